"""`ciassd plot`, called in this process."""

from collections.abc import Callable
from pathlib import Path

import pytest
from cli_files import Run

LINES = '{"step": 10, "loss": 2.0}\n{"step": 20, "loss": null}\n'


@pytest.fixture
def trained(tmp_path: Path) -> Path:
    (tmp_path / "run").mkdir()
    # A kill has cut the last line.
    (tmp_path / "run/metrics.jsonl").write_text(f'{LINES}{{"step": 30, "lo')
    return tmp_path / "run"


def is_png(path: Path) -> bool:
    return path.read_bytes().startswith(b"\x89PNG")


def test_the_picture_is_written_beside_the_metrics(run: Callable[..., Run], trained: Path) -> None:
    assert run("plot", trained) == (0, f"Wrote {trained}/curves.png: {trained} up to step 20.\n", "")
    assert is_png(trained / "curves.png")


def test_several_runs_are_one_picture(run: Callable[..., Run], trained: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    (other / "metrics.jsonl").write_text(LINES)
    done = run("plot", trained, other, "--out", tmp_path / "new/both.png")
    assert done.out == f"Wrote {tmp_path}/new/both.png: {trained} up to step 20, {other} up to step 20.\n"
    assert is_png(tmp_path / "new/both.png")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "Nothing to draw"),
        (("{}",), "has no metrics.jsonl; give the folder of a training"),
        (("{}/empty",), "has no complete line yet"),
        (("{}/run", "--out", "curves.pdf"), "must end in .png"),
    ],
)
def test_bad_input_is_one_sentence(
    arguments: tuple[str, ...], words: str, run: Callable[..., Run], trained: Path, tmp_path: Path
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty/metrics.jsonl").write_text("")
    done = run("plot", *(argument.format(tmp_path) for argument in arguments))
    assert (done.code, done.out) == (2, "")
    assert done.err.startswith("error: ")
    assert done.err.count("\n") == 1
    assert words in done.err


def test_without_matplotlib_the_extra_is_named(
    run: Callable[..., Run], trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ciassd_jax.view.viz_extra.find_spec", lambda name: None)
    done = run("plot", trained)
    assert (done.code, done.err) == (
        2,
        "error: Pictures need matplotlib; run `pip install 'ciassd_jax[viz]'`.\n",
    )
    assert not (trained / "curves.png").exists()
