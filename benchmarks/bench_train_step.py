"""How long does one training step take, from points to new parameters, compared with the same step in PyTorch?

Command: pip install -e '.[peer,viz]' && python benchmarks/bench_train_step.py --voxels --plot

Both steps process the same real frames alternately, without augmentation, on the same cores, after one warm-up each.
Peak memory is measured in a separate process for each and includes compilation. `--voxels` adds the time against the
number of voxels. On an accelerator, and with a preset other than `car`, only our step is measured.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from real_frames import SHARED, real_batches

from ciassd_jax import Config, PointCloud, Scene, create_train_state, train_step
from ciassd_jax.config.presets import PRESETS

PLOT = Path(__file__).with_name("train_step.png")
SHARES = (0.25, 0.5, 0.75, 1.0)
THREADS = 2


class Point(NamedTuple):
    """Seconds of each step at a batch size and a mean number of voxels, and seconds of compilation."""

    batch: int
    voxels: float
    ours: list[float]
    peer: list[float]
    compilation: float


def thinned(scene: Scene, share: float) -> Scene:
    """Return the scene with a random share of its points."""
    points, count = np.array(scene.cloud.points), np.array(scene.cloud.count)
    random = np.random.default_rng(0)
    for row, cloud in enumerate(points):
        kept = cloud[: count[row]][random.random(count[row]) < share]
        cloud[:] = np.pad(kept, ((0, len(cloud) - len(kept)), (0, 0)))
        count[row] = len(kept)
    return jax.device_put(scene._replace(cloud=PointCloud(points, count)))


def count_voxels(scene: Scene, config: Config) -> float:
    """Return the mean number of occupied voxels per scene."""
    points, count = np.asarray(scene.cloud.points), np.asarray(scene.cloud.count)
    low, size, cells = (np.array(each) for each in (config.grid.minimum, config.grid.voxel_size, config.grid.cells))
    number = 0
    for cloud, real in zip(points, count, strict=True):
        index = np.floor((cloud[:real, :3] - low) / size).astype(np.int64)
        index = index[((index >= 0) & (index < cells)).all(1)]
        number += len(np.unique(np.ravel_multi_index(tuple(index.T), tuple(cells))))
    return number / len(count)


def scaled(config: Config, share: float) -> Config:
    """Return the config with every site capacity scaled by `share`."""
    backbone = config.backbone
    first, *others = backbone.stages
    stages = (first, *(replace(stage, capacity=int(share * (stage.capacity or 0))) for stage in others))
    backbone = replace(backbone, stages=stages, out_capacity=int(share * backbone.out_capacity))
    return replace(config, grid=replace(config.grid, max_voxels=int(share * config.grid.max_voxels)), backbone=backbone)


class OurStep:
    """Our step, compiled for one shape; it holds the train state."""

    def __init__(self, config: Config, scene: Scene) -> None:
        self.config, self.state = config, create_train_state(jax.random.key(0), config)
        start = time.perf_counter()
        self.step = jax.jit(train_step).lower(self.state, scene, config).compile()
        self.compilation = time.perf_counter() - start

    def __call__(self, scene: Scene) -> dict[str, Any]:
        self.state, metrics = self.step(self.state, scene, self.config)
        return jax.block_until_ready(metrics)


def peer_step() -> Callable[[Scene], Any]:
    """Return the PyTorch step; it takes what `for_peer` returns."""
    import torch
    from peer_training import TrainingPeer, TrainingStep

    torch.set_num_threads(THREADS)
    return TrainingStep(TrainingPeer())


def for_peer(scene: Scene) -> tuple:
    """Convert a batch to the arguments of the PyTorch step."""
    from peer_training import to_peer

    return to_peer(scene)


def seconds_of(function: Callable, *inputs: Any) -> float:
    """Return the seconds of one call."""
    start = time.perf_counter()
    function(*inputs)
    return time.perf_counter() - start


def measure(ours: OurStep, peer: Callable | None, scenes: list[Scene], config: Config) -> Point:
    """Time both steps alternately on each batch; the first batch is a warm-up."""
    times: dict[str, list[float]] = {"ours": [], "peer": []}
    for scene in scenes:
        times["ours"].append(seconds_of(ours, scene))
        if peer is not None:
            times["peer"].append(seconds_of(peer, *for_peer(scene)))
    voxels = statistics.mean(count_voxels(scene, config) for scene in scenes[1:])
    batch = len(scenes[0].cloud.count)
    return Point(batch, voxels, times["ours"][1:], times["peer"][1:], ours.compilation)


def peak_memory(kind: str, batch: int, options: argparse.Namespace) -> float:
    """Return the peak memory in GB of a fresh process that runs two steps, or of the accelerator so far."""
    if jax.default_backend() != "cpu":
        return (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use", float("nan")) / 1e9
    command = [sys.executable, __file__, "--alone", kind, "--batch", str(batch), "--preset", options.preset]
    command += ["--shared", str(options.shared)]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1])


def measure_alone(kind: str, options: argparse.Namespace) -> None:
    """Run two steps of one kind and print the peak memory of this process in GB."""
    config = PRESETS[options.preset]()
    scenes = real_batches(options.shared, config, options.batch[0], 2)
    if kind == "ours":
        step = OurStep(config, scenes[0])
        for scene in scenes:
            step(scene)
    else:
        peer = peer_step()
        for scene in scenes:
            peer(*for_peer(scene))
    # Not getrusage, whose maximum is inherited from the parent process.
    print(int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) / 1e6)


def text_of(seconds: list[float]) -> str:
    """Format the median and the range in ms."""
    if not seconds:
        return "-"
    return f"{1e3 * statistics.median(seconds):.0f} ({1e3 * min(seconds):.0f} to {1e3 * max(seconds):.0f})"


def ratio_of(point: Point) -> str:
    """Format the median over the steps of ours / peer."""
    pairs = zip(point.ours, point.peer, strict=False)
    return f"{statistics.median(a / b for a, b in pairs):.2f}" if point.peer else "-"


def print_row(*cells: str) -> None:
    """Print one row of a Markdown table at once."""
    print("| " + " | ".join(cells) + " |", flush=True)


def print_header(*cells: str) -> None:
    """Print the first two rows of a Markdown table."""
    print()
    print_row(*cells)
    print("|" + "---|" * len(cells), flush=True)


def against_batch(options: argparse.Namespace, config: Config, peer: Callable | None) -> list[Point]:
    """Measure every batch size and print the table."""
    points, kinds = [], ("ours",) if peer is None else ("ours", "peer")
    print_header("batch", "ours, ms (range)", "peer, ms (range)", "ours / peer", "compilation", "peak GB of each")
    for batch in options.batch:
        scenes = real_batches(options.shared, config, batch, 1 + options.steps)
        point = measure(OurStep(config, scenes[0]), peer, scenes, config)
        memory = [] if options.no_memory else [f"{peak_memory(kind, batch, options):.2f}" for kind in kinds]
        times = (text_of(point.ours), text_of(point.peer), ratio_of(point), f"{point.compilation:.0f} s")
        print_row(str(batch), *times, " / ".join(memory) or "-")
        points.append(point)
    return points


def against_voxels(options: argparse.Namespace, config: Config, peer: Callable | None) -> dict[str, list[Point]]:
    """Measure batches of one scene with a share of its points, at fixed and scaled capacity, and print the table."""
    whole = real_batches(options.shared, config, 1, 1 + options.steps)
    fixed = OurStep(config, whole[0])
    series: dict[str, list[Point]] = {"fixed capacity": [], "capacity scaled": []}

    def add(name: str, point: Point) -> None:
        series[name].append(point)
        print_row(name, f"{point.voxels:.0f}", text_of(point.ours), text_of(point.peer), ratio_of(point))

    print_header("capacity", "voxels", "ours, ms (range)", "peer, ms (range)", "ours / peer")
    for share in SHARES:
        scenes = [thinned(scene, share) for scene in whole]
        add("fixed capacity", measure(fixed, peer, scenes, config))
        if options.scale_capacity and share < 1:
            # The number of voxels falls more slowly than the number of points.
            smaller = scaled(config, share + 0.1)
            add("capacity scaled", measure(OurStep(smaller, whole[0]), None, scenes, config))
    return series


def plot(path: Path, batches: list[Point], voxels: dict[str, list[Point]]) -> None:
    """Draw time against batch size and against voxels."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3), layout="constrained")
    left, right = figure.subplots(1, 2)
    panels = [
        (left, "ours", [(p.batch, p.ours) for p in batches]),
        (left, "peer", [(p.batch, p.peer) for p in batches]),
    ]
    for name, points in voxels.items():
        panels.append((right, f"ours, {name}", [(p.voxels, p.ours) for p in points]))
        panels.append((right, "peer", [(p.voxels, p.peer) for p in points]))
    for axes, name, series in panels:
        measured = [(x, seconds) for x, seconds in series if seconds]
        if measured:
            x, medians = zip(*((x, statistics.median(seconds)) for x, seconds in measured), strict=True)
            style = "C1s--" if name == "peer" else "C0o-" if "scaled" not in name else "C2^-"
            axes.plot(x, medians, style, label=name)
    for axes, label in ((left, "scenes per batch"), (right, "voxels per scene (batch 1)")):
        axes.set(xlabel=label, ylabel="seconds per step", ylim=(0, None), xlim=(0, None))
        if axes.lines:
            axes.legend(frameon=False)
    figure.savefig(path, dpi=90)


