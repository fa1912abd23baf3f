"""The training loop: steps, their record, evaluation and checkpoints in one folder, exactly resumable.

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
from jax.sharding import Mesh

from ciassd_jax.config import Config
from ciassd_jax.data.frames import Dataset
from ciassd_jax.data.loader import Batches
from ciassd_jax.data.workers import WorkerError
from ciassd_jax.formats.errors import InputError, Pathlike
from ciassd_jax.formats.writing import check_folder, write_text
from ciassd_jax.inference.scoring import TRAINED
from ciassd_jax.inference.weights import save_weights
from ciassd_jax.model.network import init_variables, variables_of
from ciassd_jax.training import distributed
from ciassd_jax.training.checkpoint import Checkpoints
from ciassd_jax.training.distributed import FAILED, ParallelError, agreed, from_first, is_first, on_first, replicated
from ciassd_jax.training.metrics import MetricsLog, is_left_out, summarise
from ciassd_jax.training.signals import signals_noted
from ciassd_jax.training.step import create_train_state, train_step
from ciassd_jax.training.validation import Validation
from ciassd_jax.types import Scene, TrainState, Variables

_BEST, _LAST = TRAINED
# So many updates in a row that are not finite mean that there is no way back.
_HOPELESS = 20


class TrainingError(RuntimeError):
    """Training cannot go on; the message is one sentence with the remedy."""


class Fitted(NamedTuple):
    """Where a training ended, the best validation score so far, and the signal that stopped it, if one did."""

    state: TrainState
    best: float | None
    stopped: int | None


@dataclass(frozen=True)
class Intervals:
    """How often things are done: lines of the record and checkpoints by steps, evaluation by epochs (0: never).

    Besides, all of it is done at the end. `keep` is the number of checkpoints that stay.
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
    intervals: Intervals | None = None,
    progress: bool = False,
    say: Callable[[str], object] = print,
) -> Fitted:
    """Train for `config.schedule.total_steps` on `batches`, from the newest checkpoint in `workdir` where one is.

    The scenes of a batch are shared by all devices of all processes, each of which calls this with its own `shard` of
    the batches and the same folder; only the first one writes and speaks. A run that was stopped, killed or broke, and
    is called again in the same way, ends with the same bits as one that was not; on other devices it goes on as well.
    Without `variables` to start from they are drawn from the seed of the batches. SIGTERM and Ctrl-C, to any process,
    end it after the step, with everything saved. The batches are closed at the end.

    Raises InputError for a frame, checkpoint or folder that cannot be used, WorkerError for a dead worker,
    TrainingError where losses stay not finite, and ParallelError where the processes cannot share a batch or another
    one failed; checkpoints stay intact.
    """
    intervals, folder = intervals or Intervals(), Path(workdir)
    say = say if is_first() else lambda text: None
    check_folder(folder)
    with ExitStack() as stack:
        stack.enter_context(batches)
        noted = stack.enter_context(signals_noted())
        mesh = distributed.data_mesh(batches.state.batch_size)
        checkpoints = stack.enter_context(Checkpoints(folder / "checkpoints", config, keep=intervals.keep))
        state = _resume(checkpoints, batches, config, mesh, say)
        if state is None:
            state = create_train_state(jax.random.key(batches.state.seed), config, variables=variables)
            # Copies, as every step gives up the memory of the state before.
            state = distributed.replicate(state, mesh)
        log = on_first(partial(_begin_record, folder, config, batches, int(state.step), say))
        if log is not None:
            stack.callback(log.close)
        scored = Validation(validation, config) if validation is not None else None
        run = _Run(config, folder, scored, intervals, checkpoints, batches, mesh, log, say, state, int(state.skipped))
        stopped = run.train(noted, progress and is_first())
    return Fitted(run.state, run.best, stopped)


