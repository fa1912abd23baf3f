"""Does a change make the programs slower to compile or to run? This checkout against another, in alternating rounds.

    git worktree add ../before COMMIT
    python benchmarks/bench_against.py ../before --presets tiny car --rounds 5

Each side is a process of its own, idle while the other works. `predict` runs on one made-up scan and `train_step` on
one scene with three boxes. Compilation includes tracing and lowering; nothing is read from the compilation cache. The
other checkout needs the public names `predict`, `create_train_state` and `train_step`.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from typing import Any

import jax
import numpy as np

ROOT = Path(__file__).parents[1]
PROGRAMS = ("predict", "train_step")


def scan(capacity: int, grid: Any) -> np.ndarray:
    """A made-up turn of a LiDAR with 64 beams over flat ground between walls, [capacity, 4]."""
    elevation, azimuth = np.meshgrid(
        np.radians(np.linspace(2, -24.8, 64)), np.radians(np.linspace(-40, 40, 448)), indexing="ij"
    )
    ground = np.where(elevation < -0.01, 1.73 / np.sin(np.maximum(-elevation, 0.01)), 80.0)
    reach = np.minimum(ground, 12 + 40 * np.abs(np.sin(3 * azimuth)))
    x, y, z = (
        reach * part
        for part in (
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        )
    )
    points = np.stack([x, y, z, np.full_like(x, 0.3)], -1).reshape(-1, 4)
    # Grids of another size see the same scan in their own scale.
    points[:, :3] *= (grid.maximum[0] - grid.minimum[0]) / 70.4
    padded = np.zeros((capacity, 4), np.float32)
    kept = points[np.linspace(0, len(points) - 1, min(capacity, len(points))).astype(int)]
    padded[: len(kept)] = kept
    return padded


def serve() -> None:
    """Answer commands "compile|run PRESET PROGRAM" on standard input with seconds."""
    import ciassd_jax
    from ciassd_jax import Boxes, GroundTruth, PointCloud, Scene

    jax.config.update("jax_enable_compilation_cache", False)
    ready: dict[tuple[str, str], Any] = {}
    for line in sys.stdin:
        what, preset, program = line.split()
        config = getattr(ciassd_jax, preset)()
        if what == "compile":
            data, none = config.data, np.zeros(1, np.int32)
            points = scan(data.max_points, config.grid)
            cloud = PointCloud(points[None], np.array([len(points)], np.int32))
            boxes, label = np.zeros((1, data.max_boxes, 7), np.float32), np.full((1, data.max_boxes), -1, np.int32)
            boxes[0, :3] = [
                [5, 0, -1, 3.9, 1.6, 1.5, 0.1],
                [8, 3, -1, 3.9, 1.6, 1.5, 1.2],
                [9, -4, -1, 3.9, 1.6, 1.5, -2],
            ]
            label[0, :3] = 0
            truth = GroundTruth(Boxes.from_array(boxes), label, np.array([3], np.int32))
            state = ciassd_jax.create_train_state(jax.random.key(0), config)
            argument: Any = cloud if program == "predict" else Scene(cloud, truth, none, none, none, none)
            jax.clear_caches()
            start = time.perf_counter()
            function = jax.jit(getattr(ciassd_jax, program), static_argnames="config")
            compiled = function.lower(state, argument, config).compile()
            seconds = time.perf_counter() - start
            ready[preset, program] = (compiled, jax.device_put((state, argument)))
            jax.block_until_ready(compiled(*ready[preset, program][1]))
        else:
            compiled, arguments = ready[preset, program]
            start = time.perf_counter()
            jax.block_until_ready(compiled(*arguments))
            seconds = time.perf_counter() - start
        print(json.dumps(seconds), flush=True)


class Side:
    """A process that works for one checkout."""

    def __init__(self, checkout: Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, __file__, "--serve"],
            env=os.environ | {"PYTHONPATH": str(checkout.resolve())},
            cwd=checkout,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def ask(self, *command: str) -> float:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(" ".join(command) + "\n")
        self.process.stdin.flush()
        return float(json.loads(self.process.stdout.readline()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, nargs="?", help="the other checkout")
    parser.add_argument("--presets", nargs="+", default=["tiny", "car_lite", "car"])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--compilations", type=int, default=2, help="rounds of compilation")
    parser.add_argument("--runs", type=int, default=3, help="runs a round, of which the median counts")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve()
        return
    sides = {"before": Side(options.before), "after": Side(ROOT)}
    print(f"{'preset':<10} {'program':<11} {'what':<8} {'before':>9} {'after':>9} {'ratio':>6}")
    for preset in options.presets:
        for program in PROGRAMS:
            for what, rounds, runs in (("compile", options.compilations, 1), ("run", options.rounds, options.runs)):
                seconds: dict[str, list[float]] = {name: [] for name in sides}
                for _ in range(rounds):
                    for name, side in sides.items():
                        seconds[name].append(median(side.ask(what, preset, program) for _ in range(runs)))
                before, after = (median(seconds[name]) for name in ("before", "after"))
                print(
                    f"{preset:<10} {program:<11} {what:<8} {before:>8.3f}s {after:>8.3f}s {after / before:>6.2f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
