"""Parallel suppression against the sequential loops that define it."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import Cluster, greedy_nms_loop, paper_di_nms_loop, polygon_iou_matrix, refined_score, released_di_nms_loop

from ciassd_jax.ops.iou import iou_bev
from ciassd_jax.ops.nms import (
    Clusters,
    greedy_keep,
    pairwise_iou,
    paper_di_nms,
    refine_by_anchor_distance,
    released_di_nms,
    rotated_nms,
)
from ciassd_jax.ops.platform import Program
from ciassd_jax.types import Boxes, Candidates

SETTINGS = {"overlap": 0.3, "sigma_squared": (0.0009, 0.009, 0.1, 1.0), "distances": (20.0, 40.0, 60.0)}
SLOTS = 64
PROGRAMS = ("auto", "accelerator")


class Scene(NamedTuple):
    """Candidates in descending score, in float64 values that float32 represents; `iou` is zero between classes."""

    boxes: np.ndarray
    score: np.ndarray
    quality: np.ndarray
    anchor_distance: np.ndarray
    label: np.ndarray
    support_threshold: np.ndarray
    iou: np.ndarray

    def by_loop(self, loop, **settings):
        return loop(
            self.boxes,
            self.score,
            self.quality,
            self.anchor_distance,
            self.iou,
            support_threshold=self.support_threshold,
            **(SETTINGS | settings),
        )


def make_scene(boxes, score, quality, anchor_distance, label, support_threshold) -> Scene:
    """A scene of float32 values, sorted by score."""
    order = np.argsort(-np.asarray(score, np.float32), kind="stable")
    single = [np.asarray(a, np.float32).astype(np.float64)[order] for a in (boxes, score, quality, anchor_distance)]
    label = np.asarray(label)[order]
    iou = polygon_iou_matrix(single[0]) * (label[:, None] == label[None])
    return Scene(*single, label, np.asarray(support_threshold, np.float64)[label], iou)


def draw_scene(rng: np.random.Generator, classes: int, bounds: tuple[float, float]) -> Scene:
    """Clusters of noisy copies of a few boxes, near and far, some of them side by side and overlapping.

    A third of the copies is turned by half a turn, a few are exact duplicates or hardly overlap; quality lies
    within `bounds`.
    """
    truths = rng.integers(2, 8)
    centers = rng.uniform([3, -25], [68, 25], (truths, 2))
    centers[1] = centers[0] + rng.normal(0, 1.2, 2)
    sizes, yaws = rng.uniform([3, 1.5, 1.4], [4.5, 1.9, 1.7], (truths, 3)), rng.uniform(-3, 3, truths)
    yaws[1] = yaws[0] + rng.normal(0, 0.3)
    number = rng.integers(20, SLOTS + 1)
    owner = rng.integers(0, truths, number)
    spread = rng.choice([0.03, 0.15, 0.4], (number, 1))
    boxes = np.zeros((number, 7))
    boxes[:, :2] = centers[owner] + rng.normal(0, 1, (number, 2)) * spread
    boxes[:, 2] = rng.normal(-1, 0.2, number)
    boxes[:, 3:6] = sizes[owner] * np.exp(rng.normal(0, 0.4, (number, 3)) * spread)
    boxes[:, 6] = yaws[owner] + rng.normal(0, 0.5, number) * spread[:, 0]
    boxes[:, 6] += np.pi * (rng.random(number) < 1 / 3) * rng.choice([-1, 1], number)
    boxes[-2:] = boxes[:2]
    low, high = bounds
    quality = rng.uniform(0.5, 1, number).clip(low, high)
    quality[:3] = rng.uniform(low, high, 3)
    score = rng.uniform(0.3, 1, number) * quality**4
    distance = abs(rng.normal(0, 0.6, number))
    label = rng.integers(0, classes, number)
    return make_scene(boxes, score, quality, distance, label, [2.6, 1.0, 1.0][:classes])


def decided(scene: Scene, loop) -> bool:
    """Whether no decision of the loop hangs on rounding: the margins that keep scenes away from ties.

    Overlaps stay 1e-4 off the limit, supports 1e-3 off the threshold, S in relative terms 3e-6 off the next,
    distances 1e-3 m off the bands, yaw differences 1e-3 off a right angle, and the weights do not cancel.
    """
    pairs = scene.iou[np.triu_indices(len(scene.score), 1)]
    order = np.sort(refined_score(scene.score, scene.anchor_distance))
    ranges = np.hypot(scene.boxes[:, 0], scene.boxes[:, 1])
    turn = scene.boxes[:, None, 6] - scene.boxes[None, :, 6]
    off_right_angle = abs(abs(turn / np.pi - np.round(turn / np.pi)) - 0.5)[scene.iou > 0.3]
    clusters = scene.by_loop(loop)
    return (
        abs(pairs - 0.3).min() > 1e-4
        and (np.diff(order) > 3e-6 * abs(order[1:])).all()
        and np.diff(np.sort(scene.score)).min() > 0
        and abs(ranges[:, None] - [SETTINGS["distances"]]).min() > 1e-3
        and off_right_angle.min() > 1e-3
        and all(abs(c.support - scene.support_threshold[c.candidate]) > 1e-3 for c in clusters)
        and all(scene.quality[c.members].min() > 0 or not c.supported for c in clusters)
    )


def draw_decided(rng: np.random.Generator, loop, **kind) -> Scene:
    """The first of the random scenes that is clear of ties."""
    return next(scene for scene in iter(lambda: draw_scene(rng, **kind), None) if decided(scene, loop))


def to_candidates(scene: Scene, slots: int = SLOTS) -> tuple[Candidates, np.ndarray]:
    """The scene padded with garbage, its support thresholds too; `direction` carries the candidate's number."""
    number = len(scene.score)

    def pad(values: np.ndarray, garbage: float = np.nan) -> np.ndarray:
        rest = np.full((slots - number, *values.shape[1:]), garbage)
        return np.concatenate([values, rest]).astype(np.float32)

    boxes = pad(scene.boxes)
    # Like the boxes of anchors below the score threshold: some in the way of the real ones, some overflown.
    boxes[number:] = np.resize(np.concatenate([scene.boxes[:2], np.full((2, 7), np.inf)]), (slots - number, 7))
    candidates = Candidates(
        boxes=Boxes.from_array(boxes),
        score=pad(scene.score, 5.0),
        iou=pad(scene.quality, 5.0),
        anchor_distance=pad(scene.anchor_distance, np.inf),
        direction=np.arange(slots, dtype=np.int32),
        label=np.resize(np.concatenate([scene.label, [0]]), slots).astype(np.int32),
        valid=np.arange(slots) < number,
    )
    return jax.tree.map(jnp.asarray, candidates), jnp.asarray(pad(scene.support_threshold, 0.0))


