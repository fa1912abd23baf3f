"""Augmentation against its definition in plain loops, and its properties: what it keeps, repeats and counts."""

import itertools
from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles_data import accept_by_loop, box_coordinates, footprint, inside, move_by_loop

from ciassd_jax.config import AugmentationConfig, ClassConfig
from ciassd_jax.config.presets import tiny
from ciassd_jax.data.augment import (
    accept_objects,
    add_object_noise,
    add_sampled_objects,
    augment,
    flip,
    keep_targets,
    move_objects,
    rotate,
    scale,
    scene_key,
    shuffle_points,
)
from ciassd_jax.ops.boxes import to_paper
from ciassd_jax.types import Boxes, GroundTruth, PointCloud, SampledObjects, Scene

POINTS, BOXES, PASTE_POINTS = 512, 16, 256
# Slots of one round, for two classes.
ROUND = (4, 2)
OBJECTS = 2 * sum(ROUND)
LABELS = np.repeat([0, 1], 2 * np.array(ROUND)).astype(np.int32)
CONFIG = replace(
    tiny(),
    classes=(
        ClassConfig(gt_sampling_up_to=ROUND[0]),
        ClassConfig(name="Cyclist", length=1.8, width=0.6, gt_sampling_up_to=ROUND[1]),
    ),
    data=replace(tiny().data, max_points=POINTS, max_boxes=BOXES, max_gt_sampling_points=PASTE_POINTS),
)
compiled_augment = jax.jit(augment, static_argnames="config")
accept = jax.jit(partial(accept_objects, gt_sampling_up_to=ROUND))
add_objects = jax.jit(partial(add_sampled_objects, gt_sampling_up_to=ROUND))
noise = jax.jit(partial(add_object_noise, config=AugmentationConfig(noise_tries=10)))
compiled = {name: jax.jit(function) for name, function in (("flip", flip), ("rotate", rotate), ("scale", scale))}


def random_boxes(rng: np.random.Generator, number: int, reach: float = 6.0) -> np.ndarray:
    """Boxes of cars' sizes (N, 7) within `reach` metres of (6, 0)."""
    center = np.array([6, 0, -1]) + rng.uniform(-reach, reach, (number, 3)) * [1, 1, 0.05]
    size = np.array([3.9, 1.6, 1.5]) * rng.uniform(0.4, 1.2, (number, 1))
    return np.concatenate([center, size, rng.uniform(-4, 4, (number, 1))], 1).astype(np.float32)


def points_within(rng: np.random.Generator, boxes: np.ndarray, each: int) -> np.ndarray:
    """`each` points (x, y, z, intensity) in every box, clear of its faces; ordered by box."""
    local = rng.uniform(-0.95, 0.95, (len(boxes), each, 3)) * boxes[:, None, 3:6] / 2
    cosine, sine = np.cos(boxes[:, None, 6]), np.sin(boxes[:, None, 6])
    x, y = local[..., 0] * cosine - local[..., 1] * sine, local[..., 0] * sine + local[..., 1] * cosine
    places = np.stack([x, y, local[..., 2]], -1) + boxes[:, None, :3]
    points = np.concatenate([places, rng.random((len(boxes), each, 1))], -1)
    return points.reshape(-1, 4).astype(np.float32)


def padded(rows: np.ndarray, size: int, fill: float = 0) -> np.ndarray:
    result = np.full((size, *rows.shape[1:]), fill, rows.dtype)
    result[: len(rows)] = rows
    return result


def make_scene(points: np.ndarray, boxes: np.ndarray, label: np.ndarray) -> Scene:
    truth = GroundTruth(
        Boxes.from_array(padded(boxes, BOXES)),
        padded(np.asarray(label, np.int32), BOXES, -1),
        np.array(len(boxes), np.int32),
    )
    none = np.array(0, np.int32)
    return Scene(PointCloud(padded(points, POINTS), np.array(len(points), np.int32)), truth, none, none, none, none)


