"""Frames padded to the capacities of a config: targets, obstacles, and what is cut."""

from dataclasses import replace

import numpy as np
import pytest

from ciassd_jax import Config, three_class, tiny
from ciassd_jax.config import AugmentationConfig
from ciassd_jax.data.frames import Frame
from ciassd_jax.data.scenes import pad_frame, target_labels
from ciassd_jax.formats.errors import FormatWarning, InputError
from ciassd_jax.types import Boxes

TYPES = ("Van", "Car", "Truck", "Pedestrian", "Car")


def make_frame(num_points: int = 50, names: tuple[str, ...] = TYPES) -> Frame:
    rng = np.random.default_rng(0)
    boxes = Boxes(rng.normal(size=(len(names), 3)), rng.uniform(1, 2, (len(names), 3)), rng.normal(size=len(names)))
    difficulty = np.array([0, 1, 2, 0, -1][: len(names)])
    return Frame("000007", rng.normal(size=(num_points, 4)).astype(np.float32), boxes, names, difficulty, None)


def with_data(config: Config, **changes: object) -> Config:
    return replace(config, data=replace(config.data, **changes))


def with_augmentation(config: Config, **changes: object) -> Config:
    return with_data(config, augmentation=replace(AugmentationConfig(), **changes))


def test_what_fits_is_kept_in_order_and_padding_is_zero() -> None:
    frame, config = make_frame(), tiny()
    scene = pad_frame(frame, 3, config)
    assert scene.cloud.points.shape == (config.data.max_points, 4)
    assert scene.truth.boxes.center.shape == (config.data.max_boxes, 3)
    assert (scene.cloud.count, scene.truth.count, scene.frame) == (50, 5, 3)
    assert (scene.points_cut, scene.boxes_cut, scene.objects_cut) == (0, 0, 0)
    np.testing.assert_array_equal(scene.cloud.points[:50], frame.points)
    assert not scene.cloud.points[50:].any()
    np.testing.assert_allclose(scene.truth.boxes.to_array()[:5], frame.boxes.to_array(), rtol=1e-6)
    assert not scene.truth.boxes.to_array()[5:].any()
    assert scene.truth.label[5:].tolist() == [-1] * (config.data.max_boxes - 5)


def test_leaves_are_of_one_type_whatever_the_frame() -> None:
    scenes = [pad_frame(make_frame(count, TYPES[:objects]), 0, tiny()) for count, objects in ((0, 0), (9000, 5))]
    kinds = [
        [(leaf.shape, leaf.dtype) for leaf in (*scene.cloud, *scene.truth.boxes, *scene.truth[1:], *scene[2:])]
        for scene in scenes
    ]
    assert kinds[0] == kinds[1]
    assert {str(dtype) for _, dtype in kinds[0]} == {"float32", "int32"}


@pytest.mark.parametrize(
    ("config", "labels"),
    [
        (tiny(), [0, 0, -1, -1, 0]),
        (with_augmentation(tiny(), similar_classes=False), [-1, 0, -1, -1, 0]),
        (with_augmentation(tiny(), filter_scenes=True), [0, 0, -1, -1, -1]),
        (three_class(), [0, 0, -1, 1, 0]),
    ],
)
def test_targets_are_the_classes_and_their_similar_ones(config: Config, labels: list[int]) -> None:
    assert target_labels(make_frame(), config).tolist() == labels
    assert pad_frame(make_frame(), 0, config).truth.label[:5].tolist() == labels


def test_case_does_not_matter_but_is_told() -> None:
    frame = make_frame(names=("VAN", "car", "Truck", "Car"))
    with pytest.warns(FormatWarning) as caught:
        scene = pad_frame(frame, 0, tiny())
    assert scene.truth.label[:4].tolist() == [0, 0, -1, 0]
    texts = [f"Labels of type {name} count as Car, because case does not matter." for name in ("VAN", "car")]
    assert [str(one.message) for one in caught] == texts
    assert target_labels(frame, with_augmentation(tiny(), similar_classes=False)).tolist() == [-1, 0, -1, 0]


def test_a_name_is_its_own_class_before_it_is_similar_to_another() -> None:
    car = tiny().classes[0]
    config = replace(tiny(), classes=(car, replace(car, name="Van", similar=())))
    assert target_labels(make_frame(), config).tolist() == [1, 0, -1, -1, 0]


def test_what_does_not_fit_is_counted() -> None:
    config = with_data(tiny(), max_points=64, max_boxes=3)
    frame = make_frame(1000)
    scene = pad_frame(frame, 0, config)
    assert (scene.cloud.count, scene.points_cut, scene.truth.count, scene.boxes_cut) == (64, 936, 3, 2)
    np.testing.assert_allclose(scene.truth.boxes.to_array(), frame.boxes.to_array()[:3], rtol=1e-6)
    # Every part of the cloud keeps its share.
    place = [int(np.flatnonzero((frame.points == point).all(1))[0]) for point in scene.cloud.points]
    assert place == sorted(set(place))
    assert np.diff([*place, 1000]).max() <= 16
    assert pad_frame(make_frame(64), 0, config).points_cut == 0


@pytest.mark.parametrize("size", [0.0, -1.0, np.nan])
def test_a_box_without_a_size_is_refused(size: float) -> None:
    frame = make_frame()
    frame.boxes.size[2, 1] = size
    message = rf"Frame 000007: object 2 \(Truck\) has the size .* x {size:g} x .*; correct or remove its line"
    with pytest.raises(InputError, match=message):
        pad_frame(frame, 0, tiny())