@partial(jax.jit, static_argnames=("overlap", "program"))
def run_released(candidates: Candidates, threshold: jax.Array, **settings) -> tuple[Candidates, Clusters]:
    return candidates, released_di_nms(candidates, support_threshold=threshold, **(SETTINGS | settings))


@partial(jax.jit, static_argnames=("overlap", "program"))
def run_paper(candidates: Candidates, threshold: jax.Array, **settings) -> tuple[Candidates, Clusters]:
    """In order of S; the thresholds follow their candidates."""
    candidates = refine_by_anchor_distance(candidates)
    threshold = threshold[candidates.direction]
    return candidates, paper_di_nms(candidates, support_threshold=threshold, **(SETTINGS | settings))


RUNS = [partial(run, program=program) for run in (run_released, run_paper) for program in PROGRAMS]
VARIANTS = {
    "released": (run_released, released_di_nms_loop, (-0.05, 1.1)),
    "paper": (run_paper, paper_di_nms_loop, (0.01, 1.0)),
}


def selection(candidates: Candidates, clusters: Clusters) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Numbers, boxes and scores of what was selected, in order."""
    chosen = np.asarray(clusters.selected)
    rows = np.asarray(candidates.direction), np.asarray(clusters.boxes.to_array()), np.asarray(clusters.score)
    return rows[0][chosen], rows[1][chosen], rows[2][chosen]


# Greedy suppression and pairwise overlap


@pytest.mark.smoke
@pytest.mark.parametrize("density", [0.003, 0.02, 0.1, 0.5])
def test_fixed_point_is_the_greedy_loop(density):
    rng = np.random.default_rng(0)
    overlaps = rng.random((150, 80, 80)) < density
    # The first half symmetric, as overlaps are; the result must not need it.
    overlaps[:75] |= overlaps[:75].swapaxes(1, 2)
    eligible = rng.random((150, 80)) < rng.uniform(0.3, 1, (150, 1))
    kept = np.asarray(jax.jit(jax.vmap(greedy_keep))(overlaps, eligible))
    expected = np.stack([greedy_nms_loop(o, e) for o, e in zip(overlaps, eligible, strict=True)])
    assert (eligible & ~expected).any()
    np.testing.assert_array_equal(kept, expected)


def test_longest_chain_of_suppression():
    """Each entry overlaps its neighbours only: every decision waits for the one before."""
    length = 257
    slots = np.arange(length)
    chain = jnp.asarray(abs(slots[:, None] - slots[None]) == 1)
    keep = jax.jit(greedy_keep)
    np.testing.assert_array_equal(keep(chain, jnp.ones(length, bool)), slots % 2 == 0)
    # A gap shifts the parity of what follows.
    eligible = slots != 100
    expected = greedy_nms_loop(np.asarray(chain), eligible)
    assert expected[101]
    np.testing.assert_array_equal(keep(chain, jnp.asarray(eligible)), expected)


def test_greedy_keeps_nothing_of_nothing():
    assert not greedy_keep(jnp.ones((5, 5), bool), jnp.zeros(5, bool)).any()
    np.testing.assert_array_equal(greedy_keep(jnp.ones((5, 5), bool), jnp.ones(5, bool)), np.arange(5) == 0)


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("slots", [1, 127, 128, 129, 300])
def test_pairwise_overlap_across_blocks(slots, program):
    rng = np.random.default_rng(slots)
    boxes = np.zeros((slots, 7), np.float32)
    # Dense enough that boxes of every pair of tiles overlap.
    boxes[:, :2] = rng.uniform(0, 12, (slots, 2))
    boxes[:, 3:6] = rng.uniform(1, 5, (slots, 3))
    boxes[:, 6] = rng.uniform(-4, 4, slots)
    wide = Boxes.from_array(boxes.astype(np.float64))
    direct = iou_bev(jax.tree.map(lambda leaf: leaf[:, None], wide), jax.tree.map(lambda leaf: leaf[None], wide))
    pairwise = jax.jit(partial(pairwise_iou, program=program))
    for count in {0, 1, slots // 2, max(slots - 1, 0), slots}:
        garbage = boxes.copy()
        garbage[count:] = np.nan
        result = np.array(pairwise(Boxes.from_array(jnp.asarray(garbage)), jnp.int32(count)))
        np.testing.assert_allclose(result[:count, :count], direct[:count, :count], rtol=0, atol=2e-5)
        result[:count, :count] = 0
        np.testing.assert_array_equal(result, 0)
    if slots > 128:
        assert (direct[:128, 128:] > 0).any()


# Plain rotated NMS


ROW = 7


def row_of_candidates(x: list[float], label: list[int] | None = None) -> Candidates:
    """Boxes of 3 x 2 m along the x axis, padded to seven: IoU is exactly 1 / 2 at a shift of 1, 0 at 3."""
    number = len(x)
    boxes = np.zeros((ROW, 7), np.float32)
    boxes[:number, 0], boxes[:, 3:6] = x, (3, 2, 1)
    candidates = Candidates(
        boxes=Boxes.from_array(boxes),
        score=np.linspace(0.9, 0.5, ROW, dtype=np.float32),
        iou=np.ones(ROW, np.float32),
        anchor_distance=np.zeros(ROW, np.float32),
        direction=np.arange(ROW, dtype=np.int32),
        label=np.array((label or []) + [0] * (ROW - len(label or [])), np.int32),
        valid=np.arange(ROW) < number,
    )
    return jax.tree.map(jnp.asarray, candidates)


def chosen(clusters: Clusters) -> list[int]:
    """The slots selected."""
    return np.flatnonzero(clusters.selected).tolist()


@partial(jax.jit, static_argnames="program")
def rotated(candidates: Candidates, program: Program) -> dict[str, Clusters]:
    run = partial(rotated_nms, candidates, program=program)
    return {
        "at 1/2": run(overlap=0.5),
        "above 1/2": run(overlap=0.50001),
        "first three": run(overlap=0.5, limit=3),
        "none": run(overlap=0.5, limit=0),
    }


@pytest.mark.parametrize("program", PROGRAMS)
def test_rotated_nms_suppresses_at_the_limit_itself(program):
    found = rotated(row_of_candidates([10, 11, 13.5]), program)
    assert chosen(found["at 1/2"]) == [0, 2]
    assert chosen(found["above 1/2"]) == [0, 1, 2]


@pytest.mark.parametrize("program", PROGRAMS)
def test_rotated_nms_knows_classes_padding_and_a_limit(program):
    candidates = row_of_candidates([10, 10, 10, 20, 30], [0, 1, 0, 0, 0])
    found = rotated(candidates, program)
    assert chosen(found["at 1/2"]) == [0, 1, 3, 4]
    assert chosen(found["first three"]) == [0, 1, 3]
    assert chosen(found["none"]) == []
    np.testing.assert_array_equal(found["at 1/2"].boxes.to_array(), candidates.boxes.to_array())
    np.testing.assert_array_equal(found["at 1/2"].score, candidates.score)


# DI-NMS against the loops


@pytest.fixture(scope="module", params=list(VARIANTS))
def scenes(request):
    """Sixty scenes, half with three classes, and what the loop makes of them."""
    run, loop, bounds = VARIANTS[request.param]
    rng = np.random.default_rng(7)
    drawn = [draw_decided(rng, loop, classes=classes, bounds=bounds) for classes in (1, 3) for _ in range(30)]
    return request.param, run, drawn, [scene.by_loop(loop) for scene in drawn]


@pytest.fixture(scope="module", params=PROGRAMS)
def results(scenes, request):
    """What the parallel code makes of them, all scenes at once."""
    _, run, drawn, _ = scenes
    padded = [to_candidates(scene) for scene in drawn]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *padded)
    found = jax.vmap(partial(run, program=request.param))(*batch)
    return [selection(*jax.tree.map(lambda leaf, i=i: leaf[i], found)) for i in range(len(drawn))]


def test_the_scenes_are_hard(scenes):
    """They hold every case that tells a right implementation from a nearly right one."""
    name, _, drawn, loops = scenes
    clusters = [(scene, cluster) for scene, found in zip(drawn, loops, strict=True) for cluster in found]
    supported = [(s, c) for s, c in clusters if c.supported]
    assert len(supported) > 150
    unsupported = [(s, c) for s, c in clusters if not c.supported]
    assert sum(len(c.members) > 1 for _, c in unsupported) > 50
    yaws = [s.boxes[c.members, 6] for s, c in supported]
    assert sum(np.ptp(yaw) > 2 for yaw in yaws) > 100
    ranges = np.array([np.hypot(*s.boxes[c.candidate, :2]) for s, c in supported])
    bands = np.histogram(ranges, [0, 20, 40, 60, 100])[0]
    assert (bands >= 10).all()
    first_ineligible = [not found[0].supported for found in loops]
    assert sum(first_ineligible) > 5
    if name == "released":
        # Members shared by two outputs; seeds with members of better score that were freed again.
        shared = [sum(len(c.members) for c in found if c.supported) for found in loops]
        distinct = [len({j for c in found if c.supported for j in c.members}) for found in loops]
        assert sum(s > d for s, d in zip(shared, distinct, strict=True)) > 20
        assert sum(min(c.members) < c.candidate for _, c in supported) > 20


@pytest.mark.smoke
def test_the_same_clusters_as_the_loop(scenes, results):
    name, _, _, loops = scenes
    for (numbers, boxes, scores), clusters in zip(results, loops, strict=True):
        expected = [c for c in clusters if c.supported and np.isfinite(c.box).all()]
        assert numbers.tolist() == [c.candidate for c in expected], name
        if expected:
            np.testing.assert_allclose(boxes, np.stack([c.box for c in expected]), rtol=0, atol=1e-4)
            np.testing.assert_allclose(scores, [c.score for c in expected], rtol=0, atol=1e-5)


def test_more_padding_changes_nothing(scenes, results):
    """130 slots instead of 64: other tiles, other garbage behind the real candidates."""
    _, run, drawn, _ = scenes
    for scene, (numbers, boxes, scores) in list(zip(drawn, results, strict=True))[::10]:
        again = selection(*run(*to_candidates(scene, 130)))
        np.testing.assert_array_equal(again[0], numbers)
        np.testing.assert_allclose(again[1], boxes, rtol=0, atol=1e-5)
        np.testing.assert_allclose(again[2], scores, rtol=0, atol=1e-6)


@jax.jit
@partial(jax.vmap, in_axes=(None, 0))
def select_without_limit(candidates: Candidates, threshold: jax.Array) -> jax.Array:
    """What the released NMS selects, with a weight at any distance."""
    settings = SETTINGS | {"distances": (20.0, 40.0, 1e6)}
    return released_di_nms(candidates, support_threshold=threshold, **settings).selected


def assert_supports(scene: Scene, support: np.ndarray) -> None:
    """Raise the threshold of one candidate past its support and leave the others out of reach."""
    candidates, _ = to_candidates(scene)
    number = len(support)

    def selected(thresholds: np.ndarray) -> np.ndarray:
        alone = np.full((SLOTS, SLOTS), np.inf, np.float32)
        alone[np.arange(number), np.arange(number)] = thresholds
        return np.asarray(select_without_limit(candidates, jnp.asarray(alone)))[:number]

    below, above = selected(support - 1e-4), selected(support + 1e-4)
    np.testing.assert_array_equal(below, np.eye(number, SLOTS, dtype=bool))
    assert not above.any()


def test_support_of_every_candidate(scenes):
    """Each is selected exactly while the threshold is below the support that the loop counts."""
    name, _, drawn, loops = scenes
    for scene, clusters in list(zip(drawn, loops, strict=True))[::10]:
        if name == "released":
            support = (np.where(scene.iou > 0, scene.iou, 0) * scene.quality[None]).sum(1)
            assert_supports(scene, support)
        else:
            assert_cluster_supports(scene, clusters)


def assert_cluster_supports(scene: Scene, clusters: list[Cluster]) -> None:
    """The paper's threshold decides only what is put out, so that all clusters can be tried at once."""
    candidates, _ = to_candidates(scene)
    seeds, support = np.array([c.candidate for c in clusters]), np.array([c.support for c in clusters])
    for step, expected in ((-1e-4, seeds.tolist()), (1e-4, [])):
        threshold = np.full(SLOTS, -1, np.float32)
        threshold[seeds] = support + step
        assert selection(*run_paper(candidates, jnp.asarray(threshold)))[0].tolist() == expected


