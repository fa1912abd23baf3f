"""Active sites of a scene's grid, listed by key and indexed by a map of BEV columns.

For each column (y, x) the map holds a bit mask of the active z and the slot of the lowest site. The slot of a site is
that slot plus the number of set bits below it, found in constant time. The active set of a strided convolution is the
OR of the masks in its window, and its sites are listed from the new map: nothing is sorted.
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
    column = _quotient(keys, depth)
    y = _quotient(column, width)
    return jnp.stack([keys - column * depth, y, column - y * width], -1)


def _quotient(values: Int[Array, "*n"], divisor: int) -> Int[jax.Array, "*n"]:
    """values // divisor of values that are not negative: without a sign it is a single operation."""
    return lax.div(jnp.asarray(values), jnp.asarray(divisor, values.dtype))


def active_sites(keys: Int[Array, " V"], *, shape: Triple) -> Sites:
    """Sites of ascending distinct keys; `NO_SITE` marks padding and comes last."""
    depth, height, width = shape
    words, slots = -(-depth // 32), keys.shape[0]
    real = keys != NO_SITE
    # Padding is dropped outside of the map.
    column = _quotient(keys, depth)
    bits = _bits_of(keys - column * depth, words)
    column = jnp.where(real, column, height * width)
    # A column's bits are distinct, so that their sum is their OR; its slot is that of its first site.
    first = column != jnp.concatenate([jnp.full(1, -1, jnp.int32), column[:-1]])
    start = jnp.where(first, jnp.arange(slots, dtype=jnp.uint32), 0)
    columns = jnp.zeros((height * width, words + 1), jnp.uint32)
    columns = columns.at[column].add(jnp.concatenate([bits, start[:, None]], 1), mode="drop", indices_are_sorted=True)
    return Sites(keys, real.sum(dtype=jnp.int32), columns)


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
    """Return the sites of a strided convolution, every output whose window holds an active input, and the overflow.

    `shape` and `out_shape` are the grids (z, y, x) before and after. Over capacity, the sites of lowest key are kept
    and the others counted.
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
    """Mask of the `size` outputs along z whose window holds a set bit; strides of 1 and 2."""
    assert stride in (1, 2), f"a mask cannot be strided by {stride}"
    words = [jnp.asarray(bits[..., i]) for i in range(bits.shape[-1])]
    # Bit z + padding of the first mask, then bit z of the others, is the input z: outputs start at -padding.
    words = _shift_up([*words, jnp.zeros_like(words[0])], padding)
    window = words
    for offset in range(1, kernel):
        window = [a | b for a, b in zip(window, _shift_down(words, offset), strict=True)]
    if stride == 2:
        halves = [_even_bits(word) for word in [*window, jnp.zeros_like(words[0])]]
        window = [low | (high << 16) for low, high in zip(halves[::2], halves[1::2], strict=False)]
    result = []
    for i in range(-(-size // 32)):
        outputs = min(size - 32 * i, 32)
        result.append(window[i] & np.uint32(2**outputs - 1))
    return jnp.stack(result, -1)


def _shift_up(words: list[jax.Array], bits: int) -> list[jax.Array]:
    """The mask moved to higher bits across words, by less than 32."""
    if bits == 0:
        return words
    lower = [jnp.zeros_like(words[0]), *words[:-1]]
    return [(word << bits) | (below >> (32 - bits)) for word, below in zip(words, lower, strict=True)]


def _shift_down(words: list[jax.Array], bits: int) -> list[jax.Array]:
    """The mask moved to lower bits across words, by 1 to 31."""
    higher = [*words[1:], jnp.zeros_like(words[0])]
    return [(word >> bits) | (above << (32 - bits)) for word, above in zip(words, higher, strict=True)]


def _even_bits(word: jax.Array) -> jax.Array:
    """Bits 0, 2, 4, ... of a word, packed into its lower half."""
    word = word & np.uint32(0x55555555)
    for shift, mask in ((1, 0x33333333), (2, 0x0F0F0F0F), (4, 0x00FF00FF), (8, 0x0000FFFF)):
        word = (word | (word >> shift)) & np.uint32(mask)
    return word


def _list_sites(bits: UInt32[Array, "columns W"], *, depth: int, capacity: int) -> tuple[Sites, Int[Array, ""]]:
    """The sites of a map of masks by ascending key, and how many of the highest keys were over capacity."""
    number = lax.population_count(bits).astype(jnp.int32).sum(1)
    start = jnp.cumsum(number, dtype=jnp.int32) - number
    found = start[-1] + number[-1]
    column = jnp.arange(bits.shape[0], dtype=jnp.int32)
    # A column marks the slot of its lowest site; its other sites follow.
    place = jnp.where((number > 0) & (start < capacity), start, capacity + column)
    first = jnp.zeros(capacity, jnp.int32).at[place].set(column, mode="drop", unique_indices=True)
    # The largest column so far; a column has at most `depth` sites, so that it is among the last `depth` slots.
    column_of = lax.reduce_window(first, np.int32(0), lax.max, (depth,), (1,), ((depth - 1, 0),))
    slot = jnp.arange(capacity, dtype=jnp.int32)
    # Without the barrier it may be fused into the neighbour tables and computed again for each of their entries.
    z = lax.optimization_barrier(_nth_bit(bits[column_of], slot - start[column_of]))
    real = slot < found
    keys = jnp.where(real, column_of * depth + z, NO_SITE)
    # Sites over capacity leave the map too; the last column that stays may lose only some of its own.
    last = column_of[-1]
    mine = (real & (column_of == last))[:, None]
    of_last = jnp.where(mine, _bits_of(z, bits.shape[1]), jnp.uint32(0)).sum(0, dtype=jnp.uint32)
    trimmed = jnp.where((column == last)[:, None], of_last[None], bits)
    trimmed = jnp.where((start < capacity)[:, None], trimmed, jnp.uint32(0))
    columns = jnp.concatenate([trimmed, start.astype(jnp.uint32)[:, None]], 1)
    count = jnp.minimum(found, capacity)
    return Sites(keys, count, columns), found - count


def _nth_bit(bits: UInt32[Array, "V W"], n: Int[Array, " V"]) -> Int[Array, " V"]:
    """Place of the n-th set bit (from 0) of each mask, which has as many."""
    word, place = bits[:, 0], jnp.zeros_like(n)
    for i in range(1, bits.shape[1]):
        below = lax.population_count(word).astype(jnp.int32)
        beyond = n >= below
        # `word` stays the word in which the bit is looked for, `n` its rank there.
        word, place = jnp.where(beyond, bits[:, i], word), jnp.where(beyond, 32 * i, place)
        n = jnp.where(beyond, n - below, n)
    for width in (16, 8, 4, 2, 1):
        below = lax.population_count(word & np.uint32(2**width - 1)).astype(jnp.int32)
        beyond = n >= below
        word, place = jnp.where(beyond, word >> width, word), jnp.where(beyond, place + width, place)
        n = jnp.where(beyond, n - below, n)
    return place


def _bits_of(z: Int[Array, " V"], words: int) -> UInt32[Array, "V W"]:
    """The mask of a column in which only z is set."""
    word = jnp.arange(words, dtype=jnp.int32)[None]
    bit = jnp.uint32(1) << (z & 31).astype(jnp.uint32)
    return jnp.where((z >> 5)[:, None] == word, bit[:, None], jnp.uint32(0))


def slots_at(
    sites: Sites, z: Int[Array, "V KZ"], y: Int[Array, "V KY"], x: Int[Array, "V KX"], *, shape: Triple
) -> Int[Array, "V K"]:
    """Return the slots of the sites at all combinations of z, y and x of a row, in C order.

    The number of slots stands for "no site", also outside of the grid `shape` (z, y, x).
    """
    depth, height, width = shape
    slots = sites.keys.shape[0]
    assert sites.columns is not None, "sites of the dense backend have no map"
    inside = _within(y, height)[:, :, None] & _within(x, width)[:, None]
    column = jnp.where(inside, y[:, :, None] * width + x[:, None], 0)
    entry = jnp.asarray(sites.columns).at[column].get(mode="promise_in_bounds")
    words, start = entry[:, None, ..., :-1], entry[:, None, ..., -1].astype(jnp.int32)
    here = z[:, :, None, None]
    at = jnp.where(_within(here, depth), here, 0)
    below, active = jnp.zeros((1,) * 4, jnp.int32), jnp.zeros((1,) * 4, bool)
    for i in range(words.shape[-1]):
        bit = (at - 32 * i).clip(0, 31).astype(jnp.uint32)
        lower = jnp.where(at < 32 * (i + 1), (jnp.uint32(1) << bit) - 1, jnp.uint32(0xFFFFFFFF))
        lower = jnp.where(at < 32 * i, jnp.uint32(0), lower)
        below += lax.population_count(words[..., i] & lower).astype(jnp.int32)
        active |= (at >> 5 == i) & ((words[..., i] >> bit) & 1 == 1)
    found = active & inside[:, None] & _within(here, depth)
    return jnp.where(found, start + below, slots).reshape(z.shape[0], -1)


def _within(index: Int[Array, "*n"], size: int) -> Bool[Array, "*n"]:
    return (index >= 0) & (index < size)


def to_dense(features: Float[Array, "V C"], sites: Sites, *, shape: Triple) -> Float[Array, "Z Y X C"]:
    """Scatter the sites' features to the whole grid (z, y, x), zero where no site is active."""
    depth, height, width = shape
    cells = depth * height * width
    # Padding slots write to distinct places out of bounds and are dropped.
    place = jnp.where(sites.keys == NO_SITE, cells + jnp.arange(sites.keys.shape[0], dtype=jnp.int32), sites.keys)
    flat = zeros_after(sites.count, (cells, features.shape[-1]), features.dtype)
    flat = flat.at[place].set(features, mode="drop", unique_indices=True, indices_are_sorted=True)
    return flat.reshape(height, width, depth, -1).transpose(2, 0, 1, 3)


def zeros_after(count: Int[Array, ""], shape: tuple[int, ...], dtype: jnp.dtype) -> jax.Array:
    """Return zeros that cannot be allocated before `count`, which is not negative, is known.

    Plain zeros depend on nothing: XLA would allocate those of all layers at the start, and memory would double.
    """
    return jnp.broadcast_to(jnp.minimum(count, 0).astype(dtype), shape)
