"""A data set from its folder, in KITTI's layout or in OpenPCDet's custom one."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ciassd_jax.data.custom import PLACES as CUSTOM_PLACES
from ciassd_jax.data.custom import open_custom
from ciassd_jax.data.frames import Dataset
from ciassd_jax.data.kitti import kitti_folder, open_kitti
from ciassd_jax.data.splits import Places
from ciassd_jax.formats.errors import InputError, Pathlike


def open_dataset(
    root: Pathlike | None,
    split: str,
    image_size: tuple[int, int] | None = None,
    columns: int | Sequence[str] | None = None,
    *,
    need_labels: bool = True,
) -> Dataset:
    """Open the frames of a split in a KITTI folder, or in one of OpenPCDet's custom layout.

    `root` defaults to the environment variable KITTI_ROOT. `split` is train, val, trainval, test, "all", the name of a
    file in ROOT/ImageSets, or the path of such a file. `image_size` (width, height) overrides that of KITTI's images,
    `columns` are those of the clouds (`read_points`). Every frame has labels, except those of KITTI's test or with
    `need_labels` false. Raises InputError, one sentence with the remedy, for a folder or a split that does not exist,
    and for frames without their files.
    """
    folder = find_root(root)
    if is_custom(folder):
        dataset = open_custom(folder, split, columns, need_labels=need_labels)
    else:
        dataset = open_kitti(folder, split, image_size, columns, need_labels=need_labels)
    options = [f"{name} {value}" for name, value in (("image_size", image_size), ("columns", columns)) if value]
    return replace(dataset, options=", ".join(options))


def find_root(root: Pathlike | None) -> Path:
    """Return the folder, or KITTI_ROOT's for None; raises InputError if it has neither layout."""
    given = root if root is not None else os.environ.get("KITTI_ROOT")
    if given is None:
        raise InputError("No data set is named; give its folder, or set KITTI_ROOT to it.")
    folder = Path(given)
    if not (is_kitti(folder) or is_custom(folder)):
        raise InputError(
            f"{folder} has no folder training or testing (KITTI) or points (OpenPCDet's custom layout); check the path."
        )
    return folder


def is_kitti(folder: Path) -> bool:
    """Return whether the folder has the layout of KITTI's object benchmark."""
    return any((folder / part).is_dir() for part in ("training", "testing"))


def is_custom(folder: Path) -> bool:
    """Return whether the folder has OpenPCDet's custom layout, which takes precedence over KITTI's."""
    return (folder / "points").is_dir()


def frame_files(root: Path, split: str) -> tuple[Path, Places]:
    """Return the folder of a split's frames, and the files that each of them has there."""
    return (root, CUSTOM_PLACES) if is_custom(root) else kitti_folder(root, split)
