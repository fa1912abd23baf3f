"""Assignment of truth boxes to anchors (paper section 4.1)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Float, Int

from ciassd_jax.config import ClassConfig
from ciassd_jax.ops import boxes as box_ops
from ciassd_jax.types import Array, Boxes, GroundTruth, Targets


def assign_targets(
    truth: GroundTruth, anchors: Boxes, anchor_labels: Int[Array, " A"], classes: tuple[ClassConfig, ...]
) -> Targets:
    """Match the anchors of one scene to the truth boxes of their own class; `vmap` it over a batch.

    An anchor is matched to the box with which its nearest IoU is largest, the first one if several tie. It is positive
    if that IoU is at least its class's `matched`, or if no anchor overlaps one of the boxes more. Other anchors are
    negative below `unmatched` and ignored otherwise. Boxes with a non-positive size or non-finite numbers are not
    matched.
    """
    labels = jnp.asarray(anchor_labels)
    iou = jnp.where(
        _usable(truth)[:, None] & (truth.label[:, None] == labels[None]), nearest_iou(truth.boxes, anchors), 0
    )
    # Ties are exact: the compiler must not recompute the overlaps with different rounding.
    iou = lax.optimization_barrier(iou)
    best = iou.max(0)
    rows = jnp.arange(iou.shape[0], dtype=jnp.int32)[:, None]
    # The same as argmax, which takes four times as long on a CPU.
    first = jnp.where(iou == best[None], rows, iou.shape[0] - 1).min(0)
    best_of_truth = iou.max(1, keepdims=True)
    forced = jnp.any((iou == best_of_truth) & (best_of_truth > 0), 0)
    matched, unmatched = (
        jnp.array(limits)[labels] for limits in zip(*((c.matched, c.unmatched) for c in classes), strict=True)
    )
    positive = forced | (best >= matched)
    goal = jax.tree.map(lambda leaf: jnp.asarray(leaf)[first], box_ops.wrap_r(truth.boxes))
    return Targets(
        label=jnp.where(positive, 1, jnp.where(best < unmatched, 0, -1)).astype(jnp.int32),
        truth=jnp.where(positive, first, -1),
        box=jnp.where(positive[:, None], box_ops.encode(goal, anchors), 0),
        direction=jnp.where(positive, box_ops.direction_target(goal), 0),
    )


def nearest_iou(boxes: Boxes, anchors: Boxes) -> Float[Array, "G A"]:
    """Return the BEV IoU of every box and anchor, each rotated to the nearest axis."""
    low, high = box_ops.nearest_aligned(boxes)
    anchor_low, anchor_high = box_ops.nearest_aligned(anchors)

    def shared_side(axis: int) -> Float[Array, "G A"]:
        upper = jnp.minimum(high[:, None, axis], anchor_high[None, :, axis])
        return (upper - jnp.maximum(low[:, None, axis], anchor_low[None, :, axis])).clip(0)

    shared = shared_side(0) * shared_side(1)
    union = (high - low).prod(-1)[:, None] + (anchor_high - anchor_low).prod(-1)[None] - shared
    return shared / union


def _usable(truth: GroundTruth) -> Bool[Array, " G"]:
    """Which boxes are real, of a class, finite and of positive size."""
    rows = truth.boxes.to_array()
    real = (jnp.arange(truth.label.shape[0], dtype=jnp.int32) < truth.count) & (truth.label >= 0)
    return real & jnp.isfinite(rows).all(-1) & (truth.boxes.size > 0).all(-1)
