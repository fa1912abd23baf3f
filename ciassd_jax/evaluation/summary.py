"""The evaluation of a data set in one call."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from ciassd_jax.evaluation.breakdown import Row, correlation, rows_by_distance, rows_by_points
from ciassd_jax.evaluation.kitti_ap import (
    LIMITS,
    METRICS,
    NEIGHBOURS,
    Curve,
    Difficulty,
    Limits,
    Metric,
    Recall,
    average_precision,
    check_limits,
    is_evaluated,
    prepare,
    trace_levels,
)
from ciassd_jax.evaluation.objects import DetectedObjects, LabelledObjects, has_image_box, select
from ciassd_jax.formats.kitti_rows import DONT_CARE


class Counts(NamedTuple):
    """Numbers of labels, without DontCare, and of detections."""

    labels: int
    detections: int


class Evaluation(NamedTuple):
    """The result of `evaluate`.

    `total` counts all objects, `without_image_box` those without an image box (without a camera all of them), and
    `left_out` those of each type that is not evaluated, the most frequent first.
    `curves` holds the easy, moderate and hard curve of every class, metric and limit, or None if the official program
    does not evaluate it; aos has the curves of bbox, of which it uses `orientation`. `by_points` is empty if the
    numbers of points are unknown. `correlation` is that of score and 3D overlap by class, or NaN. Without a camera
    there is neither bbox nor aos, and difficulty is not KITTI's.
    """

    num_frames: int
    limits: Limits
    difficulty: Difficulty
    total: Counts
    without_image_box: Counts
    left_out: dict[str, Counts]
    curves: dict[tuple[str, Metric, float], tuple[Curve, ...] | None]
    by_distance: list[Row]
    by_points: list[Row]
    correlation: dict[str, float]

    @property
    def has_camera(self) -> bool:
        """Whether image boxes are evaluated and give KITTI's difficulty; true if there are no objects."""
        return self.difficulty == "kitti"

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

    `limits` names the classes and the overlaps that their detections must exceed, the strict one first; case does not
    matter in names. For KITTI's files, make the records with `labels_from_rows` and `detections_from_rows`. Records of
    data without a camera have their own boxes and difficulty, but no image boxes and alphas; no detection is too low
    then. The same holds if no label has an image box: difficulty is then by the number of points, and without
    `points` every label counts at every level. Raises ValueError for lists that do not match, and for limits that are
    no overlaps or name a class twice.
    """
    check_limits(limits)
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
    objects = select(evaluand.truths, evaluand.truths.types != DONT_CARE.lower()), evaluand.detections
    return Evaluation(
        len(truths),
        limits,
        evaluand.difficulty,
        Counts(*(len(some.frame) for some in objects)),
        Counts(*(int((~has_image_box(some)).sum()) for some in objects)),
        _count_left_out(truths, detections, limits),
        curves,
        rows_by_distance(evaluand, limits),
        rows_by_points(evaluand, limits),
        {name: correlation(evaluand, name) for name in limits},
    )


def _count_left_out(
    truths: Sequence[LabelledObjects], detections: Sequence[DetectedObjects], limits: Limits
) -> dict[str, Counts]:
    """Count the types without limits, each as it is first spelt; labels of neighbour classes take part."""
    evaluated = {name.lower() for name in limits}
    known = evaluated | {DONT_CARE.lower()}
    neighbours = {NEIGHBOURS.get(name) for name in evaluated}
    spelt: dict[str, str] = {}
    labels, found = Counter[str](), Counter[str]()
    for frames, counter, skipped in ((truths, labels, known | neighbours), (detections, found, known)):
        for name in (name for frame in frames for name in frame.types if name.lower() not in skipped):
            counter[spelt.setdefault(name.lower(), name)] += 1
    return {name: Counts(labels[name], found[name]) for name, _ in (labels + found).most_common()}
