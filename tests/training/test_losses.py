"""Losses: the released code's numbers, values and gradients by hand, and robustness to any input."""

from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from oracles_training import focal_by_hand, smooth_l1_by_hand

from ciassd_jax.config import LossConfig
from ciassd_jax.config.presets import car_released, tiny
from ciassd_jax.model.anchors import make_anchors
from ciassd_jax.ops.boxes import decode, encode
from ciassd_jax.ops.iou import iou_3d
from ciassd_jax.training.losses import (
    box_loss,
    classification_loss,
    detached_overlap,
    detection_loss,
    direction_loss,
    iou_loss,
    scene_loss,
    scene_losses,
    smooth_l1,
)
from ciassd_jax.training.targets import assign_targets
from ciassd_jax.types import Boxes, GroundTruth, LossTerms, Predictions, Targets

# Jitted, because the overlap alone compiles a hundred programs eagerly.
total_loss = jax.jit(detection_loss, static_argnames="config")
batch_losses = jax.jit(scene_losses, static_argnames="config")
one_loss = jax.jit(scene_loss, static_argnames="config")
find_overlap = jax.jit(detached_overlap)

FOCAL = {"alpha": 0.25, "gamma": 2.0}
CONFIG = LossConfig()


def random_pair(seed: int, shape: tuple[int, ...], dtype=np.float32) -> tuple[Predictions, Targets]:
    """Random targets with all three labels, and predictions whose boxes overlap theirs."""
    rng = np.random.default_rng(seed)
    label = rng.integers(-1, 2, shape).astype(np.int32)
    positive = label == 1
    target = rng.normal(0, 0.3, (*shape, 7)) * positive[..., None]
    predictions = Predictions(
        box=target + rng.normal(0, 0.15, (*shape, 7)),
        class_logit=rng.normal(0, 2, shape),
        direction=rng.normal(0, 1, (*shape, 2)),
        iou=rng.normal(0, 0.5, shape),
    )
    direction = (rng.integers(0, 2, shape) * positive).astype(np.int32)
    targets = Targets(label, np.where(positive, 0, -1).astype(np.int32), target.astype(dtype), direction)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), predictions), jax.tree.map(jnp.asarray, targets)