def random_scene(seed: int, number: int = 6, reach: float = 6.0) -> Scene:
    """Boxes, some of them obstacles, with points inside and around."""
    rng = np.random.default_rng(seed)
    boxes = random_boxes(rng, number, reach)
    around = np.concatenate([rng.uniform([0, -6, -2], [12, 6, 0], (100, 3)), rng.random((100, 1))], 1)
    points = np.concatenate([points_within(rng, boxes, 20), around.astype(np.float32)])
    return make_scene(rng.permutation(points), boxes, rng.choice([-1, 0, 0, 1], number))


def make_objects(boxes: np.ndarray, points: np.ndarray, owner: np.ndarray, valid: np.ndarray, wanted) -> SampledObjects:
    return SampledObjects(
        Boxes.from_array(boxes),
        LABELS,
        valid,
        padded(points, PASTE_POINTS),
        padded(owner.astype(np.int32), PASTE_POINTS, OBJECTS),
        np.array(wanted, np.int32),
        np.array(0, np.int32),
    )


def random_objects(seed: int, reach: float = 7.0, each: int = 10) -> SampledObjects:
    """Sampled objects, some slots empty, and `wanted` from none to all."""
    rng = np.random.default_rng((seed, 1))
    valid = rng.random(OBJECTS) < 0.9
    boxes = random_boxes(rng, OBJECTS, reach) * valid[:, None]
    owner = np.repeat(np.flatnonzero(valid), each)
    return make_objects(boxes, points_within(rng, boxes[valid], each), owner, valid, rng.integers(0, np.add(ROUND, 1)))


def no_objects() -> SampledObjects:
    return make_objects(
        np.zeros((OBJECTS, 7), np.float32), np.zeros((0, 4), np.float32), np.zeros(0), np.zeros(OBJECTS, bool), (0, 0)
    )


def real_boxes(scene: Scene) -> np.ndarray:
    return np.asarray(scene.truth.boxes.to_array())[: int(scene.truth.count)]


def real_points(scene: Scene) -> np.ndarray:
    return np.asarray(scene.cloud.points)[: int(scene.cloud.count)]


def overlapping(boxes: np.ndarray) -> set[tuple[int, int]]:
    """Pairs whose footprints share more than float32's rounding."""
    polygons = [footprint(box) for box in boxes]
    pairs = itertools.combinations(range(len(boxes)), 2)
    return {(i, j) for i, j in pairs if polygons[i].intersection(polygons[j]).area > 1e-4}


def assert_padding_is_inert(scene: Scene) -> None:
    assert not np.asarray(scene.cloud.points)[int(scene.cloud.count) :].any()
    assert not np.asarray(scene.truth.boxes.to_array())[int(scene.truth.count) :].any()
    assert (np.asarray(scene.truth.label)[int(scene.truth.count) :] == -1).all()


def assert_same(one: Scene, other: Scene) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


def stacked(scenes: list) -> Scene:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *scenes)


def unstacked(batch, index: int):
    return jax.tree.map(lambda leaf: leaf[index], batch)


# Ground-truth sampling


def test_draws_are_accepted_as_defined():
    """On 300 crowded scenes, against the loop."""
    scenes = [random_scene(seed) for seed in range(300)]
    objects = [random_objects(seed) for seed in range(300)]
    accepted = np.asarray(jax.jit(jax.vmap(accept))(stacked(scenes).truth, stacked(objects)))
    for scene, draws, result in zip(scenes, objects, accepted, strict=True):
        expected = accept_by_loop(real_boxes(scene), draws.boxes.to_array(), draws.valid, draws.wanted, ROUND)
        np.testing.assert_array_equal(result, expected)
    assert 0.1 < accepted.mean() < 0.6
    assert accepted[:, ROUND[0] : 2 * ROUND[0]].any()


