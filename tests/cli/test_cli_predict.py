"""`ciassd predict`: the files it writes, what it prints, and one sentence for bad input."""

import json
import math
import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
from cli_files import TOUCHED, evil_pth, names_in
from mini_folders import NAMES, png_header, write_custom, write_kitti, write_split
from released import released_state
from small import CALIBRATION, IMAGE_SIZE, small_cloud, small_config

from ciassd_jax import Detector
from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.kitti_rows import read_rows
from ciassd_jax.formats.points import write_bin
from ciassd_jax.inference.results import FrameResult


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """A KITTI layout of one frame, with a camera that KITTI does not have."""
    root = tmp_path / "kitti"
    for folder in ("velodyne_reduced", "calib", "image_2"):
        (root / folder).mkdir(parents=True)
    write_bin(root / "velodyne_reduced" / "000007.bin", small_cloud())
    (root / "calib" / "000007.txt").write_text(CALIBRATION)
    return root


@pytest.mark.smoke
def test_one_cloud_gives_json_and_a_table(run: Any, weights: Path, tmp_path: Path) -> None:
    write_bin(tmp_path / "street.bin", small_cloud())
    result = run("predict", tmp_path / "street.bin", "--weights", weights, "--out", tmp_path / "out" / "deep")
    assert (result.code, result.complaints) == (0, "")
    assert names_in(tmp_path / "out" / "deep") == ["street.json"]
    data = json.loads((tmp_path / "out" / "deep" / "street.json").read_text())
    assert list(data) == ["box_columns", "boxes", "scores", "labels", "counts", "seconds"]
    count = len(data["scores"])
    assert count > 0
    assert np.shape(data["boxes"]) == (count, 7)
    assert data["labels"] == ["Car"] * count
    assert data["seconds"] > 0
    counts = data["counts"]
    assert {name: set(part) for name, part in counts.items() if name != "sites"} == {
        "points": {"given", "in_range", "dropped", "clipped", "invalid"},
        "voxels": {"kept", "dropped"},
        "candidates": {"kept", "dropped"},
    }
    assert [set(stage) for stage in counts["sites"]] == [{"kept", "dropped"}] * 2
    assert counts["points"]["given"] == len(small_cloud())
    header, titles, *rows = result.out.splitlines()
    assert re.search(rf"street\.bin: {count} detections in \d+ ms$", header)
    assert titles.split() == ["class", "score", "x", "y", "z", "length", "width", "height", "yaw"]
    assert [float(cell) for cell in rows[0].split()[2:]] == pytest.approx(data["boxes"][0], abs=0.006)
    assert rows[-1] == f"Wrote {tmp_path / 'out' / 'deep' / 'street.json'}."


def test_all_formats_of_points_agree(run: Any, weights: Path, tmp_path: Path) -> None:
    points = small_cloud()
    clouds = tmp_path / "clouds"
    clouds.mkdir()
    write_bin(clouds / "a.bin", points)
    np.save(clouds / "b.npy", points)
    np.savez(clouds / "c.npz", points=points)
    header = "FIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nWIDTH 600\nHEIGHT 1\nDATA binary\n"
    (clouds / "d.pcd").write_bytes(header.encode() + points.tobytes())
    (clouds / "notes.txt").write_text("not a cloud")
    result = run("predict", clouds, "--weights", weights, "--out", tmp_path / "out")
    assert result.code == 0
    assert names_in(tmp_path / "out") == ["a.json", "b.json", "c.json", "d.json"]
    boxes = [json.loads((tmp_path / "out" / f"{name}.json").read_text())["boxes"] for name in "abcd"]
    assert boxes[0] == boxes[1] == boxes[2] == boxes[3]
    *lines, summary = result.out.splitlines()
    assert [line.split(":")[0] for line in lines] == ["a.bin", "b.npy", "c.npz", "d.pcd"]
    assert re.fullmatch(rf"a\.bin: {len(boxes[0])} boxes, best 0\.\d\d, \d\.\d+ s", lines[0])
    assert summary.startswith(f"4 frames, {4 * len(boxes[0])} boxes, ")
    assert "4/4" not in result.err  # Only a terminal shows a progress bar.


