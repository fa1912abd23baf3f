"""A training of a few steps on a few made-up frames; `python tests/mini_training.py DATA WORKDIR` runs it."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from mini_folders import NAMES, write_kitti, write_split
from small import random_variables, small_config

from ciassd_jax import Config, make_batches, open_dataset
from ciassd_jax.config import DataConfig
from ciassd_jax.data.gt_sampling import find_database
from ciassd_jax.data.loader import Batches
from ciassd_jax.training import loop
from ciassd_jax.training.loop import Fitted, Intervals, fit

STEPS = 9
_PROGRAMS: dict[Any, Any] = {}
_compile = loop._Run._compile
INTERVALS = Intervals(log=1, save=2, evaluate=4, keep=2)


def mini_config(steps: int = STEPS) -> Config:
    """`small_config()` with a moving average of the weights, so that the state has every part."""
    config = small_config()
    return replace(
        config,
        data=replace(config.data, max_points=1024, max_gt_sampling_points=512),
        schedule=replace(config.schedule, total_steps=steps, batch_size=2, ema_decay=0.9),
    )


def write_data(root: Path) -> Path:
    write_kitti(root)
    write_split(root, "train", *NAMES)
    write_split(root, "val", NAMES[0])
    return root


def mini_batches(root: Path, config: Config, **options: Any) -> Batches:
    dataset = open_dataset(root, "train")
    database = find_database(dataset, [root / "objects_train.bin"], log=lambda text: None)
    return make_batches(dataset, config, **{"seed": 3, "batch_size": 2, "database": database} | options)


def mini_fit(root: Path, workdir: Path, log: Callable[[str], object] = lambda text: None, **options: Any) -> Fitted:
    """Train with the same frames, weights, order and augmentation every time."""
    config = mini_config()
    chosen = {"variables": random_variables(config), "intervals": INTERVALS, "log": log} | options
    batches = chosen.pop("batches", None) or mini_batches(root, config)
    return fit(config, batches, workdir, **chosen)


def share_training_programs(monkeypatch: pytest.MonkeyPatch, programs: dict[Any, Any] = _PROGRAMS) -> None:
    """Compile the step of a config once for all trainings that share `programs`."""

    def compile_once(self: Any, batch: Any, signals: Any) -> Any:
        # The step does not depend on how the data is made.
        key = replace(self.config, data=DataConfig()), batch.frame.sharding, len(batch.frame)
        if key not in programs:
            programs[key] = _compile(self, batch, signals)
        return programs[key]

    monkeypatch.setattr(loop._Run, "_compile", compile_once)


if __name__ == "__main__":
    mini_fit(Path(sys.argv[1]), Path(sys.argv[2]))
