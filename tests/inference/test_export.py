"""One artefact for all platforms: it lowers for each and runs here from its bytes."""

import jax
import numpy as np
from jax import export
from small import random_variables, small_cloud, small_config

from ciassd_jax.inference.export import PLATFORMS, export_predict, run_exported
from ciassd_jax.inference.predict import predict
from ciassd_jax.types import PointCloud


def test_artefact_runs_from_its_bytes() -> None:
    config = small_config()
    variables = random_variables(config)
    points = np.stack([small_cloud(seed, 500) for seed in range(2)])
    cloud = PointCloud(points, np.array([500, 123], np.int32))
    artefact = export_predict(variables, config, num_points=500, batch=2)
    assert export.deserialize(bytearray(artefact)).platforms == PLATFORMS
    expected = jax.jit(predict, static_argnames="config")(variables, cloud, config)
    result = run_exported(artefact, cloud)
    assert int(expected.count.sum()) > 0
    for mine, theirs in zip(jax.tree.leaves(result), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-5)
