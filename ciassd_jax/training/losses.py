"""What training minimises (paper section 3.3, SPEC section 8): unreduced, masked pieces and their weighted sum.

Every piece computes in float32 or wider whatever it is given, and is finite in value and gradient wherever its
arguments are finite; what is masked may be anything.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Bool, Float, Int

from ciassd_jax.config import LossConfig
from ciassd_jax.ops import boxes as box_ops
from ciassd_jax.ops.iou import iou_3d
from ciassd_jax.types import Array, Boxes, LossTerms, Predictions, Targets


def classification_loss(
    logit: Float[Array, "*n"], label: Int[Array, "*n"], *, alpha: float, gamma: float
) -> Float[Array, "*n"]:
    """Sigmoid focal loss, weighted by alpha where the label is 1 and 1 - alpha where it is 0; 0 where it is -1."""
    counts = label >= 0
    loss = optax.losses.sigmoid_focal_loss(jnp.where(counts, _wide(logit), 0), label == 1, alpha=alpha, gamma=gamma)
    return jnp.where(counts, loss, 0)


def smooth_l1(error: Float[Array, "*n"], *, sigma: float) -> Float[Array, "*n"]:
    """(sigma * error)**2 / 2 up to an absolute error of 1 / sigma**2, then |error| - 1 / (2 * sigma**2)."""
    return sigma**2 * optax.losses.huber_loss(_wide(error), delta=1 / sigma**2)


def box_loss(
    predicted: Float[Array, "*n 7"], target: Float[Array, "*n 7"], positive: Bool[Array, "*n"], *, sigma: float
) -> Float[Array, "*n 7"]:
    """Smooth-L1 of each residual at positive anchors, of the sine of the difference for r; 0 elsewhere.

    The sine leaves it to the direction class which way a box looks.
    """
    error = jnp.where(positive[..., None], _wide(predicted) - _wide(target), 0)
    return smooth_l1(jnp.concatenate([error[..., :6], jnp.sin(error[..., 6:])], -1), sigma=sigma)


def direction_loss(
    logits: Float[Array, "*n 2"], direction: Int[Array, "*n"], positive: Bool[Array, "*n"]
) -> Float[Array, "*n"]:
    """Softmax cross-entropy at positive anchors, 0 elsewhere."""
    logits = jnp.where(positive[..., None], _wide(logits), 0)
    return jnp.where(positive, optax.losses.softmax_cross_entropy_with_integer_labels(logits, direction), 0)


def iou_loss(
    predicted: Float[Array, "*n"], overlap: Float[Array, "*n"], positive: Bool[Array, "*n"], *, sigma: float
) -> Float[Array, "*n"]:
    """Smooth-L1 between the raw IoU output and 2 * overlap - 1 at positive anchors, 0 elsewhere."""
    return smooth_l1(jnp.where(positive, _wide(predicted) - (2 * _wide(overlap) - 1), 0), sigma=sigma)


def detached_overlap(
    predicted: Float[Array, "*n 7"], target: Float[Array, "*n 7"], anchors: Boxes
) -> Float[Array, "*n"]:
    """3D IoU of the boxes that two sets of residuals mean on the anchors, without gradient.

    In [0, 1]; 0 where the predicted box is not finite or too large to have a volume. Only what is relative to the
    anchor counts, so that float32 need not spend its digits on where the anchor is.
    """
    anchors = anchors._replace(center=jnp.zeros_like(anchors.center))
    boxes = (box_ops.decode(lax.stop_gradient(_wide(residuals)), anchors) for residuals in (predicted, target))
    overlap = iou_3d(*boxes)
    return jnp.where(jnp.isfinite(overlap), overlap, 0).clip(0, 1)


def scene_loss(predictions: Predictions, targets: Targets, anchors: Boxes, config: LossConfig) -> LossTerms:
    """The terms of one scene: sums over its anchors, divided by the number of positive ones or 1 if there are none."""
    positive = targets.label == 1
    sigma = config.smooth_l1_sigma
    pieces = (
        classification_loss(predictions.class_logit, targets.label, alpha=config.focal_alpha, gamma=config.focal_gamma),
        box_loss(predictions.box, targets.box, positive, sigma=sigma),
        direction_loss(predictions.direction, targets.direction, positive),
        _iou_piece(predictions, targets, anchors, config),
    )
    classification, box, direction, iou = (piece.sum() / jnp.maximum(positive.sum(), 1) for piece in pieces)
    total = classification + config.box_weight * box + config.direction_weight * direction + config.iou_weight * iou
    return LossTerms(classification, box, direction, iou, total)


def _iou_piece(predictions: Predictions, targets: Targets, anchors: Boxes, config: LossConfig) -> Array:
    """`iou_loss` of every anchor, or zeros where the network has no IoU branch."""
    if predictions.iou is None:
        return jnp.zeros(targets.label.shape)
    overlap = detached_overlap(predictions.box, targets.box, anchors)
    return iou_loss(predictions.iou, overlap, targets.label == 1, sigma=config.smooth_l1_sigma)


def scene_losses(predictions: Predictions, targets: Targets, anchors: Boxes, config: LossConfig) -> LossTerms:
    """The terms of every scene of a batch, each of that scene alone."""
    return jax.vmap(lambda said, goal: scene_loss(said, goal, anchors, config))(predictions, targets)


def detection_loss(predictions: Predictions, targets: Targets, anchors: Boxes, config: LossConfig) -> LossTerms:
    """The terms of a batch: means over its scenes, those without boxes included."""
    return jax.tree.map(jnp.mean, scene_losses(predictions, targets, anchors, config))


def _wide(array: Array) -> jax.Array:
    return jnp.asarray(array, jnp.promote_types(array.dtype, jnp.float32))
