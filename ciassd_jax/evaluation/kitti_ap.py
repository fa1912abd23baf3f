"""Average precision by KITTI's official rules, in float64 NumPy.

Objects that a level of difficulty does not admit and objects of neighbour classes are neutral: one that is matched to a
detection makes neither a hit nor a false positive. Detections too low for the level are neutral too, in any class.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int

from ciassd_jax.config import Config
from ciassd_jax.data.frames import difficulty_by_points
from ciassd_jax.evaluation.matching import Pairs, assign, order_pairs, pick_thresholds
from ciassd_jax.evaluation.objects import (
    DetectedObjects,
    FlatObjects,
    LabelledObjects,
    flatten,
    has_image_box,
    select,
    without_image,
)
from ciassd_jax.evaluation.overlap import Geometry, Intersections, intersect
from ciassd_jax.formats.kitti_rows import DIFFICULTIES, DONT_CARE

Metric = Literal["bbox", "bev", "3d", "aos"]
Recall = Literal["R11", "R40"]
# What difficulty is: KITTI's, the number of points in a box, or the same for all, so that every label is easy.
Difficulty = Literal["kitti", "points", "none"]
# The overlaps that detections of each class must exceed, the strict one first. Case does not matter in names.
Limits = Mapping[str, tuple[float, ...]]
METRICS: tuple[Metric, ...] = ("bbox", "bev", "3d", "aos")
# The official and the loose limit of overlap; in the image only the official one is used.
LIMITS: Limits = {"Car": (0.7, 0.5), "Pedestrian": (0.5, 0.25), "Cyclist": (0.5, 0.25)}
NEIGHBOURS = {"car": "van", "pedestrian": "person_sitting"}
_NO_ALPHA = -10.0
# Points of a precision-recall curve, at recall 0, 1/40 to 1. With fewer objects the last ones stay 0.
CURVE_POINTS = 41
# R40 uses recall 1/40 to 1, R11 recall 0, 1/10 to 1 of the same curve.
_RECALL_POINTS: dict[Recall, slice] = {"R40": slice(1, None), "R11": slice(0, None, 4)}


class Curve(NamedTuple):
    """The counts at the T score thresholds of one class, geometry, limit and difficulty, and the resulting curves.

    `true`, `false` and `missed` count hits, false positives and objects without a detection; `num_truths` also counts
    objects whose detection is neutral. `similarity` is the sum over the hits of (1 + cos(difference of alpha)) / 2.
    `precision` and `orientation` are the CURVE_POINTS points after the running maximum, 0 past the last threshold and
    NaN at a threshold with neither hits nor false positives. Without a camera, `similarity` and `orientation` are NaN.
    """

    num_truths: int
    thresholds: Float64[np.ndarray, " T"]
    true: Int[np.ndarray, " T"]
    false: Int[np.ndarray, " T"]
    missed: Int[np.ndarray, " T"]
    similarity: Float64[np.ndarray, " T"]
    precision: Float64[np.ndarray, " 41"]
    orientation: Float64[np.ndarray, " 41"]


class Evaluand(NamedTuple):
    """A data set prepared for evaluation: its objects, and their intersections with labels and DontCare areas."""

    truths: FlatObjects
    detections: FlatObjects
    difficulty: Difficulty
    shared: dict[Geometry, Intersections]
    dont_care: dict[Geometry, Intersections]


class Within(NamedTuple):
    """The objects in one part of a breakdown: other labels are neutral, other detections are not false positives."""

    truths: Bool[np.ndarray, " G"]
    detections: Bool[np.ndarray, " D"]


def limits_of(config: Config) -> Limits:
    """Return the limits of a config's classes: the official ones of KITTI's classes, `eval_overlap` of others."""
    official = {name.lower(): limits for name, limits in LIMITS.items()}
    return {one.name: official.get(one.name.lower(), (one.eval_overlap,)) for one in config.classes}


def check_limits(limits: Limits) -> None:
    """Raise ValueError for limits that are no overlaps, and for a class that is named twice."""
    for name, of_class in limits.items():
        if not of_class or not all(0 < limit < 1 for limit in of_class):
            raise ValueError(f"limits: {of_class} of {name} should be overlaps between 0 and 1.")
    if len({name.lower() for name in limits}) < len(limits):
        raise ValueError(f"limits: {', '.join(limits)} name a class twice; case does not matter.")


def prepare(truths: Sequence[LabelledObjects], detections: Sequence[DetectedObjects]) -> Evaluand:
    """Join frames and intersect their objects; image boxes count only if at least one label has one.

    Raises ValueError for lists of different length, and if only one of them has a camera.
    """
    if len(truths) != len(detections):
        raise ValueError(f"{len(truths)} frames of labels, {len(detections)} of detections; give one for each.")
    labels, found = flatten(truths), flatten(detections)
    cameras = {bool(np.isfinite(objects.image_boxes).all()) for objects in (labels, found) if len(objects.frame)}
    if len(cameras) > 1:
        raise ValueError("only labels or only detections have image boxes; give both or neither.")
    is_area = labels.types == DONT_CARE.lower()
    # Data without a camera has its own difficulty.
    difficulty: Difficulty = "points" if False in cameras else "kitti"
    if difficulty == "kitti" and not is_area.all() and not has_image_box(labels)[~is_area].any():
        labels, difficulty = _grade_without_image(labels)
        found = without_image(found)
    areas = select(labels, is_area)
    return Evaluand(labels, found, difficulty, intersect(labels, found), intersect(areas, found))


def is_evaluated(detections: FlatObjects, name: str, metric: Metric) -> bool:
    """Return whether the official program evaluates a class: a detection of it must have what the metric needs.

    In the image that is a non-negative left edge, in BEV and in 3D a location and a positive size. Orientation needs
    the image too, and is disabled for all classes if any detection has no alpha (-10).
    """
    found = select(detections, detections.types == name.lower())
    center, size = found.boxes.center, found.boxes.size
    if metric == "bev":
        given = ~np.isnan(center[:, 0]) & (size[:, :2] > 0).all(1)
    elif metric == "3d":
        given = ~np.isnan(center[:, 2]) & (size > 0).all(1)
    else:
        given = found.image_boxes[:, 0] >= 0
    return bool(given.any()) and not (metric == "aos" and bool((detections.alpha == _NO_ALPHA).any()))


def trace_curve(
    evaluand: Evaluand, name: str, geometry: Geometry, limit: float, level: int, within: Within | None = None
) -> Curve:
    """Return the curve of a class at a limit that the overlap must exceed and a level, an index of DIFFICULTIES.

    A first pass matches each object to the detection of highest score, and the scores of the hits give the thresholds.
    The second pass matches at each threshold by largest overlap, and uses neutral detections only for objects without
    a valid one.
    """
    case = _state_case(evaluand, name, geometry, limit, level, within)
    every = np.array([-np.inf])
    best_scored = _match(case, every, -case.score[case.second])
    num_truths = int(case.valid_truths.sum())
    hit_scores = case.score[best_scored.pairs.detection[best_scored.hits[0]]]
    thresholds = pick_thresholds(hit_scores, num_truths)

    # Neutral detections come last, in the order of rows.
    cost = np.where(case.valid_detections[case.second], -case.overlap, 0)
    match = _match(case, thresholds, cost)
    true = match.hits.sum(1)
    countable = np.flatnonzero(case.countable)
    false = ((case.score[countable] >= thresholds[:, None]) & ~match.taken[:, countable]).sum(1)
    turn = evaluand.truths.alpha[match.pairs.truth] - evaluand.detections.alpha[match.pairs.detection]
    similarity = np.where(match.hits, (1 + np.cos(turn)) / 2, 0).sum(1)
    precision, orientation = (_envelope(value, true + false) for value in (true, similarity))
    missed = num_truths - match.found.sum(1)
    return Curve(num_truths, thresholds, true, false, missed, similarity, precision, orientation)


def trace_levels(
    evaluand: Evaluand, name: str, geometry: Geometry, limit: float, within: Within | None = None
) -> tuple[Curve, ...]:
    """Return the curves of all levels of difficulty."""
    levels = range(len(DIFFICULTIES))
    return tuple(trace_curve(evaluand, name, geometry, limit, level, within) for level in levels)


def average_precision(curve: Float64[np.ndarray, " 41"], recall: Recall = "R40") -> float:
    """Return the mean of a Curve's `precision` or `orientation` in percent, over the recalls of R40 or R11."""
    return 100 * float(curve[_RECALL_POINTS[recall]].mean())


