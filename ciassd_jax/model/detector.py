"""The whole network: the architecture figure in code (paper Figure 2)."""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from ciassd_jax.config import Config
from ciassd_jax.model.backbone import SPConvNet
from ciassd_jax.model.head import MultiTaskHead
from ciassd_jax.model.neck import SSFA, ConvolutionStack
from ciassd_jax.types import Predictions, SparseVoxels


class CIASSD(nn.Module):
    """Voxels of a batch of scenes to raw predictions for every anchor."""

    config: Config
    axis_name: str | None = None

    @nn.compact
    def __call__(
        self, voxels: SparseVoxels, *, train: bool = False
    ) -> tuple[Predictions, Int[Array, "B S"], Int[Array, "B S"]]:
        """Predictions, and the active sites kept and dropped at each strided stage of the backbone."""
        config, dtype = self.config, jnp.dtype(self.config.dtype)
        backbone = SPConvNet(config.backbone, config.grid.shape, dtype, self.axis_name, name="backbone")
        bev, kept, dropped = backbone(voxels, train=train)
        neck = SSFA if config.neck.kind == "ssfa" else ConvolutionStack
        features = neck(config.neck, dtype, self.axis_name, name="neck")(bev, train=train)
        head = MultiTaskHead(config.head, config.anchors_per_cell, dtype, name="head")
        return head(features), kept, dropped


def init_variables(key: Array, config: Config) -> Any:
    """Fresh {"params", "batch_stats"}, initialised as in the released code; the whole tree is float32."""
    none = jnp.zeros(1, jnp.int32)
    slot = jnp.zeros((1, 1), jnp.int32)
    voxels = SparseVoxels(
        features=jnp.zeros((1, 1, 4)),
        coordinates=jnp.zeros((1, 1, 3), jnp.int32),
        num_points=slot,
        first_point=slot,
        count=none,
        dropped=none,
        points_in_range=none,
        points_dropped=none,
    )
    init = CIASSD(config).init
    if isinstance(key, jax.core.Tracer):
        return init(key, voxels)
    # Run once, so the time is in the compiler: without optimisation it takes a fifth.
    return jax.jit(init, compiler_options={"xla_backend_optimization_level": 0})(key, voxels)
