"""`ciassd data synth`: simulated LiDAR frames as a folder in KITTI's layout."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ciassd_jax.cli.messages import frames_with_bar, values_from_options
from ciassd_jax.cli.options import SIMULATED_FRAMES, Unset, check_simulation
from ciassd_jax.simulation import Lidar, write_synthetic


@dataclass(frozen=True)
class Synth:
    """Write simulated LiDAR frames as a folder in KITTI's layout; every fourth frame is of the split val."""

    out: Annotated[Path, tyro.conf.Positional]
    """The folder to write; it must be new or empty, unless --overwrite is given."""
    frames: int = SIMULATED_FRAMES
    """Number of frames."""
    seed: int = 0
    """Seed of the frames; a frame depends on the seed, its own number, the sensor and --class alone."""
    beams: int = 64
    """Number of the sensor's beams, a multiple of 16; they cover the same elevations."""
    sensor_height: float = Lidar.height
    """Mean height of the sensor above the ground in metres."""
    max_range: float = Lidar.max_range
    """Largest range of the sensor in metres; objects beyond it are DontCare."""
    own_class: Annotated[Unset[str], tyro.conf.arg(name="class", metavar="NAME")] = None
    """Add machines of about 2.6 x 1.3 x 2.1 m, which are labelled with this name, one word."""
    overwrite: bool = False
    """Replace what an earlier `ciassd data synth` wrote there."""

    def run(self) -> int:
        check_simulation(self.frames, self.seed)
        with values_from_options():
            lidar = Lidar.with_beams(self.beams, height=self.sensor_height, max_range=self.max_range)
        dropped = write_synthetic(
            self.out,
            frames=self.frames,
            seed=self.seed,
            overwrite=self.overwrite,
            lidar=lidar,
            own_class=self.own_class,
            track=frames_with_bar,
        )
        if dropped:
            print(f"{dropped} pairs of a far solid and a tile of rays were over capacity and are not in the clouds.")
        print(f"Wrote {self.frames} frames to {self.out}.")
        return 0
