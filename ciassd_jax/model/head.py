"""The multi-task head: class, box, direction and the box's own IoU (paper section 3.3)."""

from __future__ import annotations

from functools import partial

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from ciassd_jax.config import HeadConfig
from ciassd_jax.model.layers import uniform_by_fan_in
from ciassd_jax.ops.convolution import convolve_2d
from ciassd_jax.ops.platform import Program
from ciassd_jax.types import Predictions


class Branch(nn.Module):
    """One convolution with an optional bias."""

    channels: int
    kernel_size: int
    use_bias: bool
    program: Program

    @nn.compact
    def __call__(self, x: Float[Array, "B H W C"]) -> Float[Array, "B H W O"]:
        size, inputs = self.kernel_size, x.shape[-1]
        init = uniform_by_fan_in(size * size * inputs)
        kernel = self.param("kernel", init, (size, size, inputs, self.channels), jnp.float32)
        around = (size // 2, size // 2)
        x = convolve_2d(x, kernel.astype(x.dtype), (around, around), 1, self.program)
        if self.use_bias:
            x = x + self.param("bias", init, (self.channels,), jnp.float32).reshape(1, 1, 1, -1)
        return x


class MultiTaskHead(nn.Module):
    """Three or four branches on the same features; one row per anchor in the order y, x, anchor of the cell.

    Computes in `dtype`, but at least in float32: bfloat16 would round the boxes themselves.
    """

    config: HeadConfig
    anchors_per_cell: int
    dtype: jnp.dtype
    program: Program = "auto"

    @nn.compact
    def __call__(self, x: Float[Array, "B H W C"]) -> Predictions:
        anchors, batch = self.anchors_per_cell, x.shape[0]
        x = x.astype(jnp.promote_types(self.dtype, jnp.float32))
        branch = partial(Branch, program=self.program)
        box = branch(7 * anchors, 1, True, name="box")(x)
        class_logit = branch(anchors, 1, True, name="class")(x)
        direction = branch(2 * anchors, 1, True, name="direction")(x)
        iou = None
        if self.config.predict_iou:
            iou = branch(anchors, self.config.iou_kernel, self.config.iou_bias, name="iou")(x)
            iou = iou.reshape(batch, -1)
        return Predictions(
            box=box.reshape(batch, -1, 7),
            class_logit=class_logit.reshape(batch, -1),
            direction=direction.reshape(batch, -1, 2),
            iou=iou,
        )
