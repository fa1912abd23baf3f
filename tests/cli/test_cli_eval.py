"""`ciassd eval`, called in this process and, to see that no device starts, in its own."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from mini_folders import NAMES, write_custom, write_kitti, write_split
from small import random_variables, small_config

from ciassd_jax import Config, Detector, create_train_state, save_weights
from ciassd_jax.cli import main
from ciassd_jax.data.loader import LoaderState
from ciassd_jax.evaluation import evaluate, read_folders, to_json
from ciassd_jax.formats.kitti_rows import ObjectRow, write_rows
from ciassd_jax.training.checkpoint import Checkpoints


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """Labels and exact results of two frames."""
    labels, results = tmp_path / "label_2", tmp_path / "results"
    labels.mkdir()
    results.mkdir()
    for frame in range(2):
        row = ObjectRow("Car", 0, 0, 0.1, (10, 20, 110, 80), (1.5, 1.6, 4), (frame, 1.7, 20), 0.2)
        write_rows(labels / f"{frame:06}.txt", [row])
        write_rows(results / f"{frame:06}.txt", [row._replace(score=0.5 + frame / 10)])
    return labels, results


def test_prints_the_block_and_writes_json(
    folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "result.json"
    assert main(["eval", "txt", *map(str, folders), "--json", str(out)]) == 0
    shown, said = capsys.readouterr()
    assert said == ""
    assert shown.startswith("Car AP@0.70, 0.70, 0.70:\nbbox AP:9.0909, 9.0909, 9.0909\n")
    assert shown.endswith(f"Wrote {out}.\n")
    assert json.loads(out.read_text()) == to_json(evaluate(*read_folders(*folders)))
    assert [path.name for path in out.parent.iterdir()] == ["result.json"]


def test_warnings_are_lines(folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    (folders[1] / "000001.txt").unlink()
    assert main(["eval", "txt", *map(str, folders)]) == 0
    said = capsys.readouterr().err
    assert said.startswith("warning: Frames of ")
    assert said.count("\n") == 1


@pytest.mark.parametrize("what", ["missing", "score", "json"])
def test_bad_input_is_one_sentence(
    what: str, folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    labels, results = folders
    arguments = {
        "missing": [labels, tmp_path / "absent"],
        "score": [labels, results],
        "json": [labels, results, "--json", labels / "000000.txt" / "out.json"],
    }
    if what == "score":
        with open(results / "000000.txt", "a") as stream:
            stream.write("Car 0 0 0 1 2 3 4 1 1 1 0 0 9 0 nan\n")
    assert main(["eval", "txt", *map(str, arguments[what])]) == 2
    shown, said = capsys.readouterr()
    assert shown == ""
    assert said.startswith("error: ")
    assert said.count("\n") == 1
    expected = {"missing": "absent does not exist", "score": "000000.txt, line 2: the score", "json": "is a file"}
    assert expected[what] in said


def own_class(folders: tuple[Path, Path]) -> list[str]:
    """The arguments for the folders, whose cars become vehicles."""
    for path in (path for folder in folders for path in folder.iterdir()):
        path.write_text(path.read_text().replace("Car", "Vehicle"))
    return ["eval", "txt", *map(str, folders)]


def test_a_class_of_ones_own(folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    """What the output advises for a type that is left out evaluates it."""
    arguments = own_class(folders)
    assert main(arguments) == 0
    shown = capsys.readouterr().out
    assert "\nNot evaluated: 2 labels and 2 detections of Vehicle.\n" in shown
    advice = re.search(r"^(--overlap Vehicle=\S+) evaluates them", shown, re.MULTILINE)[1]
    assert main([*arguments, *advice.split(), "Forklift=.4", "--overlap", "car=0.6"]) == 0
    shown = capsys.readouterr().out
    assert "Vehicle AP@0.50, 0.50, 0.50:\nbbox AP:9.0909, 9.0909, 9.0909\n" in shown
    assert re.search(r"^Vehicle +3d +0\.50 +2\.50 ", shown, re.MULTILINE)
    assert re.findall(r"^(\w+) +not evaluated", shown, re.MULTILINE) == ["Pedestrian", "Cyclist", "Forklift", "car"]
    assert "Not evaluated:" not in shown


@pytest.mark.parametrize("given", ["Vehicle", "Vehicle=2", "Vehicle=0", "=0.5", "Vehicle=", "Vehicle=nan", "A=.5 a=.4"])
def test_overlaps_that_cannot_be_used(
    given: str, folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*own_class(folders), "--overlap", *given.split()]) == 2
    shown, said = capsys.readouterr()
    assert shown == ""
    assert re.fullmatch(
        r"error: --overlap .*(write CLASS=OVERLAP .* such as Vehicle=0\.5|give each class once)\.\n", said
    )


def test_labels_without_image_boxes(folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    for path in folders[0].iterdir():
        path.write_text(re.sub(r"10\.0000 20\.0000 110\.0000 80\.0000", "0 0 0 0", path.read_text()))
    assert main(["eval", "txt", *map(str, folders)]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"^Car +3d +0\.70 +2\.50 +2\.50 +2\.50", shown, re.MULTILINE)
    assert "None of the 2 labels has an image box, so none has KITTI's difficulty: every label counts" in shown


def test_nothing_to_evaluate(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval"]) == 2
    assert "--weights FILE or --workdir FOLDER, or compare files with `ciassd eval txt" in capsys.readouterr().err


def test_starts_no_device(folders: tuple[Path, Path]) -> None:
    code = (
        "import sys; from ciassd_jax.cli import main; import jax._src.xla_bridge as bridge; "
        "assert main(sys.argv[1:]) == 0; assert not bridge._backends, 'a device was initialised'"
    )
    command = [sys.executable, "-W", "error", "-c", code, "eval", "txt", *map(str, folders)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "3d   AP:" in done.stdout


@pytest.fixture
def work(tmp_path: Path) -> Path:
    """Weights in the folder of a training, beside a KITTI folder with a split of two of its frames."""
    save_weights(tmp_path / "run/last.safetensors", random_variables(small_config()), small_config())
    write_split(write_kitti(tmp_path / "kitti"), "val", *NAMES[:2])
    return tmp_path


def test_a_network_is_evaluated_and_its_files_evaluate_alike(work: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = work / "new/out"
    weights = work / "run/last.safetensors"
    assert main(["eval", "--weights", str(weights), "--data", str(work / "kitti"), "--out", str(out)]) == 0
    shown, said = capsys.readouterr()
    # Only a terminal shows a progress bar.
    assert said == ""
    *table, counts, done = shown.splitlines()
    assert re.fullmatch(r"2 frames, \d+ boxes, \d+ ms per frame without reading and compilation\.", counts)
    assert done == f"Wrote {out}."
    assert (out / "table.log").read_text().splitlines() == table[:-1]
    assert "By number of points, AP (R40)" in table
    assert sorted(path.name for path in out.iterdir()) == ["000000.txt", "000001.txt", "result.json", "table.log"]
    assert sum(len((out / f"{name}.txt").read_text().splitlines()) for name in NAMES[:2]) == int(counts.split()[2]) > 0
    labels = work / "kitti/training/label_2"
    assert main(["eval", "txt", str(labels), str(out), "--json", str(work / "txt.json")]) == 0
    # Equal but for the four decimals of the files.
    one, other = (json.loads(path.read_text())["Car"] for path in (out / "result.json", work / "txt.json"))
    assert one["bbox"]["R40"]["0.70"] == pytest.approx(other["bbox"]["R40"]["0.70"], abs=0.05)
    assert one["3d"]["R40"]["0.50"] == pytest.approx(other["3d"]["R40"]["0.50"], abs=0.05)


def test_the_weights_of_a_training_and_the_environments_data(
    work: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("KITTI_ROOT", str(write_custom(work / "custom")))
    out = work / "result.json"
    arguments = ["eval", "--workdir", str(work / "run"), "--split", "train", "--json", str(out)]
    assert main([*arguments, "--score-threshold", "0.99"]) == 0
    shown, _ = capsys.readouterr()
    assert "2 frames, 0 boxes, " in shown
    assert shown.endswith(f"Wrote {out}.\n")
    assert json.loads(out.read_text())["Car"]["3d"]["R40"]["0.70"] is None
    assert main(arguments) == 0
    shown, _ = capsys.readouterr()
    assert ": difficulty is by the number of points in an object's box," in shown
    assert json.loads(out.read_text())["Car"]["3d"]["R40"]["0.70"] is not None


@pytest.mark.slow
def test_all_checkpoints_are_one_table(work: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = small_config()
    state = create_train_state(jax.random.key(0), config, variables=random_variables(config))
    loader = LoaderState(batch=0, seed=0, batch_size=1, frames=2, checksum=0)
    with Checkpoints(work / "run/checkpoints", config) as checkpoints:
        for step in (4, 12):
            checkpoints.save(state._replace(step=np.int32(step)), loader)
    arguments = ["eval", "--workdir", str(work / "run"), "--data", str(work / "kitti"), "--all"]
    assert main([*arguments, "--json", str(work / "all.json")]) == 0
    title, head, *rows, done = capsys.readouterr().out.splitlines()
    assert title == "AP in percent, moderate, R40; the score is the mean in 3D"
    assert head.split() == ["step", "score", "Car", "3D", "0.70", "Car", "BEV", "0.70"]
    assert [row.split()[0] for row in rows] == ["4", "12"]
    assert done == f"Wrote {work}/all.json."
    written = json.loads((work / "all.json").read_text())
    assert written["4"] == written["12"]
    assert "Car_bev_0.50_moderate_R40" in written["4"]


@pytest.mark.slow
def test_all_is_of_a_training_and_writes_no_detections(work: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = ["--data", str(work / "kitti"), "--all"]
    for others in (["--weights", "car_lite"], ["--workdir", str(work / "run"), "--out", str(work / "out")]):
        assert main(["eval", *data, *others]) == 2
        assert "--all prints one table for the checkpoints of --workdir" in capsys.readouterr().err
    assert main(["eval", *data, "--workdir", str(work / "run")]) == 2
    assert "has no checkpoint" in capsys.readouterr().err


def test_dtype_overrides_that_of_the_weights(work: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = []

    def make_detector(variables: Any, config: Config) -> Detector:
        given.append(config.dtype)
        return Detector(variables, small_config())

    monkeypatch.setattr("ciassd_jax.cli.eval.Detector", make_detector)
    arguments = ["eval", "--workdir", str(work / "run"), "--data", str(work / "kitti")]
    assert main([*arguments, "--dtype", "bfloat16"]) == main(arguments) == 0
    assert given == ["bfloat16", "float32"]


def test_simulated_frames_need_no_folder(
    work: Path, streets: list[tuple[int, int]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["eval", "--workdir", str(work / "run"), "--data", "simulated", "--frames", "8", "--seed", "5"]) == 0
    assert "\n2 frames, " in capsys.readouterr().out
    assert streets == [(5, 8)]


def with_cut_cloud(root: Path, name: str) -> Path:
    path = root / f"training/velodyne/{name}.bin"
    path.write_bytes(path.read_bytes()[:-3])
    return root


def without_labels(root: Path) -> Path:
    write_split(write_kitti(root, part="testing"), "test", NAMES[1])
    return root


Change = Callable[[Path], dict[str, Any]]
# Options that stand in for the good ones, and what the sentence must say.
BAD: dict[str, tuple[Change, str]] = {
    "both": (lambda w: {"workdir": w / "run"}, r"Give either --weights FILE or --workdir FOLDER"),
    "no weights": (lambda w: {"weights": w / "none.safetensors"}, r"none\.safetensors .*; check the path"),
    "no training": (
        lambda w: {"weights": None, "workdir": w / "kitti"},
        r"kitti has neither best\.safetensors nor last\.safetensors",
    ),
    "another config": (lambda w: {"preset": "car"}, r"does not fit the config in .* tensors: .*; leave out --preset"),
    "threshold": (lambda w: {"score-threshold": 1.5}, r"--config\.detection\.score-threshold\): 1\.5 is outside"),
    "batch size": (lambda w: {"batch-size": -1}, r"--batch-size is -1; detect at least 1 cloud at once"),
    "no data": (lambda w: {"data": w / "none"}, r"none has no folder training or testing \(KITTI\) or points"),
    "no split": (lambda w: {"split": "mine"}, r"ImageSets/mine\.txt does not exist; write it"),
    "absent frames": (lambda w: {"split": "train"}, r"3711 of 3712 frames have no cloud .*; copy them, or list"),
    "out is a file": (lambda w: {"out": w / "run/last.safetensors"}, r"last\.safetensors cannot be a folder"),
    "json below a file": (lambda w: {"json": w / "run/last.safetensors/a.json"}, r"cannot be a folder"),
    "cut cloud": (
        lambda w: {"data": with_cut_cloud(w / "kitti", NAMES[1])},
        rf"velodyne/{NAMES[1]}\.bin has \d+ bytes, not a multiple of 16",
    ),
    "unlabelled": (
        lambda w: {"data": without_labels(w / "unlabelled"), "split": "test"},
        r"Frame 000001 has no labels to compare with",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_options_are_one_sentence_and_leave_nothing(
    name: str, work: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change, message = BAD[name]
    options = {"weights": work / "run/last.safetensors", "data": work / "kitti", "out": work / "out"} | change(work)
    before = sorted(work.rglob("*"))
    given = [part for key, value in options.items() if value is not None for part in (f"--{key}", str(value))]
    assert main(["eval", *given]) == 2
    shown, said = capsys.readouterr()
    *bar, sentence = said.splitlines()
    assert re.fullmatch(rf"error: .*{message}.*", sentence)
    # The frames themselves are read while the bar runs.
    assert not bar or name in ("unlabelled", "cut cloud")
    assert shown == ""
    assert sorted(work.rglob("*")) == before


def test_files_take_no_option_of_a_network(folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", "--split", "train", "txt", *map(str, folders)]) == 2
    assert capsys.readouterr().err.startswith("error: `ciassd eval txt LABELS RESULTS` has --json and --overlap only;")


def test_a_reader_that_has_seen_enough_is_no_error(tmp_path: Path) -> None:
    """`ciassd eval txt ... | true`: the file is written, and nothing is printed on stderr."""
    labels, results = tmp_path / "labels", tmp_path / "results"
    for folder, score in ((labels, ""), (results, " 1.0")):
        folder.mkdir()
        row = "Car 0 0 0.1 100 100 200 200 1.5 1.6 3.9 1 1.5 10 0.2"
        (folder / "000000.txt").write_text(f"{row}{score}\n")
    command = f"{sys.executable} -m ciassd_jax eval txt {labels} {results} --json {tmp_path / 'ap.json'} | true"
    done = subprocess.run(["bash", "-o", "pipefail", "-c", command], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "ap.json").is_file()
