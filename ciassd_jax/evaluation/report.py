"""An evaluation as text and as JSON: the block that other toolboxes print, and tables."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence

from ciassd_jax.evaluation.breakdown import Row
from ciassd_jax.evaluation.kitti_ap import CURVE_POINTS, METRICS, Metric, Recall, average_precision
from ciassd_jax.evaluation.summary import Counts, Evaluation
from ciassd_jax.formats.kitti_rows import DIFFICULTIES

# Keys are class, metric, R11 or R40, and limit of overlap.
Precisions = dict[str, dict[str, dict[str, dict[str, list[float | None] | None]]]]

_RECALLS: tuple[Recall, ...] = ("R11", "R40")
_LEVELS = "".join(f"{level.name:>10}" for level in DIFFICULTIES)


def to_json(evaluation: Evaluation) -> Precisions:
    """Return AP in percent as {"Car": {"3d": {"R40": {"0.70": [easy, moderate, hard]}}}}.

    The keys are all classes, metrics (bbox, bev, 3d, aos), R11 and R40, and limits of overlap. The value is None if
    the official program does not evaluate it; None in a list stands for NaN.
    """
    result: Precisions = {}
    for name, metric, limit in evaluation.curves:
        for recall in _RECALLS:
            values = evaluation.precision(name, metric, limit, recall)
            by_limit = result.setdefault(name, {}).setdefault(metric, {}).setdefault(recall, {})
            numbers = None if values is None else [None if math.isnan(value) else value for value in values]
            by_limit[f"{limit:.2f}"] = numbers
    return result


def format_block(evaluation: Evaluation) -> str:
    """Return the block that other toolboxes print and scripts parse, without classes that have no detections."""
    lines = []
    for name, limits in evaluation.limits.items():
        if all(evaluation.curves[name, metric, limits[0]] is None for metric in METRICS):
            continue
        for limit in limits:
            for recall in _RECALLS:
                title = "AP" if recall == "R11" else "AP_R40"
                lines.append(f"{name} {title}@{limits[0]:.2f}, {limit:.2f}, {limit:.2f}:")
                lines += _block_lines(evaluation, name, limit, recall)
    return "\n".join(lines)


def format_report(evaluation: Evaluation) -> str:
    """Return `format_block` and `format_tables`."""
    return f"{format_block(evaluation)}\n\n{format_tables(evaluation)}".strip()


def format_json(evaluation: Evaluation) -> str:
    """Return `to_json` as text."""
    return json.dumps(to_json(evaluation), indent=1, allow_nan=False)


def format_tables(evaluation: Evaluation) -> str:
    """Return tables of AP, in total, by distance and by number of points, with the correlation and notes."""
    parts = [_main_table(evaluation)]
    for title, rows in (("distance", evaluation.by_distance), ("number of points", evaluation.by_points)):
        if rows:
            parts.append(f"By {title}, AP (R40)\n{_align([_HEAD_OF_PARTS, *map(_part_line, rows)])}")
    known = [f"{name} {value:.3f}" for name, value in evaluation.correlation.items() if not math.isnan(value)]
    if known:
        parts.append(f"Correlation (PCC) of confidence and 3D overlap: {', '.join(known)}.")
    return "\n\n".join(parts + list(_notes(evaluation)))


_HEAD = "class", f"{'metric':<8}{'overlap':>7}{'R40':>6}{_LEVELS}{'R11':>6}{_LEVELS}"
_HEAD_OF_PARTS = "class", f"{'metric':<8}{'part':>14}{_LEVELS}{'objects':>10}{_LEVELS}"
# What difficulty is without KITTI's.
_DIFFICULTY = {
    "points": "difficulty is by the number of points in an object's box",
    "none": "every label counts at every level, as the points in the boxes are not known here",
}


def _block_lines(evaluation: Evaluation, name: str, limit: float, recall: Recall) -> Iterable[str]:
    official = evaluation.limits[name][0]
    for metric in METRICS:
        values = evaluation.precision(name, metric, limit if metric in ("bev", "3d") else official, recall)
        # Other toolboxes omit orientation if it is disabled, but no other metric.
        if values is not None or metric != "aos":
            shown = ", ".join(f"{value:.4f}" for value in values or [math.nan] * len(DIFFICULTIES))
            yield f"{metric:<4} AP:{shown}"


def _main_table(evaluation: Evaluation) -> str:
    lines = [_HEAD]
    for name, limits in evaluation.limits.items():
        rows = [
            (name, _main_line(evaluation, name, metric, limit))
            for limit in limits
            for metric in METRICS
            if evaluation.curves.get((name, metric, limit)) is not None
        ]
        lines += rows or [(name, "not evaluated, as there is no detection of it, or none has what a metric needs")]
    return f"AP in percent by KITTI's rules, frames: {evaluation.num_frames}\n{_align(lines)}"


def _main_line(evaluation: Evaluation, name: str, metric: Metric, limit: float) -> str:
    r40, r11 = (_columns(evaluation.precision(name, metric, limit, recall) or []) for recall in ("R40", "R11"))
    return f"{metric:<8}{limit:>7.2f}{'':6}{r40}{'':6}{r11}"


def _part_line(row: Row) -> tuple[str, str]:
    # Without objects there is no AP, rather than one of 0.
    values = [average_precision(curve.precision) if curve.num_truths else math.nan for curve in row.curves]
    counts = "".join(f"{curve.num_truths:>10}" for curve in row.curves)
    return row.name, f"{row.geometry:<8}{row.part:>14}{_columns(values)}{'':10}{counts}"


def _align(lines: Sequence[tuple[str, str]]) -> str:
    """Return lines of a class and what is said of it, with the first column as wide as its longest name."""
    width = max(12, *(len(name) + 2 for name, _ in lines))
    return "\n".join(f"{name:<{width}}{text}" for name, text in lines)


def _columns(values: Iterable[float]) -> str:
    return "".join(f"{'-' if math.isnan(value) else f'{value:.2f}':>10}" for value in values)


def _notes(evaluation: Evaluation) -> Iterable[str]:
    if evaluation.left_out:
        parts = (_phrase(counts) + f" of {name}" for name, counts in evaluation.left_out.items())
        yield f"Not evaluated: {', '.join(parts)}."
    if unlabelled := [name for name in evaluation.limits if not _num_labels(evaluation, name)]:
        yield f"There is no label of {', '.join(unlabelled)}, so the AP says nothing there."
    total, unboxed = evaluation.total, evaluation.without_image_box
    if not evaluation.has_camera:
        yield (
            f"None of the {total.labels} labels has an image box, so none has KITTI's difficulty: "
            f"{_DIFFICULTY[evaluation.difficulty]}, no detection is too low, and bbox and aos are not evaluated; these "
            "are not KITTI's numbers."
        )
    elif unboxed.labels:
        yield f"{unboxed.labels} of {total.labels} labels have no image box, so no difficulty: they do not count."
    if evaluation.has_camera and unboxed.detections:
        yield f"{unboxed.detections} of {total.detections} detections have no image box: too low, they do not count."
    if evaluation.has_camera and all(
        evaluation.curves[name, "aos", limits[0]] is None for name, limits in evaluation.limits.items()
    ):
        yield "Orientation (aos) is not evaluated: there is no detection, one has alpha -10, or none is in the image."
    if not evaluation.by_points:
        yield "Nothing by number of points, as the points in the boxes are not known here."
    if min(_counts(evaluation), default=CURVE_POINTS) < CURVE_POINTS:
        yield (
            f"By the official rule n objects fill n points of the curve, so that fewer than {CURVE_POINTS} cannot "
            "reach 100 by R40."
        )


def _num_labels(evaluation: Evaluation, name: str) -> int:
    """Return the number of labels of a class that any level admits; 1 for a class that is not evaluated."""
    curves = [curves for (of, *_), curves in evaluation.curves.items() if of == name and curves is not None]
    return max((curve.num_truths for each in curves for curve in each), default=1)


def _counts(evaluation: Evaluation) -> Iterable[int]:
    """Return the numbers of objects behind each number of the tables."""
    shown = [curves for curves in evaluation.curves.values() if curves is not None]
    shown += [row.curves for row in evaluation.by_distance + evaluation.by_points]
    return (curve.num_truths for curves in shown for curve in curves)


def _phrase(counts: Counts) -> str:
    """Return "2 labels and 1 detection", without what there is none of."""
    parts = zip(counts, ("label", "detection"), strict=True)
    return " and ".join(f"{number} {what}{'s' * (number != 1)}" for number, what in parts if number)
