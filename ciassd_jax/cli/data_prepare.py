"""`ciassd data prepare`: the ground-truth database that training samples objects from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ciassd_jax.cli.messages import UsageError, frames_with_bar, warnings_as_lines
from ciassd_jax.cli.options import ImageSize, Unset
from ciassd_jax.data.folders import find_root, is_custom, open_dataset
from ciassd_jax.data.gt_sampling import build_database, database_path
from ciassd_jax.data.kitti import write_reduced
from ciassd_jax.formats.writing import check_folder


@dataclass(frozen=True)
class Prepare:
    """Build the ground-truth database that training samples objects from."""

    root: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(help_behavior_hint="")] = None
    """Folder in KITTI's or OpenPCDet's custom layout; by default the variable KITTI_ROOT."""
    split: str = "train"
    """The frames whose objects are collected."""
    out: Unset[Path] = None
    """Folder for the database. Default: the data set's own."""
    reduce: bool = False
    """First crop the full clouds of a KITTI folder to the camera's view, and write them to velodyne_reduced."""
    image_size: ImageSize = None

    def run(self) -> int:
        root = find_root(self.root)
        path = database_path(self.out or root, self.split)
        check_folder(path.parent)
        with warnings_as_lines(root):
            if self.reduce:
                if is_custom(root):
                    raise UsageError(f"{root} has no camera to crop clouds to; leave out --reduce.")
                print(f"Wrote {write_reduced(root, self.image_size, frames_with_bar)} cropped clouds.")
            dataset = open_dataset(root, self.split, self.image_size)
            build_database(dataset, path, frames_with_bar)
        print(f"Wrote the objects of {len(dataset)} frames to {path}.")
        return 0