def draws_at(places: list[float | None], wanted) -> SampledObjects:
    """A unit box and a point for every slot at x, or none."""
    boxes, owner = np.zeros((OBJECTS, 7), np.float32), []
    for slot, x in enumerate(places):
        if x is not None:
            boxes[slot] = [x, 0, 0, 1, 1, 1, 0]
            owner.append(slot)
    valid = np.isin(np.arange(OBJECTS), owner)
    points = np.concatenate([boxes[owner, :3], np.ones((len(owner), 1), np.float32)], 1)
    return make_objects(boxes, points, np.array(owner), valid, wanted)


@pytest.mark.parametrize(
    ("places", "wanted", "expected"),
    [
        # Of two that collide the earlier is rejected, even if the later collides with a truth box (at x = 0).
        ([5, 5.5, 8, None], (3, 0), [1, 2]),
        ([1.2, 0.5, 8, None], (3, 0), [2]),
        # A chain: each of the first two collides with its successor only.
        ([5, 5.8, 6.6, None], (3, 0), [2]),
        # The second round has `wanted` draws, which ignore the unused ones.
        ([5, 0, None, None, 0, 8, 8.5, None], (3, 0), [0, 5]),
        ([5, 0, 7, None, 9, 9.5, 12, None], (3, 0), [0, 2, 4]),
        ([0, 0, 0, None, 5, 5.5, 9, None], (3, 0), [5, 6]),
        ([5, 7, 9, 11, 13, 15, 17, 19], (0, 0), []),
        # The second class avoids the objects of the first.
        ([5, None, None, None, 7, None, None, None, 5.5, 9], (2, 2), [0, 4, 9]),
        ([5, None, None, None, 7, None, None, None, 9, 7.5, 9.5, 11], (2, 2), [0, 4, 8]),
    ],
)
def test_rounds_by_hand(places, wanted, expected):
    scene = make_scene(np.zeros((0, 4), np.float32), np.array([[0, 0, 0, 1, 1, 1, 0]], np.float32), [-1])
    accepted = accept(scene.truth, draws_at(places, wanted))
    np.testing.assert_array_equal(np.flatnonzero(accepted), expected)


@pytest.mark.parametrize("seed", range(12))
def test_added_points_come_first_and_covered_ones_leave(seed):
    scene, objects = random_scene(seed), random_objects(seed)
    accepted = np.flatnonzero(accept(scene.truth, objects))
    boxes = objects.boxes.to_array()
    comes = objects.points[np.isin(objects.owner, accepted)]
    covered = np.zeros(int(scene.cloud.count), bool)
    for slot in accepted:
        covered |= inside(real_points(scene), boxes[slot])
    result = add_objects(scene, objects)
    np.testing.assert_array_equal(real_points(result), np.concatenate([comes, real_points(scene)[~covered]]))
    np.testing.assert_array_equal(real_boxes(result), np.concatenate([real_boxes(scene), boxes[accepted]]))
    labels = np.asarray(result.truth.label)[int(scene.truth.count) : int(result.truth.count)]
    np.testing.assert_array_equal(labels, LABELS[accepted])
    assert (int(result.points_cut), int(result.boxes_cut)) == (0, 0)
    assert overlapping(real_boxes(result)) == overlapping(real_boxes(scene))
    assert_padding_is_inert(result)


def test_an_object_without_a_free_box_stays_out_and_is_counted():
    boxes = random_boxes(np.random.default_rng(0), BOXES - 1)
    scene = make_scene(np.full((9, 4), -30, np.float32), boxes, [0] * (BOXES - 1))
    cut = {"points_cut": 3, "boxes_cut": 1, "objects_cut": 2}
    scene = scene._replace(**{name: np.array(number, np.int32) for name, number in cut.items()})
    draws = draws_at([40, 50, 60, 70], (4, 0))._replace(cut=np.array(5, np.int32))
    result = add_objects(scene, draws)
    assert (int(result.truth.count), int(result.boxes_cut), int(result.objects_cut)) == (BOXES, 1 + 3, 2 + 5)
    assert (int(result.cloud.count), int(result.points_cut)) == (10, 3)
    np.testing.assert_array_equal(real_points(result)[0], [40, 0, 0, 1])


