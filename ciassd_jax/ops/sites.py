"""Active sites of a scene's grid: listed by key, and found again through a map of its BEV columns.

The map holds a mask of bits for each column (y, x), a bit for each active z, and the slot of its lowest site. A site's
slot is that plus the number of set bits below it: constant time. The active set of a strided convolution is the OR of
the masks in its window, and the list of its sites is read off the new map: nothing is sorted.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Int, UInt32

from ciassd_jax.types import Array, Sites

Triple = tuple[int, int, int]
NO_SITE = np.int32(np.iinfo(np.int32).max)


def linear_keys(coordinates: Int[Array, "*n 3"], shape: Triple) -> Int[Array, "*n"]:
    """Linear key of (z, y, x) with z fastest, then x, then y."""
    depth, _, width = shape
    z, y, x = coordinates[..., 0], coordinates[..., 1], coordinates[..., 2]
    return (y * width + x) * depth + z


def coordinates_of(keys: Int[Array, "*n"], shape: Triple) -> Int[Array, "*n 3"]:
    """Inverse of `linear_keys`: (z, y, x)."""
    depth, _, width = shape
    column = keys // depth
    return jnp.stack([keys % depth, column // width, column % width], -1)


def active_sites(keys: Int[Array, " V"], *, shape: Triple) -> Sites:
    """Sites of ascending distinct keys; `NO_SITE` marks padding and comes last."""
    depth, height, width = shape
    words, slots = -(-depth // 32), keys.shape[0]
    column, z = keys // depth, keys % depth
    word = jnp.arange(words, dtype=jnp.int32)[None]
    bits = jnp.where((z // 32)[:, None] == word, _bit(z % 32)[:, None], jnp.uint32(0))
    # Gather the bits of a column in its first site: its sites are adjacent, at most `depth` of them.
    for step in (2**i for i in range((depth - 1).bit_length())):
        same = jnp.pad(column[step:], (0, min(step, slots)), constant_values=-1)[:slots] == column
        later = jnp.pad(bits[step:], ((0, min(step, slots)), (0, 0)))[:slots]
        bits = bits | jnp.where(same[:, None], later, jnp.uint32(0))
    slot = jnp.arange(slots, dtype=jnp.int32)
    is_first = (column != jnp.concatenate([jnp.full(1, -1, jnp.int32), column[:-1]])) & (keys != NO_SITE)
    # Each other slot writes to a place of its own outside of the map, where it is dropped.
    place = jnp.where(is_first, column, height * width + slot)
    entry = jnp.concatenate([bits, slot.astype(jnp.uint32)[:, None]], 1)
    columns = jnp.zeros((height * width, words + 1), jnp.uint32)
    columns = columns.at[place].set(entry, mode="drop", unique_indices=True)
    return Sites(keys, (keys != NO_SITE).sum(dtype=jnp.int32), columns)


def strided_sites(
    sites: Sites,
    *,
    shape: Triple,
    out_shape: Triple,
    kernel: Triple,
    stride: Triple,
    padding: Triple,
    capacity: int,
) -> tuple[Sites, Int[Array, ""]]:
    """Sites of a strided convolution: every output whose window holds an active input.

    `shape` and `out_shape` are the grids (z, y, x) before and after. Over capacity the sites of lowest key
    stay; the second result counts the others.
    """
    assert sites.columns is not None, "sites of the dense backend have no map"
    masks = jnp.asarray(sites.columns)[:, :-1].reshape(*shape[1:], -1)
    masks = _any_in_window(masks, 0, out_shape[1], kernel[1], stride[1], padding[1])
    masks = _any_in_window(masks, 1, out_shape[2], kernel[2], stride[2], padding[2])
    bits = _any_in_depth(masks, shape[0], out_shape[0], kernel[0], stride[0], padding[0])
    return _list_sites(bits.reshape(-1, bits.shape[-1]), depth=out_shape[0], capacity=capacity)


def _any_in_window(
    bits: UInt32[Array, "Y X W"], axis: int, size: int, kernel: int, stride: int, padding: int
) -> UInt32[jax.Array, "Y2 X2 W"]:
    """OR of the masks in the window of each of `size` outputs along y (axis 0) or x (axis 1)."""
    last = (size - 1) * stride
    around = [(0, 0)] * 3
    around[axis] = (padding, max(0, last + kernel - padding - bits.shape[axis]))
    padded = jnp.pad(bits, around)
    result = lax.slice_in_dim(padded, 0, last + 1, stride, axis)
    for offset in range(1, kernel):
        result |= lax.slice_in_dim(padded, offset, offset + last + 1, stride, axis)
    return result


def _any_in_depth(
    bits: UInt32[Array, "Y X W"], depth: int, size: int, kernel: int, stride: int, padding: int
) -> UInt32[jax.Array, "Y X W2"]:
    """Mask of the `size` outputs along z whose window holds a set bit."""
    result = [jnp.zeros(bits.shape[:2], jnp.uint32) for _ in range(-(-size // 32))]
    for output in range(size):
        start = output * stride - padding
        window = range(max(start, 0), min(start + kernel, depth))
        hit = jnp.zeros(bits.shape[:2], bool)
        for word in {z // 32 for z in window}:
            hit |= (bits[..., word] & np.uint32(sum(1 << z % 32 for z in window if z // 32 == word))) != 0
        result[output // 32] |= jnp.where(hit, np.uint32(1 << output % 32), np.uint32(0))
    return jnp.stack(result, -1)


def _list_sites(bits: UInt32[Array, "columns W"], *, depth: int, capacity: int) -> tuple[Sites, Int[Array, ""]]:
    """The sites of a map of masks by ascending key, and how many of the highest keys were over capacity."""
    number = lax.population_count(bits).astype(jnp.int32).sum(1)
    start = jnp.cumsum(number, dtype=jnp.int32) - number
    found = start[-1] + number[-1]
    column = jnp.arange(bits.shape[0], dtype=jnp.int32)
    # A column marks the slot of its lowest site; the slots of its other sites follow.
    place = jnp.where((number > 0) & (start < capacity), start, capacity + column)
    first = jnp.zeros(capacity, jnp.int32).at[place].set(column, mode="drop", unique_indices=True)
    column_of = lax.cummax(first)
    slot = jnp.arange(capacity, dtype=jnp.int32)
    z = _nth_bit(bits[column_of], slot - start[column_of], depth)
    real = slot < found
    keys = jnp.where(real, column_of * depth + z, NO_SITE)
    # Sites over capacity leave the map too; the last column that stays may lose only some of its own.
    last = column_of[-1]
    word = jnp.arange(bits.shape[1], dtype=jnp.int32)[None]
    mine = (real & (column_of == last))[:, None] & ((z // 32)[:, None] == word)
    trimmed = jnp.where((start < capacity)[:, None], bits, jnp.uint32(0))
    trimmed = trimmed.at[last].set(jnp.where(mine, _bit(z % 32)[:, None], jnp.uint32(0)).sum(0, dtype=jnp.uint32))
    columns = jnp.concatenate([trimmed, start.astype(jnp.uint32)[:, None]], 1)
    count = jnp.minimum(found, capacity)
    return Sites(keys, count, columns), found - count


def _nth_bit(bits: UInt32[Array, "V W"], n: Int[Array, " V"], depth: int) -> Int[Array, " V"]:
    """Place of the n-th set bit (from 0) of each mask; `depth` where there are fewer."""

    def count(z: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        seen, place = state
        word = lax.dynamic_index_in_dim(bits, z // 32, 1, keepdims=False)
        seen = seen + ((word >> jnp.asarray(z % 32).astype(jnp.uint32)) & 1).astype(jnp.int32)
        return seen, place + (seen <= n).astype(jnp.int32)

    # A loop, as unrolled it would be fused into every neighbour table and computed again for each entry.
    none = jnp.zeros(n.shape, jnp.int32)
    return lax.fori_loop(0, depth, count, (none, none))[1]


def _bit(z: Int[Array, "*n"]) -> UInt32[Array, "*n"]:
    return jnp.uint32(1) << jnp.asarray(z).astype(jnp.uint32)


def slots_at(
    sites: Sites, z: Int[Array, "V KZ"], y: Int[Array, "V KY"], x: Int[Array, "V KX"], *, shape: Triple
) -> Int[Array, "V K"]:
    """Slots of the sites at all combinations of z, y and x of a row, in C order; the number of slots for none.

    A coordinate outside of the grid `shape` (z, y, x) finds none.
    """
    depth, height, width = shape
    slots = sites.keys.shape[0]
    assert sites.columns is not None, "sites of the dense backend have no map"
    inside = _within(y, height)[:, :, None] & _within(x, width)[:, None]
    column = jnp.where(inside, y[:, :, None] * width + x[:, None], 0)
    entry = jnp.asarray(sites.columns).at[column].get(mode="promise_in_bounds")
    words, start = entry[..., :-1], entry[..., -1].astype(jnp.int32)
    found = []
    for k in range(z.shape[1]):
        here = z[:, k, None, None]
        at = jnp.where(_within(here, depth), here, 0)
        below, active = jnp.zeros(start.shape, jnp.int32), jnp.zeros(start.shape, bool)
        for i in range(words.shape[-1]):
            bit = (at - 32 * i).clip(0, 31).astype(jnp.uint32)
            lower = jnp.where(at < 32 * (i + 1), (jnp.uint32(1) << bit) - 1, jnp.uint32(0xFFFFFFFF))
            lower = jnp.where(at < 32 * i, jnp.uint32(0), lower)
            below += lax.population_count(words[..., i] & lower).astype(jnp.int32)
            active |= (at // 32 == i) & ((words[..., i] >> bit) & 1 == 1)
        found.append(jnp.where(active & inside & _within(here, depth), start + below, slots))
    return jnp.stack(found, 1).reshape(z.shape[0], -1)


def _within(index: Int[Array, "*n"], size: int) -> Bool[Array, "*n"]:
    return (index >= 0) & (index < size)


def to_dense(features: Float[Array, "V C"], sites: Sites, *, shape: Triple) -> Float[Array, "Z Y X C"]:
    """The sites' features on the whole grid (z, y, x), zero where no site is active."""
    depth, height, width = shape
    cells = depth * height * width
    # Padding writes outside of the grid, each slot to a place of its own, and is dropped there.
    place = jnp.where(sites.keys == NO_SITE, cells + jnp.arange(sites.keys.shape[0], dtype=jnp.int32), sites.keys)
    flat = zeros_after(sites.count, (cells, features.shape[-1]), features.dtype)
    flat = flat.at[place].set(features, mode="drop", unique_indices=True, indices_are_sorted=True)
    return flat.reshape(height, width, depth, -1).transpose(2, 0, 1, 3)


def zeros_after(count: Int[Array, ""], shape: tuple[int, ...], dtype: jnp.dtype) -> jax.Array:
    """Zeros that cannot be allocated before `count`, which is not negative, is known.

    Plain zeros depend on nothing: XLA sets those of all layers aside at the start, and memory doubles.
    """
    return jnp.broadcast_to(jnp.minimum(count, 0).astype(dtype), shape)
