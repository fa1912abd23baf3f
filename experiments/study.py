"""The setting of an experiment: frames, a config with a budget, and trainings that resume."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ciassd_jax import Config, make_batches, open_dataset
from ciassd_jax.config import DetectionConfig
from ciassd_jax.data.frames import Dataset
from ciassd_jax.data.gt_sampling import database_path, find_database
from ciassd_jax.data.loader import Batches
from ciassd_jax.model.checks import variables_of
from ciassd_jax.training.loop import Intervals, fit
from ciassd_jax.types import Variables

Log = Callable[[str], object]


@dataclass(frozen=True)
class Study:
    """The folder of frames, the config to train, the number of seeds, and the folder for trainings and results.

    `config` is the full method with the budget as its schedule; an experiment changes one part of it at a time. With
    `weights` nothing is trained: they are measured instead.
    """

    data: Path | None
    out: Path
    config: Config
    seeds: int = 1
    weights: Variables | None = None
    log: Log = print

    def validation(self) -> Dataset:
        """Open the frames that are scored."""
        return open_dataset(self.data, "val")

    def networks(self, variant: str, config: Config) -> list[Variables]:
        """Return the trained network of a variant for each seed; interrupted trainings resume.

        `variant` names the folder of the training, which experiments share. Raises InputError for a folder of another
        config or data set.
        """
        if self.weights is not None:
            return [self.weights]
        return [self._train(variant, config, seed) for seed in range(self.seeds)]

    def _train(self, variant: str, config: Config, seed: int) -> Variables:
        folder = self.out / "trainings" / f"{variant}-seed{seed}"
        self.log(f"{variant}, seed {seed}: training in {folder}.")
        steps = config.schedule.total_steps
        intervals = Intervals(log=min(100, steps), save=min(250, steps), evaluate=0, keep=1)
        fitted = fit(config, self._batches(config, seed), folder, intervals=intervals, progress=True, log=self.log)
        if fitted.stopped is not None:
            self.log("Interrupted. Re-run the same command to resume.")
            sys.exit(128 + fitted.stopped)
        return variables_of(fitted.state)

    def _batches(self, config: Config, seed: int) -> Batches:
        dataset = open_dataset(self.data, "train")
        database = None
        if config.data.augmentation.gt_sampling:
            places = [database_path(folder, "train") for folder in (self.data, self.out) if folder is not None]
            database = find_database(dataset, places, log=self.log)
        options: dict[str, Any] = {"seed": seed, "batch_size": config.schedule.batch_size, "database": database}
        return make_batches(dataset, config, **options)


def with_neck(config: Config, kind: str) -> Config:
    """Return the config with another neck."""
    return replace(config, neck=replace(config.neck, kind=kind))


def without_iou(config: Config) -> Config:
    """Return the config without the IoU branch."""
    return replace(config, head=replace(config.head, predict_iou=False))


def with_detection(config: Config, **changes: Any) -> DetectionConfig:
    """Return the config's post-processing with some fields changed."""
    return replace(config.detection, **changes)
