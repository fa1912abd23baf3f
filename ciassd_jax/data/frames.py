"""One labelled frame on the host, before any padding, and the data set that it comes from."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from ciassd_jax.formats.kitti_camera import Camera
from ciassd_jax.types import Boxes


class Frame(NamedTuple):
    """A labelled frame of P points and G objects in the LiDAR frame, as NumPy arrays.

    Where there is a camera, `points` (x, y, z, intensity) are those that it sees. `boxes` are float64, `names` the
    types of the objects in the order of the label file without DontCare. `difficulty` is 0 (easy), 1, 2 (hard) or
    -1 (none of them): KITTI's of the label with a camera (SPEC 1.4), without one `difficulty_by_points`.
    """

    name: str
    points: Float32[np.ndarray, "P 4"]
    boxes: Boxes
    names: tuple[str, ...]
    difficulty: Int[np.ndarray, " G"]
    camera: Camera | None


@dataclass(frozen=True)
class Dataset:
    """The frames of one split by name; `read_frame` reads one of them. Workers can pickle it."""

    names: tuple[str, ...]
    read_frame: Callable[[str], Frame]

    def __len__(self) -> int:
        return len(self.names)

    def read(self, index: int) -> Frame:
        """The frame with that place in `names`; raises FormatError for a file that cannot be used."""
        return self.read_frame(self.names[index])


# An object with so many points inside is easy, moderate, hard where no camera says how large it looks.
_POINTS_OF_DIFFICULTY = (50, 20, 5)


def difficulty_by_points(points: Float[np.ndarray, "P C"], boxes: Boxes) -> Int[np.ndarray, " G"]:
    """Difficulty by the number of points inside a box: 0 from 50, 1 from 20, 2 from 5, else -1."""
    inside = points_inside(points, boxes).sum(-1)
    levels = sum((inside >= least).astype(np.int64) for least in _POINTS_OF_DIFFICULTY)
    return np.where(levels > 0, len(_POINTS_OF_DIFFICULTY) - levels, -1)


def points_inside(points: Float[np.ndarray, "P C"], boxes: Boxes) -> Bool[np.ndarray, "G P"]:
    """Which points (x, y, z first) lie strictly inside which box; in float64, false for NaN."""
    inside = np.zeros((len(boxes.yaw), len(points)), bool)
    x, y, z = points[:, :3].T.astype(np.float64)
    for index, (center, half, yaw) in enumerate(zip(boxes.center, boxes.size / 2, boxes.yaw, strict=True)):
        reach = math.hypot(half[0], half[1])
        near = np.flatnonzero((np.abs(x - center[0]) < reach) & (np.abs(y - center[1]) < reach))
        forward, left = x[near] - center[0], y[near] - center[1]
        along = np.abs(forward * math.cos(yaw) + left * math.sin(yaw)) < half[0]
        across = np.abs(left * math.cos(yaw) - forward * math.sin(yaw)) < half[1]
        inside[index, near] = along & across & (np.abs(z[near] - center[2]) < half[2])
    return inside
