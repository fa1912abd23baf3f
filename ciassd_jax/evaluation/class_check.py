"""Whether the labelled objects of a data set fit the classes of a config, and what they score as detections."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ciassd_jax.config import ClassConfig, Config
from ciassd_jax.data.frames import Frame
from ciassd_jax.evaluation.frame_check import Finding, project_rows
from ciassd_jax.evaluation.kitti_ap import METRICS, Metric, limits_of, possible_precision
from ciassd_jax.evaluation.objects import DetectedObjects, LabelledObjects, detections_from_rows, labels_from_rows
from ciassd_jax.evaluation.summary import evaluate

# Median length / width below which a type has them swapped, and above which a single object may have.
_WIDE, _LONG = 1 / 1.2, 1.5
# Fewer objects have no typical shape and height.
_FEW = 5
# Edges of this length in metres are of another unit.
_METRES = 60.0
# Share of a class that may lie outside the range, and relative difference of a typical object and its anchor.
_MAX_OUTSIDE, _MAX_DIFFERENCE = 0.1, 0.3


class Labels(NamedTuple):
    """All objects of a data set: types, places ("FILE, line N"), boxes, and how many points each holds."""

    types: np.ndarray
    places: np.ndarray
    boxes: Float[np.ndarray, "G 7"]
    inside: Int[np.ndarray, " G"]


class TypeSummary(NamedTuple):
    """The objects of one type: their number, how many are out of the range, and how many hold no point.

    `size` (length, width, height) and `center_z` are medians in metres.
    """

    objects: int
    out_of_range: int
    without_points: int
    size: tuple[float, float, float]
    center_z: float


class LabelScore(NamedTuple):
    """AP R40 in percent of the labels as detections, for one class and metric, at each difficulty.

    `possible` is what the official rule gives for this number of objects if all are found: 100 from CURVE_POINTS on.
    """

    name: str
    metric: Metric
    objects: tuple[int, ...]
    score: tuple[float, ...]
    possible: tuple[float, ...]


def join_labels(frames: Sequence[Frame], inside: Sequence[Int[np.ndarray, " G"]]) -> Labels:
    """Join the objects of frames."""
    return Labels(
        np.array([name for frame in frames for name in frame.names], np.str_),
        np.array([row.place for frame in frames for row in frame.objects], np.str_),
        np.concatenate([np.zeros((0, 7)), *(np.asarray(frame.boxes.to_array()) for frame in frames)]),
        np.concatenate([np.zeros(0, np.int64), *inside]),
    )


def summarise_types(labels: Labels, config: Config) -> dict[str, TypeSummary]:
    """Summarise the objects of each type, the most frequent type first."""
    outside = _out_of_range(labels.boxes, config)
    summaries = {}
    for name, count in Counter(labels.types.tolist()).most_common():
        mine = labels.types == name
        z, length, width, height = np.median(labels.boxes[mine, 2:6], axis=0).tolist()
        empty = int((labels.inside[mine] == 0).sum())
        summaries[name] = TypeSummary(count, int(outside[mine].sum()), empty, (length, width, height), z)
    return summaries


def count_targets(labels: Labels, config: Config) -> dict[str, int]:
    """Return how many objects of each class that has any lie in the range."""
    label, inside = _targets(labels, config), ~_out_of_range(labels.boxes, config)
    counts = {name: int((inside & (label == index)).sum()) for index, name in enumerate(config.class_names)}
    return {name: count for name, count in counts.items() if count}


def check_classes(labels: Labels, config: Config) -> Iterator[Finding]:
    """Find what keeps a config from learning these objects."""
    label = _targets(labels, config)
    types = Counter(labels.types.tolist())
    for name in types:
        yield from _check_edges(name, labels.places[labels.types == name], labels.boxes[labels.types == name])
    if not types:
        yield Finding("no object", True, "No frame has a labelled object; check the labels.")
    elif (label < 0).all():
        found = ", ".join(f"{name} ({count})" for name, count in types.most_common())
        learned = ", ".join(config.class_names)
        remedy = "write a config for them with `ciassd data suggest`"
        yield Finding("class", True, f"No object is of a class that is learned ({learned}), but {found}; {remedy}.")
    else:
        yield from _check_case(labels, label, config)
        yield from _check_others(labels.types[label < 0], (label >= 0).sum(), config)
        for index, one in enumerate(config.classes):
            yield from _check_class(one, labels.places[label == index], labels.boxes[label == index], config)


def _targets(labels: Labels, config: Config) -> Int[np.ndarray, " G"]:
    """Return the class of each object, -1 for an object of none."""
    by_name = config.labels_by_name(similar=config.data.augmentation.similar_classes)
    return np.array([by_name.get(name.lower(), -1) for name in labels.types.tolist()], np.int64)


def _out_of_range(boxes: Float[np.ndarray, "G 7"], config: Config) -> Bool[np.ndarray, " G"]:
    low, high = (np.array(limit) for limit in config.range)
    return np.asarray(((boxes[:, :3] < low) | (boxes[:, :3] > high)).any(-1))


def _check_edges(name: str, places: np.ndarray, boxes: Float[np.ndarray, "G 7"]) -> Iterator[Finding]:
    """Find length and width swapped."""
    ratio = boxes[:, 3] / np.where(boxes[:, 4] > 0, boxes[:, 4], np.inf)
    if len(boxes) >= _FEW and np.median(ratio) < _WIDE:
        text = f"{(ratio < 1).sum()} of {len(boxes)} objects of type {name} are wider than long"
        yield Finding("swapped", True, f"{places[0]} and others: {text}; swap their length and width.")
    elif len(boxes) >= _FEW and np.median(ratio) > _LONG:
        for index in np.flatnonzero(ratio < 1):
            text = f"this {name} is {boxes[index, 3]:g} m long and {boxes[index, 4]:g} m wide; swap the two."
            yield Finding("swapped", False, f"{places[index]}: {text}")


def _check_case(labels: Labels, label: Int[np.ndarray, " G"], config: Config) -> Iterator[Finding]:
    """Find types that are written otherwise than in the config."""
    written = {name for one in config.classes for name in (one.name, *one.similar)}
    for name in dict.fromkeys(labels.types[label >= 0].tolist()):
        if name not in written:
            mine = np.flatnonzero(labels.types == name)
            text = f"{labels.places[mine[0]]}: the type {name} ({len(mine)} objects) is learned as the class"
            yield Finding("case", False, f"{text} {config.class_names[label[mine[0]]]}, because case does not matter.")


def _check_others(types: np.ndarray, learned: int, config: Config) -> Iterator[Finding]:
    """Find a type that is not learned although it has more objects than the classes."""
    for name, count in Counter(types.tolist()).most_common(1):
        if count > learned:
            text = f"{count} objects are of type {name}, but only {learned} of a class that is learned"
            remedy = "learn it, or list it under `similar` of a class, if it is one of them"
            yield Finding("class", False, f"{text} ({', '.join(config.class_names)}); {remedy}.")


def _check_class(
    one: ClassConfig, places: np.ndarray, boxes: Float[np.ndarray, "G 7"], config: Config
) -> Iterator[Finding]:
    """Check range, typical size and typical height of the objects of a class."""
    remedy = "as `ciassd data suggest` does"
    if not len(boxes):
        yield Finding("class", False, f"No object is of class {one.name}; remove it from the config, {remedy}.")
        return
    outside = np.flatnonzero(_out_of_range(boxes, config))
    if len(outside) > _MAX_OUTSIDE * len(boxes):
        extent = ", ".join(f"{axis} {low:g}..{high:g}" for axis, low, high in zip("xyz", *config.range, strict=True))
        share = f"{len(outside)} of {len(boxes)} objects of class {one.name} ({len(outside) / len(boxes):.0%})"
        text = f"{share} lie outside the range {extent} m, the first {places[outside[0]]}"
        text = f"{text}; check them, or fit the range, {remedy}."
        yield Finding("range", len(outside) == len(boxes), text)
    if len(boxes) < _FEW:
        return
    typical = np.median(boxes, axis=0)
    if typical[3:6].max() > _METRES:
        text = f"objects of class {one.name} are typically {typical[3:6].max():g} m long"
        yield Finding("anchor", True, f"{places[0]} and others: {text}; write metres.")
        return
    # A footprint is the same whichever of its edges is called length. Anchors are matched by it alone.
    shape, anchor = np.sort(typical[3:5]), np.sort([one.length, one.width])
    if (np.maximum(shape / anchor, anchor / shape.clip(1e-9)) > 1 + _MAX_DIFFERENCE).any():
        text = f"objects of class {one.name} are typically {shape[1]:.2f} x {shape[0]:.2f} m large"
        text = f"{text}, but its anchors {anchor[1]:g} x {anchor[0]:g} m, so that few match"
        yield Finding("anchor", False, f"{places[0]} and others: {text}; set the class's length and width, {remedy}.")
    center_z = one.center_z - config.input.z_shift
    if abs(typical[2] - center_z) > one.height / 2:
        text = f"objects of class {one.name} are typically centred at z = {typical[2]:.2f}, its anchors at {center_z:g}"
        check = "check that z is the middle of the box, or set the class's center_z"
        yield Finding("height", False, f"{places[0]} and others: {text}; {check}, {remedy}.")


def score_labels(frames: Sequence[Frame], inside: Sequence[Int[np.ndarray, " G"]], config: Config) -> list[LabelScore]:
    """Score the labels as detections of score 1, for every class and metric that can be evaluated.

    `inside` is the number of points in each box of each frame.
    """
    pairs, limits = [_as_detections(*each) for each in zip(frames, inside, strict=True)], limits_of(config)
    found = evaluate([truth for truth, _ in pairs], [detections for _, detections in pairs], limits)
    scores = []
    for name, (limit, *_) in limits.items():
        for metric in METRICS:
            curves, score = found.curves[name, metric, limit], found.precision(name, metric, limit)
            if curves is not None and score is not None:
                objects = tuple(curve.num_truths for curve in curves)
                scores.append(LabelScore(name, metric, objects, tuple(score), tuple(map(possible_precision, objects))))
    return scores


def _as_detections(frame: Frame, inside: Int[np.ndarray, " G"]) -> tuple[LabelledObjects, DetectedObjects]:
    """Return the labels and the same as detections; with a camera, through the LiDAR frame and back."""
    if frame.camera is None:
        labels = LabelledObjects(frame.names, frame.difficulty, frame.boxes)
        return labels, DetectedObjects(frame.names, np.ones(len(frame.names)), frame.boxes)
    pairs, fields = project_rows(frame), ("location", "dimensions", "rotation_y")
    found = [row._replace(score=1.0, **{name: getattr(seen or row, name) for name in fields}) for row, seen in pairs]
    return labels_from_rows([row for row, _ in pairs])._replace(points=inside), detections_from_rows(found)


def check_scores(scores: Sequence[LabelScore]) -> Iterator[Finding]:
    """Find classes whose labels score less than is possible."""
    for one in scores:
        if one.score != one.possible:
            score, possible = (", ".join(f"{value:.2f}" for value in values) for values in (one.score, one.possible))
            text = f"{one.name} {one.metric}: labels as detections score {score} where {possible} is possible"
            yield Finding("score", True, f"{text}; look for labels that cover each other.")
