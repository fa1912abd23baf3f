"""The levels of difficulty, at and beside their limits."""

from itertools import pairwise

import pytest

from ciassd_jax.formats.kitti import ObjectRow
from ciassd_jax.formats.kitti_difficulty import DIFFICULTIES, difficulty_of


def car(height: float, occluded: int = 0, truncated: float = 0.0) -> ObjectRow:
    return ObjectRow("Car", truncated, occluded, 0.0, (0, 0, 50, height), (1.5, 1.6, 4), (0, 1.7, 20), 0.0)


@pytest.mark.parametrize(
    ("height", "occluded", "truncated", "expected"),
    [
        (41, 0, 0.0, 0),
        (40, 0, 0.0, 1),
        (25, 0, 0.0, -1),
        (25.01, 0, 0.0, 1),
        (99, 1, 0.0, 1),
        (99, 2, 0.0, 2),
        (99, 3, 0.0, -1),
        (99, -1, -1.0, 0),
        (99, 0, 0.15, 0),
        (99, 0, 0.1501, 1),
        (99, 0, 0.3, 1),
        (99, 0, 0.31, 2),
        (99, 0, 0.5, 2),
        (99, 0, 0.51, -1),
    ],
)
def test_difficulty(height: float, occluded: int, truncated: float, expected: int) -> None:
    assert difficulty_of(car(height, occluded, truncated)) == expected


def test_levels_are_nested() -> None:
    for easier, harder in pairwise(DIFFICULTIES):
        assert easier.min_height >= harder.min_height
        assert easier.max_occlusion < harder.max_occlusion
        assert easier.max_truncation < harder.max_truncation
