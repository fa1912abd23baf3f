"""Which points and boxes of a frame can be shown, and one sentence for each reason to leave some out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

# Farther from the sensor, in metres along an axis, lie only stray numbers that would make the scene a speck.
FARTHEST = 300.0


class ShownPoints(NamedTuple):
    """The points x, y, z that are shown, and what was left out."""

    points: Float[np.ndarray, "M 3"]
    notes: tuple[str, ...]


def choose_points(points: Float[np.ndarray, "N columns"], most: int) -> ShownPoints:
    """At most so many points: those that are finite and within `FARTHEST`, evenly thinned; always the same ones."""
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


def thin(count: int, most: int) -> Int[np.ndarray, " most"]:
    """One index out of each of `most` equal parts of range(count), always the same ones."""
    borders = np.arange(most + 1) * count // most
    # Not the first of each part: a fixed stride through an organised cloud would leave out whole rings of it.
    place = np.random.default_rng(0).random(most)
    return borders[:-1] + (place * np.diff(borders)).astype(np.int64)


def usable_boxes(boxes: Float[np.ndarray, "D 7"]) -> Bool[np.ndarray, " D"]:
    """Whether each box has finite numbers and lies within `FARTHEST`, itself no larger."""
    # Comparisons with NaN are false.
    return (np.abs(boxes[:, :6]) <= FARTHEST).all(1) & np.isfinite(boxes[:, 6])
