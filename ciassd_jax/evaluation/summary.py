"""The evaluation of a data set in one call."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from ciassd_jax.evaluation.breakdown import Row, correlation, rows_by_distance, rows_by_points
from ciassd_jax.evaluation.kitti_ap import (
    LIMITS,
    METRICS,
    Curve,
    Limits,
    Metric,
    Recall,
    average_precision,
    is_evaluated,
    prepare,
    trace_levels,
)
from ciassd_jax.evaluation.objects import DetectedObjects, LabelledObjects


class Evaluation(NamedTuple):
    """The result of `evaluate`.

    `curves` holds the easy, moderate and hard curve of every class, metric and limit, or None if the official program
    does not evaluate it; aos has the curves of bbox, of which it uses `orientation`. `by_points` is empty if the
    numbers of points are unknown. `correlation` is that of score and 3D overlap by class, or NaN. Without a camera
    there is neither bbox nor aos, and difficulty is not KITTI's.
    """

    num_frames: int
    limits: Limits
    has_camera: bool
    curves: dict[tuple[str, Metric, float], tuple[Curve, ...] | None]
    by_distance: list[Row]
    by_points: list[Row]
    correlation: dict[str, float]

    def precision(self, name: str, metric: Metric, limit: float, recall: Recall = "R40") -> list[float] | None:
        """Return AP in percent, easy, moderate and hard; None if not evaluated, NaN for zero over zero."""
        curves = self.curves[name, metric, limit]
        if curves is None:
            return None
        return [average_precision(c.orientation if metric == "aos" else c.precision, recall) for c in curves]


def evaluate(
    truths: Sequence[LabelledObjects], detections: Sequence[DetectedObjects], limits: Limits = LIMITS
) -> Evaluation:
    """Evaluate detections by KITTI's official rules; both lists hold one record per frame, in the same order.

    For KITTI's files, make the records with `labels_from_rows` and `detections_from_rows`. Records of data without a
    camera have their own boxes and difficulty, but no image boxes and alphas; no detection is too low then. Raises
    ValueError for lists that do not match.
    """
    evaluand = prepare(truths, detections)
    curves: dict[tuple[str, Metric, float], tuple[Curve, ...] | None] = {}
    for name, of_class in limits.items():
        for metric in METRICS:
            geometry = "bbox" if metric == "aos" else metric
            for limit in of_class if metric in ("bev", "3d") else of_class[:1]:
                traced = None
                if is_evaluated(evaluand.detections, name, metric):
                    traced = curves.get((name, geometry, limit)) or trace_levels(evaluand, name, geometry, limit)
                curves[name, metric, limit] = traced
    return Evaluation(
        len(truths),
        limits,
        evaluand.has_camera,
        curves,
        rows_by_distance(evaluand, limits),
        rows_by_points(evaluand, limits),
        {name: correlation(evaluand, name) for name in limits},
    )
