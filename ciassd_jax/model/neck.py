"""SSFA, Spatial-Semantic Feature Aggregation (paper section 3.2 and Figure 3), and the baseline necks of Table 4."""

from __future__ import annotations

from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ciassd_jax.config import NeckConfig
from ciassd_jax.model.layers import ConvNormRelu, UpsampleNormRelu
from ciassd_jax.ops.platform import Program


class SSFA(nn.Module):
    """Fuse spatial and semantic BEV features by attention."""

    config: NeckConfig
    dtype: jnp.dtype
    axis_name: str | None = None
    program: Program = "auto"

    @nn.compact
    def __call__(self, bev: Float[Array, "B H W C"], *, train: bool) -> Float[Array, "B H W D"]:
        width = self.config.channels
        conv = partial(ConvNormRelu, dtype=self.dtype, axis_name=self.axis_name, program=self.program)
        upsample = partial(UpsampleNormRelu, dtype=self.dtype, axis_name=self.axis_name, program=self.program)

        spatial = bev
        for i in range(3):
            spatial = conv(width, 3, name=f"spatial_{i}")(spatial, train=train)
        semantic = conv(2 * width, 3, stride=2, name="semantic_0")(spatial, train=train)
        for i in (1, 2):
            semantic = conv(2 * width, 3, name=f"semantic_{i}")(semantic, train=train)
        spatial = conv(width, 1, name="spatial_lateral")(spatial, train=train)
        semantic = conv(2 * width, 1, name="semantic_lateral")(semantic, train=train)

        enriched = upsample(width, name="upsample_to_spatial")(semantic, train=train) + spatial
        raised = upsample(width, name="upsample_semantic")(semantic, train=train)
        enriched = conv(width, 3, name="spatial_out")(enriched, train=train)
        raised = conv(width, 3, name="semantic_out")(raised, train=train)

        attend = partial(conv, 1, self.config.attention_kernel, relu=False)
        logits = jnp.concatenate(
            [
                attend(name="spatial_attention")(enriched, train=train),
                attend(name="semantic_attention")(raised, train=train),
            ],
            -1,
        )
        weight = jax.nn.softmax(logits.astype(jnp.float32), -1).astype(self.dtype)
        return enriched * _spread(weight[..., :1], width) + raised * _spread(weight[..., 1:], width)


class ConvolutionStack(nn.Module):
    """Baseline necks of Table 4, those of SECOND and SA-SSD: a stack of convolutions of one resolution."""

    config: NeckConfig
    dtype: jnp.dtype
    axis_name: str | None = None
    program: Program = "auto"

    @nn.compact
    def __call__(self, bev: Float[Array, "B H W C"], *, train: bool) -> Float[Array, "B H W D"]:
        width = self.config.channels
        layers = [(width, 3)] * 7 if self.config.kind == "second" else [(2 * width, 3)] * 7 + [(2 * width, 1)]
        conv = partial(ConvNormRelu, dtype=self.dtype, axis_name=self.axis_name, program=self.program)
        for i, (channels, kernel_size) in enumerate(layers):
            bev = conv(channels, kernel_size, name=f"conv_{i}")(bev, train=train)
        return bev


def _spread(weight: Float[Array, "B H W 1"], channels: int) -> Float[Array, "B H W C"]:
    """Repeat the weight for every channel."""
    return jnp.matmul(weight, jnp.ones((1, channels), weight.dtype), precision=jax.lax.Precision.HIGHEST)