# Single rules


def test_an_overlap_at_the_limit_itself():
    """Released: suppressed from the limit on, averaged only above it. Paper: both only above it.

    At 45 m, where the Gaussian would give the other box a weight of exp(-2.5).
    """
    candidates = row_of_candidates([45, 46])
    thresholds = jnp.full(ROW, 0.1)
    _, released = run_released(candidates, thresholds, overlap=0.5)
    assert chosen(released) == [0]
    np.testing.assert_allclose(released.boxes.center[0], [45, 0, 0])
    _, paper = run_paper(candidates, thresholds, overlap=0.5)
    assert chosen(paper) == [0, 1]
    np.testing.assert_allclose(paper.boxes.center[:2, 0], [45, 46])


def test_support_must_exceed_the_threshold():
    candidates = row_of_candidates([10, 10])
    for run in (run_released, run_paper):
        assert chosen(run(candidates, jnp.full(ROW, 2.0))[1]) == []
        assert chosen(run(candidates, jnp.full(ROW, 1.9999))[1]) == [0]


def test_a_freed_cluster_may_come_again():
    """The seed of best score lacks support and hides a supported one: released finds it, the paper does not.

    IoU 1/2 between neighbours 1 m apart, 1/5 at 2 m: the outer box is supported by 1.7, the middle by 2.
    """
    candidates = row_of_candidates([10, 11, 12])
    thresholds = jnp.full(ROW, 1.8)
    assert chosen(run_released(candidates, thresholds)[1]) == [1]
    assert chosen(run_paper(candidates, thresholds)[1]) == []


