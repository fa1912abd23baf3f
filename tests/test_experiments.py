"""Each table and figure of the paper with trainings of two steps, and what the runner refuses."""

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
import run
from experiment_report import to_text
from measuring import decode_all, nearest_overlap
from mini_folders import NAMES
from mini_training import write_data
from PIL import Image
from small import IMAGE_SIZE, random_variables, small_config

from ciassd_jax import Boxes, Config, open_dataset, save_weights
from ciassd_jax.config import AugmentationConfig
from ciassd_jax.evaluation.breakdown import pearson
from ciassd_jax.training import loop

TABLES = ["table3_data", "table4_modules", "table5_beta", "table6_runtime", "figure4_iou_scatter", "figure5_snapshots"]
BUDGET = ["--preset", "tiny", "--budget", "2", "--batch-size", "2"]


def mini_preset() -> Config:
    """A config of which some boxes pass the threshold after two steps."""
    config = small_config()
    return replace(
        config,
        data=replace(config.data, max_points=1024, max_gt_sampling_points=512),
        detection=replace(config.detection, score_threshold=0.05, nms="paper"),
        classes=(replace(config.classes[0], support_threshold=0.1),),
    )


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = write_data(tmp_path_factory.mktemp("data"))
    for name in NAMES:
        Image.new("RGB", IMAGE_SIZE, "grey").save(root / f"training/image_2/{name}.png")
    return root


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One folder, so that the experiments share the training of the full network."""
    return tmp_path_factory.mktemp("results")


@pytest.fixture(autouse=True)
def preset() -> Iterator[None]:
    """Programs that run a few times only are compiled quickly."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(run.PRESETS, "tiny", mini_preset)
        jax.config.update("jax_disable_most_optimizations", True)
        yield
        jax.config.update("jax_disable_most_optimizations", False)


def columns_of(path: Path) -> dict[str, list]:
    rows = json.loads(path.read_text())["rows"]
    return {name: [row[name] for row in rows] for name in rows[0]}


