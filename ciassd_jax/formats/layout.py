"""How many columns the numbers of a file have that does not tell it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

_WIDTHS = range(3, 13)
# Fewer points are not judged.
_MIN_POINTS = 100
# Of a larger file these parts are read: long enough for rows of any width, far enough apart to be of different places.
_PARTS, _PART = 12, 840
# Numbers are told apart by sign, by half decades of magnitude, and by whether they are whole.
_DECADES = (10 ** np.linspace(-3, 3, 13)).astype(np.float32)
_EDGES = np.concatenate([-_DECADES[::-1], _DECADES])


def guess_columns(numbers: Float32[np.ndarray, " n"], assumed: int) -> int:
    """Return the number of columns of points read as a flat array: `assumed`, unless another fits clearly better.

    The columns of a cloud differ in sign, magnitude and wholeness. With the right number of columns, the place of a
    number in its row therefore tells much about the number; with a wrong one, every place has numbers of all columns.
    The measure is the mutual information of place and number in nats. It does not depend on the order of the points.
    """
    if len(numbers) < _MIN_POINTS * _WIDTHS[0]:
        return assumed
    information, noise = _place_information(numbers, sorted({*_WIDTHS, assumed}))
    # Multiples of the right width tell as much as the right one.
    best = min(width for width, bits in information.items() if bits >= max(information.values()) - 0.05 - noise[width])
    gain = information[best] - (0 if assumed % best == 0 else information[assumed])
    # Sensors that fire beams of two halves in turn make odd and even points differ, by up to 0.38.
    return best if gain > (0.4 if best % assumed == 0 else 0.1) + noise[best] else assumed


def looks_like_float64(data: bytes) -> bool:
    """Whether the bytes make sense as float64 and do not as float32: half of every number would be noise."""
    size = len(data) // 8
    if len(data) % 8 or size < 3 * _MIN_POINTS:
        return False
    start = (size - min(size, _PARTS * _PART)) // 2 * 8
    part = data[start : start + 8 * _PARTS * _PART]
    return _sensible(np.frombuffer(part, "<f8")) > 0.99 and _sensible(np.frombuffer(part, "<f4")) < 0.9


def _sensible(numbers: np.ndarray) -> float:
    """Return the share of numbers that are 0, NaN or of a magnitude that coordinates, intensities and times have."""
    size = np.abs(numbers)
    return float(((size == 0) | np.isnan(size) | ((size > 1e-9) & (size < 1e12))).mean())


def _place_information(
    numbers: Float32[np.ndarray, " n"], widths: list[int]
) -> tuple[dict[int, float], dict[int, float]]:
    """Return for each width what the place of a number tells about it in nats, and how far chance may change that."""
    places = np.arange(len(numbers))
    if len(places) > _PARTS * _PART:
        starts = np.linspace(0, len(numbers) - _PART, _PARTS).astype(int)
        places = (starts[:, None] + np.arange(_PART)).ravel()
    numbers = numbers[places]
    kinds = 2 * np.searchsorted(_EDGES, numbers) + (numbers == np.rint(numbers))
    _, kinds = np.unique(kinds, return_inverse=True)
    number = int(kinds.max()) + 1
    information, noise = {}, {}
    for width in widths:
        counts = np.bincount(places % width * number + kinds, minlength=width * number).reshape(width, number)
        joint = counts / len(places)
        expected = joint.sum(0) * joint.sum(1, keepdims=True)
        terms = joint * np.log(np.divide(joint, expected, where=joint > 0, out=np.ones_like(joint)))
        # Independent places and numbers give a chi-squared statistic of this many degrees of freedom.
        freedom = (width - 1) * (number - 1)
        information[width] = float(terms.sum()) - freedom / (2 * len(places))
        noise[width] = 4 * (2 * freedom) ** 0.5 / (2 * len(places))
    return information, noise
