"""`ciassd data check`, `data prepare`, `data synth`: exit codes, and what they print and write."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mini_folders import NAMES, OBJECTS, object_points, write_custom, write_kitti, write_split

from ciassd_jax import Config, three_class
from ciassd_jax.data.folders import open_dataset
from ciassd_jax.data.gt_sampling import open_database
from ciassd_jax.evaluation.dataset_check import check_dataset
from ciassd_jax.formats.kitti_rows import read_rows, write_rows
from ciassd_jax.formats.points import write_bin
from ciassd_jax.simulation import Lidar, open_synthetic


def test_sound_data_pass_the_check(run: Any, tmp_path: Path) -> None:
    result = run("data", "check", write_kitti(tmp_path), "--preset", "tiny")
    assert result.code == 0
    lines = result.out.splitlines()
    assert lines[0].split() == ["3", "frames", "least", "median", "most"]
    assert lines[-1] == "Verdict: ready to train: 6 Car objects in range in 3 frames."
    assert lines[-2] == "By KITTI's rule fewer than 41 objects cannot score 100, however well they are found."
    assert ["Car", "3", "0", "(0%)", "0", "3.90", "1.60", "1.50", "-1.00"] in [line.split() for line in lines]
    # Three cars give three points of 41, the first of which R40 leaves out.
    assert ["Car", "3d", "5.00", "5.00", "5.00", "3,", "3,", "3"] in [line.split() for line in lines]


def test_what_must_be_mended_is_exit_code_1(run: Any, tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    write_split(root, "train", "000000", "000009")
    path = root / "training/label_2/000001.txt"
    path.write_text(path.read_text() + "Car\n")
    result = run("data", "check", root, "--preset", "tiny")
    assert result.code == 1
    first, second, *_, last = result.out.splitlines()
    assert first.startswith(f"error: {root}/ImageSets/train.txt: 1 of 2 frames have no cloud")
    assert second.startswith(f"error: {path}, line 5: 1 columns; a label has 15")
    assert last == f"Verdict: not ready: 2 errors; first: {first.removeprefix('error: ')}"


def test_what_is_odd_is_listed_up_to_most(run: Any, tmp_path: Path) -> None:
    root = write_kitti(tmp_path, clouds="velodyne_reduced")
    for name in NAMES:
        write_bin(root / f"training/velodyne_reduced/{name}.bin", object_points(0)[:120])
    result = run("data", "check", root, "--most", 2, "--preset", "tiny")
    assert result.code == 0
    lines = result.out.splitlines()
    assert [line.split(":")[0] for line in lines[:3]] == ["odd"] * 3
    assert lines[2] == "odd: ... and 1 more of this kind (no point); --most lists more."
    assert lines[-1] == "Verdict: ready to train: 6 Car objects in range in 3 frames; findings worth a look: 3."


def test_custom_data_are_checked_without_a_camera(run: Any, tmp_path: Path) -> None:
    result = run("data", "check", write_custom(tmp_path), "--preset", "tiny")
    assert result.code == 0
    rows = [line.split()[:2] for line in result.out.splitlines()]
    assert ["Car", "3d"] in rows
    assert ["Car", "bbox"] not in rows


def test_test_frames_have_no_scores(run: Any, tmp_path: Path) -> None:
    root = write_kitti(tmp_path, part="testing")
    write_split(root, "test", *NAMES)
    result = run("data", "check", root, "--split", "test", "--preset", "tiny")
    assert result.code == 0
    assert "Labels as detections" not in result.out
    assert result.out.splitlines()[-1] == "Verdict: ready to predict: 3 frames, without labels."


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("data", "check", "nowhere"), "error: nowhere has no folder training or testing (KITTI) or points"),
        (("data", "prepare", "nowhere"), "error: nowhere has no folder training or testing (KITTI) or points"),
        (("submit", "nowhere", "a.zip"), "error: nowhere is not a folder; "),
        (("submit", "nowhere", "a.tar"), "error: a.tar must end in .zip; "),
    ],
)
def test_bad_input_is_exit_code_2_and_one_sentence(run: Any, arguments: tuple[str, ...], message: str) -> None:
    result = run(*arguments)
    assert (result.code, result.out) == (2, "")
    assert result.err.startswith(message)
    assert result.err.count("\n") == 1


def test_the_folder_comes_from_the_environment(run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KITTI_ROOT", str(write_kitti(tmp_path)))
    assert run("data", "check", "--preset", "tiny").code == 0


def write_vehicles(root: Path) -> Path:
    """Labels of types that no preset learns."""
    write_custom(root)
    for path in (root / "labels").iterdir():
        path.write_text(path.read_text().replace("Car", "Vehicle").replace("Van", "Truck"))
    return root


def test_the_remedy_for_an_unknown_class_is_true(run: Any, tmp_path: Path) -> None:
    root, path = write_vehicles(tmp_path / "data"), tmp_path / "config.json"
    refused = run("data", "check", root, "--preset", "tiny")
    assert refused.code == 1
    assert "write a config for them with `ciassd data suggest`." in refused.out.splitlines()[-1]
    suggested = run("data", "suggest", root, "--preset", "tiny", "--classes", "vehicle")
    assert suggested.code == 0
    path.write_text(suggested.out)
    assert Config.from_json(suggested.out).class_names == ("Vehicle",)
    assert suggested.err.startswith("Class Vehicle (2): anchors of 3.9 x 1.6 x 1.5 m centred at z = -1 m.\n")
    assert "Left out: Truck (2), Pedestrian (2); name a type with --classes to learn it" in suggested.err
    accepted = run("data", "check", root, "--config", path)
    assert accepted.code == 0
    assert accepted.out.splitlines()[-1] == "Verdict: ready to train: 2 Vehicle objects in range in 2 frames."


def test_suggest_writes_a_file(run: Any, tmp_path: Path) -> None:
    root, path = write_vehicles(tmp_path / "data"), tmp_path / "new/config.json"
    result = run("data", "suggest", root, "--preset", "tiny", "--classes", "Vehicle", "truck", "--out", path)
    assert (result.code, result.out) == (0, "")
    assert Config.from_json(path.read_text()).class_names == ("Vehicle", "Truck")


def test_suggest_names_the_types_there_are(run: Any, tmp_path: Path) -> None:
    result = run("data", "suggest", write_vehicles(tmp_path), "--classes", "Forklift")
    assert (result.code, result.out) == (2, "")
    assert result.err == (
        "error: No object is of the type Forklift; choose from Vehicle (2), Truck (2), Pedestrian (2).\n"
    )


def test_prepare_writes_the_database(run: Any, tmp_path: Path) -> None:
    root = write_kitti(tmp_path / "kitti")
    result = run("data", "prepare", root, "--split", "all", "--out", tmp_path / "out")
    assert result.code == 0
    path = tmp_path / "out" / "objects_all.bin"
    assert result.out.splitlines()[0] == f"Wrote the objects of 3 frames to {path}."
    database = open_database(path, open_dataset(root, "all"))
    assert len(database.objects) == 3 * len(OBJECTS)
    assert not (root / "training/velodyne_reduced").exists()


def test_prepare_reduces_clouds_when_asked(run: Any, tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    before = open_dataset(root, "all").read(0).points
    result = run("data", "prepare", root, "--split", "all", "--reduce")
    assert (result.code, result.out.splitlines()[0]) == (0, "Wrote 3 cropped clouds.")
    assert (root / "objects_all.bin").is_file()
    np.testing.assert_array_equal(open_dataset(root, "all").read(0).points, before)
    assert len(list((root / "training/velodyne_reduced").glob("*.bin"))) == 3


def test_prepare_cannot_reduce_without_a_camera(run: Any, tmp_path: Path) -> None:
    result = run("data", "prepare", write_custom(tmp_path), "--reduce")
    assert result.code == 2
    assert result.err == f"error: {tmp_path} has no camera to crop clouds to; leave out --reduce.\n"


@pytest.mark.slow
def test_synth_writes_a_folder_that_passes_the_check(run: Any, tmp_path: Path) -> None:
    root = tmp_path / "synth"
    result = run("data", "synth", root, "--frames", 4, "--seed", 1)
    assert (result.code, result.out, result.err) == (0, f"Wrote 4 frames to {root}.\n", "")
    assert (root / "ImageSets/val.txt").read_text() == "000003\n"
    assert run("data", "check", root).code == 0
    again = run("data", "synth", root)
    assert (again.code, again.out) == (2, "")
    assert again.err.startswith(f"error: {root} is not empty; ")
    assert "overwrite" in again.err
    assert run("data", "synth", root, "--frames", 1, "--overwrite").code == 0
    assert [path.name for path in (root / "training/velodyne").iterdir()] == ["000000.bin"]


@pytest.mark.slow
def test_synth_simulates_another_sensor_and_an_own_class(run: Any, tmp_path: Path) -> None:
    options = ("--beams", 16, "--sensor-height", 2.1, "--max-range", 40, "--class", "Forklift")
    assert run("data", "synth", tmp_path, "--frames", 2, *options).code == 0
    read = open_dataset(tmp_path, "all")
    made = open_synthetic(0, 2, Lidar.with_beams(16, height=2.1, max_range=40.0), "Forklift")
    for index in range(2):
        np.testing.assert_array_equal(read.read(index).points, made.read(index).points)
        assert read.read(index).names == made.read(index).names
    assert "Forklift" in read.read(0).names + read.read(1).names


def test_synth_without_options_simulates_the_usual_sensor(
    run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[dict] = []
    monkeypatch.setattr("ciassd_jax.cli.data_synth.write_synthetic", lambda out, **given: calls.append(given))
    assert run("data", "synth", tmp_path).code == 0
    assert [(given["lidar"], given["own_class"]) for given in calls] == [(Lidar(), None)]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--frames", 0), "error: --frames is 0; simulate at least 1 frame.\n"),
        (("--seed", -1), "error: --seed is -1; choose one from 0 to 2147483647.\n"),
        (("--sensor-height", 0), "error: A sensor's height cannot be 0 m; choose 0.5 to 10 m.\n"),
        (("--class", "a b"), "error: The class 'a b' is not one word; write it without spaces, such as Forklift.\n"),
    ],
)
def test_synth_refuses_senseless_numbers(run: Any, tmp_path: Path, options: tuple, message: str) -> None:
    result = run("data", "synth", tmp_path / "out", *options)
    assert (result.code, result.out, result.err) == (2, "", message)
    assert not (tmp_path / "out").exists()


def test_labels_that_cover_each_other_score_less_than_is_possible(run: Any, tmp_path: Path) -> None:
    """A detection too low for the level is neutral whatever its type: the car behind it takes it and is lost."""
    root = write_kitti(tmp_path)
    for name in NAMES:
        path = root / f"training/label_2/{name}.txt"
        car, van, pedestrian = (row for row in read_rows(path) if row.type != "DontCare")
        low, high = (100.0, 100.0, 130.0, 124.9), (100.0, 100.0, 130.0, 126.0)
        write_rows(path, [pedestrian._replace(bbox=low), van, car._replace(bbox=high)])
    result = run("data", "check", root, "--preset", "tiny")
    assert result.code == 1
    lines = [line for line in result.out.splitlines() if line.startswith("error: ")]
    remedy = "look for labels that cover each other."
    assert lines == [
        f"error: Car {metric}: labels as detections score 0.00, 0.00, 0.00 where 0.00, 5.00, 5.00 is possible; {remedy}"
        for metric in ("bbox", "aos")
    ]


@pytest.mark.reference
def test_real_labels_score_100_or_what_fewer_objects_can(shared: Path) -> None:
    scores = check_dataset(shared / "kitti", config=three_class()).scores
    assert all(one.score == one.possible for one in scores)
    by_class = {one.name: (one.objects, one.score) for one in scores if one.metric == "3d"}
    assert by_class == {
        "Car": ((132, 335, 451), (100, 100, 100)),
        "Pedestrian": ((51, 74, 83), (100, 100, 100)),
        "Cyclist": ((16, 28, 30), (37.5, 67.5, 72.5)),
    }
