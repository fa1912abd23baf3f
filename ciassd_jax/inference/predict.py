"""Points to detections: `predict` as one pure, jittable function."""

from __future__ import annotations

from jaxtyping import Float

from ciassd_jax.config import Config
from ciassd_jax.inference.postprocess import postprocess
from ciassd_jax.model.network import predict_raw
from ciassd_jax.types import Array, Detections, PointCloud, Variables


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
