"""Any config from the command line: --preset, --config FILE, weights, and --config.SECTION.FIELD."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from small import small_config

from ciassd_jax import Config, car_lite, three_class, tiny
from ciassd_jax.cli.messages import describe

PEOPLE = three_class()


def _count_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("compiled_memory", "count_flops", "count_parameters"):
        monkeypatch.setattr(f"ciassd_jax.inference.cost.{name}", lambda *arguments: {})


@pytest.fixture
def shown(run: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The config that `ciassd info` with these arguments shows."""
    _count_nothing(monkeypatch)

    def call(*arguments: object) -> Config:
        result = run("info", *arguments, "--json")
        assert result.code == 0, result.err
        return Config.from_json(json.dumps(json.loads(result.out)["config"]))

    return call


def test_the_default_is_a_preset_a_file_or_that_of_weights(shown: Any, weights: Path, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(PEOPLE.to_json())
    assert shown() == Config()
    assert shown("--preset", "tiny") == tiny()
    assert shown("--config", tmp_path / "config.json") == PEOPLE
    assert shown("--config", weights) == small_config()
    assert shown("--weights", weights) == small_config()


def test_a_field_is_replaced_in_any_of_them(shown: Any, weights: Path, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(PEOPLE.to_json())
    config = shown("--preset", "tiny", "--config.grid.max-voxels", 3000, "--config.grid.minimum", 0, -6.4, -3.4)
    grid = replace(tiny().grid, max_voxels=3000, minimum=(0.0, -6.4, -3.4))
    assert config == replace(tiny(), grid=grid)
    bus = replace(PEOPLE.classes[2], name="Bus", similar=("Truck", "Tram"))
    config = shown(
        "--config.classes.2.name=Bus",
        "--config.classes.2.similar",
        "Truck",
        "Tram",
        "--config",
        tmp_path / "config.json",
    )
    assert config == replace(PEOPLE, classes=(*PEOPLE.classes[:2], bus))
    assert shown("--weights", weights, "--config.schedule.total-steps", 7).schedule.total_steps == 7
    assert not shown("--config.detection.no-clamp-iou").detection.clamp_iou


def test_an_option_of_the_command_wins_over_the_config(shown: Any) -> None:
    config = shown("--preset", "tiny", "--intensity-scale", 255, "--z-shift", "-0.4")
    assert (config.input.intensity_scale, config.input.z_shift) == (255, -0.4)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (
            ("--config.grid.bogus", "3"),
            "--config.grid.bogus is no field of this config; see the list of --help-config.",
        ),
        (("--config.classes.1.name", "Bus"), "--config.classes.1.name is no field of this config"),
        (("--z-shift", "1", "--config.input.z-shift", "1"), "--config.input.z-shift sets a field that another option"),
        (("--config.dtype", "bfloat16", "--config.dtype", "float32"), "--config.dtype is given twice; give it once."),
        (("--config.grid.max_voxels", "5", "--config.grid.max-voxels=6"), "--config.grid.max-voxels is given twice"),
        (("--config.head.predict-iou", "--config.head.no-predict-iou"), "--config.head.predict-iou is given twice"),
        (("--preset", "tiny", "--preset", "car"), "--preset is given twice; give it once."),
        (("--config.grid.maximum.0", "70.4"), "give all values of --config.grid.maximum, or see"),
        (("--preset", "tiny", "--config", "x.json"), "--preset and --config both choose a config; give one of them."),
        (("--config", "nowhere.json"), "nowhere.json does not exist; check the path."),
        (("--intensity-scale", "0"), "input.intensity_scale (--config.input.intensity-scale): 0.0 must be positive"),
    ],
)
def test_what_cannot_be_used_is_one_sentence(run: Any, arguments: tuple[str, ...], sentence: str) -> None:
    result = run("info", *arguments)
    assert result.code == 2
    assert result.out == ""
    assert sentence in result.err
    assert result.err.count("\n") == 1