@pytest.mark.slow
@pytest.mark.parametrize("name", TABLES)
def test_it_runs_to_its_end(name: str, root: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run.main([name, "--data", str(root), "--out", str(out), *BUDGET]) == 0, capsys.readouterr().err
    page = (out / f"{name}.md").read_text()
    assert f"run.py {name} --data" in page
    columns = columns_of(out / f"{name}.json")
    for column in columns.values():
        assert f"| {to_text(column[0])} " in page
    pictures = re.findall(r"\]\((.*\.png)\)", page)
    assert pictures
    for picture in pictures:
        with Image.open(out / picture) as image:
            assert np.asarray(image.convert("L")).std() > 1
    if name == "figure5_snapshots":
        assert pictures == ["figure5_snapshots_000000_above.png", "figure5_snapshots_000000_image.png"]


@pytest.mark.slow
def test_the_memory_of_necks_is_of_their_programs(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two of the three necks: each takes two long compilations."""
    monkeypatch.delitem(run.memory_of_necks.NECKS, "ssfa")
    assert run.main(["memory_of_necks", "--out", str(out), "--preset", "tiny"]) == 0
    columns = columns_of(out / "memory_of_necks.json")
    assert columns["neck"] == ["SECOND's, the baseline", "SA-SSD's"]
    assert columns["predict more"][0] == columns["training step more"][0] == "+0 %"
    assert columns["training step, MB"][1] > columns["training step, MB"][0] > 0


@pytest.mark.slow
def test_a_switch_changes_its_part_alone(out: Path) -> None:
    assert run.main(["parts_of_variants", "--out", str(out), "--preset", "tiny"]) == 0
    columns = columns_of(out / "parts_of_variants.json")
    changed = dict(zip(columns["variant"], columns["other parameter trees"], strict=True))
    assert changed == {
        "the paper's": "none",
        "neck: SECOND's": "neck",
        # Its features have twice the channels.
        "neck: SA-SSD's": "neck, head",
        "no IoU branch": "head",
        "beta 0": "none",
        "rotated NMS": "none",
        "none of Table 3's data": "none",
    }
    assert len(set(columns["backbone, GFLOP"])) == 1


@pytest.mark.slow
def test_an_interrupted_run_resumes(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The run is killed after the first seed's training, which is not repeated."""
    command = ["figure4_iou_scatter", "--data", str(root), "--out", str(tmp_path), "--seeds", "2", *BUDGET]

    def killed(config: Config, batches: object, workdir: Path, **options: object) -> loop.Fitted:
        if "seed1" in str(workdir):
            raise KeyboardInterrupt
        return loop.fit(config, batches, workdir, **options)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr("study.fit", killed)
        with pytest.raises(KeyboardInterrupt):
            run.main(command)
    assert not (tmp_path / "figure4_iou_scatter.json").exists()
    first = (tmp_path / "trainings/full-seed0/metrics.jsonl").read_bytes()
    assert run.main(command) == 0
    assert "from step 2 " in capsys.readouterr().out
    assert (tmp_path / "trainings/full-seed0/metrics.jsonl").read_bytes() == first
    assert len(columns_of(tmp_path / "figure4_iou_scatter.json")["PCC with the 3D overlap"][0]) == 2


@pytest.mark.slow
def test_results_of_another_config_are_refused(
    root: Path, out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run.main(["parts_of_variants", "--out", str(tmp_path), "--preset", "tiny"]) == 0
    capsys.readouterr()
    assert run.main(["parts_of_variants", "--out", str(tmp_path), "--preset", "tiny", "--budget", "5"]) == 2
    error = capsys.readouterr().err
    assert all(part in error for part in ("settings.config.schedule.total_steps", "55680", " 5 ", "--out"))
    # A training of another config in the folder, results or not.
    other = [*BUDGET, "--learning-rate", "0.5"]
    assert run.main(["table5_beta", "--data", str(root), "--out", str(out), *BUDGET]) == 0
    (out / "table5_beta.json").unlink()
    assert run.main(["table5_beta", "--data", str(root), "--out", str(out), *other]) == 2
    assert "config.schedule.learning_rate" in capsys.readouterr().err


def test_what_cannot_be_run_is_one_sentence(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        run.main(["table9"])
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert all(name in error for name in run.EXPERIMENTS)
    monkeypatch.delenv("KITTI_ROOT", raising=False)
    weights = tmp_path / "weights.safetensors"
    save_weights(weights, random_variables(small_config()), small_config())
    for arguments, words in (
        (["table5_beta"], "KITTI_ROOT"),
        (["table5_beta", "--data", "nowhere"], "nowhere"),
        (["table4_modules", "--data", str(root), "--weights", str(weights)], "--weights"),
        (
            ["table5_beta", "--data", str(root), "--weights", str(weights), "--preset", "car"],
            "use the config of the file",
        ),
    ):
        assert run.main([*arguments, "--out", str(tmp_path / "out")]) == 2
        error = capsys.readouterr().err
        assert words in error
        assert len(error.splitlines()) == 1
    with pytest.raises(SystemExit):
        run.main(["table5_beta", "--seeds", "0"])


@pytest.mark.parametrize("name", ["figure4_iou_scatter", pytest.param("table5_beta", marks=pytest.mark.slow)])
def test_given_weights_are_measured_without_training(name: str, root: Path, tmp_path: Path) -> None:
    weights = tmp_path / "weights.safetensors"
    save_weights(weights, random_variables(mini_preset()), mini_preset())
    arguments = ["--data", str(root), "--out", str(tmp_path), "--weights", str(weights)]
    assert run.main([name, *arguments]) == 0
    assert not (tmp_path / "trainings").exists()
    columns = columns_of(tmp_path / f"{name}.json")
    if name == "table5_beta":
        assert columns["beta"] == list(range(7))
    else:
        assert len(columns["quantity"]) == 3


def test_table_3_has_all_switches() -> None:
    switches = {name for name, value in vars(AugmentationConfig()).items() if value is True}
    assert switches == set(filter(None, run.table3_data.ROWS.values()))


@pytest.mark.parametrize(
    ("precisions", "verdict"),
    [
        ((2.0, 30.0, 30.0), "is confirmed"),
        ((2.0, 30.0, 29.0), "is not confirmed: 3D R40 moderate falls with 'c'"),
        ((0.0, 0.4, 0.0), "is neither confirmed nor refuted"),
    ],
)
def test_the_order_of_table_4(precisions: tuple[float, ...], verdict: str) -> None:
    rows = [{"modules": name, "3D R40 moderate": [value]} for name, value in zip("abc", precisions, strict=True)]
    assert verdict in run.table4_modules.judge_order(rows)


def test_decoded_boxes_are_those_above_the_threshold(root: Path) -> None:
    """All of them, beyond the detector's capacity; and their confidence is the rectified one."""
    config = mini_preset()
    dataset = open_dataset(root, "val")
    few = replace(config, detection=replace(config.detection, max_candidates=1))
    decoded = decode_all(random_variables(config), few, dataset)
    assert len(decoded.overlap) > 16
    assert (decoded.probability >= config.detection.score_threshold).all()
    assert ((decoded.overlap >= 0) & (decoded.overlap <= 1)).all()
    np.testing.assert_array_equal(decoded.confidence(0), decoded.probability)
    np.testing.assert_allclose(decoded.confidence(2), decoded.probability * decoded.predicted_iou**2)


def test_the_overlap_is_that_with_the_nearest_object() -> None:
    truth = Boxes.from_array(np.array([[10.0, 0, 0, 4, 2, 2, 0], [20, 0, 0, 4, 2, 2, 0]]))
    boxes = Boxes.from_array(np.array([[11.0, 0, 0, 4, 2, 2, 0], [20, 0, 1, 4, 2, 2, 0], [14, 0, 0, 8.1, 2, 2, 0]]))
    # The nearest to the last one is the first: they share 2.05 m of 10.05 m along x.
    expected = [3 / 5, 1 / 3, 2.05 / 10.05]
    np.testing.assert_allclose(nearest_overlap(boxes, truth), expected, rtol=1e-9)


def test_correlation() -> None:
    values = np.array([0.1, 0.5, 0.4])
    assert pearson(values, 2 * values + 1) == pytest.approx(1)
    assert pearson(values, -values) == pytest.approx(-1)
    assert np.isnan(pearson(values, np.ones(3)))
    assert np.isnan(pearson(values[:1], values[:1]))


@pytest.mark.parametrize(
    ("cell", "text"),
    [
        (None, "-"),
        ("SSFA", "SSFA"),
        (1234567, "1,234,567"),
        (54.434, "54.43"),
        (0.12345, "0.123"),
        ([50.0], "50.00"),
        ([50.0, 52.0], "51.00 (50.00 to 52.00)"),
        ([float("nan")], "-"),
    ],
)
def test_text_of_a_cell(cell: object, text: str) -> None:
    assert to_text(cell) == text  # type: ignore[arg-type]
