"""What a result says of itself: parts of it, corners, KITTI's rows, plain numbers, and a table for notebooks."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from small import CALIBRATION, IMAGE_SIZE, small_cloud

from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.kitti_camera import read_camera
from ciassd_jax.inference.results import FrameResult, write_result
from ciassd_jax.ops.footprints import footprint_corners
from ciassd_jax.types import Boxes
from ciassd_jax.view.outlines import outline_boxes
from ciassd_jax.view.view_frame import SCORE_MEANING

BOXES = np.array(
    [
        [10, 2, -1, 3.9, 1.6, 1.5, 0.3],
        [14, -3, -1, 4.6, 1.9, 2.0, -1.2],
        # Behind the camera.
        [-12, 0, -1, 0.8, 0.6, 1.7, 2.0],
        [18, 5, -1, 3.9, 1.6, 1.5, -3.0],
    ],
    np.float32,
)
RESULT = FrameResult(
    BOXES,
    np.array([0.9, 0.4, 0.3, 0.2], np.float32),
    ("Car", "Van", "Pedestrian", "Car"),
    {"points": {"given": 600}},
    0.1,
    ("Car", "Van", "Pedestrian", "Cyclist"),
)


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    (tmp_path / "calib.txt").write_text(CALIBRATION)
    return tmp_path / "calib.txt"


def test_a_filter_keeps_scores_from_the_least_and_the_named_classes() -> None:
    least = float(RESULT.scores[1])
    for kept, expected in (
        (RESULT.filter(), [0, 1, 2, 3]),
        (RESULT.filter(min_score=least), [0, 1]),
        (RESULT.filter(min_score=0.9001), []),
        (RESULT.filter(classes="car"), [0, 3]),
        (RESULT.filter(classes=["VAN", "Pedestrian"]), [1, 2]),
        (RESULT.filter(0.25, ["Car", "Cyclist"]), [0]),
        (RESULT.filter(classes=[]), []),
    ):
        np.testing.assert_array_equal(kept.boxes, BOXES[expected])
        np.testing.assert_array_equal(kept.scores, RESULT.scores[expected])
        assert kept.labels == tuple(RESULT.labels[index] for index in expected)
        assert (kept.counts, kept.seconds, kept.class_names) == (RESULT.counts, 0.1, RESULT.class_names)


def test_an_unknown_class_is_refused_with_the_known_ones() -> None:
    """Also where the frame has no detection of a known class."""
    with pytest.raises(
        ValueError, match=r"^'Tram' is none of the classes; choose from Car, Van, Pedestrian, Cyclist\.$"
    ):
        RESULT.filter(classes=["Car", "Tram"])
    assert len(RESULT[:0].filter(classes="Cyclist")) == 0


def test_detections_are_chosen_as_in_an_array() -> None:
    assert RESULT[:2].labels == ("Car", "Van")
    np.testing.assert_array_equal(RESULT[RESULT.boxes[:, 0] > 12].boxes, BOXES[[1, 3]])
    np.testing.assert_array_equal(RESULT[[3, 0]].scores, RESULT.scores[[3, 0]])
    assert [(len(one), one.labels[0]) for one in RESULT] == [(1, label) for label in RESULT.labels]
    assert RESULT[-1].boxes.shape == (1, 7)
    with pytest.raises(IndexError):
        RESULT[4]


def test_results_lie_in_lists_and_sets() -> None:
    """They are compared by identity, as their arrays have no single truth."""
    other = RESULT[:]
    assert [other, RESULT].index(RESULT) == 1
    assert len({other, RESULT}) == 2


def test_corners_are_those_of_the_footprints_and_of_the_outlines() -> None:
    corners = RESULT.corners
    assert corners.shape == (4, 8, 3)
    np.testing.assert_allclose(corners[:, :4, :2], footprint_corners(Boxes.from_array(BOXES)), atol=1e-6)
    np.testing.assert_array_equal(corners[:, :4, :2], corners[:, 4:, :2])
    np.testing.assert_allclose(corners[:, :4, 2], BOXES[:, 2:3].repeat(4, 1) - BOXES[:, 5:6] / 2, atol=1e-6)
    np.testing.assert_allclose(corners.mean(1), BOXES[:, :3], atol=1e-5)
    edges = outline_boxes(BOXES)[:, :12].reshape(4, -1, 3)
    for one, ends in zip(corners, edges, strict=True):
        np.testing.assert_allclose(np.unique(ends.round(4), axis=0), np.unique(one.round(4), axis=0), atol=2e-4)
    assert RESULT[:0].corners.shape == (0, 8, 3)


def test_kittis_lines_are_those_of_the_result_file(calibration: Path, tmp_path: Path) -> None:
    camera = read_camera(calibration, image_size=IMAGE_SIZE)
    lines = RESULT.to_kitti(calibration, image_size=IMAGE_SIZE)
    assert lines == RESULT.to_kitti(camera)
    assert [line.split()[0] for line in lines] == ["Car", "Van", "Car"]
    write_result(RESULT, "000000", tmp_path, camera)
    assert (tmp_path / "000000.txt").read_text() == "".join(f"{line}\n" for line in lines)
    assert RESULT[:0].to_kitti(camera) == []
    with pytest.raises(InputError, match="`image_size`"):
        RESULT.to_kitti(calibration)


def test_plain_numbers_have_names() -> None:
    plain = json.loads(json.dumps(RESULT.to_dict()))
    assert plain["box_columns"] == ["x", "y", "z", "length", "width", "height", "yaw"]
    np.testing.assert_allclose(plain["boxes"], BOXES)
    assert (plain["labels"], plain["counts"], plain["seconds"]) == (list(RESULT.labels), RESULT.counts, 0.1)


def test_a_notebook_shows_a_table_of_the_first_rows() -> None:
    evil = "<b onclick=alert(1)>&"
    many = FrameResult(BOXES[:1].repeat(25, 0), np.linspace(0.9, 0.4, 25), (evil, *["Car"] * 24), {}, 0.1234)
    page = many._repr_html_()
    assert "25 detections in 123 ms" in page
    assert page.count(SCORE_MEANING) == 1
    assert evil not in page
    rows = re.findall(r"<tr>(.*?)</tr>", page)
    assert re.findall(r"<th>(.*?)</th>", rows[0]) == ["class", "score", *many.to_dict()["box_columns"]]
    assert re.findall(r"<td>(.*?)</td>", rows[1]) == ["&lt;b onclick=alert(1)&gt;&amp;", "0.90"] + [
        f"{value:.2f}" for value in BOXES[0]
    ]
    assert (len(rows), "... and 5 more" in page) == (21, True)
    assert "more" not in RESULT._repr_html_()
    assert len(re.findall("<tr>", RESULT[:0]._repr_html_())) == 1


def test_pictures_name_the_true_boxes() -> None:
    figure = RESULT.plot_bev(small_cloud(), BOXES[:1], truth_labels=["Tram"])
    assert isinstance(figure, Figure)
    assert [text.get_text() for text in figure.axes[0].texts] == [
        "Tram",
        *(f"{label} {score:.2f}" for label, score in zip(RESULT.labels, RESULT.scores, strict=True)),
    ]
    assert '"labels":["Tram"]' in RESULT.view(small_cloud(), BOXES[:1], truth_labels=["Tram"]).html