def boxes_in(folder: Path) -> dict[str, Any]:
    return {path.stem: json.loads(path.read_text())["boxes"] for path in folder.glob("*.json")}


def test_batches_give_the_same_boxes_in_order(run: Any, weights: Path, tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "clouds", {f"{name}.bin": small_cloud(name, 400).tobytes() for name in range(3)})
    common = ("predict", folder, "--weights", weights)
    assert run(*common, "--out", tmp_path / "alone").code == 0
    result = run(*common, "--out", tmp_path / "batched", "--batch-size", 2)
    assert (result.code, result.complaints) == (0, "")
    *lines, summary = result.out.splitlines()
    assert [line.split(":")[0] for line in lines] == ["0.bin", "1.bin", "2.bin"]
    assert re.search(r" s per frame without reading and compilation, in batches of 2; results are in ", summary)
    alone, batched = boxes_in(tmp_path / "alone"), boxes_in(tmp_path / "batched")
    assert alone.keys() == batched.keys()
    for name, boxes in alone.items():
        assert len(boxes) > 0
        np.testing.assert_allclose(batched[name], boxes, atol=1e-5)


def test_no_batch_is_larger_than_the_folder(run: Any, weights: Path, tmp_path: Path, monkeypatch: Any) -> None:
    def detect(self: Detector, points: list[Any], *, batch_size: int, **named: Any) -> None:
        raise InputError(f"{len(points)} clouds, compiled for {batch_size}")

    monkeypatch.setattr(Detector, "__call__", detect)
    folder = folder_of(tmp_path / "clouds", {"0.bin": GOOD, "1.bin": GOOD})
    result = run("predict", folder, "--weights", weights, "--out", tmp_path / "out", "--batch-size", 1000)
    assert result.err == "error: 2 clouds, compiled for 2\n"


def test_a_cloud_that_cannot_be_read_does_not_prevent_the_others(run: Any, weights: Path, tmp_path: Path) -> None:
    bytes_as_intensity = (small_cloud() * np.float32([1, 1, 1, 255])).tobytes()
    contents = {"0.bin": GOOD, "1.bin": GOOD[:-1], "2.bin": bytes_as_intensity, "3.npy": b"\x93NUMPY\1", "4.bin": GOOD}
    folder = folder_of(tmp_path / "clouds", contents)
    common = ("predict", folder, "--weights", weights, "--batch-size", 2)
    result = run(*common, "--out", tmp_path / "out")
    assert result.code == 2
    assert sorted(boxes_in(tmp_path / "out")) == ["0", "4"]
    assert result.out.splitlines()[-1].startswith("2 frames, ")
    errors = result.complaints.splitlines()
    # The sizes of all files are checked first.
    assert [Path(re.match(r"error: (\S+?):? ", line)[1]).name for line in errors] == ["1.bin", "2.bin", "3.npy"]
    assert "--intensity-scale" in errors[1]
    for name, left in (("1.bin", set()), ("2.bin", {"0.json"}), ("3.npy", {"0.json"})):
        strict = run(*common[:-1], 1, "--out", tmp_path / name, "--strict")
        assert strict.code == 2
        assert re.fullmatch(rf"error: \S+{name}:? .*\n", strict.complaints)
        assert set(names_in(tmp_path / name) if left else ()) == left
        (folder / name).unlink()


@pytest.mark.parametrize("layout", ["kitti", "custom"])
def test_the_frames_of_a_data_set_are_predicted(run: Any, weights: Path, tmp_path: Path, layout: str) -> None:
    root = write_kitti(tmp_path / "data") if layout == "kitti" else write_custom(tmp_path / "data", NAMES)
    write_split(root, "val", *NAMES[:0:-1])
    # Labels are not read.
    next(root.rglob("label*/000001.txt")).write_text("broken")
    common = ("predict", root, "--weights", weights)
    result = run(*common, "--split", "val", "--out", tmp_path / "val")
    assert (result.code, result.complaints) == (0, "")
    assert [line.split(".")[0] for line in result.out.splitlines()[:2]] == [*NAMES[:0:-1]]
    written = [f"{name}.{suffix}" for name in NAMES[1:] for suffix in ("json", "txt")]
    assert names_in(tmp_path / "val") == (written if layout == "kitti" else written[::2])
    assert ("points that the camera does not see" in result.out) == (layout == "kitti")
    assert run(*common, "--out", tmp_path / "all").code == 0
    assert sorted(boxes_in(tmp_path / "all")) == list(NAMES)


