"""How many frames per second does the loader deliver with all augmentations?

Command: python benchmarks/bench_data.py [--frames 440] [--batch 4] [--repeats 3] [--shared ../shared]

The loader repeats the train frames of the reference data, with ground-truth sampling from a database of the same
frames. The first batch is not timed: it compiles and starts the workers. Files are in the page cache. "host" reads,
draws objects and pads; "device" augments one batch repeatedly; "loader" is both, with no training step on the device.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from real_frames import SHARED

from ciassd_jax import car, car_lite, make_batches, open_dataset
from ciassd_jax.config import Config
from ciassd_jax.data.frames import Dataset
from ciassd_jax.data.gt_sampling import ObjectDatabase, build_database, open_database
from ciassd_jax.data.loader import Rows, Stream, finish_scenes, host_batches

WORKERS = (0, 2)


def measure(arguments: argparse.Namespace, next_batch: Callable[[], object]) -> str:
    """Return median and range of the frames per second over the repeats, after one batch."""
    number, rates = arguments.frames // arguments.batch, []
    jax.block_until_ready(next_batch())
    for _ in range(arguments.repeats):
        start = time.perf_counter()
        for _ in range(number):
            jax.block_until_ready(next_batch())
        rates.append(number * arguments.batch / (time.perf_counter() - start))
    return f"{statistics.median(rates):6.1f} ({min(rates):.1f} to {max(rates):.1f})"


def measure_preset(
    config: Config, dataset: Dataset, database: ObjectDatabase, arguments: argparse.Namespace
) -> dict[str, str]:
    """Return the frames per second of each part."""
    rows, rates = Rows(Stream(dataset, config, 0, True, database), arguments.batch), {}
    for workers in WORKERS:
        host = host_batches(rows, workers=workers)
        rates[f"host, {workers} workers"] = measure(arguments, lambda host=host: next(host))
        host.close()
    few = itertools.cycle([rows.stream.read(position) for position in range(arguments.batch)])
    batch = jax.device_put(jax.tree.map(lambda *leaves: np.stack(leaves), *itertools.islice(few, arguments.batch)))
    rates["device"] = measure(arguments, lambda: finish_scenes(batch, np.int32(0), config))
    for workers in WORKERS:
        numbers = {"seed": 0, "batch_size": arguments.batch, "workers": workers}
        with make_batches(dataset, config, database=database, **numbers) as batches:
            rates[f"loader, {workers} workers"] = measure(arguments, lambda batches=batches: next(batches))
    return rates


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=440)
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--shared", type=Path, default=SHARED)
    arguments = parser.parse_args()
    dataset = open_dataset(arguments.shared / "kitti", "train")
    with tempfile.TemporaryDirectory() as folder:
        build_database(dataset, Path(folder) / "objects.bin")
        database = open_database(Path(folder) / "objects.bin", dataset)
        print(f"{len(dataset)} frames, batches of {arguments.batch}: frames/s, median (range)")
        for preset in (car, car_lite):
            for part, rate in measure_preset(preset(), dataset, database, arguments).items():
                print(f"{preset.__name__:<10} {part:<18} {rate}", flush=True)


if __name__ == "__main__":
    main()
