"""The bundled weights find cars on simulated streets."""

import jax
import numpy as np
import pytest

from ciassd_jax import Detector
from ciassd_jax.ops.footprints import points_in_boxes
from ciassd_jax.ops.iou import iou_3d
from ciassd_jax.simulation import open_synthetic
from ciassd_jax.types import Boxes

SEED, STREETS = 123, 5


def overlaps(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """3D IoU of every pair [D, G]."""
    pair = np.broadcast_arrays(found[:, None], true[None])
    return np.asarray(jax.jit(iou_3d)(*(Boxes.from_array(boxes.astype(np.float32)) for boxes in pair)))


@pytest.mark.slow
def test_they_find_the_cars_of_unseen_streets() -> None:
    detector = Detector.from_pretrained("car_lite")
    dataset = open_synthetic(SEED, STREETS)
    found = wanted = invented = 0
    for index in range(STREETS):
        frame = dataset.read(index)
        true = frame.boxes.to_array()
        overlap = overlaps(detector(frame.points).boxes, true)
        points = np.asarray(points_in_boxes(frame.points, frame.boxes)).sum(1)
        near = np.isin(frame.names, ["Car"]) & (points >= 20) & (np.hypot(true[:, 0], true[:, 1]) < 40)
        wanted += near.sum()
        found += (overlap[:, near].max(0, initial=0) > 0.5).sum()
        invented += (overlap.max(1, initial=0) < 0.1).sum()
    assert wanted >= 10
    assert found >= 0.8 * wanted
    assert invented <= 5
