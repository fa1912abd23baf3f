"""One portable artefact of the whole of `predict`: voxeliser, network and NMS as StableHLO with its weights."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from ciassd_jax.config import Config
from ciassd_jax.inference.predict import predict
from ciassd_jax.model.network import variables_of
from ciassd_jax.ops.camera import ANYWHERE
from ciassd_jax.types import Boxes, Counts, Detections, PointCloud, Variables

PLATFORMS = ("cpu", "cuda", "tpu")


def export_predict(
    variables: Variables, config: Config, *, num_points: int, batch: int = 1, platforms: Sequence[str] = PLATFORMS
) -> bytes:
    """Serialise `predict` for clouds [batch, num_points, 4], with the weights inside, for all platforms at once."""
    weights = jax.tree.map(jnp.asarray, variables_of(variables))

    def run(points: jax.Array, count: jax.Array, frustum: jax.Array) -> list[jax.Array]:
        return jax.tree.leaves(predict(weights, PointCloud(points, count), config, frustum=frustum))

    shapes = [
        jax.ShapeDtypeStruct((batch, num_points, 4), np.float32),
        jax.ShapeDtypeStruct((batch,), np.int32),
        jax.ShapeDtypeStruct((batch, *ANYWHERE.shape), np.float32),
    ]
    return bytes(export.export(jax.jit(run), platforms=list(platforms))(*shapes).serialize())


def run_exported(artefact: bytes, cloud: PointCloud, frustum: np.ndarray | None = None) -> Detections:
    """Run a serialised `predict` on the current device; `frustum` [batch, 6, 4] as in `predict`."""
    batch = cloud.points.shape[0]
    planes = np.broadcast_to(ANYWHERE, (batch, *ANYWHERE.shape)) if frustum is None else frustum
    leaves = export.deserialize(bytearray(artefact)).call(cloud.points, cloud.count, planes)
    boxes, rest = Boxes(*leaves[:3]), leaves[3:]
    return Detections(boxes, rest[0], rest[1], rest[2], Counts(*rest[3:]))
