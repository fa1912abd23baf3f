"""Batch normalisation over the real entries of a batch, with its gradient in closed form."""

from __future__ import annotations

from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

Tree = TypeVar("Tree")


def scale_and_shift(
    x: Float[Array, "*n C"],
    scale: Float[Array, " C"],
    bias: Float[Array, " C"],
    mean: Float[Array, " C"],
    variance: Float[Array, " C"],
    *,
    epsilon: float,
) -> Float[Array, "*n C"]:
    """(x - mean) / sqrt(variance + epsilon) * scale + bias, in float32 or wider, returned in the type of x."""
    factor = scale * lax.rsqrt(variance + epsilon)
    return (x * _row(factor, x) + _row(bias - mean * factor, x)).astype(x.dtype)


def batch_norm(
    x: Float[Array, "*n C"],
    real: Bool[Array, "*n"] | None,
    scale: Float[Array, " C"],
    bias: Float[Array, " C"],
    epsilon: float,
    axis_name: str | None = None,
) -> tuple[Float[Array, "*n C"], Float[Array, " C"], Float[Array, " C"], Float[Array, ""]]:
    """Normalise x by the mean and the biased variance of its real entries. Returns (y, mean, variance, count).

    With `axis_name`, moments are pooled over that axis by the number of entries, so that every entry weighs the same on
    whatever device it is. Without any entry, mean and variance are 0. Entries that are not real are scaled and
    shifted too. Only y has a gradient: two sums and one more pass over x, half of what differentiation step by step
    takes.
    """
    if axis_name is not None:
        # Each device has its own gradient of them; the types of shard_map must show it.
        scale, bias = (values + 0 * lax.axis_index(axis_name) for values in (scale, bias))
    return _batch_norm(x, real, scale, bias, epsilon, axis_name)


@partial(jax.custom_vjp, nondiff_argnums=(4, 5))
def _batch_norm(
    x: Array, real: Array | None, scale: Array, bias: Array, epsilon: float, axis_name: str | None
) -> tuple[Array, Array, Array, Array]:
    mean, variance, count = _moments(x, real, axis_name)
    return scale_and_shift(x, scale, bias, mean, variance, epsilon=epsilon), mean, variance, count


def _moments(x: Array, real: Array | None, axis_name: str | None) -> tuple[Array, Array, Array]:
    """Mean, biased variance and number of the real entries, of all devices after one exchange."""
    count = _count(x, real)
    share = 1 / jnp.maximum(count, 1)
    mean = _real(x, real).sum(_axes(x)) * share
    # Around the mean rather than from the mean square: no cancellation.
    squares = (_real(_wide(x) - _row(mean, x), real) ** 2).sum(_axes(x))
    if axis_name is not None:
        own = jnp.concatenate([mean, squares, count[None]])
        # A sum in which every device has a row of its own is a gather whose result shard_map knows to be replicated.
        rows = jnp.zeros((lax.axis_size(axis_name), own.size), own.dtype).at[lax.axis_index(axis_name)].set(own)
        means, squares, counts = jnp.split(lax.psum(rows, axis_name), (len(mean), 2 * len(mean)), axis=1)
        count = counts.sum()
        share = 1 / jnp.maximum(count, 1)
        mean = (counts * means).sum(0) * share
        squares = (squares + counts * (means - mean[None]) ** 2).sum(0)
    return mean, squares * share, count


def _forward(x: Array, real: Array | None, scale: Array, bias: Array, epsilon: float, axis_name: str | None):  # type: ignore[no-untyped-def]
    results = _batch_norm.fun(x, real, scale, bias, epsilon, axis_name)
    return results, (x, real, scale, *results[1:])


def _backward(epsilon: float, axis_name: str | None, saved: tuple, gradients: tuple):  # type: ignore[no-untyped-def]
    x, real, scale, mean, variance, count = saved
    inverse = lax.rsqrt(variance + epsilon)
    # Passes over x are cheap, copies of it are not. Without the barriers XLA would keep x - mean from the forward pass,
    # and the gradient behind a ReLU from one pass to the next.
    x, mean = lax.optimization_barrier((x, mean))
    gradient = gradients[0]
    to_bias = _wide(gradient).sum(_axes(x))
    along = (_wide(gradient) * (_wide(x) - _row(mean, x))).sum(_axes(x))
    pooled_bias, pooled_along = _pooled((to_bias, along), axis_name)
    # Mean and variance depend on the entries of all devices.
    share = 1 / jnp.maximum(count, 1)
    drift, slope = pooled_bias * share, pooled_along * inverse**2 * share
    gradient, x, mean = lax.optimization_barrier((gradient, x, mean))
    moved = _real(_row(drift, x) + (_wide(x) - _row(mean, x)) * _row(slope, x), real)
    to_x = (_wide(gradient) - moved) * _row(scale * inverse, x)
    return to_x.astype(x.dtype), None, along * inverse, to_bias


_batch_norm.defvjp(_forward, _backward)


def _axes(x: Array) -> tuple[int, ...]:
    return tuple(range(x.ndim - 1))


def _row(values: Array, x: Array) -> Array:
    return values.reshape((1,) * (x.ndim - 1) + (-1,))


def _wide(x: Array) -> Array:
    return x.astype(jnp.promote_types(x.dtype, jnp.float32))


def _real(x: Array, real: Array | None) -> Array:
    return _wide(x) if real is None else jnp.where(real[..., None], _wide(x), 0)


def _count(x: Array, real: Array | None) -> Array:
    dtype = jnp.promote_types(x.dtype, jnp.float32)
    return jnp.asarray(x.size // x.shape[-1], dtype) if real is None else real.sum(dtype=dtype)


def _pooled(sums: Tree, axis_name: str | None) -> Tree:
    return sums if axis_name is None else lax.psum(sums, axis_name)
