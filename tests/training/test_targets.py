"""Targets: the released assigner's numbers, a plain loop, and properties of any scene."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles_training import assign_by_loop, encode_by_hand, nearest_iou_by_loop

from ciassd_jax.config import ClassConfig, GridConfig
from ciassd_jax.config.presets import car, car_released, tiny
from ciassd_jax.model.anchors import make_anchors
from ciassd_jax.ops.boxes import direction_target, from_paper, nearest_aligned, r_to_yaw, to_paper, wrap_r
from ciassd_jax.training.targets import assign_targets, nearest_iou
from ciassd_jax.types import Boxes, GroundTruth, Targets

# Two classes on a grid of numbers that are exact in float32, so that ties do not depend on rounding.
SMALL = replace(
    tiny(),
    grid=GridConfig(
        minimum=(0.0, -4.0, -3.0), maximum=(8.0, 4.0, 1.0), voxel_size=(0.125, 0.125, 0.2), max_voxels=2048
    ),
    classes=(
        ClassConfig(width=1.5, length=4.0, height=1.5, matched=0.5, unmatched=0.25),
        ClassConfig(name="Pedestrian", width=0.75, length=1.0, height=1.75, matched=0.625, unmatched=0.375),
    ),
)
ANCHORS, LABELS = make_anchors(SMALL)
CAPACITY = 8


@partial(jax.jit, static_argnames="config")
def assign(truth: GroundTruth, config=SMALL) -> Targets:
    anchors, labels = make_anchors(config)
    return assign_targets(truth, anchors, labels, config.classes)


def scene(paper: np.ndarray, labels: np.ndarray | None = None, capacity: int = CAPACITY) -> GroundTruth:
    """A padded scene of boxes [n, 7] (x, y, z, w, l, h, r), by default of the first class."""
    paper = np.asarray(paper, np.float64).reshape(-1, 7)
    number = len(paper)
    boxes = np.zeros((capacity, 7), np.float32)
    boxes[:number] = np.concatenate([paper[:, :3], paper[:, [4, 3, 5]], -paper[:, 6:] - np.pi / 2], 1)
    label = np.full(capacity, -1, np.int32)
    label[:number] = 0 if labels is None else labels
    return GroundTruth(Boxes.from_array(jnp.asarray(boxes)), jnp.asarray(label), jnp.int32(number))


def random_boxes(rng: np.random.Generator, number: int, labels: np.ndarray, step: float = 0.0) -> np.ndarray:
    """Boxes about the size of their class, inside and outside the small range; multiples of `step` if it is not 0."""
    size = np.array([[c.width, c.length, c.height] for c in SMALL.classes])[labels]
    boxes = np.concatenate(
        [
            rng.uniform([-1, -5, -1.5], [9, 5, -0.5], (number, 3)),
            size * rng.uniform(0.7, 1.4, (number, 3)),
            rng.uniform(-7, 7, (number, 1)),
        ],
        1,
    )
    if step:
        boxes[:, :6] = np.maximum(np.round(boxes[:, :6] / step), [-99, -99, -99, 1, 1, 1]) * step
    return boxes


# The released code's numbers


@pytest.mark.reference
@pytest.mark.parametrize("name", ["000005", "000010", "000068", "000095", "synthetic"])
def test_golden_targets(shared, name):
    with np.load(shared / "golden" / f"targets_{name}.npz") as data:
        golden = dict(data)
    targets = assign(scene(golden["gt_boxes"], capacity=64), config=car_released())
    clear = np.setdiff1d(np.arange(70400), golden["ambiguous_anchors"])
    np.testing.assert_array_equal(np.asarray(targets.label)[clear], golden["labels"][clear])

    positive = golden["positive_indices"]
    known = np.isin(positive, clear)
    positive = positive[known]
    np.testing.assert_array_equal(np.asarray(targets.truth)[positive], golden["positive_gt_id"][known])
    np.testing.assert_array_equal(np.asarray(targets.direction)[positive], golden["dir_targets_pos"][known])
    np.testing.assert_allclose(np.asarray(targets.box)[positive], golden["reg_targets_pos"][known], rtol=0, atol=1e-5)
    assert not np.asarray(targets.box)[np.asarray(targets.label) != 1].any()


def test_numbers_of_the_released_code():
    boxes = [
        (20.3, 3.1, -0.8, 1.65, 4.1, 1.5, 0.3),
        (41.0, -12.25, -1.1, 1.8, 4.6, 1.7, -1.45),
        (8.0, 25.0, -0.9, 1.5, 3.2, 1.45, 2.4),
    ]
    targets = jax.tree.map(np.asarray, assign(scene(boxes), config=car_released()))
    assert [(targets.label == value).sum() for value in (1, -1, 0)] == [17, 22, 70361]
    expected = {
        1: [24489, 24491, 24493, 24495, 24497],
        0: [37412, 37764, 37766, 38116, 38118, 38468],
        2: [56710, 56712, 57062, 57064, 57414, 57416],
    }
    for truth, anchors in expected.items():
        np.testing.assert_array_equal(np.flatnonzero(targets.truth == truth), anchors)
        np.testing.assert_array_equal(targets.direction[anchors], float(boxes[truth][6] > 0))
    residuals = [
        [0.023722, 0.023722, 0.128205, 0.030772, 0.050010, -0.039221, 0.3],
        [0, -0.011861, -0.064103, 0.117783, 0.165080, 0.085942, -3.02],
    ]
    np.testing.assert_allclose(targets.box[[37764, 24493]], residuals, rtol=0, atol=2e-6)
    anchors, _ = make_anchors(car_released())
    iou = np.asarray(nearest_iou(scene(boxes).boxes, anchors))
    np.testing.assert_allclose(
        iou[[0, 1, 2, 2], [37764, 24493, 57062, 57064]], [0.842721, 0.753624] + [0.642857] * 2, atol=2e-6
    )


# The definition


@pytest.mark.smoke
def test_agrees_with_a_plain_loop():
    """Exact labels and matches with ties, ignored anchors, forced anchors and two classes."""
    paper_anchors = np.asarray(to_paper(ANCHORS))
    forced_ties = ignored = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        labels = rng.integers(-1, 2, 7)
        truth = scene(random_boxes(rng, 7, labels, step=0.125), labels)
        paper = np.asarray(to_paper(truth.boxes))[:7]
        expected, owner = np.zeros(len(LABELS), int), np.full(len(LABELS), -1)
        for number, one in enumerate(SMALL.classes):
            anchors, boxes = np.flatnonzero(number == LABELS), np.flatnonzero(labels == number)
            iou = nearest_iou_by_loop(paper[boxes], paper_anchors[anchors])
            label, match = assign_by_loop(iou, one.matched, one.unmatched)
            expected[anchors] = label
            owner[anchors[match >= 0]] = boxes[match[match >= 0]]
            ignored += (label == -1).sum()
            best = iou.max(0, initial=0)
            forced_ties += (((iou == best) & (iou > 0)).sum(0)[best < one.matched] > 1).sum()
        targets = jax.tree.map(np.asarray, assign(truth))
        np.testing.assert_array_equal(targets.label, expected)
        np.testing.assert_array_equal(targets.truth, owner)
        for anchor in np.flatnonzero(owner >= 0):
            box = encode_by_hand(paper[owner[anchor]], paper_anchors[anchor])
            np.testing.assert_allclose(targets.box[anchor], box, rtol=0, atol=1e-5)
            assert targets.direction[anchor] == (box[6] + paper_anchors[anchor, 6] > 0)
        assert not targets.box[owner < 0].any()
        assert not targets.direction[owner < 0].any()
    assert ignored > 100
    assert forced_ties > 3


def test_a_forced_anchor_is_matched_to_the_box_that_it_overlaps_most():
    """The best anchor of a small box coincides with a larger box, and stays matched to that one."""
    anchor = np.asarray(to_paper(ANCHORS))[len(LABELS) // 2]
    small = anchor.copy()
    small[3:5] /= 4
    targets = jax.tree.map(np.asarray, assign(scene([anchor, small])))
    assert targets.truth[len(LABELS) // 2] == 0
    alone = jax.tree.map(np.asarray, assign(scene([small])))
    assert alone.label[len(LABELS) // 2] == 1
    assert (alone.label == 1).sum() > 1, "every anchor around the small box has the same overlap"
    # Their overlap is below the threshold.
    iou = np.where(LABELS == 0, np.asarray(nearest_iou(scene([small]).boxes, ANCHORS))[0], 0)
    assert iou.max() == pytest.approx(1 / 16)
    np.testing.assert_array_equal(alone.label == 1, iou == iou.max())


def test_no_box_goes_without_an_anchor():
    """At full size and in a batch, where the compiler might recompute an overlap with different rounding."""
    x, y = np.meshgrid(np.arange(3, 67, 8.0), np.arange(-36, 36, 9.0))
    rng = np.random.default_rng(0)
    paper = np.zeros((2, 64, 7))
    paper[..., :2] = np.stack([x.ravel(), y.ravel()], -1) + rng.uniform(-2, 2, (2, 64, 2))
    paper[..., 3:6] = rng.uniform(0.3, 0.9, (2, 64, 3))
    paper[..., 6] = rng.uniform(-3, 3, (2, 64))
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(scene(boxes, capacity=64) for boxes in paper))
    targets = jax.jit(jax.vmap(partial(assign, config=car())))(batch)
    for truth in np.asarray(targets.truth):
        np.testing.assert_array_equal(np.unique(truth), np.arange(-1, 64))


def test_a_class_has_its_own_anchors_and_thresholds():
    """The same box as a car, as a pedestrian, as both, and with no class."""
    box = np.asarray(to_paper(ANCHORS))[2 * 4 * 17]
    as_car, as_pedestrian, obstacle = (jax.tree.map(np.asarray, assign(scene([box], [label]))) for label in (0, 1, -1))
    for targets, label in ((as_car, 0), (as_pedestrian, 1)):
        assert (targets.label == 1).any()
        assert not targets.label[label != LABELS].any()
    both = jax.tree.map(np.asarray, assign(scene([box, box], [0, 1])))
    np.testing.assert_array_equal(both.label, as_car.label + as_pedestrian.label)
    np.testing.assert_array_equal(np.unique(both.truth[LABELS == 1]), [-1, 1])
    assert not obstacle.label.any()


# Properties


def assert_same(a: Targets, b: Targets) -> None:
    jax.tree.map(np.testing.assert_array_equal, a, b)


@given(seed=st.integers(0, 2**32 - 1), number=st.integers(0, 6))
@settings(max_examples=25, deadline=None)
def test_padding_is_inert(seed, number):
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 2, number)
    boxes = random_boxes(rng, number, labels)
    clean = scene(boxes, labels)
    rows = np.array(clean.boxes.to_array())
    rows[number:] = rng.choice([np.nan, np.inf, -1.0, 0.0, 4.0], (CAPACITY - number, 7))
    label = np.array(clean.label)
    label[number:] = rng.integers(-1, 2, CAPACITY - number)
    dirty = GroundTruth(Boxes.from_array(jnp.asarray(rows)), jnp.asarray(label), clean.count)
    assert_same(assign(clean), assign(dirty))
    assert_same(assign(clean), assign(scene(boxes, labels, capacity=13)))


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_the_order_of_the_boxes_is_irrelevant(seed):
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 2, CAPACITY)
    boxes, order = random_boxes(rng, CAPACITY, labels), rng.permutation(CAPACITY)
    one, other = assign(scene(boxes, labels)), assign(scene(boxes[order], labels[order]))
    assert_same(one, other._replace(truth=jnp.where(other.truth >= 0, jnp.asarray(order)[other.truth], -1)))


@given(anchor=st.integers(0, len(LABELS) - 1), turns=st.integers(-1, 1))
@settings(max_examples=25, deadline=None)
def test_a_box_on_an_anchor_is_found_by_it(anchor, turns):
    box = np.asarray(to_paper(ANCHORS))[anchor] + np.array([0] * 6 + [2 * np.pi * turns])
    targets = assign(scene([box], [LABELS[anchor]]))
    assert (targets.label[anchor], targets.truth[anchor]) == (1, 0)
    np.testing.assert_allclose(targets.box[anchor], np.zeros(7), rtol=0, atol=1e-5)
    assert set(np.unique(targets.label[LABELS[anchor] != LABELS])) == {0}


def test_a_batch_is_its_scenes():
    rng = np.random.default_rng(0)
    scenes = [scene(random_boxes(rng, number, np.zeros(number, int))) for number in (0, 3, CAPACITY)]
    batch = jax.jit(jax.vmap(assign))(jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes))
    for index, one in enumerate(scenes):
        jax.tree.map(
            partial(np.testing.assert_allclose, rtol=0, atol=1e-6),
            jax.tree.map(lambda leaf, i=index: leaf[i], batch),
            assign(one),
        )


# Boxes that are not targets

CAR_BOX = (4.0, 0.0, -1.0, 1.5, 4.0, 1.5, 0.3)


@pytest.mark.parametrize(
    ("index", "value"),
    [
        *((index, 0.0) for index in (3, 4, 5)),
        *((index, -1.0) for index in (3, 4, 5)),
        *((index, value) for index in range(7) for value in (np.nan, np.inf, -np.inf)),
        *((index, value) for index in (0, 1) for value in (-50.0, 500.0, 3e38)),
        (3, 3e38),
    ],
)
def test_boxes_without_volume_not_finite_or_far_away_have_no_anchor(index, value):
    bad = np.array(CAR_BOX)
    bad[index] = value
    targets = jax.tree.map(np.asarray, assign(scene([bad])))
    assert not targets.label.any()
    assert not targets.box.any()
    beside = jax.tree.map(np.asarray, assign(scene([bad, CAR_BOX])))
    alone = jax.tree.map(np.asarray, assign(scene([CAR_BOX])))
    np.testing.assert_array_equal(beside.label, alone.label)
    np.testing.assert_array_equal(beside.box, alone.box)


def test_of_identical_boxes_the_first_is_matched():
    twice, once = assign(scene([CAR_BOX, CAR_BOX])), assign(scene([CAR_BOX]))
    assert_same(twice, once)


def test_a_scene_without_boxes_is_all_negative():
    targets = assign(scene(np.zeros((0, 7))))
    assert not np.asarray(targets.label).any()
    assert (np.asarray(targets.truth) == -1).all()
    assert not np.asarray(targets.box).any()


# The angle r in `ops.boxes`


def test_r_is_wrapped_before_it_is_encoded():
    """r is in [-pi, pi) with the same heading, and its sign is the direction class."""
    r = np.array([-9.0, -3.2, -1.0, 0.0, 1e-3, 1.0, 3.2, 9.0])
    boxes = Boxes(np.zeros((8, 3), np.float32), np.ones((8, 3), np.float32), r_to_yaw(r).astype(np.float32))
    wrapped = wrap_r(boxes)
    expected = np.angle(np.exp(1j * r))
    np.testing.assert_allclose(to_paper(wrapped)[:, 6], expected, rtol=0, atol=2e-6)
    np.testing.assert_array_equal(direction_target(wrapped), expected > 0)


@pytest.mark.parametrize(
    ("r", "turned"),
    [(0.0, False), (0.78, False), (0.79, True), (1.57, True), (2.35, True), (2.36, False), (-3.0, False)],
)
def test_the_nearest_axis(r, turned):
    """At r = 0 the width is along x."""
    low, high = nearest_aligned(from_paper(jnp.array([1.0, 2.0, 0.0, 2.0, 4.0, 1.5, r])))
    np.testing.assert_allclose(high - low, (4, 2) if turned else (2, 4), rtol=1e-6)
    np.testing.assert_allclose(high + low, (2, 4), rtol=1e-6)
