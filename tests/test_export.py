"""One artefact for all platforms: it lowers for each and runs here from its bytes."""

from dataclasses import replace

import jax
import numpy as np
from jax import export

from ciassd_jax.export import PLATFORMS, export_predict, run_exported
from ciassd_jax.model.detector import init_variables
from ciassd_jax.prediction import predict
from ciassd_jax.presets import tiny
from ciassd_jax.types import PointCloud


def test_artefact_runs_from_its_bytes() -> None:
    config = replace(tiny(), detection=replace(tiny().detection, nms="rotated"))  # Finds boxes even untrained.
    variables = init_variables(jax.random.key(0), config)
    rng = np.random.default_rng(0)
    points = rng.uniform((0, -6.4, -3, 0), (12.8, 6.4, 1, 1), (2, 500, 4)).astype(np.float32)
    cloud = PointCloud(points, np.array([500, 123], np.int32))
    artefact = export_predict(variables, config, num_points=500, batch=2)
    assert export.deserialize(bytearray(artefact)).platforms == PLATFORMS
    expected = jax.jit(predict, static_argnames="config")(variables, cloud, config)
    result = run_exported(artefact, cloud)
    assert int(expected.count.sum()) > 0
    for mine, theirs in zip(jax.tree.leaves(result), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-5)
