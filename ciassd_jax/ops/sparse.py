"""Sparse 3D convolution with static shapes (paper section 3.1).

A scene is a grid (z, y, x) in which only active sites exist (`sites.py`). A neighbour table lists the input site under
each kernel offset of each output site. A convolution gathers its inputs through the table and multiplies them with the
kernel, and so does its gradient. `sparse_dense.py` holds the definition that this must equal.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int

from ciassd_jax.ops.sites import NO_SITE, Triple, coordinates_of, slots_at, zeros_after
from ciassd_jax.types import Array, NeighbourTable, Sites

# Rows that a CPU gathers and multiplies at once: the gathered block must stay in cache.
_BLOCK_ROWS = 2000


def submanifold_table(sites: Sites, *, shape: Triple) -> NeighbourTable:
    """Neighbours of a 3 x 3 x 3 submanifold convolution, offsets in C order (z, y, x)."""
    inputs = _inputs(sites, sites, shape=shape, out_shape=shape, kernel=(3, 3, 3), stride=(1, 1, 1), padding=(1, 1, 1))
    # The transposed table is the table with its offsets reversed.
    return NeighbourTable(inputs, inputs[:, ::-1], sites.count, sites.count)


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
    inputs, outputs = _inputs(sites, out_sites, **geometry), _outputs(sites, out_sites, **geometry)
    return NeighbourTable(inputs, outputs, out_sites.count, sites.count)


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
    assert set(stride) <= {1, 2}, f"the stride {stride} is not 1 or 2 along each axis"
    real = (sites.keys != NO_SITE)[:, None]
    axes = []
    for i, k, s, p in zip(coordinates_of(sites.keys, shape).T, kernel, stride, padding, strict=True):
        shifted = i[:, None] + p - jnp.arange(k, dtype=jnp.int32)[None]
        # A shift halves negative numbers downwards.
        axes.append(jnp.where(real & (shifted & (s - 1) == 0), shifted >> (s - 1), -1))
    return slots_at(out_sites, *axes, shape=out_shape)


def flatten_scenes(table: NeighbourTable) -> NeighbourTable:
    """Tables of a batch as one table over the slots of all scenes, scene after scene."""

    def flatten(index: Int[Array, "B V K"], slots: int) -> Int[Array, "N K"]:
        scenes = index.shape[0]
        first = slots * jnp.arange(scenes, dtype=jnp.int32)[:, None, None]
        return jnp.where(index < slots, index + first, scenes * slots).reshape(-1, index.shape[-1])

    inputs = flatten(table.inputs, table.outputs.shape[1])
    outputs = flatten(table.outputs, table.inputs.shape[1])
    return NeighbourTable(inputs, outputs, table.num_outputs, table.num_inputs)


@jax.custom_vjp
def convolve(
    features: Float[Array, "U C"], table: NeighbourTable, kernel: Float[Array, "K C O"]
) -> Float[Array, "V O"]:
    """Sparse convolution (cross-correlation, no bias): out[v] = sum_k features[table.inputs[v, k]] @ kernel[k].

    Rows without neighbours are zero. The backward pass gathers through `table.outputs`; nothing is scattered, so that
    results repeat bit for bit on every device. Accumulates in float32 or wider.
    """
    return _multiply_on_platform(features, table, kernel)


def _multiply_on_platform(features: Array, table: NeighbourTable, kernel: Array) -> jax.Array:
    operands = (features, table.inputs, table.num_outputs, kernel)
    return jnp.asarray(lax.platform_dependent(*operands, cpu=multiply_in_blocks, default=multiply_at_once))


def _convolve_forward(
    features: Float[Array, "U C"], table: NeighbourTable, kernel: Float[Array, "K C O"]
) -> tuple[Float[Array, "V O"], tuple[Array, NeighbourTable, Array]]:
    return _multiply_on_platform(features, table, kernel), (features, table, kernel)


def _convolve_backward(
    saved: tuple[Array, NeighbourTable, Array], gradient: Float[Array, "V O"]
) -> tuple[Array, NeighbourTable, Array]:
    features, table, kernel = saved
    transposed = jnp.swapaxes(kernel, 1, 2)
    to_features, to_kernel = lax.platform_dependent(
        gradient,
        table.outputs,
        table.num_inputs,
        transposed,
        features,
        cpu=gradients_in_blocks,
        default=gradients_at_once,
    )
    no_gradient = NeighbourTable(*(np.zeros(t.shape, jax.dtypes.float0) for t in table))
    return to_features, no_gradient, to_kernel


convolve.defvjp(_convolve_forward, _convolve_backward)


def _product(a: Array, b: Array, dtype: jnp.dtype) -> jax.Array:
    """Matrix product in full precision, accumulated in float32 or wider."""
    accumulator = jnp.promote_types(dtype, jnp.float32)
    return jnp.matmul(a, b, precision=lax.Precision.HIGHEST, preferred_element_type=accumulator)


def _with_zero_row(rows: Float[Array, "U C"]) -> Float[jax.Array, "U1 C"]:
    """The rows and one of zeros, which absent neighbours read."""
    return jnp.pad(rows, ((0, 1), (0, 0)))


def _real_rows(values: Array, count: Int[Array, "*b"]) -> Array:
    """The rows of real sites, zero elsewhere: padding slots may hold anything."""
    real = jnp.arange(values.shape[0] // count.size, dtype=jnp.int32)[None] < count.reshape(-1, 1)
    return jnp.where(real.reshape(-1, 1), values, 0)


# All rows at once, for accelerators.


def multiply_at_once(features: Array, index: Array, count: Array, kernel: Array) -> Array:
    gathered = _with_zero_row(features).at[index].get(mode="promise_in_bounds").reshape(index.shape[0], -1)
    return _product(gathered, kernel.reshape(-1, kernel.shape[-1]), features.dtype).astype(features.dtype)


def gradients_at_once(
    gradient: Array, index: Array, count: Array, kernel: Array, features: Array
) -> tuple[Array, Array]:
    """Gradients of features and kernel [K, C, O] from the output's, of which one gather serves both.

    `index` [U, K] lists the outputs that read a feature row, and `kernel` is [K, O, C].
    """
    columns, out, channels = kernel.shape
    gathered = _with_zero_row(gradient).at[index].get(mode="promise_in_bounds").reshape(index.shape[0], -1)
    to_features = _product(gathered, kernel.reshape(-1, channels), features.dtype)
    to_kernel = _product(_real_rows(features, count).T, gathered, features.dtype)
    to_kernel = to_kernel.reshape(channels, columns, out).transpose(1, 0, 2)
    return to_features.astype(features.dtype), to_kernel.astype(kernel.dtype)


# Block after block of the real rows of each scene, for a CPU.


class _Blocks:
    """The rows of a table in blocks of one size, scene after scene."""

    def __init__(self, index: Array, count: Array) -> None:
        scenes, slots = count.size, index.shape[0] // count.size
        # As few blocks as needed, of the same size: often no row is left to pad.
        self.rows = -(-slots // -(-slots // _BLOCK_ROWS))
        self.scenes, self.slots, self.padded = scenes, slots, -(-slots // self.rows) * self.rows
        self.count = count.reshape(-1)
        self.always = self.count[0] >= 0

    def pad(self, array: Array, value: int = 0) -> Array:
        """An array of rows with every scene padded to whole blocks."""
        if self.padded == self.slots:
            return array
        by_scene = array.reshape(self.scenes, self.slots, -1)
        by_scene = jnp.pad(by_scene, ((0, 0), (0, self.padded - self.slots), (0, 0)), constant_values=value)
        return by_scene.reshape(self.scenes * self.padded, -1)

    def crop(self, array: Array) -> Array:
        """Inverse of `pad`."""
        if self.padded == self.slots:
            return array
        return array.reshape(self.scenes, self.padded, -1)[:, : self.slots].reshape(self.scenes * self.slots, -1)

    def accumulate(self, step: Callable[[Array, Array, Any], Any], start: Any) -> Any:
        """Run step(first row, end of the scene's real rows, carry) for every block that holds a real row."""

        def each_scene(scene: Array, carry: Any) -> Any:
            first = scene * self.padded
            last = first + self.count[scene]
            block = lambda state: (state[0] + self.rows, step(state[0], last, state[1]))  # noqa: E731
            return lax.while_loop(lambda state: state[0] < last, block, (first, carry))[1]

        return lax.fori_loop(0, self.scenes, each_scene, start)

    def gather(self, rows: Array, index: Array, start: Array) -> Array:
        """The neighbours of one block of rows, [rows, K * C]."""
        size = self.rows * index.shape[1]

        def gather(start: Array) -> Array:
            block = lax.dynamic_slice_in_dim(index, start, self.rows).reshape(-1)
            return jnp.asarray(rows).at[block].get(mode="promise_in_bounds")

        # Always true. XLA does not fuse across a branch: fused with the reshape, a CPU gathers one float at a time.
        whole = lax.cond(self.always, gather, lambda _: jnp.zeros((size, rows.shape[1]), rows.dtype), start)
        return whole.reshape(self.rows, -1)


def multiply_in_blocks(features: Array, index: Array, count: Array, kernel: Array) -> Array:
    blocks, out = _Blocks(index, count), kernel.shape[-1]
    index, padded = blocks.pad(index, features.shape[0]), _with_zero_row(features)
    kernel = kernel.reshape(-1, out)

    def multiply(start: Array, end: Array, result: Array) -> Array:
        product = _product(blocks.gather(padded, index, start), kernel, features.dtype)
        return lax.dynamic_update_slice_in_dim(result, product.astype(features.dtype), start, 0)

    empty = zeros_after(blocks.count[0], (index.shape[0], out), features.dtype)
    return blocks.crop(blocks.accumulate(multiply, empty))


def gradients_in_blocks(
    gradient: Array, index: Array, count: Array, kernel: Array, features: Array
) -> tuple[Array, Array]:
    blocks, (columns, out, channels) = _Blocks(index, count), kernel.shape
    index, padded = blocks.pad(index, gradient.shape[0]), _with_zero_row(gradient)
    features = blocks.pad(features)
    kernel_rows = kernel.reshape(-1, channels)

    def accumulate(start: Array, end: Array, results: tuple[Array, Array]) -> tuple[Array, Array]:
        to_features, to_kernel = results
        gathered = blocks.gather(padded, index, start)
        block = _product(gathered, kernel_rows, features.dtype).astype(features.dtype)
        to_features = lax.dynamic_update_slice_in_dim(to_features, block, start, 0)
        real = start + jnp.arange(blocks.rows, dtype=jnp.int32)[:, None] < end
        rows = jnp.where(real, lax.dynamic_slice_in_dim(features, start, blocks.rows), 0)
        return to_features, to_kernel + _product(rows.T, gathered, features.dtype)

    empty = zeros_after(blocks.count[0], features.shape, features.dtype)
    zero = jnp.zeros((channels, columns * out), jnp.promote_types(features.dtype, jnp.float32))
    to_features, to_kernel = blocks.accumulate(accumulate, (empty, zero))
    to_kernel = to_kernel.reshape(channels, columns, out).transpose(1, 0, 2)
    return blocks.crop(to_features), to_kernel.astype(kernel.dtype)
