"""AP of parts of a set, by distance and by number of points, and how well confidence tells overlap."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ciassd_jax.evaluation.kitti_ap import LIMITS, Curve, Evaluand, Within, is_evaluated, trace_levels
from ciassd_jax.evaluation.overlap import Geometry

# Where parts begin; the last one has no end.
DISTANCES = (0, 20, 40)
POINTS = (0, 20, 100)


class Row(NamedTuple):
    """The curves of a class, easy, moderate and hard, for the objects in one part of the set."""

    name: str
    geometry: Geometry
    limit: float
    part: str
    curves: tuple[Curve, ...]


def rows_by_distance(evaluand: Evaluand) -> list[Row]:
    """Rows of every evaluated class by the distance in the plane from the sensor, in metres."""
    truths, detections = evaluand.truths.boxes.center, evaluand.detections.boxes.center
    distances = np.hypot(truths[:, 0], truths[:, 1]), np.hypot(detections[:, 0], detections[:, 1])
    return _rows(evaluand, *distances, DISTANCES, "m")


def rows_by_points(evaluand: Evaluand) -> list[Row]:
    """Rows by the number of points in a box; none unless it is known of labels and detections."""
    points, found = evaluand.truths.points, evaluand.detections.points
    if (points < 0).any() or (found < 0).any():
        return []
    return _rows(evaluand, points, found, POINTS, "points")


def correlation(evaluand: Evaluand, name: str) -> float:
    """Pearson's correlation of score and 3D overlap over the detections of a class.

    A detection's overlap is its largest with a label of the class, whatever the difficulty; those that overlap none
    are left out, as they may be of unlabelled objects. NaN where fewer than two are left or one quantity is constant.
    """
    pairs = evaluand.shared["3d"]
    same = evaluand.truths.types[pairs.first] == name.lower()
    same &= evaluand.detections.types[pairs.second] == name.lower()
    best = np.zeros(len(evaluand.detections.frame))
    np.maximum.at(best, pairs.second[same], pairs.overlap[same])
    overlap, score = best[best > 0], evaluand.detections.score[best > 0]
    return pearson(overlap, score)


def pearson(first: np.ndarray, second: np.ndarray) -> float:
    """Pearson's correlation; NaN for fewer than two values and where one of the two is constant."""
    if len(first) < 2 or np.ptp(first) == 0 or np.ptp(second) == 0:
        return float("nan")
    return float(np.corrcoef(first, second)[0, 1])


def _rows(
    evaluand: Evaluand, truths: np.ndarray, detections: np.ndarray, starts: tuple[int, ...], unit: str
) -> list[Row]:
    rows = []
    ends = (*starts[1:], np.inf)
    for name, (limit, _) in LIMITS.items():
        for geometry in ("bev", "3d"):
            if not is_evaluated(evaluand.detections, name, geometry):
                continue
            for start, end in zip(starts, ends, strict=True):
                within = Within(*((value >= start) & (value < end) for value in (truths, detections)))
                part = f"{start}+ {unit}" if end == np.inf else f"{start}-{end} {unit}"
                rows.append(Row(name, geometry, limit, part, trace_levels(evaluand, name, geometry, limit, within)))
    return rows
