"""The real frames that the benchmarks run on: the reference data in ../shared."""

from __future__ import annotations

from pathlib import Path

from ciassd_jax import Config, Scene, make_batches, open_dataset

SHARED = Path(__file__).parents[2] / "shared"


def real_batches(shared: Path, config: Config, batch: int, number: int) -> list[Scene]:
    """Return `number` batches of real frames without augmentation."""
    dataset = open_dataset(shared / "kitti", "all")
    with make_batches(dataset, config, seed=0, batch_size=batch, augmented=False) as batches:
        return [next(batches) for _ in range(number)]
