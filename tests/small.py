"""A detector that compiles in seconds, with a scene and a camera for it."""

import math
from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import numpy as np

from ciassd_jax import Config, init_variables, tiny
from ciassd_jax.types import Boxes, GroundTruth, PointCloud, Scene


def small_config() -> Config:
    """`tiny()` with two stages, few candidates and ordinary NMS, so that random weights find something."""
    config = tiny()
    return replace(
        config,
        backbone=replace(config.backbone, stages=config.backbone.stages[:2]),
        detection=replace(config.detection, nms="rotated", max_candidates=16),
    )


@cache
def random_variables(config: Config, seed: int = 0) -> Any:
    """Variables of the right shapes without compiling; a negative class bias keeps empty ground empty."""
    rng = np.random.default_rng(seed)
    shapes = jax.eval_shape(partial(init_variables, config=config), jax.random.key(0))

    def draw(keys: tuple, leaf: jax.ShapeDtypeStruct) -> np.ndarray:
        names = [key.key for key in keys]
        if names[-1] == "kernel":
            scale = 0.02 if "box" in names else 1.5
            return (rng.normal(size=leaf.shape) * scale / math.sqrt(math.prod(leaf.shape[:-1]))).astype(np.float32)
        if names[-2:] == ["class", "bias"]:
            return np.full(leaf.shape, -1, np.float32)
        if names[-2:] == ["iou", "bias"]:
            return np.full(leaf.shape, 0.8, np.float32)
        return (np.ones if names[-1] in ("scale", "var") else np.zeros)(leaf.shape, np.float32)

    return jax.tree_util.tree_map_with_path(draw, shapes)


def small_cloud(seed: int = 0, count: int = 600) -> np.ndarray:
    """Points in a few clusters within the range of `tiny()`, inside the view of `CALIBRATION`."""
    rng = np.random.default_rng(seed)
    centers = np.stack([rng.uniform(5, 11, 4), rng.uniform(-2, 2, 4), rng.uniform(-1.6, -0.4, 4)], -1)
    points = centers[rng.integers(4, size=count)] + rng.normal(0, 0.4, (count, 3))
    return np.concatenate([points, rng.uniform(0, 1, (count, 1))], 1).astype(np.float32)


# A camera at the LiDAR that looks along x, of 640 x 480 pixels with a focal length of 300: KITTI has none such.
CALIBRATION = """\
P2: 300 0 320 0 0 300 240 0 0 0 1 0
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0
"""
IMAGE_SIZE = (640, 480)


def random_scene(config: Config, seed: int) -> Scene:
    """A labelled scene of `small_cloud` with two cars in the range of `tiny()`, padded to the config's capacities."""
    rng = np.random.default_rng(seed)
    points = small_cloud(seed)
    padded = np.zeros((config.data.max_points, 4), np.float32)
    padded[: len(points)] = points
    boxes = np.zeros((config.data.max_boxes, 7), np.float32)
    boxes[:2, :2] = rng.uniform((2, -5), (11, 5), (2, 2))
    boxes[:2, 2:] = [-1.0, 3.9, 1.6, 1.5, 0.0]
    boxes[:2, 6] = rng.uniform(-3, 3, 2)
    label = np.full(config.data.max_boxes, -1, np.int32)
    label[:2] = 0
    zero = np.int32(0)
    return Scene(
        PointCloud(padded, np.int32(len(points))),
        GroundTruth(Boxes.from_array(boxes), label, np.int32(2)),
        frame=np.int32(seed),
        points_cut=zero,
        boxes_cut=zero,
        objects_cut=zero,
    )
