"""SPConvNet: the sparse 3D encoder (paper section 3.1)."""

from __future__ import annotations

from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ciassd_jax.config import BackboneConfig
from ciassd_jax.model.backends import make_backend
from ciassd_jax.model.layers import SparseConvNormRelu
from ciassd_jax.ops import sites as site_ops
from ciassd_jax.ops.platform import Program
from ciassd_jax.ops.sites import NO_SITE, Triple, Window
from ciassd_jax.types import Sites, SparseVoxels


class SPConvNet(nn.Module):
    """Voxels to a BEV map: stages of submanifold convolutions, each but the first begun by a strided one."""

    config: BackboneConfig
    shape: Triple
    dtype: jnp.dtype
    axis_name: str | None = None
    program: Program = "auto"

    @nn.compact
    def __call__(
        self, voxels: SparseVoxels, *, train: bool
    ) -> tuple[Float[Array, "B H W C"], Int[Array, "B S"], Int[Array, "B S"]]:
        """Return the BEV map, whose channels hold the z layers, and the sites kept and dropped by strided stages."""
        layer = partial(SparseConvNormRelu, dtype=self.dtype, axis_name=self.axis_name)
        backend, shapes = make_backend(self.config.backend, self.program), self.config.stage_shapes(self.shape)
        capacities = self.config.capacities(voxels.num_points.shape[-1])
        sites = sites_of(voxels, self.shape)
        x = jnp.asarray(voxels.features).reshape(-1, voxels.features.shape[-1])
        kept, dropped = [], []
        for i, stage in enumerate(self.config.stages):
            if i > 0:
                window = Window(shapes[i - 1], shapes[i], (3, 3, 3), (2, 2, 2), (stage.z_padding, 1, 1))
                sites, convolution, lost = backend.strided(sites, window, capacities[i])
                x = layer(stage.channels, (3, 3, 3), name=f"stage{i}_down")(x, convolution, _real(sites), train=train)
                kept.append(sites.count)
                dropped.append(lost)
            convolution = backend.submanifold(sites, shapes[i])
            for j in range(stage.layers):
                x = layer(stage.channels, (3, 3, 3), name=f"stage{i}_{j}")(x, convolution, _real(sites), train=train)
        window = Window(shapes[-2], shapes[-1], (3, 1, 1), (2, 1, 1), (0, 0, 0))
        sites, convolution, lost = backend.strided(sites, window, capacities[-1])
        x = layer(self.config.out_channels, (3, 1, 1), name="out")(x, convolution, _real(sites), train=train)
        bev = fold_height(backend.to_dense(x.reshape(*sites.keys.shape, -1), sites, shapes[-1]))
        return bev, jnp.stack([*kept, sites.count], -1), jnp.stack([*dropped, lost], -1)


def sites_of(voxels: SparseVoxels, shape: Triple) -> Sites:
    real = jnp.arange(voxels.coordinates.shape[1], dtype=jnp.int32)[None] < voxels.count[:, None]
    keys = jnp.where(real, site_ops.linear_keys(voxels.coordinates, shape), NO_SITE)
    return jax.vmap(partial(site_ops.active_sites, shape=shape))(keys)


def _real(sites: Sites) -> Bool[Array, " N"]:
    """Which slots of all scenes hold a site."""
    return (sites.keys != NO_SITE).reshape(-1)


def fold_height(grid: Float[Array, "B H W Z C"]) -> Float[Array, "B H W C2"]:
    """BEV map with channel c * Z + z, as a (C, Z, H, W) tensor folds in the released code."""
    return jnp.swapaxes(grid, 3, 4).reshape(*grid.shape[:3], -1)
