"""Data without a camera in OpenPCDet's custom layout: ROOT/{points,labels,ImageSets}."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from ciassd_jax.data.frames import Dataset, Frame, clean_points, difficulty_by_points
from ciassd_jax.data.splits import (
    Places,
    find_file,
    present_files,
    present_paths,
    same_stem,
    split_names,
    with_suffixes,
)
from ciassd_jax.formats.custom_rows import read_custom_rows
from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.points import POINT_SUFFIXES, read_points
from ciassd_jax.ops.footprints import points_in_boxes
from ciassd_jax.types import Boxes

PLACES: Places = {"cloud": with_suffixes("points/{}", POINT_SUFFIXES), "label": ("labels/{}.txt",)}


def open_custom(
    root: Path, split: str, columns: int | Sequence[str] | None = None, *, need_labels: bool = True
) -> Dataset:
    """Open the frames listed in ROOT/ImageSets/SPLIT.txt, or all frames for the split "all".

    `columns` are those of the clouds (`read_points`). All frames have labels, unless `need_labels` is false.
    Raises InputError for a split without frames, and for frames without their files or with two clouds.
    """
    twice = same_stem(present_paths(root, PLACES["cloud"]))
    if twice:
        raise InputError(f"{twice[0]} and {twice[1]} are clouds of one frame; remove one of them.")
    needed = PLACES if need_labels else {"cloud": PLACES["cloud"]}
    return Dataset(
        split_names(root, split, root, needed),
        partial(read_custom_frame, root=root, labelled=True if need_labels else None, columns=columns),
        partial(present_files, folder=root, places=PLACES),
    )


def read_custom_frame(
    name: str,
    *,
    root: Path,
    labelled: bool | None = True,
    columns: int | Sequence[str] | None = None,
    problems: list[InputError] | None = None,
) -> Frame:
    """Read one frame, its difficulty by the number of points in a box.

    With `labelled` None a frame may lack its label file; with false it is not read. Raises InputError for a file that
    is missing or malformed. With a list of `problems`, the errors of malformed label lines are appended to it instead,
    and the frame has the other rows.
    """
    path, label = find_file(root, PLACES["cloud"], name), root / PLACES["label"][0].format(name)
    if path is None:
        raise InputError(f"{root / 'points'} has no cloud {name}; copy it, or remove the frame from the split.")
    points = clean_points(read_points(path, columns), path)
    read = label.is_file() if labelled is None else labelled
    rows = tuple(read_custom_rows(label, problems)) if read else None
    boxes = Boxes.from_array(np.array([row.box for row in rows or ()], np.float64).reshape(-1, 7))
    inside = np.asarray(points_in_boxes(points, boxes)).sum(-1)
    names = tuple(row.type for row in rows or ())
    return Frame(name, points, boxes, names, difficulty_by_points(inside), None, rows)
