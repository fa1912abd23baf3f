"""Active sites of a scene's grid, listed by key and indexed by maps of BEV columns.

For each column (y, x) the maps hold a bit mask of the active z and the slot of the lowest site. The slot of a site is
that slot plus the number of set bits below it, found in constant time. The active set of a strided convolution is the
OR of the masks in its window, and its sites are listed from the new masks: nothing is sorted.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int, UInt32

from ciassd_jax.types import Array, Sites

Triple = tuple[int, int, int]
NO_SITE = np.int32(np.iinfo(np.int32).max)


class Window(NamedTuple):
    """A convolution from the grid `shape` to the grid `out_shape`, both (z, y, x)."""

    shape: Triple
    out_shape: Triple
    kernel: Triple
    stride: Triple
    padding: Triple


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
    words, columns = -(-depth // 32), height * width
    slots = jnp.arange(keys.shape[0], dtype=jnp.int32)
    real = keys != NO_SITE
    column = _quotient(keys, depth)
    z = keys - column * depth
    # A column's bits are distinct, so that their sum is their OR. Padding is dropped outside of the map.
    place = jnp.where(real, column, columns)
    by_word = [
        jnp.zeros(columns, jnp.uint32)
        .at[place]
        .add(jnp.where(z >> 5 == i, _bit(z), 0), mode="drop", indices_are_sorted=True)
        for i in range(words)
    ]
    first = real & (column != jnp.concatenate([jnp.full(1, -1, jnp.int32), column[:-1]]))
    place = jnp.where(first, column, columns + slots)
    starts = jnp.zeros(columns, jnp.int32).at[place].set(slots, mode="drop", unique_indices=True)
    masks = jnp.stack(by_word).reshape(words, height, width)
    return Sites(keys, real.sum(dtype=jnp.int32), masks, starts.reshape(height, width))


def _bit(z: Int[Array, "*n"]) -> UInt32[jax.Array, "*n"]:
    """The bit of z in its word."""
    return jnp.uint32(1) << (z & 31).astype(jnp.uint32)


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
    assert sites.masks is not None, "sites of the dense backend have no maps"
    masks = _any_in_window(sites.masks, 1, out_shape[1], kernel[1], stride[1], padding[1])
    masks = _any_in_window(masks, 2, out_shape[2], kernel[2], stride[2], padding[2])
    masks = _any_in_depth(masks, out_shape[0], kernel[0], stride[0], padding[0])
    return _list_sites(masks, depth=out_shape[0], capacity=capacity)


def _any_in_window(
    bits: UInt32[Array, "W Y X"], axis: int, size: int, kernel: int, stride: int, padding: int
) -> UInt32[jax.Array, "W Y2 X2"]:
    """OR of the masks in the window of each of `size` outputs along y (axis 1) or x (axis 2)."""
    last = (size - 1) * stride
    around = [(0, 0)] * 3
    around[axis] = (padding, max(0, last + kernel - padding - bits.shape[axis]))
    padded = jnp.pad(bits, around)
    result = lax.slice_in_dim(padded, 0, last + 1, stride, axis)
    for offset in range(1, kernel):
        result |= lax.slice_in_dim(padded, offset, offset + last + 1, stride, axis)
    return result


def _any_in_depth(
    bits: UInt32[Array, "W Y X"], size: int, kernel: int, stride: int, padding: int
) -> UInt32[jax.Array, "W2 Y X"]:
    """Mask of the `size` outputs along z whose window holds a set bit; strides of 1 and 2."""
    assert stride in (1, 2), f"a mask cannot be strided by {stride}"
    words = [jnp.asarray(word) for word in bits]
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
    return jnp.stack(result)


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


def _list_sites(bits: UInt32[Array, "W Y X"], *, depth: int, capacity: int) -> tuple[Sites, Int[Array, ""]]:
    """The sites of a map of masks by ascending key, and how many of the highest keys were over capacity."""
    words, height, width = bits.shape
    bits = jnp.asarray(bits).reshape(words, -1)
    number = lax.population_count(bits).astype(jnp.int32).sum(0, dtype=jnp.int32)
    start = jnp.cumsum(number, dtype=jnp.int32) - number
    found = start[-1] + number[-1]
    column = jnp.arange(bits.shape[1], dtype=jnp.int32)
    # A column marks the slot of its lowest site; its other sites follow.
    place = jnp.where((number > 0) & (start < capacity), start, capacity + column)
    first = jnp.zeros(capacity, jnp.int32).at[place].set(column, mode="drop", unique_indices=True)
    # A column has at most `depth` sites, so that the largest column so far is among the last `depth` slots.
    column_of = _largest_so_far(first, depth)
    slot = jnp.arange(capacity, dtype=jnp.int32)
    # Without the barrier it may be fused into the neighbour tables and computed again for each of their entries.
    z = lax.optimization_barrier(_nth_bit([word[column_of] for word in bits], slot - start[column_of]))
    real = slot < found
    keys = jnp.where(real, column_of * depth + z, NO_SITE)
    # Sites over capacity leave the masks too; the column of the last slot may lose only some of its own.
    kept = start < capacity
    last = column == jnp.where(found > capacity, column_of[-1], -1)
    trimmed = [
        jnp.where(kept, jnp.where(last, word & lower_bits(z[-1] + 1 - 32 * i), word), 0) for i, word in enumerate(bits)
    ]
    masks = jnp.stack(trimmed).reshape(words, height, width)
    count = jnp.minimum(found, capacity)
    return Sites(keys, count, masks, start.reshape(height, width)), found - count


def _largest_so_far(values: Int[Array, " V"], reach: int) -> Int[jax.Array, " V"]:
    """Maximum of each value and at least the `reach` - 1 before it; none is negative."""
    largest, step = jnp.asarray(values), 1
    while step < min(reach, len(values)):
        # A TPU's compiler takes most of a minute for a window that slides.
        largest = jnp.maximum(largest, jnp.pad(largest[:-step], (step, 0)))
        step *= 2
    return largest


def _nth_bit(words: list[jax.Array], n: Int[Array, " V"]) -> Int[Array, " V"]:
    """Place of the n-th set bit (from 0) of each mask, which has as many."""
    word, place = words[0], jnp.zeros_like(n)
    for i, following in enumerate(words[1:], start=1):
        below = lax.population_count(word).astype(jnp.int32)
        beyond = n >= below
        # `word` stays the word in which the bit is looked for, `n` its rank there.
        word, place = jnp.where(beyond, following, word), jnp.where(beyond, 32 * i, place)
        n = jnp.where(beyond, n - below, n)
    for width in (16, 8, 4, 2, 1):
        below = lax.population_count(word & np.uint32(2**width - 1)).astype(jnp.int32)
        beyond = n >= below
        word, place = jnp.where(beyond, word >> width, word), jnp.where(beyond, place + width, place)
        n = jnp.where(beyond, n - below, n)
    return place


def to_dense(features: Float[Array, "V C"], sites: Sites, *, shape: Triple) -> Float[Array, "Y X Z C"]:
    """Return the sites' features on the whole grid `shape` (z, y, x), zero where no site is active."""
    assert sites.masks is not None, "sites of the dense backend have no maps"
    z = jnp.arange(shape[0], dtype=jnp.int32)
    below, active = jnp.zeros((1, 1, 1), jnp.int32), jnp.zeros((1, 1, 1), bool)
    for i, word in enumerate(sites.masks):
        bits = jnp.asarray(word)[:, :, None]
        below += lax.population_count(bits & lower_bits(z - 32 * i)[None, None]).astype(jnp.int32)
        active |= (bits & jnp.where(z >> 5 == i, _bit(z), 0)[None, None]) != 0
    slots = jnp.where(active, jnp.asarray(sites.starts)[:, :, None] + below, features.shape[0])
    return _spread(features, slots, sites.keys)


def lower_bits(n: Int[Array, "*n"]) -> UInt32[jax.Array, "*n"]:
    """A word whose n lowest bits are set: none if n is negative, all from 32 on."""
    some = (jnp.uint32(1) << n.clip(0, 31).astype(jnp.uint32)) - 1
    return jnp.where(n >= 32, jnp.uint32(0xFFFFFFFF), some)


@jax.custom_vjp
def _spread(features: Array, slots: Array, keys: Array) -> jax.Array:
    """Every cell reads its site, and in the backward pass every site its cell: nothing is scattered."""
    # The last row serves cells without a site.
    return jnp.pad(features, ((0, 1), (0, 0))).at[slots].get(mode="promise_in_bounds")


def _spread_forward(features: Array, slots: Array, keys: Array) -> tuple[jax.Array, Array]:
    return _spread(features, slots, keys), keys


def _spread_backward(keys: Array, gradient: Array) -> tuple[jax.Array, None, None]:
    real = keys != NO_SITE
    cells = jnp.asarray(gradient).reshape(-1, gradient.shape[-1])
    return jnp.where(real[:, None], cells[jnp.where(real, keys, 0)], 0), None, None


_spread.defvjp(_spread_forward, _spread_backward)
