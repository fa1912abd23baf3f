"""Voxelisation with fixed capacity (paper section 4.1): the mean of the first points of each voxel."""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Int

from ciassd_jax.ops.rows import rows_ahead, take_rows
from ciassd_jax.ops.sites import NO_SITE, Triple, coordinates_of, linear_keys
from ciassd_jax.types import Array, PointCloud, SparseVoxels

Vector = tuple[float, float, float]
# A larger intensity comes from a damaged file, and one such point would spoil the whole scene.
MAX_INTENSITY = 1e3


def voxel_coordinates(
    points: Float[Array, "P 3"], *, minimum: Vector, voxel_size: Vector, cells: Triple
) -> tuple[Int[Array, "P 3"], Bool[Array, " P"]]:
    """Voxel (z, y, x) of each point and whether it lies in the grid of `cells` (x, y, z).

    Exactly floor((p - minimum) / size) in float32. KITTI's coordinates are whole millimetres and often lie on a cell
    border, where a multiplication by the reciprocal would move them to the neighbouring cell.
    """
    offset = points.astype(jnp.float32).T - jnp.array(minimum, jnp.float32)[:, None]
    index = _floor_of_quotient(offset, np.array(voxel_size, np.float32)[:, None])
    inside = ((index >= 0) & (index < jnp.array(cells, jnp.float32)[:, None])).all(0)
    return jnp.where(inside[None], index, 0).astype(jnp.int32).T[:, ::-1], inside


def _floor_of_quotient(values: Float[Array, "*n"], divisor: np.ndarray | np.float32) -> Float[jax.Array, "*n"]:
    """Return floor(values / divisor) of IEEE 754 division, exact for results of 0 to 2**16.

    Compilers replace a division by a constant with a product, and accelerators approximate it. Here the quotient only
    proposes the nearest whole number n. Whether the rounded quotient reaches n is decided by n * divisor - values,
    every step of which is exact.
    """
    nearest = jnp.round(values / divisor)
    # Half the distance from n to the float below: a quotient this close is rounded up to n.
    slack = (nearest - jnp.nextafter(nearest, jnp.zeros_like(nearest))) / 2 * divisor
    missing, rest = -values, divisor
    for _ in range(3):
        # Eight bits of the divisor at a time: their product with n needs no rounding.
        exponent = np.frexp(rest)[1] - 8
        part = np.ldexp(np.trunc(np.ldexp(rest, -exponent)), exponent)
        missing = missing + nearest * part
        rest = rest - part
    return jnp.where(missing <= slack, nearest, nearest - 1)


def voxelize(
    cloud: PointCloud,
    *,
    minimum: Vector,
    voxel_size: Vector,
    cells: Triple,
    shape: Triple,
    max_points: int,
    max_voxels: int,
    overflow: Literal["skip", "stop"],
) -> SparseVoxels:
    """Group points into voxels and average the first `max_points` of each, in the order of the cloud.

    Points outside the grid of `cells` (x, y, z) are ignored. Points that are not finite or have an intensity beyond
    1000 are dropped and counted. Over capacity, the `max_voxels` voxels that the cloud touches first are kept; "stop"
    also ignores every point after the one that exceeds the capacity, as the released code does. `shape` (z, y, x)
    defines the linear keys and may have more layers than `cells`.
    """
    capacity = cloud.points.shape[0]
    slots = jnp.arange(capacity, dtype=jnp.int32)
    coordinates, inside = voxel_coordinates(cloud.points[:, :3], minimum=minimum, voxel_size=voxel_size, cells=cells)
    given = slots < cloud.count
    finite = jnp.isfinite(cloud.points).all(-1) & (jnp.abs(cloud.points[:, 3]) <= MAX_INTENSITY)
    inside &= given & finite
    keys = jnp.where(inside, linear_keys(coordinates, shape), NO_SITE)
    # A stable sort keeps the order of the cloud within a voxel.
    keys, order = lax.sort((keys, slots), num_keys=1, is_stable=True)
    is_first = (keys != jnp.concatenate([jnp.full(1, -1, jnp.int32), keys[:-1]])) & (keys != NO_SITE)
    limit = _first_over_capacity(is_first, order, max_voxels)
    kept = is_first & (order < limit)
    rank = jnp.cumsum(kept, dtype=jnp.int32)
    count = rank[-1]
    real = jnp.arange(max_voxels, dtype=jnp.int32) < count
    # Where each kept voxel begins in the sorted list. Every other slot writes to a distinct place out of bounds.
    place = jnp.where(kept, rank - 1, max_voxels + slots)
    start = jnp.zeros(max_voxels, jnp.int32).at[place].set(slots, mode="drop", unique_indices=True)
    usable = keys != NO_SITE if overflow == "skip" else (keys != NO_SITE) & (order < limit)
    total, number = _sums_of_runs(cloud.points[order], keys, usable, max_points)
    total, number, key, first_point = take_rows((total, number, keys, order), start)
    num_points = jnp.where(real, number, 0)
    # A point's voxel was kept if the last kept voxel that begins at or before it has its key.
    in_kept = usable & (count > 0) & (keys == key[jnp.maximum(rank - 1, 0)])
    counted = jnp.stack([is_first, inside, given & ~finite, in_kept])
    touched, in_range, not_finite, in_voxels = counted.sum(1, dtype=jnp.int32)
    return SparseVoxels(
        features=jnp.where(real[:, None], total, 0) / jnp.maximum(num_points, 1).astype(total.dtype)[:, None],
        coordinates=jnp.where(real[:, None], coordinates_of(key, shape), 0),
        num_points=num_points,
        first_point=jnp.where(real, first_point, capacity),
        count=count,
        dropped=touched - count,
        points_given=jnp.asarray(cloud.count),
        points_in_range=in_range,
        points_dropped=not_finite + in_range - in_voxels,
    )


def _first_over_capacity(is_first: Bool[Array, " P"], order: Int[Array, " P"], max_voxels: int) -> Int[Array, ""]:
    """The point that would open voxel number max_voxels + 1; the number of points if all voxels fit."""
    capacity = len(order)
    if max_voxels >= capacity:
        return jnp.int32(capacity)
    opens = jnp.zeros(capacity, jnp.int32).at[order].set(is_first.astype(jnp.int32), unique_indices=True)
    return (jnp.cumsum(opens, dtype=jnp.int32) <= max_voxels).sum(dtype=jnp.int32)


def _sums_of_runs(
    points: Float[Array, "P 4"], keys: Int[Array, " P"], usable: Bool[Array, " P"], most: int
) -> tuple[Float[Array, "P 4"], Int[Array, " P"]]:
    """For each point of the sorted list, sum and number of it and up to `most` - 1 further ones of the same key."""
    total, number = jnp.zeros_like(points), jnp.zeros(len(keys), jnp.int32)
    for k in range(most):
        mine = (rows_ahead(keys, k, NO_SITE) == keys) & rows_ahead(usable, k, False)
        total += jnp.where(mine[:, None], rows_ahead(points, k, 0), 0)
        number += mine
    return total, number
