"""2D convolutions and their gradients beside XLA's own and loops."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from oracles import upsample_loop

from ciassd_jax.ops.convolution import convolve_2d, upsample_2d


def convolve_by_xla(x: jax.Array, kernel: jax.Array, padding, stride: int) -> jax.Array:
    dimensions = ("NHWC", "HWIO", "NHWC")
    return lax.conv_general_dilated(
        x, kernel, (stride, stride), padding, dimension_numbers=dimensions, precision=lax.Precision.HIGHEST
    )


programs = pytest.mark.parametrize("program", ["auto", "accelerator"])


@pytest.mark.smoke
@programs
@pytest.mark.parametrize(
    ("shape", "size", "padding", "stride"),
    [
        ((2, 6, 5, 3), (3, 3), ((1, 1), (1, 1)), 1),
        ((2, 6, 5, 3), (3, 3), ((1, 1), (1, 1)), 2),
        ((2, 5, 8, 3), (3, 3), ((1, 1), (1, 1)), 2),
        ((1, 4, 5, 2), (2, 1), ((0, 1), (0, 0)), 1),
        ((3, 4, 5, 2), (1, 1), ((0, 0), (0, 0)), 1),
        ((2, 7, 300, 2), (3, 3), ((1, 1), (1, 1)), 1),
        ((1, 50, 40, 2), (3, 3), ((1, 1), (1, 1)), 1),
    ],
)
def test_value_and_gradients_are_xlas(shape, size, padding, stride, program):
    """Rows of which one, several, or all fit into a block; odd and even sizes with a stride."""
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        x, kernel = jnp.array(rng.normal(size=shape)), jnp.array(rng.normal(size=(*size, shape[-1], 4)))

        def run(function, *settings):
            loss = lambda *arrays: jnp.sin(function(*arrays, padding, stride, *settings)).sum()  # noqa: E731
            return jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))(x, kernel)

        close = partial(np.testing.assert_allclose, rtol=1e-10, atol=1e-10)
        jax.tree.map(close, run(convolve_2d, program), run(convolve_by_xla))


@programs
def test_gradient_of_bfloat16_is_accumulated_in_float32(program):
    """Ten thousand cells of 1: a bfloat16 sum would stand still at 256."""
    x, kernel = jnp.ones((1, 100, 100, 1), jnp.bfloat16), jnp.ones((1, 1, 1, 1), jnp.bfloat16)
    convolve = partial(convolve_2d, padding=((0, 0), (0, 0)), program=program)
    gradient = jax.grad(lambda kernel: convolve(x, kernel).astype(jnp.float32).sum())(kernel)
    assert gradient.dtype == jnp.bfloat16
    np.testing.assert_allclose(np.float32(gradient), 1e4, rtol=1e-2)


def upsample_by_dilation(x: jax.Array, kernel: jax.Array) -> jax.Array:
    return lax.conv_general_dilated(
        x,
        kernel[::-1, ::-1],
        (1, 1),
        [(1, 2), (1, 2)],
        lhs_dilation=(2, 2),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision=lax.Precision.HIGHEST,
    )


@programs
@pytest.mark.parametrize("shape", [(2, 3, 4, 5), (1, 1, 1, 2), (1, 5, 2, 3)])
def test_upsample_is_the_transposed_convolution(shape, program):
    rng = np.random.default_rng(0)
    x, kernel = rng.normal(size=shape), rng.normal(size=(3, 3, shape[-1], 4))
    arrays = jnp.float32(x), jnp.float32(kernel)
    np.testing.assert_allclose(upsample_2d(*arrays, program), upsample_loop(x, kernel), rtol=0, atol=1e-5)

    def run(function, *settings):
        return jax.jit(jax.value_and_grad(lambda *a: jnp.sin(function(*a, *settings)).sum(), argnums=(0, 1)))(*arrays)

    close = partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-5)
    jax.tree.map(close, run(upsample_2d, program), run(upsample_by_dilation))
