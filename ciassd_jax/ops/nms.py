"""Rotated NMS and distance-variant IoU-weighted NMS (DI-NMS; paper section 3.4 and Algorithm 1), in parallel.

Greedy suppression is the fixed point of `keep = eligible & ~any(overlaps & earlier & keep)`, reached in a few
iterations; no loop runs over boxes. All functions take one scene of K candidates in order of selection.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Float, Int

from ciassd_jax.ops.iou import iou_bev
from ciassd_jax.ops.platform import Program, by_platform
from ciassd_jax.ops.rows import take_rows
from ciassd_jax.types import Array, Boxes, Candidates

_BLOCK_ROWS = 64


class Clusters(NamedTuple):
    """One box for each candidate; rows that are not `selected` are undefined."""

    boxes: Boxes
    score: Float[Array, " K"]
    selected: Bool[Array, " K"]


def pairwise_iou(boxes: Boxes, count: Int[Array, ""], program: Program = "auto") -> Float[Array, "K K"]:
    """Rotated BEV IoU of the first `count` boxes with each other, zero elsewhere."""
    overlap = by_platform(program, boxes, count, cpu=_pairs_in_blocks, accelerator=_pairs_at_once)
    real = jnp.arange(boxes.yaw.shape[0], dtype=jnp.int32) < count
    return jnp.where(real[:, None] & real[None], overlap, 0)


def _pairs_at_once(boxes: Boxes, count: Int[Array, ""]) -> Float[Array, "K K"]:
    rows, columns = (jax.tree.map(partial(jnp.expand_dims, axis=axis), boxes) for axis in (1, 0))
    # Each consumer would compute the overlaps again, and compile them.
    return lax.optimization_barrier(iou_bev(rows, columns))


@jax.custom_batching.sequential_vmap
def _pairs_in_blocks(boxes: Boxes, count: Int[Array, ""]) -> Float[Array, "K K"]:
    """Block of rows after block of rows, scene after scene, so that padding costs nothing; later blocks are zero."""
    capacity = boxes.yaw.shape[0]
    rows = min(_BLOCK_ROWS, capacity)
    blocks = -(-capacity // rows)
    padded = jax.tree.map(lambda leaf: _pad_rows(leaf, blocks * rows), boxes)
    columns = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], boxes)

    def fill(block: Array, result: Array) -> Array:
        start = block * rows
        some = jax.tree.map(lambda leaf: lax.dynamic_slice_in_dim(leaf, start, rows)[:, None], padded)
        return lax.dynamic_update_slice_in_dim(result, iou_bev(some, columns), start, 0)

    empty = jnp.zeros((blocks * rows, capacity), boxes.yaw.dtype)
    return lax.fori_loop(jnp.int32(0), (-(-count // rows)).astype(jnp.int32), fill, empty)[:capacity]


def _pad_rows(array: Array, rows: int) -> Array:
    return jnp.pad(array, ((0, rows - array.shape[0]),) + ((0, 0),) * (array.ndim - 1))


def greedy_keep(overlaps: Bool[Array, "K K"], eligible: Bool[Array, " K"]) -> Bool[Array, " K"]:
    """Greedy suppression in index order: keep an eligible entry unless an earlier kept one overlaps it."""
    slots = jnp.arange(eligible.shape[0], dtype=jnp.int32)
    suppresses = overlaps & (slots[:, None] < slots[None])

    def step(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        keep, _ = state
        updated = jnp.asarray(eligible) & ~(suppresses & keep[:, None]).any(0)
        return updated, (updated != keep).any()

    return lax.while_loop(lambda state: state[1], step, (jnp.asarray(eligible), jnp.array(True)))[0]


def rotated_nms(
    candidates: Candidates, *, overlap: float, limit: int | None = None, program: Program = "auto"
) -> Clusters:
    """Plain NMS within each class: a kept box suppresses later ones of IoU at or above `overlap`.

    `limit` keeps the first so many only. Boxes and scores stay as they are.
    """
    iou, _ = _class_overlap(candidates, program)
    selected = greedy_keep(iou >= overlap, candidates.valid)
    if limit is not None:
        selected &= jnp.cumsum(selected, dtype=jnp.int32) <= limit
    return Clusters(candidates.boxes, candidates.score, selected)


def released_di_nms(
    candidates: Candidates,
    *,
    overlap: float,
    support_threshold: Float[Array, " K"],
    sigma_squared: tuple[float, ...],
    distances: tuple[float, ...],
    program: Program = "auto",
) -> Clusters:
    """DI-NMS as in the released code.

    Support counts all candidates that overlap at all, so that it is known before any is selected. A candidate without
    enough support never suppresses another. Each kept box averages all candidates that overlap it by more than the
    limit, raw yaw included. The softmax of squared anchor distances refines the reported score only. Boxes beyond the
    last distance have no weight and are not selected.
    """
    iou, real = _class_overlap(candidates, program)
    support = jnp.where(iou > 0, iou * candidates.iou[None], 0).sum(1)
    keep = greedy_keep(iou >= overlap, candidates.valid & (support > support_threshold))
    members = (iou > overlap) & real
    refined = candidates.score * (1 - _masked_softmax(candidates.anchor_distance**2, candidates.valid))
    score = jnp.where(members, refined[None], -jnp.inf).max(1)
    ranges = jnp.linalg.norm(candidates.boxes.center[:, :2], axis=-1)
    weights = _gaussian(iou, _sigma_squared(ranges, sigma_squared, distances)[:, None]) * candidates.iou[None]
    boxes = _average(candidates.boxes, jnp.where(members, weights, 0), align=False)
    return Clusters(boxes, score, keep & (ranges < distances[-1]))


def paper_di_nms(
    candidates: Candidates,
    *,
    overlap: float,
    support_threshold: Float[Array, " K"],
    sigma_squared: tuple[float, ...],
    distances: tuple[float, ...],
    program: Program = "auto",
) -> Clusters:
    """DI-NMS of the paper (Algorithm 1).

    Candidates must come in order of their score, which is reported too. A suppressed box belongs to the first
    kept box that overlaps it; support and average run over those. A cluster without enough support is removed.
    Each auxiliary box is weighted by the sigma of its own distance, its yaw first aligned to the candidate
    modulo pi.
    """
    iou, real = _class_overlap(candidates, program)
    overlaps = (iou > overlap) & real
    keep = greedy_keep(overlaps, candidates.valid)
    # argmax finds the first kept candidate that overlaps each box; a kept one is its own.
    owner = jnp.argmax(overlaps & keep[:, None], axis=0)
    slots = jnp.arange(owner.shape[0], dtype=owner.dtype)
    members = overlaps & keep[:, None] & (owner[None] == slots[:, None])
    support = jnp.where(members, iou * candidates.iou[None], 0).sum(1)
    ranges = jnp.linalg.norm(candidates.boxes.center[:, :2], axis=-1)
    weights = _gaussian(iou, _sigma_squared(ranges, sigma_squared, distances)[None]) * candidates.iou[None]
    boxes = _average(candidates.boxes, jnp.where(members, weights, 0), align=True)
    return Clusters(boxes, candidates.score, keep & (support > support_threshold))


def refine_by_anchor_distance(candidates: Candidates) -> Candidates:
    """Lower the score of boxes far from their anchor and sort by it (Algorithm 1, line 2).

    S = f * (1 - softmax(distance)) over the candidates of the scene, distance in metres.
    """
    score = candidates.score * (1 - _masked_softmax(candidates.anchor_distance, candidates.valid))
    order = jnp.argsort(jnp.where(candidates.valid, score, -jnp.inf), descending=True, stable=True)
    return take_rows(candidates._replace(score=score), order)


def _class_overlap(candidates: Candidates, program: Program) -> tuple[Float[Array, "K K"], Bool[Array, "K K"]]:
    """IoU between candidates of one class, zero between classes, and which pairs are real and of one class."""
    count = candidates.valid.sum(dtype=jnp.int32)
    same = candidates.label[:, None] == candidates.label[None]
    same &= candidates.valid[:, None] & candidates.valid[None]
    return jnp.where(same, pairwise_iou(candidates.boxes, count, program), 0), same


def _masked_softmax(values: Float[Array, " K"], valid: Bool[Array, " K"]) -> Float[Array, " K"]:
    """Softmax over the valid entries, zero elsewhere and where there is none."""
    top = jnp.max(values, where=valid, initial=-jnp.inf)
    powers = jnp.where(valid, jnp.exp(jnp.where(valid, values - top, 0)), 0)
    return powers / jnp.maximum(powers.sum(), 1)


def _sigma_squared(ranges: Array, sigma_squared: tuple[float, ...], distances: tuple[float, ...]) -> Array:
    """Sigma squared by the BEV distance of a box; a distance itself belongs to the farther band."""
    band = sum((ranges >= limit).astype(jnp.int32) for limit in distances)
    return jnp.array(sigma_squared, ranges.dtype)[band]


def _gaussian(iou: Array, sigma_squared: Array) -> Array:
    """Weight exp(-(1 - IoU)^2 / sigma^2) of an auxiliary box (paper equation 8)."""
    return jnp.exp(-((1 - iou) ** 2) / sigma_squared)


def _average(boxes: Boxes, weights: Float[Array, "K K"], *, align: bool) -> Boxes:
    """Weighted mean of the boxes for every row of weights; a row without weight keeps its own box.

    Averages offsets from the row's own box: means of coordinates of 60 m would lose 1e-5 m to rounding.
    """
    own, total = boxes.to_array(), weights.sum(1)
    share = weights / jnp.where(total != 0, total, 1)[:, None]
    # A box of infinite size overlaps nothing, but zero weight times infinity would be NaN.
    finite = jnp.where(jnp.isfinite(own), own, 0)
    offsets = finite[None] - finite[:, None]
    if align:
        offsets = offsets.at[..., 6].add(-jnp.pi * jnp.round(offsets[..., 6] / jnp.pi))
    return Boxes.from_array(own + (share[..., None] * offsets).sum(1))
