"""Layers of the network: BatchNorm over real entries only, and convolutions followed by BatchNorm and ReLU."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ciassd_jax.ops.convolution import convolve_2d, upsample_2d
from ciassd_jax.ops.normalization import batch_norm, scale_and_shift
from ciassd_jax.ops.platform import Program

Initializer = Callable[..., Array]
# A sparse convolution: (features [B * U, C], kernel [K, C, O]) to features [B * V, O], scene after scene.
Convolution = Callable[[Array, Array], Array]

EPSILON = 1e-3
MOMENTUM = 0.99


def uniform_by_fan_in(fan_in: int) -> Initializer:
    """Return an initializer U(-1 / sqrt(fan_in), 1 / sqrt(fan_in)), as in the released code."""
    bound = 1 / math.sqrt(fan_in)

    def init(key: Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> Array:
        return jax.random.uniform(key, shape, dtype, -bound, bound)

    return init


class MaskedBatchNorm(nn.Module):
    """BatchNorm over the real entries of the whole batch, pooled over all devices if `axis_name` is given.

    Statistics are float32 or wider. An empty device or batch stays finite; an empty batch leaves the running statistics
    unchanged.
    """

    axis_name: str | None = None

    @nn.compact
    def __call__(
        self, x: Float[Array, "*n C"], mask: Bool[Array, "*n"] | None = None, *, train: bool = False
    ) -> Float[Array, "*n C"]:
        channels = x.shape[-1]
        scale = self.param("scale", nn.initializers.ones, (channels,), jnp.float32)
        bias = self.param("bias", nn.initializers.zeros, (channels,), jnp.float32)
        mean = self.variable("batch_stats", "mean", jnp.zeros, (channels,), jnp.float32)
        variance = self.variable("batch_stats", "var", jnp.ones, (channels,), jnp.float32)
        if not train:
            return scale_and_shift(x, scale, bias, mean.value, variance.value, epsilon=EPSILON)
        result, *moments, count = batch_norm(x, mask, scale, bias, EPSILON, self.axis_name)
        if not self.is_initializing():
            for running, new in zip((mean, variance), moments, strict=True):
                updated = MOMENTUM * running.value + (1 - MOMENTUM) * new
                running.value = jnp.where(count == 0, running.value, updated)
        return result


class SparseConvNormRelu(nn.Module):
    """A sparse convolution without bias, BatchNorm over the active sites, ReLU; padding rows stay zero.

    `convolution` maps (features, kernel [K, C, O]) to features at the output sites, of which `mask` are real.
    """

    channels: int
    kernel_size: tuple[int, int, int]
    dtype: jnp.dtype
    axis_name: str | None = None

    @nn.compact
    def __call__(
        self, features: Float[Array, "U C"], convolution: Convolution, mask: Bool[Array, " V"], *, train: bool
    ) -> Float[Array, "V O"]:
        depth, height, width = self.kernel_size
        inputs = features.shape[-1]
        # spconv 1.x takes kH * kW * C * O for the fan-in. BatchNorm follows, so that only step sizes are affected.
        init = uniform_by_fan_in(height * width * inputs * self.channels)
        kernel = self.param("kernel", init, (depth, height, width, inputs, self.channels), jnp.float32)
        kernel = kernel.reshape(-1, inputs, self.channels).astype(self.dtype)
        x = convolution(features.astype(self.dtype), kernel)
        x = MaskedBatchNorm(self.axis_name, name="norm")(x, mask, train=train)
        return jnp.where(mask[:, None], nn.relu(x), 0)


class ConvNormRelu(nn.Module):
    """A 2D convolution without bias on [B, H, W, C], BatchNorm, and ReLU if `relu`."""

    channels: int
    kernel_size: int
    dtype: jnp.dtype
    stride: int = 1
    relu: bool = True
    axis_name: str | None = None
    program: Program = "auto"

    @nn.compact
    def __call__(self, x: Float[Array, "B H W C"], *, train: bool) -> Float[Array, "B H2 W2 O"]:
        size, inputs = self.kernel_size, x.shape[-1]
        shape = (size, size, inputs, self.channels)
        kernel = self.param("kernel", uniform_by_fan_in(size * size * inputs), shape, jnp.float32)
        around = (size // 2, size // 2)
        x = convolve_2d(x.astype(self.dtype), kernel.astype(self.dtype), (around, around), self.stride, self.program)
        x = MaskedBatchNorm(self.axis_name, name="norm")(x, train=train)
        return nn.relu(x) if self.relu else x


class UpsampleNormRelu(nn.Module):
    """Transposed 3 x 3 convolution of stride 2 that doubles H and W, BatchNorm, ReLU."""

    channels: int
    dtype: jnp.dtype
    axis_name: str | None = None
    program: Program = "auto"

    @nn.compact
    def __call__(self, x: Float[Array, "B H W C"], *, train: bool) -> Float[Array, "B H2 W2 O"]:
        inputs = x.shape[-1]
        shape = (3, 3, inputs, self.channels)
        # torch takes the fan-in of a transposed convolution from its output channels.
        kernel = self.param("kernel", uniform_by_fan_in(9 * self.channels), shape, jnp.float32)
        x = upsample_2d(x.astype(self.dtype), kernel.astype(self.dtype), self.program)
        return nn.relu(MaskedBatchNorm(self.axis_name, name="norm")(x, train=train))
