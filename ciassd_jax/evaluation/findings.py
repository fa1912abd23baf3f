"""What a check of a data set found."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int

from ciassd_jax.formats.kitti_camera import Camera
from ciassd_jax.formats.kitti_rows import ObjectRow


class Finding(NamedTuple):
    """One sentence: file, line, what, remedy. Serious ones must be mended, the others are worth a look."""

    kind: str
    serious: bool
    text: str


class Labelled(NamedTuple):
    """One object of a label file: where its line is, and its box in the LiDAR frame (x, y, z, l, w, h, yaw)."""

    place: str
    type: str
    box: Float64[np.ndarray, " 7"]
    # The line itself, for KITTI's layout.
    row: ObjectRow | None


class CheckedFrame(NamedTuple):
    """A frame that could be read: its objects, how many points each of them holds, and the amounts of the cloud."""

    name: str
    camera: Camera | None
    objects: tuple[Labelled, ...]
    inside: Int[np.ndarray, " G"]
    points: int
    voxels: int


class TypeSummary(NamedTuple):
    """The objects of one type: how many, how many of them out of the grid's range and without any point.

    `size` (length, width, height) and `center_z` are medians in metres.
    """

    objects: int
    out_of_range: int
    without_points: int
    size: tuple[float, float, float]
    center_z: float


class Report(NamedTuple):
    """The check of a data set: what was found, every frame that could be read, and its objects by type."""

    findings: tuple[Finding, ...]
    frames: tuple[CheckedFrame, ...]
    types: dict[str, TypeSummary]
