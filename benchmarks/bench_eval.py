"""How long does the evaluation take for 155 real frames, and for the 3769 frames of KITTI's val split?

Command: python benchmarks/bench_eval.py [--repeats 5] [--shared ../shared]

The 3769 frames are the 155 repeated. The times cover a whole evaluation in one process: reading the files, then every
class, metric, overlap limit and difficulty, and the rows by distance. NumPy only, no device.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path

from real_frames import SHARED

from ciassd_jax.evaluation import evaluate, read_folders

VAL_FRAMES = 3769


def measure(repeats: int, work: Callable[[], object]) -> str:
    """Return median and range of the seconds that `work` takes."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return f"{statistics.median(seconds):.3f} s ({min(seconds):.3f} to {max(seconds):.3f})"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--shared", type=Path, default=SHARED)
    arguments = parser.parse_args()
    labels, results = arguments.shared / "kitti/training/label_2", arguments.shared / "kitti_eval/kitti155/data"
    truths, detections = read_folders(labels, results)
    print(f"reading {len(truths)} frames: {measure(arguments.repeats, lambda: read_folders(labels, results))}")
    for number in (len(truths), VAL_FRAMES):
        times = number // len(truths) + 1
        many = (truths * times)[:number], (detections * times)[:number]
        objects = [sum(len(frame.types) for frame in frames) for frames in many]
        taken = measure(arguments.repeats, lambda many=many: evaluate(*many))
        print(f"{number} frames, {objects[0]} labels, {objects[1]} detections: {taken}")


if __name__ == "__main__":
    main()
