"""The program `ciassd`: its commands, their help, and the answers to wrong and to old options."""

import subprocess
import sys
from pathlib import Path
from typing import Any, get_args

import pytest

from ciassd_jax.cli import main
from ciassd_jax.cli.config_options import Preset
from ciassd_jax.config.presets import PRESETS


@pytest.mark.parametrize(
    "arguments", [[], ["predict"], ["fly"], ["predict", "a.bin", "--weights", "w", "--preset", "x"]]
)
def test_usage_errors_end_with_code_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert "--help" in capsys.readouterr().err


def test_preset_names_are_those_of_the_config() -> None:
    assert set(get_args(Preset)) == set(PRESETS)


def test_the_module_is_the_program(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "ciassd_jax"]
    helped = subprocess.run([*command, "--help"], capture_output=True, text=True)
    assert (helped.returncode, helped.stderr) == (0, "")
    assert all(name in helped.stdout for name in ("predict", "convert", "info", "demo"))
    arguments = ["predict", tmp_path / "none.bin", "--weights", "w.pth", "--out", tmp_path / "out"]
    failed = subprocess.run([*command, *arguments], capture_output=True, text=True)
    assert failed.returncode == 2
    assert failed.stderr == f"error: {tmp_path / 'none.bin'} does not exist; check the path.\n"


@pytest.mark.parametrize(
    ("arguments", "new"),
    [
        (["train", "--workdir", "w", "--accumulate", "2"], "--gradient-accumulation-steps"),
        (["train", "--accumulate=2", "--workdir", "w"], "--gradient-accumulation-steps"),
        (["train", "--rematerialize", "True"], "--remat"),
        (["view", "KITTI", "--most", "3"], "--frames"),
        (["view", "KITTI", "--frames", "000010", "000012"], "--names"),
    ],
)
def test_an_old_option_is_answered_with_its_new_name(run: Any, arguments: list[str], new: str) -> None:
    result = run(*arguments)
    assert (result.code, result.out) == (2, "")
    assert new in result.err
    assert result.err.startswith("error: ")
    assert result.err.count("\n") == 1


def test_an_unknown_option_is_answered_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["train", "--workdir", "w", "--learn-rate", "2"])
    assert ended.value.code == 2
    assert "--learning-rate" in capsys.readouterr().err


COMMANDS = "demo, predict, view, data check, data prepare, data synth, train, eval, eval txt, submit, convert, info"


@pytest.mark.parametrize("command", ["", *COMMANDS.split(", ")])
def test_help_shows_no_default_of_none(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*command.split(), "--help"])
    assert ended.value.code == 0
    assert "None" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--frames", 3), "--data simulated"),
        (("--data", "simulated", "--frames", 3), "at least 4"),
        (("--data", "simulated", "--frames", 0), "at least 1"),
        (("--data", "simulated", "--seed", -1), "--seed is -1"),
        (("--data", "simulated", "--split", "mine"), "'mine'; choose train, val"),
    ],
)
def test_simulated_frames_that_do_not_exist_are_one_sentence(
    run: Any, weights: Path, options: tuple[object, ...], words: str
) -> None:
    result = run("eval", "--weights", weights, *options)
    assert (result.code, result.out) == (2, "")
    assert words in result.err
    assert result.err.count("\n") == 1
