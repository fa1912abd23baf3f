"""The training loop: steps, metrics, evaluation and checkpoints in one folder, resumed exactly.

The folder holds config.json, versions.json, metrics.jsonl, tb/, checkpoints/, eval/STEP/, best.safetensors and
last.safetensors.
"""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import optax
from jax.sharding import Mesh

from ciassd_jax.config import Config
from ciassd_jax.data.frames import Dataset
from ciassd_jax.data.loader import Batches
from ciassd_jax.data.workers import WorkerError
from ciassd_jax.formats.errors import InputError, Pathlike
from ciassd_jax.formats.writing import check_folder, write_text
from ciassd_jax.inference.scoring import TRAINED
from ciassd_jax.inference.weights import save_weights
from ciassd_jax.model.network import variables_of
from ciassd_jax.training import distributed
from ciassd_jax.training.checkpoint import Checkpoints
from ciassd_jax.training.metrics import MetricsLog, describe_metrics, summarise
from ciassd_jax.training.signals import deferred_signals
from ciassd_jax.training.step import create_train_state, train_step
from ciassd_jax.training.validation import score_weights
from ciassd_jax.types import Scene, TrainState, Variables

_BEST, _LAST = TRAINED
# Training fails after this many non-finite updates in a row.
_MAX_SKIPPED = 20


class TrainingError(RuntimeError):
    """Training cannot continue; the message is one sentence with the remedy."""


class Fitted(NamedTuple):
    """The final state, the best validation score of the run, and the signal that stopped it, if any."""

    state: TrainState
    best: float | None
    stopped: int | None


@dataclass(frozen=True)
class Intervals:
    """How often to log and save, in steps, and to evaluate, in epochs (0: never); all three also happen at the end.

    `keep` is the number of recent checkpoints to keep.
    """

    log: int = 50
    save: int = 1000
    evaluate: int = 10
    keep: int = 3

    def __post_init__(self) -> None:
        if min(self.log, self.save, self.keep) < 1 or self.evaluate < 0:
            raise ValueError(f"{self}: log, save and keep must be at least 1, evaluate at least 0.")


def fit(
    config: Config,
    batches: Batches,
    workdir: Pathlike,
    *,
    validation: Dataset | None = None,
    variables: Variables | None = None,
    optimizer: optax.GradientTransformation | None = None,
    intervals: Intervals | None = None,
    progress: bool = False,
    log: Callable[[str], object] = print,
) -> Fitted:
    """Train for `config.schedule.total_steps` on `batches`; resume from the newest checkpoint in `workdir` if any.

    A run that was interrupted or killed, and is resumed by the same call, ends with the same bits as an uninterrupted
    one; it can also resume on other devices. SIGTERM and Ctrl-C stop it after the running step, with the state saved.
    `variables` are the initial weights, by default random from the seed of the batches. `optimizer` is any optax
    transformation, by default that of `config.schedule`. `batches` is closed at the end.

    The scenes of a batch are shared by all devices. Each of several processes calls this with its own `shard` of the
    batches and the same folder; only process 0 writes and logs.

    Raises InputError for a frame, checkpoint or folder that cannot be used, WorkerError for a dead worker,
    TrainingError if updates stay non-finite, and ParallelError if the processes cannot share a batch or another one
    failed. Checkpoints stay intact.
    """
    intervals, folder = intervals or Intervals(), Path(workdir)
    log = log if distributed.is_process_0() else lambda text: None
    check_folder(folder)
    with ExitStack() as stack:
        stack.enter_context(batches)
        signals = stack.enter_context(deferred_signals())
        mesh = distributed.data_mesh(batches.state.batch_size)
        checkpoints = stack.enter_context(Checkpoints(folder / "checkpoints", config, keep=intervals.keep))
        state = _resume(
            checkpoints, batches, partial(create_train_state, config=config, optimizer=optimizer), mesh, log
        )
        if state is None:
            key = jax.random.key(batches.state.seed)
            state = create_train_state(key, config, variables=variables, optimizer=optimizer)
            # Copied, because every step donates the previous state.
            state = distributed.replicate(state, mesh)
        step, skipped = int(state.step), int(state.skipped)
        metrics = distributed.on_process_0(partial(_start_metrics, folder, config, batches, step, log))
        if metrics is not None:
            stack.callback(metrics.close)
        run = _Run(
            config,
            folder,
            validation,
            optimizer,
            intervals,
            checkpoints,
            batches,
            mesh,
            metrics,
            log,
            state,
            step,
            skipped,
        )
        stopped = run.train(signals, progress and distributed.is_process_0())
    return Fitted(run.state, run.best, stopped)


