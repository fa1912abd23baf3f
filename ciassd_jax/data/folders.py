"""A data set from its folder, whichever layout it has, and its database."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from ciassd_jax.data.custom import open_custom
from ciassd_jax.data.frames import Dataset
from ciassd_jax.data.gt_sampling import ObjectDatabase, build_database, fingerprint_of, open_database
from ciassd_jax.data.kitti import open_kitti
from ciassd_jax.formats.errors import InputError, Pathlike


def open_dataset(root: Pathlike | None, split: str, image_size: tuple[int, int] | None = None) -> Dataset:
    """The frames of a split in a KITTI folder, or in one of OpenPCDet's custom layout.

    Without `root` the environment's KITTI_ROOT is taken. `split` is train, val, trainval, test, "all", or the name of a
    file in ROOT/ImageSets. `image_size` (width, height) stands in for that of KITTI's images. Raises InputError, one
    sentence with the remedy, for a folder or a split that is not there.
    """
    folder = find_root(root)
    return open_custom(folder, split) if is_custom(folder) else open_kitti(folder, split, image_size)


def find_root(root: Pathlike | None) -> Path:
    """The folder, or the environment's KITTI_ROOT for None; raises InputError if it has neither layout."""
    given = root if root is not None else os.environ.get("KITTI_ROOT")
    if given is None:
        raise InputError("No data set is named; give its folder, or set KITTI_ROOT to it.")
    folder = Path(given)
    if not any((folder / part).is_dir() for part in ("training", "testing", "points")):
        raise InputError(
            f"{folder} has no folder training or testing (KITTI) or points (OpenPCDet's custom layout); check the path."
        )
    return folder


def database_path(folder: Path, split: str) -> Path:
    """The file of a split's ground-truth database."""
    return folder / f"objects_{split}.bin"


def find_database(
    dataset: Dataset,
    places: Sequence[Path],
    progress: Callable[[range], Iterable[int]] = iter,
    say: Callable[[str], object] = print,
) -> ObjectDatabase:
    """The ground-truth database of a data set from the first of these files that belongs to it.

    Where none does it is built in the last place. Raises InputError for a frame or a place that cannot be used.
    """
    fingerprint = fingerprint_of(dataset)
    for place in places:
        try:
            return open_database(place, fingerprint)
        except InputError:
            continue
    say(f"Collecting the objects to paste from {len(dataset)} frames into {places[-1]}.")
    build_database(dataset, places[-1], progress)
    return open_database(places[-1], fingerprint)


def is_custom(root: Path) -> bool:
    """Whether the folder has OpenPCDet's custom layout."""
    return (root / "points").is_dir()
