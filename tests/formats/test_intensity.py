"""Intensities: one outlier never changes how a cloud is read, and another scale is refused with the remedy."""

import re

import numpy as np
import pytest
from point_samples import make_cloud

from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.points import check_intensity

CLOUD = make_cloud(np.random.default_rng(0), 2000)


def with_intensity(values: np.ndarray) -> np.ndarray:
    return np.c_[CLOUD[:, :3], values].astype(np.float32)


def test_intensities_in_range_are_returned_as_they_are():
    points, clipped = check_intensity(CLOUD, 1.0, "a.bin")
    assert points is CLOUD
    assert clipped == 0
    assert check_intensity(with_intensity(CLOUD[:, 3] * 255), 255.0, "a.bin")[1] == 0
    assert check_intensity(CLOUD[:0], 1.0, "a.bin")[1] == 0


@pytest.mark.parametrize("scale", [1.0, 255.0])
def test_up_to_one_percent_is_clipped_and_counted(scale):
    values = CLOUD[:, 3] * np.float32(scale)
    values[:12], values[12:20] = 4 * scale, -0.5
    before = with_intensity(values)
    points, clipped = check_intensity(before, scale, "a.bin")
    assert clipped == 20
    np.testing.assert_array_equal(points[:20, 3], np.repeat(np.float32([scale, 0]), [12, 8]))
    np.testing.assert_array_equal(points[20:], before[20:])
    assert before[0, 3] == 4 * scale


def test_what_voxelisation_drops_is_left():
    values = CLOUD[:, 3].copy()
    values[:5] = 9e37, -9e37, np.nan, np.inf, 1001
    points, clipped = check_intensity(with_intensity(values), 1.0, "a.bin")
    assert clipped == 0
    np.testing.assert_array_equal(points[:, 3], values)


@pytest.mark.parametrize(("top", "expected"), [(255, 255), (65535, 65535), (4000, 4095), (100, 100), (1.76, 1.76)])
def test_another_scale_is_refused_and_its_remedy_works(top, expected):
    values = CLOUD[:, 3] / CLOUD[:, 3].max() * top
    values[: len(values) // 100] = top
    with pytest.raises(
        InputError, match=r"a.bin has \d+\S* % of its intensities outside \[0, 1\], from \S+ to"
    ) as caught:
        check_intensity(with_intensity(values), 1.0, "a.bin")
    (scale,) = re.findall(r"; pass (\S+) as `intensity_scale`\.$", str(caught.value))
    assert float(scale) == pytest.approx(expected)
    assert check_intensity(with_intensity(values), float(expected) + 1e-6, "a.bin")[1] == 0


def test_an_outlier_does_not_change_the_remedy():
    values = np.round(CLOUD[:, 3] * 255)
    values[0] = 3e38
    with pytest.raises(InputError, match="pass 255 as `intensity_scale`"):
        check_intensity(with_intensity(values), 1.0, "a.bin")


def test_negative_intensities_have_no_scale():
    with pytest.raises(InputError, match="save them without negative numbers, or name their column as `columns`"):
        check_intensity(with_intensity(CLOUD[:, 3] - 0.5), 1.0, "a.bin")


def test_ring_numbers_are_recognised():
    with pytest.raises(
        InputError, match="if they are ring numbers, pass names such as x,y,z,ring,intensity as `columns`"
    ):
        check_intensity(with_intensity(np.arange(2000) % 32), 1.0, "a.bin")
