"""Exported detectors: the same boxes as a `Detector`, with and without the package, and files that are refused."""

import inspect
import io
import json
import subprocess
import sys
import textwrap
import warnings
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from jax import export as jax_export
from small import CALIBRATION, IMAGE_SIZE, random_variables, small_cloud, small_config

from ciassd_jax import Detector, export_predict, load_exported, load_weights
from ciassd_jax.formats.errors import DroppedWarning, InputError
from ciassd_jax.formats.kitti_camera import frustum_of, read_camera
from ciassd_jax.inference import artefact as files
from ciassd_jax.inference import export
from ciassd_jax.inference.artefact import Golden, misfit
from ciassd_jax.inference.weights import find_weights

POINTS, BATCH = 640, 2
INPUTS = [("points", [BATCH, POINTS, 4], "float32"), ("count", [BATCH], "int32"), ("frustum", [BATCH, 6, 4], "float32")]


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """Ignore the warning that the small network drops candidates."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*dropped .* candidates", DroppedWarning)
        yield


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("exported") / "car.ciassd"
    with pytest.MonkeyPatch.context() as patch:
        # Streets that need no simulation.
        patch.setattr(export, "_street", lambda index, config, num_points: small_cloud(index))
        export_predict(random_variables(small_config()), small_config(), path, num_points=POINTS, batch=BATCH)
    return path


@pytest.fixture(scope="module")
def exported(path: Path) -> export.ExportedDetector:
    return load_exported(path)


@pytest.fixture(scope="module")
def detector() -> Detector:
    return Detector(random_variables(small_config()), small_config())


def assert_same(found: Any, expected: Any) -> None:
    assert len(found) > 0
    np.testing.assert_allclose(found.boxes, expected.boxes, rtol=0, atol=1e-5)
    np.testing.assert_allclose(found.scores, expected.scores, rtol=0, atol=1e-5)
    assert (found.labels, found.counts) == (expected.labels, expected.counts)


@pytest.mark.smoke
def test_a_cloud_gives_the_result_of_the_detector(exported: Any, detector: Detector) -> None:
    assert_same(exported(small_cloud(5)), detector(small_cloud(5)))


def test_batches_are_filled_with_empty_clouds(exported: Any, detector: Detector) -> None:
    clouds = [small_cloud(seed, 600 - 100 * seed) for seed in range(3)]
    found = exported(clouds)
    assert len(found) == 3
    for mine, cloud in zip(found, clouds, strict=True):
        assert_same(mine, detector(cloud))
    assert exported([]) == []


def test_a_frustum_drops_boxes_as_in_the_detector(exported: Any, detector: Detector, tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_text(CALIBRATION.replace("320", "80"))
    planes = frustum_of(read_camera(tmp_path / "calib.txt", image_size=(IMAGE_SIZE[0] // 4, IMAGE_SIZE[1])))
    seen = exported(small_cloud(), frustum=planes)
    assert 0 < len(seen) < len(exported(small_cloud()))
    assert_same(seen, detector(small_cloud(), frustum=planes))


def test_the_program_is_compiled_once(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    loaded = load_exported(path)
    loaded(small_cloud())
    assert capsys.readouterr().err == f"Compiling the exported predict for {BATCH} x {POINTS} points, once.\n"
    assert loaded.config.class_names == ("Car",)


def test_input_is_checked_as_by_the_detector(exported: Any) -> None:
    with pytest.raises(ValueError, match=r"points have the shape \(5, 3\); give \[N, 4\]"):
        exported(np.zeros((5, 3), np.float32))
    with pytest.raises(InputError, match=r"% of its intensities .*`intensity_scale`"):
        exported(small_cloud() * np.array([1, 1, 1, 255], np.float32))
    with pytest.warns(DroppedWarning, match="has no points"):
        assert len(exported(np.zeros((0, 4), np.float32))) == 0


def test_a_larger_cloud_or_batch_is_refused(exported: Any) -> None:
    with pytest.raises(ValueError, match=f"641 points exceeds the {POINTS} of .*; export it with `num_points` 641"):
        exported(small_cloud(count=641))
    with pytest.raises(ValueError, match=f"3 clouds exceed the exported batch of {BATCH}; .*`batch` 3"):
        exported([small_cloud()] * 3, batch_size=3)
    assert len(exported([small_cloud()], batch_size=3)) == 1


def test_the_manifest_describes_the_program(path: Path, exported: Any) -> None:
    manifest = exported.manifest
    assert [(one["name"], one["shape"], one["type"]) for one in manifest["inputs"]] == INPUTS
    with zipfile.ZipFile(path) as archive:
        assert json.loads(archive.read("manifest.json")) == manifest
        program = jax_export.deserialize(bytearray(archive.read("program.bin")))
    assert list(program.platforms) == manifest["platforms"] == ["cpu", "cuda", "tpu"]
    found = program.call(*(np.zeros(one["shape"], one["type"]) for one in manifest["inputs"]))
    # A dictionary's leaves are in the order of its names, as are the results of the StableHLO program.
    assert [one["name"] for one in manifest["outputs"]] == sorted(found)
    for one in manifest["outputs"]:
        assert (list(found[one["name"]].shape), found[one["name"]].dtype.name) == (one["shape"], one["type"])
        assert 0 < len(one["meaning"]) < 100
    assert json.loads(small_config().to_json()) == manifest["config"]
    assert manifest["versions"]["jax"] == jax.__version__
    assert manifest["calling_convention_version"] == program.calling_convention_version


def test_the_snippet_runs_without_the_package(path: Path, exported: Any, tmp_path: Path) -> None:
    text = inspect.getdoc(export) or ""
    snippet = textwrap.dedent(text[text.index("    import json") : text.index("The manifest gives")])
    assert len(snippet.strip().splitlines()) <= 15
    (tmp_path / "car_lite.ciassd").write_bytes(path.read_bytes())
    small_cloud(5).tofile(tmp_path / "000010.bin")
    code = f"{snippet}\nimport sys\nassert 'ciassd_jax' not in sys.modules\n"
    run = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True, capture_output=True, text=True)
    expected = exported(small_cloud(5))
    rows = "".join(run.stdout.replace("[", " ").replace("]", " ")).split()
    assert rows[::9] == ["Car"] * len(expected)
    numbers = np.array([row for row in rows if row != "Car"], float).reshape(-1, 8)
    np.testing.assert_allclose(numbers[:, 0], expected.scores, rtol=0, atol=1e-4)
    np.testing.assert_allclose(numbers[:, 1:], expected.boxes, rtol=0, atol=0.006)


def test_members_have_no_date(path: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        assert {one.date_time for one in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
        assert [one.filename for one in archive.infolist()] == ["manifest.json", "program.bin", "golden.npz"]


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"batch": 0}, "`batch` is 0; both must be at least 1"),
        ({"num_points": 0}, "`num_points` is 0"),
        ({"platforms": ()}, "choose from cpu, cuda, tpu"),
        ({"platforms": ("gpu",)}, "'gpu'.*choose from cpu, cuda, tpu"),
    ],
)
def test_impossible_exports_are_refused(options: Any, match: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=match):
        export_predict(random_variables(small_config()), small_config(), tmp_path / "no.ciassd", **options)
    assert not list(tmp_path.iterdir())


def changed_copy(path: Path, target: Path, name: str, change: Callable[[bytes], bytes | None], **options: Any) -> Path:
    """Copy an artefact with one of its members changed, or left out."""
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(target, "w", **options) as archive:
        for one in source.namelist():
            content = change(source.read(one)) if one == name else source.read(one)
            if content is not None:
                archive.writestr(one, content)
    return target


def in_manifest(**values: Any) -> Callable[[bytes], bytes]:
    return lambda content: json.dumps(json.loads(content) | values).encode()


def in_golden(name: str, value: Any) -> Callable[[bytes], bytes]:
    def change(content: bytes) -> bytes:
        stream = io.BytesIO()
        with np.load(io.BytesIO(content)) as arrays:
            np.savez(stream, **(dict(arrays) | {name: value}))
        return stream.getvalue()

    return change


@pytest.mark.parametrize(
    ("name", "change", "match"),
    [
        ("program.bin", lambda content: None, r"is no exported detector \(There is no item named 'program.bin'"),
        ("manifest.json", lambda content: b"{", r"has a damaged manifest.json \("),
        ("manifest.json", lambda content: b"[]", r"has a damaged manifest.json \("),
        ("manifest.json", in_manifest(format="zip"), r"has a damaged manifest.json \(its format is 'zip'"),
        (
            "manifest.json",
            in_manifest(format_version=2),
            "has version 2 of the format, and ciassd_jax .* reads version 1",
        ),
        ("manifest.json", in_manifest(config={"grid": 1}), r"has a damaged manifest.json \(config.grid"),
        ("manifest.json", in_manifest(inputs=[]), r"does not describe its program \(inputs differ"),
        ("manifest.json", in_manifest(outputs=[{"name": 1}]), "does not describe its program"),
        ("manifest.json", in_manifest(class_names=["Van"]), r"does not describe its program \(class_names differ"),
        ("manifest.json", in_manifest(platforms=["cpu"]), r"does not describe its program \(platforms differ"),
        ("program.bin", lambda content: content[: len(content) // 2], "has a program.bin that JAX .* cannot read"),
        ("program.bin", lambda content: b"", "has a program.bin that JAX .* cannot read"),
        ("golden.npz", lambda content: b"npz", r"has a damaged golden.npz \(File is not a zip file"),
        (
            "golden.npz",
            in_golden("inputs.count", np.zeros(10**6)),
            r"golden.npz \(inputs.count.npy has the shape \(1000",
        ),
        ("golden.npz", in_golden("outputs.score", np.array([{}])), r"golden.npz \(outputs.score.npy has .*object"),
    ],
)
def test_damaged_files_are_refused(path: Path, tmp_path: Path, name: str, change: Any, match: str) -> None:
    bad = changed_copy(path, tmp_path / "bad.ciassd", name, change)
    with pytest.raises(InputError, match=match) as error:
        load_exported(bad)
    assert str(error.value).startswith(str(bad))
    assert str(error.value).endswith("write it again with `ciassd export`.")


def test_a_compressed_member_is_not_unpacked(path: Path, tmp_path: Path) -> None:
    bomb = changed_copy(path, tmp_path / "b", "program.bin", lambda _: bytes(10**7), compression=zipfile.ZIP_DEFLATED)
    with pytest.raises(InputError, match=r"is no exported detector \(manifest.json is compressed\)"):
        load_exported(bomb)


def test_other_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("text")
    with pytest.raises(InputError, match=r"text is no exported detector \(File is not a zip file\); write it again"):
        load_exported(tmp_path / "text")
    with pytest.raises(InputError, match="does not exist; check the path"):
        load_exported(tmp_path / "absent")


def test_a_changed_golden_output_is_refused(path: Path, exported: Any, tmp_path: Path) -> None:
    score = files.read_artefact(path).golden.outputs["score"].copy()
    score[1, 0] += 0.25
    bad = changed_copy(path, tmp_path / "bad.ciassd", "golden.npz", in_golden("outputs.score", score))
    with pytest.raises(
        InputError, match=r"golden output here: score differs by up to 0.25 where 0.001 is allowed; write"
    ):
        load_exported(bad)


def test_a_program_for_other_platforms_is_refused(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax_export, "default_export_platform", lambda: "rocm")
    with pytest.raises(
        InputError, match=r"for cpu, cuda, tpu, and JAX runs on rocm here; write .* and --platforms rocm"
    ):
        load_exported(path)


def test_the_golden_output_is_compared_with_its_tolerance() -> None:
    boxes = np.array([[[10, 2, -1, 4, 2, 1.5, np.pi - 1e-4]]], np.float32)
    golden = Golden({}, {"boxes": boxes, "count": np.array([1], np.int32)}, 1e-3)
    same = golden.outputs
    assert misfit(same, golden) is None
    # The other side of pi, and half the tolerance.
    turned = boxes + np.array([0, 0, 0, 0, 0, 0, 2e-4 - 2 * np.pi], np.float32)
    assert misfit(same | {"boxes": turned}, golden) is None
    assert misfit(same | {"boxes": boxes + np.float32(5e-4)}, golden) is None
    assert (
        misfit(same | {"boxes": boxes * np.float32(1.1)}, golden) == "boxes differs by up to 1 where 0.001 is allowed"
    )
    assert misfit(same | {"boxes": boxes * np.float32(np.nan)}, golden) == (
        "boxes differs by up to inf where 0.001 is allowed"
    )
    assert misfit(same | {"count": np.array([2], np.int32)}, golden) == "count differs by up to 1 where 0 is allowed"


@pytest.mark.slow
def test_the_golden_street_of_the_bundled_weights_has_boxes(tmp_path: Path) -> None:
    weights = load_weights(find_weights("car_lite"))
    golden = export_predict(weights.variables, weights.config, tmp_path / "a", platforms=("cpu",)).golden
    assert int(golden.outputs["count"][0]) > 3
    street = export._street(0, small_config(), 100)
    assert len(street) <= 100
    assert (np.abs(street[:, 2] - small_config().ground) < 0.3).mean() > 0.5
