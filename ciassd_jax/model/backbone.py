"""SPConvNet: the sparse 3D encoder (paper section 3.1, SPEC section 4)."""

from __future__ import annotations

from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ciassd_jax.config import BackboneConfig
from ciassd_jax.model.layers import Convolution, SparseConvNormRelu
from ciassd_jax.ops import sites as site_ops
from ciassd_jax.ops import sparse, sparse_dense
from ciassd_jax.ops.sites import NO_SITE, Triple
from ciassd_jax.types import Sites, SparseVoxels


class SPConvNet(nn.Module):
    """Voxels to a BEV map: stages of submanifold convolutions with a strided one before each but the first."""

    config: BackboneConfig
    shape: Triple
    dtype: jnp.dtype
    axis_name: str | None = None

    @nn.compact
    def __call__(
        self, voxels: SparseVoxels, *, train: bool
    ) -> tuple[Float[Array, "B H W C"], Int[Array, "B S"], Int[Array, "B S"]]:
        """The BEV map (z layers folded into the channels), and sites kept and dropped at each strided stage."""
        layer = partial(SparseConvNormRelu, dtype=self.dtype, axis_name=self.axis_name)
        shapes = self.config.stage_shapes(self.shape)
        capacities = self.config.capacities(voxels.num_points.shape[-1])
        sites = _sites_of(voxels, self.shape, self.config.backend)
        x = jnp.asarray(voxels.features).reshape(-1, voxels.features.shape[-1])
        kept, dropped = [], []
        for i, stage in enumerate(self.config.stages):
            if i > 0:
                step = _Strided(shapes[i - 1], shapes[i], (3, 3, 3), (2, 2, 2), (stage.z_padding, 1, 1))
                sites, convolution, lost = step.plan(sites, capacities[i], self.config.backend)
                x = layer(stage.channels, (3, 3, 3), name=f"stage{i}_down")(x, convolution, _real(sites), train=train)
                kept.append(sites.count)
                dropped.append(lost)
            convolution = _submanifold(sites, shapes[i], self.config.backend)
            for j in range(stage.layers):
                x = layer(stage.channels, (3, 3, 3), name=f"stage{i}_{j}")(x, convolution, _real(sites), train=train)
        step = _Strided(shapes[-2], shapes[-1], (3, 1, 1), (2, 1, 1), (0, 0, 0))
        sites, convolution, lost = step.plan(sites, capacities[-1], self.config.backend)
        x = layer(self.config.out_channels, (3, 1, 1), name="out")(x, convolution, _real(sites), train=train)
        bev = _fold_height(x.reshape(*sites.keys.shape, -1), sites, shapes[-1])
        return bev, jnp.stack([*kept, sites.count], -1), jnp.stack([*dropped, lost], -1)


class _Strided:
    """Geometry of one strided convolution."""

    def __init__(self, shape: Triple, out_shape: Triple, kernel: Triple, stride: Triple, padding: Triple) -> None:
        self.geometry: dict[str, Any] = {"shape": shape, "out_shape": out_shape, "stride": stride, "padding": padding}
        self.kernel = kernel

    def plan(self, sites: Sites, capacity: int, backend: str) -> tuple[Sites, Convolution, Int[Array, " B"]]:
        """Sites after the convolution, the convolution itself, and how many sites were over capacity."""
        geometry, kernel = self.geometry, self.kernel
        find = (site_ops if backend == "gather" else sparse_dense).strided_sites
        out_sites, dropped = jax.vmap(partial(find, kernel=kernel, capacity=capacity, **geometry))(sites)
        if backend == "gather":
            table = jax.vmap(lambda a, b: sparse.strided_table(a, b, kernel=kernel, **geometry))(sites, out_sites)
            return out_sites, _gather(sparse.flatten_scenes(table)), dropped
        return out_sites, _dense(sites, out_sites, kernel_size=kernel, **geometry), dropped


def _submanifold(sites: Sites, shape: Triple, backend: str) -> Convolution:
    """A 3 x 3 x 3 convolution whose output sites are its input sites."""
    if backend == "gather":
        table = jax.vmap(partial(sparse.submanifold_table, shape=shape))(sites)
        return _gather(sparse.flatten_scenes(table))
    return _dense(
        sites, sites, shape=shape, out_shape=shape, kernel_size=(3, 3, 3), stride=(1, 1, 1), padding=(1, 1, 1)
    )


def _gather(table: sparse.NeighbourTable) -> Convolution:
    return lambda features, kernel: sparse.convolve(features, table, kernel)


def _dense(sites: Sites, out_sites: Sites, **geometry: Any) -> Convolution:
    """The dense definition, on rows of all scenes like the gather backend."""

    def convolution(features: Array, kernel: Array) -> Array:
        scenes = features.reshape(*sites.keys.shape, -1)
        one = lambda f, s, o: sparse_dense.convolve(f, s, o, kernel, **geometry)  # noqa: E731
        result = jax.vmap(one)(scenes, sites, out_sites)
        return jnp.asarray(result).reshape(-1, kernel.shape[-1])

    return convolution


def _sites_of(voxels: SparseVoxels, shape: Triple, backend: str) -> Sites:
    real = jnp.arange(voxels.coordinates.shape[1], dtype=jnp.int32)[None] < voxels.count[:, None]
    keys = jnp.where(real, site_ops.linear_keys(voxels.coordinates, shape), NO_SITE)
    return (
        jax.vmap(partial(site_ops.active_sites, shape=shape))(keys)
        if backend == "gather"
        else Sites(keys, voxels.count)
    )


def _real(sites: Sites) -> Array:
    return (sites.keys != NO_SITE).reshape(-1)


def _fold_height(features: Float[Array, "B V C"], sites: Sites, shape: Triple) -> Float[Array, "B H W C2"]:
    """Dense BEV map with channel c * Z + z, as a (C, Z, H, W) tensor folds in the released code."""
    grid = jnp.asarray(jax.vmap(partial(site_ops.to_dense, shape=shape))(features, sites))
    depth, height, width = shape
    return grid.transpose(0, 2, 3, 4, 1).reshape(-1, height, width, features.shape[-1] * depth)
