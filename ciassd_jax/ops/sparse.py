"""Sparse 3D convolution with static shapes (paper section 3.1, SPEC section 4).

A scene is a grid (z, y, x) in which only active sites exist (`sites.py`). A neighbour table says which input each
kernel offset reads; a convolution is a gather through it and one matrix product for each block of rows, in value and
in gradient. `sparse_dense.py` holds the definition that this must equal.
"""

from __future__ import annotations

from functools import partial, wraps
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int

from ciassd_jax.ops.sites import NO_SITE, Triple, coordinates_of, slots_at, zeros_after
from ciassd_jax.types import Array, NeighbourTable, Sites

# Rows of the output computed at once. On a CPU the gathered block must stay in cache; elsewhere large
# products matter more.
_BLOCK_ROWS = {"cpu": 2000, "default": 32000}


def submanifold_table(sites: Sites, *, shape: Triple) -> NeighbourTable:
    """Neighbours of a 3 x 3 x 3 submanifold convolution, offsets in C order (z, y, x)."""
    inputs = _inputs(sites, sites, shape=shape, out_shape=shape, kernel=(3, 3, 3), stride=(1, 1, 1), padding=(1, 1, 1))
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
    geometry = {"shape": shape, "out_shape": out_shape, "kernel": kernel, "stride": stride, "padding": padding}
    return NeighbourTable(_inputs(sites, out_sites, **geometry), _outputs(sites, out_sites, **geometry))


def _inputs(
    sites: Sites, out_sites: Sites, *, shape: Triple, out_shape: Triple, kernel: Triple, stride: Triple, padding: Triple
) -> Int[Array, "V K"]:
    """Slots of the inputs at o * stride - padding + k of every output o."""
    real = (out_sites.keys != NO_SITE)[:, None]
    axes = [
        jnp.where(real, o[:, None] * s - p + jnp.arange(k, dtype=jnp.int32)[None], -1)
        for o, k, s, p in zip(coordinates_of(out_sites.keys, out_shape).T, kernel, stride, padding, strict=True)
    ]
    return slots_at(sites, *axes, shape=shape)


def _outputs(
    sites: Sites, out_sites: Sites, *, shape: Triple, out_shape: Triple, kernel: Triple, stride: Triple, padding: Triple
) -> Int[Array, "U K"]:
    """Slots of the outputs at (i + padding - k) / stride of every input i, where that is whole."""
    real = (sites.keys != NO_SITE)[:, None]
    axes = []
    for i, k, s, p in zip(coordinates_of(sites.keys, shape).T, kernel, stride, padding, strict=True):
        shifted = i[:, None] + p - jnp.arange(k, dtype=jnp.int32)[None]
        axes.append(jnp.where(real & (shifted % s == 0), shifted // s, -1))
    return slots_at(out_sites, *axes, shape=out_shape)


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
    to_features, to_kernel = _gradients(gradient, table.outputs, jnp.swapaxes(kernel, 1, 2), features)
    no_gradient = NeighbourTable(*(np.zeros(t.shape, jax.dtypes.float0) for t in table))
    return to_features, no_gradient, to_kernel


convolve.defvjp(_convolve_forward, _convolve_backward)


def _per_platform(function):  # type: ignore[no-untyped-def]
    """Run `function(*arrays, rows=...)` with the block size of the platform that it is lowered for."""

    @wraps(function)
    def choose(*arrays: Array) -> Any:
        branches = {name: partial(function, rows=rows) for name, rows in _BLOCK_ROWS.items()}
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
    columns, channels = index.shape[1], features.shape[1]

    def gather(start: Array) -> Array:
        block = lax.dynamic_slice_in_dim(index, start, rows).reshape(-1)
        return jnp.asarray(features).at[block].get(mode="promise_in_bounds")

    # Always true. XLA does not fuse across a branch: fused with the reshape, a CPU gathers one float at a time.
    whole = lax.cond(start >= 0, gather, lambda _: jnp.zeros((rows * columns, channels), features.dtype), start)
    return whole.reshape(rows, -1)


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

    empty = zeros_after(occupied, (index.shape[0], out), features.dtype)
    return lax.fori_loop(jnp.int32(0), occupied, multiply, empty)[:slots]


@_per_platform
def _gradients(gradient: Array, index: Array, kernel: Array, features: Array, *, rows: int) -> tuple[Array, Array]:
    """Gradients of features and kernel [K, C, O] from the output's, of which one gather serves both.

    `index` [U, K] says which outputs read a feature row, and `kernel` is [K, O, C].
    """
    slots, columns, (out, channels) = features.shape[0], index.shape[1], kernel.shape[1:]
    rows = _even_rows(slots, rows)
    index, order, occupied = _blocks(index, gradient.shape[0], rows)
    padded = jnp.pad(gradient, ((0, 1), (0, 0)))
    # Padding slots may hold anything, and nobody reads them.
    read = jnp.any(index < gradient.shape[0], 1, keepdims=True)
    features = jnp.where(read, jnp.pad(features, ((0, index.shape[0] - slots), (0, 0))), 0)
    multiply = partial(jnp.matmul, precision=lax.Precision.HIGHEST, preferred_element_type=_accumulator(features.dtype))

    def accumulate(i: Array, results: tuple[Array, Array]) -> tuple[Array, Array]:
        to_features, to_kernel = results
        start = order[i] * rows
        gathered = _gathered(padded, index, start, rows)
        block = multiply(gathered, kernel.reshape(-1, channels)).astype(features.dtype)
        to_features = lax.dynamic_update_slice_in_dim(to_features, block, start, 0)
        return to_features, to_kernel + multiply(lax.dynamic_slice_in_dim(features, start, rows).T, gathered)

    empty = zeros_after(occupied, features.shape, features.dtype)
    zero = jnp.zeros((channels, columns * out), _accumulator(features.dtype))
    to_features, to_kernel = lax.fori_loop(jnp.int32(0), occupied, accumulate, (empty, zero))
    to_kernel = to_kernel.reshape(channels, columns, out).transpose(1, 0, 2)
    return to_features[:slots], to_kernel.astype(kernel.dtype)
