"""`Detector`: inputs, results, compilation and warnings."""

import re
import subprocess
import sys
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small import random_variables, small_cloud, small_config

from ciassd_jax import Boxes, Detections, Detector, PointCloud, save_weights
from ciassd_jax.config import InputConfig, LossConfig, ScheduleConfig
from ciassd_jax.formats.errors import DroppedWarning, FormatWarning, InputError
from ciassd_jax.inference.results import FrameResult
from ciassd_jax.types import Counts


@pytest.fixture
def detector() -> Detector:
    return Detector(random_variables(small_config()), small_config())


@pytest.fixture
def quiet() -> Iterator[None]:
    """Ignore the warning that the small network drops candidates."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*: dropped .* candidates", DroppedWarning)
        yield


def drops(caught: Any) -> str:
    return "\n".join(str(w.message) for w in caught if w.category is DroppedWarning)


@pytest.mark.smoke
@pytest.mark.usefixtures("quiet")
def test_one_cloud_gives_one_result(detector: Detector) -> None:
    result = detector(small_cloud())
    assert isinstance(result, FrameResult)
    assert len(result) > 0
    assert result.boxes.shape == (len(result), 7)
    assert result.scores.shape == (len(result),)
    assert result.labels == ("Car",) * len(result)
    assert (np.abs(result.boxes[:, 6]) <= np.pi).all()
    assert result.seconds > 0
    assert result.counts["points"]["given"] == len(small_cloud())
    assert [set(stage) for stage in result.counts["sites"]] == [{"kept", "dropped"}] * 2


@pytest.mark.usefixtures("quiet")
def test_several_clouds_give_a_list_and_batches_change_no_result(detector: Detector) -> None:
    clouds = [small_cloud(0), small_cloud(1, 50), np.zeros((0, 4), np.float32), small_cloud(2), small_cloud(3, 900)]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".* has no points", DroppedWarning)
        alone = [detector(cloud) for cloud in clouds]
        # Five clouds in batches of two: the last one is filled with an empty cloud.
        each, batched = detector(clouds), detector(iter(clouds), batch_size=2)
    assert min(len(result) for result in (alone[0], alone[3], alone[4])) > 0
    for one, same, other in zip(alone, each, batched, strict=True):
        assert_same(same, one, 0)
        assert_same(other, one, 1e-5)
        assert other.seconds > 0
    assert detector([]) == detector(iter([]), batch_size=4) == []


def assert_same(result: FrameResult, expected: FrameResult, tolerance: float) -> None:
    np.testing.assert_allclose(result.boxes, expected.boxes, rtol=0, atol=tolerance)
    np.testing.assert_allclose(result.scores, expected.scores, rtol=0, atol=tolerance)
    assert (result.labels, result.counts) == (expected.labels, expected.counts)


def test_clouds_are_taken_as_they_are_needed(detector: Detector, monkeypatch: pytest.MonkeyPatch) -> None:
    taken, batches = [], []
    clouds = (taken.append(index) or small_cloud(index, 9) for index in range(5))
    monkeypatch.setattr(Detector, "_detect", lambda self, batch, size: batches.append((len(taken), len(batch))) or [])
    detector(clouds, batch_size=2)
    assert batches == [(2, 2), (4, 2), (5, 1)]


@pytest.mark.usefixtures("quiet")
def test_every_cloud_may_have_its_own_frustum(detector: Detector) -> None:
    clouds, everything = [small_cloud(0), small_cloud(1), small_cloud(2)], detector(small_cloud(1))
    middle = np.median(everything.boxes[:, 0]) + 0.01
    far = np.tile([1.0, 0.0, 0.0, -middle], (6, 1))
    results = detector(clouds, frustum=[None, far, None], batch_size=2)
    assert_same(results[0], detector(clouds[0]), 1e-5)
    assert_same(results[1], detector(clouds[1], frustum=far), 1e-5)
    for one, same in zip(
        detector(clouds, frustum=far), [detector(cloud, frustum=far) for cloud in clouds], strict=True
    ):
        assert_same(one, same, 0)
    assert 0 < len(results[1]) < len(everything)


@pytest.mark.usefixtures("quiet")
def test_a_message_names_its_cloud(detector: Detector) -> None:
    bright = small_cloud(1)
    bright[7, 3] = 4
    far = small_cloud(2) + np.float32([500, 0, 0, 0])
    with pytest.warns() as caught:
        detector([small_cloud(0), bright, far, bright], source=["a.bin", "b.bin", "c.bin", "d.bin"], batch_size=2)
    told = [str(one.message) for one in caught if "candidates" not in str(one.message)]
    assert [text.split(":")[0] for text in told] == ["b.bin", "d.bin", "c.bin"]
    with pytest.raises(ValueError, match=r"^Cloud 1: points have the shape \(5, 3\); give \[N, 4\]"):
        detector([small_cloud(), np.zeros((5, 3), np.float32)], batch_size=2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch_size": 0}, "batch_size is 0; give a whole number of at least 1"),
        ({"batch_size": 1.5}, "batch_size is 1.5; give a whole number of at least 1"),
        ({"frustum": [None]}, r"points, frustum and source differ in length \(2 and 1\); give one of each"),
        ({"frustum": np.zeros((5, 4))}, r"Cloud 0: its frustum has the shape \(5, 4\); give the planes \[6, 4\]"),
        ({"source": ["a", "b", "c"]}, r"differ in length \(2 and 3\)"),
        ({"source": "ab"}, r"differ in length \(2 and 1\)"),
    ],
)
@pytest.mark.usefixtures("no_type_checks")
def test_what_cannot_be_a_batch_is_refused(detector: Detector, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"^.*{message}"):
        detector([small_cloud(0), small_cloud(1)], **options)


def test_warnings_point_to_the_line_of_the_caller(tmp_path: Path) -> None:
    """Without the type checker of the tests, which adds calls."""
    script = tmp_path / "script.py"
    script.write_text(WARNING_SCRIPT)
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    kinds = done.stdout.splitlines()
    assert set(kinds) == {f"{kind} {script} detector(" for kind in ("DroppedWarning", "FormatWarning")}
    assert len(kinds) >= 6


# Reports the line of every warning; nothing is compiled.
WARNING_SCRIPT = """
import linecache, warnings
import numpy as np
import jax
from ciassd_jax import Detections, Detector, tiny
from ciassd_jax.model.network import variable_shapes
from ciassd_jax.types import Boxes, Counts

