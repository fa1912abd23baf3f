"""Average precision by KITTI's official rules, in float64 NumPy (SPEC section 11.2).

Objects that a level of difficulty does not admit, and neighbour classes, are neutral: they take a detection, and
neither is counted. So are detections too low for the level, whatever their class.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int

from ciassd_jax.evaluation.matching import assign, order_candidates, pick_thresholds
from ciassd_jax.evaluation.objects import DetectedObjects, FlatObjects, LabelledObjects, flatten, select
from ciassd_jax.evaluation.overlap import Geometry, Intersections, intersect
from ciassd_jax.formats.kitti_difficulty import DIFFICULTIES

Metric = Literal["bbox", "bev", "3d", "aos"]
METRICS: tuple[Metric, ...] = ("bbox", "bev", "3d", "aos")
# The official and the loose limit of overlap; in the image the official one alone.
LIMITS = {"Car": (0.7, 0.5), "Pedestrian": (0.5, 0.25), "Cyclist": (0.5, 0.25)}
_NEIGHBOURS = {"Car": "van", "Pedestrian": "person_sitting", "Cyclist": ""}
_NO_ALPHA = -10.0
_VALID, _NEUTRAL, _ABSENT = 0, 1, -1
# Places in the curve: recall 1/40 to 1 (R40), and 0, 1/10 to 1 of the same curve (R11).
_RECALL_PLACES = {"R40": slice(1, 41), "R11": slice(0, 41, 4)}


class Curve(NamedTuple):
    """What happens at the T thresholds of one class, geometry, limit and difficulty.

    `true`, `false` and `missed` count hits, false positives and objects without a detection; an object whose
    detection is neutral is none of them, yet one of `num_truths`. `similarity` is the sum of the orientation
    scores (1 + cos(difference of alpha)) / 2 of the hits. `precision` and `orientation` are the 41 points after the
    running maximum, 0 past the last threshold. Where a threshold finds neither hit nor false positive they are NaN.
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
    """The curve of a class at one limit of overlap and one level, an index of DIFFICULTIES; overlap must exceed it."""
    truths, detections, score = evaluand.truths, evaluand.detections, evaluand.detections.score
    truth_status = _truth_status(truths, name, level, within)
    status = _detection_status(detections, name, level)
    pairs = evaluand.shared[geometry]
    overlap = pairs.overlap
    kept = (overlap > limit) & (truth_status[pairs.first] != _ABSENT) & (status[pairs.second] != _ABSENT)
    first, second, overlap = pairs.first[kept], pairs.second[kept], overlap[kept]
    num_truths = int((truth_status == _VALID).sum())

    best_score = order_candidates(first, second, truths.frame[first], (-score[second],))
    chosen, _ = assign(best_score, np.ones((1, len(first)), bool), len(score))
    hit = chosen[0] & (truth_status[best_score.truth] == _VALID) & (status[best_score.detection] == _VALID)
    thresholds = pick_thresholds(score[best_score.detection[hit]], num_truths)

    neutral = status[second] == _NEUTRAL
    best_overlap = order_candidates(first, second, truths.frame[first], (neutral, np.where(neutral, 0, -overlap)))
    visible = score[best_overlap.detection] >= thresholds[:, None]
    chosen, taken = assign(best_overlap, visible, len(score))
    found = chosen & (truth_status[best_overlap.truth] == _VALID)
    hits = found & (status[best_overlap.detection] == _VALID)
    true = hits.sum(1)
    false = _count_false(
        evaluand,
        geometry,
        limit,
        (status == _VALID) & (True if within is None else within.detections),
        thresholds,
        taken,
    )
    turn = truths.alpha[best_overlap.truth] - detections.alpha[best_overlap.detection]
    similarity = np.where(hits, (1 + np.cos(turn)) / 2, 0).sum(1)
    return Curve(
        num_truths,
        thresholds,
        true,
        false,
        num_truths - found.sum(1),
        similarity,
        _envelope(true, true + false),
        _envelope(similarity, true + false),
    )


def average_precision(curve: Float64[np.ndarray, " 41"], recall: Literal["R11", "R40"] = "R40") -> float:
    """Mean of a Curve's `precision` or `orientation`, in percent, over the recalls 1/40 to 1 or 0, 1/10 to 1."""
    return 100 * float(curve[_RECALL_PLACES[recall]].mean())


def _truth_status(truths: FlatObjects, name: str, level: int, within: Within | None) -> Int[np.ndarray, " G"]:
    same = truths.types == name.lower()
    admitted = same & (truths.difficulty >= 0) & (truths.difficulty <= level)
    if within is not None:
        admitted &= within.truths
    neighbour = truths.types == _NEIGHBOURS[name]
    return np.where(admitted, _VALID, np.where(same | neighbour, _NEUTRAL, _ABSENT))


def _detection_status(detections: FlatObjects, name: str, level: int) -> Int[np.ndarray, " D"]:
    height = np.abs(detections.image_boxes[:, 3] - detections.image_boxes[:, 1])
    # The height comes before the class, and without a camera no detection is too low: NaN compares false.
    low = height < DIFFICULTIES[level].min_height
    return np.where(low, _NEUTRAL, np.where(detections.types == name.lower(), _VALID, _ABSENT))


def _count_false(
    evaluand: Evaluand,
    geometry: Geometry,
    limit: float,
    countable: Bool[np.ndarray, " D"],
    thresholds: Float64[np.ndarray, " T"],
    taken: Bool[np.ndarray, "T D"],
) -> Int[np.ndarray, " T"]:
    """Visible detections that nothing took and no DontCare area excuses."""
    areas = evaluand.dont_care[geometry]
    excused = np.zeros(len(countable), bool)
    excused[areas.second[areas.coverage > limit]] = True
    index = np.flatnonzero(countable & ~excused)
    return ((evaluand.detections.score[index] >= thresholds[:, None]) & ~taken[:, index]).sum(1)


def _envelope(value: np.ndarray, total: Int[np.ndarray, " T"]) -> Float64[np.ndarray, " 41"]:
    """41 points of value / total, each the maximum from there on; NaN stays where it stands, as in the devkit."""
    curve = np.zeros(41)
    np.divide(value, total, out=curve[: len(total)], where=total > 0)
    curve[: len(total)][total == 0] = np.nan
    return np.where(np.isnan(curve), np.nan, np.fmax.accumulate(curve[::-1])[::-1])
