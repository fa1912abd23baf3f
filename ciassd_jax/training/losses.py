"""The losses of paper section 3.3: unreduced, masked pieces per anchor, and their weighted sum.

- `classification_loss`: sigmoid focal loss of logits [...]
- `box_loss`: smooth-L1 of residuals [..., 7] in the paper's order (x, y, z, w, l, h, r)
- `direction_loss`: softmax cross-entropy of two logits [..., 2]
- `iou_loss`: smooth-L1 of the IoU output [...], whose target comes from `detached_overlap`
- `scene_loss`, `scene_losses`, `detection_loss`: the terms of a scene [A], of each scene [B, A], and of a batch [B, A]

Pieces return one value per anchor (`box_loss` one per residual) for any leading shape. They compute in float32 or
wider, and are finite in value and gradient for finite inputs. Masked entries contribute exactly 0, even if non-finite.
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
    """Return the sigmoid focal loss: weight alpha for label 1 and 1 - alpha for label 0; 0 for label -1 (ignored)."""
    counts = label >= 0
    loss = optax.losses.sigmoid_focal_loss(jnp.where(counts, _wide(logit), 0), label == 1, alpha=alpha, gamma=gamma)
    return jnp.where(counts, loss, 0)


def smooth_l1(error: Float[Array, "*n"], *, sigma: float) -> Float[Array, "*n"]:
    """Return (sigma * error)**2 / 2 for |error| <= 1 / sigma**2, and |error| - 1 / (2 * sigma**2) beyond."""
    return sigma**2 * optax.losses.huber_loss(_wide(error), delta=1 / sigma**2)


def box_loss(
    predicted: Float[Array, "*n 7"], target: Float[Array, "*n 7"], positive: Bool[Array, "*n"], *, sigma: float
) -> Float[Array, "*n 7"]:
    """Return the smooth-L1 loss of each residual at positive anchors, 0 elsewhere.

    The error of the angle r is the sine of the difference, which is the same for opposite headings; the direction
    class tells them apart.
    """
    error = jnp.where(positive[..., None], _wide(predicted) - _wide(target), 0)
    return smooth_l1(jnp.concatenate([error[..., :6], jnp.sin(error[..., 6:])], -1), sigma=sigma)


def direction_loss(
    logits: Float[Array, "*n 2"], direction: Int[Array, "*n"], positive: Bool[Array, "*n"]
) -> Float[Array, "*n"]:
    """Return the softmax cross-entropy of the direction class (0 or 1) at positive anchors, 0 elsewhere."""
    logits = jnp.where(positive[..., None], _wide(logits), 0)
    return jnp.where(positive, optax.losses.softmax_cross_entropy_with_integer_labels(logits, direction), 0)


def iou_loss(
    predicted: Float[Array, "*n"], overlap: Float[Array, "*n"], positive: Bool[Array, "*n"], *, sigma: float
) -> Float[Array, "*n"]:
    """Return the smooth-L1 loss of the raw IoU output against 2 * overlap - 1 at positive anchors, 0 elsewhere."""
    return smooth_l1(jnp.where(positive, _wide(predicted) - (2 * _wide(overlap) - 1), 0), sigma=sigma)


def detached_overlap(
    predicted: Float[Array, "*n 7"], target: Float[Array, "*n 7"], anchors: Boxes
) -> Float[Array, "*n"]:
    """Return the 3D IoU in [0, 1] of the boxes that two sets of residuals encode, without gradient.

    It is 0 if the predicted box, or its volume, is not finite.
    """
    # The overlap does not depend on the anchor's position; at the origin float32 is most precise.
    anchors = anchors._replace(center=jnp.zeros_like(anchors.center))
    boxes = (box_ops.decode(lax.stop_gradient(_wide(residuals)), anchors) for residuals in (predicted, target))
    overlap = iou_3d(*boxes)
    return jnp.where(jnp.isfinite(overlap), overlap, 0).clip(0, 1)


def scene_loss(predictions: Predictions, targets: Targets, anchors: Boxes, config: LossConfig) -> LossTerms:
    """Return the terms of one scene: sums over its anchors, divided by the number of positive ones (at least 1)."""
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
    """Return `iou_loss` of every anchor, or zeros if the network has no IoU branch."""
    if predictions.iou is None:
        return jnp.zeros(targets.label.shape)
    overlap = detached_overlap(predictions.box, targets.box, anchors)
    return iou_loss(predictions.iou, overlap, targets.label == 1, sigma=config.smooth_l1_sigma)


def scene_losses(predictions: Predictions, targets: Targets, anchors: Boxes, config: LossConfig) -> LossTerms:
    """Return `scene_loss` of every scene of a batch."""
    return jax.vmap(lambda one, target: scene_loss(one, target, anchors, config))(predictions, targets)


def detection_loss(predictions: Predictions, targets: Targets, anchors: Boxes, config: LossConfig) -> LossTerms:
    """Return the terms of a batch: means over its scenes, empty ones included."""
    return jax.tree.map(jnp.mean, scene_losses(predictions, targets, anchors, config))


def _wide(array: Array) -> jax.Array:
    """Promote to float32 or wider."""
    return jnp.asarray(array, jnp.promote_types(array.dtype, jnp.float32))
