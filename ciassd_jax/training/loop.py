"""The training loop: steps, metrics, evaluation and checkpoints in one folder, resumed exactly.

The folder holds checkpoints/, eval/STEP/, best.safetensors, last.safetensors, and the files of `record.py`.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass, fields
from functools import partial
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
from ciassd_jax.formats.writing import check_folder
from ciassd_jax.inference.cost import program_memory
from ciassd_jax.inference.programs import announce, compile_program, for_this_backend
from ciassd_jax.inference.scoring import TRAINED
from ciassd_jax.inference.weights import save_weights
from ciassd_jax.model.checks import variables_of
from ciassd_jax.training import distributed
from ciassd_jax.training.checkpoint import Checkpoints
from ciassd_jax.training.progress import Progress
from ciassd_jax.training.record import Record, open_record
from ciassd_jax.training.signals import Signals, deferred_signals
from ciassd_jax.training.step import create_train_state, train_step
from ciassd_jax.training.validation import describe_score, score_weights
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
        for one in fields(self):
            value, least = getattr(self, one.name), int(one.name != "evaluate")
            if value < least:
                raise ValueError(f"intervals.{one.name} is {value}; give at least {least}.")


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
    one; it can also resume on other devices. SIGTERM and Ctrl-C stop it after the running step, with the state saved,
    and at once while it compiles. `variables` are the initial weights, by default random from the seed of the batches.
    `optimizer` is any optax transformation that a gradient and the loss suffice for, by default that of
    `config.schedule`; what is evaluated and written are the parameters, or their running mean. `batches` is closed at
    the end.

    The scenes of a batch are shared by all devices. Each of several processes calls this with its own `shard` of the
    batches and the same folder; only process 0 writes and logs. `log` is called with every line, which train.log keeps
    too.

    Raises InputError for a frame, checkpoint or folder that cannot be used, WorkerError for a dead worker,
    TrainingError if updates stay non-finite, and ParallelError if the processes cannot share a batch or another one
    failed. Checkpoints stay intact.
    """
    intervals, folder = intervals or Intervals(), Path(workdir)
    check_folder(folder)
    with ExitStack() as stack:
        stack.enter_context(batches)
        signals = stack.enter_context(deferred_signals())
        mesh = distributed.data_mesh(batches.state.batch_size)
        checkpoints = stack.enter_context(Checkpoints(folder / "checkpoints", config, keep=intervals.keep))
        state = _restore(checkpoints, batches, partial(create_train_state, config=config, optimizer=optimizer), mesh)
        if state is None:
            key = jax.random.key(batches.state.seed)
            state = create_train_state(key, config, variables=variables, optimizer=optimizer)
            # Copied, because every step donates the previous state.
            state = distributed.replicate(state, mesh)
        step, skipped, loader = int(state.step), int(state.skipped), batches.state
        record = distributed.on_process_0(partial(open_record, folder, config, loader, step, log))
        stack.enter_context(record or nullcontext())
        told = Progress(record, step, config.schedule.total_steps, loader.batch_size, skipped)
        run = _Run(
            config, folder, validation, optimizer, intervals, checkpoints, batches, mesh, record, told, state, step
        )
        stopped = run.train(signals, progress and distributed.is_process_0())
    return Fitted(run.state, record.best if record else None, stopped)


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
    # On process 0 only.
    record: Record | None
    progress: Progress
    state: TrainState
    # The last saved step.
    saved: int
    program: Any = None

    def train(self, signals: Signals, bar: bool) -> int | None:
        """Train to the last step, or until any process receives a signal; return that signal."""
        from tqdm.auto import tqdm

        total, step, code, failure = self.config.schedule.total_steps, self.saved, 0, None
        with tqdm(total=total, initial=step, unit="step", leave=False, disable=None if bar else True) as shown:
            while step < total:
                try:
                    batch = self._next(signals)
                except (InputError, WorkerError) as error:
                    failure = error
                except KeyboardInterrupt:
                    # Only `raising` interrupts here, or a second signal.
                    if step > self.saved or not signals:
                        raise
                # A signal to the process group also ends the workers, so it takes precedence.
                code = distributed.max_over_processes(signals[0] if signals else distributed.FAILED if failure else 0)
                if code:
                    break
                self.state, metrics = self.program(self.state, batch)
                self.progress.add(metrics)
                step += 1
                shown.update()
                self._after(step)
        self._save(step)
        self.checkpoints.wait()
        if code == distributed.FAILED:
            raise failure or distributed.ParallelError("Another process failed and reports why; the state is saved.")
        self._log_end(step, code)
        return code or None

    def _next(self, signals: Signals) -> Scene:
        """Return the next batch on the devices; before the first step, compile it.

        A signal then ends the wait of a process that trains alone at once, as no step was made.
        """
        if self.program is not None:
            return distributed.shard_batch(next(self.batches), self.mesh)
        alone = jax.process_count() == 1
        with signals.raising() if alone else nullcontext():
            announce("the augmentation of scenes")
            batch = distributed.shard_batch(next(self.batches), self.mesh)
            self.program = self._compile(batch, signals if alone else ())
        self.progress.start()
        return batch

    def _after(self, step: int) -> None:
        """Log, evaluate and save as due after a step."""
        evaluated = self._is_evaluated(step)
        if evaluated or step % self.intervals.save == 0:
            self._write_line(step)
            self._save(step, self._evaluate(step) if evaluated else None)
        elif step % self.intervals.log == 0:
            self._write_line(step)

    def _compile(self, batch: Scene, signals: Sequence[int]) -> Any:
        """Compile the step unless there is a signal, and log its time and memory."""
        start = time.perf_counter()
        function = partial(train_step, config=for_this_backend(self.config), optimizer=self.optimizer)
        step: Any = distributed.shard_step(function, self.mesh)
        scenes, points, _ = batch.cloud.points.shape
        what = f"the training step for {scenes} scenes of {points} points"
        program = compile_program(step, self.state, batch, what=what, signals=signals)
        sizes = ", ".join(f"{name} {size / 1e6:.0f} MB" for name, size in program_memory(program).items() if size)
        self._log(
            f"Compiled the step of {scenes} scenes for {distributed.describe(self.mesh)} in "
            f"{time.perf_counter() - start:.1f} s; memory: {sizes or 'unknown'}."
        )
        return program

    def _log(self, text: str) -> None:
        distributed.on_process_0(lambda: self.record.log(text) if self.record is not None else None)

    def _log_end(self, step: int, code: int) -> None:
        """Log how the training ended, with the signal `code` if it was stopped."""
        if code:
            saved = f"after step {step}, which is saved" if step else "before the first step: there is nothing to save"
            self._log(f"Stopped by {signal.Signals(code).name} {saved}.")
            return
        best = f"; best AP {self.record.best:.2f}" if self.record and self.record.best is not None else ""
        self._log(f"Trained {step} steps{best}. Weights, metrics and evaluations are in {self.folder}.")

    def _write_line(self, step: int) -> None:
        """Write and log one line for the steps since the last line."""
        self.progress.write(step, self._epoch(step))
        if self.progress.skipped_in_a_row >= _MAX_SKIPPED:
            raise TrainingError(
                f"The last {self.progress.skipped_in_a_row} updates were not finite; lower the learning rate or use "
                "float32, and start a new run in another folder."
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
        self.progress.skip_pause()
        return score

    def _score(self, step: int) -> float:
        """Score the validation frames, and export the weights if they are the best so far."""
        assert self.validation is not None
        assert self.record is not None
        numbers = score_weights(self.state, self.validation, self.config, self.folder / "eval" / str(step))
        score, best = numbers["score"], self.record.best
        self.record.write(step, numbers)
        self.record.log(f"step {step}  {describe_score(numbers)}; eval/{step}/table.txt has the rest")
        if best is None or score > best:
            self._export(_BEST)
        return score

    def _export(self, name: str) -> None:
        save_weights(self.folder / name, jax.device_get(variables_of(self.state)), self.config)

    def _save(self, step: int, score: float | None = None) -> None:
        """Export the last weights and save a checkpoint, unless this step has one."""
        if step > self.saved:
            distributed.on_process_0(partial(self._export, _LAST))
            self._write_line(step)
            self.checkpoints.save(self.state, self.batches.state._replace(batch=step), score=score)
            self.saved = step


def _restore(
    checkpoints: Checkpoints, batches: Batches, create: Callable[[jax.Array], TrainState], mesh: Mesh
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
    return restored.state