def test_points_over_capacity_are_cut_from_the_end():
    points = np.concatenate([np.full((POINTS, 3), -30), np.linspace(0, 1, POINTS)[:, None]], 1).astype(np.float32)
    scene = make_scene(points, np.zeros((0, 7), np.float32), [])
    result = add_objects(scene, draws_at([5, 7, 9], (3, 0)))
    assert (int(result.cloud.count), int(result.points_cut), int(result.truth.count)) == (POINTS, 3, 3)
    np.testing.assert_array_equal(real_points(result)[3:], points[:-3])


# Noise


@cache
def noise_case() -> tuple[list[Scene], np.ndarray, np.ndarray, Scene]:
    """120 crowded scenes with tries, and the results."""
    scenes = [random_scene(seed, number=9) for seed in range(120)]
    rng = np.random.default_rng(0)
    shifts = rng.normal(0, [1, 1, 0.5], (120, BOXES, 8, 3)).astype(np.float32)
    turns = rng.uniform(-0.785, 0.785, (120, BOXES, 8)).astype(np.float32)
    return scenes, shifts, turns, jax.jit(jax.vmap(move_objects))(stacked(scenes), shifts, turns)


def test_boxes_move_as_defined():
    """Against the loop; points within 1e-4 of a face of a box may move with it or not."""
    scenes, shifts, turns, batch = noise_case()
    moves = []
    for index, scene in enumerate(scenes):
        boxes, points = real_boxes(scene), real_points(scene)
        targets = scene.truth.label[: len(boxes)] >= 0
        moved, places, changed = move_by_loop(boxes, targets, points, shifts[index], turns[index])
        result = unstacked(batch, index)
        np.testing.assert_allclose(real_boxes(result), moved, rtol=0, atol=1e-5)
        clear = np.ones(len(points), bool)
        for box in boxes:
            clear &= np.abs(np.abs(box_coordinates(points, box)).max(-1) - 1) > 1e-4
        np.testing.assert_allclose(real_points(result)[clear], places[clear], rtol=0, atol=1e-5)
        still = (places == points).all(-1) & clear
        np.testing.assert_array_equal(real_points(result)[still], points[still])
        assert_padding_is_inert(result)
        moves.append(changed[targets].mean() if targets.any() else 1)
    assert 0.5 < np.mean(moves) < 1


def test_noise_makes_no_collision():
    scenes, _, _, batch = noise_case()
    for index, scene in enumerate(scenes):
        assert overlapping(real_boxes(unstacked(batch, index))) <= overlapping(real_boxes(scene))


def test_a_box_without_a_clear_try_keeps_its_bits():
    rng = np.random.default_rng(0)
    wall = [[10, y, 0, 30, 3, 1, 0] for y in (-2.6, 2.6)]
    boxes = np.array([[10, 0, 0, 4, 2, 1, 0], *wall], np.float32)
    points = points_within(rng, boxes, 50)
    scene = make_scene(points, boxes, [0, -1, -1])
    shifts = rng.uniform(1, 2, (BOXES, 5, 3)).astype(np.float32)
    turns = np.full((BOXES, 5), 0.7, np.float32)
    assert_same(jax.jit(move_objects)(scene, shifts, turns), scene)


def test_a_point_in_two_targets_follows_the_first():
    boxes = np.array([[5, 0, 0, 4, 4, 2, 0], [7, 0, 0, 4, 4, 2, 0]], np.float32)
    scene = make_scene(np.array([[6, 0, 0, 1], [8, 0, 0, 1]], np.float32), boxes, [0, 0])
    shifts = np.zeros((BOXES, 1, 3), np.float32)
    shifts[0], shifts[1] = [-9, 0, 1], [9, 0, 2]
    result = jax.jit(move_objects)(scene, shifts, np.zeros((BOXES, 1), np.float32))
    np.testing.assert_array_equal(real_points(result), [[-3, 0, 1, 1], [17, 0, 2, 1]])


