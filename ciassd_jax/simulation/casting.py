"""Ray casting: the first solid that each ray of the sensor hits.

The rays form a grid of rows (beams) and columns (azimuths), divided into square tiles. Each solid is tested against the
rays of those tiles only that its outline overlaps. Pairs of a solid and a tile fill a list of fixed capacity, nearest
solids first, and each ray keeps the nearest hit among the pairs of its tile.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from ciassd_jax.simulation.solids import Solids, cross, extent, incidence
from ciassd_jax.types import Array

# Rays of a tile along each axis; 16 columns fill a vector register.
TILE = 16
# A distance in steps per metre and the index of a solid are packed into one int32, whose minimum is the nearest solid.
_STEPS, _BITS = 8000, 11
MAX_SOLIDS = 2**_BITS
_FARTHEST = (2**31 - 1) / MAX_SOLIDS / _STEPS
_NONE = 2**31 - 1
# Rays start at this distance in metres, so that a solid around the sensor does not stop them.
_NEAREST = 0.3
# A ray that ends up to this many metres before a box still reaches it.
_SLACK = 0.1


class Rays(NamedTuple):
    """Directions: evenly spaced azimuths of a full circle in radians, ascending; tangents of elevation, descending."""

    azimuth: Float[Array, " columns"]
    tangent: Float[Array, " rows"]


class Hits(NamedTuple):
    """The first hit of each ray: horizontal distance in metres, cosine of incidence, and index of the solid.

    Without a hit the distance is inf and `solid` is -1. `dropped` counts pairs of a solid and a tile over capacity:
    parts of the farthest solids that are not seen.
    """

    distance: Float[Array, "rows columns"]
    cosine: Float[Array, "rows columns"]
    solid: Int[Array, "rows columns"]
    dropped: Int[Array, ""]


class _Pairs(NamedTuple):
    """Solids and tiles that may contain them; the tile of an empty slot is the number of tiles."""

    solid: Int[Array, " pairs"]
    row: Int[Array, " pairs"]
    column: Int[Array, " pairs"]
    tile: Int[Array, " pairs"]
    dropped: Int[Array, ""]


def cast(
    solids: Solids, depth: Float[Array, " S"], rays: Rays, stray: Float[Array, "rows columns"], capacity: int
) -> Hits:
    """Return the first hit of every ray among S solids.

    A ray travels `stray * depth` metres into a solid before it is reflected, and passes through if it leaves the solid
    sooner. Rows and columns must be multiples of `TILE` and S at most `MAX_SOLIDS`; `capacity` is the number of pairs.
    """
    rows, columns = rays.tangent.size // TILE, rays.azimuth.size // TILE
    assert (rows * TILE, columns * TILE) == (rays.tangent.size, rays.azimuth.size)
    assert len(depth) <= MAX_SOLIDS
    order = jnp.argsort(jnp.where(solids.present, jnp.sum(solids.origin[:, :2] ** 2, -1), jnp.inf))
    sorted_solids = jax.tree.map(lambda leaf: leaf[order], solids)
    pairs = _pair(sorted_solids, rays, capacity)
    keys = _test(sorted_solids, depth[order], rays, _tiles(stray), pairs)
    best = jnp.full((rows * columns, TILE, TILE), _NONE, jnp.int32).at[pairs.tile].min(keys, mode="drop")
    best = best.reshape(rows, columns, TILE, TILE).transpose(0, 2, 1, 3).reshape(rows * TILE, columns * TILE)
    return _finish(best, order, solids, depth, rays, stray, pairs.dropped)


def count_rays(
    solids: Solids, rays: Rays, distance: Float[Array, "rows columns"], capacity: int
) -> tuple[Int[Array, " S"], Int[Array, " S"], Int[Array, ""]]:
    """Return the number of rays through each solid, the number of these that reach it, and the dropped pairs.

    `distance` is the horizontal distance in metres at which each ray ends.
    """
    pairs = _pair(solids, rays, capacity)
    enter, leave = cross(*_aim(solids, rays, pairs))
    real = (pairs.tile < (rays.tangent.size // TILE) * (rays.azimuth.size // TILE))[:, None, None]
    through = (enter < leave) & (leave > 0) & real
    ends = _tiles(distance)[jnp.minimum(pairs.tile, _tiles(distance).shape[0] - 1)]
    # Pack both counts into one number, and multiply with ones (exact for this few rays) instead of summing, which XLA
    # would fuse with all of `cross` and not vectorise.
    weight = 2 * TILE * TILE
    value = jnp.where(through, jnp.where(ends > enter - _SLACK, weight + 1.0, 1.0), 0.0)
    both = (value.reshape(capacity, -1) @ jnp.ones(TILE * TILE)).astype(jnp.int32)
    none = jnp.zeros(len(solids.yaw), jnp.int32)
    return none.at[pairs.solid].add(both % weight), none.at[pairs.solid].add(both // weight), pairs.dropped


def _tiles(grid: Float[Array, "rows columns"]) -> Float[Array, "tiles tile_rows tile_columns"]:
    rows, columns = (size // TILE for size in grid.shape)
    return grid.reshape(rows, TILE, columns, TILE).transpose(0, 2, 1, 3).reshape(-1, TILE, TILE)


def _aim(solids: Solids, rays: Rays, pairs: _Pairs) -> tuple[Solids, tuple[Array, Array, Array]]:
    """The solid of each pair and the directions of the tile's rays in its frame, ready to broadcast."""
    chosen = jax.tree.map(lambda leaf: leaf[pairs.solid][:, None, None], solids)
    azimuth = rays.azimuth.reshape(-1, TILE)[pairs.column] - chosen.yaw[:, 0]
    tangent = rays.tangent.reshape(-1, TILE)[pairs.row]
    return chosen, (jnp.cos(azimuth)[:, None, :], jnp.sin(azimuth)[:, None, :], tangent[:, :, None])


