"""`ciassd train`, called in this process: it trains, resumes, and answers what it cannot use with one sentence."""

import json
import logging
import os
import re
import shlex
import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from cli_files import Run
from mini_folders import write_split
from mini_training import STEPS, mini_config, share_training_programs, write_data
from small import random_variables

from ciassd_jax import create_train_state, load_weights, make_batches, open_dataset, save_weights
from ciassd_jax.cli import main
from ciassd_jax.cli.eval import Evaluate
from ciassd_jax.cli.options import Frames
from ciassd_jax.config.presets import PRESETS
from ciassd_jax.data.gt_sampling import database_path, find_database
from ciassd_jax.training.checkpoint import Checkpoints
from ciassd_jax.training.loop import Fitted


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data(tmp_path_factory.mktemp("data"))


@pytest.fixture
def run(root: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Run]:
    """Train the small network in place of `tiny`, in the program of `mini_fit` unless said otherwise, unscored."""

    def call(*arguments: object, **options: object) -> Run:
        chosen = {"preset": "tiny", "data": root, "batch-size": 2, "steps": STEPS, "evaluate-every": 0} | options
        given = [text for name, value in chosen.items() if value is not None for text in (f"--{name}", str(value))]
        code = main(["train", *given, *map(str, arguments)])
        return Run(code, *capsys.readouterr())

    share_training_programs(monkeypatch)
    monkeypatch.setitem(PRESETS, "tiny", mini_config)
    return call


def steps_of(workdir: Path) -> list[int]:
    return [json.loads(line)["step"] for line in (workdir / "metrics.jsonl").read_text().splitlines()]


@pytest.mark.slow
def test_trains_and_resumes(run: Callable[..., Run], root: Path, tmp_path: Path) -> None:
    first = run(workdir=tmp_path, **{"log-every": 2})
    assert first.code == 0, first.err
    assert f"from 3 frames into {tmp_path}" in first.out
    assert not database_path(root, "train").exists()
    assert f"Trained 9 steps. Weights, metrics and evaluations are in {tmp_path}." in first.out
    assert first.out.endswith(f"Next: `ciassd plot {tmp_path}`\n")
    assert steps_of(tmp_path) == [2, 4, 6, 8, 9]
    saved = load_weights(tmp_path / "last.safetensors").variables
    again = run(workdir=tmp_path, **{"log-every": 2})
    assert again.code == 0
    assert "step 9 in " in again.out
    assert "from 3 frames" not in again.out
    jax.tree.map(np.testing.assert_array_equal, load_weights(tmp_path / "last.safetensors").variables, saved)


@pytest.fixture
def begun(root: Path, tmp_path: Path) -> Path:
    """The folder of a training with one checkpoint."""
    config, dataset = mini_config(), open_dataset(root, "train")
    database = find_database(dataset, [database_path(tmp_path, "train")], log=lambda text: None)
    state = create_train_state(jax.random.key(0), config, variables=random_variables(config))
    with (
        make_batches(dataset, config, seed=0, batch_size=2, database=database) as batches,
        Checkpoints(tmp_path / "checkpoints", config) as checkpoints,
    ):
        checkpoints.save(state, batches.state)
    return tmp_path


def test_another_config_or_seed_is_one_sentence(run: Callable[..., Run], begun: Path) -> None:
    before = {path: path.read_bytes() for path in begun.rglob("*") if path.is_file()}
    for options, words in (
        ({"weight-decay": 0.5}, "config.schedule.weight_decay is 0.01 there and 0.5 here"),
        ({"seed": 7}, "seed 0 instead of 7"),
    ):
        refused = run(workdir=begun, **options)
        assert refused.code == 2
        assert words in refused.err
        assert refused.err.startswith("error: ")
        assert refused.err.count("\n") == 1
    assert {path: path.read_bytes() for path in begun.rglob("*") if path.is_file()} == before


def test_damaged_checkpoints_are_one_sentence(run: Callable[..., Run], begun: Path) -> None:
    for path in (begun / "checkpoints").rglob("d/*"):
        path.write_bytes(b"")
    levels = [logging.getLogger(name).level for name in ("absl", "asyncio")]
    refused = run(workdir=begun)
    assert refused.code == 2
    assert re.fullmatch(rf"error: .*{begun}/checkpoints .*\n", refused.err)
    assert [logging.getLogger(name).level for name in ("absl", "asyncio")] == levels


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """What `fit` is called with; it trains nothing."""
    calls: list[tuple[Any, ...]] = []

    def stand_in(config: Any, batches: Any, workdir: Path, **options: Any) -> Fitted:
        calls.append((config, batches._rows.stream, options))
        variables = random_variables(config)
        return Fitted(create_train_state(jax.random.key(0), config, variables=variables), None, None)

    monkeypatch.setattr("ciassd_jax.cli.train.fit", stand_in)
    return calls