def test_noise_has_the_given_spread():
    far = np.array([[1000 * i, 0, 0, 4, 2, 1.5, 0] for i in range(BOXES)], np.float32)
    scene = make_scene(np.zeros((0, 4), np.float32), far, [0] * BOXES)
    noise = jax.jit(jax.vmap(partial(add_object_noise, config=AugmentationConfig()), in_axes=(0, None)))
    moved = noise(jax.random.split(jax.random.key(0), 200), scene).truth.boxes
    shift = np.asarray(moved.center - far[None, :, :3]).reshape(-1, 3)
    turn = np.asarray(moved.yaw).ravel()
    np.testing.assert_allclose(shift.std(0), [1, 1, 0.5], rtol=0.1)
    np.testing.assert_allclose(shift.mean(0), 0, atol=0.1)
    assert 0.78 < abs(turn).max() <= 0.785
    np.testing.assert_allclose(turn.std(), 0.785 / np.sqrt(3), rtol=0.1)
    assert len(np.unique(turn)) > 3000


# The whole scene


def test_flip_and_turn_in_the_papers_angle():
    """In the paper's angle r, a flip is r -> pi - r and a clockwise rotation by theta is r += theta."""
    scene = random_scene(0)
    before, theta = np.asarray(to_paper(scene.truth.boxes)), 0.6
    mirrored = np.asarray(to_paper(flip(scene, jnp.array(True)).truth.boxes))
    turned = rotate(scene, jnp.array(-theta))
    after = np.asarray(to_paper(turned.truth.boxes))
    count = int(scene.truth.count)
    for angle, expected in ((mirrored, np.pi - before), (after, before + theta)):
        difference = angle[:count, 6] - expected[:count, 6]
        np.testing.assert_allclose(np.cos(difference), 1, atol=1e-6)
    x, y = real_points(scene)[:, :2].T
    clockwise = [x * np.cos(theta) + y * np.sin(theta), -x * np.sin(theta) + y * np.cos(theta)]
    np.testing.assert_allclose(real_points(turned)[:, :2].T, clockwise, atol=1e-5)
    assert_same(flip(scene, jnp.array(False)), scene)


@given(
    seed=st.integers(0, 2**31 - 1),
    mirrored=st.booleans(),
    angle=st.floats(-0.78125, 0.78125, width=32),
    factor=st.floats(0.9375, 1.0625, width=32),
)
@settings(max_examples=40, deadline=None)
def test_an_object_keeps_its_points(seed, mirrored, angle, factor):
    """Every geometric step leaves a point where it was in the box that held it, mirrored by a flip."""
    rng = np.random.default_rng(seed)
    boxes = random_boxes(rng, 8, reach=14)
    boxes = boxes[[not any(i in pair for pair in overlapping(boxes)) for i in range(8)]]
    points = points_within(rng, boxes, 20)
    scene = make_scene(points, boxes, np.zeros(len(boxes)))
    for step, argument in (("noise", None), ("flip", mirrored), ("rotate", angle), ("scale", factor)):
        after = noise(jax.random.key(seed), scene) if step == "noise" else compiled[step](scene, jnp.array(argument))
        assert int(after.truth.count) == len(boxes)
        assert not overlapping(real_boxes(after))
        for slot, (old, new) in enumerate(zip(real_boxes(scene), real_boxes(after), strict=True)):
            rows = slice(20 * slot, 20 * slot + 20)
            local = box_coordinates(real_points(scene)[rows], old)
            local[:, 1] *= -1 if step == "flip" and mirrored else 1
            np.testing.assert_allclose(box_coordinates(real_points(after)[rows], new), local, rtol=0, atol=2e-4)
            assert inside(real_points(after)[rows], new).all()
        np.testing.assert_array_equal(real_points(after)[:, 3], points[:, 3])
        assert_padding_is_inert(after)
        scene = after


