"""The command train."""

from __future__ import annotations

import gc
import logging
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ciassd_jax.cli.inference import Preset
from ciassd_jax.cli.messages import UsageError, frames_with_bar, warnings_as_lines
from ciassd_jax.config import Config
from ciassd_jax.config.presets import PRESETS
from ciassd_jax.formats.errors import InputError

if TYPE_CHECKING:
    from ciassd_jax.data.frames import Dataset
    from ciassd_jax.data.gt_sampling import ObjectDatabase
    from ciassd_jax.data.loader import Batches
    from ciassd_jax.training.loop import Intervals
    from ciassd_jax.types import Variables

# Options that replace a field of the config's schedule.
_SCHEDULE = ("batch_size", "kind", "learning_rate", "weight_decay", "accumulate", "ema_decay", "remat")
# One frame is learnt by heart so; the running statistics of the batch norms need the last hundreds of steps to settle.
_OVERFIT = {"total_steps": 800, "learning_rate": 1e-3, "batch_size": 1}


@dataclass(frozen=True)
class Train:
    """Train a detector; the same command again goes on where the first one ended, whatever ended it.

    SIGTERM and Ctrl-C end it with everything saved and the exit code that shells give (143, 130).
    """

    workdir: Path
    """Folder for everything that is written: config, metrics, checkpoints, evaluations, weights."""
    preset: Preset = "car"
    """What is trained."""
    data: Path | None = None
    """Folder in KITTI's or OpenPCDet's custom layout; KITTI_ROOT without it."""
    split: str = "train"
    """The frames to train on: train, trainval, all or a file of ImageSets."""
    validate: str | None = "val"
    """The frames to evaluate on; None for no evaluation."""
    image_size: tuple[int, int] | None = None
    """Width and height of the images in pixels, for cameras that KITTI does not have."""
    init_from: Path | None = None
    """Weights to start from: a file of ours, a released .pth, or the name of bundled ones."""
    overfit_one: str | None = None
    """Train on this frame alone without augmentation, to see that learning works; exit code 1 if it is not learnt."""
    seed: int = 0
    """Of the weights, the order of the frames and the augmentation."""
    steps: int | None = None
    """How many steps in all (the preset's schedule: 55680; 800 with --overfit-one)."""
    epochs: int | None = None
    """Or how many passes over the frames."""
    batch_size: int | None = None
    """Scenes a step (4; 1 with --overfit-one)."""
    workers: int = 0
    """Processes that read frames; 0 for a thread of this one."""
    dtype: Literal["float32", "bfloat16"] | None = None
    """Compute type of the network."""
    kind: Literal["one_cycle", "cosine"] | None = None
    """Schedule of the learning rate (one_cycle)."""
    learning_rate: float | None = None
    """Its peak (0.003; 0.001 with --overfit-one)."""
    weight_decay: float | None = None
    """Decoupled decay of all parameters (0.01)."""
    accumulate: int | None = None
    """Gradients of so many batches make one update (1)."""
    ema_decay: float | None = None
    """Decay of the running mean of the weights, which evaluation then uses (0: none)."""
    remat: bool | None = None
    """Compute activations again in the backward pass: less memory, more time."""
    log_every: int = 50
    """Steps between two lines of metrics.jsonl."""
    save_every: int = 1000
    """Steps between two checkpoints."""
    evaluate_every: int = 10
    """Epochs between two evaluations; 0 for none."""
    keep: int = 3
    """So many of the last checkpoints stay, and the best."""
    coordinator: str | None = None
    """HOST:PORT of process 0 where several train together, each started with the same options but for its index; SLURM
    and TPU pods are recognised without, "auto" tries any other cluster that JAX knows."""
    num_processes: int | None = None
    """How many processes train together."""
    process_index: int | None = None
    """Which of them this is, from 0."""

    def run(self) -> int:
        from tqdm.auto import tqdm

        from ciassd_jax.data.folders import find_root
        from ciassd_jax.data.workers import WorkerError
        from ciassd_jax.formats.writing import check_folder
        from ciassd_jax.training.distributed import ParallelError, connect, is_first
        from ciassd_jax.training.loop import TrainingError

        root = find_root(self.data)
        check_folder(self.workdir)
        with warnings_as_lines(root), _storage_silenced():
            try:
                connect(self.coordinator, self.num_processes, self.process_index)
                return self._train(root, tqdm.write if is_first() else lambda text: None)
            except (WorkerError, TrainingError, ParallelError) as error:
                raise UsageError(str(error)) from error

    def _train(self, root: Path, say: Any) -> int:
        from ciassd_jax.data.folders import open_dataset
        from ciassd_jax.training.loop import fit

        dataset = open_dataset(root, self.split, self.image_size)
        validation = None
        if self.overfit_one is not None:
            dataset = self._one_frame(dataset, self.overfit_one)
        elif self.validate is not None and self.evaluate_every:
            validation = open_dataset(root, self.validate, self.image_size)
        config, intervals = self._config(len(dataset)), self._intervals()
        variables = self._variables(config)
        batches = self._batches(dataset, config, self._database(dataset, config, root, say))
        fitted = fit(
            config,
            batches,
            self.workdir,
            validation=validation,
            variables=variables,
            intervals=intervals,
            progress=True,
            say=say,
        )
        step = int(fitted.state.step)
        if fitted.stopped is not None:
            say(f"Stopped by signal {fitted.stopped} after step {step}, which is saved; the same command goes on.")
            return 128 + fitted.stopped
        best = "" if fitted.best is None else f"; best AP {fitted.best:.2f}"
        say(f"Trained {step} steps{best}. Weights, metrics and evaluations are in {self.workdir}.")
        return 0 if self.overfit_one is None else self._report_overfit(fitted.state, dataset, config, say)

    def _config(self, frames: int) -> Config:
        """The preset with the options' values."""
        if self.steps is not None and self.epochs is not None:
            raise UsageError("Give either --steps or --epochs.")
        config = PRESETS[self.preset]()
        given = {name: getattr(self, name) for name in _SCHEDULE if getattr(self, name) is not None}
        if self.overfit_one is not None:
            given = _OVERFIT | given
        with _refused_as_usage():
            schedule = replace(config.schedule, **given)
            steps = self.steps if self.epochs is None else self.epochs * frames // schedule.batch_size
            if steps is not None:
                schedule = replace(schedule, total_steps=steps)
        return replace(config, schedule=schedule, dtype=self.dtype or config.dtype)

    def _intervals(self) -> Intervals:
        from ciassd_jax.training.loop import Intervals

        with _refused_as_usage():
            return Intervals(self.log_every, self.save_every, self.evaluate_every, self.keep)

    def _batches(self, dataset: Dataset, config: Config, database: ObjectDatabase | None) -> Batches:
        from ciassd_jax.data.loader import make_batches
        from ciassd_jax.training.distributed import shard

        with _refused_as_usage():
            return make_batches(
                dataset,
                config,
                seed=self.seed,
                batch_size=config.schedule.batch_size,
                database=database,
                augmented=self.overfit_one is None,
                workers=self.workers,
                shard=shard(),
            )

    def _one_frame(self, dataset: Dataset, name: str) -> Dataset:
        if name not in dataset.names:
            raise UsageError(
                f"Frame {name} is not among the {len(dataset)} of {self.split}, such as {dataset.names[0]}; name one "
                "of them."
            )
        return replace(dataset, names=(name,))

    def _database(self, dataset: Dataset, config: Config, root: Path, say: Any) -> ObjectDatabase | None:
        """The data set's own database, or one in the workdir; none where nothing is pasted."""
        from ciassd_jax.data.gt_sampling import database_path, find_database
        from ciassd_jax.training.distributed import on_first

        pasted = config.data.augmentation.gt_sampling and any(one.gt_sampling_up_to for one in config.classes)
        if self.overfit_one is not None or not pasted:
            return None
        places = [database_path(folder, self.split) for folder in (root, self.workdir)]
        find = partial(find_database, dataset, places, frames_with_bar, say)
        # The others open what the first one may have to build.
        return on_first(find) or find()

    def _variables(self, config: Config) -> Variables | None:
        from ciassd_jax.inference.weights import check_fits, find_weights, load_weights

        if self.init_from is None:
            return None
        weights = load_weights(find_weights(self.init_from))
        check_fits(weights, config, self.init_from)
        return weights.variables

    def _report_overfit(self, state: Any, dataset: Dataset, config: Config, say: Any) -> int:
        from ciassd_jax.training.distributed import on_first
        from ciassd_jax.training.validation import count_found

        found, targets = on_first(partial(count_found, state, dataset, config)) or (0, 0)
        say(f"Frame {self.overfit_one}: {found} of {targets} objects are found at a 3D overlap of 0.7.")
        return 0 if found == targets else 1


@contextmanager
def _storage_silenced() -> Iterator[None]:
    """Of a file that cannot be read or written the storage's threads print pages, when our sentence says it."""
    for name in ("absl", "asyncio"):
        # For good: some of it is said when the program ends.
        logging.getLogger(name).setLevel(logging.CRITICAL)
    before = sys.unraisablehook
    sys.unraisablehook = lambda unraisable: None
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "coroutine .* was never awaited", RuntimeWarning)
            try:
                yield
            except InputError as error:
                # Writes that were given up end a little later; causes and frames would keep them until the very end.
                time.sleep(0.5)
                error.__cause__ = error.__context__ = None
                raise error.with_traceback(None)  # noqa: B904
            finally:
                gc.collect()
    finally:
        sys.unraisablehook = before


@contextmanager
def _refused_as_usage() -> Iterator[None]:
    """What these numbers are refused with is the user's to mend."""
    try:
        yield
    except ValueError as error:
        raise UsageError(str(error)) from error