def test_average_of_yaws_half_a_turn_apart():
    """Released averages the numbers; the paper's preset aligns them modulo pi first."""
    candidates = row_of_candidates([10, 10, 10])
    yaw = jnp.array([0.1, 0.1 + np.pi, 0.1 - 3 * np.pi, 0, 0, 0, 0], jnp.float32)
    candidates = candidates._replace(boxes=candidates.boxes._replace(yaw=yaw))
    thresholds = jnp.full(ROW, 2.6)
    np.testing.assert_allclose(run_paper(candidates, thresholds)[1].boxes.yaw[0], 0.1, atol=1e-5)
    np.testing.assert_allclose(run_released(candidates, thresholds)[1].boxes.yaw[0], 0.1 - 2 * np.pi / 3, atol=1e-4)


def test_beyond_the_last_distance():
    """The released code has no weight there, the paper a fourth sigma."""
    candidates = row_of_candidates([65, 65, 65])
    thresholds = jnp.full(ROW, 2.6)
    assert chosen(run_released(candidates, thresholds)[1]) == []
    _, paper = run_paper(candidates, thresholds)
    assert chosen(paper) == [0]
    np.testing.assert_allclose(paper.boxes.center[0], [65, 0, 0], atol=1e-5)


def test_refined_score_orders_the_candidates():
    candidates = row_of_candidates([10, 20, 30])
    distance = np.array([1.5, 0.2, 0.1, 50.0, 50.0, 50.0, 50.0])
    refined = refine_by_anchor_distance(candidates._replace(anchor_distance=jnp.asarray(distance)))
    expected = refined_score(np.asarray(candidates.score, np.float64)[:3], distance[:3])
    order = np.argsort(-expected)
    assert order.tolist() != [0, 1, 2]
    assert refined.direction.tolist() == [*order.tolist(), 3, 4, 5, 6]
    np.testing.assert_allclose(refined.score[:3], expected[order], rtol=0, atol=1e-6)
    assert refined.valid.tolist() == [True] * 3 + [False] * 4


