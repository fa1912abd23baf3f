"""2D convolutions of BEV maps [B, H, W, C], in full float32 precision on every device."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ciassd_jax.ops.platform import Program, by_platform

Padding = tuple[tuple[int, int], tuple[int, int]]

# Cells that a CPU multiplies at once for the gradient of a kernel: they must stay in cache.
_BLOCK_CELLS = 900
# Blocks of a smaller map would cost more compilation than they save.
_FEW_CELLS = 4096


@partial(jax.custom_vjp, nondiff_argnums=(2, 3, 4))
def convolve_2d(
    x: Float[Array, "B H W C"],
    kernel: Float[Array, "Y X C O"],
    padding: Padding,
    stride: int = 1,
    program: Program = "auto",
) -> Float[Array, "B H2 W2 O"]:
    """Cross-correlate with explicit zero padding.

    On a CPU the gradient of the kernel is a sum of blocked matrix products: XLA's own convolution takes 2.5 times as
    long.
    """
    if kernel.shape[:2] == (1, 1) and stride == 1:
        # A matrix product of the same sums takes a CPU less than half the time.
        return jnp.matmul(x, kernel[0, 0], precision=lax.Precision.HIGHEST)
    return lax.conv_general_dilated(
        x,
        kernel,
        (stride, stride),
        padding,
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision=lax.Precision.HIGHEST,
    )


def _forward(
    x: Array, kernel: Array, padding: Padding, stride: int, program: Program
) -> tuple[Array, tuple[Array, Array]]:
    return convolve_2d.fun(x, kernel, padding, stride), (x, kernel)


def _backward(
    padding: Padding, stride: int, program: Program, saved: tuple[Array, Array], gradient: Array
) -> tuple[Array, Array]:
    x, kernel = saved
    (to_x,) = jax.linear_transpose(lambda x: convolve_2d.fun(x, kernel, padding, stride), x)(gradient)
    return to_x, _kernel_gradients(x, gradient, kernel, padding, stride, program)


convolve_2d.defvjp(_forward, _backward)


def _kernel_gradients(
    x: Array, gradient: Array, kernel: Array, padding: Padding, stride: int, program: Program
) -> Array:
    """Gradient of the kernel of a convolution of x, from that of its result."""

    def whole(x: Array, gradient: Array) -> Array:
        convolve = partial(convolve_2d.fun, x, padding=padding, stride=stride)
        (to_kernel,) = jax.linear_transpose(convolve, kernel)(gradient)
        return to_kernel

    if gradient.shape[0] * gradient.shape[1] * gradient.shape[2] <= _FEW_CELLS:
        return whole(x, gradient)
    size = (kernel.shape[0], kernel.shape[1])
    blocked = partial(_blocked_kernel_gradient, size=size, padding=padding, stride=stride)
    return by_platform(program, x, gradient, cpu=blocked, accelerator=whole)


def _blocked_kernel_gradient(
    x: Array, gradient: Array, *, size: tuple[int, int], padding: Padding, stride: int
) -> Array:
    """For each tap (i, j) the sum over cells of x[b, stride r + i, stride q + j]^T gradient[b, r, q]."""
    batch, height, width, out = gradient.shape
    taps = size[0] * size[1]
    channels, accumulator = x.shape[-1], jnp.promote_types(x.dtype, jnp.float32)
    rows = max(n for n in range(1, height + 1) if height % n == 0 and (n == 1 or n * batch * width <= _BLOCK_CELLS))
    x = jnp.pad(x, ((0, 0), *padding, (0, 0)))
    spans = (batch, (rows - 1) * stride + 1, (width - 1) * stride + 1, channels)

    def accumulate(block: Array, total: Array) -> Array:
        part = lax.dynamic_slice_in_dim(gradient, block * rows, rows, axis=1).reshape(-1, out)

        def add_tap(tap: Array, total: Array) -> Array:
            i = lax.div(tap, size[1])
            start = (0, block * rows * stride + i, tap - i * size[1], 0)
            cells = lax.dynamic_slice(x, start, spans)[:, ::stride, ::stride].reshape(-1, channels)
            product = jnp.matmul(cells.T, part, precision=lax.Precision.HIGHEST, preferred_element_type=accumulator)
            return total.at[tap].add(product)

        return lax.fori_loop(0, taps, add_tap, total)

    zero = jnp.zeros((taps, channels, out), accumulator)
    total = lax.fori_loop(0, height // rows, accumulate, zero)
    return total.reshape(*size, channels, out).astype(x.dtype)


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def upsample_2d(
    x: Float[Array, "B H W C"], kernel: Float[Array, "3 3 C O"], program: Program = "auto"
) -> Float[Array, "B H2 W2 O"]:
    """Transposed convolution of stride 2, padding 1, output padding 1: out[2i - 1 + k] += in[i] * kernel[k] per axis.

    The backward pass is the strided convolution that this transposes.
    """
    return jnp.asarray(by_platform(program, x, kernel, cpu=_upsample_by_phases, accelerator=_upsample_dilated))


def _upsample_dilated(x: Array, kernel: Array) -> Array:
    return lax.conv_general_dilated(
        x,
        kernel[::-1, ::-1],
        (1, 1),
        ((1, 2), (1, 2)),
        lhs_dilation=(2, 2),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision=lax.Precision.HIGHEST,
    )


def _upsample_by_phases(x: Array, kernel: Array) -> Array:
    """Four convolutions: an even output row reads the middle tap alone, an odd one the outer two."""
    taps = (slice(1, 2), slice(2, None, -2))

    def phase(odd_y: int, odd_x: int) -> Array:
        return convolve_2d.fun(x, kernel[taps[odd_y], taps[odd_x]], ((0, odd_y), (0, odd_x)), 1)

    rows = [jnp.stack([phase(y, 0), phase(y, 1)], 3) for y in (0, 1)]
    batch, height, width, _ = x.shape
    return jnp.stack(rows, 2).reshape(batch, 2 * height, 2 * width, -1)


def _upsample_forward(x: Array, kernel: Array, program: Program) -> tuple[Array, tuple[Array, Array]]:
    return upsample_2d(x, kernel, program), (x, kernel)


def _upsample_backward(program: Program, saved: tuple[Array, Array], gradient: Array) -> tuple[Array, Array]:
    x, kernel = saved
    padding, transposed = ((1, 0), (1, 0)), jnp.swapaxes(kernel, 2, 3)
    to_kernel = _kernel_gradients(gradient, x, transposed, padding, 2, program)
    return convolve_2d.fun(gradient, transposed, padding, 2), jnp.swapaxes(to_kernel, 2, 3)


upsample_2d.defvjp(_upsample_forward, _upsample_backward)
