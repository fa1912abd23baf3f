"""A scene from above, drawn with matplotlib."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float

from ciassd_jax.ops.footprints import footprint_corners
from ciassd_jax.types import Boxes
from ciassd_jax.view.outlines import HEADING
from ciassd_jax.view.picture import DIMMED, DIMMED_MEANING, FOUND, TRUTH, captions_of, new_picture
from ciassd_jax.view.sampling import choose_boxes, choose_points
from ciassd_jax.view.view_frame import SCORE_MEANING, ViewFrame

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# More points than this only hide each other.
PICTURE_POINTS = 1_000_000
# The heights that the colours span, in metres: from the ground below the sensor to the roofs of cars and vans.
HEIGHTS = (-2.0, 1.0)
# The ground is pale and what stands on it dark; no colour is red or green, as boxes are.
HEIGHT_COLORS = ("#c9c6ba", "#8fa3bd", "#3f6aa8", "#1b2f63")


def plot_bev(
    points: Float[np.ndarray, "N columns"],
    boxes: Float[np.ndarray, "D 7"] | None = None,
    truth: Float[np.ndarray, "G 7"] | None = None,
    scores: Float[np.ndarray, " D"] | None = None,
    labels: Sequence[str] | None = None,
    *,
    truth_labels: Sequence[str] | None = None,
    is_target: Bool[np.ndarray, " G"] | None = None,
    x_limits: tuple[float, float] | None = None,
    y_limits: tuple[float, float] | None = None,
    title: str | None = None,
) -> Figure:
    """Return a picture of points coloured by height, ground truth in red, and detections in green.

    The first columns of `points` are x, y, z (metres); boxes are x, y, z, length, width, height, yaw. A caption has the
    class of a box and its score, beside true boxes and above detected ones. True boxes that are not `is_target` are
    dimmed. The default limits, in metres, enclose every point and box ahead of the sensor. A note in the picture counts
    what is left out: points and boxes that are not finite or farther than `sampling.FARTHEST`, and points beyond a
    million. Save the picture with `figure.savefig(path)`. Raises ModuleNotFoundError without matplotlib.
    """
    visible, point_notes = choose_points(points, PICTURE_POINTS)
    boxes, truth = (np.zeros((0, 7)) if some is None else np.asarray(some, np.float64) for some in (boxes, truth))
    chosen, box_notes = choose_boxes(boxes, "detected boxes")
    chosen_truth, truth_notes = choose_boxes(truth, "true boxes")
    captions = np.array(captions_of(len(boxes), scores, labels), object)[chosen]
    names = np.array(captions_of(len(truth), None, truth_labels), object)[chosen_truth]
    targets = (np.ones(len(truth), bool) if is_target is None else is_target)[chosen_truth]
    boxes, truth = boxes[chosen], truth[chosen_truth]
    x_limits = x_limits or _span(visible, boxes, truth, 0)
    y_limits = y_limits or _span(visible, boxes, truth, 1)
    figure = new_picture(figsize=_figure_size(x_limits, y_limits), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    _draw_points(axes, visible)
    for some, color, text_color, width in ((~targets, DIMMED, "#a87573", 0.9), (targets, TRUTH, "#a31515", 1.6)):
        _draw_boxes(axes, truth[some], color, zorder=3, width=width)
        _write_captions(axes, truth[some], names[some], text_color, beside=True)
    _draw_boxes(axes, boxes, FOUND, zorder=4)
    _write_captions(axes, boxes, captions, "#0a6b22", beside=False)
    _dress(axes, x_limits, y_limits)
    _legend(axes, len(boxes), int(targets.sum()), int((~targets).sum()))
    axes.set_title(title or "", loc="left")
    if scores is not None and len(scores):
        axes.set_title(SCORE_MEANING, loc="right", fontsize=8, color="#555555")
    if notes := [*point_notes, *box_notes, *truth_notes]:
        axes.text(0.01, 0.01, "\n".join(notes), transform=axes.transAxes, fontsize=7, color="#555555", zorder=7)
    return figure


def plot_frame(frame: ViewFrame) -> Figure:
    """Return the picture of a frame (`plot_bev`), with its name as the title."""
    return plot_bev(
        frame.points,
        frame.boxes,
        frame.truth,
        frame.scores,
        frame.labels,
        truth_labels=frame.truth_labels,
        is_target=frame.is_target,
        title=frame.name,
    )


def _draw_points(axes: Axes, points: Float[np.ndarray, "N 3"]) -> None:
    """Points coloured by height, and the scale of the colours."""
    from matplotlib.colors import LinearSegmentedColormap

    # Draw the highest points last, so that roofs and walls cover the ground.
    x, y, z = points[np.argsort(points[:, 2], kind="stable")].T
    colors = LinearSegmentedColormap.from_list("height", HEIGHT_COLORS)
    dots = axes.scatter(x, y, c=z, s=1.6, lw=0, cmap=colors, vmin=HEIGHTS[0], vmax=HEIGHTS[1])
    dots.set_rasterized(True)
    bar = axes.figure.colorbar(dots, ax=axes, shrink=0.7, pad=0.015, extend="both")
    bar.set_label("height z (m)")


def _footprints(boxes: Float[np.ndarray, "D 7"]) -> Float[np.ndarray, "D 5 2"]:
    """The closed outline of each box on the ground."""
    return np.asarray(footprint_corners(Boxes.from_array(boxes)))[:, (0, 1, 2, 3, 0)]


def _draw_boxes(axes: Axes, boxes: Float[np.ndarray, "D 7"], color: str, zorder: int, width: float = 1.6) -> None:
    """Outlines, and a line from each centre through the front."""
    from matplotlib.collections import LineCollection

    ahead = np.stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6])], -1) * (boxes[:, 3:4] / 2 + HEADING)
    heading = boxes[:, None, :2] + np.stack([np.zeros_like(ahead), ahead], 1)
    for lines in (_footprints(boxes), heading):
        axes.add_collection(LineCollection(list(lines), colors=color, linewidths=width, zorder=zorder))


def _write_captions(
    axes: Axes, boxes: Float[np.ndarray, "D 7"], texts: Iterable[str], color: str, *, beside: bool
) -> None:
    """A caption above each box, or smaller and beside it."""
    from matplotlib.patheffects import withStroke

    style: dict[str, Any] = {"ha": "center", "va": "bottom", "fontsize": 7, "xytext": (0, 2)}
    if beside:
        style = {"ha": "left", "va": "center", "fontsize": 6, "xytext": (3, 0)}
    style |= {"path_effects": [withStroke(linewidth=2, foreground="white")], "annotation_clip": True, "zorder": 5}
    for outline, text in zip(_footprints(boxes), texts, strict=True):
        (left, low), (right, high) = outline.min(0), outline.max(0)
        at = (right, (low + high) / 2) if beside else ((left + right) / 2, high)
        if text:
            axes.annotate(text, at, textcoords="offset points", color=color, **style)


def _span(points: np.ndarray, boxes: np.ndarray, truth: np.ndarray, axis: int) -> tuple[float, float]:
    """Limits that enclose the sensor and everything ahead of it, with a margin."""
    ahead = points[points[:, 0] >= 0]
    values = np.concatenate([[0.0], ahead[:, axis], *(_footprints(b)[..., axis].ravel() for b in (boxes, truth))])
    return float(values.min()) - 2, float(values.max()) + 2


def _figure_size(x_limits: tuple[float, float], y_limits: tuple[float, float]) -> tuple[float, float]:
    """Width and height in inches that leave little space around axes of equal scale."""
    ratio = (y_limits[1] - y_limits[0]) / (x_limits[1] - x_limits[0])
    return 10.0, min(max(8.2 * ratio + 0.9, 4.0), 12.0)


def _dress(axes: Axes, x_limits: tuple[float, float], y_limits: tuple[float, float]) -> None:
    """Equal scales in metres, a light grid, and a mark at the sensor."""
    axes.set(xlim=x_limits, ylim=y_limits, aspect="equal", xlabel="x forward (m)", ylabel="y left (m)")
    axes.grid(color="#ebebe8", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.plot(0, 0, marker=">", markersize=9, color="black", zorder=6, clip_on=True)


def _legend(axes: Axes, found: int, targets: int, others: int) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color="black", marker=">", linestyle="none", label="sensor")]
    handles += [Line2D([], [], color=TRUTH, linewidth=1.6, label=f"ground truth ({targets})")] * bool(targets)
    handles += [Line2D([], [], color=DIMMED, linewidth=0.9, label=f"{DIMMED_MEANING} ({others})")] * bool(others)
    handles += [Line2D([], [], color=FOUND, linewidth=1.6, label=f"detected ({found})")]
    axes.legend(handles=handles, loc="upper right", framealpha=0.9, fontsize=9)
