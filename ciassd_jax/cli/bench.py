"""`ciassd bench`: how fast detection is on this machine, with these weights and clouds."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from ciassd_jax.cli.config_options import ConfigOptions
from ciassd_jax.cli.messages import UsageError, warnings_as_lines
from ciassd_jax.cli.options import (
    SIMULATED,
    BatchSize,
    Columns,
    File,
    ImageSize,
    Unset,
    WeightsFile,
    check_batch_size,
    open_simulated,
    read_columns,
)
from ciassd_jax.data.clouds import find_clouds, read_cloud
from ciassd_jax.formats.writing import check_file, write_text
from ciassd_jax.inference.timing import time_detection

# Clouds that take turns, evenly spaced over a folder; more if a batch has more.
_CLOUDS = 8


@dataclass(frozen=True)
class Bench:
    """Time detection on this machine: compilation, first call, percentiles of the others, host and device.

    Without options it times the bundled weights on simulated streets.
    """

    weights: WeightsFile[Path] = Path("car_lite")
    """Weights file (.safetensors, or a released .pth), or the name of bundled weights."""
    data: Annotated[str, tyro.conf.arg(metavar="FOLDER|FILE|simulated")] = SIMULATED
    """A cloud, a folder of clouds, a data set, or the LiDAR simulator."""
    image_size: ImageSize = None
    batch_size: BatchSize = 1
    repeats: Annotated[int, tyro.conf.arg(metavar="CALLS")] = 50
    """Number of calls that are timed."""
    json: File[Unset[Path]] = None
    """Also write the numbers to this file."""
    columns: Columns = None
    config_options: Annotated[ConfigOptions, tyro.conf.OmitArgPrefixes] = field(default_factory=ConfigOptions)

    def run(self) -> int:
        check_batch_size(self.batch_size)
        if self.repeats < 1:
            raise UsageError(f"--repeats is {self.repeats}; time at least 1 call.")
        if self.json is not None:
            check_file(self.json)
        with warnings_as_lines(self.data):
            weights = self.config_options.load(self.weights)
            numbers = time_detection(
                weights.variables, weights.config, self._clouds(), batch_size=self.batch_size, repeats=self.repeats
            )
        print(_describe(self.weights, self.data, numbers))
        if self.json is not None:
            write_text(self.json, json.dumps({"weights": str(self.weights), "data": self.data} | numbers, indent=1))
            print(f"Wrote {self.json}.")
        return 0

    def _clouds(self) -> list[np.ndarray]:
        number = max(_CLOUDS, self.batch_size)
        if self.data == SIMULATED:
            streets = open_simulated("all", number, seed=0)
            return [streets.read(index).points for index in range(number)]
        columns = read_columns(self.columns)
        files = find_clouds(self.data, image_size=self.image_size, columns=columns)
        chosen = np.unique(np.linspace(0, len(files) - 1, number).astype(int)).tolist()
        return [read_cloud(files[index], columns)[0] for index in chosen]


def _describe(weights: Path, data: str, numbers: dict[str, Any]) -> str:
    """The numbers as a table."""
    machine, size = numbers["machine"], numbers["batch_size"]
    memory = [f"{name} {value / 1e6:.1f} MB" for name, value in numbers["memory"].items() if value is not None]
    rows = {
        "machine": f"{machine['processor']}, {machine['cores']} cores; {machine['platform']}: "
        f"{len(machine['devices'])} x {machine['devices'][0]}; JAX {machine['jax']}",
        "weights": f"{weights}, {numbers['dtype']}",
        "clouds": f"{numbers['clouds']} of {data}, {size} per call",
        **{name: _spread(numbers[name]) for name in ("points", "voxels", "boxes")},
        "compile": f"{numbers['compile']:.2f} s" + (" from the compilation cache" if numbers["cached"] else ""),
        "first call": f"{1e3 * numbers['first_call']:.1f} ms",
        "call": _percentiles(numbers["call"]),
        "  device": _percentiles(numbers["device"]),
        "  host": _percentiles(numbers["host"]),
        "speed": f"{numbers['frames_per_second']:.1f} frames/s at the p50 of {numbers['repeats']} calls",
        "memory": ", ".join(memory) or "not reported",
    }
    return "\n".join(f"{name:<11} {text}" for name, text in rows.items())


def _spread(numbers: dict[str, int]) -> str:
    return f"{numbers['min']} to {numbers['max']} per cloud, median {numbers['median']}"


def _percentiles(seconds: dict[str, float]) -> str:
    return "  ".join(f"{name} {1e3 * value:8.1f} ms" for name, value in seconds.items())
