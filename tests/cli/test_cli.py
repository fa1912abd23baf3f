"""The program `ciassd`, called in this process: what it writes, what it prints, and one sentence for bad input."""

import json
import math
import os
import pickle
import re
import struct
import subprocess
import sys
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
import pytest
import safetensors.numpy
from released import released_state, write_pth
from small import CALIBRATION, IMAGE_SIZE, random_variables, share_programs, small_cloud, small_config

from ciassd_jax import Detector, load_weights, save_weights, tiny
from ciassd_jax.cli import main
from ciassd_jax.cli.inference import Preset
from ciassd_jax.config.presets import PRESETS
from ciassd_jax.formats.kitti_rows import read_rows
from ciassd_jax.formats.points import write_bin
from ciassd_jax.inference.results import FrameResult
from ciassd_jax.simulation import Lidar, open_synthetic

SMALL_LIDAR = Lidar(upper=(2.0, -8.0, 8), lower=(-9.0, -24.0, 8), columns=256)


class Run(NamedTuple):
    code: int
    out: str
    err: str


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Run]:
    """Run `ciassd` with these arguments; programs are shared between tests."""
    share_programs(monkeypatch)

    def call(*arguments: object) -> Run:
        code = main([str(argument) for argument in arguments])
        return Run(code, *capsys.readouterr())

    return call


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    save_weights(tmp_path / "small.safetensors", random_variables(small_config()), small_config())
    return tmp_path / "small.safetensors"


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """A KITTI layout of one frame, with a camera that KITTI does not have."""
    root = tmp_path / "kitti"
    for folder in ("velodyne_reduced", "calib", "image_2"):
        (root / folder).mkdir(parents=True)
    write_bin(root / "velodyne_reduced" / "000007.bin", small_cloud())
    (root / "calib" / "000007.txt").write_text(CALIBRATION)
    return root