@pytest.mark.parametrize("run", RUNS)
def test_far_anchors_do_not_overflow(run):
    """The softmax of 20 m squared overflows float32 unless it is shifted."""
    candidates = row_of_candidates([10, 10, 10, 30, 30, 30])
    candidates = candidates._replace(anchor_distance=jnp.array([20.0, 0, 0, 19, 0, 0, 0]))
    _, clusters = run(candidates, jnp.full(ROW, 2.6))
    assert len(chosen(clusters)) == 2
    scores = np.asarray(clusters.score)[chosen(clusters)]
    assert np.isfinite(scores).all()
    assert (scores > 0.5).all()


@pytest.mark.parametrize("run", RUNS)
def test_no_candidate_gives_no_cluster(run):
    candidates = row_of_candidates([])
    candidates = candidates._replace(score=jnp.full(ROW, np.nan), anchor_distance=jnp.full(ROW, np.nan))
    _, clusters = run(candidates, jnp.zeros(ROW))
    assert chosen(clusters) == []
    assert np.isfinite(clusters.boxes.to_array()).all()


@pytest.mark.parametrize("run", RUNS)
def test_a_candidate_that_overflowed_spoils_no_other(run):
    """A real candidate whose size or angle is no number overlaps nothing and is not selected."""
    x = [10.0, 10, 10, 30, 30, 30]
    sane = run(row_of_candidates([*x, 50]), jnp.full(ROW, 2.6))[1]
    rows = chosen(sane)
    assert len(rows) == 2
    for broken in (np.inf, np.nan):
        candidates = row_of_candidates([*x, 50])
        boxes = candidates.boxes.to_array().at[6].set(broken)
        _, clusters = run(candidates._replace(boxes=Boxes.from_array(boxes)), jnp.full(ROW, 2.6))
        assert chosen(clusters) == rows
        np.testing.assert_array_equal(clusters.boxes.to_array()[np.array(rows)], sane.boxes.to_array()[np.array(rows)])


