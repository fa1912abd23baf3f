"""The camera's view of LiDAR points: projection, clipping, and the half-spaces of the frustum."""

from __future__ import annotations

import functools
import operator

import numpy as np
from jaxtyping import Bool, Float, Float64

from ciassd_jax.types import Array

# Half-spaces that contain every point, for frames without a camera.
ANYWHERE = np.tile(np.array([0, 0, 0, 1], np.float32), (6, 1))


def frustum_planes(
    projection: Float[np.ndarray, "3 4"], *, width: int, height: int, near: float = 0.001, far: float = 100.0
) -> Float64[np.ndarray, "6 4"]:
    """Return half-spaces whose product with (x, y, z, 1) is positive exactly inside the image's frustum.

    With (a, b, d) = projection @ (x, y, z, 1) these are near < d < far, 0 < a / d < width and 0 < b / d < height,
    linear because d is positive. `near` and `far` are in metres, `width` and `height` in pixels.
    """
    horizontal, vertical, depth = np.asarray(projection, np.float64)
    one = np.array([0.0, 0.0, 0.0, 1.0])
    return np.stack(
        [
            depth - near * one,
            far * one - depth,
            horizontal,
            width * depth - horizontal,
            vertical,
            height * depth - vertical,
        ]
    )


def inside_planes(points: Float[Array, "*n 3"], planes: Float[Array, "k 4"]) -> Bool[Array, "*n"]:
    """Return whether each point is strictly inside every half-space; points that are not finite are outside."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    # Sums, not a matrix product: accelerators would round that to TF32.
    inside = functools.reduce(operator.and_, [a * x + b * y + c * z + d > 0 for a, b, c, d in planes])
    return np.asarray(inside) if isinstance(inside, np.bool) else inside


def project(
    points: Float[Array, "*n 3"], projection: Float[Array, "3 4"]
) -> tuple[Float[Array, "*n 2"], Float[Array, "*n"]]:
    """Return pixels (u, v) and depth in metres of LiDAR points; pixels are NaN where the depth is not positive."""
    xp = (points * projection[0, 0]).__array_namespace__()
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    horizontal, vertical, depth = (a * x + b * y + c * z + d for a, b, c, d in projection)
    divisor = xp.where(depth > 0, depth, xp.nan)
    return xp.stack([horizontal / divisor, vertical / divisor], -1), depth


def clip_to_depth(
    points: Float64[np.ndarray, "*n 3"], ends: Float64[np.ndarray, "*n 3"], *, nearest: float
) -> Float64[np.ndarray, "*n 3"]:
    """Move projected points that are too near along their segment to `ends`, up to the depth `nearest`.

    Points are (u * depth, v * depth, depth), depths in metres. Without clipping, the division by depth would mirror
    points behind the camera. A segment that is too near as a whole gives NaN.
    """
    depth, end_depth = points[..., 2], ends[..., 2]
    near = depth < nearest
    hidden = near & (end_depth < nearest)
    moves = near & ~hidden
    step = np.where(moves, nearest - depth, 0) / np.where(moves, end_depth - depth, 1)
    moved = points + step[..., None] * (ends - points)
    return np.where(hidden[..., None], np.nan, moved)
