"""Checks of labelled objects: each by itself, and all objects of a type together."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ciassd_jax.config import Config
from ciassd_jax.evaluation.findings import Finding, Labelled
from ciassd_jax.formats.custom_rows import parse_custom_row
from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.kitti_boxes import boxes_to_rows, rows_to_boxes
from ciassd_jax.formats.kitti_camera import Calibration, Camera
from ciassd_jax.formats.kitti_rows import DONT_CARE, OBJECT_TYPES, ObjectRow, parse_row
from ciassd_jax.formats.lines import read_lines

# Labels are rounded to two decimals, so half a turn may read 3.15.
_LARGEST_HEADING = math.pi + 0.01
# A type is long when its objects are typically so much longer than wide.
_LONG = 1.5
# Image boxes are drawn by hand, not projected: in one of 155 real frames they overlap by less than a half.
_SAME = 0.25
_FEW = 5


def read_labelled(path: Path, calibration: Calibration | None) -> tuple[list[Labelled], list[Finding]]:
    """The objects of a label file, KITTI's with a calibration, and a finding for every line that is no row."""
    objects, findings = [], []
    try:
        lines = read_lines(path)
    except InputError as error:
        return [], [Finding("label file", True, str(error))]
    seen: dict[str, str] = {}
    for place, line in lines:
        if seen.setdefault(line.strip(), place) != place:
            text = f"{place}: the same object as in {seen[line.strip()]}; remove one of the two lines."
            findings.append(Finding("repeated row", True, text))
        try:
            if calibration is None:
                custom = parse_custom_row(line, place)
                objects.append(Labelled(place, custom.type, np.array(custom.box), None))
            else:
                row = parse_row(line, place)
                if row.type != DONT_CARE:
                    box = np.asarray(rows_to_boxes([row], calibration).to_array()[0])
                    objects.append(Labelled(place, row.type, box, row))
        except InputError as error:
            findings.append(Finding("label row", True, str(error)))
    return objects, findings


def check_object(labelled: Labelled) -> Iterator[Finding]:
    """What is odd about one object by itself."""
    place, row, size = labelled.place, labelled.row, labelled.box[3:6]
    if (size <= 0).any():
        shown = " x ".join(f"{edge:g}" for edge in size)
        yield Finding("size", True, f"{place}: the size {shown} is not positive; mend or remove the line.")
    heading = labelled.box[6] if row is None else row.rotation_y
    if abs(heading) > _LARGEST_HEADING:
        yield Finding(
            "heading", True, f"{place}: the heading {heading:g} is outside [-pi, pi]; write it in radians, wrapped."
        )
    if row is not None:
        yield from _check_row(labelled.place, row)


def _check_row(place: str, row: ObjectRow) -> Iterator[Finding]:
    if row.type not in OBJECT_TYPES:
        yield Finding(
            "type", True, f"{place}: the type '{row.type}' is none of KITTI's; write {', '.join(OBJECT_TYPES)}."
        )
    x1, y1, x2, y2 = row.bbox
    if x2 <= x1 or y2 <= y1:
        yield Finding(
            "image box", True, f"{place}: the image box is empty; write its left, top, right and bottom edge in pixels."
        )
    if not 0 <= row.truncated <= 1 or row.occluded not in range(4):
        yield Finding(
            "occlusion", True, f"{place}: truncation must lie in 0..1 and occlusion be 0, 1, 2 or 3; mend the line."
        )
    if row.score is not None:
        yield Finding("score", False, f"{place}: a label has no score; remove the last column.")


def check_projection(objects: Sequence[Labelled], camera: Camera) -> Iterator[Finding]:
    """A frame whose boxes project elsewhere than its image boxes lie: those of objects that are seen whole."""
    every = [labelled.row for labelled in objects if labelled.row is not None]
    rows = [row for row in every if row.truncated == 0 and row.occluded == 0]
    boxes = rows_to_boxes(rows, camera.calibration)
    projected, kept = boxes_to_rows(boxes, np.zeros(len(rows)), [row.type for row in rows], *camera)
    overlaps = [0.0] * (len(rows) - len(kept))
    overlaps += [
        _image_overlap(rows[index].bbox, row.bbox) for index, row in zip(kept.tolist(), projected, strict=True)
    ]
    if overlaps and np.median(overlaps) < _SAME:
        text = (
            f"{objects[0].place} and others: the boxes project elsewhere than their image boxes lie (overlap "
            f"{np.median(overlaps):.2f}); check that label and calibration belong together."
        )
        yield Finding("projection", False, text)


def _image_overlap(a: Sequence[float], b: Sequence[float]) -> float:
    """Intersection over union of two image boxes (x1, y1, x2, y2); 0 where one of them is empty."""
    shared = math.prod(max(min(a[i + 2], b[i + 2]) - max(a[i], b[i]), 0) for i in (0, 1))
    areas = sum((box[2] - box[0]) * (box[3] - box[1]) for box in (a, b))
    return shared / (areas - shared) if shared else 0.0


def check_types(objects: Sequence[Labelled], config: Config) -> Iterator[Finding]:
    """What is odd about the objects of each type together: length and width swapped, heights, range."""
    by_type: dict[str, list[Labelled]] = {}
    for labelled in objects:
        by_type.setdefault(labelled.type, []).append(labelled)
    for name, same in by_type.items():
        boxes = np.stack([labelled.box for labelled in same])
        yield from _check_lengths(name, same, boxes)
        yield from _check_heights(name, same, boxes, config)


def _check_lengths(name: str, same: list[Labelled], boxes: np.ndarray) -> Iterator[Finding]:
    ratio = boxes[:, 3] / np.where(boxes[:, 4] > 0, boxes[:, 4], np.inf)
    typical = np.median(ratio)
    if len(same) >= _FEW and typical < 1 / 1.2:
        yield Finding(
            "swapped",
            True,
            f"{same[0].place} and others: {(ratio < 1).sum()} of {len(same)} objects of type {name} are wider than "
            "long; swap their length and width.",
        )
    elif len(same) >= _FEW and typical > _LONG:
        for index in np.flatnonzero(ratio < 1):
            length, width = boxes[index, 3:5]
            yield Finding(
                "swapped",
                False,
                f"{same[index].place}: this {name} is {length:g} m long and {width:g} m wide; swap the two.",
            )


def _check_heights(name: str, same: list[Labelled], boxes: np.ndarray, config: Config) -> Iterator[Finding]:
    """Targets with their centre above or below the grid; a class whose centres are typically not at its anchors."""
    low, high = config.grid.minimum[2], config.grid.maximum[2]
    for wanted in config.classes:
        if name not in (wanted.name, *wanted.similar):
            continue
        for index in np.flatnonzero((boxes[:, 2] < low) | (boxes[:, 2] > high)):
            text = (
                f"{same[index].place}: the centre of this {name} is at z = {boxes[index, 2]:.2f}, outside the grid's "
                f"{low:g}..{high:g} m; check the line, or choose the grid for it."
            )
            yield Finding("height", False, text)
        typical = float(np.median(boxes[:, 2]))
        if name == wanted.name and len(same) >= _FEW and abs(typical - wanted.center_z) > wanted.height / 2:
            text = (
                f"{same[0].place} and others: the centres of type {name} are typically at z = {typical:.2f}, but its "
                f"anchors at {wanted.center_z:g}; check that z is the middle of the box, or set the class's center_z."
            )
            yield Finding("height", False, text)
