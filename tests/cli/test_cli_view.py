"""`ciassd view`: what it shows of clouds, data sets and results, and one sentence for what it cannot."""

import base64
import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from mini_folders import NAMES, OBJECTS, object_boxes, write_custom, write_kitti
from small import IMAGE_SIZE, random_variables, small_cloud, small_config

from ciassd_jax import save_weights
from ciassd_jax.cli import main
from ciassd_jax.formats.kitti_boxes import boxes_to_rows
from ciassd_jax.formats.kitti_camera import read_calibration
from ciassd_jax.formats.kitti_rows import write_rows
from ciassd_jax.formats.points import write_bin

TRUTH = np.array(list(OBJECTS.values()))
SIZE = ("--image-size", *IMAGE_SIZE)


class Run(NamedTuple):
    code: int
    out: str
    err: str
    frames: list[dict[str, Any]]


@pytest.fixture
def view(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Run]:
    """Run `ciassd view` in an empty folder; also the frames of the page where it wrote one."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")

    def call(*arguments: object, page: str = "view.html") -> Run:
        code = main(["view", *map(str, arguments)])
        return Run(code, *capsys.readouterr(), frames_of(Path(page)) if Path(page).exists() else [])

    return call


def frames_of(page: Path) -> list[dict[str, Any]]:
    text = page.read_text(encoding="utf-8")
    (data,) = re.findall(r'<script id="data" type="application/json">(.*?)</script>', text, re.DOTALL)
    return json.loads(data)["frames"]


def num_points(frame: dict[str, Any]) -> int:
    return len(base64.b64decode(frame["points"])) // 6


def write_image(path: Path) -> None:
    from PIL import Image

    Image.fromarray(np.full((IMAGE_SIZE[1], IMAGE_SIZE[0], 3), 90, np.uint8)).save(path)


def test_a_cloud_alone(view: Any, tmp_path: Path) -> None:
    write_bin(tmp_path / "street.bin", small_cloud())
    result = view(tmp_path / "street.bin")
    assert (result.code, result.err) == (0, "")
    (frame,) = result.frames
    assert (frame["name"], num_points(frame), frame["truth"]["boxes"], frame["image"]) == ("street", 600, [], None)
    assert re.fullmatch(
        r"Wrote view.html: 1 frame, 0 labelled and 0 detected boxes, \d\.\d MB; open it in a browser\.\n", result.out
    )


def test_a_folder_of_clouds_and_another_place_for_the_page(view: Any, tmp_path: Path) -> None:
    (tmp_path / "clouds").mkdir()
    for seed, name in enumerate("ba"):
        write_bin(tmp_path / "clouds" / f"{name}.bin", small_cloud(seed))
    result = view(tmp_path / "clouds", "--out", tmp_path / "new" / "page.html", page=str(tmp_path / "new/page.html"))
    assert [frame["name"] for frame in result.frames] == ["a", "b"]
    assert list(Path().iterdir()) == []


def test_a_kitti_folder_shows_its_labels(view: Any, tmp_path: Path) -> None:
    result = view(write_kitti(tmp_path / "kitti"))
    assert [frame["name"] for frame in result.frames] == list(NAMES)
    for frame in result.frames:
        np.testing.assert_allclose(frame["truth"]["boxes"], TRUTH, atol=2e-3)
        assert frame["truth"]["labels"] == list(OBJECTS)
        assert frame["image"] is None
    assert "3 frames, 9 labelled and 0 detected boxes" in result.out


def test_a_folder_of_clouds_within_kitti_is_shown_whole_with_its_labels(view: Any, tmp_path: Path) -> None:
    root = write_kitti(tmp_path / "kitti")
    whole, cropped = view(root / "training" / "velodyne"), view(root)
    assert num_points(whole.frames[0]) == 980
    assert num_points(cropped.frames[0]) < 700
    np.testing.assert_allclose(whole.frames[0]["truth"]["boxes"], TRUTH, atol=2e-3)


@pytest.mark.parametrize("part", ["", "points", "points/a.npy"])
def test_a_custom_data_set_shows_its_labels(part: str, view: Any, tmp_path: Path) -> None:
    first = view(write_custom(tmp_path / "own") / part).frames[0]
    assert (first["name"], first["truth"]["labels"]) == ("a", list(OBJECTS))
    np.testing.assert_allclose(first["truth"]["boxes"], TRUTH, atol=1e-4)


def test_frames_are_chosen_by_name_number_and_split(view: Any, tmp_path: Path) -> None:
    root = write_kitti(tmp_path / "kitti")
    assert [frame["name"] for frame in view(root, "--names", NAMES[2], NAMES[0]).frames] == [NAMES[2], NAMES[0]]
    result = view(root, "--frames", 2)
    assert [frame["name"] for frame in result.frames] == list(NAMES[:2])
    assert "Showing the first 2 of 3 frames; " in result.out
    (root / "ImageSets").mkdir()
    (root / "ImageSets" / "few.txt").write_text(NAMES[1])
    assert [frame["name"] for frame in view(root, "--split", "few").frames] == [NAMES[1]]


def test_simulated_frames_need_no_folder(view: Any, streets: list[tuple[int, int]]) -> None:
    result = view("simulated", "--frames", 2, "--seed", 5)
    assert [frame["name"] for frame in result.frames] == ["000000", "000001"]
    assert streets == [(5, 2)]
    np.testing.assert_allclose(result.frames[0]["truth"]["boxes"], TRUTH, atol=2e-3)
    result = view("simulated", "--frames", 8, "--split", "val")
    assert [frame["name"] for frame in result.frames] == ["000003", "000007"]
    assert "no images; leave out --image" in view("simulated", "--image").err


def test_images_are_shown_with_boxes(view: Any, tmp_path: Path) -> None:
    root = write_kitti(tmp_path / "kitti")
    for name in NAMES:
        write_image(root / "training" / "image_2" / f"{name}.png")
    for path in (root, root / "training" / "velodyne"):
        image = view(path, "--image").frames[0]["image"]
        assert (image["width"], image["height"], len(image["truth"])) == (*IMAGE_SIZE, 3)


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    save_weights(tmp_path / "small.safetensors", random_variables(small_config()), small_config())
    return tmp_path / "small.safetensors"


def test_weights_detect_and_saved_results_show_the_same(view: Any, weights: Path, tmp_path: Path) -> None:
    (tmp_path / "clouds").mkdir()
    for seed, name in enumerate("ab"):
        write_bin(tmp_path / "clouds" / f"{name}.bin", small_cloud(seed))
    detected = view(tmp_path / "clouds", "--weights", weights)
    assert sum(len(frame["found"]["boxes"]) for frame in detected.frames) > 0
    assert main(["predict", f"{tmp_path / 'clouds'}", "--weights", f"{weights}", "--out", f"{tmp_path / 'out'}"]) == 0
    saved = view(tmp_path / "clouds", "--results", tmp_path / "out")
    assert [frame["found"] for frame in saved.frames] == [frame["found"] for frame in detected.frames]


@pytest.mark.slow
def test_the_least_score_holds_for_detecting_and_for_saved_results(view: Any, weights: Path, tmp_path: Path) -> None:
    (tmp_path / "clouds").mkdir()
    write_bin(tmp_path / "clouds" / "a.bin", small_cloud())
    out = ("--weights", f"{weights}", "--out", f"{tmp_path / 'out'}")
    assert main(["predict", f"{tmp_path / 'clouds'}", *out]) == 0
    (everything,) = view(tmp_path / "clouds", "--results", tmp_path / "out").frames
    scores = everything["found"]["scores"]
    least = sorted(scores)[len(scores) // 2] - 1e-4
    for place in (("--weights", weights), ("--results", tmp_path / "out")):
        (frame,) = view(tmp_path / "clouds", *place, "--min-score", least).frames
        assert frame["found"]["scores"] == [score for score in scores if score >= least]
        assert 0 < len(frame["found"]["scores"]) < len(scores)


def test_a_config_tells_which_truth_is_no_target(view: Any, weights: Path, tmp_path: Path) -> None:
    root = write_kitti(tmp_path / "kitti")
    others = [index for index, name in enumerate(OBJECTS) if name not in ("Car", "Van")]
    assert others
    for options, dimmed in (((), []), (("--preset", "car"), others), (("--weights", weights), others)):
        assert view(root, *SIZE, *options, "--frames", 1).frames[0]["truth"]["dimmed"] == dimmed


def test_kitti_rows_are_shown_where_there_is_a_camera(view: Any, tmp_path: Path) -> None:
    root = write_kitti(tmp_path / "kitti")
    calibration = read_calibration(root / "training" / "calib" / f"{NAMES[0]}.txt")
    rows, _ = boxes_to_rows(object_boxes(), np.array([0.9, 0.5, 0.1]), list(OBJECTS), calibration, IMAGE_SIZE)
    (tmp_path / "rows").mkdir()
    write_rows(tmp_path / "rows" / f"{NAMES[0]}.txt", rows)
    result = view(root, "--results", tmp_path / "rows")
    assert f"has no results for 2 of 3 frames, {NAMES[1]} first" in result.err
    found = result.frames[0]["found"]
    assert (found["labels"], found["scores"]) == (list(OBJECTS), [0.9, 0.5, 0.1])
    np.testing.assert_allclose(found["boxes"], result.frames[0]["truth"]["boxes"], atol=2e-3)


def test_rows_of_a_custom_data_set(view: Any, tmp_path: Path) -> None:
    root = write_custom(tmp_path / "own")
    (tmp_path / "rows").mkdir()
    for name in "ab":
        (tmp_path / "rows" / f"{name}.txt").write_text("8 1 -1 3.9 1.6 1.5 0.3 Car 0.75\n")
    found = view(root, "--results", tmp_path / "rows").frames[1]["found"]
    assert found == {"boxes": [[8, 1, -1, 3.9, 1.6, 1.5, 0.3]], "labels": ["Car"], "scores": [0.75], "dimmed": []}


BAD = {
    "absent": ["{tmp}/absent.bin"],
    "no cloud": ["{tmp}/nothing"],
    "part of a data set": ["{tmp}/kitti/training"],
    "unknown frame": ["{tmp}/kitti", "--names", "17"],
    "no frames": ["{tmp}/kitti", "--frames", "0"],
    "no page": ["{tmp}/kitti", "--out", "picture.png"],
    "page below a file": ["{tmp}/kitti", "--out", "{tmp}/kitti/training/calib/000000.txt/view.html"],
    "both": ["{tmp}/kitti", "--weights", "w.safetensors", "--results", "{tmp}/nothing"],
    "a threshold without weights": ["{tmp}/kitti", "--score-threshold", "0.5"],
    "a score without detections": ["{tmp}/kitti", "--min-score", "0.5"],
    "a score of 1": ["{tmp}/kitti", "--results", "{tmp}/rows", "--min-score", "1"],
    "no weights": ["{tmp}/kitti", "--weights", "{tmp}/absent.safetensors"],
    "no results": ["{tmp}/kitti", "--results", "{tmp}/nothing"],
    "no folder": ["{tmp}/kitti", "--results", "{tmp}/absent"],
    "labels as results": ["{tmp}/kitti", "--results", "{tmp}/kitti/training/label_2"],
    "broken json": ["{tmp}/kitti", "--results", "{tmp}/broken"],
    "KITTI's rows without a camera": ["{tmp}/own", "--results", "{tmp}/rows"],
    "no score": ["{tmp}/own", "--results", "{tmp}/own/labels"],
    "no images": ["{tmp}/own", "--image"],
    "bad images": ["{tmp}/kitti", "--image"],
    "no split": ["{tmp}/kitti", "--split", "own"],
}


@pytest.mark.parametrize("arguments", BAD.values(), ids=BAD.keys())
def test_bad_input_is_one_sentence(arguments: list[str], view: Any, tmp_path: Path) -> None:
    write_kitti(tmp_path / "kitti")
    write_custom(tmp_path / "own")
    for folder in ("nothing", "broken", "rows"):
        (tmp_path / folder).mkdir()
    (tmp_path / "broken" / "000000.json").write_text('{"boxes": [[1, 2]]}')
    row = "Car 0 0 0 1 2 3 4 1.5 1.6 3.9 1 1 8 0.1 0.9\n"
    (tmp_path / "rows" / "a.txt").write_text(row)
    result = view(*(argument.format(tmp=tmp_path) for argument in arguments))
    assert (result.code, result.out, result.frames) == (2, "", [])
    assert re.fullmatch(r"error: [^\n]+\.\n", result.err)


def test_without_the_extra_one_sentence_names_it(tmp_path: Path) -> None:
    write_bin(tmp_path / "street.bin", small_cloud())
    code = (
        "import sys; sys.modules['plotly'] = None\nfrom ciassd_jax.cli import main\n"
        f"sys.exit(main(['view', {str(tmp_path / 'street.bin')!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch(r"error: [^\n]*plotly[^\n]*pip install 'ciassd_jax\[viz\]'[^\n]*\.\n", done.stderr)


@pytest.mark.slow
def test_a_cloud_of_millions_is_thinned_and_said_so(view: Any, tmp_path: Path) -> None:
    np.save(tmp_path / "huge.npy", np.broadcast_to(np.float32([5, 1, 0, 0.5]), (10_000_000, 4)))
    result = view(tmp_path / "huge.npy")
    assert result.code == 0
    assert "150,000 of 10,000,000 points are shown, chosen evenly." in result.err
    assert num_points(result.frames[0]) == 150_000
