"""`ciassd data suggest`: a config for a data set."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from ciassd_jax.cli.config_options import ConfigOptions
from ciassd_jax.cli.messages import describe, frames_with_bar, warnings_as_lines
from ciassd_jax.cli.options import Columns, File, ImageSize, Split, Unset, read_columns
from ciassd_jax.data.folders import find_root, open_dataset
from ciassd_jax.data.splits import ALL
from ciassd_jax.evaluation.suggest import suggest_config
from ciassd_jax.formats.writing import check_file, write_text


@dataclass(frozen=True)
class Suggest:
    """Print a config with classes, range and capacities for a data set as JSON; sentences on it go to stderr."""

    root: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(help_behavior_hint="")] = None
    """Folder in KITTI's or OpenPCDet's custom layout; by default the variable KITTI_ROOT."""
    split: Split[str] = ALL
    """The frames to fit: train, val, trainval, all, or a file that lists them."""
    classes: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="TYPE [TYPE ...]", help_behavior_hint="")] = None
    """The types to learn. Default: all with at least 5 % of the objects."""
    config_options: Annotated[ConfigOptions, tyro.conf.OmitArgPrefixes] = field(default_factory=ConfigOptions)
    image_size: ImageSize = None
    columns: Columns = None
    out: File[Unset[Path]] = None
    """Write the config to this file instead."""

    def run(self) -> int:
        root, base, columns = find_root(self.root), self.config_options.resolve(), read_columns(self.columns)
        if self.out is not None:
            check_file(self.out)
        with warnings_as_lines(root):
            dataset = open_dataset(root, self.split, self.image_size, columns, need_labels=False)
            config, notes = suggest_config(dataset, base, classes=self.classes, track=frames_with_bar)
        if self.config_options == ConfigOptions():
            print("Based on the preset car; --preset car_lite is sized for a CPU.", file=sys.stderr)
        print(*map(describe, notes), sep="\n", file=sys.stderr)
        if self.out is None:
            print(config.to_json())
        else:
            write_text(self.out, config.to_json())
            print(f"Wrote {self.out}.", file=sys.stderr)
        return 0