def test_says_what_to_run_next(
    run: Callable[..., Run],
    fits: list[tuple[Any, ...]],
    streets: list[tuple[int, int]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    workdir = tmp_path / "my run"
    done = run(workdir=workdir, data="simulated", frames=8, seed=5, validate="all", **{"evaluate-every": 1})
    *_, line = done.out.splitlines()
    evaluation, plot = re.fullmatch("Next: `(.*)`, `(.*)`", line).groups()  # type: ignore[union-attr]
    assert plot == f"ciassd plot '{workdir}'"
    parsed: list[Evaluate] = []
    monkeypatch.setattr(Evaluate, "run", lambda command: parsed.append(command) or 0)
    assert main(shlex.split(evaluation)[1:]) == 0
    assert parsed == [Evaluate(Frames("simulated", frames=8), workdir=workdir, split="all", seed=5)]


@pytest.mark.parametrize("step", [0, 7])
def test_a_stopped_training_says_how_to_go_on(
    step: int, run: Callable[..., Run], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = create_train_state(jax.random.key(0), mini_config(), variables=random_variables(mini_config()))
    stopped = Fitted(state._replace(step=np.int32(step)), None, signal.SIGTERM)
    monkeypatch.setattr("ciassd_jax.cli.train.fit", lambda *arguments, **options: stopped)
    done = run(workdir=tmp_path)
    assert done.code == 143
    curves = f"; `ciassd plot {tmp_path}` draws the curves so far" if step else ""
    assert done.out.endswith(f"Run the same command again to resume{curves}.\n")


def test_starts_from_weights(run: Callable[..., Run], fits: list[tuple[Any, ...]], tmp_path: Path) -> None:
    start = tmp_path / "start.safetensors"
    save_weights(start, random_variables(mini_config(), seed=5), mini_config())
    assert run(workdir=tmp_path / "w", **{"init-from": start}).code == 0
    ((_, _, options),) = fits
    jax.tree.map(np.testing.assert_array_equal, options["variables"], random_variables(mini_config(), seed=5))


def test_without_a_config_that_of_the_weights_is_used(
    run: Callable[..., Run], fits: list[tuple[Any, ...]], tmp_path: Path
) -> None:
    own = replace(mini_config(), schedule=replace(mini_config().schedule, learning_rate=0.25, frozen=("backbone",)))
    save_weights(tmp_path / "w.safetensors", random_variables(own), own)
    options = {"init-from": tmp_path / "w.safetensors", "preset": None, "steps": None}
    assert run("--config.schedule.warmup", "0.5", workdir=tmp_path / "run", **options).code == 0
    assert run("--freeze", workdir=tmp_path / "thawed", **options).code == 0
    (config, _, _), (thawed, _, _) = fits
    assert config == replace(own, schedule=replace(own.schedule, warmup=0.5))
    assert thawed == replace(own, schedule=replace(own.schedule, frozen=()))


@pytest.fixture
def other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Weights of a network that has another head, and a tensor more; what they lack is not drawn by a program."""
    monkeypatch.setattr("ciassd_jax.inference.weights.init_variables", lambda key, config: random_variables(config))
    given = mini_config()
    config = replace(given, classes=(given.classes[0], replace(given.classes[0], name="Van")))
    variables = random_variables(config, seed=5)
    variables = variables | {"params": variables["params"] | {"extra": {"scale": np.zeros(3, np.float32)}}}
    save_weights(tmp_path / "other.safetensors", variables, config)
    return tmp_path / "other.safetensors"


def test_weights_that_do_not_fit_are_refused_and_the_remedy_works(
    run: Callable[..., Run], fits: list[tuple[Any, ...]], other: Path, tmp_path: Path
) -> None:
    refused = run(workdir=tmp_path / "w", **{"init-from": other})
    assert refused.code == 2
    assert refused.err.count("\n") == 1
    assert "does not fit the config in 9 of 99 tensors: " in refused.err
    assert "`ciassd train --init-from FILE --partial` to take what fits" in refused.err
    assert not (tmp_path / "w").exists()
    done = run("--partial", workdir=tmp_path / "w", **{"init-from": other})
    assert done.code == 0, done.err
    lines = [re.sub(" +", " ", line).strip() for line in done.out.splitlines()]
    assert "backbone 20 of 20 tensors" in lines
    assert "head 0 of 8 tensors" in lines
    assert "params/head/box/bias fresh: other shape file (28,) config (14,)" in lines
    assert "params/extra/scale left: not in the config file (3,) config absent" in lines
    ((config, _, options),) = fits
    assert config.class_names == ("Car",)
    given = random_variables(config, seed=5)["params"]["backbone"]
    jax.tree.map(np.testing.assert_array_equal, options["variables"]["params"]["backbone"], given)


def test_partial_needs_weights(run: Callable[..., Run], tmp_path: Path) -> None:
    refused = run("--partial", workdir=tmp_path / "w")
    assert refused.code == 2
    assert refused.err == "error: --partial takes what fits of the weights of --init-from; give both.\n"


def test_a_resumed_training_takes_no_weights(
    run: Callable[..., Run], fits: list[tuple[Any, ...]], other: Path, begun: Path
) -> None:
    done = run("--partial", "--freeze", "head", workdir=begun, **{"init-from": other})
    assert (done.code, done.err) == (0, "")
    assert "fresh" not in done.out


@pytest.mark.parametrize(
    ("options", "warned"),
    [
        (("--freeze", "backbone", "head/box"), "backbone, head/box"),
        (("--freeze", "backbone", "head/box", "--partial"), "head/box"),
        (("--freeze", "backbone", "--partial"), ""),
    ],
)
def test_frozen_parts_go_to_the_config_and_random_ones_are_told(
    run: Callable[..., Run],
    fits: list[tuple[Any, ...]],
    other: Path,
    tmp_path: Path,
    options: tuple[str, ...],
    warned: str,
) -> None:
    start = {"init-from": other} if "--partial" in options else {}
    done = run(*options, workdir=tmp_path / "w", **start)
    assert done.code == 0, done.err
    ((config, _, _),) = fits
    assert config.schedule.frozen == tuple(one for one in options if not one.startswith("--"))
    expected = f"warning: {warned}: frozen with random parameters, as no weights were loaded for all of it.\n"
    assert done.err == (expected if warned else "")


def test_an_unknown_part_is_refused_with_the_names_of_the_parts(
    run: Callable[..., Run], fits: list[tuple[Any, ...]], tmp_path: Path
) -> None:
    refused = run("--freeze", "bakbone", workdir=tmp_path / "w")
    assert refused.code == 2
    assert re.fullmatch(r"error: schedule\.frozen .*'bakbone'; its parts are backbone, .*neck/.*\n", refused.err)
    assert not fits


def test_overfit_one_takes_that_frame_alone_and_reports(
    run: Callable[..., Run], fits: list[tuple[Any, ...]], tmp_path: Path
) -> None:
    done = run("--overfit-one", "000001", workdir=tmp_path, steps=None, **{"batch-size": None})
    assert done.code == 1, done.err
    assert "Frame 000001: 0 of 2 objects are found at the strict overlap of their class." in done.out
    ((config, stream, options),) = fits
    assert (stream.dataset.names, stream.augmented, stream.database) == (("000001",), False, None)
    # Found or not says more of one frame than its average precision.
    assert options["validation"] is None
    assert (config.schedule.total_steps, config.schedule.batch_size, config.schedule.learning_rate) == (800, 1, 1e-3)


@pytest.mark.parametrize(
    ("label", "sentence"), [("Tram", "is of a class that is learned"), ("Car", "has no target to")]
)
def test_overfit_one_on_a_frame_without_targets_fails_before_it_compiles(
    run: Callable[..., Run], fits: list[tuple[Any, ...]], root: Path, tmp_path: Path, label: str, sentence: str
) -> None:
    data = shutil.copytree(root, tmp_path / "data")
    # In KITTI's layout, far behind the sensor.
    row = f"{label} 0 0 0 1 1 9 60 1.5 1.6 3.9 0 1 -500 0\n"
    (data / "training/label_2/000001.txt").write_text(row)
    done = run("--overfit-one", "000001", workdir=tmp_path / "w", data=data)
    assert done.code == 2
    assert sentence in done.err
    assert not fits


def test_options_go_to_the_config(run: Callable[..., Run], fits: list[tuple[Any, ...]], tmp_path: Path) -> None:
    options = {"epochs": 6, "steps": None, "kind": "cosine", "dtype": "bfloat16", "seed": 4}
    assert run(workdir=tmp_path, **options).code == 0
    ((config, stream, _),) = fits
    assert (config.schedule.total_steps, config.schedule.kind, config.dtype) == (9, "cosine", "bfloat16")
    assert (stream.seed, stream.augmented) == (4, True)


def test_simulated_frames_need_no_folder(
    run: Callable[..., Run], fits: list[tuple[Any, ...]], streets: list[tuple[int, int]], tmp_path: Path
) -> None:
    done = run(workdir=tmp_path, data="simulated", frames=8, seed=5, **{"evaluate-every": 1})
    assert done.code == 0, done.err
    ((_, stream, options),) = fits
    assert (stream.dataset.names, options["validation"].names) == (
        ("000000", "000001", "000002", "000004", "000005", "000006"),
        ("000003", "000007"),
    )
    assert (stream.seed, set(streets)) == (5, {(5, 8)})
    assert database_path(tmp_path, "train").is_file()


@pytest.mark.parametrize("word", ["none", "None"])
def test_no_validation(word: str, run: Callable[..., Run], fits: list[tuple[Any, ...]], tmp_path: Path) -> None:
    assert run(workdir=tmp_path, validate=word, **{"evaluate-every": 1}).code == 0
    ((_, _, options),) = fits
    assert options["validation"] is None


def test_fields_of_the_schedule_are_replaced(
    run: Callable[..., Run], fits: list[tuple[Any, ...]], tmp_path: Path
) -> None:
    assert run("--remat", workdir=tmp_path, **{"gradient-accumulation-steps": 3, "ema-decay": 0.5}).code == 0
    ((config, _, _),) = fits
    schedule = mini_config().schedule
    assert config.schedule == replace(schedule, remat=True, gradient_accumulation_steps=3, ema_decay=0.5)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"steps": 0}, "total_steps"),
        ({"steps": 3, "epochs": 2}, "either --steps or --epochs"),
        ({"workers": -1}, "workers"),
        ({"seed": -1}, "seed"),
        ({"log-every": 0}, "--log-every is 0; give at least 1."),
        ({"learning-rate": 0}, "learning_rate must be positive"),
        ({"overfit-one": "000777"}, "Frame 000777 is not among the 3 of train"),
        ({"split": "none"}, "none"),
        ({"data": "nowhere"}, "nowhere"),
        ({"init-from": "nowhere.safetensors"}, "nowhere.safetensors"),
        ({"num-processes": 2}, "give all three"),
    ],
)
def test_what_cannot_be_used_is_one_sentence(
    options: dict[str, object], words: str, run: Callable[..., Run], tmp_path: Path
) -> None:
    refused = run(workdir=tmp_path / "new", **options)
    assert refused.code == 2
    assert words in refused.err
    assert refused.err.rstrip().splitlines()[-1].startswith("error: ")
    assert "Traceback" not in refused.err
    assert not (tmp_path / "new" / "checkpoints").exists()


def test_a_workdir_that_cannot_be_is_one_sentence(run: Callable[..., Run], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("kept")
    refused = run(workdir=tmp_path / "file" / "w")
    assert (refused.code, refused.out) == (2, "")
    assert refused.err == (
        f"error: {tmp_path}/file/w cannot be a folder, as {tmp_path}/file is a file; choose another place.\n"
    )
    assert (tmp_path / "file").read_text() == "kept"


def test_a_read_only_workdir_is_one_sentence(
    run: Callable[..., Run], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The superuser may write everywhere.
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)
    refused = run(workdir=tmp_path)
    assert (refused.code, refused.out) == (2, "")
    assert refused.err == f"error: {tmp_path} cannot be written, as {tmp_path} is read-only; choose another place.\n"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        (9, "nan", "000004.txt, line 1: a value is not finite"),
        (8, "-1.5", "Frame 000004: object 0 (Car) has the size"),
    ],
)
def test_a_label_that_is_none_names_its_frame(
    column: int, value: str, words: str, run: Callable[..., Run], tmp_path: Path
) -> None:
    data = write_data(tmp_path / "data")
    label = data / "training" / "label_2" / "000004.txt"
    fields = label.read_text().split(" ")
    fields[column] = value
    label.write_text(" ".join(fields))
    # Alone, so that no other frame is augmented before it, and from weights: both need no compilation.
    write_split(data, "one", "000004")
    save_weights(tmp_path / "start.safetensors", random_variables(mini_config()), mini_config())
    refused = run(workdir=tmp_path / "w", data=data, split="one", **{"init-from": tmp_path / "start.safetensors"})
    assert refused.code == 2
    assert words in refused.err
    assert refused.complaints.startswith("error: ")
    assert refused.complaints.count("\n") == 1
