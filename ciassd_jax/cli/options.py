"""Options that several commands share, and the labelled frames that they select."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import tyro

from ciassd_jax.cli.messages import UsageError, values_from_options
from ciassd_jax.data.folders import find_root, open_dataset
from ciassd_jax.data.frames import Dataset
from ciassd_jax.formats.points import parse_columns
from ciassd_jax.simulation import open_synthetic, split_synthetic

T = TypeVar("T")
# An option without a default; the help does not print "default: None".
Unset = Annotated[T | None, tyro.conf.arg(help_behavior_hint="")]
# The word in the help for a value.
File = Annotated[T, tyro.conf.arg(metavar="FILE")]
Folder = Annotated[T, tyro.conf.arg(metavar="FOLDER")]
WeightsFile = Annotated[T, tyro.conf.arg(metavar="FILE|NAME")]
Split = Annotated[T, tyro.conf.arg(metavar="SPLIT")]
Steps = Annotated[T, tyro.conf.arg(metavar="STEPS")]
Epochs = Annotated[T, tyro.conf.arg(metavar="EPOCHS")]
ImageSize = Annotated[
    tuple[int, int] | None,
    tyro.conf.arg(
        metavar="WIDTH HEIGHT",
        help="Size of the images in pixels, for cameras that KITTI does not have.",
        help_behavior_hint="",
    ),
]
Dtype = Literal["float32", "bfloat16"]
BatchSize = Annotated[int, tyro.conf.arg(metavar="CLOUDS", help="Number of clouds that are detected at once.")]
Columns = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="x,y,z,intensity,ring",
        help="The columns of the clouds by name, or their number if the first four are x, y, z and intensity.",
        help_behavior_hint="",
    ),
]

# In place of a folder: frames of the LiDAR simulator.
SIMULATED = "simulated"
SIMULATED_FRAMES = 100


@dataclass(frozen=True)
class Thresholds:
    """What a candidate and a detection must reach."""

    score_threshold: Annotated[float | None, tyro.conf.arg(metavar="PROBABILITY", help_behavior_hint="")] = None
    """Lowest class probability of a candidate, before its score is rectified and NMS."""
    min_score: Annotated[float | None, tyro.conf.arg(metavar="SCORE", help_behavior_hint="")] = None
    """Lowest score of a detection: the class probability times the predicted IoU ** 4, after NMS."""

    def fields(self) -> dict[str, float | None]:
        """Return the fields of the config that the options set."""
        return {"detection.score_threshold": self.score_threshold, "detection.min_score": self.min_score}


@dataclass(frozen=True)
class Frames:
    """The frames: those of a data set, or simulated ones."""

    data: Annotated[str | None, tyro.conf.arg(metavar="FOLDER|simulated", help_behavior_hint="")] = None
    """Folder in KITTI's or OpenPCDet's custom layout, or the LiDAR simulator; by default the variable KITTI_ROOT."""
    frames: Annotated[int | None, tyro.conf.arg(help_behavior_hint=f"(default: {SIMULATED_FRAMES})")] = None
    """Number of simulated frames; every fourth is of the split val, the others of train."""
    image_size: ImageSize = None
    columns: Columns = None

    def find_folder(self) -> Path | None:
        """Return the folder of the data set, None for simulated frames; raises InputError without either."""
        if self.data == SIMULATED:
            return None
        if self.frames is not None:
            raise UsageError(f"--frames is the number of simulated frames; give it with --data {SIMULATED}.")
        return find_root(self.data)

    def arguments(self) -> list[str]:
        """Return the options that select these frames again."""
        given = {"--data": self.data, "--frames": self.frames, "--columns": self.columns}
        options = [text for name, value in given.items() if value is not None for text in (name, str(value))]
        return options if self.image_size is None else [*options, "--image-size", *map(str, self.image_size)]

    def open(self, split: str, seed: int) -> Dataset:
        """Open the frames of a split; `seed` is that of simulated frames."""
        if self.data == SIMULATED:
            return open_simulated(split, SIMULATED_FRAMES if self.frames is None else self.frames, seed)
        return open_dataset(self.find_folder(), split, self.image_size, read_columns(self.columns))


def check_batch_size(batch_size: int) -> None:
    """Raise UsageError for a value of --batch-size that is below 1."""
    if batch_size < 1:
        raise UsageError(f"--batch-size is {batch_size}; detect at least 1 cloud at once.")


def read_columns(text: str | None) -> int | tuple[str, ...] | None:
    """Return the value of --columns."""
    with values_from_options():
        return None if text is None else parse_columns(text)


def open_simulated(split: str, frames: int, seed: int) -> Dataset:
    """Open the frames that `ciassd data synth` with this number and seed lists as `split`, without writing them."""
    check_simulation(frames, seed)
    splits = split_synthetic(frames)
    if split not in splits:
        raise UsageError(f"Simulated frames have no split {split!r}; choose {', '.join(splits)}.")
    if not splits[split]:
        raise UsageError(f"None of {frames} simulated frames is of the split {split}; simulate at least 4 (--frames).")
    return replace(open_synthetic(seed, frames), names=splits[split])


def check_simulation(frames: int, seed: int) -> None:
    """Raise UsageError for numbers that the simulator cannot use."""
    if frames < 1:
        raise UsageError(f"--frames is {frames}; simulate at least 1 frame.")
    if not 0 <= seed < 2**31:
        raise UsageError(f"--seed is {seed}; choose one from 0 to {2**31 - 1}.")
