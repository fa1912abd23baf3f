"""How many full LiDAR scans does the simulator produce per second?

Command: python benchmarks/bench_synthetic.py

Each scene is one call of `simulate`: a street, its 360-degree scan and the rays that hit each object, without labels
and files. Scenes run one by one, in batches with `vmap`, and in one thread per core as `ciassd data synth` runs them.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import jax

from ciassd_jax.simulation import Lidar, frame_key, simulate


def scenes_per_second(run: Callable[[int], object], number: int, repeats: int) -> list[float]:
    """Return the scenes per second of each repeat; `run(first)` simulates `number` scenes starting at index `first`."""
    run(0)
    rates = []
    for repeat in range(repeats):
        start = time.perf_counter()
        run((repeat + 1) * number)
        rates.append(number / (time.perf_counter() - start))
    return rates


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=32, help="scenes per repeat")
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    one = jax.jit(partial(simulate, lidar=Lidar()))
    many = jax.jit(jax.vmap(partial(simulate, lidar=Lidar())))

    def alone(first: int) -> None:
        for index in range(first, first + options.scenes):
            jax.block_until_ready(one(frame_key(0, index)))

    def batched(first: int) -> None:
        for index in range(first, first + options.scenes, options.batch):
            keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(0)))(
                jax.numpy.arange(index, index + options.batch)
            )
            jax.block_until_ready(many(keys))

    def threads(first: int) -> None:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(lambda i: jax.block_until_ready(one(frame_key(0, i))), range(first, first + options.scenes)))

    rays = Lidar().rays()
    print(f"{rays.tangent.size} x {rays.azimuth.size} rays, {os.cpu_count()} cores, JAX {jax.__version__}\n")
    print("| how | scenes per second, median (range) |\n|---|---|")
    for name, run in (
        ("one by one", alone),
        (f"batches of {options.batch}", batched),
        ("one thread per core", threads),
    ):
        rates = scenes_per_second(run, options.scenes, options.repeats)
        print(f"| {name} | {statistics.median(rates):.1f} ({min(rates):.1f} to {max(rates):.1f}) |", flush=True)


if __name__ == "__main__":
    main()
