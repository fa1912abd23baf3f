"""The whole network: the architecture figure in code (paper Figure 2)."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ciassd_jax.config import Config
from ciassd_jax.model.backbone import SPConvNet
from ciassd_jax.model.checks import check_cloud, check_variables, variables_of
from ciassd_jax.model.head import MultiTaskHead
from ciassd_jax.model.neck import SSFA, ConvolutionStack
from ciassd_jax.ops.voxelize import voxelize
from ciassd_jax.types import PointCloud, Predictions, SparseVoxels, Variables


class NetworkOutput(NamedTuple):
    """Raw predictions for every anchor, the BEV features that they come from, and the sites of each strided stage."""

    predictions: Predictions
    features: Float[Array, "B H W C"]
    sites_kept: Int[Array, "B S"]
    sites_dropped: Int[Array, "B S"]


class CIASSD(nn.Module):
    """Voxels of a batch of scenes to raw predictions for every anchor."""

    config: Config
    axis_name: str | None = None

    @nn.compact
    def __call__(self, voxels: SparseVoxels, *, train: bool = False) -> NetworkOutput:
        config, dtype = self.config, jnp.dtype(self.config.dtype)
        how: dict[str, Any] = {"dtype": dtype, "axis_name": self.axis_name, "program": config.program}
        backbone = SPConvNet(config.backbone, config.grid.shape, **how, name="backbone")
        bev, kept, dropped = backbone(voxels, train=train)
        neck = SSFA if config.neck.kind == "ssfa" else ConvolutionStack
        features = neck(config.neck, **how, name="neck")(bev, train=train)
        head = MultiTaskHead(config.head, config.anchors_per_cell, dtype, config.program, name="head")
        return NetworkOutput(head(features), features, kept, dropped)


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
        points_given=none,
        points_in_range=none,
        points_dropped=none,
    )
    # Parameters depend neither on the backend nor on the compute type, and the dense backend is traced at once.
    dense = replace(config, backbone=replace(config.backbone, backend="dense"), dtype="float32")
    init = CIASSD(dense).init
    if isinstance(key, jax.core.Tracer):
        return init(key, voxels)
    # Run once, so the time is in the compiler: without optimisation it takes a fifth.
    return jax.jit(init, compiler_options={"xla_backend_optimization_level": 0})(key, voxels)


@cache
def variable_shapes(config: Config) -> Any:
    """Shapes and types of {"params", "batch_stats"}; nothing is computed."""
    shapes = jax.eval_shape(lambda: init_variables(jax.random.key(0), config))
    # Without the mesh of the `shard_map` in which the first call may be traced.
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), shapes)


class RawPredictions(NamedTuple):
    """The network's output for a batch and what it used: the part of `predict` before post-processing."""

    predictions: Predictions
    voxels: SparseVoxels
    sites_kept: Array
    sites_dropped: Array


def voxelize_batch(cloud: PointCloud, config: Config) -> SparseVoxels:
    """Voxelise a batch of padded clouds; voxels and their features have the scale and height of `config.input`.

    Raises ValueError for clouds of another shape or type.
    """
    check_cloud(cloud)
    grid, scale, shift = config.grid, config.input.intensity_scale, config.input.z_shift
    if (scale, shift) != (1, 0):
        factor, offset = jnp.array([1, 1, 1, 1 / scale], jnp.float32), jnp.array([0, 0, shift, 0], jnp.float32)
        cloud = cloud._replace(points=cloud.points * factor[None, None] + offset[None, None])
    return jax.vmap(
        partial(
            voxelize,
            minimum=grid.minimum,
            voxel_size=grid.voxel_size,
            cells=grid.cells,
            shape=grid.shape,
            max_points=grid.max_points_per_voxel,
            max_voxels=grid.max_voxels,
            overflow=grid.overflow,
        )
    )(cloud)


def predict_features(state_or_variables: Variables, cloud: PointCloud, config: Config) -> Float[Array, "B H W C"]:
    """Return the BEV features of a batch of padded clouds: the output of the neck, which the head reads.

    Pure; under `jax.jit` the config is static. Arguments are those of `predict`. Cell (h, w) is centred at
    x = minimum + (w + 1/2) * cell, y likewise with h, where a cell has `config.backbone.stride` voxels.
    """
    variables = fitting_variables(state_or_variables, config)
    output: Any = CIASSD(config).apply(variables, voxelize_batch(cloud, config))
    return output.features


def predict_raw(state_or_variables: Variables, cloud: PointCloud, config: Config) -> RawPredictions:
    """Voxelise and run the network in evaluation mode; `cloud` has a leading batch axis."""
    with jax.named_scope("voxelize"):
        voxels = voxelize_batch(cloud, config)
    return predict_voxels(state_or_variables, voxels, config)


def predict_voxels(state_or_variables: Variables, voxels: SparseVoxels, config: Config) -> RawPredictions:
    """Run the network in evaluation mode on a batch of voxelised scenes."""
    output: Any = CIASSD(config).apply(fitting_variables(state_or_variables, config), voxels)
    return RawPredictions(output.predictions, voxels, output.sites_kept, output.sites_dropped)


def fitting_variables(state_or_variables: Variables, config: Config) -> dict[str, Any]:
    """Return {"params", "batch_stats"} of a train state or mapping; raises ValueError unless they fit the config."""
    variables = variables_of(state_or_variables)
    check_variables(variables, variable_shapes(replace(config.for_inference(), program="auto")))
    return variables