def none_found(variables, cloud, frustum):
    none, stages = np.zeros(len(cloud.count), int), np.zeros((len(cloud.count), 3), int)
    boxes = Boxes(*(np.zeros((len(none), 2, n)) for n in (3, 3)), np.zeros((len(none), 2)))
    counts = Counts(cloud.count, none, none, none, none + 1, stages, stages, none, none)
    return Detections(boxes, np.zeros((len(none), 2)), np.zeros((len(none), 2), int), none, counts)

Detector.compile = lambda *_: none_found
config = tiny()
detector = Detector(jax.tree.map(lambda leaf: np.zeros(leaf.shape), variable_shapes(config)), config)
points = np.random.default_rng(0).uniform([0, -6, -1, 0], [12, 6, 1, 1], (600, 4))
points[3, 3] = 4
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    detector(points)
    detector([points, points[:0]])
    detector([points, points[:0]], batch_size=3)
for one in caught:
    line = linecache.getline(one.filename, one.lineno).strip()
    print(one.category.__name__, one.filename, line[:9])
"""


@pytest.mark.usefixtures("quiet")
def test_jax_arrays_and_other_number_types_are_accepted(detector: Detector) -> None:
    expected = detector(small_cloud())
    for points in (jnp.asarray(small_cloud()), small_cloud().astype(np.float64)):
        np.testing.assert_array_equal(detector(points).boxes, expected.boxes)


@pytest.mark.usefixtures("quiet")
def test_a_frustum_drops_what_no_camera_sees(detector: Detector) -> None:
    everything = detector(small_cloud())
    middle = np.median(everything.boxes[:, 0]) + 0.01
    seen = detector(small_cloud(), frustum=np.tile([1.0, 0.0, 0.0, -middle], (6, 1)))
    np.testing.assert_array_equal(seen.boxes, everything.boxes[everything.boxes[:, 0] > middle])
    assert 0 < len(seen) < len(everything)


@pytest.mark.usefixtures("quiet")
def test_points_that_are_not_finite_are_dropped_and_named(detector: Detector) -> None:
    spoilt = small_cloud()
    spoilt[[3, 5, 8], [0, 2, 3]] = [np.nan, np.inf, np.nan]
    clean = np.delete(small_cloud(), [3, 5, 8], 0)
    with pytest.warns(DroppedWarning, match=r"^The cloud: dropped 3 of 600 points that are not finite") as caught:
        result = detector(spoilt)
    assert result.counts["points"]["dropped"] == 3
    assert "voxels" not in drops(caught)
    np.testing.assert_allclose(result.boxes, detector(clean).boxes, atol=1e-6)


@pytest.mark.usefixtures("quiet")
def test_a_single_intensity_out_of_range_is_clipped_and_named(detector: Detector) -> None:
    bright, clipped = small_cloud(), small_cloud()
    bright[7, 3], clipped[7, 3] = 4, 1
    with pytest.warns(FormatWarning, match=r"^The cloud: 1 of 600 intensities were clipped to \[0, 1\]\.$"):
        result = detector(bright)
    assert result.counts["points"]["clipped"] == 1
    np.testing.assert_array_equal(result.boxes, detector(clipped).boxes)


@pytest.mark.usefixtures("quiet")
def test_intensities_of_another_scale_are_refused_until_the_scale_is_given(detector: Detector, tmp_path: Path) -> None:
    byte = np.round(small_cloud() * 64) / 64 * np.float32([1, 1, 1, 256])
    with pytest.raises(
        InputError, match=r"^The cloud has 9\d\.\d % of its intensities .*; pass .* as `intensity_scale`"
    ):
        detector(byte)
    save_weights(tmp_path / "small.safetensors", random_variables(small_config()), small_config())
    of_bytes = Detector.from_pretrained(tmp_path / "small.safetensors", intensity_scale=256.0)
    assert of_bytes.config.input == InputConfig(intensity_scale=256.0)
    result = of_bytes(byte)
    np.testing.assert_array_equal(result.boxes, detector(byte / np.float32([1, 1, 1, 256])).boxes)


@pytest.mark.parametrize("points", [np.zeros((0, 4), np.float32), np.full((9, 4), 500, np.float32) * [1, 1, 1, 0]])
def test_nothing_in_range_gives_an_empty_result(detector: Detector, points: np.ndarray) -> None:
    told = "The cloud: dropped all 9 points, none of which is in range" if len(points) else "The cloud has no points"
    with pytest.warns(DroppedWarning, match=f"^{told}.$"):
        result = detector(points)
    assert len(result) == 0
    assert result.boxes.shape == (0, 7)
    assert result.counts["voxels"] == {"kept": 0, "dropped": 0}


def test_overflow_is_counted_and_named(detector: Detector) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([0, -6.4, -3, 0], [12.8, 6.4, 1, 1], (6000, 4)).astype(np.float32)
    with pytest.warns(DroppedWarning) as caught:
        counts = detector(points).counts
    message = drops(caught)
    assert f"{counts['voxels']['dropped']} voxels beyond the 2048 that fit (grid.max_voxels), with " in message
    assert f"{counts['points']['dropped']} points" in message
    assert f"{counts['sites'][0]['dropped']} sites of backbone stage 1 beyond the 2048 that fit" in message


def test_points_in_columns_are_to_be_transposed(detector: Detector) -> None:
    with pytest.raises(ValueError, match=r"points have the shape \(4, 600\); transpose them"):
        detector(small_cloud().T)


@pytest.mark.parametrize("shape", [(5, 3), (4,), (1, 5, 4)])
def test_another_shape_is_refused(detector: Detector, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=f"points have the shape {re.escape(str(shape))}; give \\[N, 4\\]"):
        detector(np.zeros(shape, np.float32))


def test_every_bucket_is_compiled_once(monkeypatch: pytest.MonkeyPatch) -> None:
    traced = []

    def nothing(variables: Any, cloud: PointCloud, *, config: Any, frustum: jax.Array) -> Detections:
        traced.append(cloud.points.shape)
        none = jnp.zeros_like(cloud.count)
        boxes = Boxes(jnp.zeros((1, 2, 3)), jnp.zeros((1, 2, 3)), jnp.zeros((1, 2)))
        stages = jnp.zeros((1, 2), jnp.int32)
        counts = Counts(cloud.count, cloud.count, none, none, none, stages, stages, none, none)
        # Read every argument, so that none is optimised away.
        total = cloud.points.sum() + frustum.sum() + sum(leaf.sum() for leaf in jax.tree.leaves(variables))
        return Detections(boxes, jnp.zeros((1, 2)) * total, jnp.zeros((1, 2), jnp.int32), none, counts)

    # A config of its own, as programs are kept.
    config = replace(small_config(), dtype="bfloat16")
    monkeypatch.setattr("ciassd_jax.inference.predict.predict", nothing)
    detector = Detector(random_variables(config), config)
    monkeypatch.setattr("ciassd_jax.inference.detector.SMALLEST_BUCKET", 64)
    for count in (1, 64, 63, 65, 256, 10, 257):
        assert detector(np.zeros((count, 4), np.float32)).counts["points"]["given"] == count
    assert traced == [(1, 64, 4), (1, 256, 4), (1, 1024, 4)]


def test_configs_that_differ_in_training_alone_share_a_program(detector: Detector) -> None:
    config = replace(small_config(), schedule=ScheduleConfig(learning_rate=1.0), loss=LossConfig(box_weight=1.0))
    other = Detector(random_variables(config, 1), config)
    assert other.config == config != detector.config
    assert other.compile(10) is detector.compile(20)


def test_repr_is_short_and_readable() -> None:
    box = np.array([[10.0, -2.5, -0.9, 3.9, 1.6, 1.5, 0.1]], np.float32)
    result = FrameResult(box.repeat(12, 0), np.linspace(0.9, 0.4, 12), ("Car",) * 12, {}, 0.1234)
    lines = repr(result).splitlines()
    assert lines[0] == "12 detections in 123 ms"
    assert lines[1] == "  Car        0.90  at ( 10.00,  -2.50, -0.90)  3.90 x 1.60 x 1.50 m  yaw +0.10"
    assert lines[-1] == "  ... and 2 more"
    assert len(lines) == 12
    assert max(map(len, lines)) <= 100


def test_from_pretrained_reads_a_file(tmp_path: Path) -> None:
    config = small_config()
    save_weights(tmp_path / "w.safetensors", random_variables(config), config)
    loaded = Detector.from_pretrained(tmp_path / "w.safetensors")
    assert loaded.config == config


def test_from_pretrained_names_the_available_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ciassd_jax.inference.weights.BUNDLED", tmp_path)
    with pytest.raises(InputError, match=r"'car_best' \(available: none\); .*the path"):
        Detector.from_pretrained("car_best")
    config = small_config()
    save_weights(tmp_path / "small.safetensors", random_variables(config), config)
    with pytest.raises(InputError, match=r"'car_best' \(available: small\)"):
        Detector.from_pretrained("car_best")
    assert Detector.from_pretrained("small").config == config


@pytest.mark.usefixtures("quiet")
def test_a_result_draws_itself(detector: Detector) -> None:
    result = detector(small_cloud())
    figure = result.plot_bev(small_cloud())
    assert f"detected ({len(result)})" in [t.get_text() for t in figure.axes[0].get_legend().get_texts()]
