"""Frames and scenes as the records that a page shows."""

from dataclasses import replace

import jax
import numpy as np
from small import random_scene, small_cloud, small_config

from ciassd_jax.config.presets import car
from ciassd_jax.config.training import AugmentationConfig, DataConfig
from ciassd_jax.data.frames import Frame
from ciassd_jax.inference.results import FrameResult
from ciassd_jax.types import Boxes
from ciassd_jax.view.view_frame import frame_to_view, mark_targets, scene_to_view

BOXES = np.array([[8, 1, -1, 3.9, 1.6, 1.5, 0.3], [10, -3, -1, 4.6, 1.9, 2.0, -1.2]])


def test_a_labelled_frame_shows_its_objects_as_the_truth() -> None:
    frame = Frame("a", small_cloud(), Boxes.from_array(BOXES), ("Car", "Van"), np.zeros(2, np.int64), None)
    seen = frame_to_view(frame)
    assert (seen.name, seen.truth_labels, seen.camera, seen.image, len(seen.boxes)) == (
        "a",
        ("Car", "Van"),
        None,
        None,
        0,
    )
    np.testing.assert_array_equal(seen.truth, BOXES)
    np.testing.assert_array_equal(seen.points, frame.points)


def test_targets_are_what_the_config_learns_in_any_case() -> None:
    names = ("car", "VAN", "Pedestrian", "Truck")
    boxes = Boxes.from_array(BOXES.repeat(2, 0))
    frame = frame_to_view(Frame("a", small_cloud(), boxes, names, np.zeros(4, np.int64), None))
    assert frame.is_target is None
    assert mark_targets(frame, car()).is_target.tolist() == [True, True, False, False]
    strict = replace(car(), data=DataConfig(augmentation=AugmentationConfig(similar_classes=False)))
    assert mark_targets(frame, strict).is_target.tolist() == [True, False, False, False]
    assert mark_targets(frame._replace(truth=BOXES[:0], truth_labels=()), car()).is_target.tolist() == []


def test_a_scene_is_shown_without_its_padding() -> None:
    scene = random_scene(small_config(), 3)
    (seen,) = scene_to_view(scene, ["Car"])
    count, objects = int(scene.cloud.count), int(scene.truth.count)
    assert 0 < objects < len(scene.truth.label)
    assert seen.name == f"frame {int(scene.frame)}"
    np.testing.assert_array_equal(seen.points, scene.cloud.points[:count])
    np.testing.assert_array_equal(seen.truth, np.asarray(scene.truth.boxes.to_array())[:objects])
    assert seen.truth_labels == ("Car",) * objects


def test_a_batch_shows_each_of_its_scenes() -> None:
    scenes = [random_scene(small_config(), seed) for seed in (1, 2)]
    scenes[1].truth.label[0] = -1
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *scenes)
    first, second = scene_to_view(batch, ["Car"])
    np.testing.assert_array_equal(first.truth, scene_to_view(scenes[0], ["Car"])[0].truth)
    np.testing.assert_array_equal(second.points, scene_to_view(scenes[1], ["Car"])[0].points)
    assert (first.truth_labels[0], second.truth_labels[0]) == ("Car", "other")
    assert (first.is_target.tolist(), second.is_target.tolist()) == ([True, True], [False, True])


def test_a_result_joins_its_frame() -> None:
    (seen,) = scene_to_view(random_scene(small_config(), 3), ["Car"])
    joined = FrameResult(BOXES, np.array([0.9, 0.4]), ("Car", "Car"), {}, 0.1).show_in(seen)
    np.testing.assert_array_equal(joined.boxes, BOXES)
    assert (joined.labels, joined.name) == (("Car", "Car"), seen.name)
