"""`ciassd export`: the detector as one file that needs JAX alone."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ciassd_jax.cli.config_options import ConfigOptions
from ciassd_jax.cli.messages import UsageError
from ciassd_jax.cli.options import WeightsFile
from ciassd_jax.formats.writing import check_file
from ciassd_jax.inference.detector import SMALLEST_BUCKET
from ciassd_jax.inference.export import export_predict


@dataclass(frozen=True)
class Export:
    """Write the detector with its weights as one file: manifest, StableHLO program and a golden case.

    Run it with `ciassd_jax.load_exported(OUT)`, or with JAX alone.
    """

    out: Annotated[Path, tyro.conf.Positional]
    """The file to write, such as car.ciassd."""
    weights: WeightsFile[Path]
    """Weights file (.safetensors, or a released .pth), or the name of bundled weights."""
    platforms: tuple[Literal["cpu", "cuda", "tpu"], ...] = ("cpu", "cuda", "tpu")
    """Where the program is to run."""
    batch: Annotated[int, tyro.conf.arg(metavar="CLOUDS")] = 1
    """Number of clouds per call."""
    points: Annotated[int, tyro.conf.arg(metavar="POINTS")] = SMALLEST_BUCKET
    """The most points of a cloud."""
    config_options: Annotated[ConfigOptions, tyro.conf.OmitArgPrefixes] = field(default_factory=ConfigOptions)

    def run(self) -> int:
        for name, value in (("--batch", self.batch), ("--points", self.points)):
            if value < 1:
                raise UsageError(f"{name} is {value}; give at least 1.")
        if not self.platforms:
            raise UsageError("--platforms names no platform; choose from cpu, cuda and tpu.")
        check_file(self.out)
        weights = self.config_options.load(self.weights)
        golden = export_predict(
            weights.variables,
            weights.config,
            self.out,
            num_points=self.points,
            batch=self.batch,
            platforms=self.platforms,
        ).golden
        boxes = int(golden.outputs["count"][0])
        size = self.out.stat().st_size / 1e6
        print(
            f"Wrote {self.out}: {self.batch} x {self.points} points a call, for {', '.join(self.platforms)}, "
            f"{size:.1f} MB; {boxes} boxes in the golden street."
        )
        return 0
