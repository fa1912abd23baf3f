"""How hard KITTI calls an object: image height, occlusion and truncation (SPEC section 1.4)."""

from __future__ import annotations

from typing import NamedTuple

from ciassd_jax.formats.kitti import ObjectRow


class Difficulty(NamedTuple):
    """A level and what it admits: image boxes higher than `min_height` pixels, and the others up to their maximum."""

    name: str
    min_height: float
    max_occlusion: int
    max_truncation: float


DIFFICULTIES = (
    Difficulty("easy", 40, 0, 0.15),
    Difficulty("moderate", 25, 1, 0.30),
    Difficulty("hard", 25, 2, 0.50),
)


def difficulty_of(row: ObjectRow) -> int:
    """Index in DIFFICULTIES of the easiest level that admits a labelled object, -1 where none does.

    As in the devkit, an object exactly as high as the minimum is not admitted, one exactly at a maximum is.
    """
    height = row.bbox[3] - row.bbox[1]
    for index, level in enumerate(DIFFICULTIES):
        # Comparisons with NaN are false: what is not known is not admitted.
        if height > level.min_height and row.occluded <= level.max_occlusion and row.truncated <= level.max_truncation:
            return index
    return -1
