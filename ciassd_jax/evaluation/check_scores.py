"""The labels of a data set fed back as detections: what a perfect detector would score."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ciassd_jax.data.frames import difficulty_by_points
from ciassd_jax.evaluation.findings import CheckedFrame, Finding
from ciassd_jax.evaluation.kitti_ap import LIMITS, METRICS, Metric, average_precision
from ciassd_jax.evaluation.matching import pick_thresholds
from ciassd_jax.evaluation.objects import DetectedObjects, LabelledObjects, detections_from_rows, labels_from_rows
from ciassd_jax.evaluation.summary import evaluate
from ciassd_jax.formats.kitti_boxes import boxes_to_rows
from ciassd_jax.formats.kitti_camera import Camera
from ciassd_jax.formats.kitti_rows import ObjectRow
from ciassd_jax.types import Boxes

# A curve has so many points: with fewer objects the official rule leaves the last ones 0.
FULL_CURVE = 41


class PerfectScore(NamedTuple):
    """AP R40 in percent of one class and metric at each difficulty, and the number of objects there.

    `possible` is what the official rule gives for so many objects that are all found with one score: 100 from
    FULL_CURVE objects on.
    """

    name: str
    metric: Metric
    objects: tuple[int, ...]
    score: tuple[float, ...]
    possible: tuple[float, ...]


def score_truth(frames: Sequence[CheckedFrame]) -> list[PerfectScore]:
    """Score the labels as detections with score 1, for every class and metric that can be evaluated.

    With a camera their boxes go to the LiDAR frame and back, so that the calibration takes part; image boxes and alphas
    stay as they are. Without one there is neither bbox nor aos, and difficulty is by points.
    """
    pairs = [_truth_and_detections(frame) for frame in frames]
    found = evaluate([truth for truth, _ in pairs], [detections for _, detections in pairs])
    scores = []
    for name, (limit, _) in LIMITS.items():
        for metric in METRICS:
            curves, score = found.curves[name, metric, limit], found.precision(name, metric, limit)
            if curves is not None and score is not None:
                objects = tuple(curve.num_truths for curve in curves)
                scores.append(PerfectScore(name, metric, objects, tuple(score), tuple(map(_possible, objects))))
    return scores


def find_imperfect(scores: Sequence[PerfectScore]) -> list[Finding]:
    """A serious finding for every class and metric whose labels score less than is possible."""
    return [
        Finding(
            "score",
            True,
            f"{one.name} {one.metric}: labels as detections score {_listed(one.score)} where {_listed(one.possible)} "
            "is possible; look for labels that cover each other.",
        )
        for one in scores
        if one.score != one.possible
    ]


def _listed(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.2f}" for value in values)


def _possible(objects: int) -> float:
    """AP R40 of so many objects, all found, nothing else found, all scores equal."""
    thresholds = pick_thresholds(np.ones(objects), objects)
    return average_precision(np.where(np.arange(FULL_CURVE) < len(thresholds), 1.0, 0.0))


def _truth_and_detections(frame: CheckedFrame) -> tuple[LabelledObjects, DetectedObjects]:
    boxes = Boxes.from_array(np.array([labelled.box for labelled in frame.objects]).reshape(-1, 7))
    types = tuple(labelled.type for labelled in frame.objects)
    rows = [labelled.row for labelled in frame.objects if labelled.row is not None]
    if frame.camera is None:
        return (
            LabelledObjects(types, difficulty_by_points(frame.inside), boxes),
            DetectedObjects(types, np.ones(len(types)), boxes),
        )
    return labels_from_rows(rows), detections_from_rows(_there_and_back(rows, boxes, frame.camera))


def _there_and_back(rows: Sequence[ObjectRow], boxes: Boxes, camera: Camera) -> list[ObjectRow]:
    """The rows with score 1, those in view with their place and size from the LiDAR frame."""
    detections = [row._replace(score=1.0) for row in rows]
    again, kept = boxes_to_rows(boxes, np.ones(len(rows)), [row.type for row in rows], *camera)
    for index, row in zip(kept.tolist(), again, strict=True):
        detections[index] = detections[index]._replace(
            location=row.location, dimensions=row.dimensions, rotation_y=row.rotation_y
        )
    return detections
