"""Points to detections: `predict` as one pure, jittable function."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from ciassd_jax import detections as post
from ciassd_jax.anchors import make_anchors
from ciassd_jax.config import Config, GridConfig
from ciassd_jax.model.detector import CIASSD
from ciassd_jax.ops import boxes as box_ops
from ciassd_jax.ops.voxelize import voxelize
from ciassd_jax.types import Array, Counts, Detections, PointCloud, Predictions, SparseVoxels, Variables


class RawPredictions(NamedTuple):
    """The network's output for a batch and what it used: the part of `predict` before post-processing."""

    predictions: Predictions
    voxels: SparseVoxels
    sites_kept: Array
    sites_dropped: Array


def voxelize_batch(cloud: PointCloud, grid: GridConfig) -> SparseVoxels:
    """Voxelise a batch of padded clouds as the config says."""
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


def predict_raw(state_or_variables: Variables, cloud: PointCloud, config: Config) -> RawPredictions:
    """Voxelise and run the network in evaluation mode; `cloud` has a leading batch axis."""
    with jax.named_scope("voxelize"):
        voxels = voxelize_batch(cloud, config.grid)
    return predict_voxels(state_or_variables, voxels, config)


def predict_voxels(state_or_variables: Variables, voxels: SparseVoxels, config: Config) -> RawPredictions:
    """Run the network in evaluation mode on a batch of voxelised scenes."""
    output: Any = CIASSD(config).apply(variables_of(state_or_variables), voxels)
    predictions, kept, dropped = output
    return RawPredictions(predictions, voxels, kept, dropped)


def postprocess(
    raw: RawPredictions, cloud: PointCloud, config: Config, *, frustum: Float[Array, "B 6 4"] | None = None
) -> Detections:
    """Decode, rectify, suppress and filter each scene of the batch on its own."""
    anchors, labels = make_anchors(config)
    low, high = config.grid.minimum, config.grid.maximum

    def one_scene(predictions: Predictions, planes: Array | None) -> tuple:
        candidates, dropped = post.select_candidates(predictions, anchors, labels, config.detection)
        kept = candidates.valid.sum(dtype=jnp.int32)
        candidates, clusters = post.suppress(candidates, config.detection, config.classes)
        result = post.finish(
            candidates,
            clusters,
            x_limits=(low[0], high[0]),
            y_limits=(low[1], high[1]),
            z_limits=config.detection.z_limits,
            frustum=planes,
        )
        return *result, kept, dropped

    with jax.named_scope("postprocess"):
        planes = None if frustum is None else jnp.asarray(frustum, jnp.float32)
        in_axes = (0, None if planes is None else 0)
        boxes, score, label, count, kept, dropped = jax.vmap(one_scene, in_axes)(raw.predictions, planes)
    # Results leave here: only now is the yaw folded to [-pi, pi).
    boxes = boxes._replace(yaw=box_ops.wrap_angle(boxes.yaw))
    voxels = raw.voxels
    counts = Counts(
        points_given=jnp.asarray(cloud.count),
        points_in_range=voxels.points_in_range,
        points_dropped=voxels.points_dropped,
        voxels_kept=voxels.count,
        voxels_dropped=voxels.dropped,
        sites_kept=raw.sites_kept,
        sites_dropped=raw.sites_dropped,
        candidates_kept=kept,
        candidates_dropped=dropped,
    )
    return Detections(boxes, score, label, count, counts)


def predict(
    state_or_variables: Variables,
    cloud: PointCloud,
    config: Config,
    *,
    frustum: Float[Array, "B 6 4"] | None = None,
) -> Detections:
    """Detect the boxes of a batch of padded clouds; pure and jittable, with `config` static.

    `state_or_variables` is a train state, or {"params": ..., "batch_stats": ...}. `cloud` holds points
    [B, P, 4] (x, y, z in metres, intensity in [0, 1]) and count [B]. `frustum` (`ops.camera.frustum_planes`,
    [B, 6, 4]) drops boxes whose centre no camera sees, as the released results do. Returns at most
    `max_candidates` boxes a scene in the order of selection; yaw lies in [-pi, pi).
    """
    return postprocess(predict_raw(state_or_variables, cloud, config), cloud, config, frustum=frustum)


def variables_of(state_or_variables: Variables) -> Variables:
    """{"params", "batch_stats"} of a train state, with the running mean where it has one, or of a dictionary."""
    if isinstance(state_or_variables, dict):
        return {name: state_or_variables[name] for name in ("params", "batch_stats")}
    state = state_or_variables
    return {"params": state.params if state.ema is None else state.ema, "batch_stats": state.batch_stats}
