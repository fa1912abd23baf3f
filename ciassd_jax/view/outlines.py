"""Boxes as the line segments that draw them, in space and in a camera's image."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float64

from ciassd_jax.ops.footprints import box_corners
from ciassd_jax.types import Boxes

# Between the corners of `box_corners`, then the heading.
_EDGES = np.array(
    [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7), (8, 9)]
)
# The heading, the last segment, runs along the bottom from the centre to so many metres ahead of the front.
HEADING = 1.0
# Lines are cut where they come so near to the camera, in metres of depth.
NEAREST_DEPTH = 0.1


def outline_boxes(boxes: Float[np.ndarray, "D 7"]) -> Float64[np.ndarray, "D 13 2 3"]:
    """The twelve edges of each box and its heading, as start and end in x, y, z (metres, LiDAR frame).

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
    """Pixels (u, v) of both ends of segments in space; NaN for a segment that lies behind the camera.

    `projection` takes (x, y, z, 1) to (u * depth, v * depth, depth). A segment that passes the camera's plane is cut
    at `NEAREST_DEPTH`: beyond it the division would mirror the end.
    """
    start, end = np.moveaxis(segments @ projection[:, :3].T + projection[:, 3], -2, 0)
    start, end = _cut(start, end), _cut(end, start)
    ends = np.stack([start, end], -2)
    return ends[..., :2] / ends[..., 2:]


def seen_in_image(pixels: Float[np.ndarray, "D E 2 2"], size: tuple[int, int]) -> Bool[np.ndarray, " D"]:
    """Whether the frame around a box's visible segments meets the image of (width, height) pixels."""
    points = pixels.reshape(len(pixels), 2 * pixels.shape[1], 2)
    there = np.isfinite(points)
    low = points.min(1, where=there, initial=np.inf)
    high = points.max(1, where=there, initial=-np.inf)
    return (low < np.array(size)).all(1) & (high > 0).all(1)


def _cut(point: Float64[np.ndarray, "*n 3"], other: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
    """The projected point, moved towards the other to the nearest depth if it has less; NaN where neither has it."""
    depth, far = point[..., 2], other[..., 2]
    near = depth < NEAREST_DEPTH
    hidden = near & (far < NEAREST_DEPTH)
    way = np.where(near & ~hidden, far - depth, 1)
    step = np.where(near & ~hidden, NEAREST_DEPTH - depth, 0) / way
    moved = point + step[..., None] * (other - point)
    return np.where(hidden[..., None], np.nan, moved)
