"""What is wrong in one labelled frame: its rows, its boxes and the points inside them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Float, Int

from ciassd_jax.data.frames import Frame
from ciassd_jax.evaluation.overlap import image_overlap
from ciassd_jax.formats.custom_rows import CustomRow
from ciassd_jax.formats.kitti_boxes import boxes_to_rows
from ciassd_jax.formats.kitti_camera import view_planes
from ciassd_jax.formats.kitti_rows import ObjectRow
from ciassd_jax.ops.camera import inside_planes
from ciassd_jax.ops.footprints import box_corners
from ciassd_jax.types import Boxes

# KITTI's headings lie within half a turn; labels are rounded to two decimals, so that it may read 3.15. Other data may
# wind, but beyond two turns a number is one of degrees.
_KITTI_HEADING, _MAX_HEADING = math.pi + 0.01, 4 * math.pi
# Least median overlap of labelled and projected image boxes, which are drawn by hand: one of 155 real frames has 0.5.
_SAME = 0.25
# A cloud without points in a sector of this size does not go all around the sensor.
_MIN_GAP = math.radians(30)


class Finding(NamedTuple):
    """One sentence: file, line, problem, remedy. Serious findings must be corrected, the others are worth a look."""

    kind: str
    serious: bool
    text: str


def check_rows(frame: Frame) -> Iterator[Finding]:
    """Check the rows of a frame's labels, and that their image boxes lie where its camera sees their boxes."""
    places: dict[ObjectRow | CustomRow, str] = {}
    for row in frame.objects:
        if (first := places.setdefault(row._replace(place=""), row.place)) != row.place:
            text = f"{row.place}: the same object as in {first}; remove one of the two lines."
            yield Finding("repeated row", True, text)
    for row, size in zip(frame.objects, frame.boxes.size, strict=True):
        yield from _check_row(row, size)
    if frame.camera is not None:
        yield from _check_projection(frame)


def _check_row(row: ObjectRow | CustomRow, size: Float[np.ndarray, 3]) -> Iterator[Finding]:
    place = row.place
    if (size <= 0).any():
        edges = " x ".join(f"{edge:g}" for edge in size)
        yield Finding("size", True, f"{place}: the size {edges} is not positive; correct or remove the line.")
    if isinstance(row, CustomRow):
        if abs(row.box[6]) > _MAX_HEADING:
            text = f"{place}: the heading {row.box[6]:g} is beyond two turns; convert degrees to radians."
            yield Finding("heading", True, text)
        return
    if abs(row.rotation_y) > _KITTI_HEADING:
        text = f"{place}: the heading {row.rotation_y:g} is outside [-pi, pi]; wrap it, in radians."
        yield Finding("heading", True, text)
    if not row.has_image_box:
        yield Finding("image box", True, f"{place}: the image box is empty; write left, top, right, bottom in pixels.")
    if not 0 <= row.truncated <= 1 or row.occluded not in range(4):
        yield Finding("occlusion", True, f"{place}: truncation must lie in 0..1 and occlusion be 0, 1, 2 or 3.")
    if row.score is not None:
        yield Finding("score", False, f"{place}: a label has no score; remove the last column.")


def _check_projection(frame: Frame) -> Iterator[Finding]:
    """Compare the image boxes of fully visible objects with the projections of their boxes."""
    pairs = [
        (row, seen) for row, seen in project_rows(frame) if row.has_image_box and row.truncated == row.occluded == 0
    ]
    overlap = float(np.median([image_overlap(row.bbox, seen.bbox) if seen else 0.0 for row, seen in pairs] or [1.0]))
    if overlap < _SAME:
        text = f"the boxes project elsewhere than their image boxes lie (overlap {overlap:.2f})"
        place = f"{pairs[0][0].place} and others"
        yield Finding("projection", False, f"{place}: {text}; check that label and calibration belong together.")


def project_rows(frame: Frame) -> list[tuple[ObjectRow, ObjectRow | None]]:
    """Return each object's row, and the row made of its box in the LiDAR frame if that is in the image."""
    assert frame.camera is not None
    rows = cast(list[ObjectRow], frame.objects)
    made, kept = boxes_to_rows(frame.boxes, np.ones(len(rows)), frame.names, *frame.camera)
    seen = dict(zip(kept.tolist(), made, strict=True))
    return [(row, seen.get(index)) for index, row in enumerate(rows)]


def in_view(frame: Frame) -> Bool[np.ndarray, " G"]:
    """Return which objects have a corner that the camera sees; without a camera all of them."""
    if frame.camera is None:
        return np.ones(len(frame.names), bool)
    corners = np.asarray(box_corners(frame.boxes))
    return np.asarray(inside_planes(corners, view_planes(frame.camera)).any(1))


def explain_empty(frame: Frame, inside: Int[np.ndarray, " G"]) -> dict[int, str]:
    """Return why an object that holds no point cannot hold any, by its index, where the frame tells."""
    empty = np.flatnonzero(inside == 0)
    if not len(empty) or not len(frame.points):
        return {}
    corners = np.asarray(box_corners(Boxes(*(leaf[empty] for leaf in frame.boxes))))
    reasons = np.full(len(empty), "", object)
    distance, elevation, azimuth = _spherical(frame.points[:, :3].astype(np.float64))
    far, low, side = _spherical(corners)
    reasons[(far.min(1) > distance.max())] = "beyond the farthest point"
    reasons[(low.max(1) < elevation.min()) | (far.max(1) < distance.min())] = "in the sensor's blind zone"
    if frame.camera is not None:
        reasons[~in_view(frame)[empty]] = "outside the camera's view, to which clouds are cropped"
    else:
        start, size = _largest_gap(azimuth)
        hidden = (((side - start) % (2 * math.pi)) < size).all(1) & (size > _MIN_GAP)
        reasons[hidden] = "outside the sector that the cloud covers"
    return {index: reason for index, reason in zip(empty.tolist(), reasons.tolist(), strict=True) if reason}


def _spherical(points: Float[np.ndarray, "*n 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return distance in metres, elevation and azimuth in radians."""
    x, y, z = np.moveaxis(points, -1, 0)
    across = np.hypot(x, y)
    return np.hypot(across, z), np.arctan2(z, across), np.arctan2(y, x)


def _largest_gap(azimuth: Float[np.ndarray, " P"]) -> tuple[float, float]:
    """Return the start and size of the largest sector without points, in radians."""
    ordered = np.sort(azimuth)
    gaps = np.diff(ordered, append=ordered[0] + 2 * math.pi)
    largest = int(gaps.argmax())
    return float(ordered[largest]), float(gaps[largest])