def possible_precision(num_truths: int) -> float:
    """Return the AP R40 of this number of objects if all are found with one score and nothing else is."""
    thresholds = pick_thresholds(np.ones(num_truths), num_truths)
    return average_precision(np.where(np.arange(CURVE_POINTS) < len(thresholds), 1.0, 0.0))


def _grade_without_image(labels: FlatObjects) -> tuple[FlatObjects, Difficulty]:
    """Return labels without image boxes, with a difficulty that needs none, and its kind."""
    labels = without_image(labels)
    if (labels.points >= 0).all():
        return labels._replace(difficulty=difficulty_by_points(labels.points)), "points"
    return labels._replace(difficulty=np.zeros_like(labels.difficulty)), "none"


class _Case(NamedTuple):
    """The objects that count in one curve, and the E pairs of labels and detections that may match.

    Objects of a pair that are not valid are neutral. `countable` detections are false positives if unmatched.
    """

    valid_truths: Bool[np.ndarray, " G"]
    valid_detections: Bool[np.ndarray, " D"]
    countable: Bool[np.ndarray, " D"]
    score: Float64[np.ndarray, " D"]
    first: Int[np.ndarray, " E"]
    second: Int[np.ndarray, " E"]
    overlap: Float64[np.ndarray, " E"]
    frame: Int[np.ndarray, " E"]