@dataclass
class _Run:
    """The parts of a running training, and its state, which every step replaces."""

    config: Config
    folder: Path
    validation: Dataset | None
    optimizer: optax.GradientTransformation | None
    intervals: Intervals
    checkpoints: Checkpoints
    batches: Batches
    mesh: Mesh
    metrics: MetricsLog | None
    log: Callable[[str], object]
    state: TrainState
    # The last saved step, the skipped updates, and the metrics of the steps since the last line with its time.
    saved: int
    skipped: int
    skipped_in_a_row: int = 0
    pending: list[dict[str, Any]] = field(default_factory=list)
    since: float = field(default_factory=time.perf_counter)

    @property
    def best(self) -> float | None:
        """The best validation score so far, earlier parts of the run included; None except on process 0."""
        lines = self.metrics.lines if self.metrics is not None else ()
        return max((line["score"] for line in lines if "score" in line), default=None)

    def train(self, signals: Sequence[int], progress: bool) -> int | None:
        """Train to the last step, or until any process receives a signal; return that signal."""
        from tqdm.auto import tqdm

        total, step = self.config.schedule.total_steps, self.saved
        program, code, failure = None, 0, None
        with tqdm(total=total, initial=step, unit="step", leave=False, disable=None if progress else True) as bar:
            while step < total:
                try:
                    batch = next(self.batches)
                except (InputError, WorkerError) as error:
                    failure = error
                # A signal to the process group also ends the workers, so it takes precedence.
                code = distributed.max_over_processes(signals[0] if signals else distributed.FAILED if failure else 0)
                if code:
                    break
                batch = distributed.shard_batch(batch, self.mesh)
                if program is None:
                    program = self._compile(batch)
                self.state, metrics = program(self.state, batch)
                # At most one step runs while the next batch is prepared.
                jax.block_until_ready(self.pending[-1:])
                self.pending.append(metrics)
                step += 1
                bar.update()
                self._after(step)
        self._save(step)
        if code == distributed.FAILED:
            raise failure or distributed.ParallelError("Another process failed and reports why; the state is saved.")
        return code or None

    def _after(self, step: int) -> None:
        """Log, evaluate and save as due after a step."""
        evaluated = self._is_evaluated(step)
        if evaluated or step % self.intervals.save == 0:
            self._write_line(step)
            self._save(step, self._evaluate(step) if evaluated else None)
        elif step % self.intervals.log == 0:
            self._write_line(step)

    def _compile(self, batch: Scene) -> Any:
        """Compile the step, and log its time and memory."""
        start = time.perf_counter()
        step: Any = distributed.shard_step(partial(train_step, config=self.config, optimizer=self.optimizer), self.mesh)
        program = step.lower(self.state, batch).compile()
        memory: Any = program.memory_analysis()
        sizes = ", ".join(
            f"{name} {size / 1e6:.0f} MB"
            for name in ("argument", "output", "temp")
            # Some backends do not report memory.
            if (size := getattr(memory, f"{name}_size_in_bytes", None)) is not None
        )
        self.log(
            f"Compiled the step of {len(batch.frame)} scenes for {distributed.describe(self.mesh)} in "
            f"{time.perf_counter() - start:.1f} s; memory: {sizes or 'unknown'}."
        )
        self.since = time.perf_counter()
        return program

    def _write_line(self, step: int) -> None:
        """Write and log one line for the steps since the last line."""
        if not self.pending:
            return
        rows = jax.device_get(self.pending)
        skipped, self.skipped = int(rows[-1]["skipped"]) - self.skipped, int(rows[-1]["skipped"])
        self.skipped_in_a_row = self.skipped_in_a_row + skipped if skipped == len(rows) else 0
        seconds = (time.perf_counter() - self.since) / len(rows)
        numbers = summarise(rows) | {"epoch": self._epoch(step), "seconds": seconds}
        distributed.on_process_0(lambda: self.metrics.write(step, numbers) if self.metrics is not None else None)
        self.pending, self.since = [], time.perf_counter()
        self.log(describe_metrics(step, self.config.schedule.total_steps, numbers))
        if self.skipped_in_a_row >= _MAX_SKIPPED:
            raise TrainingError(
                f"The last {self.skipped_in_a_row} updates were not finite; lower the learning rate or use float32, "
                "and start a new run in another folder."
            )

    def _epoch(self, step: int) -> float:
        """Passes over the frames after `step` steps."""
        return step * self.batches.state.batch_size / self.batches.state.frames

    def _is_evaluated(self, step: int) -> bool:
        """Whether evaluation is due: at the end of an epoch by the interval, and at the end of training."""
        every = self.intervals.evaluate
        if self.validation is None or every == 0:
            return False
        ended = self._epoch(step) // every > self._epoch(step - 1) // every
        return ended or step == self.config.schedule.total_steps

    def _evaluate(self, step: int) -> float | None:
        score = distributed.broadcast_from_process_0(distributed.on_process_0(partial(self._score, step)))
        self.since = time.perf_counter()
        return score

    def _score(self, step: int) -> float:
        """Score the validation frames, and export the weights if they are the best so far."""
        assert self.validation is not None
        assert self.metrics is not None
        numbers = score_weights(self.state, self.validation, self.config, self.folder / "eval" / str(step))
        score, best = numbers["score"], self.best
        self.metrics.write(step, numbers)
        self.log(f"step {step}  " + "  ".join(f"{name} {round(value, 2):g}" for name, value in numbers.items()))
        if best is None or score > best:
            self._export(_BEST)
        return score

    def _export(self, name: str) -> None:
        save_weights(self.folder / name, jax.device_get(variables_of(self.state)), self.config)

    def _save(self, step: int, score: float | None = None) -> None:
        """Export the last weights, and save a checkpoint unless this step has one."""
        distributed.on_process_0(partial(self._export, _LAST))
        if step > self.saved:
            self._write_line(step)
            self.checkpoints.save(self.state, self.batches.state._replace(batch=step), score=score)
            self.saved = step


