"""The program `ciassd`: its commands, their help, and the answers to wrong and to old options."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest

from ciassd_jax.cli import Command, main
from ciassd_jax.cli.config_options import Preset
from ciassd_jax.cli.messages import tell
from ciassd_jax.cli.names import _ANSWERS, options_of, subcommands
from ciassd_jax.config.presets import PRESETS


@pytest.mark.parametrize("arguments", [[], ["predict"], ["predict", "a.bin", "--weights", "w", "--preset", "x"]])
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


def answer(run: Any, *arguments: str) -> str:
    """The one sentence that answers arguments that cannot be used."""
    result = run(*arguments)
    assert (result.code, result.out) == (2, "")
    assert result.err.startswith("error: ")
    assert result.err.count("\n") == 1
    return result.err.removeprefix("error: ").removesuffix("\n")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ("trian", "trian is no command; did you mean train?"),
        ("data chek yard", "chek is no command; did you mean check?"),
        ("fly", "fly is no command; `ciassd --help` lists what there is."),
        ("--lr 1 train", "--lr is no option of ciassd; `ciassd --help` lists what there is."),
        ("train --learn-rate 2", "--learn-rate is no option of train; did you mean --learning-rate?"),
        ("train --workdir w --wokers=2", "--wokers is no option of train; did you mean --workers?"),
        ("eval txt a b --jsn c", "--jsn is no option of eval txt; did you mean --json?"),
        ("train --lr 1", "--lr is no option of train; did you mean --learning-rate?"),
        ("predict a --lr 1", "--lr is no option of predict; `ciassd predict --help` lists what there is."),
        (
            "train --cfg_file a",
            "--cfg_file is no option of train; choose a config with --preset NAME or --config FILE.",
        ),
        ("train --ckpt a", "--ckpt is no option of train; start from weights with --init-from FILE."),
        ("eval --ckpt a", "--ckpt is no option of eval; did you mean --weights?"),
        ("predict a --work_dir b", "--work_dir is no option of predict; did you mean --out?"),
        ("train --accumulate=2", "--accumulate is no option of train; did you mean --gradient-accumulation-steps?"),
        ("train --rematerialize True", "--rematerialize is no option of train; did you mean --remat?"),
        ("view KITTI --most 3", "--most is no option of view; did you mean --frames?"),
        ("view KITTI --frames 000010 000012", "--frames is a number of frames; name frames with --names."),
    ],
)
def test_a_name_that_does_not_exist_is_answered(run: Any, arguments: str, sentence: str) -> None:
    assert answer(run, *arguments.split()) == sentence


def test_fields_of_other_programs_are_told_the_option_of_a_field(run: Any) -> None:
    assert "--config.SECTION.FIELD VALUE" in answer(run, "train", "--train.batch-size", "2")


def leaves(commands: dict[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    for name, kind in commands.items():
        yield (*path, name), kind
        yield from leaves(subcommands(kind), (*path, name))


EVERY = dict(leaves(subcommands(Command)))


@pytest.mark.parametrize("command", EVERY, ids=" ".join)
def test_the_names_are_those_of_the_help(
    command: tuple[str, ...], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        main([*command, "--help"])
    lines = re.findall(r"^\W (-.*?)(?:  |$)", capsys.readouterr().out, re.MULTILINE)
    assert set(re.findall(r"--[a-z][\w-]*", " ".join(lines))) == options_of(EVERY[command]) | {"--help"}


def test_every_answer_names_options_of_a_command() -> None:
    commands = [options_of(kind) | {"--help-config"} for kind in EVERY.values()]
    for answers in _ANSWERS.values():
        for text in answers:
            assert any(set(re.findall(r"--[a-z-]+", text)) <= options for options in commands)
    assert not _ANSWERS.keys() & options_of(EVERY["train",])


def test_the_version_is_one_line(run: Any) -> None:
    result = run("--version")
    assert (result.code, result.err) == (0, "")
    assert re.fullmatch(r"ciassd_jax \S+, JAX \S+, Python \S+\n", result.out)


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


def test_work_goes_on_when_nobody_reads_its_lines() -> None:
    """`ciassd train | tee log`: Ctrl-C ends `tee` first, and the state must still be saved."""
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w", encoding="utf-8") as stream:
        tell("This line breaks the pipe.", stream)
        tell("This one goes nowhere.", stream)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="the system has no /dev/full")
def test_output_to_a_full_disk_is_one_sentence(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with open("/dev/full", "w", encoding="utf-8") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert main(["--version"]) == 2
    assert capsys.readouterr().err == ("error: A disk that is written to is full; free some space and run again.\n")


def test_without_a_device_commands_say_so(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: object, **options: object) -> None:
        raise AssertionError

    monkeypatch.setattr("ciassd_jax.cli.info.Info.run", fail)
    with pytest.raises(AssertionError):
        run("info")
    monkeypatch.setattr("jax.devices", fail)
    assert answer(run, "info") == "JAX finds no device; set JAX_PLATFORMS=cpu, or see `ciassd doctor`."


def test_a_folder_in_place_of_a_file_is_refused_before_the_work(run: Any, weights: Path, tmp_path: Path) -> None:
    for out in ("", tmp_path):
        sentence = f"{Path(out)} is a folder; name a file in it."
        assert answer(run, "bench", "--weights", weights, "--json", out) == sentence
        assert answer(run, "export", "--weights", weights, out) == sentence
