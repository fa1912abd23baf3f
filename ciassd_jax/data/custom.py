"""One's own data without a camera, in OpenPCDet's custom layout: ROOT/{points,labels,ImageSets}."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ciassd_jax.data.frames import Dataset, Frame, clean_points, difficulty_by_points
from ciassd_jax.data.splits import Places, present_files, split_names
from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.kitti import read_lines
from ciassd_jax.formats.points import read_points
from ciassd_jax.ops.footprints import points_in_boxes
from ciassd_jax.types import Boxes

PLACES: Places = {"cloud": ("points/{}.npy",), "label": ("labels/{}.txt",)}
_COLUMNS = "x y z dx dy dz heading class"


class CustomRow(NamedTuple):
    """One object: the box as (x, y, z, length, width, height, yaw) in the LiDAR frame, and its type."""

    box: tuple[float, ...]
    type: str


def open_custom(root: Path, split: str) -> Dataset:
    """The frames that ROOT/ImageSets/SPLIT.txt lists, or every one for the split "all"; all of them are labelled."""
    names = split_names(root, split, root, PLACES)
    return Dataset(names, partial(read_custom_frame, root=root), partial(present_files, folder=root, places=PLACES))


def read_custom_frame(name: str, *, root: Path) -> Frame:
    """Read one frame; difficulty is by the number of points in a box. Raises InputError for a malformed file."""
    path = root / PLACES["cloud"][0].format(name)
    points = clean_points(read_points(path), path)
    rows = read_custom_rows(root / PLACES["label"][0].format(name))
    boxes = Boxes.from_array(np.array([row.box for row in rows], np.float64).reshape(-1, 7))
    inside = np.asarray(points_in_boxes(points, boxes)).sum(-1)
    return Frame(name, points, boxes, tuple(row.type for row in rows), difficulty_by_points(inside), None)


def read_custom_rows(path: Path) -> list[CustomRow]:
    """Read a label file of rows `x y z dx dy dz heading class`; an empty file holds no objects.

    Raises InputError, one sentence with file, line and remedy, for any other line.
    """
    return [parse_custom_row(line, place) for place, line in read_lines(path)]


def parse_custom_row(line: str, place: str) -> CustomRow:
    """Read one line; `place` names it in the InputError for a line that is no row."""
    columns = line.split()
    if len(columns) != 8:
        raise InputError(f"{place}: {len(columns)} columns; a label has the 8 {_COLUMNS}, so write it again.")
    try:
        box = tuple(float(column) for column in columns[:7])
    except ValueError as error:
        raise InputError(f"{place}: {error}; write a number there.") from None
    if not np.isfinite(box).all():
        raise InputError(f"{place}: a value is not finite; write a number there.")
    return CustomRow(box, columns[7])
