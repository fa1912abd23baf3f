"""Boxes as lines: their positions, their projection, and clipping at the camera's plane."""

import numpy as np
import pytest

from ciassd_jax.view.outlines import HEADING, NEAREST_DEPTH, outline_boxes, project_segments, seen_in_image

# A camera at the sensor that looks along x: u = 320 - 300 y / x, v = 240 - 300 z / x.
PROJECTION = np.array([[320.0, -300, 0, 0], [240, 0, -300, 0], [1, 0, 0, 0]])
BOXES = np.array([[12, 3, -1, 4, 2, 1.5, 0.4], [25, -6, 0, 3, 1.5, 1.6, -2.0], [9, 0, -1, 4, 2, 1.5, np.pi]])


def test_an_outline_has_the_boxs_twelve_edges_and_its_heading() -> None:
    lines = outline_boxes(BOXES)
    assert lines.shape == (3, 13, 2, 3)
    lengths = np.linalg.norm(lines[:, :, 1] - lines[:, :, 0], axis=-1)
    for box, edges in zip(BOXES, lengths, strict=True):
        np.testing.assert_allclose(np.sort(edges[:12]), np.sort(np.repeat(box[3:6], 4)))
        np.testing.assert_allclose(edges[12], box[3] / 2 + HEADING)
    # Every corner ends three edges, and their mean is the centre.
    np.testing.assert_allclose(lines[:, :12].mean((1, 2)), BOXES[:, :3], atol=1e-12)
    corners, times = np.unique(lines[0, :12].reshape(-1, 3).round(9), axis=0, return_counts=True)
    assert (len(corners), set(times.tolist())) == (8, {3})


def test_the_heading_points_along_the_yaw_on_the_bottom() -> None:
    start, end = np.moveaxis(outline_boxes(BOXES)[:, 12], 1, 0)
    way = end - start
    np.testing.assert_allclose(np.arctan2(way[:, 1], way[:, 0]), [0.4, -2.0, np.pi], atol=1e-12)
    np.testing.assert_allclose(start[:, 2], BOXES[:, 2] - BOXES[:, 5] / 2)


def test_ends_before_the_camera_project_by_the_matrix() -> None:
    lines = outline_boxes(BOXES)
    pixels = project_segments(lines, PROJECTION)
    x, y, z = np.moveaxis(lines, -1, 0)
    np.testing.assert_allclose(pixels, np.stack([320 - 300 * y / x, 240 - 300 * z / x], -1))


def test_an_edge_through_the_cameras_plane_is_cut_there() -> None:
    line = np.array([[[-4.0, 1, -1], [8, 2, -1]]])
    ((start, end),) = project_segments(line, PROJECTION)
    # The point of the line at the nearest depth.
    share = (NEAREST_DEPTH + 4) / 12
    cut = line[0, 0] + share * (line[0, 1] - line[0, 0])
    np.testing.assert_allclose(cut[0], NEAREST_DEPTH)
    np.testing.assert_allclose(start, [320 - 300 * cut[1] / cut[0], 240 - 300 * cut[2] / cut[0]])
    np.testing.assert_allclose(end, [320 - 300 * 2 / 8, 240 + 300 / 8])
    np.testing.assert_allclose(project_segments(line[:, ::-1], PROJECTION)[0], [end, start])


def test_what_lies_behind_is_not_projected() -> None:
    behind = outline_boxes(np.array([[-12, 0, -1, 4, 2, 1.5, 0.4]]))
    pixels = project_segments(behind, PROJECTION)
    assert np.isnan(pixels).all()
    assert not seen_in_image(pixels, (640, 480)).any()


@pytest.mark.parametrize(
    ("box", "seen"),
    [
        ([12, 0, -1, 4, 2, 1.5, 0], True),
        ([12, 40, -1, 4, 2, 1.5, 0], False),
        ([12, 13.0, -1, 4, 2, 1.5, 0], True),
        ([1, 0, -1, 6, 2, 1.5, 0], True),
    ],
)
def test_a_box_is_seen_where_it_meets_the_image(box: list[float], seen: bool) -> None:
    pixels = project_segments(outline_boxes(np.array([box])), PROJECTION)
    assert seen_in_image(pixels, (640, 480)).tolist() == [seen]


def test_no_boxes_have_no_lines() -> None:
    pixels = project_segments(outline_boxes(np.zeros((0, 7))), PROJECTION)
    assert pixels.shape == (0, 13, 2, 2)
    assert seen_in_image(pixels, (640, 480)).shape == (0,)
