"""`config.input`: intensity scale and z shift, which the network applies and its boxes do not show."""

from dataclasses import replace
from functools import partial
from typing import Any

import chex
import jax
import numpy as np
import pytest
from small import random_scene, random_variables, small_cloud, small_config

from ciassd_jax import Config, PointCloud, predict, tiny
from ciassd_jax.config import InputConfig
from ciassd_jax.model.anchors import make_anchors
from ciassd_jax.model.network import voxelize_batch
from ciassd_jax.training.targets import assign_targets

# Powers of two, so that scaling and shifting back is exact.
SCALE, SHIFT = 256.0, 0.5
DETECT = jax.jit(predict)
OTHER_SENSOR = InputConfig(intensity_scale=SCALE, z_shift=SHIFT)


def as_other_sensor(points: Any) -> Any:
    """The points as a sensor gives them that stands higher and counts intensities to 256."""
    return np.round(points * 64) / 64 * np.float32([1, 1, 1, SCALE]) - np.float32([0, 0, SHIFT, 0])


def detect(points: np.ndarray, config: Config) -> Any:
    cloud = PointCloud(points[None], np.array([len(points)], np.int32))
    return jax.device_get(DETECT(random_variables(small_config()), cloud, config))


def test_detections_of_another_sensor_are_the_same_in_its_own_frame() -> None:
    config, points = small_config(), np.round(small_cloud() * 64) / 64
    usual = detect(points, config)
    other = detect(as_other_sensor(small_cloud()), replace(config, input=OTHER_SENSOR))
    assert usual.count[0] > 0
    np.testing.assert_array_equal(usual.score, other.score)
    real = np.arange(usual.score.shape[1]) < usual.count[0]
    moved = usual.boxes.center[0, real] - np.float32([[0, 0, SHIFT]])
    np.testing.assert_allclose(other.boxes.center[0, real], moved, atol=1e-6)
    np.testing.assert_array_equal(other.boxes.size, usual.boxes.size)
    chex.assert_trees_all_equal(other.counts, usual.counts)


def test_voxels_and_targets_of_another_sensor_are_the_same() -> None:
    config, other = tiny(), replace(tiny(), input=OTHER_SENSOR)
    scene = random_scene(config, 0)
    usual = np.round(scene.cloud.points * 64) / 64
    boxes = scene.truth.boxes
    shifted = scene.truth._replace(boxes=boxes._replace(center=boxes.center - np.float32([[0, 0, SHIFT]])))
    found, expected = (
        (
            jax.jit(voxelize_batch)(PointCloud(points[None], scene.cloud.count[None]), one),
            jax.jit(partial(assign_targets, classes=one.classes))(truth, *make_anchors(one)),
        )
        for points, truth, one in (
            (usual, scene.truth, config),
            (as_other_sensor(scene.cloud.points), shifted, other),
        )
    )
    assert (expected[1].label == 1).any()
    chex.assert_trees_all_close(found, expected, atol=1e-6)


def test_inference_keeps_it_and_files_hold_it() -> None:
    config = replace(tiny(), input=OTHER_SENSOR)
    assert config.for_inference().input == OTHER_SENSOR
    assert Config.from_json(config.to_json()) == config
    minimum, maximum = config.range
    assert (minimum[2], maximum[2]) == (tiny().grid.minimum[2] - SHIFT, tiny().grid.maximum[2] - SHIFT)


@pytest.mark.parametrize("value", [1001.0, -1e30, 9e37, np.inf, np.nan])
def test_a_point_of_impossible_intensity_is_dropped_and_counted(value: float) -> None:
    spoilt, clean = small_cloud(), small_cloud()
    spoilt[7, 3], clean[7, 0] = value, 1000
    found, expected = detect(spoilt, small_config()), detect(clean, small_config())
    assert found.counts.points_dropped[0] == 1
    assert np.isfinite(found.score).all()
    chex.assert_trees_all_close(found.boxes, expected.boxes, atol=1e-6)
