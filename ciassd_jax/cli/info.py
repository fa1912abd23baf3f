"""`ciassd info`: what a config is and costs, and whether it fits a data set."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from ciassd_jax.cli.config_options import ConfigOptions
from ciassd_jax.cli.messages import frames_with_bar, option_of, warnings_as_lines
from ciassd_jax.cli.options import Frames, Split, Unset, WeightsFile
from ciassd_jax.config import Config
from ciassd_jax.data.frames import Dataset
from ciassd_jax.inference import cost

# Frames of a data set that are compared with the grid, evenly spaced.
_FRAMES = 200


@dataclass(frozen=True)
class Info:
    """Show a config, its grid, its parameters, its floating-point operations and the memory of the compiled program.

    With --data also how much of a data set lies in the grid.
    """

    config_options: Annotated[ConfigOptions, tyro.conf.OmitArgPrefixes] = field(default_factory=ConfigOptions)
    weights: WeightsFile[Unset[Path]] = None
    """Show the config of this weights file, or of the bundled weights of this name."""
    data_set: Annotated[Frames, tyro.conf.OmitArgPrefixes] = field(default_factory=Frames)
    split: Split[str] = "train"
    """The frames that are compared with the grid."""
    seed: int = 0
    """Seed of simulated frames."""
    points: int = 20000
    """Points per cloud that the program is compiled for."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        options = self.config_options
        config = options.load(self.weights).config if self.weights else options.resolve()
        facts = {
            "config": json.loads(config.to_json()),
            "grid": describe_grid(config),
            "parameters": cost.count_parameters(config),
            "flops": cost.count_flops(config),
            "memory": cost.compiled_memory(config, self.points),
        }
        if self.data_set.data is not None:
            with warnings_as_lines(self.data_set.data):
                facts["data"] = measure_extent(self.data_set.open(self.split, self.seed), config)
        print(json.dumps(facts) if self.json else _describe(config, facts, self.points))
        return 0


def describe_grid(config: Config) -> list[str]:
    """Return sentences on the grid: voxels, layers of every stage, BEV map, and the next valid sizes."""
    grid, stride = config.grid, config.backbone.stride
    lines = []
    for axis, low, high, size, cells in zip(
        "xyz", grid.minimum, grid.maximum, grid.voxel_size, grid.cells, strict=True
    ):
        step = 2 * stride if axis != "z" else 1
        near = " or ".join(f"{low + n * size:g}" for n in (cells - step, cells + step) if n > 0)
        lines.append(f"{axis}: {low:g} to {high:g} m, {cells} voxels of {size:g} m; next valid maximum {near}.")
    shapes = config.backbone.stage_shapes(grid.shape)
    depths = " -> ".join(str(shape[0]) for shape in shapes)
    height, width = config.bev_shape
    cell = grid.voxel_size[0] * stride
    lines.append(f"Layers along z: {depths}, with {config.backbone.out_channels} channels each in the BEV map.")
    lines.append(
        f"BEV map: {width} x {height} cells of {cell:g} m (stride {stride}, so x and y are multiples of "
        f"{2 * stride} voxels), {width * height * config.anchors_per_cell} anchors."
    )
    return lines


def measure_extent(dataset: Dataset, config: Config) -> dict[str, Any]:
    """Return which share of the points and of the objects of every class lies in the grid."""
    low, high = (np.array(bound) for bound in config.range)
    known, inside, total = config.labels_by_name(similar=config.data.augmentation.similar_classes), 0, 0
    objects = {name: [0, 0] for name in config.class_names}
    chosen = np.unique(np.linspace(0, len(dataset) - 1, min(len(dataset), _FRAMES)).astype(int))
    for index in frames_with_bar(chosen.tolist()):
        frame = dataset.read(index)
        inside += int(((frame.points[:, :3] >= low) & (frame.points[:, :3] < high)).all(1).sum())
        total += len(frame.points)
        for name, center in zip(frame.names, frame.boxes.center, strict=True):
            if name.lower() in known:
                count = objects[config.class_names[known[name.lower()]]]
                count[0] += bool(((center >= low) & (center <= high)).all())
                count[1] += 1
    return {"frames": len(chosen), "points": [inside, total], "objects": objects}


def _describe(config: Config, facts: dict[str, Any], points: int) -> str:
    """The facts as text."""
    lines = [config.to_json(), *facts["grid"]]
    for part, count in facts["parameters"].items():
        lines.append(f"{part:<10} {count:>12,} parameters  {facts['flops'][part] / 1e9:>8.2f} GFLOP")
    lines.append("FLOPs are one scene's convolutions with the backbone at full capacity; real scenes need fewer.")
    memory = facts["memory"]
    sizes = ", ".join(
        f"{name} unknown" if memory[name] is None else f"{name} {memory[name] / 1e6:.1f} MB"
        for name in ("arguments", "outputs", "temporaries")
    )
    lines.append(f"Compiled for {memory['platform']} and up to {points} points: {sizes}.")
    return "\n".join([*lines, *(_describe_extent(facts["data"]) if "data" in facts else [])])


def _describe_extent(data: dict[str, Any]) -> list[str]:
    """The shares of points and objects in the grid as text."""
    inside, total = data["points"]
    lines = [f"In the grid, of {data['frames']} frames: {inside / max(total, 1):.1%} of the points."]
    for name, (kept, count) in data["objects"].items():
        remedy = f"; `ciassd data suggest` prints a range, {option_of('grid.minimum')} and the like set one"
        share = f"{kept} of {count} objects of class {name}" if count else f"there is no object of class {name}"
        lines.append(f"In the grid: {share}{remedy if kept < 0.99 * count or not count else ''}.")
    return lines
