"""A picture of a scene from above, drawn with matplotlib's objects: no window, no global state."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ciassd_jax.ops.footprints import footprint_corners
from ciassd_jax.types import Boxes
from ciassd_jax.view.outlines import HEADING
from ciassd_jax.view.sampling import choose_points, usable_boxes

try:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("Pictures need matplotlib; get it with `pip install 'ciassd_jax[viz]'`.") from error

TRUTH, FOUND = "#d62728", "#13a538"
# More points than this only cover each other.
PICTURE_POINTS = 1_000_000
# Heights in metres that the colours span: from the ground below the sensor to the roofs of cars and vans.
HEIGHTS = (-2.0, 1.0)
# The ground recedes, what stands on it does not; neither is red or green.
HEIGHT_COLORS = LinearSegmentedColormap.from_list("height", ["#c9c6ba", "#8fa3bd", "#3f6aa8", "#1b2f63"])


class Picture(Figure):
    """A figure that a notebook shows as the value of a cell, whether or not it uses pyplot."""

    def _repr_png_(self) -> bytes:
        stream = io.BytesIO()
        self.savefig(stream, format="png")
        return stream.getvalue()


def plot_bev(
    points: Float[np.ndarray, "N columns"],
    boxes: Float[np.ndarray, "D 7"] | None = None,
    truth: Float[np.ndarray, "G 7"] | None = None,
    scores: Float[np.ndarray, " D"] | None = None,
    labels: Sequence[str] | None = None,
    *,
    x_limits: tuple[float, float] | None = None,
    y_limits: tuple[float, float] | None = None,
    title: str | None = None,
) -> Picture:
    """Points coloured by height, ground truth in red, detections in green with score and heading.

    `points` hold x, y, z (metres) first; boxes are x, y, z, length, width, height, yaw. Without limits the picture
    holds every point and box of the front half, and says what it leaves out: points and boxes that are not finite or
    absurdly far, points beyond a million. Save it with `figure.savefig(path)`.
    """
    visible, point_notes = choose_points(points, PICTURE_POINTS)
    texts = captions_of(0 if boxes is None else len(boxes), scores, labels)
    boxes, texts, lost = _usable(boxes, texts, "detected")
    truth, _, lost_truth = _usable(truth, captions_of(0 if truth is None else len(truth), None, None), "true")
    x_limits = x_limits or _span(visible, boxes, truth, 0)
    y_limits = y_limits or _span(visible, boxes, truth, 1)
    figure = Picture(figsize=_figure_size(x_limits, y_limits), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    # The highest points last: roofs and walls over the ground.
    visible = visible[np.argsort(visible[:, 2], kind="stable")]
    dots = axes.scatter(
        visible[:, 0], visible[:, 1], c=visible[:, 2], s=1.6, lw=0, cmap=HEIGHT_COLORS, vmin=HEIGHTS[0], vmax=HEIGHTS[1]
    )
    dots.set_rasterized(True)
    bar = figure.colorbar(dots, ax=axes, shrink=0.7, pad=0.015, extend="both")
    bar.set_label("height z (m)")
    _draw_boxes(axes, truth, TRUTH, zorder=3)
    _draw_boxes(axes, boxes, FOUND, zorder=4)
    for box, text in zip(boxes, texts, strict=True):
        _caption(axes, box, text)
    _dress(axes, x_limits, y_limits)
    _legend(axes, len(boxes), len(truth))
    axes.set_title(title or "", loc="left")
    if notes := [*point_notes, *lost, *lost_truth]:
        axes.text(0.01, 0.01, "\n".join(notes), transform=axes.transAxes, fontsize=7, color="#555555", zorder=7)
    return figure


def _usable(
    boxes: np.ndarray | None, texts: list[str], what: str
) -> tuple[Float[np.ndarray, "D 7"], list[str], list[str]]:
    """The boxes that can be drawn, their texts, and a note where some cannot."""
    if boxes is None:
        return np.zeros((0, 7)), [], []
    boxes = np.asarray(boxes, np.float64)
    usable = np.flatnonzero(usable_boxes(boxes))
    lost = len(boxes) - len(usable)
    notes = [f"{lost} of {len(boxes)} {what} boxes are not finite or too far and not shown."] if lost else []
    return boxes[usable], [texts[index] for index in usable], notes


def _footprints(boxes: Float[np.ndarray, "D 7"]) -> Float[np.ndarray, "D 5 2"]:
    """The closed outline of each box on the ground."""
    return np.asarray(footprint_corners(Boxes.from_array(boxes)))[:, (0, 1, 2, 3, 0)]


def _draw_boxes(axes: Axes, boxes: Float[np.ndarray, "D 7"], color: str, zorder: int) -> None:
    """Outlines, and a line from each centre through the front."""
    ahead = np.stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6])], -1) * (boxes[:, 3:4] / 2 + HEADING)
    heading = boxes[:, None, :2] + np.stack([np.zeros_like(ahead), ahead], 1)
    for lines in (_footprints(boxes), heading):
        axes.add_collection(LineCollection(list(lines), colors=color, linewidths=1.6, zorder=zorder))


def captions_of(count: int, scores: np.ndarray | None, labels: Sequence[str] | None) -> list[str]:
    """Class and score of each box as a text; the class only where there are several."""
    several = labels is not None and len(set(labels)) > 1
    parts = [list(labels or []) if several else [], [] if scores is None else [f"{score:.2f}" for score in scores]]
    return [" ".join(part[i] for part in parts if part) for i in range(count)]


def _caption(axes: Axes, box: Float[np.ndarray, " 7"], text: str) -> None:
    if not text:
        return
    top = _footprints(box[None])[0][:, 1].max()
    box_style = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
    axes.annotate(
        text,
        (box[0], top),
        xytext=(0, 3),
        textcoords="offset points",
        ha="center",
        va="bottom",
        color="#0a6b22",
        fontsize=8,
        bbox=box_style,
        annotation_clip=True,
        zorder=5,
    )


def _span(points: np.ndarray, boxes: np.ndarray, truth: np.ndarray, axis: int) -> tuple[float, float]:
    """Limits that hold everything ahead of the sensor and the sensor itself, with a margin."""
    ahead = points[points[:, 0] >= 0]
    values = np.concatenate([[0.0], ahead[:, axis], *(_footprints(b)[..., axis].ravel() for b in (boxes, truth))])
    return float(values.min()) - 2, float(values.max()) + 2


def _figure_size(x_limits: tuple[float, float], y_limits: tuple[float, float]) -> tuple[float, float]:
    """Inches of a picture with little space left around axes of equal scale."""
    ratio = (y_limits[1] - y_limits[0]) / (x_limits[1] - x_limits[0])
    return 10.0, min(max(8.2 * ratio + 0.9, 4.0), 12.0)


def _dress(axes: Axes, x_limits: tuple[float, float], y_limits: tuple[float, float]) -> None:
    """Metres of equal length along both axes, a light grid and the sensor's place."""
    axes.set(xlim=x_limits, ylim=y_limits, aspect="equal", xlabel="x forward (m)", ylabel="y left (m)")
    axes.grid(color="#ebebe8", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.plot(0, 0, marker=">", markersize=9, color="black", zorder=6, clip_on=True)


def _legend(axes: Axes, found: int, truth: int) -> None:
    handles = [Line2D([], [], color="black", marker=">", linestyle="none", label="sensor")]
    handles += [Line2D([], [], color=TRUTH, linewidth=1.6, label=f"ground truth ({truth})")] * bool(truth)
    handles += [Line2D([], [], color=FOUND, linewidth=1.6, label=f"detected ({found})")]
    axes.legend(handles=handles, loc="upper right", framealpha=0.9, fontsize=9)