def _resume(
    checkpoints: Checkpoints,
    batches: Batches,
    create: Callable[[jax.Array], TrainState],
    mesh: Mesh,
    log: Callable[[str], object],
) -> TrainState | None:
    """Return the state of the newest checkpoint and set the loader to it; None if there is none."""
    shapes = jax.eval_shape(create, jax.random.key(0))
    everywhere = distributed.replicated(mesh)
    like = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=everywhere), shapes)
    restored = checkpoints.restore(like)
    if restored is None:
        return None
    try:
        batches.set_state(restored.loader)
    except ValueError as error:
        raise InputError(f"{checkpoints.folder} belongs to another training: {error}") from error
    log(f"Resuming from step {int(restored.state.step)} in {checkpoints.folder}.")
    return restored.state


def _start_metrics(
    folder: Path, config: Config, batches: Batches, step: int, log: Callable[[str], object]
) -> MetricsLog:
    """Write the config, versions and devices of the run, and open its metrics at a step."""
    packages = ("ciassd_jax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "grain", "numpy")
    facts = {
        **{name: version(name) for name in packages},
        "python": platform.python_version(),
        "devices": [f"{device.platform} {device.device_kind}" for device in jax.devices()],
        **{name: value for name, value in batches.state._asdict().items() if name != "batch"},
    }
    write_text(folder / "config.json", config.to_json())
    write_text(folder / "versions.json", json.dumps(facts, indent=1))
    return MetricsLog(folder, step, log)
