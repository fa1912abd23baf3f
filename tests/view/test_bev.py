"""The bird's-eye view: what is drawn and where, without global state."""

import subprocess
import sys

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from ciassd_jax.view.bev import plot_bev, plot_frame
from ciassd_jax.view.picture import DIMMED, FOUND, TRUTH
from ciassd_jax.view.view_frame import SCORE_MEANING, ViewFrame

POINTS = np.random.default_rng(0).uniform([0, -10, -2, 0], [30, 10, 1, 1], (500, 4)).astype(np.float32)
BOXES = np.array([[10, 2, -1, 4, 2, 1.5, 0], [20, -3, -1, 4, 2, 1.5, np.pi / 2]], np.float32)


def lines_of(figure: Figure, color: str) -> list[np.ndarray]:
    found = [
        c for c in figure.axes[0].collections if isinstance(c, LineCollection) and to_hex(c.get_color()[0]) == color
    ]
    return [np.asarray(segment) for collection in found for segment in collection.get_segments()]


def texts_of(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.axes[0].texts]


def legend_of(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.axes[0].get_legend().get_texts()]


def test_every_point_is_drawn_by_its_height() -> None:
    spoilt = POINTS.copy()
    spoilt[7, 2] = np.nan
    (dots,) = [c for c in plot_bev(spoilt).axes[0].collections if isinstance(c, PathCollection)]
    assert len(dots.get_offsets()) == len(POINTS) - 1
    np.testing.assert_array_equal(dots.get_array(), np.sort(np.delete(POINTS[:, 2], 7)))


def test_boxes_are_outlined_with_a_line_ahead() -> None:
    outline, other, heading, turned = lines_of(plot_bev(POINTS, BOXES), FOUND)
    np.testing.assert_allclose(outline.min(0), [8, 1], atol=1e-6)
    np.testing.assert_allclose(outline.max(0), [12, 3], atol=1e-6)
    np.testing.assert_allclose(other.max(0) - other.min(0), [2, 4], atol=1e-6)
    np.testing.assert_allclose(heading, [(10, 2), (13, 2)], atol=1e-6)
    np.testing.assert_allclose(turned, [(20, -3), (20, 0)], atol=1e-6)


def test_truth_is_red_and_detections_green_with_scores() -> None:
    figure = plot_bev(POINTS, BOXES[:1], BOXES, np.array([0.876], np.float32), title="A street")
    assert len(lines_of(figure, TRUTH)) == 4
    assert len(lines_of(figure, FOUND)) == 2
    assert texts_of(figure) == ["0.88"]
    assert legend_of(figure) == ["sensor", "ground truth (2)", "detected (1)"]
    assert figure.axes[0].get_title("left") == "A street"


def test_captions_name_the_class_of_every_box() -> None:
    scores = np.array([0.9, 0.5], np.float32)
    assert texts_of(plot_bev(POINTS, BOXES, scores=scores, labels=["Car", "Car"])) == ["Car 0.90", "Car 0.50"]
    assert texts_of(plot_bev(POINTS, BOXES, labels=["Car", "Van"])) == ["Car", "Van"]
    assert texts_of(plot_bev(POINTS, BOXES[:1], BOXES, labels=["Car"], truth_labels=["Bus", "Van"])) == [
        "Bus",
        "Van",
        "Car",
    ]


def test_truth_that_is_no_target_is_dimmed_and_the_legend_says_so() -> None:
    frame = ViewFrame("a", POINTS, truth=BOXES, truth_labels=("Car", "Tram"), is_target=np.array([True, False]))
    figure = plot_frame(frame)
    for color, (x, y) in ((TRUTH, BOXES[0, :2]), (DIMMED, BOXES[1, :2])):
        outline, heading = lines_of(figure, color)
        np.testing.assert_allclose(heading[0], [x, y], atol=1e-6)
        np.testing.assert_allclose(outline[:4].mean(0), [x, y], atol=1e-6)
    assert legend_of(figure) == ["sensor", "ground truth (1)", "truth that is no target (1)", "detected (0)"]
    assert (texts_of(figure), figure.axes[0].get_title("left")) == (["Tram", "Car"], "a")


def test_what_a_score_means_is_said_once_where_there_are_scores() -> None:
    scores = np.array([0.9, 0.5], np.float32)
    assert plot_bev(POINTS, BOXES, scores=scores).axes[0].get_title("right") == SCORE_MEANING
    for nothing in (plot_bev(POINTS, BOXES), plot_bev(POINTS, BOXES[:0], scores=scores[:0])):
        assert nothing.axes[0].get_title("right") == ""


def test_axes_are_metres_of_equal_length_and_hold_everything() -> None:
    axes = plot_bev(POINTS, BOXES).axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x forward (m)", "y left (m)")
    assert axes.get_aspect() == 1
    assert axes.get_xlim()[0] <= 0 < 30 <= axes.get_xlim()[1] + 0.1
    limited = plot_bev(POINTS, x_limits=(0, 12.8), y_limits=(-6.4, 6.4)).axes[0]
    assert limited.get_xlim() == (0, 12.8)
    assert limited.get_ylim() == (-6.4, 6.4)


@pytest.mark.parametrize("points", [np.zeros((0, 4), np.float32), POINTS])
def test_nothing_found_is_a_picture_too(points: np.ndarray, tmp_path) -> None:
    figure = plot_bev(points, np.zeros((0, 7), np.float32), scores=np.zeros(0, np.float32), labels=())
    figure.savefig(tmp_path / "empty.png")
    assert (tmp_path / "empty.png").read_bytes().startswith(b"\x89PNG")
    assert legend_of(figure) == ["sensor", "detected (0)"]


def test_what_cannot_be_drawn_is_counted_in_the_picture(tmp_path) -> None:
    points, boxes = POINTS.copy(), BOXES.copy()
    points[0, 0], points[1, 1], boxes[0, 4] = np.inf, 1e9, np.nan
    figure = plot_bev(points, boxes, BOXES, np.array([0.9, 0.5], np.float32))
    assert texts_of(figure) == [
        "0.50",
        "1 of 500 points are not finite and not shown.\n1 of 500 points lie farther than 300 m and are not shown.\n"
        "1 of 2 detected boxes are not finite or too far and not shown.",
    ]
    assert legend_of(figure) == ["sensor", "ground truth (2)", "detected (1)"]
    figure.savefig(tmp_path / "spoilt.png")


def test_a_notebook_shows_the_picture() -> None:
    assert plot_bev(POINTS, BOXES)._repr_png_().startswith(b"\x89PNG")


def test_no_pyplot_and_nothing_drawn_on_import() -> None:
    code = "import sys, numpy, ciassd_jax.view.bev, ciassd_jax.view.overlay; assert 'matplotlib' not in sys.modules; "
    code += "ciassd_jax.view.bev.plot_bev(numpy.zeros((1, 4))); assert 'matplotlib.pyplot' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_without_matplotlib_one_sentence_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ModuleNotFoundError, match=r"matplotlib.*pip install 'ciassd_jax\[viz\]'"):
        plot_bev(POINTS)
