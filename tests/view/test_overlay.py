"""Boxes in a camera's image: what is drawn and where, also on KITTI's images."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from small import CALIBRATION, IMAGE_SIZE

from ciassd_jax.data.kitti import read_kitti_frame
from ciassd_jax.formats.kitti_camera import Calibration, lidar_to_image, read_calibration
from ciassd_jax.formats.kitti_rows import read_rows
from ciassd_jax.view.outlines import outline_boxes, project_segments
from ciassd_jax.view.overlay import plot_overlay
from ciassd_jax.view.picture import DIMMED, FOUND, TRUTH
from ciassd_jax.view.sources import read_image
from ciassd_jax.view.view_frame import SCORE_MEANING

WIDTH, HEIGHT = IMAGE_SIZE
IMAGE = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
BOXES = np.array([[12, 1, -1, 4, 2, 1.5, 0.2], [20, -4, -1, 4, 2, 1.5, 1.4]], np.float32)


@pytest.fixture
def calibration(tmp_path: Path) -> Calibration:
    (tmp_path / "calib.txt").write_text(CALIBRATION)
    return read_calibration(tmp_path / "calib.txt")


def boxes_of(figure: Figure, color: str) -> list[np.ndarray]:
    """The segments of every box in this colour."""
    found = [c for c in figure.axes[0].collections if isinstance(c, LineCollection)]
    return [np.asarray(c.get_segments()) for c in found if to_hex(c.get_color()[0]) == color]


def texts_of(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.axes[0].texts]


def test_boxes_lie_where_the_camera_sees_them(calibration: Calibration) -> None:
    figure = plot_overlay(IMAGE, calibration, BOXES[:1], BOXES, np.array([0.876], np.float32), title="A street")
    expected = project_segments(outline_boxes(BOXES), lidar_to_image(calibration))
    np.testing.assert_allclose(boxes_of(figure, TRUTH), expected)
    np.testing.assert_allclose(boxes_of(figure, FOUND), expected[:1])
    assert texts_of(figure) == ["0.88", SCORE_MEANING]
    assert figure.axes[0].get_title("left") == "A street"


def test_boxes_are_named_and_truth_that_is_no_target_is_dimmed(calibration: Calibration) -> None:
    names, targets = ["Car", "Tram"], np.array([True, False])
    figure = plot_overlay(IMAGE, calibration, BOXES[:1], BOXES, labels=["Car"], truth_labels=names, is_target=targets)
    expected = project_segments(outline_boxes(BOXES), lidar_to_image(calibration))
    np.testing.assert_allclose(boxes_of(figure, TRUTH), expected[:1])
    np.testing.assert_allclose(boxes_of(figure, DIMMED), expected[1:])
    assert texts_of(figure) == ["Car", "Tram", "Car", "pale red: truth that is no target"]
    below, _, above, _ = (text.get_position()[1] for text in figure.axes[0].texts)
    assert above < expected[0, ..., 1].min() < expected[0, ..., 1].max() < below


def test_the_picture_is_the_image(calibration: Calibration, tmp_path: Path) -> None:
    plot_overlay(IMAGE, calibration).savefig(tmp_path / "empty.png", dpi=100)
    np.testing.assert_array_equal(read_image(tmp_path / "empty.png"), IMAGE)


def test_a_box_around_the_camera_is_cut_and_stays_in_the_picture(calibration: Calibration, tmp_path: Path) -> None:
    figure = plot_overlay(IMAGE, calibration, np.array([[1, 0.5, -1, 6, 2, 1.5, 0.1]]), scores=np.array([0.5]))
    (lines,) = boxes_of(figure, FOUND)
    # Of the 13 lines the four at the rear end lie behind.
    assert len(lines) == 9
    assert np.isfinite(lines).all()
    figure.savefig(tmp_path / "near.png")
    assert figure.axes[0].get_xlim() == (0, WIDTH)


@pytest.mark.parametrize("box", [[-12, 0, -1, 4, 2, 1.5, 0], [12, 40, -1, 4, 2, 1.5, 0], [12, np.inf, -1, 4, 2, 1, 0]])
def test_boxes_out_of_sight_are_left_out(box: list[float], calibration: Calibration) -> None:
    figure = plot_overlay(IMAGE, calibration, np.array([box]), scores=np.array([0.5]))
    assert not boxes_of(figure, FOUND)
    assert texts_of(figure) == [SCORE_MEANING]


@pytest.mark.reference
@pytest.mark.parametrize("name", ["000000", "000001", "000003", "000004", "000007", "000009"])
def test_kittis_boxes_frame_kittis_objects(name: str, shared: Path, tmp_path: Path) -> None:
    """The frame around the projected corners is the label's own 2D box, as closely as it was annotated."""
    folder = shared / "kitti_full" / "training"
    if not folder.is_dir():
        pytest.skip(f"the complete frames are not at {folder}")
    frame = read_kitti_frame(name, folder=folder)
    assert frame.camera is not None
    image = read_image(folder / "image_2" / f"{name}.png")
    truth = np.asarray(frame.boxes.to_array())
    figure = plot_overlay(image, frame.camera.calibration, truth=truth, title=name)
    figure.savefig(tmp_path / "overlay.png")
    rows = [row for row in read_rows(folder / "label_2" / f"{name}.txt") if row.type != "DontCare"]
    whole = [index for index, row in enumerate(rows) if row.truncated == 0]
    drawn = boxes_of(figure, TRUTH)
    assert len(drawn) == len(rows)
    for index in whole:
        # The heading, last, reaches out of the box.
        corners = drawn[index][:12].reshape(-1, 2)
        np.testing.assert_allclose([*corners.min(0), *corners.max(0)], rows[index].bbox, atol=12)
