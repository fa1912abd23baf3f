"""Pictures of the curves of trainings: which panels there are, and what each curve holds."""

import numpy as np
from numpy.testing import assert_array_equal

from ciassd_jax.view.curves import plot_curves

STEP = {"loss": 4.0, "classification": 2.0, "box": 1.0, "direction": 0.5, "iou": 0.25, "positives": 9.0}
SCORE = {"score": 7.0, "Car_3d_0.70_moderate_R40": 7.0, "Car_bev_0.70_moderate_R40": 9.0, "detections": 3}


def test_every_quantity_has_a_panel_and_null_is_a_gap() -> None:
    lines = [{"step": 1, **STEP, "learning_rate": 0.1}, {"step": 2, **STEP, "loss": None}, {"step": 2, **SCORE}]
    panels = {axes.get_title(loc="left"): axes.get_lines() for axes in plot_curves({"run": lines}).axes}
    assert list(panels) == [
        *("loss", "classification loss", "box loss", "direction loss", "IoU loss"),
        *("learning rate", "positive anchors per scene", "AP of Car, moderate, R40 (%)"),
    ]
    (loss,), (rate,) = panels["loss"], panels["learning rate"]
    assert_array_equal(loss.get_xydata(), [[1, 4], [2, np.nan]])
    assert_array_equal(rate.get_xydata(), [[1, 0.1]])
    assert [list(line.get_ydata()) for line in panels["AP of Car, moderate, R40 (%)"]] == [[7], [9]]


def test_several_runs_share_the_panels_and_several_classes_have_their_mean() -> None:
    other = {"step": 3, **SCORE, "fork_lift_3d_0.50_hard_R40": 5.0}
    figure = plot_curves(
        {"a": [{"step": 1, "loss": 100.0}, {"step": 2, "loss": 1.0}], "b": [other, {"step": 1, **STEP}]}
    )
    panels = {axes.get_title(loc="left"): axes for axes in figure.axes}
    assert [line.get_color() for line in panels["loss"].get_lines()] == ["C0", "C1"]
    assert panels["loss"].get_yscale() == "log"
    assert "learning rate" not in panels
    assert {"validation score: mean 3D AP (%)", "AP of fork_lift, hard, R40 (%)"} <= set(panels)
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["a", "b"]
