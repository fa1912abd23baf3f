"""The official evaluation in plain loops over rows of text, with shapely's polygons: the tests' slow reference."""

from __future__ import annotations

import math
from typing import NamedTuple

import shapely

from ciassd_jax.formats.kitti_rows import ObjectRow

LEVELS = ((40, 0, 0.15), (25, 1, 0.30), (25, 2, 0.50))
NEIGHBOURS = {"car": "van", "pedestrian": "person_sitting"}


class PlainCurve(NamedTuple):
    num_truths: int
    thresholds: list[float]
    true: list[int]
    false: list[int]
    missed: list[int]
    similarity: list[float]
    precision: list[float]


def footprint(row: ObjectRow) -> shapely.Polygon:
    (_, width, length), (x, _, z), turn = row.dimensions, row.location, row.rotation_y
    cosine, sine = math.cos(turn), math.sin(turn)
    corners = [(length / 2, width / 2), (length / 2, -width / 2), (-length / 2, -width / 2), (-length / 2, width / 2)]
    return shapely.Polygon([(x + cosine * a + sine * b, z - sine * a + cosine * b) for a, b in corners])


def shared(first: ObjectRow, second: ObjectRow, geometry: str) -> tuple[float, float, float]:
    """What two objects share, and the size of each."""
    if geometry == "bbox":
        boxes = [shapely.box(*row.bbox) for row in (first, second)]
        return (shapely.intersection(*boxes).area, boxes[0].area, boxes[1].area)
    polygons = [footprint(row) for row in (first, second)]
    area = shapely.intersection(*polygons).area
    if geometry == "bev":
        return area, polygons[0].area, polygons[1].area
    bottom = min(first.location[1], second.location[1])
    top = max(first.location[1] - first.dimensions[0], second.location[1] - second.dimensions[0])
    sizes = [polygon.area * row.dimensions[0] for polygon, row in zip(polygons, (first, second), strict=True)]
    return area * max(bottom - top, 0), *sizes


def overlap(first: ObjectRow, second: ObjectRow, geometry: str) -> float:
    both, one, other = shared(first, second, geometry)
    return both / (one + other - both)


def truth_kind(row: ObjectRow, name: str, level: int) -> str:
    min_height, max_occlusion, max_truncation = LEVELS[level]
    kind = row.type.lower()
    if kind == name:
        easy = row.bbox[3] - row.bbox[1] > min_height
        return "valid" if easy and row.occluded <= max_occlusion and row.truncated <= max_truncation else "neutral"
    return "neutral" if kind == NEIGHBOURS.get(name) else "absent"


def detection_kind(row: ObjectRow, name: str, level: int) -> str:
    if abs(row.bbox[3] - row.bbox[1]) < LEVELS[level][0]:
        return "neutral"
    return "valid" if row.type.lower() == name else "absent"


def match(truths, detections, name, geometry, limit, level, threshold, by_score):
    """Scores and angles of the hits of one frame, the objects missed, and the false positives."""
    kinds = [detection_kind(row, name, level) for row in detections]
    seen = [row.score >= threshold and kind != "absent" for row, kind in zip(detections, kinds, strict=True)]
    free = list(seen)
    hits, missed = [], 0
    for truth in truths:
        truth_is = truth_kind(truth, name, level)
        if truth_is == "absent":
            continue
        best = None
        for index, row in enumerate(detections):
            if not free[index] or (value := overlap(truth, row, geometry)) <= limit:
                continue
            best_of_all = (1, value) if kinds[index] == "valid" else (0,)
            key = (row.score,) if by_score else best_of_all
            if best is None or key > best[0]:
                best = key, index
        if best is None:
            missed += truth_is == "valid"
            continue
        index = best[1]
        free[index] = False
        if truth_is == kinds[index] == "valid":
            hits.append((detections[index].score, truth.alpha - detections[index].alpha))
    areas = [row for row in truths if row.type.lower() == "dontcare"]
    false = 0
    for row, kind, unused in zip(detections, kinds, free, strict=True):
        if unused and kind == "valid":
            parts = (shared(area, row, geometry) for area in areas)
            false += not any(both / own > limit for both, _, own in parts)
    return hits, missed, false


def pick_thresholds(scores: list[float], number: int) -> list[float]:
    picked, recall = [], 0.0
    scores = sorted(scores, reverse=True)
    for i, score in enumerate(scores):
        left, right = (i + 1) / number, (i + 2) / number
        if i < len(scores) - 1 and right - recall < recall - left:
            continue
        picked.append(score)
        recall += 1.0 / 40
    return picked


def plain_curve(frames, name: str, geometry: str, limit: float, level: int) -> PlainCurve:
    """The curve of a class, by lower-case name, over frames of (labels, results)."""
    number = sum(truth_kind(row, name, level) == "valid" for truths, _ in frames for row in truths)
    first = [match(*frame, name, geometry, limit, level, -math.inf, True) for frame in frames]
    curve = PlainCurve(number, pick_thresholds([s for hits, *_ in first for s, _ in hits], number), [], [], [], [], [])
    for threshold in curve.thresholds:
        found = [match(*frame, name, geometry, limit, level, threshold, False) for frame in frames]
        hits = [turn for hits, *_ in found for _, turn in hits]
        curve.true.append(len(hits))
        curve.missed.append(sum(missed for _, missed, _ in found))
        curve.false.append(sum(false for *_, false in found))
        curve.similarity.append(sum((1 + math.cos(turn)) / 2 for turn in hits))
    totals = [true + false for true, false in zip(curve.true, curve.false, strict=True)]
    raw = [true / total if total else math.nan for true, total in zip(curve.true, totals, strict=True)]
    for place, value in enumerate(raw):
        curve.precision.append(value if math.isnan(value) else max(v for v in raw[place:] if not math.isnan(v)))
    curve.precision.extend([0.0] * (41 - len(raw)))
    return curve
