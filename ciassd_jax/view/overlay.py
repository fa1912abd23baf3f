"""A camera's image with projected 3D boxes, drawn with matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from ciassd_jax.formats.kitti_camera import Calibration, lidar_to_image
from ciassd_jax.view.outlines import outline_boxes, project_segments, seen_in_image
from ciassd_jax.view.picture import DIMMED, DIMMED_MEANING, FOUND, TRUTH, captions_of, new_picture
from ciassd_jax.view.sampling import usable_boxes
from ciassd_jax.view.view_frame import SCORE_MEANING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Pixels of the image per inch of the figure; the picture is saved at 1.5 times this resolution, for crisp lines.
_SCALE = 100
# Captions keep this distance from the upper and lower border, in pixels, so that they stay inside the image.
_CAPTION_HEIGHT = 16
# Colours of captions, lighter than the lines because their background is dark.
_TEXT_COLORS = {TRUTH: "#ff9a94", DIMMED: "#e6c3c2", FOUND: "#7dff9a"}


def plot_overlay(
    image: UInt8[np.ndarray, "rows columns 3"],
    calibration: Calibration,
    boxes: Float[np.ndarray, "D 7"] | None = None,
    truth: Float[np.ndarray, "G 7"] | None = None,
    scores: Float[np.ndarray, " D"] | None = None,
    labels: Sequence[str] | None = None,
    *,
    truth_labels: Sequence[str] | None = None,
    is_target: Bool[np.ndarray, " G"] | None = None,
    title: str | None = None,
) -> Figure:
    """Return the image with the ground truth in red and detections in green, as the paper's Figure 5.

    Boxes are x, y, z, length, width, height (metres), yaw in the LiDAR frame, each with a line along its bottom through
    its front. A caption has the class of a box and its score, below true boxes and above detected ones. True boxes that
    are not `is_target` are dimmed. Lines are clipped at the camera's plane. Boxes that are outside the image or not
    finite are not drawn. Raises ModuleNotFoundError without matplotlib.
    """
    height, width = image.shape[:2]
    figure = new_picture(figsize=(width / _SCALE, height / _SCALE + 0.3 * bool(title)), dpi=1.5 * _SCALE)
    axes = figure.add_axes((0, 0, 1, height / (_SCALE * figure.get_figheight())))
    axes.imshow(image, extent=(0, width, height, 0), interpolation="nearest")
    axes.set(xlim=(0, width), ylim=(height, 0))
    axes.set_axis_off()
    if title:
        axes.set_title(title, loc="left", fontsize=9)
    projection = lidar_to_image(calibration)
    boxes, truth = (np.zeros((0, 7)) if some is None else np.asarray(some, np.float64) for some in (boxes, truth))
    targets = np.ones(len(truth), bool) if is_target is None else is_target
    names = captions_of(len(truth), None, truth_labels)
    _draw(axes, truth, projection, names, np.where(targets, TRUTH, DIMMED).tolist())
    _draw(axes, boxes, projection, captions_of(len(boxes), scores, labels), [FOUND] * len(boxes))
    notes = [f"pale red: {DIMMED_MEANING}"] * (not targets.all()) + [SCORE_MEANING] * (
        scores is not None and len(scores) > 0
    )
    if notes:
        _write(axes, "; ".join(notes), width - 4, height - 4, "#e8e8e8", ha="right", va="bottom")
    return figure


def _draw(
    axes: Axes,
    boxes: Float[np.ndarray, "D 7"],
    projection: Float[np.ndarray, "3 4"],
    texts: Sequence[str],
    colors: Sequence[str],
) -> None:
    """The visible lines of the boxes that the image shows, each with its caption."""
    from matplotlib.collections import LineCollection

    width, height = axes.get_xlim()[1], axes.get_ylim()[0]
    usable = np.flatnonzero(usable_boxes(boxes))
    pixels = project_segments(outline_boxes(boxes[usable]), projection)
    seen = seen_in_image(pixels, (int(width), int(height)))
    for index, ends in zip(usable[seen].tolist(), pixels[seen], strict=True):
        lines, color = ends[np.isfinite(ends).all((1, 2))], colors[index]
        axes.add_collection(
            LineCollection(list(lines), colors=color, linewidths=0.9 if color == DIMMED else 1.4, capstyle="round"),
            autolim=False,
        )
        if not texts[index]:
            continue
        points = lines.reshape(-1, 2).clip(0, (width, height))
        low, high = points.min(0), points.max(0)
        above = color == FOUND
        y = max(low[1] - 3, _CAPTION_HEIGHT) if above else min(high[1] + 3, height - _CAPTION_HEIGHT)
        middle = (low[0] + high[0]) / 2
        _write(axes, texts[index], middle, y, _TEXT_COLORS[color], ha="center", va="bottom" if above else "top")


def _write(axes: Axes, text: str, x: float, y: float, color: str, **alignment: Any) -> None:
    style = {"boxstyle": "round,pad=0.12", "facecolor": "black", "edgecolor": "none", "alpha": 0.55}
    axes.text(x, y, text, color=color, fontsize=7, bbox=style, clip_on=True, **alignment)
