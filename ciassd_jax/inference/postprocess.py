"""From raw predictions to boxes: decode, rectify the confidence, suppress, orient (paper section 3.4, SPEC 10)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Float, Int

from ciassd_jax.config import ClassConfig, Config, DetectionConfig
from ciassd_jax.model.anchors import make_anchors
from ciassd_jax.model.network import RawPredictions
from ciassd_jax.ops import boxes as box_ops
from ciassd_jax.ops import camera, nms
from ciassd_jax.ops.rows import take_rows
from ciassd_jax.types import Array, Boxes, Candidates, Counts, Detections, PointCloud, Predictions

RANGE_AXES = tuple[float, float]


def rectify(
    probability: Float[Array, "*n"], iou: Float[Array, "*n"], config: DetectionConfig
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Confidence f = c * q**beta and the predicted IoU q = (raw + 1) / 2 (paper equation 6)."""
    quality = (iou + 1) / 2
    if config.clamp_iou:
        quality = quality.clip(0, 1)
    # An unclamped q may be slightly negative; beta is even in the paper, so its sign never counts.
    return probability * jnp.abs(quality) ** config.iou_exponent, quality


def select_candidates(
    predictions: Predictions, anchors: Boxes, labels: Int[Array, " A"], config: DetectionConfig
) -> tuple[Candidates, Int[Array, ""]]:
    """Decode the anchors of one scene whose class probability reaches the threshold.

    Returns the `max_candidates` of best rectified confidence, best first, and how many more there were.
    """
    probability = jax.nn.sigmoid(predictions.class_logit)
    # Without an IoU branch every box counts as perfect.
    raw_iou = jnp.ones_like(probability) if predictions.iou is None else predictions.iou
    score, quality = rectify(probability, raw_iou, config)
    passes = probability >= config.score_threshold
    capacity = min(config.max_candidates, passes.shape[0])
    # What is no number could not be ranked: it is counted with the dropped.
    usable = passes & jnp.isfinite(score) & jnp.isfinite(predictions.box).all(-1)
    best, index = lax.top_k(jnp.where(usable, score, -jnp.inf), capacity)
    valid = jnp.isfinite(best)
    said = (predictions.box, predictions.direction, quality, anchors, labels)
    residuals, direction, quality, chosen, label = take_rows(said, index)
    boxes = box_ops.decode(residuals, chosen)
    offset = boxes.center[:, :2] - chosen.center[:, :2]
    candidates = Candidates(
        boxes=boxes,
        score=jnp.where(valid, best, 0),
        iou=quality,
        anchor_distance=jnp.sqrt((offset**2).sum(-1)),
        direction=jnp.argmax(direction, -1).astype(jnp.int32),
        label=label,
        valid=valid,
    )
    return candidates, passes.sum(dtype=jnp.int32) - valid.sum(dtype=jnp.int32)


def suppress(
    candidates: Candidates, config: DetectionConfig, classes: tuple[ClassConfig, ...]
) -> tuple[Candidates, nms.Clusters]:
    """The configured NMS; also returns the candidates in the order that it selected from."""
    if config.nms == "rotated":
        return candidates, nms.rotated_nms(candidates, overlap=config.nms_iou_threshold)
    run = nms.released_di_nms
    if config.nms == "paper":
        candidates, run = nms.refine_by_anchor_distance(candidates), nms.paper_di_nms
    thresholds = jnp.array([c.support_threshold for c in classes], jnp.float32)
    return candidates, run(
        candidates,
        overlap=config.nms_iou_threshold,
        support_threshold=thresholds[candidates.label],
        sigma_squared=config.sigma_squared,
        distances=config.sigma_distances,
    )


def finish(
    candidates: Candidates,
    clusters: nms.Clusters,
    *,
    x_limits: RANGE_AXES,
    y_limits: RANGE_AXES,
    z_limits: RANGE_AXES,
    frustum: Float[Array, "6 4"] | None,
) -> tuple[Boxes, Float[Array, " K"], Int[Array, " K"], Int[Array, ""]]:
    """Direction, frustum and range of the selected boxes; boxes, scores, labels and how many are real.

    The real ones come first, in the order of selection; the others are zero. Yaw is not wrapped.
    """
    keep = clusters.selected
    if frustum is not None:
        keep &= camera.inside_planes(clusters.boxes.center, frustum)
    boxes = box_ops.apply_direction(clusters.boxes, candidates.direction)
    minimum, maximum = zip(x_limits, y_limits, z_limits, strict=True)
    keep &= box_ops.inside_range(boxes, minimum, maximum)
    order = jnp.argsort(~keep, stable=True)
    keep, *selected = take_rows((keep, boxes, clusters.score, candidates.label), order)
    boxes, score, label = jax.tree.map(
        lambda leaf: jnp.where(keep.reshape((-1,) + (1,) * (leaf.ndim - 1)), leaf, 0), tuple(selected)
    )
    return boxes, score, label, keep.sum(dtype=jnp.int32)


def postprocess(
    raw: RawPredictions, cloud: PointCloud, config: Config, *, frustum: Float[Array, "B 6 4"] | None = None
) -> Detections:
    """Decode, rectify, suppress and filter each scene of the batch on its own."""
    anchors, labels = make_anchors(config)
    low, high = config.grid.minimum, config.grid.maximum

    def one_scene(predictions: Predictions, planes: Array | None) -> tuple:
        candidates, dropped = select_candidates(predictions, anchors, labels, config.detection)
        kept = candidates.valid.sum(dtype=jnp.int32)
        candidates, clusters = suppress(candidates, config.detection, config.classes)
        result = finish(
            candidates,
            clusters,
            x_limits=(low[0], high[0]),
            y_limits=(low[1], high[1]),
            z_limits=config.detection.z_limits,
            frustum=planes,
        )
        return *result, kept, dropped

    with jax.named_scope("postprocess"):
        planes = None if frustum is None else jnp.asarray(frustum, jnp.float32)
        in_axes = (0, None if planes is None else 0)
        boxes, score, label, count, kept, dropped = jax.vmap(one_scene, in_axes)(raw.predictions, planes)
    # Results leave here: only now is the yaw folded to [-pi, pi).
    boxes = boxes._replace(yaw=box_ops.wrap_angle(boxes.yaw))
    voxels = raw.voxels
    counts = Counts(
        points_given=jnp.asarray(cloud.count),
        points_in_range=voxels.points_in_range,
        points_dropped=voxels.points_dropped,
        voxels_kept=voxels.count,
        voxels_dropped=voxels.dropped,
        sites_kept=raw.sites_kept,
        sites_dropped=raw.sites_dropped,
        candidates_kept=kept,
        candidates_dropped=dropped,
    )
    return Detections(boxes, score, label, count, counts)