def _test(
    solids: Solids,
    depth: Float[Array, " S"],
    rays: Rays,
    stray: Float[Array, "tiles tile_rows tile_columns"],
    pairs: _Pairs,
) -> Int[Array, "pairs tile_rows tile_columns"]:
    """The packed distance and solid of every ray of every pair; `_NONE` for a miss."""
    enter, leave = cross(*_aim(solids, rays, pairs))
    inward = depth[pairs.solid][:, None, None] * stray[jnp.minimum(pairs.tile, len(stray) - 1)]
    distance = jnp.maximum(enter, _NEAREST) + inward
    hit = (distance < leave) & (distance < _FARTHEST)
    steps = (jnp.where(hit, distance, 0.0) * _STEPS).astype(jnp.int32)
    return jnp.where(hit, steps * MAX_SOLIDS + pairs.solid[:, None, None], _NONE)


def _finish(
    best: Int[Array, "rows columns"],
    order: Int[Array, " S"],
    solids: Solids,
    depth: Float[Array, " S"],
    rays: Rays,
    stray: Float[Array, "rows columns"],
    dropped: Int[Array, ""],
) -> Hits:
    """Unpack the nearest solids, and compute the exact distances and the cosines of incidence."""
    hit = best != _NONE
    winner = order[jnp.where(hit, best % MAX_SOLIDS, 0)]
    chosen = jax.tree.map(lambda leaf: leaf[winner], solids)
    azimuth = rays.azimuth[None] - chosen.yaw
    tangent = jnp.broadcast_to(rays.tangent[:, None], azimuth.shape)
    enter, cosine = incidence(chosen, (jnp.cos(azimuth), jnp.sin(azimuth), tangent))
    distance = jnp.maximum(enter, _NEAREST) + depth[winner] * stray
    return Hits(jnp.where(hit, distance, jnp.inf), jnp.where(hit, cosine, 0.0), jnp.where(hit, winner, -1), dropped)


def _pair(solids: Solids, rays: Rays, capacity: int) -> _Pairs:
    """Pair each solid with the tiles that its outline overlaps."""
    rows, columns = rays.tangent.size // TILE, rays.azimuth.size // TILE
    first_row, last_row, first_column, last_column = _outline(solids, rays)
    high = jnp.maximum(last_row // TILE - first_row // TILE + 1, 0)
    high = jnp.where((last_row >= first_row) & solids.present, high, 0)
    wide = jnp.where(last_column >= first_column, last_column // TILE - first_column // TILE + 1, 0)
    number = high * jnp.minimum(wide, columns)
    ends = jnp.cumsum(number)
    slot = jnp.arange(capacity)
    solid = jnp.searchsorted(ends, slot, side="right").astype(jnp.int32)
    real = solid < len(ends)
    solid = jnp.minimum(solid, len(ends) - 1)
    rest = slot - (ends - number)[solid]
    row = jnp.minimum((first_row // TILE)[solid] + rest % jnp.maximum(high[solid], 1), rows - 1)
    column = ((first_column // TILE)[solid] + rest // jnp.maximum(high[solid], 1)) % columns
    tile = jnp.where(real, row * columns + column, rows * columns)
    return _Pairs(solid, row, column, tile, jnp.maximum(ends[-1] - capacity, 0))


def _outline(solids: Solids, rays: Rays) -> tuple[Array, Array, Array, Array]:
    """First and last row, first and last column (not yet wrapped) of the rays that may hit each solid."""
    front, rear, side, high, low = extent(solids)
    cosine, sine = jnp.cos(solids.yaw), jnp.sin(solids.yaw)
    x, y, z = solids.origin[:, 0], solids.origin[:, 1], solids.origin[:, 2]
    along = jnp.stack([front, front, -rear, -rear], -1)
    across = jnp.stack([side, -side, side, -side], -1)
    corner_x = x[:, None] + along * cosine[:, None] - across * sine[:, None]
    corner_y = y[:, None] + along * sine[:, None] + across * cosine[:, None]
    middle = jnp.arctan2(corner_y.mean(-1), corner_x.mean(-1))
    turn = jnp.arctan2(corner_y, corner_x) - middle[:, None]
    turn = turn - jnp.round(turn / (2 * jnp.pi)) * (2 * jnp.pi)
    # The position of the sensor in the solid's frame, and its distance from the footprint.
    u, v = -(x * cosine + y * sine), x * sine - y * cosine
    beside = jnp.hypot(jnp.maximum(jnp.maximum(u - front, -rear - u), 0), jnp.maximum(jnp.abs(v) - side, 0))
    over = beside <= 0
    near, far = jnp.maximum(beside, 1e-3), jnp.hypot(corner_x, corner_y).max(-1)
    top, bottom = z + high, z - low
    highest = top / jnp.where(top > 0, near, far)
    lowest = bottom / jnp.where(bottom < 0, near, far)
    first_row = jnp.searchsorted(-rays.tangent, -highest)
    last_row = jnp.searchsorted(-rays.tangent, -lowest, side="right") - 1
    step = 2 * jnp.pi / rays.azimuth.size
    start = (middle - rays.azimuth[0]) / step
    # A small margin covers the rounding of the angles.
    first = jnp.ceil(start + jnp.where(over, -jnp.pi, turn.min(-1)) / step - 0.01)
    last = jnp.floor(start + jnp.where(over, jnp.pi, turn.max(-1)) / step + 0.01)
    return first_row, last_row, first.astype(jnp.int32), last.astype(jnp.int32)
