"""Options that several commands share, and what they select: weights, a preset's config, labelled frames."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import tyro

from ciassd_jax.cli.messages import UsageError, values_from_options
from ciassd_jax.config import Config
from ciassd_jax.config.presets import PRESETS
from ciassd_jax.data.folders import find_root, open_dataset
from ciassd_jax.data.frames import Dataset
from ciassd_jax.formats.errors import InputError
from ciassd_jax.inference.weights import Weights, check_fits, find_weights, load_weights
from ciassd_jax.simulation import open_synthetic, split_synthetic

T = TypeVar("T")
# An option without a default; the help does not print "default: None".
Unset = Annotated[T | None, tyro.conf.arg(help_behavior_hint="")]
ImageSize = Annotated[
    tuple[int, int] | None,
    tyro.conf.arg(
        metavar="WIDTH HEIGHT",
        help="Size of the images in pixels, for cameras that KITTI does not have.",
        help_behavior_hint="",
    ),
]
Dtype = Literal["float32", "bfloat16"]
if TYPE_CHECKING:
    Preset = str
else:
    Preset = tyro.extras.literal_type_from_choices(PRESETS)

# In place of a folder: frames of the LiDAR simulator.
SIMULATED = "simulated"
SIMULATED_FRAMES = 100


def load_as(path: Path, preset: str | None) -> Weights:
    """Load weights from a file or by the name of bundled ones, with the preset's config if one is given."""
    weights = load_weights(find_weights(path))
    if preset is None:
        return weights
    config = PRESETS[preset]()
    try:
        check_fits(weights, config, path)
    except InputError as error:
        raise UsageError(f"--preset {preset} cannot be used: {error}") from error
    return weights._replace(config=config)


def override(config: Config, *, dtype: Dtype | None = None, score_threshold: float | None = None) -> Config:
    """Return the config with the given values in place of its own."""
    if dtype is not None:
        config = replace(config, dtype=dtype)
    if score_threshold is not None:
        with values_from_options():
            config = replace(config, detection=replace(config.detection, score_threshold=score_threshold))
    return config


@dataclass(frozen=True)
class Frames:
    """The frames: those of a data set, or simulated ones."""

    data: Annotated[str | None, tyro.conf.arg(metavar="FOLDER|simulated", help_behavior_hint="")] = None
    """Folder in KITTI's or OpenPCDet's custom layout, or the LiDAR simulator; by default the variable KITTI_ROOT."""
    frames: Annotated[int | None, tyro.conf.arg(help_behavior_hint=f"(default: {SIMULATED_FRAMES})")] = None
    """Number of simulated frames; every fourth is of the split val, the others of train."""
    image_size: ImageSize = None

    def find_folder(self) -> Path | None:
        """Return the folder of the data set, None for simulated frames; raises InputError without either."""
        if self.data == SIMULATED:
            return None
        if self.frames is not None:
            raise UsageError(f"--frames is the number of simulated frames; give it with --data {SIMULATED}.")
        return find_root(self.data)

    def open(self, split: str, seed: int) -> Dataset:
        """Open the frames of a split; `seed` is that of simulated frames."""
        if self.data == SIMULATED:
            return open_simulated(split, SIMULATED_FRAMES if self.frames is None else self.frames, seed)
        return open_dataset(self.find_folder(), split, self.image_size)


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
