"""From raw predictions to boxes: decode, rectify the confidence, suppress, orient (paper section 3.4)."""

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
from ciassd_jax.ops.platform import Program
from ciassd_jax.ops.rows import take_rows
from ciassd_jax.types import Array, Boxes, Candidates, Counts, Detections, Predictions

Vector = tuple[float, float, float]


def rectify(
    probability: Float[Array, "*n"], iou: Float[Array, "*n"], config: DetectionConfig
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Return the confidence f = c * q**beta and the predicted IoU q = (raw + 1) / 2 (paper equation 6)."""
    quality = (iou + 1) / 2
    if config.clamp_iou:
        quality = quality.clip(0, 1)
    # Without clamping q may be slightly negative. beta is 4 in the paper, so the sign does not matter.
    return probability * jnp.abs(quality) ** config.iou_exponent, quality


def select_candidates(
    predictions: Predictions, anchors: Boxes, labels: Int[Array, " A"], config: DetectionConfig
) -> tuple[Candidates, Int[Array, ""]]:
    """Decode the anchors of one scene whose class probability reaches `config.score_threshold`.

    Return the `config.max_candidates` of highest rectified confidence, best first, and the number that was dropped.
    Non-finite candidates are dropped and counted.
    """
    probability = jax.nn.sigmoid(predictions.class_logit)
    # Without an IoU branch the predicted IoU q is 1.
    raw_iou = jnp.ones_like(probability) if predictions.iou is None else predictions.iou
    score, quality = rectify(probability, raw_iou, config)
    passes = probability >= config.score_threshold
    capacity = min(config.max_candidates, passes.shape[0])
    usable = passes & jnp.isfinite(score) & jnp.isfinite(predictions.box).all(-1)
    best, index = lax.top_k(jnp.where(usable, score, -jnp.inf), capacity)
    valid = jnp.isfinite(best)
    columns = (predictions.box, predictions.direction, quality, anchors, labels)
    residuals, direction, quality, chosen, label = take_rows(columns, index)
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
    candidates: Candidates, config: DetectionConfig, classes: tuple[ClassConfig, ...], program: Program = "auto"
) -> tuple[Candidates, nms.Clusters]:
    """Run the NMS of `config.nms`; return the candidates in its order of selection, and their clusters."""
    if config.nms == "rotated":
        return candidates, nms.rotated_nms(candidates, overlap=config.nms_iou_threshold, program=program)
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
        program=program,
    )


def finish(
    candidates: Candidates,
    clusters: nms.Clusters,
    *,
    minimum: Vector,
    maximum: Vector,
    frustum: Float[Array, "6 4"] | None,
    min_score: float = 0.0,
) -> tuple[Boxes, Float[Array, " K"], Int[Array, " K"], Int[Array, ""]]:
    """Orient the selected boxes; drop those whose centre is outside the frustum or the closed range, or of low score.

    Return boxes, scores, labels and count. The real rows come first, in the order of selection; the others are zero.
    Yaw is not wrapped. A score reaches `min_score` or is dropped.
    """
    keep = clusters.selected
    if frustum is not None:
        keep &= camera.inside_planes(clusters.boxes.center, frustum)
    boxes = box_ops.apply_direction(clusters.boxes, candidates.direction)
    keep &= box_ops.inside_range(boxes, minimum, maximum)
    if min_score > 0:
        keep &= clusters.score >= min_score
    order = jnp.argsort(~keep, stable=True)
    keep, *selected = take_rows((keep, boxes, clusters.score, candidates.label), order)
    boxes, score, label = jax.tree.map(
        lambda leaf: jnp.where(keep.reshape((-1,) + (1,) * (leaf.ndim - 1)), leaf, 0), tuple(selected)
    )
    return boxes, score, label, keep.sum(dtype=jnp.int32)


def postprocess(raw: RawPredictions, config: Config, *, frustum: Float[Array, "B 6 4"] | None = None) -> Detections:
    """Decode, rectify, suppress and filter the predictions of each scene; yaw is wrapped to [-pi, pi).

    `frustum` (`ops.camera.frustum_planes`) drops boxes whose centre is outside the camera's view.
    """
    anchors, labels = make_anchors(config)
    (low, high), grid, shift = config.detection.z_limits, config.grid, config.input.z_shift
    minimum, maximum = (*grid.minimum[:2], low - shift), (*grid.maximum[:2], high - shift)

    def one_scene(scene: RawPredictions, planes: Array | None) -> Detections:
        candidates, dropped = select_candidates(scene.predictions, anchors, labels, config.detection)
        counts = _count(scene, candidates, dropped)
        candidates, clusters = suppress(candidates, config.detection, config.classes, config.program)
        boxes, score, label, count = finish(
            candidates,
            clusters,
            minimum=minimum,
            maximum=maximum,
            frustum=planes,
            min_score=config.detection.min_score,
        )
        return Detections(boxes._replace(yaw=box_ops.wrap_angle(boxes.yaw)), score, label, count, counts)

    with jax.named_scope("postprocess"):
        planes = None if frustum is None else jnp.asarray(frustum, jnp.float32)
        return jax.vmap(one_scene, in_axes=(0, None if planes is None else 0))(raw, planes)


def _count(scene: RawPredictions, candidates: Candidates, dropped: Int[Array, ""]) -> Counts:
    voxels = scene.voxels
    return Counts(
        points_given=voxels.points_given,
        points_in_range=voxels.points_in_range,
        points_dropped=voxels.points_dropped,
        voxels_kept=voxels.count,
        voxels_dropped=voxels.dropped,
        sites_kept=scene.sites_kept,
        sites_dropped=scene.sites_dropped,
        candidates_kept=candidates.valid.sum(dtype=jnp.int32),
        candidates_dropped=dropped,
    )
