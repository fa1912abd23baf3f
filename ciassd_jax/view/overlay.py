"""A camera's image with projected 3D boxes, drawn with matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

from ciassd_jax.formats.kitti_camera import Calibration, lidar_to_image
from ciassd_jax.view.outlines import outline_boxes, project_segments, seen_in_image
from ciassd_jax.view.picture import FOUND, TRUTH, captions_of, new_picture
from ciassd_jax.view.sampling import usable_boxes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Pixels of the image per inch of the figure; the picture is saved at 1.5 times this resolution, for crisp lines.
_SCALE = 100
# Captions keep this distance from the upper border, in pixels, so that they stay inside the image.
_CAPTION_HEIGHT = 16


def plot_overlay(
    image: UInt8[np.ndarray, "rows columns 3"],
    calibration: Calibration,
    boxes: Float[np.ndarray, "D 7"] | None = None,
    truth: Float[np.ndarray, "G 7"] | None = None,
    scores: Float[np.ndarray, " D"] | None = None,
    labels: Sequence[str] | None = None,
    *,
    title: str | None = None,
) -> Figure:
    """Return the image with the ground truth in red and detections in green with their scores, as the paper's Figure 5.

    Boxes are x, y, z, length, width, height (metres), yaw in the LiDAR frame, each with a line along its bottom through
    its front. Lines are clipped at the camera's plane. Boxes that are outside the image or not finite are not drawn.
    Raises ModuleNotFoundError without matplotlib.
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
    _draw(axes, truth, projection, TRUTH, None)
    texts = captions_of(0 if boxes is None else len(boxes), scores, labels)
    _draw(axes, boxes, projection, FOUND, texts)
    return figure


def _draw(
    axes: Axes,
    boxes: Float[np.ndarray, "D 7"] | None,
    projection: Float[np.ndarray, "3 4"],
    color: str,
    texts: Sequence[str] | None,
) -> None:
    """The visible lines of the boxes that the image shows, and a caption above each."""
    from matplotlib.collections import LineCollection

    if boxes is None:
        return
    width, height = axes.get_xlim()[1], axes.get_ylim()[0]
    usable = np.flatnonzero(usable_boxes(boxes))
    pixels = project_segments(outline_boxes(boxes[usable]), projection)
    seen = seen_in_image(pixels, (int(width), int(height)))
    for index, ends in zip(usable[seen].tolist(), pixels[seen], strict=True):
        lines = ends[np.isfinite(ends).all((1, 2))]
        axes.add_collection(LineCollection(list(lines), colors=color, linewidths=1.4, capstyle="round"), autolim=False)
        if texts and texts[index]:
            points = lines.reshape(-1, 2).clip(0, (width, height))
            low, high = points.min(0), points.max(0)
            _caption(axes, texts[index], (low[0] + high[0]) / 2, max(low[1] - 3, _CAPTION_HEIGHT))


def _caption(axes: Axes, text: str, x: float, y: float) -> None:
    style = {"boxstyle": "round,pad=0.12", "facecolor": "black", "edgecolor": "none", "alpha": 0.55}
    axes.text(x, y, text, color="#7dff9a", fontsize=7, ha="center", va="bottom", bbox=style, clip_on=True)
