"""Average precision by KITTI's official rules, in float64 NumPy (SPEC section 11.2).

Objects that a level of difficulty does not admit, and neighbour classes, are neutral: they take a detection, and
neither is counted. So are detections too low for the level, whatever their class.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int

from ciassd_jax.evaluation.matching import Candidates, assign, order_candidates, pick_thresholds
from ciassd_jax.evaluation.objects import DetectedObjects, FlatObjects, LabelledObjects, flatten, select
from ciassd_jax.evaluation.overlap import Geometry, Intersections, intersect
from ciassd_jax.formats.kitti_rows import DIFFICULTIES

Metric = Literal["bbox", "bev", "3d", "aos"]
Recall = Literal["R11", "R40"]
METRICS: tuple[Metric, ...] = ("bbox", "bev", "3d", "aos")
# The official and the loose limit of overlap; in the image the official one alone.
LIMITS = {"Car": (0.7, 0.5), "Pedestrian": (0.5, 0.25), "Cyclist": (0.5, 0.25)}
_NEIGHBOURS = {"Car": "van", "Pedestrian": "person_sitting", "Cyclist": ""}
_NO_ALPHA = -10.0
# Places in the curve: recall 1/40 to 1 (R40), and 0, 1/10 to 1 of the same curve (R11).
_RECALL_PLACES: dict[Recall, slice] = {"R40": slice(1, 41), "R11": slice(0, 41, 4)}


class Curve(NamedTuple):
    """What happens at the T thresholds of one class, geometry, limit and difficulty.

    `true`, `false` and `missed` count hits, false positives and objects without a detection; an object whose
    detection is neutral is none of them, yet one of `num_truths`. `similarity` is the sum of the orientation
    scores (1 + cos(difference of alpha)) / 2 of the hits. `precision` and `orientation` are the 41 points after the
    running maximum, 0 past the last threshold. Where a threshold finds neither hit nor false positive they are NaN;
    without a camera so is all that is about orientation.
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
    """A set made ready: its objects in flat arrays, and what each label and each DontCare area shares with them."""

    truths: FlatObjects
    detections: FlatObjects
    shared: dict[Geometry, Intersections]
    dont_care: dict[Geometry, Intersections]

    @property
    def has_camera(self) -> bool:
        """Whether the objects have image boxes; without labels nothing says that they have not."""
        return bool(np.isfinite(self.truths.image_boxes).all())


class Within(NamedTuple):
    """The objects that a row of a breakdown is about: other labels are neutral, other detections never false."""

    truths: Bool[np.ndarray, " G"]
    detections: Bool[np.ndarray, " D"]


def prepare(truths: Sequence[LabelledObjects], detections: Sequence[DetectedObjects]) -> Evaluand:
    """Join frames and intersect their objects.

    Raises ValueError for lists of different length, and where only one of them has a camera.
    """
    if len(truths) != len(detections):
        raise ValueError(f"{len(truths)} frames of labels, {len(detections)} of detections; give one for each.")
    labels, found = flatten(truths), flatten(detections)
    cameras = {bool(np.isfinite(objects.image_boxes).all()) for objects in (labels, found) if len(objects.frame)}
    if len(cameras) > 1:
        raise ValueError("only labels or only detections have image boxes; give both or neither.")
    areas = select(labels, labels.types == "dontcare")
    return Evaluand(labels, found, intersect(labels, found), intersect(areas, found))


def is_evaluated(detections: FlatObjects, name: str, metric: Metric) -> bool:
    """Whether the official program evaluates a class at all: some detection of it must have what the metric needs.

    In the image that is a left edge that is not negative, in the plane and in space a place there and a positive
    size. Orientation needs the image, and is off for all classes where any detection gives no alpha (-10).
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
    """The curve of a class at one limit of overlap and one level, an index of DIFFICULTIES; overlap must exceed it.

    A first pass without thresholds gives each object its best score, and the hits' scores give the thresholds; at
    each of them the second gives it the best overlap, and the first neutral detection only where there is no valid.
    """
    case = _state_case(evaluand, name, geometry, limit, level, within)
    every = np.array([-np.inf])
    best_scored = _match(case, every, -case.score[case.second])
    num_truths = int(case.valid_truths.sum())
    hit_scores = case.score[best_scored.candidates.detection[best_scored.hits[0]]]
    thresholds = pick_thresholds(hit_scores, num_truths)

    # Neutral ones come last, in the order of rows.
    cost = np.where(case.valid_detections[case.second], -case.overlap, 0)
    match = _match(case, thresholds, cost)
    true = match.hits.sum(1)
    countable = np.flatnonzero(case.countable)
    false = ((case.score[countable] >= thresholds[:, None]) & ~match.taken[:, countable]).sum(1)
    turn = evaluand.truths.alpha[match.candidates.truth] - evaluand.detections.alpha[match.candidates.detection]
    similarity = np.where(match.hits, (1 + np.cos(turn)) / 2, 0).sum(1)
    precision, orientation = (_envelope(value, true + false) for value in (true, similarity))
    missed = num_truths - match.found.sum(1)
    return Curve(num_truths, thresholds, true, false, missed, similarity, precision, orientation)


def trace_levels(
    evaluand: Evaluand, name: str, geometry: Geometry, limit: float, within: Within | None = None
) -> tuple[Curve, ...]:
    """The curves of all levels of difficulty."""
    levels = range(len(DIFFICULTIES))
    return tuple(trace_curve(evaluand, name, geometry, limit, level, within) for level in levels)


def average_precision(curve: Float64[np.ndarray, " 41"], recall: Recall = "R40") -> float:
    """Mean of a Curve's `precision` or `orientation`, in percent, over the recalls 1/40 to 1 or 0, 1/10 to 1."""
    return 100 * float(curve[_RECALL_PLACES[recall]].mean())


class _Case(NamedTuple):
    """Who counts in one curve, and the E pairs of labels and detections that may match.

    What is not valid among the pairs is neutral. `countable` detections are false where nothing takes them.
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
    """At each threshold the pairs of valid objects, those of them that are hits, and the detections taken."""

    candidates: Candidates
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
    # The height comes before the class, and without a camera no detection is too low: NaN compares false.
    low = height < DIFFICULTIES[level].min_height
    of_class = detections.types == name.lower()
    areas = evaluand.dont_care[geometry]
    countable = of_class & ~low
    countable[areas.second[areas.coverage > limit]] = False
    if within is not None:
        valid_truths &= within.truths
        countable &= within.detections
    pairs = evaluand.shared[geometry]
    present_truths, present = same | (truths.types == _NEIGHBOURS[name]), of_class | low
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
    candidates = order_candidates(case.first, case.second, case.frame, cost)
    visible = case.score[candidates.detection] >= thresholds[:, None]
    chosen, taken = assign(candidates, visible, len(case.score))
    found = chosen & case.valid_truths[candidates.truth]
    return _Match(candidates, found, found & case.valid_detections[candidates.detection], taken)


def _envelope(value: np.ndarray, total: Int[np.ndarray, " T"]) -> Float64[np.ndarray, " 41"]:
    """41 points of value / total, each the maximum from there on; NaN stays where it stands, as in the devkit."""
    curve = np.zeros(41)
    np.divide(value, total, out=curve[: len(total)], where=total > 0)
    curve[: len(total)][total == 0] = np.nan
    return np.where(np.isnan(curve), np.nan, np.fmax.accumulate(curve[::-1])[::-1])
