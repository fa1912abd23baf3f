"""Post-processing: the released code's numbers, and where the paper's preset differs."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import polygon_iou_matrix, released_di_nms_loop

from ciassd_jax.config import Config
from ciassd_jax.config.presets import car, car_released, three_class
from ciassd_jax.inference.postprocess import finish, rectify, select_candidates, suppress
from ciassd_jax.ops.boxes import encode, from_paper, to_paper
from ciassd_jax.ops.nms import Clusters, rotated_nms
from ciassd_jax.types import Boxes, Candidates, Predictions

# The golden README's tolerances.
BOXES, SCORES = 1e-3, 1e-5
CASES = range(13)


class Stages(NamedTuple):
    """Everything between predictions and boxes; `anchor` is the index of each candidate's anchor."""

    candidates: Candidates
    anchor: jax.Array
    dropped: jax.Array
    ordered: Candidates
    clusters: Clusters
    boxes: Boxes
    score: jax.Array
    label: jax.Array
    count: jax.Array


@jax.jit
def detect(
    predictions: Predictions, anchors: Boxes, labels: jax.Array, config: Config, frustum: jax.Array | None = None
) -> Stages:
    """The stages of `postprocess` for one scene."""
    numbers = jnp.arange(labels.shape[0], dtype=jnp.int32)
    numbered, _ = select_candidates(predictions, anchors, numbers, config.detection)
    candidates, dropped = select_candidates(predictions, anchors, labels, config.detection)
    ordered, clusters = suppress(candidates, config.detection, config.classes)
    low, high = config.detection.z_limits
    result = finish(
        ordered,
        clusters,
        minimum=(*config.grid.minimum[:2], low),
        maximum=(*config.grid.maximum[:2], high),
        frustum=frustum,
        min_score=config.detection.min_score,
    )
    return Stages(candidates, numbered.label, dropped, ordered, clusters, *result)


