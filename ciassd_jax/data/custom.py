"""Data without a camera in OpenPCDet's custom layout: ROOT/{points,labels,ImageSets}."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from ciassd_jax.data.frames import Dataset, Frame, clean_points, difficulty_by_points
from ciassd_jax.data.splits import Places, present_files, split_names
from ciassd_jax.formats.custom_rows import read_custom_rows
from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.points import read_points
from ciassd_jax.ops.footprints import points_in_boxes
from ciassd_jax.types import Boxes

PLACES: Places = {"cloud": ("points/{}.npy",), "label": ("labels/{}.txt",)}


def open_custom(root: Path, split: str) -> Dataset:
    """Open the frames listed in ROOT/ImageSets/SPLIT.txt, or all frames for the split "all"; all have labels."""
    names = split_names(root, split, root, PLACES)
    return Dataset(names, partial(read_custom_frame, root=root), partial(present_files, folder=root, places=PLACES))


def read_custom_frame(
    name: str, *, root: Path, labelled: bool = True, problems: list[InputError] | None = None
) -> Frame:
    """Read one frame, its difficulty by the number of points in a box.

    Raises InputError for a file that is missing or malformed. With a list of `problems`, the errors of malformed label
    lines are appended to it instead, and the frame has the other rows.
    """
    path = root / PLACES["cloud"][0].format(name)
    points = clean_points(read_points(path), path)
    rows = tuple(read_custom_rows(root / PLACES["label"][0].format(name), problems)) if labelled else None
    boxes = Boxes.from_array(np.array([row.box for row in rows or ()], np.float64).reshape(-1, 7))
    inside = np.asarray(points_in_boxes(points, boxes)).sum(-1)
    names = tuple(row.type for row in rows or ())
    return Frame(name, points, boxes, names, difficulty_by_points(inside), None, rows)
