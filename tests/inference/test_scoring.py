"""Scoring of a detector on a data set: evaluation, written files, and summed warnings."""

import re
import shutil
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mini_folders import NAMES, OBJECTS, object_boxes, write_custom, write_kitti
from small import random_variables, small_config

from ciassd_jax import Config, Detector, load_weights
from ciassd_jax.config import ClassConfig
from ciassd_jax.data.folders import open_dataset
from ciassd_jax.data.frames import Dataset
from ciassd_jax.evaluation import LIMITS, Evaluation, evaluate, read_folders, to_json
from ciassd_jax.formats.errors import DroppedWarning, FormatWarning, InputError
from ciassd_jax.formats.kitti_rows import parse_row
from ciassd_jax.formats.points import write_bin
from ciassd_jax.inference.results import FrameResult
from ciassd_jax.inference.scoring import detect_dataset, find_trained, score_dataset, score_frames, write_frames
from ciassd_jax.simulation import Lidar, open_synthetic

Detect = Callable[[np.ndarray], tuple[np.ndarray, tuple[str, ...]]]
# Rounding to four decimals rarely moves an overlap past its limit or merges two scores.
ROUNDING = 0.05
CONFIG = Config(classes=tuple(ClassConfig(name=name) for name in LIMITS))


class Oracle(Detector):
    """Returns given boxes with descending scores."""

    def __init__(self, detect: Detect) -> None:
        self.config, self._find = CONFIG, detect

    def __call__(self, points: Any, **options: Any) -> Any:
        return [self._one(each) for each in points]

    def _one(self, points: np.ndarray) -> FrameResult:
        boxes, labels = self._find(points)
        counts = {
            "points": {"given": len(points), "in_range": len(points), "dropped": 0, "invalid": 0},
            "voxels": {"kept": 1, "dropped": 0},
            "sites": [],
            "candidates": {"kept": len(boxes), "dropped": 0},
        }
        scores = np.linspace(0.9, 0.3, len(boxes), dtype=np.float32)
        return FrameResult(boxes.astype(np.float32), scores, labels, counts, 0.1)


