"""Boxes in the LiDAR frame to KITTI's rows and back.

A row's location is the bottom centre of the box in the rectified camera frame; its rotation_y is -(yaw + pi / 2).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float64, Int

from ciassd_jax.formats.kitti_camera import Calibration, lidar_to_camera
from ciassd_jax.formats.kitti_rows import ObjectRow
from ciassd_jax.ops.camera import clip_to_depth
from ciassd_jax.types import Array, Boxes

# Fractions of (length, height, width) along the box's x, y, z; the location is the bottom, and y points down.
_CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-1.0, 0.0) for z in (-0.5, 0.5)])
# Corners that differ in one coordinate, in both directions.
_EDGES = np.array([(first, first ^ bit) for first in range(8) for bit in (1, 2, 4)])
_NEAREST_DEPTH = 0.001


def boxes_to_rows(
    boxes: Boxes,
    scores: Float[Array, " D"],
    names: Sequence[str],
    calibration: Calibration,
    image_size: tuple[int, int],
) -> tuple[list[ObjectRow], Int[np.ndarray, " kept"]]:
    """Return result rows of the boxes that are visible in the image, and the indices of those boxes.

    `image_size` is (width, height) in pixels. The image box bounds the part of the box in front of the camera,
    projected with the full P2 and clipped to [0, width] and [0, height]. `alpha` is not wrapped.
    """
    center, size, yaw = (np.asarray(leaf, np.float64) for leaf in boxes)
    rotation_y = (np.pi / 2 - yaw) % (2 * np.pi) - np.pi
    bottom = center - size * [0.0, 0.0, 0.5]
    transform = lidar_to_camera(calibration)
    location = bottom @ transform[:, :3].T + transform[:, 3]
    image_boxes = _image_boxes(_camera_corners(location, size, rotation_y), calibration.projection)
    limit = np.array(image_size * 2, np.float64)
    # Comparisons with NaN are false: a box without finite numbers is dropped too.
    seen = (image_boxes[:, :2] <= limit[:2]).all(1) & (image_boxes[:, 2:] >= 0).all(1)
    image_boxes = image_boxes.clip(0, limit)
    alpha = rotation_y - np.arctan2(-center[:, 1], center[:, 0])
    kept = np.flatnonzero(seen)
    confidence = np.asarray(scores)
    rows = [
        ObjectRow(
            type=names[index],
            truncated=0.0,
            occluded=0,
            alpha=float(alpha[index]),
            bbox=tuple(image_boxes[index].tolist()),
            dimensions=tuple(size[index, ::-1].tolist()),
            location=tuple(location[index].tolist()),
            rotation_y=float(rotation_y[index]),
            score=float(confidence[index]),
        )
        for index in kept.tolist()
    ]
    return rows, kept


def rows_to_boxes(rows: Sequence[ObjectRow], calibration: Calibration) -> Boxes:
    """Return the boxes of all rows in the LiDAR frame, as NumPy arrays in float64.

    Leave DontCare rows out, as they have no box. Yaw is -(rotation_y + pi / 2), not wrapped.
    """
    location = np.array([row.location for row in rows], np.float64).reshape(-1, 3)
    size = np.array([row.dimensions[::-1] for row in rows], np.float64).reshape(-1, 3)
    rotation_y = np.array([row.rotation_y for row in rows], np.float64)
    transform = lidar_to_camera(calibration)
    bottom = np.linalg.solve(transform[:, :3], (location - transform[:, 3]).T).T
    return Boxes(bottom + size * [0.0, 0.0, 0.5], size, -(rotation_y + np.pi / 2))


def _camera_corners(
    location: Float64[np.ndarray, "D 3"],
    size: Float64[np.ndarray, "D 3"],
    rotation_y: Float64[np.ndarray, " D"],
) -> Float64[np.ndarray, "D 8 3"]:
    """Return corners in the camera frame, in the order of `_CORNERS`."""
    x, y, z = np.moveaxis(_CORNERS * size[:, None, [0, 2, 1]], -1, 0)
    cos, sin = np.cos(rotation_y)[:, None], np.sin(rotation_y)[:, None]
    return location[:, None] + np.stack([x * cos + z * sin, y, z * cos - x * sin], -1)


def _image_boxes(
    corners: Float64[np.ndarray, "D 8 3"], projection: Float64[np.ndarray, "3 4"]
) -> Float64[np.ndarray, "D 4"]:
    """Return image boxes (x1, y1, x2, y2) of the parts in front of the camera; (inf, inf, -inf, -inf) without one."""
    projected = corners @ projection[:, :3].T + projection[:, 3]
    # The clipped part is convex and projection keeps it so: the ends of its edges are its extremes.
    points = clip_to_depth(projected[:, _EDGES[:, 0]], projected[:, _EDGES[:, 1]], nearest=_NEAREST_DEPTH)
    pixels = points[..., :2] / points[..., 2:]
    visible = np.isfinite(points)[..., 2:]
    low = pixels.min(1, where=visible, initial=np.inf)
    high = pixels.max(1, where=visible, initial=-np.inf)
    return np.concatenate([low, high], -1)
