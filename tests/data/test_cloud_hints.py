"""Hints about clouds: none for what a config expects, and a remedy that ends the hint for what it does not."""

import re

import numpy as np
import pytest

from ciassd_jax.data.cloud_hints import describe_cloud

LOW, HIGH, GROUND = (0.0, -40.0, -3.0), (70.4, 40.0, 1.0), -1.78


def make_cloud(count: int = 5000, ground: float = -1.7) -> np.ndarray:
    """A sloping ground with walls in front of the sensor."""
    rng = np.random.default_rng(0)
    x, y = rng.gamma(2.0, 8.0, count) + 3, rng.normal(0, 8, count)
    rise = np.where(rng.random(count) < 0.6, rng.normal(0, 0.03, count), rng.uniform(0, 2.5, count))
    return np.stack([x, y, ground + 0.01 * x + rise, rng.random(count)], -1).astype(np.float32)


def test_a_cloud_that_is_upside_down_is_told():
    (hint,) = describe_cloud(make_cloud() * np.float32([1, 1, -1, 1]), LOW, HIGH, GROUND)
    assert hint.endswith("save them with z up.")


def test_what_a_config_expects_gives_no_hint():
    assert describe_cloud(make_cloud(), LOW, HIGH, GROUND) == []
    assert describe_cloud(make_cloud(999, ground=5), LOW, HIGH, GROUND) == []
    damaged = make_cloud()
    damaged[0, :2] = 3e38
    assert describe_cloud(damaged, LOW, HIGH, GROUND) == []
    # Points all around the sensor are half behind it.
    assert (
        describe_cloud(
            np.concatenate([make_cloud(), make_cloud() * [-1, 1, 1, 1]]).astype(np.float32), LOW, HIGH, GROUND
        )
        == []
    )


@pytest.mark.parametrize("height", [-5.0, -3.2, -0.9, 0.0])
@pytest.mark.parametrize("z_shift", [0.0, 0.4])
def test_another_ground_is_named_with_the_shift_that_fits(height, z_shift):
    cloud = make_cloud(ground=height)
    # All in the frame of the points, as `Config.range` is.
    low, high = (*LOW[:2], LOW[2] - z_shift), (*HIGH[:2], HIGH[2] - z_shift)
    hint = describe_cloud(cloud, low, high, GROUND - z_shift, z_shift)[-1]
    shift = float(re.search(r"pass (\S+) as `z_shift`\.$", hint)[1])
    assert shift == pytest.approx(GROUND - height, abs=0.3)
    low, high = (*LOW[:2], LOW[2] - shift), (*HIGH[:2], HIGH[2] - shift)
    assert describe_cloud(cloud, low, high, GROUND - shift, shift) == []


@pytest.mark.parametrize(
    "cloud",
    [make_cloud() * [1000, 1000, 1000, 1], make_cloud() * [-1, 1, 1, 1], np.add(make_cloud(), [4.5e5, 5e6, 0, 0])],
    ids=["millimetres", "backward", "map coordinates"],
)
def test_points_out_of_range(cloud):
    (hint,) = describe_cloud(cloud.astype(np.float32), LOW, HIGH, GROUND)
    assert re.search(
        r"^Only 0.* % of the points lie in the range x 0 to 70.4, y -40 to 40, z -3 to 1 m; save metres", hint
    )


def test_no_ground_is_no_hint():
    cloud = make_cloud()
    cloud[:, 2] = np.random.default_rng(1).uniform(-10, 6, len(cloud))
    assert describe_cloud(cloud, LOW, HIGH, GROUND) == []


@pytest.mark.reference
def test_no_frame_of_kitti_gives_a_hint(shared):
    for path in shared.glob("kitti*/training/velodyne*/*.bin"):
        cloud = np.fromfile(path, "<f4").reshape(-1, 4)
        for ground in (GROUND, -1.465):
            assert describe_cloud(cloud, LOW, HIGH, ground) == []
