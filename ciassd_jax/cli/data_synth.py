"""`ciassd data synth`: simulated LiDAR frames as a folder in KITTI's layout."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ciassd_jax.cli.messages import frames_with_bar
from ciassd_jax.cli.options import SIMULATED_FRAMES, check_simulation
from ciassd_jax.simulation import write_synthetic


@dataclass(frozen=True)
class Synth:
    """Write simulated LiDAR frames as a folder in KITTI's layout; every fourth frame is of the split val."""

    out: Annotated[Path, tyro.conf.Positional]
    """The folder to write; it must be new or empty, unless --overwrite is given."""
    frames: int = SIMULATED_FRAMES
    """Number of frames."""
    seed: int = 0
    """Seed of the frames; a frame depends on the seed and its own number alone."""
    overwrite: bool = False
    """Replace what an earlier `ciassd data synth` wrote there."""

    def run(self) -> int:
        check_simulation(self.frames, self.seed)
        dropped = write_synthetic(
            self.out, frames=self.frames, seed=self.seed, overwrite=self.overwrite, track=frames_with_bar
        )
        if dropped:
            print(f"{dropped} pairs of a far solid and a tile of rays were over capacity and are not in the clouds.")
        print(f"Wrote {self.frames} frames to {self.out}.")
        return 0
