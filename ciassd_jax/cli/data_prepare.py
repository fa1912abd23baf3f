"""`ciassd data prepare`: the ground-truth database that training samples objects from."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from ciassd_jax.cli.config_options import ConfigOptions
from ciassd_jax.cli.messages import UsageError, frames_with_bar, warnings_as_lines
from ciassd_jax.cli.options import Columns, Folder, ImageSize, Split, Unset, read_columns
from ciassd_jax.config import Config
from ciassd_jax.data.folders import find_root, is_custom, open_dataset
from ciassd_jax.data.gt_sampling import (
    ObjectDatabase,
    build_database,
    database_path,
    eligible_objects,
    open_database,
)
from ciassd_jax.data.kitti import write_reduced
from ciassd_jax.formats.writing import check_file


@dataclass(frozen=True)
class Prepare:
    """Build the ground-truth database that training samples objects from."""

    root: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(help_behavior_hint="")] = None
    """Folder in KITTI's or OpenPCDet's custom layout; by default the variable KITTI_ROOT."""
    split: Split[str] = "train"
    """The frames whose objects are collected."""
    out: Folder[Unset[Path]] = None
    """Folder for the database. Default: the data set's own."""
    reduce: bool = False
    """First crop the full clouds of a KITTI folder to the camera's view, and write them to velodyne_reduced."""
    image_size: ImageSize = None
    columns: Columns = None
    config_options: Annotated[ConfigOptions, tyro.conf.OmitArgPrefixes] = field(default_factory=ConfigOptions)

    def run(self) -> int:
        root, columns = find_root(self.root), read_columns(self.columns)
        path = database_path(self.out or root, self.split)
        check_file(path)
        with warnings_as_lines(root):
            if self.reduce:
                if is_custom(root):
                    raise UsageError(f"{root} has no camera to crop clouds to; leave out --reduce.")
                print(f"Wrote {write_reduced(root, self.image_size, frames_with_bar, columns)} cropped clouds.")
            dataset = open_dataset(root, self.split, self.image_size, columns)
            build_database(dataset, path, frames_with_bar)
        print(f"Wrote the objects of {len(dataset)} frames to {path}.")
        print(_describe_classes(open_database(path, dataset), self.config_options.resolve()))
        return 0


def _describe_classes(database: ObjectDatabase, config: Config) -> str:
    """How many objects of each class training can sample."""
    strict = config.data.augmentation.difficulty_filter
    counts = {one.name: len(eligible_objects(database, one, difficulty_filter=strict)) for one in config.classes}
    found = ", ".join(f"{count} of class {name}" for name, count in counts.items())
    types = ", ".join(database.names) or "none"
    remedy = "" if any(counts.values()) else "; choose classes with `ciassd data suggest`"
    return f"Training can sample {found}; the labels have the types {types}{remedy}."
