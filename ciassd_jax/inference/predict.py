"""Points to detections: `predict` as one pure, jittable function."""

from __future__ import annotations

from functools import lru_cache, partial

import jax
import numpy as np
from jaxtyping import Float

from ciassd_jax.config import Config
from ciassd_jax.inference.postprocess import postprocess
from ciassd_jax.model.network import init_variables, predict_raw
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

    `state_or_variables` is a train state, or {"params": ..., "batch_stats": ...}. `cloud` holds points [B, P, 4] (x, y,
    z in metres, intensity in [0, 1]) and count [B]. `frustum` (`ops.camera.frustum_planes`) drops boxes whose centre is
    outside the camera's view, as the released code does. Return at most `config.detection.max_candidates` boxes per
    scene, in the order of selection, with yaw in [-pi, pi).
    """
    return postprocess(predict_raw(state_or_variables, cloud, config), config, frustum=frustum)


@lru_cache
def compile_predict(config: Config, num_points: int) -> jax.stages.Compiled:
    """Compile `predict` for one cloud [1, num_points, 4] with a frustum: a function of (variables, cloud, frustum=...).

    Programs are kept and shared by all callers of an equal config; pass `config.for_inference()`.
    """
    variables = jax.eval_shape(partial(init_variables, config=config), jax.random.key(0))
    cloud = PointCloud(np.zeros((1, num_points, 4), np.float32), np.zeros(1, np.int32))
    return jax.jit(partial(predict, config=config)).lower(variables, cloud, frustum=ANYWHERE[None]).compile()
