"""Sparse 3D convolution with static shapes (paper section 3.1).

A scene is a grid (z, y, x) in which only active sites exist (`sites.py`). A neighbour table lists the input sites under
the kernel of each output site, by column (`runs.py`). A convolution gathers its inputs through the table and multiplies
them with the kernel, and so does its gradient. `sparse_dense.py` holds the definition that this must equal.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int

from ciassd_jax.ops import runs as run_ops
from ciassd_jax.ops.platform import Program, by_platform
from ciassd_jax.ops.sites import NO_SITE, Triple, Window, coordinates_of
from ciassd_jax.types import Array, NeighbourTable, Sites

# Rows that a CPU gathers and multiplies at once: the gathered block must stay in cache.
_BLOCK_ROWS = 2000


def submanifold_table(sites: Sites, *, shape: Triple, program: Program = "auto") -> NeighbourTable:
    """Neighbours of a 3 x 3 x 3 submanifold convolution."""
    inputs = _inputs(sites, sites, Window(shape, shape, (3, 3, 3), (1, 1, 1), (1, 1, 1)), program)
    following = run_ops.followers(sites, depth=shape[0])
    # What a site reads also reads it.
    return NeighbourTable(inputs, inputs, following, following, sites.count, sites.count)


def strided_table(
    sites: Sites,
    out_sites: Sites,
    *,
    shape: Triple,
    out_shape: Triple,
    kernel: Triple,
    stride: Triple,
    padding: Triple,
    program: Program = "auto",
) -> NeighbourTable:
    """Neighbours of a strided convolution from `sites` to `out_sites`; a kernel of 1 or 3 along y and x, 3 along z."""
    axes = list(zip(kernel, stride, strict=True))
    assert axes[0][0] == run_ops.DEPTH, f"runs have three z, the kernel {kernel[0]}"
    assert set(axes) <= {(1, 1), (3, 1), (3, 2)}, f"no runs for a kernel of {kernel} with strides of {stride}"
    window = Window(shape, out_shape, kernel, stride, padding)
    return NeighbourTable(
        _inputs(sites, out_sites, window, program),
        _outputs(sites, out_sites, window, program),
        run_ops.followers(sites, depth=shape[0]),
        run_ops.followers(out_sites, depth=out_shape[0], step=stride[0]),
        out_sites.count,
        sites.count,
    )


def _inputs(sites: Sites, out_sites: Sites, window: Window, program: Program) -> Int[Array, "J V"]:
    """Runs of the inputs of every output o, from o * stride - padding on."""
    places = coordinates_of(out_sites.keys, window.out_shape).T
    z, y, x = (o * s - p for o, s, p in zip(places, window.stride, window.padding, strict=True))
    # Padding reads beside the grid.
    y = jnp.where(out_sites.keys != NO_SITE, y, window.shape[1])
    return run_ops.pack(*run_ops.runs_at(sites, z, y, x, size=window.kernel[1:], program=program))


def _outputs(sites: Sites, out_sites: Sites, window: Window, program: Program) -> Int[Array, "J U"]:
    """Runs of the outputs that read every input i: (i + padding - k) / stride, where that is whole, by descending k."""
    z, y, x = (i + p for i, p in zip(coordinates_of(sites.keys, window.shape).T, window.padding, strict=True))
    kernel, stride = window.kernel, window.stride
    first = [(n >> 1) - 1 if s == 2 else n - (k - 1) for n, s, k in zip((z, y, x), stride, kernel, strict=True)]
    first[1] = jnp.where(sites.keys != NO_SITE, first[1], window.out_shape[1])
    columns = [2 if s == 2 else k for s, k in zip(stride[1:], kernel[1:], strict=True)]
    slot, mask = run_ops.runs_at(out_sites, *first, size=(columns[0], columns[1]), program=program)
    if stride[0] == 2:
        # An even z is read through the outer offsets of two outputs, an odd one through the middle of the second.
        lower, upper = mask & 1, mask >> 1 & 1
        odd = (z & 1 != 0)[None, None]
        slot, mask = jnp.where(odd, slot + lower, slot), jnp.where(odd, 2 * upper, lower + 4 * upper)
    for axis, n in ((0, y), (1, x)):
        if stride[1 + axis] == 2:
            odd = (n & 1 != 0)[None]
            (slot_0, slot_1), (mask_0, mask_1) = jnp.moveaxis(slot, axis, 0), jnp.moveaxis(mask, axis, 0)
            slot = jnp.stack([slot_0, slot_1, slot_1], axis)
            mask = jnp.stack([jnp.where(odd, 0, mask_0), jnp.where(odd, mask_1, 0), jnp.where(odd, 0, mask_1)], axis)
    return run_ops.pack(slot, mask)


def flatten_scenes(table: NeighbourTable) -> NeighbourTable:
    """Tables of a batch as one table over the slots of all scenes, scene after scene."""

    def flatten(runs: Int[Array, "B J V"], slots: int) -> Int[Array, "J N"]:
        first = slots * jnp.arange(runs.shape[0], dtype=jnp.int32)[:, None, None]
        return (runs + 8 * first).transpose(1, 0, 2).reshape(runs.shape[1], -1)

    inputs, outputs = table.input_followers, table.output_followers
    assert max(inputs.size, outputs.size) < 2**28, "more site slots in a batch than a packed run can name"
    return NeighbourTable(
        flatten(table.inputs, inputs.shape[1]),
        flatten(table.outputs, outputs.shape[1]),
        inputs.reshape(-1),
        outputs.reshape(-1),
        table.num_outputs,
        table.num_inputs,
    )


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def convolve(
    features: Float[Array, "U C"], table: NeighbourTable, kernel: Float[Array, "K C O"], program: Program = "auto"
) -> Float[Array, "V O"]:
    """Sparse convolution (cross-correlation, no bias) with a kernel whose offsets are in C order (z, y, x).

    Rows without neighbours are zero. The backward pass gathers through `table.outputs`; nothing is scattered, so that
    results repeat bit for bit on every device. Accumulates in float32 or wider.
    """
    operands = (features, table.inputs, table.input_followers, table.num_outputs, kernel)
    return jnp.asarray(by_platform(program, *operands, cpu=multiply_in_blocks, accelerator=multiply_at_once))


def _convolve_forward(
    features: Float[Array, "U C"], table: NeighbourTable, kernel: Float[Array, "K C O"], program: Program
) -> tuple[Float[Array, "V O"], tuple[Array, NeighbourTable, Array]]:
    return convolve(features, table, kernel, program), (features, table, kernel)


def _convolve_backward(
    program: Program, saved: tuple[Array, NeighbourTable, Array], gradient: Float[Array, "V O"]
) -> tuple[Array, NeighbourTable, Array]:
    features, table, kernel = saved
    # The outputs that read an input come in ascending order, which is the descending one of the offsets.
    transposed = jnp.swapaxes(kernel[::-1], 1, 2)
    operands = (gradient, table.outputs, table.output_followers, table.num_inputs, transposed, features)
    to_features, to_kernel = by_platform(program, *operands, cpu=gradients_in_blocks, accelerator=gradients_at_once)
    no_gradient = NeighbourTable(*(np.zeros(t.shape, jax.dtypes.float0) for t in table))
    return to_features, no_gradient, to_kernel[::-1]


convolve.defvjp(_convolve_forward, _convolve_backward)


def _product(equation: str, a: Array, b: Array, dtype: jnp.dtype) -> jax.Array:
    """Contraction in full precision, accumulated in float32 or wider."""
    accumulator = jnp.promote_types(dtype, jnp.float32)
    return jnp.einsum(equation, a, b, precision=lax.Precision.HIGHEST, preferred_element_type=accumulator)


# All rows at once, for accelerators. J columns of runs, each of three offsets along z.


def multiply_at_once(
    features: Array, runs: Int[Array, "J V"], following: Int[Array, " U"], count: Array, kernel: Array
) -> Array:
    gathered = _gather_windows(features, runs, following)
    return _product("jvhc,jhco->vo", gathered, _by_column(kernel), features.dtype).astype(features.dtype)


def gradients_at_once(
    gradient: Array, runs: Int[Array, "J U"], following: Int[Array, " V"], count: Array, kernel: Array, features: Array
) -> tuple[Array, Array]:
    """Gradients of features and kernel [K, C, O] from the output's, of which one gather serves both.

    `runs` are of the outputs that read each feature row, and `kernel` is [K, O, C].
    """
    gathered = _gather_windows(gradient, runs, following)
    to_features = _product("jvho,jhoc->vc", gathered, _by_column(kernel), features.dtype)
    to_kernel = _product("vc,jvho->jhoc", _real_rows(features, count), gathered, features.dtype)
    offsets, out, channels = kernel.shape
    to_kernel = to_kernel.reshape(len(runs), -1, channels)[:, : run_ops.DEPTH * out]
    to_kernel = to_kernel.reshape(len(runs), run_ops.DEPTH, out, channels).transpose(1, 0, 3, 2)
    to_kernel = to_kernel.reshape(offsets, channels, out)
    return to_features.astype(features.dtype), to_kernel.astype(kernel.dtype)


def _gather_windows(rows: Array, runs: Int[Array, "J V"], following: Array) -> Float[Array, "J V 2 D"]:
    """The run of each column, in two halves."""
    index = run_ops.first_rows(runs, rows.shape[0])
    return run_ops.windows(rows, following).at[index].get(mode="promise_in_bounds")


def _by_column(kernel: Float[Array, "K C O"]) -> Float[Array, "J 2 D O"]:
    """The kernel with the offsets along z beside the channels, as in `windows`."""
    depth, (offsets, channels, out) = run_ops.DEPTH, kernel.shape
    by_column = kernel.reshape(depth, -1, channels, out).transpose(1, 0, 2, 3)
    return run_ops.in_halves(by_column.reshape(offsets // depth, -1, out), 1)


def _real_rows(values: Array, count: Int[Array, "*b"]) -> Array:
    """The rows of real sites, zero elsewhere: padding slots may hold anything."""
    real = jnp.arange(values.shape[0] // count.size, dtype=jnp.int32)[None] < count.reshape(-1, 1)
    return jnp.where(real.reshape(-1, 1), values, 0)


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


def _zeros_after(count: Int[Array, ""], shape: tuple[int, ...], dtype: jnp.dtype) -> jax.Array:
    """Zeros that cannot be allocated before `count`, which is not negative, is known.

    Plain zeros depend on nothing: XLA would allocate those of all layers at the start, and memory would double.
    """
    return jnp.broadcast_to(jnp.minimum(count, 0).astype(dtype), shape)


def _with_zero_row(rows: Float[Array, "U C"]) -> Float[jax.Array, "U1 C"]:
    """The rows and one of zeros, which absent neighbours read."""
    return jnp.pad(rows, ((0, 1), (0, 0)))


def multiply_in_blocks(features: Array, runs: Array, following: Array, count: Array, kernel: Array) -> Array:
    index = run_ops.slots(runs, absent=features.shape[0])
    blocks, out = _Blocks(index, count), kernel.shape[-1]
    index, padded = blocks.pad(index, features.shape[0]), _with_zero_row(features)
    kernel = kernel.reshape(-1, out)

    def multiply(start: Array, end: Array, result: Array) -> Array:
        product = _product("vc,co->vo", blocks.gather(padded, index, start), kernel, features.dtype)
        return lax.dynamic_update_slice_in_dim(result, product.astype(features.dtype), start, 0)

    empty = _zeros_after(blocks.count[0], (index.shape[0], out), features.dtype)
    return blocks.crop(blocks.accumulate(multiply, empty))


def gradients_in_blocks(
    gradient: Array, runs: Array, following: Array, count: Array, kernel: Array, features: Array
) -> tuple[Array, Array]:
    index = run_ops.slots(runs, absent=gradient.shape[0])
    blocks, (columns, out, channels) = _Blocks(index, count), kernel.shape
    index, padded = blocks.pad(index, gradient.shape[0]), _with_zero_row(gradient)
    features = blocks.pad(features)
    kernel_rows = kernel.reshape(-1, channels)

    def accumulate(start: Array, end: Array, results: tuple[Array, Array]) -> tuple[Array, Array]:
        to_features, to_kernel = results
        gathered = blocks.gather(padded, index, start)
        block = _product("vo,oc->vc", gathered, kernel_rows, features.dtype).astype(features.dtype)
        to_features = lax.dynamic_update_slice_in_dim(to_features, block, start, 0)
        real = start + jnp.arange(blocks.rows, dtype=jnp.int32)[:, None] < end
        rows = jnp.where(real, lax.dynamic_slice_in_dim(features, start, blocks.rows), 0)
        return to_features, to_kernel + _product("vc,vo->co", rows, gathered, features.dtype)

    empty = _zeros_after(blocks.count[0], features.shape, features.dtype)
    zero = jnp.zeros((channels, columns * out), jnp.promote_types(features.dtype, jnp.float32))
    to_features, to_kernel = blocks.accumulate(accumulate, (empty, zero))
    to_kernel = to_kernel.reshape(channels, columns, out).transpose(1, 0, 2)
    return blocks.crop(to_features), to_kernel.astype(kernel.dtype)