def test_every_order_of_points_is_as_likely():
    points = np.arange(16, dtype=np.float32).reshape(4, 4)
    scene = make_scene(points, np.zeros((0, 7), np.float32), [])
    keys = jax.random.split(jax.random.key(0), 2400)
    shuffled = jax.jit(jax.vmap(lambda key: shuffle_points(key, scene).cloud.points[:4, 0]))(keys)
    orders, counts = np.unique(np.asarray(shuffled), axis=0, return_counts=True)
    assert len(orders) == 24
    assert ((counts > 60) & (counts < 140)).all()


def test_targets_in_range_are_kept():
    """One corner strictly inside is enough, at any z."""
    square = [2, 2, 1, 0]
    boxes = np.array(
        [
            [5, 0, 0, *square],
            [-0.5, 0, 0, *square],
            [-1, 0, 0, *square],
            [5, 7.3, 99, *square],
            [5, 7.4, 0, *square],
            # All corners are outside, though the box crosses the range.
            [6.4, 0, 0, 40, 1, 1, 0],
            [5, 3, 0, *square],
            [-1.2, 0, 0, 2, 2, 1, np.pi / 4],
        ],
        np.float32,
    )
    scene = make_scene(np.zeros((3, 4), np.float32), boxes, [0, 1, 0, 1, 0, 0, -1, 0])
    result = jax.jit(partial(keep_targets, minimum=CONFIG.grid.minimum, maximum=CONFIG.grid.maximum))(scene)
    np.testing.assert_array_equal(real_boxes(result), boxes[[0, 1, 3, 7]])
    np.testing.assert_array_equal(result.truth.label[:4], [0, 1, 1, 0])
    assert int(result.cloud.count) == 3
    assert_padding_is_inert(result)
    assert_same(jax.jit(partial(keep_targets, minimum=(-99.0,) * 3, maximum=(99.0,) * 3))(result), result)


# All together


def test_the_same_numbers_give_the_same_bits():
    scene, objects = random_scene(0), random_objects(0)
    results = {}
    for numbers in itertools.product((0, 1), (0, 1), (0, 5)):
        result = compiled_augment(scene_key(*numbers), scene, objects, CONFIG)
        assert_same(result, compiled_augment(scene_key(*numbers), scene, objects, CONFIG))
        results[np.asarray(result.cloud.points).tobytes()] = numbers
        assert_padding_is_inert(result)
    assert len(results) == 8


def test_a_batch_is_its_scenes():
    scenes, objects = ([one(seed) for seed in range(4)] for one in (random_scene, random_objects))
    scenes.append(make_scene(np.zeros((0, 4), np.float32), np.zeros((0, 7), np.float32), []))
    objects.append(no_objects())
    keys = jax.vmap(lambda frame: scene_key(0, 0, frame))(jnp.arange(5))
    batch = jax.jit(jax.vmap(partial(augment, config=CONFIG)))(keys, stacked(scenes), stacked(objects))
    for index in range(5):
        single = compiled_augment(scene_key(0, 0, index), scenes[index], objects[index], CONFIG)
        jax.tree.map(partial(np.testing.assert_allclose, rtol=0, atol=2e-5), unstacked(batch, index), single)
    assert int(single.cloud.count) == int(single.truth.count) == 0
    assert_padding_is_inert(single)


def test_room_for_more_changes_nothing():
    """Larger capacities give the same real rows."""
    scene, objects = random_scene(1), random_objects(1)
    wide = Scene(
        PointCloud(padded(scene.cloud.points, 2 * POINTS), scene.cloud.count),
        GroundTruth(
            Boxes.from_array(padded(scene.truth.boxes.to_array(), 2 * BOXES)),
            padded(scene.truth.label, 2 * BOXES, -1),
            scene.truth.count,
        ),
        *scene[2:],
    )
    more = objects._replace(
        points=padded(objects.points, 2 * PASTE_POINTS), owner=padded(objects.owner, 2 * PASTE_POINTS, OBJECTS)
    )
    small, large = (compiled_augment(scene_key(0, 0, 0), *pair, CONFIG) for pair in ((scene, objects), (wide, more)))
    np.testing.assert_allclose(real_points(large), real_points(small), rtol=0, atol=2e-5)
    np.testing.assert_allclose(real_boxes(large), real_boxes(small), rtol=0, atol=2e-5)
    assert_padding_is_inert(large)


