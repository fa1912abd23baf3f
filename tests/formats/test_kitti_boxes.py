"""Boxes between the LiDAR frame and KITTI's rows."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kitti_samples import CALIBRATION, ROW

from ciassd_jax.formats.kitti_boxes import boxes_to_rows, rows_to_boxes
from ciassd_jax.formats.kitti_camera import image_size_for, lidar_to_image, read_calibration
from ciassd_jax.formats.kitti_rows import read_rows
from ciassd_jax.types import Boxes

EVERYTHING = (10**9, 10**9)


def test_golden_label_to_lidar_to_image():
    boxes = rows_to_boxes([ROW], CALIBRATION)
    np.testing.assert_allclose(boxes.center, [[8.698237, -1.825290, -0.688665]], atol=1e-6)
    np.testing.assert_array_equal(boxes.size, [[4.15, 1.73, 1.57]])
    np.testing.assert_allclose(boxes.yaw, 1.56 - np.pi / 2)
    (row,), kept = boxes_to_rows(boxes, np.array([0.5]), ["Car"], CALIBRATION, EVERYTHING)
    assert kept.tolist() == [0]
    np.testing.assert_allclose(row.bbox, (682.235839, 161.411841, 922.229593, 340.413049), atol=1e-6)
    np.testing.assert_allclose(row.alpha, -1.766845, atol=1e-6)
    assert_same_object(row, ROW)


def assert_same_object(row, other):
    assert (row.type, row.score) == (other.type, other.score)
    np.testing.assert_allclose(row.dimensions, other.dimensions, atol=1e-6)
    np.testing.assert_allclose(row.location, other.location, atol=1e-6)
    turn = (row.rotation_y - other.rotation_y + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(turn, 0, atol=1e-6)


def between(low, high):
    return st.floats(low, high, width=32)


@settings(deadline=None)
@given(
    st.lists(
        st.builds(
            lambda location, dimensions, rotation_y, score: ROW._replace(
                location=location, dimensions=dimensions, rotation_y=rotation_y, score=score
            ),
            st.tuples(between(-20, 20), between(-3, 3), between(30, 80)),
            st.tuples(between(0.5, 3), between(0.5, 3), between(0.5, 8)),
            between(-4, 4),
            between(0, 1),
        ),
        max_size=4,
    )
)
def test_rows_to_boxes_to_rows_is_the_identity(rows):
    boxes = rows_to_boxes(rows, CALIBRATION)
    scores = np.array([row.score for row in rows])
    again, kept = boxes_to_rows(boxes, scores, [row.type for row in rows], CALIBRATION, (1242, 375))
    assert kept.tolist() == list(range(len(rows)))
    for row, other in zip(again, rows, strict=True):
        assert_same_object(row, other)
        assert -np.pi <= row.rotation_y <= np.pi
        x1, y1, x2, y2 = row.bbox
        assert 0 <= x1 <= x2 <= 1242
        assert 0 <= y1 <= y2 <= 375


def test_boxes_outside_the_image_are_left_out_and_indices_say_which():
    centers = [[20, 0, -1], [20, 60, -1], [-20, 0, -1], [20, 0, 40], [30, 2, -1], [np.nan, 0, 0]]
    boxes = Boxes(np.array(centers), np.full((6, 3), 2.0), np.zeros(6))
    names = ["Car", "Van", "Car", "Car", "Cyclist", "Car"]
    rows, kept = boxes_to_rows(boxes, np.arange(6) / 10, names, CALIBRATION, (1242, 375))
    assert kept.tolist() == [0, 4]
    assert [(row.type, row.score) for row in rows] == [("Car", 0.0), ("Cyclist", 0.4)]


def test_a_box_around_the_camera_plane_covers_what_its_visible_part_covers():
    """A bus beside the camera has the image box of its part in front, sampled densely."""
    boxes = Boxes(np.array([[0.0, 4.0, -0.5]]), np.array([[12.0, 2.5, 3.0]]), np.array([0.2]))
    (row,), _ = boxes_to_rows(boxes, np.zeros(1), ["Bus"], CALIBRATION, (1242, 375))

    along, across, up = np.meshgrid(*[np.linspace(-0.5, 0.5, 121)] * 3, indexing="ij")
    local = np.stack([along, across, up], -1).reshape(-1, 3) * boxes.size[0]
    cos, sin = np.cos(0.2), np.sin(0.2)
    turned = local @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    a, b, depth = lidar_to_image(CALIBRATION) @ np.vstack([(turned + boxes.center[0]).T, np.ones(len(local))])
    front = depth > 0.001
    u, v = a[front] / depth[front], b[front] / depth[front]
    sampled = np.clip([u.min(), v.min(), u.max(), v.max()], 0, [1242, 375, 1242, 375])
    np.testing.assert_allclose(row.bbox, sampled, atol=8)
    assert row.bbox[0] == 0
    assert row.bbox[2] < 500


def test_every_order_of_depth_is_finite():
    depths = np.linspace(-4, 4, 161)
    boxes = Boxes(np.stack([depths, 0.3 * depths, -0.7 + 0 * depths], -1), np.full((161, 3), 2.0), depths)
    rows, kept = boxes_to_rows(boxes, depths, ["Car"] * 161, CALIBRATION, (1242, 375))
    assert 80 <= len(kept) < 161
    assert kept.tolist() == list(range(kept[0], 161))
    assert np.isfinite([row.bbox for row in rows]).all()


@pytest.mark.reference
def test_labels_project_onto_their_image_boxes(shared):
    """Labels have two decimals and their image boxes are not projections: agreement is to a few pixels."""
    errors = []
    for path in sorted((shared / "kitti/training/label_2").glob("*.txt")):
        calibration = read_calibration(shared / "kitti/training/calib" / path.name)
        size = image_size_for(calibration)
        assert size is not None
        labels = [row for row in read_rows(path) if row.type == "Car" and row.truncated == 0]
        boxes = rows_to_boxes(labels, calibration)
        scores = np.zeros(len(labels))
        rows, kept = boxes_to_rows(boxes, scores, ["Car"] * len(labels), calibration, size)
        assert len(kept) == len(labels)
        for row, label in zip(rows, labels, strict=True):
            assert_same_object(row._replace(score=None), label)
            errors.append(np.abs(np.subtract(row.bbox, label.bbox)))
    errors = np.array(errors)
    assert len(errors) == 517
    assert errors.max() < 5
    assert np.quantile(errors, 0.99) < 2
