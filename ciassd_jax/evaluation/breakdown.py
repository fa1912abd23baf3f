"""AP by distance and by number of points, and the correlation of confidence and overlap."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ciassd_jax.evaluation.kitti_ap import Curve, Evaluand, Limits, Within, is_evaluated, trace_levels
from ciassd_jax.evaluation.overlap import Geometry

# Lower ends of the intervals; the last interval is unbounded.
DISTANCES = (0, 20, 40)
POINTS = (0, 20, 100)


class Row(NamedTuple):
    """The easy, moderate and hard curves of a class for the objects in one interval, `part`."""

    name: str
    geometry: Geometry
    limit: float
    part: str
    curves: tuple[Curve, ...]


def rows_by_distance(evaluand: Evaluand, limits: Limits) -> list[Row]:
    """Return rows of every evaluated class by the horizontal distance from the sensor, in metres."""
    truths, detections = evaluand.truths.boxes.center, evaluand.detections.boxes.center
    distances = np.hypot(truths[:, 0], truths[:, 1]), np.hypot(detections[:, 0], detections[:, 1])
    return _rows(evaluand, limits, *distances, DISTANCES, "m")


def rows_by_points(evaluand: Evaluand, limits: Limits) -> list[Row]:
    """Return rows by the number of points in a box, or none if it is unknown for labels or detections."""
    points, found = evaluand.truths.points, evaluand.detections.points
    if (points < 0).any() or (found < 0).any():
        return []
    return _rows(evaluand, limits, points, found, POINTS, "points")


def correlation(evaluand: Evaluand, name: str) -> float:
    """Return Pearson's correlation of score and 3D overlap over the detections of a class.

    A detection's overlap is its largest with a label of the class, of any difficulty. Detections that overlap none are
    left out, because their objects may be unlabelled. NaN as in `pearson`.
    """
    pairs = evaluand.shared["3d"]
    same = evaluand.truths.types[pairs.first] == name.lower()
    same &= evaluand.detections.types[pairs.second] == name.lower()
    best = np.zeros(len(evaluand.detections.frame))
    np.maximum.at(best, pairs.second[same], pairs.overlap[same])
    overlap, score = best[best > 0], evaluand.detections.score[best > 0]
    return pearson(overlap, score)


def pearson(first: np.ndarray, second: np.ndarray) -> float:
    """Return Pearson's correlation; NaN for fewer than two values and for constant ones."""
    if len(first) < 2 or np.ptp(first) == 0 or np.ptp(second) == 0:
        return float("nan")
    return float(np.corrcoef(first, second)[0, 1])


def _rows(
    evaluand: Evaluand,
    limits: Limits,
    truths: np.ndarray,
    detections: np.ndarray,
    starts: tuple[int, ...],
    unit: str,
) -> list[Row]:
    rows = []
    ends = (*starts[1:], np.inf)
    for name, (limit, *_) in limits.items():
        for geometry in ("bev", "3d"):
            if not is_evaluated(evaluand.detections, name, geometry):
                continue
            for start, end in zip(starts, ends, strict=True):
                within = Within(*((value >= start) & (value < end) for value in (truths, detections)))
                part = f"{start}+ {unit}" if end == np.inf else f"{start}-{end} {unit}"
                rows.append(Row(name, geometry, limit, part, trace_levels(evaluand, name, geometry, limit, within)))
    return rows
