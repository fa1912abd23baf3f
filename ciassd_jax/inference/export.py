"""Export `predict` as one portable file: voxeliser, network and NMS as StableHLO, with the weights inside."""

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
    """Serialise `predict` for clouds [batch, num_points, 4], for all given platforms at once.

    `jax.export.deserialize(bytearray(artefact)).call(points, count, frustum)` runs it without this package, and returns
    the arrays of `Detections` by name: "score", "boxes.center", "counts.points_given" and so on.
    """
    weights = jax.tree.map(jnp.asarray, variables_of(variables))
    config = config.for_inference()

    def run(points: jax.Array, count: jax.Array, frustum: jax.Array) -> dict[str, jax.Array]:
        detections = predict(weights, PointCloud(points, count), config, frustum=frustum)
        leaves, _ = jax.tree_util.tree_flatten_with_path(detections)
        return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}

    shapes = [
        jax.ShapeDtypeStruct((batch, num_points, 4), np.float32),
        jax.ShapeDtypeStruct((batch,), np.int32),
        jax.ShapeDtypeStruct((batch, *ANYWHERE.shape), np.float32),
    ]
    return bytes(export.export(jax.jit(run), platforms=list(platforms))(*shapes).serialize())


def run_exported(artefact: bytes, cloud: PointCloud, frustum: np.ndarray | None = None) -> Detections:
    """Run an exported `predict` on the current device; `frustum` [batch, 6, 4] as in `predict`."""
    planes = np.broadcast_to(ANYWHERE, (cloud.points.shape[0], *ANYWHERE.shape)) if frustum is None else frustum
    arrays = export.deserialize(bytearray(artefact)).call(cloud.points, cloud.count, planes)

    def part(prefix: str) -> dict[str, jax.Array]:
        return {name.removeprefix(prefix): leaf for name, leaf in arrays.items() if name.startswith(prefix)}

    own = {name: leaf for name, leaf in arrays.items() if "." not in name}
    return Detections(boxes=Boxes(**part("boxes.")), counts=Counts(**part("counts.")), **own)
