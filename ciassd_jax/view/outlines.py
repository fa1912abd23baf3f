"""Boxes as line segments, in space and in a camera's image."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float64

from ciassd_jax.ops.camera import clip_to_depth
from ciassd_jax.ops.footprints import box_corners
from ciassd_jax.types import Boxes

# Pairs of points: corners in the order of `box_corners`, then the ends of the heading.
_EDGES = np.array(
    [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7), (8, 9)]
)
# The heading, the last segment, runs along the bottom from the centre to this many metres ahead of the front.
HEADING = 1.0
# Segments are clipped at this depth in metres.
NEAREST_DEPTH = 0.1


def outline_boxes(boxes: Float[np.ndarray, "D 7"]) -> Float64[np.ndarray, "D 13 2 3"]:
    """Return the twelve edges of each box and its heading, as start and end in x, y, z (metres, LiDAR frame).

    `boxes` are x, y, z of the centre, length, width, height, yaw.
    """
    boxes = np.asarray(boxes, np.float64)
    below = boxes[:, :3] - (0, 0, 0.5) * boxes[:, 3:6]
    ahead = np.stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6]), np.zeros(len(boxes))], -1)
    front = below + ahead * (boxes[:, 3:4] / 2 + HEADING)
    points = np.concatenate([box_corners(Boxes.from_array(boxes)), below[:, None], front[:, None]], 1)
    return points[:, _EDGES]


def project_segments(
    segments: Float[np.ndarray, "*n 2 3"], projection: Float[np.ndarray, "3 4"]
) -> Float64[np.ndarray, "*n 2 2"]:
    """Return the pixels (u, v) of both ends of each segment; NaN for a segment behind the camera.

    `projection` maps (x, y, z, 1) to (u * depth, v * depth, depth). A segment that crosses the camera's plane is
    clipped at `NEAREST_DEPTH`.
    """
    start, end = np.moveaxis(segments @ projection[:, :3].T + projection[:, 3], -2, 0)
    first, last = clip_to_depth(start, end, nearest=NEAREST_DEPTH), clip_to_depth(end, start, nearest=NEAREST_DEPTH)
    clipped = np.stack([first, last], -2)
    return clipped[..., :2] / clipped[..., 2:]


def seen_in_image(pixels: Float[np.ndarray, "D E 2 2"], size: tuple[int, int]) -> Bool[np.ndarray, " D"]:
    """Return whether the rectangle around each box's visible segments overlaps the image of (width, height) pixels."""
    points = pixels.reshape(len(pixels), 2 * pixels.shape[1], 2)
    visible = np.isfinite(points)
    low = points.min(1, where=visible, initial=np.inf)
    high = points.max(1, where=visible, initial=-np.inf)
    return (low < np.array(size)).all(1) & (high > 0).all(1)