def png_header(width: int, height: int) -> bytes:
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", width, height)


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_one_cloud_gives_json_and_a_table(run: Any, weights: Path, tmp_path: Path) -> None:
    write_bin(tmp_path / "street.bin", small_cloud())
    result = run("predict", tmp_path / "street.bin", "--weights", weights, "--out", tmp_path / "out" / "deep")
    assert (result.code, result.err) == (0, "")
    assert files(tmp_path / "out" / "deep") == ["street.json"]
    data = json.loads((tmp_path / "out" / "deep" / "street.json").read_text())
    assert list(data) == ["boxes", "scores", "labels", "counts", "seconds"]
    count = len(data["scores"])
    assert count > 0
    assert np.shape(data["boxes"]) == (count, 7)
    assert data["labels"] == ["Car"] * count
    assert data["seconds"] > 0
    counts = data["counts"]
    assert {name: set(part) for name, part in counts.items() if name != "sites"} == {
        "points": {"given", "in_range", "dropped"},
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
    assert files(tmp_path / "out") == ["a.json", "b.json", "c.json", "d.json"]
    boxes = [json.loads((tmp_path / "out" / f"{name}.json").read_text())["boxes"] for name in "abcd"]
    assert boxes[0] == boxes[1] == boxes[2] == boxes[3]
    *lines, summary = result.out.splitlines()
    assert [line.split(":")[0] for line in lines] == ["a.bin", "b.npy", "c.npz", "d.pcd"]
    assert re.fullmatch(rf"a\.bin: {len(boxes[0])} boxes, best 0\.\d\d, \d\.\d+ s", lines[0])
    assert summary.startswith(f"4 frames, {4 * len(boxes[0])} boxes, ")
    assert "4/4" in result.err


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
    assert (result.code, result.err) == (0, "")
    assert files(out) == ["000007.json", "000007.txt"]
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
    byte, spoilt = small_cloud() * np.float32([1, 1, 1, 255]), small_cloud()
    spoilt[:5, 1] = np.nan
    write_bin(folder / "byte.bin", byte)
    write_bin(folder / "nan.bin", spoilt)
    write_bin(folder / "far.bin", small_cloud() + np.float32([500, 0, 0, 0]))
    np.save(folder / "xyz.npy", small_cloud()[:, :3])
    result = run("predict", folder, "--weights", weights, "--out", tmp_path / "out")
    assert result.code == 0
    lines = [line for line in re.split(r"[\r\n]+", result.err) if "warning" in line]
    assert re.fullmatch(r"warning: \S+byte\.bin: 600 intensities of up to 25\d\.?\d* were divided by 255: .*", lines[0])
    assert lines[1].endswith("far.bin: Dropped all 600 points, none of which is in range.")
    assert lines[2].endswith("nan.bin: Dropped 5 of 600 points that are not finite.")
    assert lines[3] == f"warning: {folder / 'xyz.npy'} has no intensity; 0 is used instead."
    assert len(lines) == 4
    assert ".py" not in result.err
    far = json.loads((tmp_path / "out" / "far.json").read_text())
    assert (far["boxes"], far["scores"], far["labels"]) == ([], [], [])
    assert json.loads((tmp_path / "out" / "nan.json").read_text())["counts"]["points"]["dropped"] == 5


def test_other_warnings_are_left_alone(run: Any, weights: Path, tmp_path: Path, monkeypatch: Any) -> None:
    def warn(*arguments: Any, **options: Any) -> None:
        warnings.warn("of another library", stacklevel=1)

    write_bin(tmp_path / "a.bin", small_cloud())
    monkeypatch.setattr("ciassd_jax.inference.detector.Detector.detect", warn)
    with pytest.raises(UserWarning, match="of another library"):
        run("predict", tmp_path / "a.bin", "--weights", weights, "--out", tmp_path / "out")


def test_threshold_and_dtype_override_the_file(run: Any, weights: Path, tmp_path: Path, monkeypatch: Any) -> None:
    configs = []

    def detect(detector: Detector, points: Any, frustum: Any) -> FrameResult:
        configs.append(detector.config)
        return FrameResult(np.zeros((0, 7)), np.zeros(0), (), {}, 0.0)

    write_bin(tmp_path / "a.bin", small_cloud())
    monkeypatch.setattr("ciassd_jax.inference.detector.Detector.detect", detect)
    common = ("predict", tmp_path / "a.bin", "--weights", weights, "--out", tmp_path / "out")
    assert run(*common, "--dtype", "bfloat16", "--score-threshold", "0.7").code == 0
    assert run(*common).code == 0
    detection = replace(small_config().detection, score_threshold=0.7)
    assert configs == [replace(small_config(), dtype="bfloat16", detection=detection), small_config()]


class Evil:
    def __reduce__(self) -> Any:
        return os.system, ("touch /tmp/ciassd_test_was_here",)


def evil_pth(path: Path) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", pickle.dumps({"state_dict": Evil()}, 2))
    return path


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
    "missing file": (lambda t: {"path": t / "none.bin"}, r"none\.bin does not exist; check the path\."),
    "empty file": (lambda t: {"path": write(t / "e.bin", b"")}, r"e\.bin is empty; copy or record it again\."),
    "cut file": (lambda t: {"path": write(t / "c.bin", GOOD[:-3])}, r"c\.bin has 9597 bytes, not a multiple of 16"),
    "cut array": (lambda t: {"path": write(t / "c.npy", b"\x93NUMPY\1")}, r"c\.npy is cut short .* np\.save\."),
    "other suffix": (
        lambda t: {"path": write(t / "c.las", GOOD)},
        r"c\.las has the unknown suffix '\.las'; convert it",
    ),
    "no clouds": (lambda t: {"path": write(t / "d" / "a.txt", b"").parent}, r"d holds no point cloud; give a folder"),
    "same stems": (
        lambda t: {"path": folder_of(t / "d", {"a.bin": GOOD, "a.npy": GOOD})},
        r"a\.bin and .*a\.npy would both be written as a\.json; rename one",
    ),
    "one of a folder": (
        lambda t: {"path": folder_of(t / "d", {"0.bin": GOOD, "1.bin": GOOD[:-1]})},
        r"1\.bin has 9599 bytes",
    ),
    "missing weights": (lambda t: {"weights": t / "w.safetensors"}, r"w\.safetensors is no file; check the path"),
    "cut weights": (
        lambda t: {"weights": cut(t / "small.safetensors", 2000)},
        r"no complete safetensors file .* again",
    ),
    "unknown weights": (lambda t: {"weights": "best"}, r"'best' names no bundled weights \(.*\); give the path"),
    "code in weights": (
        lambda t: {"weights": evil_pth(t / "evil.pth")},
        r"asks to run `\w+\.system`.* source you trust",
    ),
    "no torch file": (lambda t: {"weights": write(t / "x.pth", b"junk")}, r"x\.pth is damaged or is no PyTorch"),
    "another config": (lambda t: {"preset": "car"}, r"holds weights for another config: .*; leave out --preset"),
    "threshold": (lambda t: {"score-threshold": 1.5}, r"score_threshold: 1\.5 is outside \[0, 1\)\."),
    "out is a file": (
        lambda t: {"out": write(t / "file", b"")},
        r"file cannot be a folder, as .*file is a file; choose",
    ),
    "out below a file": (
        lambda t: {"out": write(t / "file", b"") / "a" / "b"},
        r"a/b cannot be a folder, as .*file is",
    ),
    "no calibration": (
        lambda t: {"calib": write(t / "calib" / "other.txt", b"").parent},
        r"calib/good\.txt does not exist, so .*good\.bin has no calibration; add it",
    ),
    "bad calibration": (lambda t: {"calib": write(t / "c.txt", b"P2: 1 2\n")}, r"c\.txt, line P2: not the 12 numbers"),
    "unknown camera": (
        lambda t: {"calib": write(t / "c.txt", CALIBRATION.encode())},
        r"c\.txt has a focal length of 300 pixels.*; give it with --image-size WIDTH HEIGHT\.",
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
    assert not Path("/tmp/ciassd_test_was_here").exists()


def test_a_released_safetensors_is_for_convert_only(run: Any, tmp_path: Path) -> None:
    write_bin(tmp_path / "good.bin", small_cloud())
    safetensors.numpy.save_file(released_state(), tmp_path / "released.safetensors")
    arguments = (tmp_path / "good.bin", "--weights", tmp_path / "released.safetensors", "--out", tmp_path / "out")
    result = run("predict", *arguments)
    assert (result.code, result.out) == (2, "")
    assert re.search(r"make a file of ours with `ciassd convert \S+ OUT\.safetensors`", result.err)


def test_a_failed_write_leaves_no_part_of_a_file(run: Any, weights: Path, tmp_path: Path, monkeypatch: Any) -> None:
    def full(self: Path, text: str, **options: Any) -> int:
        self.write_bytes(text[:10].encode())
        raise OSError(28, "No space left on device")

    write_bin(tmp_path / "a.bin", small_cloud())
    monkeypatch.setattr(Path, "write_text", full)
    result = run("predict", tmp_path / "a.bin", "--weights", weights, "--out", tmp_path / "out")
    assert result.code == 2
    assert re.fullmatch(r"error: \S+a\.json cannot be written \(No space left on device\); choose .*\n", result.err)
    assert files(tmp_path / "out") == []


def test_a_mistake_of_ours_keeps_its_traceback(run: Any, weights: Path, tmp_path: Path, monkeypatch: Any) -> None:
    def broken(*arguments: Any, **options: Any) -> None:
        raise ValueError("shapes do not match")

    write_bin(tmp_path / "a.bin", small_cloud())
    monkeypatch.setattr("ciassd_jax.inference.detector.Detector.detect", broken)
    with pytest.raises(ValueError, match="shapes do not match"):
        run("predict", tmp_path / "a.bin", "--weights", weights, "--out", tmp_path / "out")


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


def test_convert_reports_every_tensor_and_predict_needs_nothing_else(run: Any, tmp_path: Path) -> None:
    source = write_pth(tmp_path / "released.pth", {"state_dict": released_state(iou=(1, True), counters=True)})
    result = run("convert", source, tmp_path / "new" / "ours.safetensors")
    assert (result.code, result.err) == (0, "")
    *rows, summary = result.out.splitlines()
    assert len(rows) == 176
    assert re.fullmatch(
        r"transposed +neck\.w_0\.0\.weight +params/neck/spatial_attention/kernel +\(1, 128, 1, 1\)",
        next(row for row in rows if "neck.w_0.0.weight" in row),
    )
    assert summary.startswith(f"Wrote {tmp_path / 'new' / 'ours.safetensors'}: 148 tensors; 28 counters")
    assert files(tmp_path / "new") == ["ours.safetensors"]
    converted = load_weights(tmp_path / "new" / "ours.safetensors")
    assert (converted.config.head.iou_kernel, converted.config.head.iou_bias) == (1, True)
    kernel = released_state(iou=(1, True))["neck.w_0.0.weight"].transpose(2, 3, 1, 0)
    np.testing.assert_array_equal(converted.variables["params"]["neck"]["spatial_attention"]["kernel"], kernel)


def test_convert_refuses_what_it_must(run: Any, weights: Path, tmp_path: Path) -> None:
    path = tmp_path / "released.safetensors"
    safetensors.numpy.save_file(released_state(), path)
    before = path.read_bytes()
    for source, target, message in [
        (path, tmp_path / "out.npz", "out.npz must end in .safetensors"),
        (path, path, "released.safetensors is the input itself; name another output"),
        (path, weights / "out.safetensors", "small.safetensors cannot be a folder, as "),
        (weights, tmp_path / "out.safetensors", "is already a file of ours"),
        (tmp_path / "none.pth", tmp_path / "out.safetensors", "does not exist; check the path"),
        (evil_pth(tmp_path / "evil.pth"), tmp_path / "out.safetensors", "asks to run"),
    ]:
        result = run("convert", source, target)
        assert result.code == 2
        assert result.err.startswith("error: ")
        assert message in result.err
        assert result.err.count("\n") == 1
    assert path.read_bytes() == before
    assert files(tmp_path) == ["evil.pth", "released.safetensors", "small.safetensors"]


def test_info_counts_parameters_and_arithmetic(run: Any, weights: Path) -> None:
    result = run("info", "--weights", weights, "--points", 1000, "--json")
    assert (result.code, result.err) == (0, "")
    facts = json.loads(result.out)
    assert facts["config"] == json.loads(small_config().to_json())
    # Convolutions, then scale and bias of each BatchNorm; the voxels' 4 numbers come in.
    kernels = [27 * 4 * 4, 27 * 4 * 8, 27 * 8 * 8, 3 * 8 * 8]
    assert facts["parameters"]["backbone"] == sum(kernels) + 2 * (4 + 8 + 8 + 8)
    capacities = [2048, 2048, 2048, 1024]
    assert facts["flops"]["backbone"] == sum(2 * k * n for k, n in zip(kernels, capacities, strict=True))
    # Box, class, direction and IoU of two anchors on 16 channels, on 64 x 64 cells.
    assert facts["parameters"]["head"] == 2 * (7 + 1 + 2 + 1) * 17
    assert facts["flops"]["head"] == 2 * 2 * (7 + 1 + 2 + 1) * 16 * 64 * 64
    full = [9 * 40 * 16, 9 * 16 * 16, 9 * 16 * 16, 16 * 16, 9 * 16 * 16, 9 * 16 * 16, 9 * 16, 9 * 16]
    half = [9 * 16 * 32, 9 * 32 * 32, 9 * 32 * 32, 32 * 32, 9 * 32 * 16, 9 * 32 * 16]
    assert facts["flops"]["neck"] == 2 * 64 * 64 * sum(full) + 2 * 32 * 32 * sum(half)
    for part in ("parameters", "flops"):
        assert facts[part]["total"] == sum(facts[part][name] for name in ("backbone", "neck", "head"))
    assert facts["memory"]["platform"] == "cpu"
    assert min(facts["memory"][name] for name in ("arguments", "outputs", "temporaries")) > 0


def test_info_for_readers_names_the_capacity_and_the_platform(run: Any, weights: Path) -> None:
    result = run("info", "--weights", weights, "--points", 1000)
    assert "at full capacity" in result.out
    assert re.search(r"backbone +\d[\d,]* parameters +\d+\.\d\d GFLOP", result.out)
    assert re.search(r"Compiled for cpu and up to 1000 points: arguments \d+\.\d MB, outputs ", result.out)


def test_info_of_a_preset_needs_no_weights(run: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr("ciassd_jax.inference.cost.compiled_memory", lambda config, points: {"platform": "none"})
    facts = json.loads(run("info", "--preset", "tiny", "--json").out)
    assert facts["config"] == json.loads(tiny().to_json())


def test_demo_detects_in_simulated_streets(run: Any, weights: Path, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("ciassd_jax.cli.demo.open_synthetic", partial(open_synthetic, lidar=SMALL_LIDAR))
    result = run("demo", "--weights", weights, "--scenes", "2", "--seed", "3")
    assert result.code == 0
    assert len(re.findall(r"^street_\d: \d+ points, \d+ objects in its label\n\d+ detections", result.out, re.M)) == 2
    names = ["street_0.json", "street_0.png", "street_1.json", "street_1.png", "view.html"]
    assert files(tmp_path / "ciassd_demo") == names
    last = result.out.splitlines()[-1]
    assert all(f"ciassd_demo/{name}" in last for name in names)


def test_demo_of_a_file_and_weights_of_your_own(run: Any, weights: Path, tmp_path: Path) -> None:
    write_bin(tmp_path / "street.bin", small_cloud())
    result = run("demo", tmp_path / "street.bin", "--weights", weights, "--out", tmp_path / "out")
    assert (result.code, result.err) == (0, "")
    assert "label" not in result.out
    assert files(tmp_path / "out") == ["street.json", "street.png", "view.html"]


def test_demo_of_no_scenes_is_refused(run: Any) -> None:
    result = run("demo", "--scenes", "0")
    assert (result.code, result.err) == (2, "error: --scenes 0 shows nothing; ask for at least 1.\n")


def test_demo_without_pictures_names_the_extra(run: Any, weights: Path, tmp_path: Path, monkeypatch: Any) -> None:
    write_bin(tmp_path / "street.bin", small_cloud())
    for library in ("matplotlib", "plotly"):
        monkeypatch.setitem(sys.modules, library, None)
    result = run("demo", tmp_path / "street.bin", "--weights", weights, "--out", tmp_path / "out")
    assert result.code == 0
    assert result.out.count("pip install 'ciassd_jax[viz]'") == 2
    assert files(tmp_path / "out") == ["street.json"]


def test_the_module_is_the_program(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "ciassd_jax"]
    helped = subprocess.run([*command, "--help"], capture_output=True, text=True)
    assert (helped.returncode, helped.stderr) == (0, "")
    assert all(name in helped.stdout for name in ("predict", "convert", "info", "demo"))
    arguments = ["predict", tmp_path / "none.bin", "--weights", "w.pth", "--out", tmp_path / "out"]
    failed = subprocess.run([*command, *arguments], capture_output=True, text=True)
    assert failed.returncode == 2
    assert failed.stderr == f"error: {tmp_path / 'none.bin'} does not exist; check the path.\n"


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