def final(stages: Stages) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Check the padding; return the real rows of boxes (in the paper's order), scores and labels."""
    count = int(stages.count)
    paper, rows = np.asarray(to_paper(stages.boxes)), np.asarray(stages.boxes.to_array())
    assert not rows[count:].any()
    assert not np.asarray(stages.score)[count:].any()
    return paper[:count], np.asarray(stages.score)[:count], np.asarray(stages.label)[:count]


# The released code's numbers


@lru_cache
def golden_cases(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as data:
        return dict(data)


class Case(NamedTuple):
    """One golden case: the arrays by name, and the result of our stages."""

    data: dict[str, np.ndarray]
    stages: Stages

    @property
    def kept(self) -> np.ndarray:
        """Anchors above the score threshold, in order; golden's candidate numbers index this list."""
        return np.flatnonzero(self.data["keep_score"])

    @property
    def slots(self) -> np.ndarray:
        """Golden's candidate number of each of our valid slots."""
        number = np.full(len(self.stages.anchor) + len(self.data["keep_score"]), -1)
        number[self.kept] = np.arange(len(self.kept))
        return number[np.asarray(self.stages.anchor)[np.asarray(self.stages.candidates.valid)]]


@pytest.fixture(scope="module", params=CASES)
def case(request, shared) -> Case:
    """The case padded with anchors below the threshold to 128 (or 1280) of them, so that few shapes compile."""
    arrays = golden_cases(shared / "golden" / "postprocess_cases.npz")
    prefix = f"c{request.param:02d}_"
    data = {name.removeprefix(prefix): value for name, value in arrays.items() if name.startswith(prefix)}
    number = len(data["anchors"])
    slots = 128 if number <= 128 else 1280

    def pad(values: np.ndarray, padding: float) -> jax.Array:
        rest = np.full((slots - number, *values.shape[1:]), padding, np.float32)
        return jnp.asarray(np.concatenate([values, rest]))

    predictions = Predictions(
        box=pad(data["box_preds"], 0.0),
        class_logit=pad(data["cls_preds"][:, 0], -5.0),
        direction=pad(data["dir_cls_preds"], 0.0),
        iou=pad(data["iou_preds"][:, 0], 1.0),
    )
    anchors = from_paper(pad(data["anchors"], 1.0))
    planes = jnp.asarray(half_spaces(arrays["frustum"][0]), jnp.float32)
    stages = detect(predictions, anchors, jnp.zeros(slots, jnp.int32), car_released(), planes)
    return Case(data, stages)


def half_spaces(faces: np.ndarray) -> np.ndarray:
    """Planes (6, 4), positive inside, from golden's faces (6, 4, 3), whose normals point outwards."""
    first, second, third = faces[:, 0], faces[:, 1], faces[:, 2]
    normal = np.cross(first - second, second - third)
    planes = np.concatenate([-normal, (normal * first).sum(1, keepdims=True)], 1)
    return planes / np.linalg.norm(normal, axis=1, keepdims=True)


@pytest.mark.reference
def test_golden_candidates(case):
    data, (candidates, anchor, dropped, *_) = case
    valid = np.asarray(candidates.valid)
    assert valid.sum() == min(data["keep_score"].sum(), 1000)
    assert dropped == data["keep_score"].sum() - valid.sum()
    assert data["keep_score"][np.asarray(anchor)[valid]].all()
    if not valid.any():
        return
    rows = case.slots
    # The thousand best, best first; scores closer than their tolerance may change places.
    expected = data["rectified_scores"]
    np.testing.assert_allclose(
        np.asarray(candidates.score)[valid], np.sort(expected)[::-1][: valid.sum()], rtol=0, atol=SCORES
    )
    assert (np.diff(np.asarray(candidates.score)[valid]) <= 0).all()
    assert len(set(rows)) == len(rows)
    np.testing.assert_allclose(np.asarray(candidates.score)[valid], expected[rows], rtol=0, atol=SCORES)
    np.testing.assert_allclose(np.asarray(candidates.iou)[valid], data["iou01"][rows], rtol=0, atol=SCORES)
    decoded = np.asarray(to_paper(candidates.boxes))[valid]
    np.testing.assert_allclose(decoded, data["decoded"][rows], rtol=0, atol=BOXES)
    offset = data["decoded"] - data["anchors"][case.kept]
    np.testing.assert_allclose(
        np.asarray(candidates.anchor_distance)[valid], np.hypot(*offset[rows, :2].T), rtol=0, atol=BOXES
    )


@pytest.mark.reference
def test_golden_clusters(case):
    """After the NMS; rows that golden has as NaN are beyond 60 m and not selected here."""
    data, stages = case
    selected = np.asarray(stages.clusters.selected)
    if "nms_boxes" not in data:
        assert not selected.any()
        return
    real = np.isfinite(data["nms_boxes"]).all(1)
    assert selected.sum() == real.sum()
    boxes, scores = np.asarray(to_paper(stages.clusters.boxes))[selected], np.asarray(stages.clusters.score)[selected]
    np.testing.assert_allclose(boxes, data["nms_boxes"][real], rtol=0, atol=BOXES)
    np.testing.assert_allclose(scores, data["nms_scores"][real], rtol=0, atol=SCORES)
    np.testing.assert_array_equal(np.asarray(stages.ordered.direction)[selected], data["nms_dirs"][real])
    if len(real):
        np.testing.assert_allclose(boxes, data["nms_boxes_f64"][real], rtol=0, atol=BOXES)
        seeds = case.slots[selected[: len(case.slots)]]
        np.testing.assert_array_equal(seeds, data["cluster_seed_candidate"][real])
        assert (data["cluster_dist"][~real] >= 60).all()


@pytest.mark.reference
def test_golden_detections(case):
    boxes, scores, labels = final(case.stages)
    expected = case.data.get("final_boxes", np.zeros((0, 7)))
    assert boxes.shape == expected.shape
    np.testing.assert_allclose(boxes, expected, rtol=0, atol=BOXES)
    np.testing.assert_allclose(scores, case.data.get("final_scores", np.zeros(0)), rtol=0, atol=SCORES)
    np.testing.assert_array_equal(labels, case.data.get("final_labels", np.zeros(0)))


@jax.jit
def plain_nms(candidates: Candidates) -> list[jax.Array]:
    return [rotated_nms(candidates, overlap=overlap, limit=100).selected for overlap in (0.01, 0.1, 0.3)]


@pytest.mark.reference
def test_golden_plain_nms(case):
    if "plain_nms_keep_001" not in case.data:
        assert not np.asarray(case.stages.candidates.valid).any()
        return
    selections = plain_nms(case.stages.candidates)
    for name, selected in zip(("001", "010", "030"), selections, strict=True):
        # A nearer decision could fall either way in float32; there is none.
        assert case.data[f"plain_nms_margin_{name}"] > 1e-4
        kept = case.slots[np.asarray(selected)[: len(case.slots)]]
        np.testing.assert_array_equal(kept, case.data[f"plain_nms_keep_{name}"])


@pytest.mark.reference
def test_golden_clusters_by_the_loop(case):
    """The tests' slow reference gives the released numbers too, supports and cluster sizes included."""
    data = case.data
    if "decoded" not in data:
        assert not data["keep_score"].any()
        return
    order = np.argsort(-data["rectified_scores"], kind="stable")[:1000]
    decoded = data["decoded"][order].astype(np.float64)
    boxes = np.concatenate([decoded[:, :3], decoded[:, [4, 3, 5]], -decoded[:, 6:] - np.pi / 2], 1)
    distance = np.hypot(*(decoded - data["anchors"][case.kept][order])[:, :2].T)
    config = car_released().detection
    clusters = released_di_nms_loop(
        boxes,
        data["rectified_scores"][order].astype(np.float64),
        data["iou01"][order].astype(np.float64),
        distance,
        polygon_iou_matrix(boxes),
        overlap=config.nms_iou_threshold,
        support_threshold=np.full(len(order), 2.6),
        sigma_squared=config.sigma_squared,
        distances=config.sigma_distances,
    )
    found = [c for c in clusters if c.supported]
    if "cluster_cnt" not in data:
        assert found == []
        return
    np.testing.assert_array_equal(order[[c.candidate for c in found]], data["cluster_seed_candidate"])
    np.testing.assert_array_equal([len(c.members) for c in found], data["cluster_size"])
    np.testing.assert_allclose([c.support for c in found], data["cluster_cnt"], rtol=0, atol=1e-4)
    np.testing.assert_allclose([c.score for c in found], data["nms_scores_f64"], rtol=0, atol=SCORES)
    averaged = np.stack([c.box for c in found])
    averaged = np.concatenate([averaged[:, :3], averaged[:, [4, 3, 5]], -averaged[:, 6:] - np.pi / 2], 1)
    np.testing.assert_allclose(averaged, data["nms_boxes_f64"], rtol=0, atol=BOXES)


# Synthetic scenes: some boxes, each on an anchor of its own


SLOTS = 12


def scene(boxes: list[tuple], anchors: list[tuple] | None = None, **given) -> tuple[Predictions, Boxes, jax.Array]:
    """Predictions whose decoding gives `boxes` (x, y, z, yaw) of one size, padded with empty anchors.

    Anchors stand where the boxes do unless given as (x, y). Class logits fall slowly from 2, the raw IoU is 1,
    the direction class that of the box, all labels 0.
    """
    number = len(boxes)
    box = jnp.array([(x, y, z, 4.0, 2.0, 1.5, yaw) for x, y, z, yaw in boxes] + [(1, 1, 1, 4, 2, 1.5, 0)] * SLOTS)
    at = jnp.array([(x, y) for x, y, *_ in boxes] if anchors is None else anchors)
    onto = box.at[:number, :2].set(at).at[:, 6].set(-np.pi / 2)[:SLOTS]
    r = -(box[:SLOTS, 6] + np.pi / 2)

    def row(name: str, default: list[float], padding: float) -> jax.Array:
        values = [float(value) for value in given.get(name, default)]
        return jnp.array(values + [padding] * (SLOTS - number), jnp.float32)

    direction = row("direction", [float(value) for value in (r > 0)[:number]], 0)
    predictions = Predictions(
        box=encode(Boxes.from_array(box[:SLOTS]), Boxes.from_array(onto)),
        class_logit=row("logit", [2 - i / 10 for i in range(number)], -9),
        direction=jnp.stack([-direction, direction - 0.5], -1),
        iou=row("iou", [1] * number, 0),
    )
    return predictions, Boxes.from_array(onto), row("label", [0] * number, 0).astype(jnp.int32)


def three_at(x: float, y: float = 0.0, z: float = -1.0, yaw: float = -2.0) -> list[tuple]:
    return [(x, y, z, yaw)] * 3


def sigmoid(value: float) -> float:
    return 1 / (1 + np.exp(-value))


@pytest.mark.smoke
@pytest.mark.parametrize("config", [car(), car_released()], ids=["car", "released"])
def test_three_equal_boxes_give_one(config):
    boxes, scores, labels = final(detect(*scene(three_at(20.5)), config))
    np.testing.assert_allclose(boxes, [[20.5, 0, -1, 2, 4, 1.5, 2 - np.pi / 2]], rtol=0, atol=1e-5)
    # Three equal anchor distances: each softmax is 1 / 3.
    np.testing.assert_allclose(scores, [sigmoid(2) * 2 / 3], rtol=0, atol=1e-6)
    assert labels.tolist() == [0]


def test_beyond_sixty_metres():
    given = scene(three_at(65))
    assert len(final(detect(*given, car_released()))[0]) == 0
    boxes, *_ = final(detect(*given, car()))
    np.testing.assert_allclose(boxes[:, :3], [[65, 0, -1]], rtol=0, atol=1e-4)


def test_predicted_iou_is_clamped_in_the_paper_preset_only():
    raw, probability = jnp.array([1.5, -1.2, 0.0, -1.0]), jnp.full(4, 0.8)
    released, quality = rectify(probability, raw, car_released().detection)
    np.testing.assert_allclose(quality, [1.25, -0.1, 0.5, 0], rtol=0, atol=1e-6)
    np.testing.assert_allclose(released, [0.8 * 1.25**4, 0.8 * 0.1**4, 0.8 / 16, 0], rtol=0, atol=1e-6)
    clamped, quality = rectify(probability, raw, car().detection)
    np.testing.assert_allclose(quality, [1, 0, 0.5, 0], rtol=0, atol=1e-6)
    np.testing.assert_allclose(clamped, [0.8, 0, 0.8 / 16, 0], rtol=0, atol=1e-6)


def test_quality_above_one_supports_only_unclamped():
    """Two boxes of raw IoU 1.7 support each other by 2.7 as released, by 2 when clamped."""
    given = scene(three_at(20)[:2], iou=[1.7, 1.7])
    assert len(final(detect(*given, car_released()))[0]) == 1
    assert len(final(detect(*given, car()))[0]) == 0


def test_yaws_half_a_turn_apart():
    yaws = [-2.0, -2.0 + np.pi, -2.0 - np.pi, -2.0 + np.pi]
    given = scene([(20, 0, -1, yaw) for yaw in yaws], direction=[1] * 4)
    boxes, *_ = final(detect(*given, car()))
    np.testing.assert_allclose(boxes[:, 6], [2 - np.pi / 2], rtol=0, atol=1e-5)
    released, *_ = final(detect(*given, car_released()))
    # The mean of the numbers, r = 0.429 - pi / 4 < 0, then turned by the direction class.
    np.testing.assert_allclose(released[:, 6], [2 - np.pi / 2 - np.pi / 4 + np.pi], rtol=0, atol=1e-5)


def test_the_paper_picks_by_refined_score():
    """The most confident box is 3 m off its anchor: S is small, so another leads, with its own direction."""
    boxes = [(20.2, 0, -1, -2.0), (20, 0, -1, -2.0), (20, 0, -1, -2.0), (20, 0, -1, -2.0)]
    given = scene(boxes, anchors=[(20.2, 3), (20, 0), (20, 0), (20, 0)], direction=[1, 0, 1, 1])
    released, paper = detect(*given, car_released()), detect(*given, car())
    weight = np.exp(3) / (np.exp(3) + 3)
    np.testing.assert_allclose(paper.ordered.score[3], sigmoid(2) * (1 - weight), rtol=0, atol=1e-6)
    np.testing.assert_allclose(paper.score[0], sigmoid(1.9) * (1 - weight / np.exp(3)), rtol=0, atol=1e-6)
    # The released seed is the first box, class 1; the paper's the second, class 0 against r > 0.
    assert final(released)[0][0, 6] == pytest.approx(2 - np.pi / 2, abs=1e-5)
    assert final(paper)[0][0, 6] == pytest.approx(2 - np.pi / 2 + np.pi, abs=1e-5)
    # The released one reports the best S of the members, with squared distances.
    best = sigmoid(1.9) * (1 - 1 / (np.exp(9) + 3))
    np.testing.assert_allclose(released.score[0], best, rtol=0, atol=1e-6)


def test_score_threshold_is_inclusive_and_precedes_rectification():
    """sigmoid(0) is exactly 1 / 2; a low predicted IoU does not drop a candidate."""
    predictions, anchors, _ = scene(three_at(20), logit=[1.0, 0.0, -1e-6], iou=[-0.9, 1, 1])
    config = replace(car().detection, score_threshold=0.5)
    candidates, dropped = select_candidates(predictions, anchors, jnp.arange(SLOTS), config)
    assert candidates.label[np.asarray(candidates.valid)].tolist() == [1, 0]
    assert dropped == 0


def test_the_least_score_is_inclusive_and_drops_detections_alone():
    """It follows rectification and NMS: the other boxes keep their bits, and nothing counts as overflow."""
    given = scene([*three_at(20), *three_at(30), *three_at(40)], logit=[2.0] * 3 + [0.0] * 3 + [1.0] * 3)
    everything = detect(*given, car())
    boxes, scores, _ = final(everything)
    for least in (float(scores.min()), float(scores.max())):
        strict = detect(*given, replace(car(), detection=replace(car().detection, min_score=least)))
        np.testing.assert_array_equal(final(strict)[0], boxes[scores >= least])
        np.testing.assert_array_equal(final(strict)[1], scores[scores >= least])
        assert strict.dropped == everything.dropped == 0
    assert len(final(strict)[0]) == 1


def test_candidates_over_capacity_are_counted():
    """The best by rectified confidence stay; four anchors pass the threshold and do not fit."""
    predictions, anchors, _ = scene(
        [(20 + 5 * i, 0, -1, -2.0) for i in range(8)],
        logit=[0.1, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, -3.0],
        iou=[1, 1, 1, 1, -0.9, -0.9, -0.9, 1],
    )
    config = replace(car().detection, max_candidates=3)
    candidates, dropped = select_candidates(predictions, anchors, jnp.arange(SLOTS), config)
    assert candidates.label.tolist() == [3, 2, 1]
    assert np.asarray(candidates.valid).all()
    assert dropped == 4


@pytest.mark.parametrize("make", [car, car_released])
def test_no_candidate_gives_no_box(make):
    stages = detect(*scene(three_at(20), logit=[-3, -4, -5]), make())
    assert stages.count == 0
    assert stages.dropped == 0
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(stages._replace(clusters=None)))
    boxes, scores, labels = final(stages)
    assert len(boxes) == len(scores) == len(labels) == 0


@pytest.mark.parametrize("make", [car, car_released])
@pytest.mark.parametrize("broken", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("field", ["iou", "box"])
def test_a_non_finite_anchor_does_not_affect_others(make, broken, field):
    """It passes the threshold but cannot be ranked or placed: counted as dropped."""
    predictions, anchors, labels = scene([(40, 5, -1, 0.0), *three_at(20), *three_at(30)])
    sane = final(detect(predictions, anchors, labels, make()))
    assert len(sane[0]) == 2
    values = getattr(predictions, field)
    predictions = predictions._replace(**{field: values.at[0].set(broken)})
    stages = detect(predictions, anchors, labels, make())
    boxes, _, found = final(stages)
    np.testing.assert_array_equal(boxes, sane[0])
    np.testing.assert_array_equal(found, sane[2])
    assert np.isfinite(stages.score).all()
    # A clamped infinite IoU is 0 or 1.
    clamped = make is car and field == "iou" and np.isinf(broken)
    assert stages.dropped == (0 if clamped else 1)


def test_order_of_selection_not_of_score():
    """Released: the seed of best f comes first, though its members' refined score is the lower one."""
    boxes = [*three_at(20), *three_at(40)]
    given = scene(boxes, anchors=[(20, 1.5)] * 3 + [(40, 0)] * 3, logit=[2.0, 1.9, 1.9, 1.8, 1.8, 1.8])
    boxes, scores, _ = final(detect(*given, car_released()))
    np.testing.assert_allclose(boxes[:, 0], [20, 40], rtol=0, atol=1e-4)
    assert scores[0] < scores[1]


def test_centres_outside_the_range_are_dropped():
    """Closed limits 0..70.4, -40..40, -5..5 on the averaged centre."""
    inside = [(70.0, 39.9, 4.9), (0.0, -39.9, -4.9)]
    outside = [(70.5, 0.0, 0.0), (30.0, 40.1, 0.0), (30.0, 0.0, 5.1), (-0.1, 0.0, 0.0), (30.0, -40.1, 0.0)]
    for config in (car(), car_released()):
        for center in inside + outside:
            boxes, *_ = final(detect(*scene(three_at(*center)), config))
            wanted = center in inside and (config != car_released() or np.hypot(*center[:2]) < 60)
            assert len(boxes) == wanted, (center, config.detection.nms)


def test_frustum_filters_by_averaged_centre_only_when_given():
    """The half-space y > 5 alone (the others always hold); strict. The first two averages cross its border."""
    planes = jnp.array([[0, 1, 0, -5.0]] + [[0, 0, 0, 1.0]] * 5)
    crossing = [
        [(x, seed, -1, -2.0), *[(x, other, -1, -2.0)] * 2] for x, seed, other in [(45, 4.95, 5.15), (50, 5.05, 4.85)]
    ]
    given = scene([*crossing[0], *crossing[1], *three_at(30, 5.0)])
    boxes, *_ = final(detect(*given, car()))
    assert (boxes[:, 1] > 5).tolist() == [True, False, False]
    np.testing.assert_array_equal(boxes[2, 1], 5)
    filtered, *_ = final(detect(*given, car(), planes))
    np.testing.assert_allclose(filtered, boxes[:1], rtol=0, atol=1e-5)


def test_classes_have_their_own_support_threshold_and_do_not_mix():
    """A car needs more than 2.6, a pedestrian and a cyclist more than 1.0 from their own class."""
    boxes = [(20, 0, -1, -2.0)] * 7 + [(40, 0, -1, -2.0)] * 2
    given = scene(boxes, label=[0, 0, 0, 1, 1, 2, 0, 0, 0])
    found, _, labels = final(detect(*given, three_class()))
    assert labels.tolist() == [0, 1]
    np.testing.assert_allclose(found[:, 0], [20, 20], rtol=0, atol=1e-5)
    plain = replace(three_class(), detection=replace(three_class().detection, nms="rotated"))
    found, scores, labels = final(detect(*given, plain))
    assert labels.tolist() == [0, 1, 2, 0]
    np.testing.assert_allclose(scores, [sigmoid(2 - i / 10) for i in (0, 3, 5, 7)], rtol=0, atol=1e-6)
