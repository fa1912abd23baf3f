"""The number of columns of a `.bin`: a wrong one is refused by name, a right one never."""

import numpy as np
import pytest
from point_samples import make_cloud

from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.layout import guess_columns
from ciassd_jax.formats.points import read_points

CLOUD = make_cloud(np.random.default_rng(0), 6000)
RNG = np.random.default_rng(1)
RING, TIME = np.arange(6000) // 188, np.linspace(0, 0.1, 6000)
NORMALS = RNG.normal(size=(6000, 3)) / 2
LAYOUTS = {
    "xyz": CLOUD[:, :3],
    "xyzi": CLOUD,
    "u8": CLOUD * [1, 1, 1, 255] // [1e-3, 1e-3, 1e-3, 1] * [1e-3, 1e-3, 1e-3, 1],
    "ring": np.c_[CLOUD, RING],
    "zero": np.c_[CLOUD, np.zeros(6000)],
    "time": np.c_[CLOUD, RING, TIME],
    "colour": np.c_[CLOUD[:, :3], RNG.integers(0, 256, (6000, 3))],
    "normals": np.c_[CLOUD, NORMALS],
    "polar": np.c_[CLOUD, RING, TIME, np.arctan2(CLOUD[:, 1], CLOUD[:, 0]), np.hypot(CLOUD[:, 0], CLOUD[:, 1])],
    "pcl": np.c_[CLOUD[:, :3], np.ones(6000), CLOUD[:, 3], np.zeros((6000, 3))],
}


def numbers(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array.astype("<f4")).ravel()


@pytest.mark.parametrize("name", LAYOUTS)
def test_another_number_of_columns_is_found(name):
    array = LAYOUTS[name]
    width = array.shape[1]
    for assumed in (3, 4, 5, 6, 8):
        assert guess_columns(numbers(array), assumed) == width
        assert guess_columns(numbers(RNG.permutation(array)), assumed) == width
    assert guess_columns(numbers(array[RNG.integers(0, 6000, 200)]), 4) == width


def test_the_remedy_of_a_refusal_works(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(numbers(LAYOUTS["ring"]).tobytes())
    for columns in (None, 4, 6, ("x", "y", "z", "intensity")):
        with pytest.raises(InputError, match=r"with [46] columns but does with 5; pass 5 as `columns`, or save it as"):
            read_points(path, columns)
    np.testing.assert_array_equal(read_points(path, 5), CLOUD)
    # Five columns of a number of points that four do not divide.
    path.write_bytes(numbers(LAYOUTS["ring"][:5999]).tobytes())
    with pytest.raises(InputError, match="pass 5 as `columns`"):
        read_points(path)
    path.write_bytes(numbers(CLOUD).tobytes()[:-2])
    with pytest.raises(InputError, match="not a multiple of 16"):
        read_points(path)


@pytest.mark.parametrize("width", [3, 4, 5])
@pytest.mark.parametrize("noise", [0, 1e-9])
def test_float64_is_refused(tmp_path, width, noise):
    array = LAYOUTS["ring"][:, :width].astype(np.float64)
    (tmp_path / "a.bin").write_bytes((array + RNG.normal(size=array.shape) * noise).tobytes())
    with pytest.raises(InputError, match=r"holds float64 numbers, and a \.bin is read as float32; save it as \.npy"):
        read_points(tmp_path / "a.bin")


def damaged(share: float, values: np.ndarray | float) -> np.ndarray:
    return np.where(RNG.random(CLOUD.shape) < share, values, CLOUD)


GENUINE = {
    "flat": CLOUD * [1, 1, 0, 1],
    "wall": CLOUD * [0, 1, 1, 1] + [5, 0, 0, 0],
    "no intensity": CLOUD * [1, 1, 1, 0],
    "not finite": damaged(0.05, np.nan),
    "outliers": damaged(0.01, 10 ** RNG.uniform(-30, 30, CLOUD.shape)),
    "noise": RNG.normal(size=CLOUD.shape),
    "one value": np.ones_like(CLOUD),
    "nothing": np.zeros_like(CLOUD),
    "millimetres": CLOUD * [1000, 1000, 1000, 1],
    "far": np.add(CLOUD, [4.5e5, 5e6, 100, 0]),
    "sorted": CLOUD[np.argsort(CLOUD[:, 0])],
    "dual returns": np.repeat(CLOUD, 2, 0) * np.tile([[1, 1, 1, 1], [1, 1, 1, 0.3]], (6000, 1)),
    # The beams of two halves fire in turn.
    "halves": np.stack([CLOUD[:3000], CLOUD[3000:]], 1).reshape(-1, 4),
}


@pytest.mark.parametrize("name", GENUINE)
def test_four_columns_are_never_refused(tmp_path, name):
    with np.errstate(over="ignore"):
        cloud = GENUINE[name].astype(np.float32)
    for part in (cloud, RNG.permutation(cloud), cloud[:75], cloud[:100], cloud[500:650], cloud[::50]):
        (tmp_path / "a.bin").write_bytes(part.tobytes())
        np.testing.assert_array_equal(read_points(tmp_path / "a.bin"), part)


def test_a_few_points_are_not_judged(tmp_path):
    (tmp_path / "a.bin").write_bytes(numbers(LAYOUTS["ring"][:48]).tobytes())
    assert len(read_points(tmp_path / "a.bin")) == 60


@pytest.mark.reference
def test_kitti_clouds_have_four_columns(shared):
    paths = [*shared.glob("kitti/training/velodyne_reduced/*.bin"), *shared.glob("kitti_full/training/velodyne/*.bin")]
    assert len(paths) > 150
    for path in paths:
        points = read_points(path)
        five = np.c_[points, np.arange(len(points)) % 64]
        assert guess_columns(numbers(five), 4) == 5