def some_anchors(number: int, dtype=np.float32) -> Boxes:
    """The first anchors of `tiny()`."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf[:number], dtype), make_anchors(tiny())[0])


# The released code's numbers


@lru_cache
def golden_batch(folder: Path) -> tuple[dict[str, np.ndarray], Predictions, Targets]:
    """The golden file, its head outputs and its targets; direction classes come from the files of the frames."""
    with np.load(folder / "losses.npz") as data:
        golden = dict(data)
    label = golden["labels"].astype(np.int32)
    box, direction = np.zeros((*label.shape, 7), np.float32), np.zeros(label.shape, np.int32)
    box[golden["reg_targets_batch_index"].astype(int), golden["reg_targets_anchor_index"]] = golden[
        "reg_targets_values"
    ]
    for scene, frame in enumerate(golden["frames"]):
        with np.load(folder / f"targets_{frame}.npz") as data:
            direction[scene, data["positive_indices"]] = data["dir_targets_pos"]
    targets = Targets(label, np.where(label == 1, 0, -1).astype(np.int32), box, direction)
    outputs = (golden[name].astype(np.float32) for name in ("box_preds", "cls_preds", "dir_cls_preds", "iou_preds"))
    shapes = ((7,), (), (2,), ())
    predictions = Predictions(*(o.reshape(*label.shape, *shape) for o, shape in zip(outputs, shapes, strict=True)))
    return golden, jax.tree.map(jnp.asarray, predictions), jax.tree.map(jnp.asarray, targets)


@pytest.mark.reference
@pytest.mark.parametrize("name", ["all3", "first", "first2", "empty"])
def test_golden_terms(shared, name):
    """Terms of the whole batch, and means of the terms of some of its scenes."""
    golden, predictions, targets = golden_batch(shared / "golden")
    anchors, _ = make_anchors(car_released())
    if name == "all3":
        terms = total_loss(predictions, targets, anchors, CONFIG)
    else:
        scenes = batch_losses(predictions, targets, anchors, CONFIG)
        terms = jax.tree.map(lambda term: np.asarray(term)[golden[f"{name}__sample_select"]].mean(), scenes)
    expected = LossTerms(
        golden[f"{name}__cls"],
        golden[f"{name}__box_weighted2"] / 2,
        golden[f"{name}__dir_unweighted"],
        golden[f"{name}__iou_pred"],
        golden[f"{name}__total"],
    )
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5, atol=0), terms, expected)


@pytest.mark.reference
def test_golden_parts(shared):
    """Positives and negatives apart, each of the seven residuals, and the overlap of the decoded boxes."""
    golden, predictions, targets = golden_batch(shared / "golden")
    positive = targets.label == 1
    share = 1 / positive.sum(1).clip(1) / 3
    focal = classification_loss(predictions.class_logit, targets.label, **FOCAL) * share[:, None]
    np.testing.assert_allclose(jnp.where(positive, focal, 0).sum(), golden["all3__cls_pos"], rtol=1e-5)
    np.testing.assert_allclose(jnp.where(positive, 0, focal).sum(), golden["all3__cls_neg"], rtol=1e-5)
    box = box_loss(predictions.box, targets.box, positive, sigma=3.0) * share[:, None, None]
    np.testing.assert_allclose(box.sum((0, 1)), golden["all3__box_elem7"], rtol=1e-5)

    scene, anchor = np.nonzero(positive)
    anchors = jax.tree.map(lambda leaf: leaf[anchor], make_anchors(car_released())[0])
    overlap = find_overlap(predictions.box[scene, anchor], targets.box[scene, anchor], anchors)
    # The golden overlaps are of float32 boxes away from the origin, which changes them by up to 4e-6.
    np.testing.assert_allclose(overlap, golden["iou_pos_exact"], rtol=0, atol=6e-6)


@pytest.mark.reference
def test_golden_gradients(shared):
    golden, predictions, targets = golden_batch(shared / "golden")
    anchors, _ = make_anchors(car_released())
    gradient = jax.jit(jax.grad(lambda p: detection_loss(p, targets, anchors, CONFIG).total))(predictions)
    positive = np.asarray(targets.label) == 1
    close = partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-8)
    close(gradient.box[positive], golden["grad_pos_box"])
    close(gradient.class_logit[positive], golden["grad_pos_cls"][:, 0])
    close(gradient.direction[positive], golden["grad_pos_dir"])
    random = golden["grad_rand_batch_index"].astype(int), golden["grad_rand_anchor_index"]
    close(np.asarray(gradient.class_logit)[random], golden["grad_rand_cls"])

    # An overlap error of 4e-6 changes a gradient by 7e-5 before the division by 53 positives and 3 scenes.
    close(gradient.iou[positive], golden["grad_pos_iou"][:, 0], atol=5e-7)
    share = 1 / positive.sum(1).clip(1)[np.nonzero(positive)[0]] / 3
    given = jnp.asarray(golden["iou_pos_exact"])
    alone = jax.grad(lambda iou: (iou_loss(iou, given, given >= 0, sigma=3.0) * share).sum())(predictions.iou[positive])
    close(alone, golden["grad_pos_iou"][:, 0])

    assert not np.asarray(gradient.box)[~positive].any()
    assert not np.asarray(gradient.direction)[~positive].any()
    assert not np.asarray(gradient.iou)[~positive].any()
    assert not np.asarray(gradient.class_logit)[np.asarray(targets.label) == -1].any()


# By hand


def test_focal_loss_of_the_released_code():
    """Alpha weights the positives; an ignored anchor has no loss."""
    loss = classification_loss(jnp.full(3, 0.5), jnp.array([1, 0, -1]), **FOCAL)
    np.testing.assert_allclose(loss, [0.01689337, 0.28305870, 0], rtol=1e-6)


@pytest.mark.parametrize(("alpha", "gamma"), [(0.25, 2.0), (0.9, 2.0), (0.5, 0.0), (0.25, 1.0), (0.0, 3.5)])
def test_focal_loss_by_hand(alpha, gamma):
    logits = np.concatenate([np.linspace(-8, 8, 33), [-300.0, 300.0, -1e4, 1e4]]).astype(np.float32)
    for label in (0, 1):
        with np.errstate(over="ignore"):
            expected = [
                focal_by_hand(float(np.clip(z, -300, 300)), label, alpha, gamma) * max(1, abs(float(z)) / 300)
                for z in logits
            ]
        loss = classification_loss(jnp.asarray(logits), jnp.full(len(logits), label), alpha=alpha, gamma=gamma)
        np.testing.assert_allclose(loss, expected, rtol=2e-5, atol=1e-30)


def test_focal_gradient_by_hand():
    """At logit 0, p = 1/2: alpha * (1 - p)**2 * (2 * p * log(p) + p - 1), and its mirror image for a negative."""
    slope = jax.grad(lambda z: classification_loss(z, jnp.array([1, 0, -1]), **FOCAL).sum())(jnp.zeros(3))
    expected = 0.25 * (np.log(0.5) - 0.5)
    np.testing.assert_allclose(slope, [0.25 * expected, -0.75 * expected, 0], rtol=1e-6)


def test_smooth_l1_by_hand():
    """Both branches, several sigmas, and the derivative: sigma**2 * error, then the sign."""
    errors = jnp.array([0.05, 1 / 9, 0.5, -0.05, -0.5, 0.0])
    half = [0.01125, 0.0555556, 0.4444444]
    np.testing.assert_allclose(smooth_l1(errors, sigma=3.0), [*half, half[0], half[2], 0], rtol=1e-6)
    slope = jax.grad(lambda error: smooth_l1(error, sigma=3.0).sum())(errors)
    np.testing.assert_allclose(slope, [0.45, 1, 1, -0.45, -1, 0], rtol=1e-6)
    many = np.linspace(-3, 3, 101)
    for sigma in (0.5, 1.0, 3.0):
        expected = [smooth_l1_by_hand(error, sigma) for error in many]
        np.testing.assert_allclose(
            smooth_l1(jnp.asarray(many, jnp.float32), sigma=sigma), expected, rtol=2e-6, atol=1e-8
        )


def test_box_loss_by_hand():
    """The loss ignores a rotation by pi, and each residual affects only its own entry."""
    error = np.diag([0.05, -0.05, 0.5, 1.5, 0.0, 1 / 9, np.pi / 6]).astype(np.float32)
    target = np.linspace(-0.3, 0.3, 7, dtype=np.float32)[None].repeat(7, 0)
    expected = np.diag([0.01125, 0.01125, 0.4444444, 1.5 - 1 / 18, 0, 0.0555556, 0.5 - 1 / 18])
    loss = box_loss(jnp.asarray(target + error), jnp.asarray(target), jnp.ones(7, bool), sigma=3.0)
    np.testing.assert_allclose(loss, expected, rtol=1e-5, atol=1e-9)
    turned = error + np.array([0] * 6 + [np.pi], np.float32)
    loss = box_loss(jnp.asarray(target + turned), jnp.asarray(target), jnp.ones(7, bool), sigma=3.0)
    np.testing.assert_allclose(loss, expected, rtol=1e-5, atol=1e-9)
    assert not np.asarray(box_loss(jnp.asarray(turned), jnp.asarray(target), jnp.zeros(7, bool), sigma=3.0)).any()


def test_direction_loss_by_hand():
    """The loss is log(1 + exp(other - own)), its gradient the probabilities minus the one-hot class."""
    logits, direction = jnp.array([[0.0, 0.0], [2.0, -1.0], [2.0, -1.0], [5.0, 1.0]]), jnp.array([0, 0, 1, 1])
    positive = jnp.array([True, True, True, False])
    loss, back = jax.vjp(lambda given: direction_loss(given, direction, positive), logits)
    np.testing.assert_allclose(loss, [np.log(2), np.log1p(np.exp(-3)), np.log1p(np.exp(3)), 0], rtol=1e-6)
    wrong = 1 / (1 + np.exp(3))
    expected = [[-0.5, 0.5], [-wrong, wrong], [1 - wrong, wrong - 1], [0, 0]]
    np.testing.assert_allclose(back(jnp.ones(4))[0], expected, rtol=1e-5)


def test_iou_loss_by_hand():
    """Against 2 * overlap - 1: errors of 0.05, -0.5 and, masked, 3."""
    predicted, overlap = jnp.array([0.25, -0.5, 3.0]), jnp.array([0.6, 0.5, 0.5])
    positive = jnp.array([True, True, False])
    loss, back = jax.vjp(lambda given: iou_loss(given, overlap, positive, sigma=3.0), predicted)
    np.testing.assert_allclose(loss, [0.01125, 0.4444444, 0], rtol=1e-5)
    np.testing.assert_allclose(back(jnp.ones(3))[0], [0.45, -1, 0], rtol=1e-5)


def test_the_overlap_does_not_depend_on_the_position_of_the_anchor():
    anchors = some_anchors(200)
    predictions, targets = random_pair(0, (200,))
    shifted = [decode(residuals, anchors) for residuals in (predictions.box, targets.box)]
    expected = iou_3d(*(Boxes.from_array(np.asarray(boxes.to_array(), np.float64)) for boxes in shifted))
    overlap = find_overlap(predictions.box, targets.box, anchors)
    np.testing.assert_allclose(overlap, expected, rtol=0, atol=1e-5)
    assert (expected > 0.3).sum() > 20
    lifted = anchors._replace(center=anchors.center + 1e6)
    np.testing.assert_array_equal(find_overlap(predictions.box, targets.box, lifted), overlap)


def test_terms_of_a_scene_by_hand():
    """Sums over the anchors divided by the positives, and the total with every weight of the config."""
    anchors = some_anchors(60)
    predictions, targets = random_pair(1, (60,))
    config = LossConfig(
        box_weight=0.7, direction_weight=0.4, iou_weight=3.0, focal_alpha=0.6, focal_gamma=1.5, smooth_l1_sigma=2.0
    )
    overlap = np.asarray(find_overlap(predictions.box, targets.box, anchors))
    expected = np.zeros(4)
    for i in range(60):
        label = int(targets.label[i])
        expected[0] += focal_by_hand(float(predictions.class_logit[i]), label, 0.6, 1.5)
        if label == 1:
            errors = np.asarray(predictions.box[i], np.float64) - np.asarray(targets.box[i])
            expected[1] += sum(smooth_l1_by_hand(error, 2.0) for error in (*errors[:6], np.sin(errors[6])))
            own, other = (
                predictions.direction[i][targets.direction[i]],
                predictions.direction[i][1 - targets.direction[i]],
            )
            expected[2] += np.log1p(np.exp(float(other) - float(own)))
            expected[3] += smooth_l1_by_hand(float(predictions.iou[i]) - (2 * overlap[i] - 1), 2.0)
    expected /= (np.asarray(targets.label) == 1).sum()
    terms = one_loss(predictions, targets, anchors, config)
    np.testing.assert_allclose(terms[:4], expected, rtol=2e-5)
    np.testing.assert_allclose(terms.total, expected @ [1, 0.7, 0.4, 3.0], rtol=2e-5)


# Gradients


def smooth_piece(name: str, dtype) -> tuple:
    """A piece as a function of its differentiable argument, with a point away from its kinks."""
    predictions, targets = random_pair(2, (12,), dtype)
    positive = targets.label == 1
    return {
        "classification": (lambda z: classification_loss(z, targets.label, **FOCAL), predictions.class_logit),
        "smooth_l1": (partial(smooth_l1, sigma=3.0), jnp.asarray([-2.0, -0.3, -0.05, 0.02, 0.09, 0.4], dtype)),
        "box": (lambda box: box_loss(box, targets.box, positive, sigma=3.0), predictions.box),
        "direction": (lambda z: direction_loss(z, targets.direction, positive), predictions.direction),
        "iou": (lambda iou: iou_loss(iou, jnp.full(12, 0.6, dtype), positive, sigma=3.0), predictions.iou),
    }[name]


@pytest.mark.smoke
@pytest.mark.parametrize("name", ["classification", "smooth_l1", "box", "direction", "iou"])
def test_gradients_match_the_values(name):
    with jax.enable_x64(True):
        piece, at = smooth_piece(name, np.float64)
        assert piece(at).dtype == jnp.float64
        check_grads(jax.jit(piece), (at,), order=1, modes=("fwd", "rev"), atol=1e-6, rtol=1e-6)


def test_gradients_of_the_total_match_its_values_except_for_the_overlap():
    with jax.enable_x64(True):
        anchors = some_anchors(20, np.float64)
        predictions, targets = random_pair(3, (2, 20), np.float64)

        def rest(class_logit, direction, iou):
            return detection_loss(
                Predictions(predictions.box, class_logit, direction, iou), targets, anchors, CONFIG
            ).total

        check_grads(jax.jit(rest), tuple(predictions[1:]), order=1, modes=("rev",), atol=1e-6, rtol=1e-6)

        def box_only(box):
            config = replace(CONFIG, iou_weight=0.0)
            return detection_loss(predictions._replace(box=box), targets, anchors, config).total

        check_grads(jax.jit(box_only), (predictions.box,), order=1, modes=("rev",), atol=1e-6, rtol=1e-6)


def test_the_iou_loss_has_no_gradient_in_the_box():
    anchors = some_anchors(40)
    predictions, targets = random_pair(4, (1, 40))
    gradient = jax.jit(jax.grad(lambda p: detection_loss(p, targets, anchors, CONFIG).iou))(predictions)
    assert not np.asarray(gradient.box).any()
    assert not np.asarray(gradient.class_logit).any()
    assert np.asarray(gradient.iou).any()


# Robustness

ANCHORS, ANCHOR_LABELS = make_anchors(tiny())
CAR_BOX = (6.0, 0.0, -1.0, 3.9, 1.6, 1.5, 0.2)
TRUTHS = {
    "no boxes": np.zeros((0, 7)),
    "zero size": [(*CAR_BOX[:3], 0, 0, 0, 0)],
    "zero width": [(*CAR_BOX[:4], 0, 1.5, 0)],
    "zero height": [(*CAR_BOX[:5], 0, 0)],
    "tiny": [(*CAR_BOX[:3], 1e-20, 1e-20, 1e-20, 0)],
    "identical": [CAR_BOX] * 3,
    "outside": [(500.0, 900.0, 50.0, *CAR_BOX[3:])],
    "edge": [(-1.5, 6.4, -1.0, *CAR_BOX[3:])],
    "not finite": [np.full(7, np.nan), CAR_BOX],
}


@jax.jit
def value_and_gradient(truth: GroundTruth, predictions: Predictions) -> tuple[LossTerms, Predictions]:
    targets = jax.vmap(lambda one: assign_targets(one, ANCHORS, ANCHOR_LABELS, tiny().classes))(truth)

    def loss(given: Predictions) -> tuple[jax.Array, LossTerms]:
        terms = detection_loss(given, targets, ANCHORS, CONFIG)
        return terms.total, terms

    (_, terms), gradient = jax.value_and_grad(loss, has_aux=True)(predictions)
    return terms, gradient


def one_scene(boxes: np.ndarray) -> GroundTruth:
    rows, label = np.zeros((1, 4, 7), np.float32), np.full((1, 4), -1, np.int32)
    rows[0, : len(boxes)], label[0, : len(boxes)] = boxes, 0
    return GroundTruth(Boxes.from_array(jnp.asarray(rows)), jnp.asarray(label), jnp.array([len(boxes)], jnp.int32))


@pytest.mark.parametrize("logit", [0.0, 1e4, -1e4])
@pytest.mark.parametrize("residual", [0.0, 1e3, -1e3, 50.0, 1e30])
@pytest.mark.parametrize("truth", TRUTHS)
def test_value_and_gradient_are_finite(truth, residual, logit):
    number = len(ANCHOR_LABELS)
    predictions = Predictions(
        box=jnp.full((1, number, 7), residual),
        class_logit=jnp.full((1, number), logit),
        direction=jnp.tile(jnp.array([logit, -logit]), (1, number, 1)),
        iou=jnp.full((1, number), logit),
    )
    terms, gradient = value_and_gradient(one_scene(np.asarray(TRUTHS[truth])), predictions)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((terms, gradient)))
    assert float(terms.total) > 0 or logit == -1e4


def test_masked_anchors_have_no_gradient_even_if_non_finite():
    anchors = some_anchors(30)
    predictions, targets = random_pair(5, (1, 30))
    positive, counts = targets.label == 1, targets.label >= 0
    broken = Predictions(
        jnp.where(positive[..., None], predictions.box, jnp.inf),
        jnp.where(counts, predictions.class_logit, jnp.nan),
        jnp.where(positive[..., None], predictions.direction, jnp.nan),
        jnp.where(positive, predictions.iou, jnp.nan),
    )
    run = jax.jit(jax.value_and_grad(lambda p: detection_loss(p, targets, anchors, CONFIG).total))
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6), run(broken), run(predictions))


def test_the_overlap_with_a_non_finite_box_is_zero():
    """exp(1e3) overflows float32, and so does exp(50) squared."""
    anchors = some_anchors(1)
    for residual in (1e3, 50.0, 1e30, np.inf, np.nan):
        overlap = find_overlap(jnp.full((1, 7), residual), jnp.zeros((1, 7)), anchors)
        assert float(overlap[0]) == 0
    assert float(find_overlap(jnp.zeros((1, 7)), jnp.zeros((1, 7)), anchors)[0]) == pytest.approx(1)


def test_a_perfect_prediction_has_no_loss():
    truth = Boxes.from_array(jnp.asarray([CAR_BOX]))
    anchors = some_anchors(1)._replace(center=jnp.array([[6.0, 0.2, -1.0]]))
    residuals = encode(truth, anchors)
    targets = Targets(jnp.array([1]), jnp.array([0]), residuals, jnp.array([1]))
    predictions = Predictions(residuals, jnp.array([40.0]), jnp.array([[-20.0, 20.0]]), jnp.array([1.0]))
    np.testing.assert_allclose(one_loss(predictions, targets, anchors, CONFIG), np.zeros(5), atol=1e-6)


# Batches and types


def test_a_scene_ignores_its_batch_mates_and_the_loss_is_their_mean():
    anchors = some_anchors(50)
    predictions, targets = random_pair(6, (3, 50))
    targets = targets._replace(label=targets.label.at[1].set(0), box=targets.box.at[1].set(0))
    batch = batch_losses(predictions, targets, anchors, CONFIG)
    for index in range(3):
        alone = one_loss(*jax.tree.map(lambda leaf, i=index: leaf[i], (predictions, targets)), anchors, CONFIG)
        np.testing.assert_allclose([term[index] for term in batch], alone, rtol=1e-6)
    assert [float(term[1]) for term in batch[1:4]] == [0, 0, 0]
    mean = total_loss(predictions, targets, anchors, CONFIG)
    np.testing.assert_allclose(mean, [term.mean() for term in batch], rtol=1e-6)


def test_half_precision_is_widened_before_anything_is_computed():
    anchors = some_anchors(50)
    predictions, targets = random_pair(7, (2, 50))
    half = jax.tree.map(lambda leaf: leaf.astype(jnp.bfloat16), predictions)
    wide = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), half)
    terms = total_loss(half, targets, anchors, CONFIG)
    assert {term.dtype for term in terms} == {jnp.dtype("float32")}
    np.testing.assert_allclose(terms, total_loss(wide, targets, anchors, CONFIG), rtol=1e-6)
    positive = targets.label == 1
    for piece, *given in (
        (lambda z: classification_loss(z, targets.label, **FOCAL), half.class_logit),
        (lambda box: box_loss(box, targets.box, positive, sigma=3.0), half.box),
        (lambda box: detached_overlap(box, box, anchors), half.box[0]),
        (lambda z: direction_loss(z, targets.direction, positive), half.direction),
        (lambda iou: iou_loss(iou, iou, positive, sigma=3.0), half.iou),
        (partial(smooth_l1, sigma=3.0), half.iou),
    ):
        assert jax.eval_shape(piece, *given).dtype == jnp.float32
