"""One artefact for all platforms: it lowers for each and runs here from its bytes."""

import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from jax import export
from small import random_variables, small_cloud, small_config

from ciassd_jax.inference.export import PLATFORMS, export_predict, run_exported
from ciassd_jax.inference.predict import predict
from ciassd_jax.ops.camera import ANYWHERE
from ciassd_jax.types import Detections, PointCloud

# JAX alone: the package is not imported.
RUN = """
import sys
import numpy as np
from jax import export

artefact, given, found = sys.argv[1:]
with open(artefact, "rb") as file, np.load(given) as arrays:
    result = export.deserialize(bytearray(file.read())).call(arrays["points"], arrays["count"], arrays["frustum"])
assert "ciassd_jax" not in sys.modules
np.savez(found, **result)
"""


@pytest.fixture(scope="module")
def cloud() -> PointCloud:
    points = np.stack([small_cloud(seed, 500) for seed in range(2)])
    return PointCloud(points, np.array([500, 123], np.int32))


@pytest.fixture(scope="module")
def artefact() -> bytes:
    return export_predict(random_variables(small_config()), small_config(), num_points=500, batch=2)


@pytest.fixture(scope="module")
def expected(cloud: PointCloud) -> Detections:
    result = jax.jit(predict)(random_variables(small_config()), cloud, small_config())
    assert int(result.count.sum()) > 0
    return result


@pytest.mark.smoke
def test_artefact_runs_from_its_bytes(artefact: bytes, cloud: PointCloud, expected: Detections) -> None:
    assert export.deserialize(bytearray(artefact)).platforms == PLATFORMS
    result = run_exported(artefact, cloud)
    assert jax.tree.structure(result) == jax.tree.structure(expected)
    for mine, theirs in zip(jax.tree.leaves(result), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-5)


def test_artefact_runs_without_the_package(
    artefact: bytes, cloud: PointCloud, expected: Detections, tmp_path: Path
) -> None:
    (tmp_path / "predict.bin").write_bytes(artefact)
    frustum = np.broadcast_to(ANYWHERE, (2, *ANYWHERE.shape))
    np.savez(tmp_path / "given.npz", points=cloud.points, count=cloud.count, frustum=frustum)
    paths = (tmp_path / name for name in ("predict.bin", "given.npz", "found.npz"))
    subprocess.run([sys.executable, "-c", RUN, *map(str, paths)], check=True)
    names = [name for name in Detections._fields if name not in ("boxes", "counts")]
    named = {name: getattr(expected, name) for name in names}
    named |= {f"boxes.{name}": leaf for name, leaf in expected.boxes._asdict().items()}
    named |= {f"counts.{name}": leaf for name, leaf in expected.counts._asdict().items()}
    with np.load(tmp_path / "found.npz") as found:
        assert set(found) == set(named)
        for name, leaf in named.items():
            np.testing.assert_allclose(found[name], leaf, rtol=0, atol=1e-5, err_msg=name)
