"""Anchors: golden values, and the order that the network's outputs follow."""

from dataclasses import replace

import numpy as np
import pytest

from ciassd_jax.config import HeadConfig
from ciassd_jax.config.presets import car, car_released, three_class, tiny
from ciassd_jax.model.anchors import make_anchors
from ciassd_jax.ops.boxes import to_paper


@pytest.mark.reference
def test_golden_anchors(shared):
    """The released code's, with 1.57 for a right angle; the paper's preset has pi / 2."""
    with np.load(shared / "golden" / "anchors.npz") as data:
        expected, thresholds = data["anchors"], (data["matched_threshold"], data["unmatched_threshold"])
    boxes, labels = make_anchors(car_released())
    assert boxes.yaw.dtype == boxes.size.dtype == boxes.center.dtype == np.float32
    np.testing.assert_allclose(to_paper(boxes), expected, rtol=0, atol=1e-5)
    np.testing.assert_array_equal(labels, np.zeros(70400))
    one = car_released().classes[0]
    np.testing.assert_allclose((one.matched, one.unmatched), thresholds, rtol=1e-6)
    exact = expected.copy()
    exact[1::2, 6] = np.pi / 2
    np.testing.assert_allclose(to_paper(make_anchors(car())[0]), exact, rtol=0, atol=1e-5)


def test_the_number_of_an_anchor():
    """((row * 176) + column) * 2 + angle; rows run along y from -40, columns along x from 0."""
    boxes, _ = make_anchors(car())
    for row, column, angle in [(0, 0, 0), (0, 0, 1), (0, 175, 0), (199, 0, 1), (123, 45, 1)]:
        number = (row * 176 + column) * 2 + angle
        center = (0.2 + 0.4 * column, -39.8 + 0.4 * row, -1.0)
        np.testing.assert_allclose(boxes.center[number], center, rtol=0, atol=1e-5)
        np.testing.assert_allclose(boxes.size[number], (3.9, 1.6, 1.56), rtol=1e-6)
        # r = 0 looks along -y, r = pi / 2 along -x.
        np.testing.assert_allclose(boxes.yaw[number], (-np.pi / 2, -np.pi)[angle], rtol=1e-6)


def test_several_classes_share_a_cell():
    """Within a cell first the class, then the angle."""
    boxes, labels = make_anchors(three_class())
    assert labels.shape == boxes.yaw.shape == (200 * 176 * 6,)
    assert np.issubdtype(labels.dtype, np.integer)
    np.testing.assert_array_equal(labels.reshape(-1, 6), np.tile([0, 0, 1, 1, 2, 2], (200 * 176, 1)))
    cell = slice(6 * 1000, 6 * 1001)
    np.testing.assert_array_equal(boxes.center[cell, :2], np.tile(boxes.center[6000, :2], (6, 1)))
    np.testing.assert_allclose(boxes.center[cell, 2], [-1, -1, -0.6, -0.6, -0.6, -0.6], rtol=1e-6)
    sizes = [(3.9, 1.6, 1.56)] * 2 + [(0.8, 0.6, 1.73)] * 2 + [(1.76, 0.6, 1.73)] * 2
    np.testing.assert_allclose(boxes.size[cell], sizes, rtol=1e-6)
    np.testing.assert_allclose(boxes.yaw[cell], [-np.pi / 2, -np.pi] * 3, rtol=1e-6)
    assert three_class().class_names == ("Car", "Pedestrian", "Cyclist")


def test_anchors_follow_grid_and_head():
    config = replace(tiny(), head=HeadConfig(angles=(0.0, 0.5, 1.0)))
    boxes, _ = make_anchors(config)
    height, width = config.bev_shape
    assert boxes.yaw.shape == (height * width * 3,) == (height * width * config.anchors_per_cell,)
    cell = config.grid.voxel_size[0] * config.backbone.stride
    center = boxes.center.reshape(height, width, 3, 3)
    np.testing.assert_allclose(center[0, 0, 0, :2], [cell / 2, -6.4 + cell / 2], rtol=1e-6)
    np.testing.assert_allclose(center[-1, -1, 0, :2], [12.8 - cell / 2, 6.4 - cell / 2], rtol=1e-6)
    np.testing.assert_allclose(np.diff(center[0, :, 0, 0]), cell, rtol=1e-5)
    np.testing.assert_allclose(boxes.yaw[:3], -np.array([0, 0.5, 1]) - np.pi / 2, rtol=1e-6)
