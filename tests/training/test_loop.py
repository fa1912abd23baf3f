"""The training loop: the files of its folder, and interrupted runs that resume to the same bits."""

import json
import re
import signal
import subprocess
import sys
import time
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from mini_training import (
    STEPS,
    mini_batches,
    mini_config,
    mini_fit,
    share_training_programs,
    write_data,
)
from small import random_variables

from ciassd_jax import create_train_state, load_weights, make_batches, open_dataset, open_synthetic
from ciassd_jax.data.gt_sampling import find_database
from ciassd_jax.data.workers import WorkerError
from ciassd_jax.formats.errors import InputError
from ciassd_jax.model.checks import variables_of
from ciassd_jax.simulation import Lidar
from ciassd_jax.training import loop
from ciassd_jax.training.checkpoint import Checkpoints
from ciassd_jax.training.loop import Fitted, Intervals, TrainingError, fit
from ciassd_jax.training.record import Record
from ciassd_jax.training.signals import deferred_signals
from ciassd_jax.training.validation import score_checkpoints
from ciassd_jax.types import TrainState


@pytest.fixture(scope="module", autouse=True)
def _compiled_once() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        share_training_programs(patch, {})
        yield


@pytest.fixture(autouse=True)
def _interruptible() -> Iterator[None]:
    """Handle SIGINT as at a terminal; in a background job it is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def whole(root: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Fitted, Path, list[str]]:
    """An uninterrupted run, its folder and its log."""
    workdir, logged = tmp_path_factory.mktemp("whole") / "new", []
    validation = open_dataset(root, "val")
    return mini_fit(root, workdir, logged.append, validation=validation), workdir, logged


def assert_same_bits(some: TrainState, others: TrainState) -> None:
    assert jax.tree.structure(some) == jax.tree.structure(others)
    jax.tree.map(np.testing.assert_array_equal, some, others)


def lines(workdir: Path) -> list[dict[str, Any]]:
    """The lines of the metrics without times and evaluations."""
    found = map(json.loads, (workdir / "metrics.jsonl").read_text().splitlines())
    return [{name: value for name, value in line.items() if name != "seconds"} for line in found if "loss" in line]


def saved_state(workdir: Path) -> TrainState:
    like = create_train_state(jax.random.key(0), mini_config(), variables=random_variables(mini_config()))
    with Checkpoints(workdir / "checkpoints", mini_config()) as checkpoints:
        restored = checkpoints.restore(like)
    assert restored is not None
    assert restored.loader.batch == restored.state.step
    return restored.state


def test_the_folder_is_complete(whole: tuple[Fitted, Path, list[str]]) -> None:
    fitted, workdir, logged = whole
    assert int(fitted.state.step) == STEPS
    assert fitted.stopped is None
    names = {path.name for path in workdir.iterdir()}
    assert names == {
        *("config.json", "versions.json", "metrics.jsonl", "train.log", "checkpoints", "eval"),
        *("best.safetensors", "last.safetensors"),
    }
    assert (workdir / "config.json").read_text().strip() == mini_config().to_json()
    assert json.loads((workdir / "versions.json").read_text())["seed"] == 3
    # Three frames in batches of two: epoch 4 ends with step 6.
    assert sorted(path.name for path in (workdir / "eval").iterdir()) == ["6", "9"]
    assert {path.name for path in (workdir / "eval" / "9").iterdir()} == {"data", "result.json", "table.txt"}
    assert (workdir / "eval" / "9" / "data" / "000000.txt").is_file()
    assert {"8", "9"} <= {path.name for path in (workdir / "checkpoints").iterdir()}
    assert sum(text.startswith("Compiled the step of 2 scenes for 2 cpu devices in ") for text in logged) == 1
    assert sum("tensorboardX" in text for text in logged) == 1
    assert (
        logged[-1] == f"Trained 9 steps; best AP {fitted.best:.2f}. Weights, metrics and evaluations are in {workdir}."
    )
    kept = (workdir / "train.log").read_text().splitlines()
    assert [re.sub(r"^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d  ", "", line) for line in kept] == logged


def test_the_metrics_have_every_step_and_scores(whole: tuple[Fitted, Path, list[str]]) -> None:
    fitted, workdir, _ = whole
    assert [line["step"] for line in lines(workdir)] == list(range(1, STEPS + 1))
    assert lines(workdir)[2]["epoch"] == 2
    every = [json.loads(line) for line in (workdir / "metrics.jsonl").read_text().splitlines()]
    scores = {line["step"]: line for line in every if "score" in line}
    assert set(scores) == {6, 9}
    assert scores[9]["score"] == scores[9]["Car_3d_0.70_moderate_R40"]
    assert "Car_bev_0.50_moderate_R40" in scores[9]
    assert fitted.best == max(line["score"] for line in scores.values())


def test_the_weights_are_those_of_the_last_step(whole: tuple[Fitted, Path, list[str]]) -> None:
    fitted, workdir, _ = whole
    weights = load_weights(workdir / "last.safetensors")
    assert weights.config == mini_config()
    # The moving average of the weights, which this config asks for.
    jax.tree.map(np.testing.assert_array_equal, weights.variables, variables_of(fitted.state))
    assert_same_bits(saved_state(workdir), fitted.state)


def test_checkpoints_score_as_in_training(whole: tuple[Fitted, Path, list[str]], root: Path) -> None:
    _, workdir, _ = whole
    scores = score_checkpoints(workdir, open_dataset(root, "val"), mini_config())
    assert {8, 9} <= set(scores)
    every = [json.loads(line) for line in (workdir / "metrics.jsonl").read_text().splitlines()]
    (in_training,) = [line for line in every if line["step"] == 9 and "score" in line]
    assert scores[9] == {name: in_training[name] for name in scores[9]}


@pytest.mark.slow
def test_validates_on_synthetic_frames(tmp_path: Path) -> None:
    frames = open_synthetic(seed=3, frames=2, lidar=Lidar(columns=128))
    batches = make_batches(frames, mini_config(), seed=3, batch_size=2)
    fitted = mini_fit(tmp_path, tmp_path, batches=batches, validation=frames, intervals=Intervals(log=STEPS))
    *_, line = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert json.loads(line)["score"] == fitted.best == json.loads(line)["Car_3d_0.70_moderate_R40"]
    written = {path.name for path in (tmp_path / "eval" / str(STEPS) / "data").iterdir()}
    assert written == {"000000.txt", "000001.txt"}


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_a_stopped_run_resumes_to_the_same_bits(
    number: int, whole: tuple[Fitted, Path, list[str]], root: Path, tmp_path: Path
) -> None:
    handlers = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)

    def stop(text: str) -> None:
        if text.startswith("step 3/"):
            signal.raise_signal(number)

    stopped = mini_fit(root, tmp_path, stop)
    assert (int(stopped.state.step), stopped.stopped) == (3, number)
    told = (tmp_path / "train.log").read_text().splitlines()
    assert told[-1].endswith(f"  Stopped by {signal.Signals(number).name} after step 3, which is saved.")
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)) == handlers
    logged: list[str] = []
    resumed = mini_fit(root, tmp_path, logged.append)
    assert logged[0].startswith("Resuming from step 3 in ")
    assert (tmp_path / "train.log").read_text().splitlines()[: len(told)] == told
    assert_same_bits(resumed.state, whole[0].state)
    assert lines(tmp_path) == lines(whole[1])
    # A complete run has nothing left to do.
    assert_same_bits(mini_fit(root, tmp_path).state, whole[0].state)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_compilation_at_once(
    number: int, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def compile_long(self: Any, batch: Any, signals: Any) -> None:
        signal.raise_signal(number)
        raise AssertionError("the signal was deferred")

    monkeypatch.setattr(loop._Run, "_compile", compile_long)
    logged: list[str] = []
    stopped = mini_fit(root, tmp_path, logged.append)
    assert (int(stopped.state.step), stopped.stopped) == (0, number)
    assert logged[-1] == f"Stopped by {signal.Signals(number).name} before the first step: there is nothing to save."
    assert not any((tmp_path / "checkpoints").iterdir())
    assert not (tmp_path / "last.safetensors").exists()


@pytest.mark.slow
def test_a_killed_run_resumes_to_the_same_bits(
    whole: tuple[Fitted, Path, list[str]], root: Path, tmp_path: Path
) -> None:
    program = Path(__file__).parents[1] / "mini_training.py"
    process = subprocess.Popen([sys.executable, str(program), str(root), str(tmp_path)], stderr=subprocess.PIPE)
    checkpoints, deadline = tmp_path / "checkpoints", time.monotonic() + 300
    # Kill it after the first checkpoint, while the next one may be half-written.
    while process.poll() is None and time.monotonic() < deadline:
        if checkpoints.is_dir() and any(path.name.isdigit() for path in checkpoints.iterdir()):
            break
        time.sleep(0.001)
    process.kill()
    _, errors = process.communicate()
    assert process.returncode == -signal.SIGKILL, errors.decode()
    logged: list[str] = []
    resumed = mini_fit(root, tmp_path, logged.append)
    assert logged[0].startswith("Resuming from step "), logged
    assert_same_bits(resumed.state, whole[0].state)
    assert lines(tmp_path) == lines(whole[1])


def test_an_invalid_label_is_named_and_the_state_is_saved(root: Path, tmp_path: Path) -> None:
    dataset, config = open_dataset(root, "train"), mini_config()
    batches = mini_batches(root, config)
    names = []

    def read(name: str) -> Any:
        frame = dataset.read_frame(name)
        names.append(name)
        if len(names) > 10:
            frame.boxes.size[0] = np.nan
        return frame

    object.__setattr__(batches._rows.stream, "dataset", type(dataset)(dataset.names, read, dataset.find_files))
    with pytest.raises(InputError, match=r"Frame 00000\d: object 0 \(Car\) has the size nan"):
        mini_fit(root, tmp_path, batches=batches)
    assert int(saved_state(tmp_path).step) == len(lines(tmp_path)) >= 1
    assert "  InputError: Frame 00000" in (tmp_path / "train.log").read_text().splitlines()[-1]


@pytest.mark.slow
def test_a_dead_worker_loses_no_step(
    whole: tuple[Fitted, Path, list[str]], root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    batches = mini_batches(root, mini_config())
    after = type(batches).__next__

    def die(self: Any) -> Any:
        if self.state.batch == 5:
            raise WorkerError("A worker of the loader died.")
        return after(self)

    with monkeypatch.context() as patch:
        patch.setattr(type(batches), "__next__", die)
        with pytest.raises(WorkerError):
            mini_fit(root, tmp_path, batches=batches)
    assert int(saved_state(tmp_path).step) == 5
    assert_same_bits(mini_fit(root, tmp_path).state, whole[0].state)


@pytest.mark.parametrize("log", [1, 4])
def test_updates_that_stay_non_finite_end_it(
    log: int, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "_MAX_SKIPPED", 4)
    broken = jax.tree.map(lambda leaf: leaf * np.float32(np.nan), random_variables(mini_config()))
    with pytest.raises(TrainingError, match="last 4 updates were not finite"):
        mini_fit(root, tmp_path, variables=broken, intervals=Intervals(log=log))
    assert lines(tmp_path)[-1]["loss"] is None


def test_another_stream_is_refused(whole: tuple[Fitted, Path, list[str]], root: Path) -> None:
    batches = mini_batches(root, mini_config(), seed=4)
    with pytest.raises(InputError, match=r"belongs to another training: .*seed 3 instead of 4"):
        fit(mini_config(), batches, whole[1])
    assert len(lines(whole[1])) == STEPS


def test_later_and_truncated_lines_are_removed(tmp_path: Path) -> None:
    written = "".join(f'{{"step": {step}, "score": {step}.5}}\n' for step in (2, 4, 6))
    (tmp_path / "metrics.jsonl").write_text(f'{written}{{"step": 8, "sco')
    with Record(tmp_path, 4, lambda text: None) as record:
        record.write(6, {"loss": float("inf")})
    assert [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()] == [
        {"step": 2, "score": 2.5},
        {"step": 4, "score": 4.5},
        {"step": 6, "loss": None},
    ]


def test_events_are_written_if_tensorboardx_is_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple] = []

    class Writer:
        def __init__(self, folder: str, purge_step: int) -> None:
            calls.append((folder, purge_step))

        def add_scalar(self, *number: object) -> None:
            calls.append(number)

        def close(self) -> None:
            calls.append(())

    monkeypatch.setitem(sys.modules, "tensorboardX", types.SimpleNamespace(SummaryWriter=Writer))
    with Record(tmp_path, 4, lambda text: None) as record:
        record.write(5, {"loss": 2.0})
    assert calls == [(str(tmp_path / "tb"), 5), ("loss", 2.0, 5), ()]


def test_the_database_is_found_or_built(root: Path, tmp_path: Path) -> None:
    dataset, logged = open_dataset(root, "train"), []
    stale = tmp_path / "stale.bin"
    stale.write_bytes(b"no database")
    built = find_database(dataset, [stale, tmp_path / "built.bin"], log=logged.append)
    assert (built.path, len(logged)) == (tmp_path / "built.bin", 1)
    again = find_database(dataset, [stale, tmp_path / "built.bin"], log=logged.append)
    assert (again.path, len(logged)) == (tmp_path / "built.bin", 1)
    assert stale.read_bytes() == b"no database"


def test_intervals_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        Intervals(save=0)


def test_a_second_signal_gets_the_previous_handler() -> None:
    with deferred_signals() as received:
        signal.raise_signal(signal.SIGINT)
        assert received == [signal.SIGINT]
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_a_signal_may_raise_at_once() -> None:
    with deferred_signals() as received:
        with pytest.raises(KeyboardInterrupt), received.raising():
            signal.raise_signal(signal.SIGTERM)
        assert received == [signal.SIGTERM]
        with pytest.raises(KeyboardInterrupt), received.raising():
            raise AssertionError("the signal came before")


def test_an_ignored_signal_stays_ignored() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with deferred_signals() as received:
        signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    assert received == []
