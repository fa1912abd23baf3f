"""The labelled and detected objects that evaluation compares: per frame, and of a data set in flat arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Float64, Int

from ciassd_jax.data.frames import Frame
from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.kitti_rows import ObjectRow, difficulty_of, is_dont_care
from ciassd_jax.ops.footprints import points_in_boxes
from ciassd_jax.types import Boxes

# KITTI's value for a location that is not given.
_NO_LOCATION = -1000.0


class LabelledObjects(NamedTuple):
    """The labels of one frame, G objects in the order of their file, in float64.

    `difficulty` is an index in formats.kitti_rows.DIFFICULTIES or -1. `boxes` are in any right-handed frame with z up
    whose origin is the sensor. `image_boxes` (x1, y1, x2, y2) in pixels and `alpha` in radians are None for data
    without a camera; `points`, the number of points in each box, is None if unknown. If no label of a data set has an
    image box with an area, it is evaluated without a camera, and difficulty is by `points`.
    """

    types: tuple[str, ...]
    difficulty: Int[np.ndarray, " G"]
    boxes: Boxes
    image_boxes: Float64[np.ndarray, "G 4"] | None = None
    alpha: Float64[np.ndarray, " G"] | None = None
    points: Int[np.ndarray, " G"] | None = None


class DetectedObjects(NamedTuple):
    """The detections of one frame, D objects, with the fields of LabelledObjects and finite scores.

    A coordinate of `boxes.center` that the result does not give is NaN.
    """

    types: tuple[str, ...]
    score: Float64[np.ndarray, " D"]
    boxes: Boxes
    image_boxes: Float64[np.ndarray, "D 4"] | None = None
    alpha: Float64[np.ndarray, " D"] | None = None
    points: Int[np.ndarray, " D"] | None = None


class FlatObjects(NamedTuple):
    """The objects of several frames in one array per field, frame after frame; `types` are in lower case.

    Labels have score NaN, detections difficulty -1. Without a camera, image boxes and alphas are NaN; unknown `points`
    are -1.
    """

    frame: Int[np.ndarray, " O"]
    types: np.ndarray
    difficulty: Int[np.ndarray, " O"]
    score: Float64[np.ndarray, " O"]
    boxes: Boxes
    image_boxes: Float64[np.ndarray, "O 4"]
    alpha: Float64[np.ndarray, " O"]
    points: Int[np.ndarray, " O"]


def labels_from_frame(frame: Frame) -> LabelledObjects:
    """Return the labels of a frame, with the number of points in each box.

    With a camera they are the rows of the label file, DontCare among them, without one the boxes of the frame. Raises
    InputError for a frame without labels.
    """
    inside = np.asarray(points_in_boxes(frame.points, frame.boxes)).sum(-1)
    if frame.camera is None:
        return LabelledObjects(frame.names, frame.difficulty, frame.boxes, points=inside)
    if frame.rows is None:
        raise InputError(f"Frame {frame.name} has no labels to compare with; choose a split of labelled frames.")
    rows = cast(tuple[ObjectRow, ...], frame.rows)
    points = np.zeros(len(rows), np.int64)
    points[[not is_dont_care(row.type) for row in rows]] = inside
    return labels_from_rows(rows)._replace(points=points)


def labels_from_rows(rows: Sequence[ObjectRow]) -> LabelledObjects:
    """Return the objects of a label file, DontCare among them; boxes in axes right, forward, up from the camera."""
    difficulty = np.array([difficulty_of(row) for row in rows], np.int64)
    return LabelledObjects(tuple(row.type for row in rows), difficulty, *_geometry(rows))


def detections_from_rows(rows: Sequence[ObjectRow]) -> DetectedObjects:
    """Return the objects of a result file, whose rows all have a score; boxes as in `labels_from_rows`."""
    score = np.array([row.score for row in rows], np.float64)
    return DetectedObjects(tuple(row.type for row in rows), score, *_geometry(rows))


def flatten(frames: Sequence[LabelledObjects] | Sequence[DetectedObjects]) -> FlatObjects:
    """Join frames; raises ValueError if only some of them have a camera or points."""
    sizes = [len(frame.types) for frame in frames]
    scores = [getattr(frame, "score", np.full(size, np.nan)) for frame, size in zip(frames, sizes, strict=True)]
    difficulty = [getattr(frame, "difficulty", np.full(size, -1)) for frame, size in zip(frames, sizes, strict=True)]
    return FlatObjects(
        np.repeat(np.arange(len(frames)), sizes),
        np.array([name.lower() for frame in frames for name in frame.types], np.str_),
        np.concatenate([np.zeros(0, np.int64), *difficulty]),
        np.concatenate([np.zeros(0), *scores]),
        Boxes.from_array(np.concatenate([np.zeros((0, 7)), *(frame.boxes.to_array() for frame in frames)])),
        _join("image_boxes", frames, sizes, np.full(4, np.nan)),
        _join("alpha", frames, sizes, np.array(np.nan)),
        _join("points", frames, sizes, np.array(-1)),
    )


def select(objects: FlatObjects, index: np.ndarray) -> FlatObjects:
    """Return the objects at an index or mask."""
    boxes = Boxes(*(leaf[index] for leaf in objects.boxes))
    return FlatObjects._make(boxes if field is objects.boxes else field[index] for field in objects)


def has_image_box(objects: FlatObjects) -> Bool[np.ndarray, " O"]:
    """Return which objects have an image box with an area."""
    return np.all(objects.image_boxes[:, 2:] > objects.image_boxes[:, :2], axis=1)


def without_image(objects: FlatObjects) -> FlatObjects:
    """Return the objects as those of data without a camera."""
    return objects._replace(
        image_boxes=np.full_like(objects.image_boxes, np.nan), alpha=np.full_like(objects.alpha, np.nan)
    )


def _geometry(
    rows: Sequence[ObjectRow],
) -> tuple[Boxes, Float64[np.ndarray, "O 4"], Float64[np.ndarray, " O"]]:
    location = np.array([row.location for row in rows], np.float64).reshape(-1, 3)
    size = np.array([row.dimensions[::-1] for row in rows], np.float64).reshape(-1, 3)
    rotation_y = np.array([row.rotation_y for row in rows], np.float64)
    location[location == _NO_LOCATION] = np.nan
    center = np.stack([location[:, 0], location[:, 2], size[:, 2] / 2 - location[:, 1]], -1)
    image_boxes = np.array([row.bbox for row in rows], np.float64).reshape(-1, 4)
    alpha = np.array([row.alpha for row in rows], np.float64)
    return Boxes(center, size, -rotation_y), image_boxes, alpha


def _join(
    field: str, frames: Sequence[LabelledObjects] | Sequence[DetectedObjects], sizes: list[int], missing: np.ndarray
) -> np.ndarray:
    """Join one field of all frames; `missing` stands for each object if no frame has the field."""
    parts = [getattr(frame, field) for frame in frames]
    lacking = [part is None for part in parts]
    if any(lacking) and not all(lacking):
        raise ValueError(f"{field} is given for some frames only; give it for all or for none.")
    if not parts or all(lacking):
        return np.broadcast_to(missing, (sum(sizes), *missing.shape)).copy()
    return np.concatenate(parts)
