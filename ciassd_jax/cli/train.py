"""`ciassd train`: training with a record, evaluation and checkpoints, exactly resumable."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from shlex import join
from typing import Annotated, Literal

import jax
import tyro

from ciassd_jax.cli.config_options import ConfigOptions
from ciassd_jax.cli.initial_weights import describe_taken, find_unloaded
from ciassd_jax.cli.messages import UsageError, frames_with_bar, tell, values_from_options, warnings_as_lines
from ciassd_jax.cli.options import Dtype, Epochs, Folder, Frames, Split, Steps, Unset, WeightsFile
from ciassd_jax.config import Config, ScheduleConfig
from ciassd_jax.data.frames import Dataset
from ciassd_jax.data.gt_sampling import ObjectDatabase, database_path, find_database
from ciassd_jax.data.loader import Batches, make_batches
from ciassd_jax.data.scenes import check_targets
from ciassd_jax.data.workers import WorkerError
from ciassd_jax.formats.errors import warn_of_file
from ciassd_jax.formats.writing import check_folder
from ciassd_jax.inference.weights import load_weights, read_config
from ciassd_jax.model.frozen import check_frozen
from ciassd_jax.training.distributed import ParallelError, connect, is_process_0, on_process_0, shard
from ciassd_jax.training.loop import Intervals, TrainingError, fit
from ciassd_jax.training.validation import count_found
from ciassd_jax.types import TrainState, Variables

# Overfits one frame; the running statistics of BatchNorm need the last hundreds of steps to settle.
_OVERFIT = {"schedule.total_steps": 800, "schedule.learning_rate": 1e-3, "schedule.batch_size": 1}


@dataclass(frozen=True)
class Train:
    """Train a detector. Re-run the same command to resume.

    SIGTERM and Ctrl-C save the state after the running step and end the program with the shell's exit codes (143, 130).

    Several processes train together if each runs the same command with its own --process-index besides --coordinator
    and --num-processes. SLURM and TPU pods need none of the three.
    """

    workdir: Folder[Path]
    """Folder for everything that is written: config, metrics, checkpoints, evaluations, weights."""
    config_options: Annotated[ConfigOptions, tyro.conf.OmitArgPrefixes] = field(default_factory=ConfigOptions)
    data_set: Annotated[Frames, tyro.conf.OmitArgPrefixes] = field(default_factory=Frames)
    split: Split[str] = "train"
    """The frames to train on: train, trainval, all or a file of ImageSets."""
    validate: Split[str] = "val"
    """The split to evaluate on; none for no evaluation."""
    init_from: WeightsFile[Unset[Path]] = None
    """Weights to start from, by default with their config: a .safetensors, a released .pth, or bundled ones by name."""
    partial: bool = False
    """Take the tensors of --init-from that fit the config, for other classes or another range; draw the others."""
    freeze: Annotated[Unset[tuple[str, ...]], tyro.conf.arg(metavar="PART ...")] = None
    """Parts of the network that keep their parameters and statistics, such as backbone or neck/spatial_0."""
    overfit_one: Annotated[Unset[str], tyro.conf.arg(metavar="FRAME")] = None
    """Train on this frame alone without augmentation, to check that the model can overfit it; exit code 1 if not."""
    seed: int = 0
    """Seed of the weights, of the order of frames and their augmentation, and of simulated frames."""
    steps: Steps[Unset[int]] = None
    """Number of steps in all."""
    epochs: Epochs[Unset[int]] = None
    """Or the number of passes over the frames."""
    batch_size: Annotated[Unset[int], tyro.conf.arg(metavar="SCENES")] = None
    """Scenes per step."""
    workers: int = 0
    """Processes that read frames; with 0 a thread reads them."""
    dtype: Unset[Dtype] = None
    """Compute type of the network."""
    kind: Unset[Literal["one_cycle", "cosine"]] = None
    """Schedule of the learning rate."""
    learning_rate: Unset[float] = None
    """Peak learning rate."""
    weight_decay: Unset[float] = None
    """Decoupled weight decay of all parameters."""
    gradient_accumulation_steps: Steps[Unset[int]] = None
    """Steps whose gradients are averaged for one update."""
    ema_decay: Unset[float] = None
    """Decay of the moving average of the weights, which evaluation then uses; 0 for none."""
    remat: Unset[bool] = None
    """Recompute activations in the backward pass: less memory, more time."""
    log_every: Steps[int] = 50
    """Steps between two lines. Their ETA goes by the mean pace since the start, evaluations so far included."""
    save_every: Steps[int] = 1000
    """Steps between two checkpoints."""
    evaluate_every: Epochs[int] = 10
    """Epochs between two evaluations; 0 for no evaluation."""
    keep: int = 3
    """Number of recent checkpoints to keep, besides the best."""
    coordinator: Annotated[Unset[str], tyro.conf.arg(metavar="HOST:PORT|auto")] = None
    """Process 0 if several processes train together; auto for any cluster that JAX recognises."""
    num_processes: Unset[int] = None
    """Number of processes that train together."""
    process_index: Unset[int] = None
    """Index of this process, from 0."""

    def run(self) -> int:
        folder = self.data_set.find_folder()
        check_folder(self.workdir)
        with warnings_as_lines(folder or "simulated frames"):
            try:
                connect(self.coordinator, self.num_processes, self.process_index)
                return self._train(folder, tell if is_process_0() else lambda text: None)
            except (WorkerError, TrainingError, ParallelError) as error:
                raise UsageError(str(error)) from error

    def _train(self, folder: Path | None, log: Callable[[str], object]) -> int:
        dataset, validation = self.data_set.open(self.split, self.seed), None
        if self.overfit_one is not None:
            dataset = self._one_frame(dataset, self.overfit_one)
        elif self.validate.lower() != "none" and self.evaluate_every:
            validation = self.data_set.open(self.validate, self.seed)
        config, intervals = self._config(len(dataset)), self._intervals()
        # Before minutes of compilation and hours of training for nothing.
        if not check_targets(dataset, config, frames_with_bar) and self.overfit_one is not None:
            raise UsageError(
                f"Frame {self.overfit_one} has no target to overfit; name another frame, or another range."
            )
        variables = self._variables(config, log)
        batches = self._batches(dataset, config, self._database(dataset, config, folder, log))
        fitted = fit(
            config,
            batches,
            self.workdir,
            validation=validation,
            variables=variables,
            intervals=intervals,
            progress=True,
            log=log,
        )
        plot = f"`{join(['ciassd', 'plot', str(self.workdir)])}`"
        if fitted.stopped is not None:
            curves = f"; {plot} draws the curves so far" if int(fitted.state.step) else ""
            log(f"Run the same command again to resume{curves}.")
            return 128 + fitted.stopped
        code = 0 if self.overfit_one is None else self._report_overfit(fitted.state, dataset, config, log)
        log(f"Next: {plot}" if validation is None else f"Next: `{self._evaluation()}`, {plot}")
        return code

    def _evaluation(self) -> str:
        """The command that evaluates the best weights on the validation frames."""
        split = [] if self.validate == "val" else ["--split", self.validate]
        seed = ["--seed", str(self.seed)] if self.seed else []
        return join(["ciassd", "eval", "--workdir", str(self.workdir), *self.data_set.arguments(), *split, *seed])

    def _config(self, frames: int) -> Config:
        """The chosen config with the fields that are given as options."""
        if self.steps is not None and self.epochs is not None:
            raise UsageError("Give either --steps or --epochs.")
        if self.partial and self.init_from is None:
            raise UsageError("--partial takes what fits of the weights of --init-from; give both.")
        given = {f"schedule.{one.name}": getattr(self, one.name, None) for one in fields(ScheduleConfig)}
        given |= {"dtype": self.dtype, "schedule.total_steps": self.steps, "schedule.frozen": self.freeze}
        usual = _OVERFIT if self.overfit_one is not None else None
        own = read_config(self.init_from) if self.init_from is not None else None
        config = self.config_options.resolve(own, given, usual)
        if self.epochs is not None:
            steps = self.epochs * frames // config.schedule.batch_size
            config = self.config_options.resolve(own, given | {"schedule.total_steps": steps}, usual)
        if config.schedule.frozen:
            with values_from_options():
                check_frozen(config)
        return config

    def _intervals(self) -> Intervals:
        with values_from_options():
            return Intervals(self.log_every, self.save_every, self.evaluate_every, self.keep)

    def _batches(self, dataset: Dataset, config: Config, database: ObjectDatabase | None) -> Batches:
        with values_from_options():
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

    def _database(
        self, dataset: Dataset, config: Config, folder: Path | None, log: Callable[[str], object]
    ) -> ObjectDatabase | None:
        """The data set's own database, or one in the workdir; None if no objects are sampled."""
        sampled = config.data.augmentation.gt_sampling and any(one.gt_sampling_up_to for one in config.classes)
        if self.overfit_one is not None or not sampled:
            return None
        places = [database_path(place, self.split) for place in (folder, self.workdir) if place is not None]
        find = partial(find_database, dataset, places, frames_with_bar, log)
        # Process 0 may have to build it; the others then open it.
        return on_process_0(find) or find()

    def _variables(self, config: Config, log: Callable[[str], object]) -> Variables | None:
        weights = None
        if self.init_from is not None:
            weights = load_weights(self.init_from, config, self.partial, jax.random.key(self.seed))
        resumed = any(path.name.isdecimal() for path in self.workdir.glob("checkpoints/*"))
        if self.partial and weights is not None and not resumed:
            log(f"Taken from {self.init_from}:\n{describe_taken(weights.report)}")
        if not resumed and (parts := find_unloaded(config.schedule.frozen, weights)):
            warn_of_file(f"{', '.join(parts)}: frozen with random parameters, as no weights were loaded for all of it.")
        return None if weights is None else weights.variables

    def _report_overfit(self, state: TrainState, dataset: Dataset, config: Config, log: Callable[[str], object]) -> int:
        found, targets = on_process_0(partial(count_found, state, dataset, config)) or (0, 0)
        log(f"Frame {self.overfit_one}: {found} of {targets} objects are found at the strict overlap of their class.")
        return 0 if found == targets else 1