def main() -> None:
    """Measure, print the tables, draw the plot."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batch", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--steps", type=int, default=5)
    parser.add_argument("--preset", choices=sorted(PRESETS), default="car")
    parser.add_argument("--voxels", action="store_true", help="also measure the time against the number of voxels")
    parser.add_argument("--scale-capacity", action="store_true", help="with --voxels, also measure smaller capacities")
    parser.add_argument("--plot", type=Path, nargs="?", const=PLOT, help="draw both curves")
    parser.add_argument("--no-memory", action="store_true", help="skip the processes that measure memory")
    parser.add_argument("--no-peer", action="store_true", help="measure our step only")
    parser.add_argument("--shared", type=Path, default=SHARED, help="folder of kitti/")
    parser.add_argument("--alone", choices=("ours", "peer"), help="print the peak memory of one step and exit")
    options = parser.parse_args()
    if options.alone:
        measure_alone(options.alone, options)
        return
    config = PRESETS[options.preset]()
    device = jax.devices()[0]
    with_peer = device.platform == "cpu" and options.preset == "car" and not options.no_peer
    print(f"{options.preset} on {device.device_kind} ({device.platform}), JAX {jax.__version__}, {options.steps} steps")
    peer = peer_step() if with_peer else None
    batches = against_batch(options, config, peer)
    voxels = against_voxels(options, config, peer) if options.voxels else {}
    if options.plot:
        plot(options.plot, batches, voxels)


if __name__ == "__main__":
    main()