def test_pictures_and_a_page_are_written_on_demand(
    run: Any, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, out = folder_of(tmp_path / "clouds", {"a.bin": GOOD, "b.bin": GOOD}), tmp_path / "out"
    common = ("predict", folder, "--weights", weights, "--out", out)
    result = run(*common, "--png", "--html")
    assert (result.code, result.complaints) == (0, "")
    assert names_in(out) == ["a.json", "a.png", "b.json", "b.png", "view.html"]
    assert (out / "a.png").read_bytes().startswith(b"\x89PNG")
    assert result.out.endswith(f"{out / 'view.html'} shows all frames.\n")
    monkeypatch.setattr("ciassd_jax.cli.predict._FRAMES_OF_PAGE", 1)
    assert "view.html shows the first 1 of 2 frames; `ciassd view " in run(*common, "--html").out
    one = run("predict", folder / "a.bin", "--weights", weights, "--out", out, "--png", "--html")
    assert one.out.endswith(f"Wrote {out / 'a.json'} and {out / 'a.png'} and {out / 'view.html'}.\n")


def expected_rows(data: Any) -> list[tuple[float, ...]]:
    """Dimensions, location and rotation_y of each box for the camera of `CALIBRATION`."""
    return [
        (height, width, length, -y, height / 2 - z, x, (math.pi / 2 - yaw) % (2 * math.pi) - math.pi)
        for x, y, z, length, width, height, yaw in data["boxes"]
    ]


def test_calibration_beside_the_cloud_gives_kitti_rows(run: Any, weights: Path, kitti: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    cloud = kitti / "velodyne_reduced" / "000007.bin"
    result = run("predict", cloud, "--weights", weights, "--out", out, "--image-size", *IMAGE_SIZE)
    assert (result.code, result.complaints) == (0, "")
    assert names_in(out) == ["000007.json", "000007.txt"]
    data = json.loads((out / "000007.json").read_text())
    rows = read_rows(out / "000007.txt")
    assert len(rows) == len(data["scores"]) > 0
    for row, score, expected in zip(rows, data["scores"], expected_rows(data), strict=True):
        assert (row.type, row.truncated, row.occluded) == ("Car", 0, 0)
        assert (*row.dimensions, *row.location, row.rotation_y) == pytest.approx(expected, abs=1e-4)
        assert row.score == pytest.approx(score, abs=1e-4)
        x1, y1, x2, y2 = row.bbox
        assert 0 <= x1 < x2 <= 640
        assert 0 <= y1 < y2 <= 480
    assert "000007.txt." in result.out


def test_boxes_that_the_camera_misses_are_left_out(run: Any, weights: Path, kitti: Path, tmp_path: Path) -> None:
    cloud = kitti / "velodyne_reduced" / "000007.bin"
    for size in ("640 480", "640 1"):
        out = tmp_path / size.split()[1]
        assert run("predict", cloud, "--weights", weights, "--out", out, "--image-size", *size.split()).code == 0
    assert json.loads((tmp_path / "480" / "000007.json").read_text())["boxes"]
    assert json.loads((tmp_path / "1" / "000007.json").read_text())["boxes"] == []
    assert (tmp_path / "1" / "000007.txt").read_text() == ""


def test_image_size_is_read_from_the_image(run: Any, weights: Path, kitti: Path, tmp_path: Path) -> None:
    (kitti / "image_2" / "000007.png").write_bytes(png_header(640, 1))
    result = run("predict", kitti / "velodyne_reduced", "--weights", weights, "--out", tmp_path / "out")
    assert result.code == 0
    assert (tmp_path / "out" / "000007.txt").read_text() == ""
    assert "000007.bin: 0 boxes, none, " in result.out


def test_calibration_can_be_named(run: Any, weights: Path, kitti: Path, tmp_path: Path) -> None:
    write_bin(tmp_path / "000007.bin", small_cloud())
    kitti_camera = CALIBRATION.replace("300 0 320 0 0 300 240", "721.5377 0 609.5593 0 0 721.5377 172.854")
    (kitti / "calib" / "000007.txt").write_text(kitti_camera)
    texts = []
    for calib in (kitti / "calib", kitti / "calib" / "000007.txt"):
        result = run("predict", tmp_path / "000007.bin", "--weights", weights, "--out", tmp_path, "--calib", calib)
        assert result.code == 0
        texts.append((tmp_path / "000007.txt").read_text())
        (tmp_path / "000007.txt").unlink()
    assert texts[0] == texts[1] != ""


def test_what_was_dropped_is_one_line_with_the_file(run: Any, weights: Path, tmp_path: Path) -> None:
    folder = tmp_path / "clouds"
    folder.mkdir()
    bright, spoilt = small_cloud(), small_cloud()
    bright[3, 3] = 4
    spoilt[:5, 1] = np.nan
    write_bin(folder / "bright.bin", bright)
    write_bin(folder / "nan.bin", spoilt)
    write_bin(folder / "far.bin", small_cloud() + np.float32([500, 0, 0, 0]))
    np.save(folder / "xyz.npy", small_cloud()[:, :3])
    result = run("predict", folder, "--weights", weights, "--out", tmp_path / "out")
    assert result.code == 0
    lines = [line for line in re.split(r"[\r\n]+", result.err) if "warning" in line]
    assert lines[0] == f"warning: {folder / 'bright.bin'}: 1 of 600 intensities were clipped to [0, 1]."
    assert lines[1] == f"warning: {folder / 'far.bin'}: dropped all 600 points, none of which is in range."
    assert lines[2] == f"warning: {folder / 'nan.bin'}: 5 of 600 points are not finite; they were left out."
    assert lines[3].startswith(f"warning: {folder / 'xyz.npy'} has no intensity")
    assert len(lines) == 4
    assert ".py" not in result.err
    far = json.loads((tmp_path / "out" / "far.json").read_text())
    assert (far["boxes"], far["scores"], far["labels"]) == ([], [], [])
    assert json.loads((tmp_path / "out" / "nan.json").read_text())["counts"]["points"]["given"] == 595
    assert json.loads((tmp_path / "out" / "bright.json").read_text())["counts"]["points"]["clipped"] == 1


def test_other_warnings_are_left_alone(run: Any, weights: Path, tmp_path: Path, monkeypatch: Any) -> None:
    def warn(*arguments: Any, **options: Any) -> None:
        warnings.warn("of another library", stacklevel=1)

    write_bin(tmp_path / "a.bin", small_cloud())
    monkeypatch.setattr("ciassd_jax.inference.detector.Detector.__call__", warn)
    with pytest.raises(UserWarning, match="of another library"):
        run("predict", tmp_path / "a.bin", "--weights", weights, "--out", tmp_path / "out")


def test_threshold_and_dtype_override_the_file(run: Any, weights: Path, tmp_path: Path, monkeypatch: Any) -> None:
    configs = []

    def detect(detector: Detector, points: Any, **options: Any) -> list[FrameResult]:
        configs.append(detector.config)
        return [FrameResult(np.zeros((0, 7)), np.zeros(0), (), {}, 0.0)]

    write_bin(tmp_path / "a.bin", small_cloud())
    monkeypatch.setattr("ciassd_jax.inference.detector.Detector.__call__", detect)
    common = ("predict", tmp_path / "a.bin", "--weights", weights, "--out", tmp_path / "out")
    assert run(*common, "--dtype", "bfloat16", "--score-threshold", "0.7").code == 0
    assert run(*common).code == 0
    detection = replace(small_config().detection, score_threshold=0.7)
    assert configs == [replace(small_config(), dtype="bfloat16", detection=detection), small_config()]


def cut(path: Path, keep: int) -> Path:
    path.write_bytes(path.read_bytes()[:keep])
    return path


def write(path: Path, data: bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def folder_of(folder: Path, contents: dict[str, bytes]) -> Path:
    for name, data in contents.items():
        write(folder / name, data)
    return folder


GOOD = small_cloud().astype("<f4").tobytes()
# Arguments after `predict` that stand in for the good ones, and what the sentence must say.
BAD: dict[str, tuple[Callable[[Path], dict[str, Any]], str]] = {
    "missing file": (lambda t: {"path": t / "none.bin"}, r"none\.bin does not exist; .+\."),
    "empty file": (lambda t: {"path": write(t / "e.bin", b"")}, r"e\.bin is empty; .+\."),
    "cut file": (lambda t: {"path": write(t / "c.bin", GOOD[:-3])}, r"c\.bin .*9597 bytes.* 16"),
    "cut array": (lambda t: {"path": write(t / "c.npy", b"\x93NUMPY\1")}, r"c\.npy .*; .+\."),
    "other suffix": (
        lambda t: {"path": write(t / "c.las", GOOD)},
        r"c\.las .*'\.las'; convert it",
    ),
    "no clouds": (lambda t: {"path": write(t / "d" / "a.txt", b"").parent}, r"d .*no point cloud; .+\."),
    "same stems": (
        lambda t: {"path": folder_of(t / "d", {"a.bin": GOOD, "a.npy": GOOD})},
        r"a\.bin and .*a\.npy .*a\.json; rename one",
    ),
    "all of a folder": (lambda t: {"path": folder_of(t / "d", {"1.bin": GOOD[:-1]})}, r"1\.bin .*9599 bytes"),
    "batch size": (lambda t: {"batch-size": 0}, r"--batch-size is 0; detect at least 1 cloud at once"),
    "split of a file": (lambda t: {"split": "val"}, r"--split is for the root of a data set, .*good\.bin is not"),
    "calibration of a data set": (
        lambda t: {"path": write_kitti(t / "kitti"), "calib": t},
        r"kitti has its own calibrations; leave out --calib",
    ),
    "unknown split": (
        lambda t: {"path": write_kitti(t / "kitti"), "split": "mine"},
        r"mine\.txt does not exist; write it",
    ),
    "missing weights": (lambda t: {"weights": t / "w.safetensors"}, r"w\.safetensors .*; check the path"),
    "cut weights": (
        lambda t: {"weights": cut(t / "small.safetensors", 2000)},
        r"small\.safetensors .* again",
    ),
    "unknown weights": (lambda t: {"weights": "best"}, r"'best' .*car_lite.*path"),
    "code in weights": (
        lambda t: {"weights": evil_pth(t / "evil.pth")},
        r"evil\.pth .*`\w+\.system`.* source you trust",
    ),
    "no torch file": (lambda t: {"weights": write(t / "x.pth", b"junk")}, r"x\.pth is damaged or .*PyTorch"),
    "another config": (
        lambda t: {"preset": "car"},
        r"small\.safetensors does not fit the config in \d+ of \d+ tensors: .*; leave out --preset",
    ),
    "threshold": (
        lambda t: {"score-threshold": 1.5},
        r"--config\.detection\.score-threshold\): 1\.5 is outside \[0, 1\)",
    ),
    "out is a file": (
        lambda t: {"out": write(t / "file", b"")},
        r"file cannot be a folder, as .*file is a file",
    ),
    "out below a file": (
        lambda t: {"out": write(t / "file", b"") / "a" / "b"},
        r"a/b cannot be a folder, as .*file is",
    ),
    "no calibration": (
        lambda t: {"calib": write(t / "calib" / "other.txt", b"").parent},
        r"calib/good\.txt does not exist.*good\.bin.*calibration; add it",
    ),
    "bad calibration": (lambda t: {"calib": write(t / "c.txt", b"P2: 1 2\n")}, r"c\.txt, line P2: .*12 numbers"),
    "unknown camera": (
        lambda t: {"calib": write(t / "c.txt", CALIBRATION.encode())},
        r"c\.txt .*focal length of 300 pixels.*--image-size WIDTH HEIGHT",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_sentence_and_leaves_nothing(run: Any, weights: Path, tmp_path: Path, name: str) -> None:
    make, message = BAD[name]
    write_bin(tmp_path / "good.bin", small_cloud())
    options = {"path": tmp_path / "good.bin", "weights": weights, "out": tmp_path / "out"} | make(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    arguments = [options.pop("path"), *(part for key, value in options.items() for part in (f"--{key}", value))]
    result = run("predict", *arguments)
    assert result.code == 2
    assert re.fullmatch(rf"error: .*{message}.*\n", result.err)
    assert result.out == ""
    assert sorted(tmp_path.rglob("*")) == before
    assert not TOUCHED.exists()


def test_a_released_safetensors_is_for_convert_only(run: Any, tmp_path: Path) -> None:
    write_bin(tmp_path / "good.bin", small_cloud())
    safetensors.numpy.save_file(released_state(), tmp_path / "released.safetensors")
    arguments = (tmp_path / "good.bin", "--weights", tmp_path / "released.safetensors", "--out", tmp_path / "out")
    result = run("predict", *arguments)
    assert (result.code, result.out) == (2, "")
    assert re.search(r"released\.safetensors .*`ciassd convert \S+ OUT\.safetensors`", result.err)


def test_a_failed_write_leaves_no_part_of_a_file(run: Any, weights: Path, tmp_path: Path, monkeypatch: Any) -> None:
    def full(self: Path, text: str, **options: Any) -> int:
        self.write_bytes(text[:10].encode())
        raise OSError(28, "No space left on device")

    write_bin(tmp_path / "a.bin", small_cloud())
    monkeypatch.setattr(Path, "write_text", full)
    result = run("predict", tmp_path / "a.bin", "--weights", weights, "--out", tmp_path / "out")
    assert result.code == 2
    assert re.fullmatch(r"error: \S+a\.json cannot be written \(No space left on device\); choose .*\n", result.err)
    assert names_in(tmp_path / "out") == []


def test_a_mistake_of_ours_keeps_its_traceback(run: Any, weights: Path, tmp_path: Path, monkeypatch: Any) -> None:
    def broken(*arguments: Any, **options: Any) -> None:
        raise ValueError("shapes do not match")

    write_bin(tmp_path / "a.bin", small_cloud())
    monkeypatch.setattr("ciassd_jax.inference.detector.Detector.__call__", broken)
    with pytest.raises(ValueError, match="shapes do not match"):
        run("predict", tmp_path / "a.bin", "--weights", weights, "--out", tmp_path / "out")


@pytest.mark.slow
@pytest.mark.reference
def test_a_real_frame_gives_the_golden_boxes(run: Any, shared: Path, tmp_path: Path) -> None:
    cloud = shared / "kitti" / "training" / "velodyne_reduced" / "000010.bin"
    result = run("predict", cloud, "--weights", shared / "golden" / "weights.pth", "--out", tmp_path)
    assert result.code == 0
    data = json.loads((tmp_path / "000010.json").read_text())
    with np.load(shared / "golden" / "network.npz") as golden:
        x, y, z, width, length, height, r = golden["000010_final_boxes"].T
        scores = golden["000010_final_scores"]
    found = np.array(data["boxes"])
    np.testing.assert_allclose(found[:, :6], np.stack([x, y, z, length, width, height], 1), atol=5e-3)
    turn = found[:, 6] + r + np.pi / 2
    np.testing.assert_allclose(turn - 2 * np.pi * np.round(turn / (2 * np.pi)), 0, atol=5e-3)
    np.testing.assert_allclose(data["scores"], scores, atol=1e-3)
    assert len(read_rows(tmp_path / "000010.txt")) == len(scores)
