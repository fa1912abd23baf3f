"""Labelled frames padded to scenes of fixed size."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

from ciassd_jax.config import Config
from ciassd_jax.data.frames import Frame
from ciassd_jax.formats.errors import InputError
from ciassd_jax.types import Boxes, GroundTruth, PointCloud, Scene

OBSTACLE = -1


def pad_frame(frame: Frame, index: int, config: Config) -> Scene:
    """Pad a frame to the capacities of `config.data`, as NumPy arrays; `index` is its place in the data set.

    An object is a target of the class with its name or, with `similar_classes`, of the class that lists it as similar.
    Other objects are obstacles (label -1), and with `filter_scenes` so are those without a difficulty. Points over
    capacity are cut evenly from the whole cloud, boxes from the end; both are counted. Raises InputError for a box
    whose values are not finite or whose size is not positive.
    """
    _check_boxes(frame)
    data = config.data
    points, kept = _spread(len(frame.points), data.max_points), min(len(frame.names), data.max_boxes)
    padded = np.zeros((data.max_points, 4), np.float32)
    padded[: len(points)] = frame.points[points]
    boxes = np.zeros((data.max_boxes, 7), np.float32)
    boxes[:kept] = frame.boxes.to_array()[:kept]
    label = np.full(data.max_boxes, OBSTACLE, np.int32)
    label[:kept] = target_labels(frame, config)[:kept]
    return Scene(
        PointCloud(padded, np.array(len(points), np.int32)),
        GroundTruth(Boxes.from_array(boxes), label, np.array(kept, np.int32)),
        frame=np.array(index, np.int32),
        points_cut=np.array(len(frame.points) - len(points), np.int32),
        boxes_cut=np.array(len(frame.names) - kept, np.int32),
        objects_cut=np.array(0, np.int32),
    )


def target_labels(frame: Frame, config: Config) -> Int[np.ndarray, " G"]:
    """Return the class that each object of the frame is a target of, -1 for an obstacle."""
    augmentation = config.data.augmentation
    labels = {name: label for label, one in enumerate(config.classes) for name in one.similar}
    if not augmentation.similar_classes:
        labels.clear()
    labels |= {name: label for label, name in enumerate(config.class_names)}
    label = np.array([labels.get(name, OBSTACLE) for name in frame.names], np.int32)
    return np.where(frame.difficulty < 0, np.int32(OBSTACLE), label) if augmentation.filter_scenes else label


def _spread(count: int, capacity: int) -> Int[np.ndarray, " kept"]:
    """Return the points to keep: evenly spaced, because a cloud is ordered by beam and direction."""
    if count <= capacity:
        return np.arange(count)
    return np.arange(capacity) * count // capacity


def _check_boxes(frame: Frame) -> None:
    usable = np.isfinite(frame.boxes.to_array()).all(-1) & (frame.boxes.size > 0).all(-1)
    if not usable.all():
        index = int(np.argmin(usable))
        size = " x ".join(f"{edge:g}" for edge in frame.boxes.size[index])
        raise InputError(
            f"Frame {frame.name}: object {index} ({frame.names[index]}) has the size {size} or a value that is not "
            "finite; correct or remove its line in the label file."
        )
