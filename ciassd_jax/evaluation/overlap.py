"""Overlap of the objects of one frame in the image, in the plane and in space, for all frames at once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float64, Int

from ciassd_jax.evaluation.objects import FlatObjects
from ciassd_jax.ops.iou import intersection_bev
from ciassd_jax.types import Boxes

# Image boxes, footprints, volumes.
Geometry = Literal["bbox", "bev", "3d"]


class Intersections(NamedTuple):
    """E pairs of intersecting objects of the same frame, sorted by `first`, then `second`.

    `shared` is the area or volume of the intersection, `first_size` and `second_size` that of each object, in square
    pixels, square metres or cubic metres.
    """

    first: Int[np.ndarray, " E"]
    second: Int[np.ndarray, " E"]
    shared: Float64[np.ndarray, " E"]
    first_size: Float64[np.ndarray, " E"]
    second_size: Float64[np.ndarray, " E"]

    @property
    def overlap(self) -> Float64[np.ndarray, " E"]:
        """Intersection over union."""
        return self.shared / (self.first_size + self.second_size - self.shared)

    @property
    def coverage(self) -> Float64[np.ndarray, " E"]:
        """The fraction of the second object that the first covers."""
        return self.shared / self.second_size


def intersect(a: FlatObjects, b: FlatObjects) -> dict[Geometry, Intersections]:
    """Return the intersections of objects of `a` and `b`; by the official rules a negative height has no volume."""
    first, second = _pairs(a.frame, b.frame)
    image = _image_intersections(a.image_boxes, b.image_boxes, first, second)
    near = _near(a.boxes, b.boxes, first, second)
    first, second = first[near], second[near]
    footprint = intersection_bev(_footprints(a.boxes, first), _footprints(b.boxes, second))
    height = np.minimum(_top(a.boxes)[first], _top(b.boxes)[second])
    height -= np.maximum(_bottom(a.boxes)[first], _bottom(b.boxes)[second])
    area, other_area = np.abs(a.boxes.size[:, :2]).prod(1), np.abs(b.boxes.size[:, :2]).prod(1)
    size, other_size = area * a.boxes.size[:, 2], other_area * b.boxes.size[:, 2]
    return {
        "bbox": image,
        "bev": _shared_only(first, second, np.asarray(footprint), area[first], other_area[second]),
        "3d": _shared_only(first, second, np.asarray(footprint * height), size[first], other_size[second]),
    }


def image_overlap(a: Sequence[float], b: Sequence[float]) -> float:
    """Return the intersection over union of two image boxes (x1, y1, x2, y2); 0 if one of them is empty."""
    shared = math.prod(max(min(a[i + 2], b[i + 2]) - max(a[i], b[i]), 0) for i in (0, 1))
    areas = sum((box[2] - box[0]) * (box[3] - box[1]) for box in (a, b))
    return shared / (areas - shared) if shared else 0.0


def _pairs(
    frame: Int[np.ndarray, " A"], other: Int[np.ndarray, " B"]
) -> tuple[Int[np.ndarray, " E"], Int[np.ndarray, " E"]]:
    """Return all pairs of objects of the same frame; both lists of frames are ascending."""
    start, stop = np.searchsorted(other, frame, "left"), np.searchsorted(other, frame, "right")
    count = stop - start
    first = np.repeat(np.arange(len(frame)), count)
    before = np.cumsum(count) - count
    return first, np.arange(len(first)) + (start - before)[first]


def _image_intersections(
    a: Float64[np.ndarray, "A 4"],
    b: Float64[np.ndarray, "B 4"],
    first: Int[np.ndarray, " E"],
    second: Int[np.ndarray, " E"],
) -> Intersections:
    low = np.maximum(a[first, :2], b[second, :2])
    high = np.minimum(a[first, 2:], b[second, 2:])
    # Comparisons with NaN are false, so that nothing intersects without a camera.
    shared = np.where((high > low).all(1), (high - low).prod(1), 0)
    area, other_area = ((boxes[:, 2:] - boxes[:, :2]).prod(1) for boxes in (a, b))
    return _shared_only(first, second, shared, area[first], other_area[second])


def _near(a: Boxes, b: Boxes, first: Int[np.ndarray, " E"], second: Int[np.ndarray, " E"]) -> Int[np.ndarray, " near"]:
    """Return the pairs whose circumscribed circles meet; no others can intersect."""
    distance = np.hypot(*(a.center[first, :2] - b.center[second, :2]).T)
    radius, other_radius = (np.hypot(*boxes.size[:, :2].T) / 2 for boxes in (a, b))
    return np.flatnonzero(distance <= radius[first] + other_radius[second])


def _footprints(boxes: Boxes, index: Int[np.ndarray, " E"]) -> Boxes:
    return Boxes(boxes.center[index], np.abs(boxes.size[index]), boxes.yaw[index])


def _top(boxes: Boxes) -> np.ndarray:
    return np.asarray(boxes.center[:, 2] + boxes.size[:, 2] / 2)


def _bottom(boxes: Boxes) -> np.ndarray:
    return np.asarray(boxes.center[:, 2] - boxes.size[:, 2] / 2)


def _shared_only(
    first: Int[np.ndarray, " E"],
    second: Int[np.ndarray, " E"],
    shared: Float64[np.ndarray, " E"],
    first_size: Float64[np.ndarray, " E"],
    second_size: Float64[np.ndarray, " E"],
) -> Intersections:
    some = shared > 0
    return Intersections(first[some], second[some], shared[some], first_size[some], second_size[some])