def all_objects(points: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    return object_boxes().to_array(), tuple(OBJECTS)


def nothing(points: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    return np.zeros((0, 7)), ()


def blurred_truth(dataset: Dataset, seed: int = 0) -> Oracle:
    """The labels in their order, slightly shifted, and one more box per frame."""
    rng, frames = np.random.default_rng(seed), iter(map(dataset.read, range(len(dataset))))

    def find(points: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
        frame = next(frames)
        boxes = np.concatenate([frame.boxes.to_array(), [[15, 1, -1, 3.9, 1.6, 1.5, 0]]])
        return boxes + rng.normal(0, 0.06, boxes.shape), (*frame.names, "Car")

    return Oracle(find)


def written(evaluated: list[Any], labels: Path, folder: Path) -> Evaluation:
    """The evaluation of the written files."""
    write_frames(evaluated, folder)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Frames of .* without a result file", FormatWarning)
        return evaluate(*read_folders(labels, folder))


def assert_same_precision(a: Evaluation, b: Evaluation, tolerance: float) -> None:
    one, other = flat(to_json(a)), flat(to_json(b))
    assert one.keys() == other.keys()
    for key, values in one.items():
        assert values == (None if other[key] is None else pytest.approx(other[key], abs=tolerance)), key


def flat(tree: Any, *keys: str) -> dict[tuple[str, ...], Any]:
    if not isinstance(tree, dict):
        return {keys: tree}
    return {key: value for name, part in tree.items() for key, value in flat(part, *keys, name).items()}


def test_what_is_all_found_scores_what_is_possible(tmp_path: Path) -> None:
    dataset = open_dataset(write_kitti(tmp_path), "all")
    frames = detect_dataset(Oracle(all_objects), dataset)
    assert [frame.name for frame in frames] == list(NAMES)
    evaluation = score_frames(frames, CONFIG)
    # Three objects fill the first three of 41 points of the curve, of which R40 counts two.
    for name, metric, limit in (("Car", "3d", 0.7), ("Car", "bev", 0.7), ("Pedestrian", "3d", 0.5)):
        assert evaluation.precision(name, metric, limit) == [5, 5, 5]
    assert evaluation.has_camera
    assert evaluation.num_frames == 3


def test_points_in_boxes_are_known(tmp_path: Path) -> None:
    dataset = open_dataset(write_kitti(tmp_path, clouds="velodyne_reduced"), "all")
    frame = detect_dataset(Oracle(all_objects), dataset)[0]
    assert frame.truth.types == ("Car", "DontCare", "Van", "Pedestrian")
    assert frame.truth.points.tolist() == [60, 0, 60, 60]
    assert frame.detections.points.tolist() == [60, 60, 60]
    rows = score_dataset(Oracle(all_objects), dataset).by_points
    assert {
        row.part: [c.num_truths for c in row.curves] for row in rows if (row.name, row.geometry) == ("Car", "3d")
    } == {
        "0-20 points": [0, 0, 0],
        "20-100 points": [3, 3, 3],
        "100+ points": [0, 0, 0],
    }


def test_files_evaluate_alike(tmp_path: Path) -> None:
    root = write_kitti(tmp_path, names=tuple(f"{i:06}" for i in range(24)))
    dataset = open_dataset(root, "all")
    frames = detect_dataset(blurred_truth(dataset), dataset)
    evaluation = score_frames(frames, CONFIG)
    assert 20 < evaluation.precision("Car", "3d", 0.7)[1] < 60
    assert_same_precision(evaluation, written(frames, root / "training/label_2", tmp_path / "out"), ROUNDING)
    assert [path.name for path in sorted((tmp_path / "out").iterdir())] == [f"{i:06}.txt" for i in range(24)]


def test_a_frame_without_detections_is_an_empty_file(tmp_path: Path) -> None:
    dataset = open_dataset(write_kitti(tmp_path), "all")
    frames = detect_dataset(Oracle(nothing), dataset)
    write_frames(frames, tmp_path / "out")
    assert [path.read_bytes() for path in (tmp_path / "out").iterdir()] == [b"", b"", b""]
    assert score_frames(frames, CONFIG).precision("Car", "3d", 0.7) is None


def test_boxes_outside_the_image_are_no_rows(tmp_path: Path) -> None:
    def find(points: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
        behind = np.array([[-8, 0, -1, 3.9, 1.6, 1.5, 0.3]])
        return np.concatenate([behind, object_boxes().to_array()]), ("Car", *OBJECTS)

    frame = detect_dataset(Oracle(find), open_dataset(write_kitti(tmp_path, clouds="velodyne_reduced"), "all"))[0]
    rows = [parse_row(line, "here") for line in frame.lines]
    assert [row.type for row in rows] == list(OBJECTS)
    assert [row.score for row in rows] == pytest.approx([0.7, 0.5, 0.3], abs=1e-4)
    assert frame.detections.points.tolist() == [60, 60, 60]


def test_without_a_camera_boxes_stay_in_the_lidar_frame(tmp_path: Path) -> None:
    dataset = open_dataset(write_custom(tmp_path), "train")
    frames = detect_dataset(Oracle(all_objects), dataset)
    evaluation = score_frames(frames, CONFIG)
    assert not evaluation.has_camera
    assert evaluation.precision("Car", "bbox", 0.7) is None
    # Two objects, both with fewer than 100 points: none is easy. Of their two points of the curve R40 counts one.
    assert evaluation.precision("Car", "3d", 0.7) == [0, 2.5, 2.5]
    assert evaluation.by_points
    assert frames[0].truth.points.tolist() == frames[0].detections.points.tolist()
    assert frames[0].lines[0] == "8.0000 1.0000 -1.0000 3.9000 1.6000 1.5000 0.3000 Car 0.9000"
    write_frames(frames, tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.txt", "b.txt"]


def test_track_sees_the_names(tmp_path: Path) -> None:
    seen: list[str] = []

    def track(names: Any) -> Any:
        for name in names:
            seen.append(name)
            yield name

    score_dataset(Oracle(nothing), open_dataset(write_custom(tmp_path), "train"), track)
    assert seen == ["a", "b"]


def test_frames_in_memory_score_like_those_of_files(tmp_path: Path) -> None:
    dataset = open_dataset(write_kitti(tmp_path), "all")
    frames = {name: dataset.read_frame(name) for name in dataset.names}
    score = to_json(score_dataset(blurred_truth(dataset), dataset))
    shutil.rmtree(tmp_path)
    in_memory = Dataset(dataset.names, frames.__getitem__)
    assert to_json(score_dataset(blurred_truth(in_memory), in_memory)) == score


@pytest.mark.slow
def test_synthetic_frames_can_be_scored() -> None:
    dataset = open_synthetic(seed=3, frames=2, lidar=Lidar(columns=128))
    truth = iter([dataset.read(index) for index in range(2)])

    def find(points: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
        frame = next(truth)
        return frame.boxes.to_array(), frame.names

    evaluation = score_dataset(Oracle(find), dataset)
    assert evaluation.has_camera
    cars = evaluation.curves["Car", "3d", 0.7]
    assert cars is not None
    assert cars[2].num_truths > 0
    assert evaluation.precision("Car", "3d", 0.7)[2] > 0


def test_frames_without_labels_are_refused(tmp_path: Path) -> None:
    root = write_kitti(tmp_path, part="testing")
    (root / "ImageSets").mkdir()
    (root / "ImageSets/test.txt").write_text("000001\n")
    with pytest.raises(InputError, match=r"^Frame 000001 has no labels to compare with; choose a split of labelled"):
        detect_dataset(Oracle(nothing), open_dataset(root, "test"))


def test_problems_of_frames_are_reported_once(tmp_path: Path) -> None:
    root = write_custom(tmp_path, names=tuple("abc"))
    for path in (root / "points").iterdir():
        points = np.load(path)[:, :3]
        points[0, 0] = np.nan if path.stem == "b" else 0
        np.save(path, points)
    with pytest.warns(FormatWarning) as caught:
        detect_dataset(Oracle(all_objects), open_dataset(root, "all"))
    texts = [str(one.message) for one in caught]
    assert len(texts) == 2
    assert re.search(r"a\.npy has no intensity .* Other frames with this problem: 2\.$", texts[0])
    assert re.search(r"b\.npy: 1 of 980 points are not finite; they were left out\.$", texts[1])


def test_the_detector_is_told_the_frame(tmp_path: Path) -> None:
    sources = []

    class Recorder(Oracle):
        def __call__(self, points: Any, *, source: Any = None, **others: Any) -> Any:
            sources.extend(source)
            return super().__call__(points, **others)

    detect_dataset(Recorder(nothing), open_dataset(write_custom(tmp_path, names=("a", "b")), "all"))
    assert sources == ["Frame a", "Frame b"]


def test_batches_change_neither_order_nor_detections(tmp_path: Path) -> None:
    dataset = open_dataset(write_kitti(tmp_path), "all")
    detector = Detector(random_variables(small_config()), small_config())
    tracked: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DroppedWarning)
        alone = detect_dataset(detector, dataset)
        batched = detect_dataset(
            detector, dataset, lambda names: (tracked.append(name) or name for name in names), batch_size=2
        )
    assert [frame.name for frame in batched] == tracked == list(NAMES)
    assert sum(len(frame.lines) for frame in alone) > 0
    for one, other in zip(alone, batched, strict=True):
        assert one.truth.types == other.truth.types
        np.testing.assert_allclose(other.result.boxes, one.result.boxes, atol=1e-5)
        np.testing.assert_allclose(other.detections.score, one.detections.score, atol=1e-5)


def test_other_warnings_are_left_alone(tmp_path: Path) -> None:
    def find(points: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
        warnings.warn("of another library", stacklevel=1)
        return nothing(points)

    with pytest.warns(UserWarning, match="of another library") as caught:
        detect_dataset(Oracle(find), open_dataset(write_custom(tmp_path), "train"))
    assert len(caught) == 2


def test_drops_are_summed(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    crowd = np.random.default_rng(0).uniform([0, -6.4, -3, 0], [12.8, 6.4, 1, 1], (9000, 4)).astype(np.float32)
    for name, points in zip(NAMES[1:], (crowd, np.float32([[50, 0, 0, 0.5], [60, 1, 0, 0.5]])), strict=True):
        write_bin(root / f"training/velodyne/{name}.bin", points)
    detector = Detector(random_variables(small_config()), small_config())
    with pytest.warns(DroppedWarning) as caught:
        frames = detect_dataset(detector, open_dataset(root, "all"))
    (text,) = (str(one.message) for one in caught)
    voxels = [frame.result.counts["voxels"]["dropped"] for frame in frames]
    assert voxels[1] > 0 == voxels[0]
    assert text.startswith(f"Dropped {voxels[1]} voxels beyond grid.max_voxels (in 1 of 3 frames); ")
    sites = sum(frame.result.counts["sites"][0]["dropped"] for frame in frames)
    assert f"; {sites} sites of backbone stage 1 beyond its capacity (in 1 of 3 frames)" in text
    assert text.endswith("; 2 points of frames without a point in range (in 1 of 3 frames).")
    assert [len(frame.lines) for frame in frames] == [len(frame.detections.score) for frame in frames]
    assert len(frames[0].lines) > 0


def test_the_best_of_a_training_is_taken(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has neither best\.safetensors nor last\.safetensors; give the folder"):
        find_trained(tmp_path)
    for name in ("last", "best"):
        (tmp_path / f"{name}.safetensors").touch()
        assert find_trained(tmp_path) == tmp_path / f"{name}.safetensors"


@pytest.mark.reference
def test_real_frames_evaluate_like_their_files(shared: Path, tmp_path: Path) -> None:
    dataset = open_dataset(shared / "kitti", "val")
    frames = detect_dataset(blurred_truth(dataset), dataset)
    evaluation = score_frames(frames, CONFIG)
    assert 50 < evaluation.precision("Car", "3d", 0.7)[1] < 99
    assert_same_precision(evaluation, written(frames, shared / "kitti/training/label_2", tmp_path), ROUNDING)


@pytest.mark.slow
@pytest.mark.reference
def test_golden_weights_on_real_frames(shared: Path, tmp_path: Path) -> None:
    weights = load_weights(shared / "golden/weights.pth")
    everything = open_dataset(shared / "kitti", "val")
    dataset = replace(everything, names=("000010", *everything.names[:2]))
    frames = detect_dataset(Detector(weights.variables, weights.config), dataset)
    with np.load(shared / "golden/network.npz") as golden:
        x, y, z, width, length, height, _ = golden["000010_final_boxes"].T
        scores = golden["000010_final_scores"]
    np.testing.assert_allclose(frames[0].result.boxes[:, :6], np.stack([x, y, z, length, width, height], 1), atol=5e-3)
    np.testing.assert_allclose(frames[0].detections.score, scores, atol=1e-3)
    again = written(frames, shared / "kitti/training/label_2", tmp_path)
    assert_same_precision(score_frames(frames, CONFIG), again, ROUNDING)
    assert again.num_frames == 3


def test_labels_similar_to_an_own_class_count_as_it_and_those_of_a_car_do_not(tmp_path: Path) -> None:
    dataset = open_dataset(write_custom(tmp_path), "all")
    bus = ClassConfig(name="Bus", similar=("VAN", "Car"))

    def found_of(*classes: ClassConfig) -> Evaluation:
        oracle = Oracle(lambda points: (object_boxes().to_array(), ("Bus",) * len(OBJECTS)))
        return score_frames(detect_dataset(oracle, dataset), Config(classes=classes))

    curves = found_of(bus).curves["Bus", "3d", 0.5]
    assert curves is not None
    assert curves[2].num_truths == 2 * sum(name in ("Car", "Van") for name in OBJECTS)
    car = found_of(ClassConfig(name="car", similar=("Van",))).curves["car", "3d", 0.7]
    assert car is None
