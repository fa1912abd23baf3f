"""A suggested config: valid, made of the data's own labels, no larger than needed, and one that can be trained."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mini_folders import OBJECTS, full_cloud, write_custom

from ciassd_jax import Config, car, car_lite, tiny
from ciassd_jax.config import InputConfig
from ciassd_jax.data.folders import open_dataset
from ciassd_jax.data.frames import Dataset, Frame
from ciassd_jax.data.scenes import pad_frame
from ciassd_jax.evaluation.active_sites import count_sites
from ciassd_jax.evaluation.dataset_check import check_dataset
from ciassd_jax.evaluation.fitted_grid import boxes_held, fit_grid
from ciassd_jax.evaluation.suggest import suggest_config
from ciassd_jax.formats.errors import InputError
from ciassd_jax.model.anchors import make_anchors
from ciassd_jax.ops.footprints import footprint_corners
from ciassd_jax.training.targets import assign_targets
from ciassd_jax.types import Boxes


def make_boxes(count: int, low: tuple = (5, -20), high: tuple = (60, 20), z: float = -1.0) -> np.ndarray:
    """Cars of about the usual size anywhere in an area."""
    rng = np.random.default_rng(count)
    place, size = rng.uniform(low, high, (count, 2)), rng.normal((4.0, 1.7, 1.5), 0.1, (count, 3))
    turn = rng.uniform(-np.pi, np.pi, (count, 1))
    return np.concatenate([place, rng.normal(z, 0.2, (count, 1)), size, turn], 1)


def make_dataset(names: list[str], boxes: np.ndarray, per_frame: int = 5, scale: float = 1.0) -> Dataset:
    """Frames with some objects each and a cloud around them."""

    def read(name: str) -> Frame:
        rows = slice(int(name) * per_frame, (int(name) + 1) * per_frame)
        mine, points = boxes[rows], full_cloud(int(name))
        around = np.concatenate([mine[:, :3] + shift for shift in np.linspace(-0.3, 0.3, 20)]).astype(np.float32)
        points = np.concatenate([points, np.pad(around, ((0, 0), (0, 1)), constant_values=0.5)])
        points[:, 3] *= scale
        kinds = tuple(names[rows])
        return Frame(name, points, Boxes.from_array(mine), kinds, np.zeros(len(kinds), np.int64), None, ())

    return Dataset(tuple(map(str, range(-(-len(names) // per_frame)))), read)


def test_classes_have_enough_objects_and_the_usual_spelling() -> None:
    names = ["vehicle"] * 3 + ["Vehicle"] * 60 + ["Bike"] * 10 + ["Tram"] * 3 + ["Misc"] * 20 + ["DontCare"] * 20
    suggestion = suggest_config(make_dataset(names, make_boxes(len(names))), car_lite())
    assert suggestion.config.class_names == ("Vehicle", "Bike")
    text = "\n".join(suggestion.notes)
    assert "Class Vehicle (63): anchors" in text
    assert "Left out: Tram (3); name a type as `classes` to learn it" in text
    assert "Misc" not in text
    given = suggest_config(make_dataset(names, make_boxes(len(names))), car_lite(), classes=["tram", "VEHICLE"])
    assert given.config.class_names == ("Tram", "Vehicle")
    few = suggest_config(make_dataset([*names[:2], "Tram"], make_boxes(3)), car_lite())
    assert few.config.class_names == ("vehicle",)


def test_labels_without_a_class_are_refused() -> None:
    with pytest.raises(InputError, match=r"No object is of the type Bus; choose from Car \(2\), Van \(1\)\."):
        suggest_config(make_dataset(["Car", "Car", "Van"], make_boxes(3)), car(), classes=["Car", "Bus"])
    with pytest.raises(InputError, match="No frame has a labelled object; check the labels"):
        suggest_config(make_dataset(["Misc"], make_boxes(1)), car())


@pytest.mark.parametrize("z_shift", [0.0, 0.4])
def test_anchors_are_those_of_the_labels(z_shift: float) -> None:
    boxes, base = make_boxes(50), replace(car_lite(), input=InputConfig(z_shift=z_shift))
    (one,) = suggest_config(make_dataset(["Truck"] * 50, boxes), base).config.classes
    np.testing.assert_allclose((one.length, one.width, one.height), np.median(boxes[:, 3:6], 0), atol=0.006)
    assert one.center_z == pytest.approx(boxes[:, 2].mean() + z_shift, abs=0.006)
    assert (one.similar, one.gt_sampling_up_to) == ((), base.classes[0].gt_sampling_up_to)


@pytest.mark.parametrize(
    ("base", "size", "matched", "support"),
    [
        (car(), (3.9, 1.6), 0.6, 2.6),
        (car(), (0.8, 0.6), 0.45, 0.2),
        (car_lite(), (0.8, 0.6), 0.3, 0.05),
        (car(), (12.0, 2.6), 0.6, 2.6),
    ],
)
def test_thresholds_of_small_objects_can_be_reached(
    base: Config, size: tuple[float, float], matched: float, support: float
) -> None:
    boxes = make_boxes(20)
    boxes[:, 3:5] = size
    (one,) = suggest_config(make_dataset(["Thing"] * 20, boxes), base).config.classes
    assert (one.matched, one.unmatched, one.support_threshold) == (matched, round(matched - 0.15, 2), support)


@pytest.mark.parametrize("base", [car(), car_lite(), tiny()], ids=["car", "car_lite", "tiny"])
@pytest.mark.parametrize("low", [(5, -20), (-50, -9)], ids=["ahead", "around"])
@pytest.mark.parametrize("z", [-1.0, 3.0])
def test_the_range_is_the_smallest_that_holds_all_of_few_boxes(base: Config, low: tuple, z: float) -> None:
    boxes = make_boxes(99, low, z=z)
    config = replace(base, grid=fit_grid(boxes, base))
    assert boxes_held(boxes, config).all()
    assert config.grid.voxel_size == base.grid.voxel_size
    assert (config.grid.minimum[0] == 0) == (low[0] > 0)
    assert config.grid.minimum[1] == -config.grid.maximum[1]
    assert config.grid.cells[2] == base.grid.cells[2]
    corners = footprint_corners(Boxes.from_array(boxes))
    step = 2 * base.backbone.stride * base.grid.voxel_size[0]
    assert corners[..., 0].max() > config.grid.maximum[0] - step
    assert abs(corners[..., 1]).max() > config.grid.maximum[1] - step / 2
    if low[0] < 0:
        assert corners[..., 0].min() < config.grid.minimum[0] + step


def test_a_few_far_boxes_do_not_enlarge_the_range() -> None:
    boxes, base = make_boxes(300), car()
    boxes[:2, 0], boxes[2, 2] = (250, 252), 20
    grid = fit_grid(boxes, base)
    assert boxes_held(boxes, replace(base, grid=grid)).sum() == 297
    assert grid.maximum[0] <= 64
    assert grid.cells[2] == base.grid.cells[2]


def test_tall_objects_get_more_layers_and_a_note() -> None:
    boxes = make_boxes(20)
    boxes[:, 5] = 9
    suggestion = suggest_config(make_dataset(["Crane"] * 20, boxes), car())
    config = suggestion.config
    assert boxes_held(boxes, config).all()
    assert config.grid.cells[2] > 90
    assert config.detection.z_limits[0] <= config.grid.minimum[2] < -5
    assert suggestion.notes[-1].endswith("layers, weights that were trained with the base config do not fit.")


def test_a_range_with_too_many_voxels_is_refused() -> None:
    with pytest.raises(InputError, match=r"leave out far ones, or choose a larger grid\.voxel_size"):
        fit_grid(make_boxes(20, (-900, -900), (900, 900)), car())


def dense_counts(points: np.ndarray, config: Config) -> list[int]:
    """Count active sites on the dense grid."""
    cells = np.floor((points[:, :3] - np.array(config.grid.minimum)) / np.array(config.grid.voxel_size)).astype(int)
    cells = cells[((cells >= 0) & (cells < np.array(config.grid.cells))).all(1)]
    active = np.zeros(config.grid.shape, bool)
    active[tuple(cells.T[::-1])] = True
    counts = [active.sum()]
    shapes = config.backbone.stage_shapes(config.grid.shape)[1:]
    paddings = [(stage.z_padding, 1, 1) for stage in config.backbone.stages[1:]]
    for shape, padding in zip(shapes, [*paddings, (0, None, None)], strict=True):
        for axis, (size, before) in enumerate(zip(shape, padding, strict=True)):
            if before is not None:
                rows = 2 * np.arange(size)[:, None] + np.arange(3) - before
                seen = np.take(active, rows.clip(0, active.shape[axis] - 1), axis)
                valid = (rows >= 0) & (rows < active.shape[axis])
                active = (seen & np.expand_dims(valid, tuple(set(range(4)) - {axis, axis + 1}))).any(axis + 1)
        counts.append(active.sum())
    return counts


@pytest.mark.parametrize("padding", [0, 1])
def test_sites_are_counted_as_the_backbone_does(padding: int) -> None:
    config = tiny()
    stages = (*config.backbone.stages[:-1], replace(config.backbone.stages[-1], z_padding=padding))
    config = replace(config, backbone=replace(config.backbone, stages=stages))
    for seed, number in enumerate((0, 1, 500)):
        points = np.random.default_rng(seed).uniform((-1, -7, -4, 0), (14, 7, 2, 1), (number, 4)).astype(np.float32)
        counts = dense_counts(points, config)
        # A damaged point is in no voxel, and gives no warning.
        damaged = np.concatenate([points, np.full((1, 4), 3e38, np.float32)])
        assert list(count_sites(points, config)) == list(count_sites(damaged, config)) == counts


def test_capacities_cover_the_frames_and_what_is_pasted() -> None:
    boxes = make_boxes(60)
    dataset = make_dataset(["Car"] * 60, boxes, per_frame=6)
    config = suggest_config(dataset, car_lite()).config
    slots = config.backbone.capacities(config.grid.max_voxels)
    for index in range(len(dataset)):
        frame = dataset.read(index)
        assert all(count < most for count, most in zip(count_sites(frame.points, config), slots, strict=True))
        assert len(frame.points) < config.data.max_points
    assert config.data.max_boxes == 20
    # Every object holds at least 20 points, and two rounds of 15 are drawn.
    assert 600 <= config.data.max_gt_sampling_points < 6000


@pytest.mark.parametrize(("top", "scale"), [(0.7, 1.0), (255.0, 255.0), (4000.0, 4095.0), (90.0, 100.0)])
def test_the_scale_of_intensities(top: float, scale: float) -> None:
    dataset = make_dataset(["Car"] * 10, make_boxes(10), scale=top)
    suggestion = suggest_config(dataset, tiny())
    assert suggestion.config.input.intensity_scale == scale
    assert ("is read as 1." in suggestion.notes[-1]) == (scale > 1)
    base = replace(tiny(), input=InputConfig(intensity_scale=5000.0))
    assert suggest_config(dataset, base).config.input.intensity_scale == 5000


def test_a_suggested_config_is_checked_without_findings_and_has_positives(tmp_path: Path) -> None:
    root = write_custom(tmp_path, names=tuple("abcdef"))
    dataset = open_dataset(root, "train")
    config = suggest_config(dataset, tiny()).config
    assert set(config.class_names) == set(OBJECTS)
    assert Config.from_json(config.to_json()) == config
    assert check_dataset(root, config=config).findings == ()
    anchors, labels = make_anchors(config)
    truth = pad_frame(dataset.read(0), 0, config).truth
    targets = assign_targets(truth, anchors, labels, config.classes)
    assert set(np.asarray(targets.truth)[np.asarray(targets.label) == 1].tolist()) == {0, 1, 2}


@pytest.mark.slow
@pytest.mark.reference
def test_a_config_for_real_cars(shared: Path) -> None:
    dataset = open_dataset(shared / "kitti", "all")
    config = suggest_config(dataset, car(), classes=["Car"]).config
    (one,) = config.classes
    np.testing.assert_allclose((one.length, one.width, one.height), (3.9, 1.6, 1.56), rtol=0.05)
    frames = [dataset.read(index) for index in range(len(dataset))]
    boxes = np.concatenate([frame.boxes.to_array()[np.array(frame.names) == "Car"] for frame in frames])
    assert abs(boxes[:, 2].mean() - one.center_z) < 0.1
    assert boxes_held(boxes, config).mean() >= 0.99
    assert config.bev_channels == car().bev_channels
    assert config.grid.cells[0] * config.grid.cells[1] < 1.1 * 1408 * 1600