def with_switches(**switches: bool):
    names = ("gt_sampling", "object_noise", "global_transform")
    augmentation = AugmentationConfig(**{name: switches.get(name, False) for name in names})
    return replace(CONFIG, data=replace(CONFIG.data, augmentation=augmentation))


def test_everything_off_only_orders_points_and_drops_what_is_no_target():
    scene, key = random_scene(2), scene_key(0, 0, 0)
    result = compiled_augment(key, scene, random_objects(2), with_switches())
    kept = keep_targets(scene, minimum=CONFIG.grid.minimum, maximum=CONFIG.grid.maximum)
    assert_same(Scene(scene.cloud, *result[1:]), kept)
    before, after = (points[np.lexsort(points.T)] for points in (real_points(scene), real_points(result)))
    np.testing.assert_array_equal(before, after)


@pytest.mark.parametrize("switch", ["gt_sampling", "object_noise", "global_transform"])
def test_one_switch_does_one_thing(switch):
    scene, objects, key = random_scene(3), random_objects(3), scene_key(0, 0, 0)
    result = compiled_augment(key, scene, objects, with_switches(**{switch: True}))
    plain = compiled_augment(key, scene, objects, with_switches())
    one = compiled_augment(key, scene, no_objects(), with_switches(**{switch: True}))
    if switch == "gt_sampling":
        assert int(result.truth.count) > int(plain.truth.count)
        assert_same(one, plain)
    else:
        # The sampled objects play no part.
        assert_same(one, result)
        assert int(result.cloud.count) == int(scene.cloud.count)
        assert np.abs(real_points(result) - real_points(plain)).max() > 0.1
    if switch != "global_transform":
        # Background points keep their bits.
        background = ~np.any([inside(real_points(scene), box) for box in real_boxes(scene)], 0)
        rows = {row.tobytes() for row in real_points(result)}
        stays = [row.tobytes() in rows for row in real_points(scene)[background]]
        assert np.mean(stays) > (0.5 if switch == "gt_sampling" else 0.999)


def test_without_slots_nothing_is_added():
    config = replace(CONFIG, classes=tuple(replace(one, gt_sampling_up_to=0) for one in CONFIG.classes))
    none = np.zeros(0, np.int32)
    objects = no_objects()._replace(
        boxes=Boxes.from_array(np.zeros((0, 7), np.float32)),
        label=none,
        valid=none.astype(bool),
        owner=np.zeros(PASTE_POINTS, np.int32),
    )
    scene, key = random_scene(4), scene_key(0, 0, 0)
    assert_same(
        compiled_augment(key, scene, objects, config),
        compiled_augment(key, scene, no_objects(), with_switches(object_noise=True, global_transform=True)),
    )


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**31 - 1))
def test_augmented_scenes_keep_objects_apart(seed):
    """Augmentation adds no collision between targets, and every lost point is counted."""
    scene, objects = random_scene(seed, number=10), random_objects(seed)
    result = compiled_augment(scene_key(seed, 0, 0), scene, objects, CONFIG)
    assert len(overlapping(real_boxes(result))) <= len(overlapping(real_boxes(scene)))
    added = add_objects(scene, objects)
    assert int(result.cloud.count) == int(added.cloud.count)
    intensities = (np.sort(real_points(one)[:, 3]) for one in (result, added))
    np.testing.assert_array_equal(*intensities)
    assert np.isfinite(real_points(result)).all()
