"""Do simulated scenes look like KITTI's? A table and a plot of what a detector sees of both.

    python experiments/compare_synthetic.py --real ../shared/kitti --frames 155 --out experiments

Compares points per frame and ring of distance, occupied voxels and active sites of each stage of `car()`, points per
car by distance, sizes, headings, difficulty and reflectance. Writes OUT/synthetic_vs_real.md and .png. Results:
README.md.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from ciassd_jax import car, open_dataset
from ciassd_jax.data.frames import Frame
from ciassd_jax.formats.writing import write_text
from ciassd_jax.ops.footprints import points_in_boxes
from ciassd_jax.simulation import open_synthetic

RINGS = np.arange(0, 80, 10)
LEVELS = ("easy", "moderate", "hard", "none")
# Points within this height of the road and this distance count as ground, both in metres.
GROUND, GROUND_RANGE = 0.15, 25.0
BINS = np.linspace(0, 1, 21)


class Look(NamedTuple):
    """The counts of a data set, one row per frame or car."""

    points: np.ndarray
    rings: np.ndarray
    sites: np.ndarray
    cars: np.ndarray
    boxes: np.ndarray
    inside: np.ndarray
    difficulty: Counter
    types: Counter
    car_reflectance: np.ndarray
    ground_reflectance: np.ndarray
    heights: np.ndarray


def look_at(frames: Iterable[Frame]) -> Look:
    """Count over the frames."""
    rows: dict[str, list] = {name: [] for name in Look._fields}
    difficulty, types = Counter(), Counter()
    for frame in frames:
        points, grid = frame.points, car().grid
        low, high = np.array(grid.minimum), np.array(grid.maximum)
        points = points[((points[:, :3] >= low) & (points[:, :3] < high)).all(1)]
        distance = np.hypot(points[:, 0], points[:, 1])
        rows["points"].append(len(points))
        rows["rings"].append(np.histogram(distance, np.append(RINGS, 80))[0])
        rows["sites"].append(count_sites(points))
        is_car = np.array([name == "Car" for name in frame.names], bool)
        boxes = frame.boxes.to_array()
        inside = np.asarray(points_in_boxes(points.astype(np.float64), frame.boxes))
        rows["cars"].append(is_car.sum())
        rows["boxes"].append(boxes[is_car])
        rows["inside"].append(inside[is_car].sum(1))
        rows["car_reflectance"].append(points[inside[is_car].any(0), 3])
        low_points = (abs(points[:, 2] + 1.7) < GROUND) & (distance < GROUND_RANGE) & ~inside.any(0)
        rows["ground_reflectance"].append(points[low_points, 3])
        rows["heights"].append(points[:, 2])
        difficulty.update(LEVELS[level] for level in frame.difficulty[is_car])
        types.update(frame.names)
    stacked = {name: np.stack(rows[name]) for name in ("rings", "sites")}
    stacked |= {name: np.array(rows[name]) for name in ("points", "cars")}
    joined = ("boxes", "inside", "car_reflectance", "ground_reflectance", "heights")
    stacked |= {name: np.concatenate(rows[name]) for name in joined}
    return Look(**stacked, difficulty=difficulty, types=types)


def count_sites(points: np.ndarray) -> list[int]:
    """Return the occupied voxels of `car()` and the active sites after each strided stage and the last convolution."""
    config = car()
    low, size = np.array(config.grid.minimum, np.float32), np.array(config.grid.voxel_size, np.float32)
    sites = np.unique(np.floor((points[:, :3] - low) / size).astype(np.int64)[:, ::-1], axis=0)
    shapes, counts = config.backbone.stage_shapes(config.grid.shape), [len(sites)]
    for stage, shape in zip(config.backbone.stages[1:], shapes[1:], strict=False):
        sites = strided(sites, (3, 3, 3), (2, 2, 2), (stage.z_padding, 1, 1), shape)
        counts.append(len(sites))
    return [*counts, len(strided(sites, (3, 1, 1), (2, 1, 1), (0, 0, 0), shapes[-1]))]


def strided(sites: np.ndarray, kernel: tuple, stride: tuple, padding: tuple, shape: tuple) -> np.ndarray:
    """Return the output sites whose window holds any of these sites."""
    found = []
    for offset in np.ndindex(*kernel):
        start = sites + np.array(padding) - np.array(offset)
        output = start // np.array(stride)
        fits = (start % np.array(stride) == 0).all(1) & (output >= 0).all(1) & (output < np.array(shape)).all(1)
        found.append(output[fits])
    return np.unique(np.concatenate(found), axis=0)


def table(real: Look, synthetic: Look) -> list[str]:
    """Return the comparison as a Markdown table."""
    rows = ["| | real | synthetic |", "|---|---|---|"]

    def add(name: str, measure) -> None:  # type: ignore[no-untyped-def]
        rows.append(f"| {name} | {measure(real)} | {measure(synthetic)} |")

    def spread(values: np.ndarray) -> str:
        low, middle, high = np.quantile(values, (0.1, 0.5, 0.9))
        return f"{middle:.0f} ({low:.0f} to {high:.0f})"

    add("frames", lambda look: len(look.points))
    add("points in range per frame", lambda look: spread(look.points))
    for index, start in enumerate(RINGS):
        add(f"... {start} to {start + 10} m", lambda look, index=index: spread(look.rings[:, index]))
    stages = ("occupied voxels", "sites after stride 2", "after stride 4", "after stride 8", "after the last")
    for index, name in enumerate(stages):
        add(name, lambda look, index=index: spread(look.sites[:, index]))
    add("cars per frame", lambda look: f"{look.cars.mean():.1f} (at most {look.cars.max()})")
    for start in RINGS:
        add(f"points of a car, {start} to {start + 10} m", lambda look, start=start: _at(look, start, spread))
    for axis, name in enumerate(("length", "width", "height"), 3):
        add(
            f"car {name}, m",
            lambda look, axis=axis: f"{look.boxes[:, axis].mean():.2f} ± {look.boxes[:, axis].std():.2f}",
        )
    add("cars easy / moderate / hard / none", lambda look: _shares(look.difficulty, LEVELS))
    add("cars along / across / other than the view", lambda look: _headings(look))
    for axis, name in ((0, "ahead"), (1, "to the left")):
        add(f"cars {name}, m", lambda look, axis=axis: spread(look.boxes[:, axis]))
    add("bottom of cars, m", lambda look: _mean(look.boxes[:, 2] - look.boxes[:, 5] / 2))
    for name in ("car", "ground"):
        add(f"reflectance of {name}s", lambda look, name=name: _reflectance(getattr(look, f"{name}_reflectance")))
    types = ("Car", "Van", "Truck", "Pedestrian", "Cyclist")
    add(" / ".join(types), lambda look: _shares(look.types, types))
    return rows


def _at(look: Look, start: int, spread) -> str:  # type: ignore[no-untyped-def]
    distance = np.hypot(look.boxes[:, 0], look.boxes[:, 1])
    values = look.inside[(distance >= start) & (distance < start + 10)]
    return f"{spread(values)}, n = {len(values)}" if len(values) else "-"


def _mean(values: np.ndarray) -> str:
    return f"{values.mean():.2f} ± {values.std():.2f}"


def _shares(counter: Counter, names: Iterable[str]) -> str:
    total = sum(counter[name] for name in names)
    return " / ".join(f"{100 * counter[name] / max(total, 1):.0f} %" for name in names)


def _headings(look: Look) -> str:
    turn = abs(np.rad2deg((look.boxes[:, 6] + np.pi / 2) % np.pi - np.pi / 2))
    along, across = (turn < 20).mean(), (turn > 70).mean()
    return f"{100 * along:.0f} % / {100 * across:.0f} % / {100 * (1 - along - across):.0f} %"


def _reflectance(values: np.ndarray) -> str:
    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
    return f"{middle:.2f} ({low:.2f} to {high:.2f}), 0 in {100 * (values == 0).mean():.0f} %"


def plot(looks: dict[str, Look]) -> Figure:
    """Plot points by distance, sites, points of cars, reflectances and heights."""
    figure = Figure(figsize=(13, 7.5), dpi=130, layout="constrained")
    axes = figure.subplots(2, 3).ravel()
    for (name, look), color in zip(looks.items(), ("#d62728", "#1f6fb4"), strict=True):
        distance = np.hypot(look.boxes[:, 0], look.boxes[:, 1])
        axes[0].step(RINGS + 5, look.rings.mean(0), where="mid", color=color, label=name)
        axes[1].plot(np.median(look.sites, 0), "o-", color=color, label=name)
        axes[2].semilogy(distance, look.inside + 0.5, ".", ms=3, color=color, alpha=0.5, label=name)
        axes[3].hist(look.car_reflectance, BINS, histtype="step", density=True, color=color, label=name)
        axes[4].hist(look.ground_reflectance, BINS, histtype="step", density=True, color=color, label=name)
        axes[5].hist(look.heights, np.linspace(-3, 1, 81), histtype="step", density=True, color=color, label=name)
    titles = ("points per ring of 10 m", "active sites by stage", "points of a car by distance (m)")
    titles += ("reflectance of cars", "reflectance of the ground", "height of points (m)")
    for axis, title in zip(axes, titles, strict=True):
        axis.set_title(title, loc="left")
        axis.legend()
    return figure


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--real", type=Path, default=Path("../shared/kitti"))
    parser.add_argument("--frames", type=int, default=155)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("experiments"))
    options = parser.parse_args()
    looks = {
        name: look_at(map(dataset.read, range(len(dataset))))
        for name, dataset in (
            ("real", open_dataset(options.real, "all")),
            ("synthetic", open_synthetic(options.seed, options.frames)),
        )
    }
    text = "\n".join(table(*looks.values()))
    print(text)
    write_text(options.out / "synthetic_vs_real.md", text)
    plot(looks).savefig(options.out / "synthetic_vs_real.png")


if __name__ == "__main__":
    main()