# Numbers of the released code. Columns: x y z w l h r, score f, quality q, anchor x y, direction


A1 = np.array(
    [
        [10, 2, -0.9, 1.6, 3.9, 1.5, 0.1, 0.8, 0.95, 10.2, 2.2, 1],
        [10.1, 2.05, -0.92, 1.62, 3.95, 1.52, 0.12, 0.75, 0.93, 10.2, 2.2, 0],
        [45, 8, -1.2, 1.6, 3.9, 1.5, -0.4, 0.7, 0.9, 45, 8.2, 0],
        [45.2, 8.1, -1.1, 1.7, 4.1, 1.6, -0.5, 0.65, 0.88, 45.4, 8.2, 1],
        [9.95, 1.9, -0.88, 1.58, 3.85, 1.48, 0.08, 0.6, 0.9, 9.8, 1.8, 1],
        [64, 0, -1, 1.6, 3.9, 1.5, 0, 0.55, 0.85, 63.8, 0.2, 0],
        [64.1, 0.1, -1, 1.6, 3.9, 1.5, 0, 0.52, 0.84, 64.2, 0.2, 1],
        [44.8, 7.8, -1.3, 1.5, 3.8, 1.4, -0.3, 0.5, 0.85, 44.6, 7.8, 0],
        [45.1, 7.9, -1.2, 1.6, 3.9, 1.5, -0.35, 0.48, 0.86, 45, 7.8, 0],
        [64, 0.2, -1, 1.6, 3.9, 1.5, 0.05, 0.45, 0.82, 64.2, 0.2, 0],
        [63.9, 0, -1, 1.6, 3.9, 1.5, 0, 0.42, 0.8, 63.8, 0.2, 1],
        [30, -5, -1, 1.6, 3.9, 1.5, 1.5, 0.4, 0.8, 30.2, -5, 0],
        [30.2, -5.1, -1, 1.7, 4, 1.5, 1.45, 0.35, 0.75, 30.2, -5, 1],
        [10.05, 2.6, -0.95, 1.65, 4, 1.55, 0.2, 0.3, 0.8, 10.2, 2.6, 0],
        [45.4, 8.3, -1.2, 1.6, 3.9, 1.5, -0.45, 0.2, 0.7, 45.4, 8.2, 1],
    ]
)
A1_SUPPORT = np.array(
    [
        *(3.10078, 2.98170, 3.22237, 3.07374, 2.98655, 2.96310, 2.83791, 2.68399),
        *(3.20034, 2.89686, 2.83474, 1.39208, 1.38155, 2.61233, 2.48481),
    ]
)
# Selected: candidates 0 and 2, and 5 at 64 m, whose box the released code loses.
A1_SCORES = [0.7443815, 0.653242, 0.5117623]
A1_BOXES = np.array(
    [
        [9.999999, 1.999998, -0.9000, 3.8999991, 1.6000, 1.5000, -0.1000 - np.pi / 2],
        [45.0503439, 7.9704152, -1.1950445, 3.9225232, 1.6049556, 1.5049556, 0.3913478 - np.pi / 2],
    ]
)


