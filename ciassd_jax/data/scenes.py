"""Labelled frames padded to scenes of fixed size."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable

import numpy as np
from jaxtyping import Int

from ciassd_jax.config import Config
from ciassd_jax.data.cloud_hints import describe_cloud
from ciassd_jax.data.frames import Dataset, Frame
from ciassd_jax.formats.errors import InputError, collected_warnings, warn_of_file
from ciassd_jax.formats.points import check_intensity
from ciassd_jax.types import Boxes, GroundTruth, PointCloud, Scene

OBSTACLE = -1


def pad_frame(frame: Frame, index: int, config: Config) -> Scene:
    """Pad a frame to the capacities of `config.data`, as NumPy arrays; `index` is its place in the data set.

    An object is a target of the class with its name or, with `similar_classes`, of the class that lists it as similar;
    case does not matter, but a FormatWarning tells of a difference. Other objects are obstacles (label -1), and with
    `filter_scenes` so are those without a difficulty. Points over capacity are cut evenly from the whole cloud, boxes
    from the end; both are counted. Raises InputError for a box whose values are not finite or whose size is not
    positive.
    """
    _check_boxes(frame)
    _tell_of_case(frame, config)
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
    labels = config.labels_by_name(similar=augmentation.similar_classes)
    label = np.array([labels.get(name.lower(), OBSTACLE) for name in frame.names], np.int32)
    return np.where(frame.difficulty < 0, np.int32(OBSTACLE), label) if augmentation.filter_scenes else label


def check_targets(dataset: Dataset, config: Config, track: Callable[[range], Iterable[int]] = iter) -> bool:
    """Return whether a target lies in the range of the grid; gives a FormatWarning if all lie outside.

    Gives another one if the first cloud is unlike what the config expects (`describe_cloud`). Reads up to the first
    frame with a target. `track` wraps the iteration over the frames, for a progress bar. Raises InputError if the first
    cloud has intensities of another scale, or, with what the labels have, if no object is of a class that is learned.
    """
    low, high = (np.array(limit) for limit in config.range)
    found: Counter[str] = Counter()
    learned = 0
    for index in track(range(len(dataset))):
        # The loader reads the frames again and gives their warnings.
        with collected_warnings():
            frame = dataset.read(index)
        if index == 0:
            check_intensity(frame.points, config.input.intensity_scale, f"Frame {frame.name}")
            for hint in describe_cloud(frame.points, *config.range, config.ground, config.input.z_shift):
                warn_of_file(f"Frame {frame.name}: {hint}", stacklevel=2)
        of_class = target_labels(frame, config) >= 0
        inside = ((frame.boxes.center >= low) & (frame.boxes.center <= high)).all(-1)
        if (of_class & inside).any():
            return True
        learned += int(of_class.sum())
        found.update(frame.names)
    if not learned:
        raise InputError(_describe_types(found, len(dataset), config))
    space = ", ".join(f"{axis} {least:g}..{most:g}" for axis, least, most in zip("xyz", low, high, strict=True))
    warn_of_file(
        f"All {learned} objects of the classes that are learned ({', '.join(config.class_names)}) lie outside the "
        f"grid, {space} m; choose a range with `ciassd data suggest`."
    )
    return False


def _describe_types(found: Counter[str], frames: int, config: Config) -> str:
    """Say which types there are instead of those that are learned, and the remedy."""
    if not found:
        return f"None of {frames} frames has a labelled object; check the labels, or choose another split."
    types = ", ".join(f"{name} ({count})" for name, count in found.most_common())
    graded = " with a difficulty" if config.data.augmentation.filter_scenes else ""
    return (
        f"None of {found.total()} labelled objects in {frames} frames is of a class that is learned "
        f"({', '.join(config.class_names)}){graded}; the labels have {types}, so choose classes with "
        "`ciassd data suggest`, or list a type as `similar` of a class."
    )


def _tell_of_case(frame: Frame, config: Config) -> None:
    similar = config.data.augmentation.similar_classes
    labels = config.labels_by_name(similar=similar)
    spelled = {name for one in config.classes for name in (one.name, *(one.similar if similar else ()))}
    for name in sorted(set(frame.names) - spelled):
        if name.lower() in labels:
            target = config.class_names[labels[name.lower()]]
            warn_of_file(f"Labels of type {name} count as {target}, because case does not matter.")


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
