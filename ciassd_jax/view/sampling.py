"""Which points and boxes of a frame can be shown, with one sentence for each reason to leave some out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

# Coordinates in metres beyond this are stray values, which would shrink the scene to a speck.
FARTHEST = 300.0


class ShownPoints(NamedTuple):
    """The points (x, y, z) that are shown, and notes on what is left out."""

    points: Float[np.ndarray, "M 3"]
    notes: tuple[str, ...]


class ShownBoxes(NamedTuple):
    """The indices of the boxes that are shown, and notes on what is left out."""

    indices: Int[np.ndarray, " M"]
    notes: tuple[str, ...]


def choose_points(points: Float[np.ndarray, "N columns"], most: int) -> ShownPoints:
    """Choose at most `most` points that are finite and within `FARTHEST`, sampled evenly and deterministically."""
    places, given = points[:, :3], len(points)
    finite = np.isfinite(places).all(1)
    near = (np.abs(places) <= FARTHEST).all(1)
    notes = []
    if not finite.all():
        notes.append(f"{given - finite.sum():,} of {given:,} points are not finite and not shown.")
    if (far := int((finite & ~near).sum())) > 0:
        notes.append(f"{far:,} of {given:,} points lie farther than {FARTHEST:g} m and are not shown.")
    chosen = np.flatnonzero(near)
    if len(chosen) > most:
        chosen = chosen[thin(len(chosen), most)]
        notes.append(f"{most:,} of {given:,} points are shown, chosen evenly.")
    return ShownPoints(places[chosen], tuple(notes))


def choose_boxes(
    boxes: Float[np.ndarray, "D 7"], what: str, scores: Float[np.ndarray, " D"] | None = None
) -> ShownBoxes:
    """Choose the usable boxes, with finite scores if scores are given; `what` names the boxes in the note."""
    chosen = np.flatnonzero(usable_boxes(boxes) & (True if scores is None else np.isfinite(scores)))
    lost = len(boxes) - len(chosen)
    notes = (f"{lost} of {len(boxes)} {what} are not finite or too far and not shown.",) if lost else ()
    return ShownBoxes(chosen, notes)


def thin(count: int, most: int) -> Int[np.ndarray, " most"]:
    """Return one index from each of `most` equal parts of range(count), the same ones in every call."""
    borders = np.arange(most + 1) * count // most
    # A random index of each part: a fixed stride through an organised cloud would leave out whole rings.
    place = np.random.default_rng(0).random(most)
    return borders[:-1] + (place * np.diff(borders)).astype(np.int64)


def usable_boxes(boxes: Float[np.ndarray, "D 7"]) -> Bool[np.ndarray, " D"]:
    """Return whether each box is finite, with coordinates and sizes of at most `FARTHEST`."""
    # Comparisons with NaN are false.
    return (np.abs(boxes[:, :6]) <= FARTHEST).all(1) & np.isfinite(boxes[:, 6])