@pytest.fixture(scope="module")
def a1() -> Scene:
    boxes = np.concatenate([A1[:, :3], A1[:, [4, 3, 5]], -A1[:, [6]] - np.pi / 2], 1)
    distance = np.hypot(A1[:, 0] - A1[:, 9], A1[:, 1] - A1[:, 10])
    return make_scene(boxes, A1[:, 7], A1[:, 8], distance, np.zeros(15, int), [2.6])


def test_numbers_of_the_released_code(a1):
    numbers, boxes, scores = selection(*run_released(*to_candidates(a1)))
    assert numbers.tolist() == [0, 2]
    assert A1[numbers, 11].tolist() == [1, 0]
    np.testing.assert_allclose(boxes, A1_BOXES, rtol=0, atol=1e-4)
    np.testing.assert_allclose(scores, A1_SCORES[:2], rtol=0, atol=1e-5)


def test_support_numbers_of_the_released_code(a1):
    assert_supports(a1, A1_SUPPORT)
    iou = pairwise_iou(to_candidates(a1)[0].boxes, jnp.int32(15))
    expected = [0.7296414, 0.6794287, 0.8667628, 0.5105073]
    np.testing.assert_allclose(iou[2, jnp.array([3, 7, 8, 14])], expected, rtol=0, atol=1e-5)


def test_the_loop_gives_the_numbers_of_the_released_code(a1):
    """The oracle itself: the numbers come from the authors' code, not from this project."""
    clusters = a1.by_loop(released_di_nms_loop)
    found = [c for c in clusters if c.supported]
    assert [c.candidate for c in found] == [0, 2, 5]
    np.testing.assert_allclose([c.score for c in found], A1_SCORES, rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.stack([c.box for c in found[:2]]), A1_BOXES, rtol=0, atol=2e-6)
    assert np.isnan(found[2].box).all()
    rejected = next(c for c in clusters if c.candidate == 11)
    assert not rejected.supported
    for c in clusters:
        np.testing.assert_allclose(c.support, A1_SUPPORT[c.candidate], rtol=0, atol=1e-5)