class _Match(NamedTuple):
    """At each threshold the matched pairs of valid labels, those that are hits, and the matched detections."""

    pairs: Pairs
    found: Bool[np.ndarray, "T E"]
    hits: Bool[np.ndarray, "T E"]
    taken: Bool[np.ndarray, "T D"]


def _state_case(
    evaluand: Evaluand, name: str, geometry: Geometry, limit: float, level: int, within: Within | None
) -> _Case:
    truths, detections = evaluand.truths, evaluand.detections
    same = truths.types == name.lower()
    valid_truths = same & (truths.difficulty >= 0) & (truths.difficulty <= level)
    height = np.abs(detections.image_boxes[:, 3] - detections.image_boxes[:, 1])
    # Height is tested before the class. Without a camera no detection is too low, as comparisons with NaN are false.
    low = height < DIFFICULTIES[level].min_height
    of_class = detections.types == name.lower()
    areas = evaluand.dont_care[geometry]
    countable = of_class & ~low
    countable[areas.second[areas.coverage > limit]] = False
    if within is not None:
        valid_truths &= within.truths
        countable &= within.detections
    pairs = evaluand.shared[geometry]
    present_truths = same | (truths.types == NEIGHBOURS.get(name.lower(), ""))
    present = of_class | low
    kept = np.flatnonzero((pairs.overlap > limit) & present_truths[pairs.first] & present[pairs.second])
    first, second = pairs.first[kept], pairs.second[kept]
    return _Case(
        valid_truths,
        of_class & ~low,
        countable,
        detections.score,
        first,
        second,
        pairs.overlap[kept],
        truths.frame[first],
    )


def _match(case: _Case, thresholds: Float64[np.ndarray, " T"], cost: Float64[np.ndarray, " E"]) -> _Match:
    pairs = order_pairs(case.first, case.second, case.frame, cost)
    visible = case.score[pairs.detection] >= thresholds[:, None]
    chosen, taken = assign(pairs, visible, len(case.score))
    found = chosen & case.valid_truths[pairs.truth]
    return _Match(pairs, found, found & case.valid_detections[pairs.detection], taken)


def _envelope(value: np.ndarray, total: Int[np.ndarray, " T"]) -> Float64[np.ndarray, " 41"]:
    """Return value / total as CURVE_POINTS points, each the maximum from there on; NaN stays, as in the devkit."""
    curve = np.zeros(CURVE_POINTS)
    np.divide(value, total, out=curve[: len(total)], where=total > 0)
    curve[: len(total)][total == 0] = np.nan
    return np.where(np.isnan(curve), np.nan, np.fmax.accumulate(curve[::-1])[::-1])
