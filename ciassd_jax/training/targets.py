"""Which anchor should find which truth box (SPEC section 7; paper section 4.1)."""

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
    """Match the anchors of one scene to the truth boxes of their own class; `vmap` for a batch.

    An anchor is positive from its class's `matched` nearest IoU on, or if no anchor overlaps some truth box more (all
    ties), and belongs to the first box that it overlaps most. Below `unmatched` it is negative, between ignored.
    Boxes without volume and those that are not finite are no targets.
    """
    labels = jnp.asarray(anchor_labels)
    iou = jnp.where(
        _usable(truth)[:, None] & (truth.label[:, None] == labels[None]), nearest_iou(truth.boxes, anchors), 0
    )
    # Ties are ties of bits: the compiler must not compute an overlap twice in two ways.
    iou = lax.optimization_barrier(iou)
    best = iou.max(0)
    rows = jnp.arange(iou.shape[0], dtype=jnp.int32)[:, None]
    # Where the largest is first, as argmax says, which takes a CPU four times as long.
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
    """Intersection over union of the footprints of boxes and anchors, each turned to its nearest axis."""
    low, high = box_ops.nearest_aligned(boxes)
    anchor_low, anchor_high = box_ops.nearest_aligned(anchors)

    def shared_side(axis: int) -> Float[Array, "G A"]:
        upper = jnp.minimum(high[:, None, axis], anchor_high[None, :, axis])
        return (upper - jnp.maximum(low[:, None, axis], anchor_low[None, :, axis])).clip(0)

    shared = shared_side(0) * shared_side(1)
    union = (high - low).prod(-1)[:, None] + (anchor_high - anchor_low).prod(-1)[None] - shared
    return shared / union


def _usable(truth: GroundTruth) -> Bool[Array, " G"]:
    """Real boxes of a class, with a volume, finite."""
    rows = truth.boxes.to_array()
    real = (jnp.arange(truth.label.shape[0], dtype=jnp.int32) < truth.count) & (truth.label >= 0)
    return real & jnp.isfinite(rows).all(-1) & (truth.boxes.size > 0).all(-1)
