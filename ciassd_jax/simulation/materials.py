"""How materials reflect the rays: intensity as in KITTI, lost returns, and penetration."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Material(NamedTuple):
    """A surface as the sensor sees it.

    `reflectance` is the typical intensity at normal incidence and `spread` its standard deviation from point to point.
    `loss` is the fraction of rays that never return, and `depth` the mean penetration in metres (leaves, a cabin).
    """

    reflectance: float
    spread: float
    loss: float
    depth: float


# Fitted by eye to the reflectance of points in six full KITTI frames and of the labelled objects in 155 frames.
_TABLE = {
    "asphalt": Material(0.28, 0.06, 0.0, 0.0),
    "paving": Material(0.34, 0.07, 0.0, 0.0),
    "grass": Material(0.36, 0.12, 0.03, 0.0),
    "paint": Material(1.0, 0.07, 0.04, 0.0),
    "glass": Material(0.0, 0.05, 0.85, 0.4),
    "trim": Material(0.0, 0.03, 0.10, 0.0),
    "tyre": Material(0.0, 0.05, 0.10, 0.0),
    "plate": Material(0.95, 0.10, 0.0, 0.0),
    "cloth": Material(0.25, 0.15, 0.02, 0.03),
    "foliage": Material(0.32, 0.14, 0.05, 0.35),
    "spokes": Material(0.25, 0.15, 0.45, 0.02),
    "wood": Material(0.28, 0.08, 0.0, 0.0),
    "wall": Material(0.36, 0.10, 0.0, 0.0),
    "metal": Material(0.40, 0.20, 0.02, 0.0),
    "ego": Material(0.0, 0.0, 1.0, 0.0),
}
NAMES = tuple(_TABLE)
# One row of the four values per material.
MATERIALS = np.array(list(_TABLE.values()), np.float32)


def material(name: str) -> int:
    """Return the index of a material in `MATERIALS`."""
    return NAMES.index(name)
