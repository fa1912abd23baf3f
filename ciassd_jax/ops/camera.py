"""The camera's view of LiDAR points: projection, and the half-spaces of its frustum."""

from __future__ import annotations

import functools
import operator

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Float64

from ciassd_jax.types import Array

# Half-spaces that hold every point: no camera, no frustum.
ANYWHERE = np.tile(np.array([0, 0, 0, 1], np.float32), (6, 1))


def frustum_planes(
    projection: Float[np.ndarray, "3 4"], *, width: int, height: int, near: float = 0.001, far: float = 100.0
) -> Float64[np.ndarray, "6 4"]:
    """Half-spaces whose product with (x, y, z, 1) is positive exactly inside the image's frustum (SPEC 1.3).

    With (a, b, d) = projection @ (x, y, z, 1): near < d < far, 0 < a / d < width, 0 < b / d < height. As d is
    positive, each is linear. `near` and `far` in metres, `width` and `height` in pixels.
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
    """Whether each point is strictly inside every half-space; points that are not finite are outside."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    # Sums, not a matrix product: accelerators would round that to TF32.
    inside = functools.reduce(operator.and_, [a * x + b * y + c * z + d > 0 for a, b, c, d in planes])
    return np.asarray(inside) if isinstance(inside, np.bool) else inside


def project(
    points: Float[Array, "*n 3"], projection: Float[Array, "3 4"]
) -> tuple[Float[Array, "*n 2"], Float[Array, "*n"]]:
    """Pixels (u, v) and depth in metres of LiDAR points; pixels are NaN where the depth is not positive."""
    xp = np if isinstance(points, np.ndarray) and isinstance(projection, np.ndarray) else jnp
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    horizontal, vertical, depth = (a * x + b * y + c * z + d for a, b, c, d in projection)
    divisor = xp.where(depth > 0, depth, xp.nan)
    return xp.stack([horizontal / divisor, vertical / divisor], -1), depth
