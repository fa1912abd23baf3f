"""Points to detections: `predict` as one pure, jittable function."""

from __future__ import annotations

from functools import lru_cache, partial

import jax
import numpy as np
from jaxtyping import Float

from ciassd_jax.config import Config
from ciassd_jax.inference.postprocess import postprocess
from ciassd_jax.inference.programs import compile_program, for_this_backend
from ciassd_jax.model.checks import check_cloud
from ciassd_jax.model.network import predict_raw, variable_shapes
from ciassd_jax.ops.camera import ANYWHERE
from ciassd_jax.types import Array, Detections, PointCloud, Variables


def predict(
    state_or_variables: Variables,
    cloud: PointCloud,
    config: Config,
    *,
    frustum: Float[Array, "B 6 4"] | None = None,
) -> Detections:
    """Detect objects in a batch of padded clouds. Pure; under `jax.jit` the config is static.

    `state_or_variables` is a train state, or a mapping {"params": ..., "batch_stats": ...} such as
    `load_weights(...).variables`. `cloud` holds float32 points [B, P, 4] (x, y, z in metres, intensity in [0, 1]) and
    count [B]. `frustum` (`ops.camera.frustum_planes`) drops boxes whose centre is outside the camera's view, as the
    released code does. Return at most `config.detection.max_candidates` boxes per scene, in the order of selection,
    with yaw in [-pi, pi). Raises ValueError for arguments of another shape or type; under `jax.jit` it does so while
    it is traced.
    """
    check_cloud(cloud, frustum)
    return postprocess(predict_raw(state_or_variables, cloud, config), config, frustum=frustum)


@lru_cache
def compile_predict(config: Config, num_points: int, batch: int = 1) -> jax.stages.Compiled:
    """Compile `predict` for clouds [batch, num_points, 4] with frustums: a function of (variables, cloud, frustum=...).

    Programs are kept and shared by all callers of an equal config; pass `config.for_inference()`.
    """
    variables = variable_shapes(config)
    cloud = PointCloud(np.zeros((batch, num_points, 4), np.float32), np.zeros(batch, np.int32))
    scenes = "1 scene" if batch == 1 else f"{batch} scenes"
    return compile_program(
        jax.jit(partial(predict, config=for_this_backend(config))),
        variables,
        cloud,
        frustum=np.broadcast_to(ANYWHERE, (batch, *ANYWHERE.shape)),
        what=f"predict for {scenes} of {num_points} points",
    )