@pytest.mark.slow
def test_a_path_after_names_is_told_and_the_remedy_works(run: Any, shown: Any, tmp_path: Path) -> None:
    names = ("--config.classes.0.similar", "Van", "Truck")
    result = run("data", "check", *names, tmp_path)
    assert result.code == 2
    assert result.err == f"error: {tmp_path} was taken for a similar class; give the path before the options.\n"
    assert f"{tmp_path} has no folder" in run("data", "check", tmp_path, *names).err


@pytest.mark.parametrize("text", ["{", "[]", '{"grid": {"bogus": 1}}'])
def test_a_file_that_is_no_config_is_one_sentence(run: Any, tmp_path: Path, text: str) -> None:
    (tmp_path / "config.json").write_text(text)
    result = run("info", "--config", tmp_path / "config.json")
    assert (result.code, result.err.count("\n")) == (2, 1)
    assert f"{tmp_path / 'config.json'} is not a config: " in result.err


def test_a_command_without_a_config_says_so(run: Any, tmp_path: Path) -> None:
    result = run("data", "synth", tmp_path / "out", "--config.grid.max-voxels", 3)
    assert result.code == 2
    assert result.err == "error: This command has no config; leave out --config.grid.max-voxels.\n"


def test_the_help_lists_the_fields_only_if_asked(run: Any, capsys: pytest.CaptureFixture[str]) -> None:
    for option, listed in (("--help", False), ("--help-config", True)):
        with pytest.raises(SystemExit) as left:
            run("info", "--preset", "car_lite", option)
        assert left.value.code == 0
        text = capsys.readouterr().out
        assert ("--config.grid.max-voxels" in text) == listed
        assert (str(car_lite().grid.max_voxels) in text) == listed


def test_info_explains_the_grid(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    _count_nothing(monkeypatch)
    lines = json.loads(run("info", "--json").out)["grid"]
    assert lines[0] == "x: 0 to 70.4 m, 1408 voxels of 0.05 m; next valid maximum 69.6 or 71.2."
    assert lines[3] == "Layers along z: 41 -> 21 -> 11 -> 5 -> 2, with 64 channels each in the BEV map."
    assert (
        lines[4]
        == "BEV map: 176 x 200 cells of 0.4 m (stride 8, so x and y are multiples of 16 voxels), 70400 anchors."
    )
    config = Config()
    for maximum in (69.6, 71.2):
        replace(config, grid=replace(config.grid, maximum=(maximum, 40.0, 1.0)))


def test_an_invalid_grid_names_the_option_and_a_value_that_works(
    run: Any, shown: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as left:
        run("info", "--config.grid.maximum", 70, 40, 1)
    assert left.value.code == 2
    assert "grid.maximum along x" in capsys.readouterr().err
    assert shown("--config.grid.maximum", 69.6, 40, 1).grid.maximum == (69.6, 40.0, 1.0)


@pytest.mark.parametrize(
    ("message", "shown"),
    [
        ("raise grid.max_voxels.", "raise grid.max_voxels (--config.grid.max-voxels)."),
        ("classes[1].name: bad", "classes[1].name (--config.classes.1.name): bad"),
        ("backbone.stages[2].capacity is", "backbone.stages[2].capacity (--config.backbone.stages.2.capacity) is"),
        ("data.augmentation.flip_probability:", "data.augmentation.flip_probability "),
        ("data.bin is empty; data/grid.minimum too.", "data.bin is empty; data/grid.minimum too."),
        ("pass 5 as `columns`, or 255 as `intensity_scale`", "pass 5 with --columns, or 255 with --intensity-scale"),
    ],
)
def test_messages_name_the_options(message: str, shown: str) -> None:
    assert describe(message).startswith(shown)


def test_help_says_of_each_field_what_is_said_of_it_alone(run: Any, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run("train", "--help-config")
    text = capsys.readouterr().out
    for words, fields in (
        ("The rectified score", 1),
        ("Without the IoU branch", 1),
        ("60 epochs", 2),
        ("Keep objects", 2),
    ):
        assert text.count(words) == fields
