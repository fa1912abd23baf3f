"""Sparse 3D convolution with static shapes (paper section 3.1, SPEC section 4).

A scene is a grid (z, y, x) in which only active sites exist. Sites are sorted by linear key with z fastest, so
that the sites of a BEV column are adjacent; a map of the columns finds any of them in constant time. A neighbour
table says which input each kernel offset reads; a convolution is a gather through it and one matrix product for
each block of rows, in value and in gradient. `sparse_dense.py` holds the definition that this must equal.
"""

from __future__ import annotations

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Int, UInt32

from ciassd_jax.types import Array, NeighbourTable, Sites

Triple = tuple[int, int, int]
NO_SITE = np.int32(np.iinfo(np.int32).max)

# Rows of the output computed at once. On a CPU the gathered block must stay in cache; elsewhere large
# products matter more.
_BLOCK_ROWS = {"cpu": 1000, "default": 32000}


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


def sort_unique(keys: Int[Array, " N"], *, capacity: int) -> tuple[Sites, Int[Array, ""]]:
    """Sites of the lowest distinct keys (`NO_SITE` marks none), and how many over capacity were dropped."""
    keys = jnp.sort(keys)
    previous = jnp.concatenate([jnp.full(1, -1, keys.dtype), keys[:-1]])
    is_first = (keys != previous) & (keys != NO_SITE)
    rank = jnp.cumsum(is_first, dtype=jnp.int32)
    found = rank[-1]
    slots = jnp.arange(capacity, dtype=jnp.int32)
    # The v-th distinct key stands where the running count first reaches v + 1.
    position = jnp.minimum(jnp.searchsorted(rank, slots + 1).astype(jnp.int32), keys.shape[0] - 1)
    count = jnp.minimum(found, capacity)
    return Sites(jnp.where(slots < count, keys[position], NO_SITE), count), found - count


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
    coordinates = coordinates_of(sites.keys, shape)
    candidates = []
    # An input at i is read by outputs o with 0 <= i + padding - o * stride < kernel.
    reach = [range(-(-k // s)) for k, s in zip(kernel, stride, strict=True)]
    for back in itertools.product(*reach):
        output, inside = [], sites.keys != NO_SITE
        for axis in range(3):
            shifted = coordinates[:, axis] + padding[axis]
            o = shifted // stride[axis] - back[axis]
            inside &= (shifted - o * stride[axis] < kernel[axis]) & (o >= 0) & (o < out_shape[axis])
            output.append(o)
        candidates.append(jnp.where(inside, linear_keys(jnp.stack(output, -1), out_shape), NO_SITE))
    return sort_unique(jnp.concatenate(candidates), capacity=capacity)


def submanifold_table(sites: Sites, *, shape: Triple) -> NeighbourTable:
    """Neighbours of a 3 x 3 x 3 submanifold convolution, offsets in C order (z, y, x)."""
    corner = coordinates_of(sites.keys, shape) - 1
    inputs = _window_indices(sites, corner, sites.keys != NO_SITE, shape=shape, kernel=(3, 3, 3))
    # Who reads me through offset k is whom I read through the mirrored offset.
    return NeighbourTable(inputs, inputs[:, ::-1])


def strided_table(
    sites: Sites,
    out_sites: Sites,
    *,
    shape: Triple,
    out_shape: Triple,
    kernel: Triple,
    stride: Triple,
    padding: Triple,
) -> NeighbourTable:
    """Neighbours of a strided convolution from `sites` to `out_sites`, offsets in C order (z, y, x)."""
    strides, paddings = jnp.array(stride, jnp.int32), jnp.array(padding, jnp.int32)
    corner = coordinates_of(out_sites.keys, out_shape) * strides[None] - paddings[None]
    inputs = _window_indices(sites, corner, out_sites.keys != NO_SITE, shape=shape, kernel=kernel)
    offsets = jnp.array(list(np.ndindex(*kernel)), jnp.int32)
    shifted = (coordinates_of(sites.keys, shape) + paddings[None])[:, None] - offsets[None]
    output = shifted // strides[None, None]
    inside = (sites.keys != NO_SITE)[:, None] & (shifted % strides[None, None] == 0).all(-1)
    inside &= ((output >= 0) & (output < jnp.array(out_shape, jnp.int32)[None, None])).all(-1)
    return NeighbourTable(inputs, _site_indices(out_sites, linear_keys(output, out_shape), inside))


def _site_indices(sites: Sites, keys: Int[Array, "*n"], wanted: Bool[Array, "*n"]) -> Int[Array, "*n"]:
    """Slot of each wanted key, the number of slots where it is not active."""
    slots = sites.keys.shape[0]
    position = jnp.minimum(jnp.searchsorted(sites.keys, keys).astype(jnp.int32), slots - 1)
    return jnp.where(wanted & (sites.keys[position] == keys), position, slots)


def _column_map(sites: Sites, *, shape: Triple) -> UInt32[Array, "columns words"]:
    """For every BEV column (y, x): a bit for each active z, in words of 32, and the slot of its lowest site.

    With it a site is found in constant time: its slot is the column's first plus the number of set bits below.
    """
    depth, height, width = shape
    words = -(-depth // 32)
    slots = sites.keys.shape[0]
    column, z = sites.keys // depth, sites.keys % depth
    word = jnp.arange(words, dtype=jnp.int32)[None]
    bits = jnp.where((z // 32)[:, None] == word, jnp.uint32(1) << (z % 32).astype(jnp.uint32)[:, None], jnp.uint32(0))
    # Gather the bits of a column in its first site: its sites are adjacent, at most `depth` of them.
    for step in (2**i for i in range((depth - 1).bit_length())):
        same = jnp.pad(column[step:], (0, min(step, slots)), constant_values=-1)[:slots] == column
        later = jnp.pad(bits[step:], ((0, min(step, slots)), (0, 0)))[:slots]
        bits = bits | jnp.where(same[:, None], later, jnp.uint32(0))
    slot = jnp.arange(slots, dtype=jnp.int32)
    is_first = (column != jnp.concatenate([jnp.full(1, -1, jnp.int32), column[:-1]])) & (sites.keys != NO_SITE)
    place = jnp.where(is_first, column, height * width + slot)
    entry = jnp.concatenate([bits, slot.astype(jnp.uint32)[:, None]], 1)
    empty = jnp.zeros((height * width, words + 1), jnp.uint32)
    return empty.at[place].set(entry, mode="drop", unique_indices=True)


def _window_indices(
    sites: Sites, corner: Int[Array, "V 3"], real: Bool[Array, " V"], *, shape: Triple, kernel: Triple
) -> Int[Array, "V K"]:
    """Slots of the sites in the windows that start at `corner` (z, y, x), in C order of the kernel."""
    depth, height, width = shape
    slots = sites.keys.shape[0]
    offset_y, offset_x = (jnp.array(o, jnp.int32) for o in zip(*np.ndindex(*kernel[1:]), strict=True))
    y, x = corner[:, 1:2] + offset_y[None], corner[:, 2:] + offset_x[None]
    inside = real[:, None] & (y >= 0) & (y < height) & (x >= 0) & (x < width)
    columns = _column_map(sites, shape=shape)
    entry = jnp.asarray(columns).at[jnp.where(inside, y * width + x, 0)].get(mode="promise_in_bounds")
    words, start = entry[..., :-1], entry[..., -1].astype(jnp.int32)
    found = []
    for dz in range(kernel[0]):
        z = corner[:, :1] + dz
        at = jnp.where((z >= 0) & (z < depth), z, 0)
        below, active = jnp.zeros(start.shape, jnp.int32), jnp.zeros(start.shape, bool)
        for i in range(words.shape[-1]):
            bit = (at - 32 * i).clip(0, 31).astype(jnp.uint32)
            lower = jnp.where(at < 32 * (i + 1), (jnp.uint32(1) << bit) - 1, jnp.uint32(0xFFFFFFFF))
            lower = jnp.where(at < 32 * i, jnp.uint32(0), lower)
            below += lax.population_count(words[..., i] & lower).astype(jnp.int32)
            active |= (at // 32 == i) & ((words[..., i] >> bit) & 1 == 1)
        active &= inside & (z >= 0) & (z < depth)
        found.append(jnp.where(active, start + below, slots))
    return jnp.stack(found, 1).reshape(corner.shape[0], -1)


def flatten_scenes(table: NeighbourTable) -> NeighbourTable:
    """Tables of a batch as one table over the slots of all scenes, scene after scene."""

    def flatten(index: Int[Array, "B V K"], slots: int) -> Int[Array, "N K"]:
        scenes = index.shape[0]
        first = slots * jnp.arange(scenes, dtype=jnp.int32)[:, None, None]
        return jnp.where(index < slots, index + first, scenes * slots).reshape(-1, index.shape[-1])

    return NeighbourTable(flatten(table.inputs, table.outputs.shape[1]), flatten(table.outputs, table.inputs.shape[1]))


@jax.custom_vjp
def convolve(
    features: Float[Array, "U C"], table: NeighbourTable, kernel: Float[Array, "K C O"]
) -> Float[Array, "V O"]:
    """Sparse convolution (cross-correlation, no bias): out[v] = sum_k features[table.inputs[v, k]] @ kernel[k].

    Rows without neighbours are zero and cost nothing. The backward pass gathers through `table.outputs`; nothing
    is scattered, so that results repeat bit for bit on every device. Accumulates in float32 or wider.
    """
    return _gather_multiply(features, table.inputs, kernel)


def _convolve_forward(
    features: Float[Array, "U C"], table: NeighbourTable, kernel: Float[Array, "K C O"]
) -> tuple[Float[Array, "V O"], tuple[Array, NeighbourTable, Array]]:
    return _gather_multiply(features, table.inputs, kernel), (features, table, kernel)


def _convolve_backward(
    saved: tuple[Array, NeighbourTable, Array], gradient: Float[Array, "V O"]
) -> tuple[Array, NeighbourTable, Array]:
    features, table, kernel = saved
    to_features = _gather_multiply(gradient, table.outputs, jnp.swapaxes(kernel, 1, 2))
    to_kernel = _kernel_gradient(features, table.inputs, gradient).reshape(kernel.shape).astype(kernel.dtype)
    no_gradient = NeighbourTable(*(np.zeros(t.shape, jax.dtypes.float0) for t in table))
    return to_features, no_gradient, to_kernel


convolve.defvjp(_convolve_forward, _convolve_backward)


def _per_platform(function):  # type: ignore[no-untyped-def]
    """Run `function(*arrays, rows=...)` with the block size of the platform that it is lowered for."""

    @functools.wraps(function)
    def choose(*arrays: Array) -> Array:
        branches = {name: functools.partial(function, rows=rows) for name, rows in _BLOCK_ROWS.items()}
        return lax.platform_dependent(*arrays, **branches)

    return choose


def _even_rows(slots: int, most: int) -> int:
    """At most `most` rows in as few blocks of one size as they need: often no row is left to pad."""
    return -(-slots // -(-slots // most))


def _accumulator(dtype: jnp.dtype) -> jnp.dtype:
    return jnp.promote_types(dtype, jnp.float32)


def _blocks(index: Int[Array, "V K"], absent: int, rows: int) -> tuple[Array, Array, Array]:
    """The table padded to whole blocks, the blocks with the occupied ones first, and how many those are."""
    padding = -index.shape[0] % rows
    index = jnp.pad(index, ((0, padding), (0, 0)), constant_values=absent)
    occupied = (index < absent).reshape(-1, rows * index.shape[1]).any(1)
    return index, jnp.argsort(~occupied, stable=True).astype(jnp.int32), occupied.sum(dtype=jnp.int32)


def _gathered(features: Float[Array, "U1 C"], index: Int[Array, "V K"], start: Array, rows: int) -> Array:
    """The inputs of one block of rows, [rows, K * C]; the last feature row is zero and stands for 'none'."""
    block = lax.dynamic_slice_in_dim(index, start, rows)
    return jnp.asarray(features).at[block].get(mode="promise_in_bounds").reshape(rows, -1)


@_per_platform
def _gather_multiply(features: Array, index: Array, kernel: Array, *, rows: int) -> Array:
    slots, out = index.shape[0], kernel.shape[-1]
    rows = _even_rows(slots, rows)
    index, order, occupied = _blocks(index, features.shape[0], rows)
    padded = jnp.pad(features, ((0, 1), (0, 0)))
    kernel = kernel.reshape(-1, out)

    def multiply(i: Array, result: Array) -> Array:
        start = order[i] * rows
        product = jnp.matmul(
            _gathered(padded, index, start, rows),
            kernel,
            precision=lax.Precision.HIGHEST,
            preferred_element_type=_accumulator(features.dtype),
        )
        return lax.dynamic_update_slice_in_dim(result, product.astype(features.dtype), start, 0)

    empty = jnp.zeros((index.shape[0], out), features.dtype)
    return lax.fori_loop(jnp.int32(0), occupied, multiply, empty)[:slots]


@_per_platform
def _kernel_gradient(features: Array, index: Array, gradient: Array, *, rows: int) -> Array:
    slots, out = index.shape[0], gradient.shape[-1]
    rows = _even_rows(slots, rows)
    index, order, occupied = _blocks(index, features.shape[0], rows)
    padded = jnp.pad(features, ((0, 1), (0, 0)))
    gradient = jnp.pad(gradient, ((0, index.shape[0] - slots), (0, 0)))
    accumulator = _accumulator(features.dtype)

    def accumulate(i: Array, total: Array) -> Array:
        start = order[i] * rows
        return total + jnp.matmul(
            _gathered(padded, index, start, rows).T,
            lax.dynamic_slice_in_dim(gradient, start, rows),
            precision=lax.Precision.HIGHEST,
            preferred_element_type=accumulator,
        )

    zero = jnp.zeros((index.shape[1] * features.shape[1], out), accumulator)
    return lax.fori_loop(jnp.int32(0), occupied, accumulate, zero)


def to_dense(features: Float[Array, "V C"], sites: Sites, *, shape: Triple) -> Float[Array, "Z Y X C"]:
    """The sites' features on the whole grid (z, y, x), zero where no site is active."""
    depth, height, width = shape
    cells = depth * height * width
    # Padding writes outside of the grid, each slot to a place of its own, and is dropped there.
    place = jnp.where(sites.keys == NO_SITE, cells + jnp.arange(sites.keys.shape[0], dtype=jnp.int32), sites.keys)
    flat = jnp.zeros((cells, features.shape[-1]), features.dtype)
    flat = flat.at[place].set(features, mode="drop", unique_indices=True, indices_are_sorted=True)
    return flat.reshape(height, width, depth, -1).transpose(2, 0, 1, 3)