@dataclass
class _Run:
    """A training under way: its parts, and what changes with every step."""

    config: Config
    folder: Path
    validation: Validation | None
    intervals: Intervals
    checkpoints: Checkpoints
    batches: Batches
    mesh: Mesh
    log: MetricsLog | None
    say: Callable[[str], object]
    state: TrainState
    skipped: int
    pending: list[dict[str, Any]] = field(default_factory=list)
    since: float = field(default_factory=time.perf_counter)

    @property
    def best(self) -> float | None:
        """The best validation score so far, that of the runs before included; only the first process knows."""
        lines = self.log.lines if self.log is not None else ()
        return max((line["score"] for line in lines if "score" in line), default=None)

    def train(self, noted: Sequence[int], progress: bool) -> int | None:
        """Go to the last step, or as far as a signal to any of the processes lets it; returns that signal."""
        from tqdm.auto import tqdm

        program, total, step = None, self.config.schedule.total_steps, int(self.state.step)
        saved, ended, failure = step, 0, None
        with tqdm(total=total, initial=step, unit="step", leave=False, disable=None if progress else True) as bar:
            while step < total:
                try:
                    batch = next(self.batches)
                except (InputError, WorkerError) as error:
                    failure = error
                # A signal to the whole group ends the workers too, and comes first.
                ended = agreed(noted[0] if noted else FAILED if failure else 0)
                if ended:
                    break
                batch = distributed.shard_batch(batch, self.mesh)
                if program is None:
                    program = self._compile(batch)
                self.state, metrics = program(self.state, batch)
                # One step is under way while the next batch is prepared, never more.
                if self.pending:
                    jax.block_until_ready(self.pending[-1])
                self.pending.append(metrics)
                step += 1
                bar.update()
                saved = self._report(step, saved)
        self._save(step, saved)
        if ended == FAILED:
            raise failure or ParallelError("Another process cannot go on, and says why; what was trained is saved.")
        return ended or None

    def _report(self, step: int, saved: int) -> int:
        """What is due after a step; returns the step that was saved last."""
        evaluated = self._is_evaluated(step)
        if not (evaluated or step % self.intervals.save == 0):
            if step % self.intervals.log == 0:
                self._write_line(step)
            return saved
        self._write_line(step)
        self._save(step, saved, self._evaluate(step) if evaluated else None)
        return step

    def _compile(self, batch: Scene) -> Any:
        """Compile the step once for all, and say what it takes."""
        start = time.perf_counter()
        step: Any = distributed.shard_step(partial(train_step, config=self.config), self.mesh)
        program = step.lower(self.state, batch).compile()
        memory: Any = program.memory_analysis()
        sizes = ", ".join(
            f"{name} {size / 1e6:.0f} MB"
            for name in ("argument", "output", "temp")
            # Not every backend reports its memory.
            if (size := getattr(memory, f"{name}_size_in_bytes", None)) is not None
        )
        self.say(
            f"Compiled the step of {len(batch.frame)} scenes for {distributed.describe(self.mesh)} in "
            f"{time.perf_counter() - start:.1f} s; memory: {sizes or 'unknown'}."
        )
        self.since = time.perf_counter()
        return program

    def _write_line(self, step: int) -> None:
        """One line for the steps since the last: means, sums of what was left out, and states as they are now."""
        if not self.pending:
            return
        rows = jax.device_get(self.pending)
        skipped, self.skipped = int(rows[-1]["skipped"]) - self.skipped, int(rows[-1]["skipped"])
        numbers = summarise(rows)
        seconds = (time.perf_counter() - self.since) / len(rows)
        numbers |= {"epoch": self._epoch(step), "seconds": seconds}
        self._record(step, numbers)
        self.pending, self.since = [], time.perf_counter()
        lost = ", ".join(f"{name} {numbers[name]:.0f}" for name in numbers if is_left_out(name) and numbers[name])
        self.say(
            f"step {step}/{self.config.schedule.total_steps}  epoch {numbers['epoch']:.2f}  loss {numbers['loss']:.4f}"
            f"  {seconds:.2f} s a step" + (f"  ({lost})" if lost else "")
        )
        if skipped >= _HOPELESS and skipped == len(rows):
            raise TrainingError(
                f"The last {skipped} updates were not finite; lower the learning rate, or take --dtype float32, and "
                "start anew in another folder."
            )

    def _epoch(self, step: int) -> float:
        """How often the frames were seen after so many steps."""
        return step * self.batches.state.batch_size / self.batches.state.frames

    def _is_evaluated(self, step: int) -> bool:
        """Whether an epoch that is to be evaluated ended with this step, or training does."""
        every = self.intervals.evaluate
        if self.validation is None or every == 0:
            return False
        ended = self._epoch(step) // every > self._epoch(step - 1) // every
        return ended or step == self.config.schedule.total_steps

    def _record(self, step: int, numbers: dict[str, float]) -> None:
        on_first(lambda: self.log.write(step, numbers) if self.log is not None else None)

    def _evaluate(self, step: int) -> float | None:
        """Score the validation frames on the first process, and keep the weights if they are the best so far."""
        score = from_first(on_first(partial(self._score, step)))
        self.since = time.perf_counter()
        return score

    def _score(self, step: int) -> float | None:
        assert self.validation is not None
        assert self.log is not None
        numbers = self.validation.score(self.state, self.folder / "eval" / str(step))
        if not numbers:
            return None
        score, best = next(iter(numbers.values())), self.best
        self.log.write(step, {"score": score, **numbers})
        self.say(f"step {step}  " + "  ".join(f"{name} {value:.2f}" for name, value in numbers.items()))
        if best is None or score > best:
            self._export(_BEST)
        return score

    def _export(self, name: str) -> None:
        save_weights(self.folder / name, jax.device_get(variables_of(self.state)), self.config)

    def _save(self, step: int, saved: int, score: float | None = None) -> None:
        """Save the state after `step`, unless it is already."""
        on_first(partial(self._export, _LAST))
        if step > saved:
            self._write_line(step)
            self.checkpoints.save(self.state, self.batches.state._replace(batch=step), score=score)


def _resume(
    checkpoints: Checkpoints, batches: Batches, config: Config, mesh: Mesh, say: Callable[[str], object]
) -> TrainState | None:
    """The state to go on from, with the loader there too; None without a checkpoint."""
    key, everywhere = jax.random.key(0), replicated(mesh)
    variables = jax.eval_shape(partial(init_variables, config=config), key)
    shapes = jax.eval_shape(lambda start: create_train_state(key, config, variables=start), variables)
    like = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=everywhere), shapes)
    restored = checkpoints.restore(like)
    if restored is None:
        return None
    try:
        batches.set_state(restored.loader)
    except ValueError as error:
        raise InputError(f"{checkpoints.folder} is of another training: {error}") from error
    say(f"Going on from step {int(restored.state.step)} in {checkpoints.folder}.")
    return restored.state


def _begin_record(
    folder: Path, config: Config, batches: Batches, step: int, say: Callable[[str], object]
) -> MetricsLog:
    """Write the config and what the training runs with, and open its record at a step."""
    packages = ("ciassd_jax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "grain", "numpy")
    facts = {
        **{name: version(name) for name in packages},
        "python": platform.python_version(),
        "devices": [f"{device.platform} {device.device_kind}" for device in jax.devices()],
        **{name: value for name, value in batches.state._asdict().items() if name != "batch"},
    }
    write_text(folder / "config.json", config.to_json())
    write_text(folder / "versions.json", json.dumps(facts, indent=1))
    return MetricsLog(folder, step, say)
