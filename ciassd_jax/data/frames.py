"""One labelled frame on the host, before any padding, and the data set that it comes from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int

from ciassd_jax.formats.custom_rows import CustomRow
from ciassd_jax.formats.errors import Pathlike, warn_of_file
from ciassd_jax.formats.kitti_camera import Camera
from ciassd_jax.formats.kitti_rows import ObjectRow, is_dont_care
from ciassd_jax.types import Boxes

# Number of points inside an object from which it is easy, moderate, hard, for data without a camera.
_POINTS_OF_DIFFICULTY = (100, 30, 5)


class Frame(NamedTuple):
    """A labelled frame of P points and G objects in the LiDAR frame, as NumPy arrays.

    `points` (x, y, z, intensity) are finite and, with a camera, only those that it sees. `boxes` are float64 and
    `names` the types of the objects, in the order of the label file without DontCare. `difficulty` is 0 (easy), 1,
    2 (hard) or -1 (none of them): KITTI's with a camera, `difficulty_by_points` without one. `rows` are the rows of
    the label file as read, DontCare among them: KITTI's with a camera. They are None for a frame without labels.
    """

    name: str
    points: Float32[np.ndarray, "P 4"]
    boxes: Boxes
    names: tuple[str, ...]
    difficulty: Int[np.ndarray, " G"]
    camera: Camera | None
    rows: tuple[ObjectRow, ...] | tuple[CustomRow, ...] | None = None

    @property
    def objects(self) -> list[ObjectRow | CustomRow]:
        """The rows of the objects, in the order of `boxes`: all but DontCare."""
        return [row for row in self.rows or () if isinstance(row, CustomRow) or not is_dont_care(row.type)]


@dataclass(frozen=True)
class Dataset:
    """The frames of one split by name; `read_frame` reads one of them. Worker processes can pickle it.

    `find_files` returns the files that a frame is read from; None for frames that do not come from files. `options` are
    those of reading that change the frames, as text.
    """

    names: tuple[str, ...]
    read_frame: Callable[[str], Frame]
    find_files: Callable[[str], tuple[Path, ...]] | None = None
    options: str = ""

    def __len__(self) -> int:
        return len(self.names)

    def read(self, index: int) -> Frame:
        """Read the frame `names[index]`; raises InputError for a file that cannot be used."""
        return self.read_frame(self.names[index])

    def sources(self, index: int) -> tuple[Path, ...]:
        """Return the files that the frame `names[index]` is read from."""
        return self.find_files(self.names[index]) if self.find_files else ()


def difficulty_by_points(inside: Int[np.ndarray, " G"]) -> Int[np.ndarray, " G"]:
    """Return the difficulty by the number of points inside each box: 0 from 100, 1 from 30, 2 from 5, else -1."""
    levels = (inside[:, None] >= np.array(_POINTS_OF_DIFFICULTY)).sum(-1)
    return np.where(levels > 0, len(_POINTS_OF_DIFFICULTY) - levels, -1)


def clean_points(points: Float32[np.ndarray, "N 4"], path: Pathlike) -> Float32[np.ndarray, "P 4"]:
    """Return the finite points of a file; a FormatWarning tells how many are not."""
    finite = np.isfinite(points).all(1)
    if finite.all():
        return points
    text = f"{path}: {(~finite).sum()} of {len(points)} points are not finite; they were left out."
    warn_of_file(text, path, stacklevel=4)
    return points[finite]
