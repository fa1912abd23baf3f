"""Records that cross the boundary between two stages.

Every record is a NamedTuple of arrays. Shapes are given for one scene; a batch is the same record with a
leading axis B on every leaf. Padding comes last and is inert.

Letters: B scenes, P points, V voxel or site slots, A anchors, G truth boxes, K candidates, D detections,
H W cells of the bird's-eye-view (BEV) map, C channels, S strided stages of the backbone, N classes, O objects
that may be pasted and Q their points.

Frame: LiDAR, x forward, y left, z up, metres. Yaw is counter-clockwise from +x, in radians.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, UInt32

Array = jax.Array | np.ndarray
# Flax variables: {"params": ..., "batch_stats": ...}, or a train state that has both.
Variables = Any


class PointCloud(NamedTuple):
    """Points as x, y, z in metres and intensity in [0, 1]; the first `count` rows are real."""

    points: Float[Array, "*b P 4"]
    count: Int[Array, "*b"]  # type: ignore[assignment]


class Boxes(NamedTuple):
    """Boxes by geometric centre (x, y, z), size (length, width, height) and yaw."""

    center: Float[Array, "*b 3"]
    size: Float[Array, "*b 3"]
    yaw: Float[Array, "*b"]

    @classmethod
    def from_array(cls, array: Float[Array, "*b 7"]) -> Boxes:
        """Read (x, y, z, length, width, height, yaw) from the last axis."""
        return cls(array[..., :3], array[..., 3:6], array[..., 6])

    def to_array(self) -> Float[Array, "*b 7"]:
        """Write (x, y, z, length, width, height, yaw) on a last axis."""
        numpy = all(isinstance(leaf, np.ndarray) for leaf in self)
        parts = [self.center, self.size, self.yaw[..., None]]
        return np.concatenate(parts, -1) if numpy else jnp.concatenate(parts, -1)


class GroundTruth(NamedTuple):
    """Labelled boxes of a scene; the first `count` rows are real, the others zero with label -1.

    `label` is the class that a box is a target of (a similar class counts as it), -1 for an object of no class: an
    obstacle that nothing may be put onto, and no target.
    """

    boxes: Boxes
    label: Int[Array, "*b G"]
    count: Int[Array, "*b"]  # type: ignore[assignment]


class Scene(NamedTuple):
    """A labelled frame, padded: what the loader gives and `train_step` takes.

    `frame` is the frame's place in its data set, -1 for a scene that only fills a batch. `points_cut`, `boxes_cut` and
    `objects_cut` (of those drawn from the ground-truth database) count what was over capacity.
    """

    cloud: PointCloud
    truth: GroundTruth
    frame: Int[Array, "*b"]
    points_cut: Int[Array, "*b"]
    boxes_cut: Int[Array, "*b"]
    objects_cut: Int[Array, "*b"]


class SampledObjects(NamedTuple):
    """Objects drawn from the ground-truth database for one scene, in the LiDAR frame and the order of the draw.

    Slot k holds an object where `valid`: for every class two rounds of as many slots as objects may be wanted. Point
    q belongs to the object in slot `owner[q]`; padding points have the number of slots there. `wanted` is the
    number of objects of each class that the scene still lacks, `cut` counts objects whose points did not fit.
    """

    boxes: Boxes
    label: Int[Array, "*b O"]
    valid: Bool[Array, "*b O"]
    points: Float[Array, "*b Q 4"]
    owner: Int[Array, "*b Q"]
    wanted: Int[Array, "*b N"]
    cut: Int[Array, "*b"]


class SparseVoxels(NamedTuple):
    """Occupied voxels in ascending order of their linear key (y, x, z with z fastest).

    `coordinates` are (z, y, x). `first_point` is the index of the point that touched the voxel first.
    `dropped` counts voxels over capacity, `points_dropped` the points that went with them and those that are
    not finite.
    """

    features: Float[Array, "*b V C"]
    coordinates: Int[Array, "*b V 3"]
    num_points: Int[Array, "*b V"]
    first_point: Int[Array, "*b V"]
    count: Int[Array, "*b"]  # type: ignore[assignment]
    dropped: Int[Array, "*b"]
    points_in_range: Int[Array, "*b"]
    points_dropped: Int[Array, "*b"]


class Sites(NamedTuple):
    """Active sites of one grid by ascending linear key; padding has the largest int32 and comes last.

    `columns` finds them (`ops/sites.py`): for every BEV column (y, x) a bit for each active z in words of 32, then the
    slot of the lowest. The dense backend has none.
    """

    keys: Int[Array, "*b V"]
    count: Int[Array, "*b"]  # type: ignore[assignment]
    columns: UInt32[Array, "*b columns words"] | None = None


class NeighbourTable(NamedTuple):
    """Which input site each kernel offset reads, and its transpose for the backward pass.

    `inputs[o, k]` is the input site under offset k of output site o, `outputs[i, k]` the output site that
    reads input site i through offset k. Where there is none, the number of input (output) slots stands. The first
    `num_outputs` and `num_inputs` rows of a scene are real.
    """

    inputs: Int[Array, "*b V K"]
    outputs: Int[Array, "*b U K"]
    num_outputs: Int[Array, "*b"]
    num_inputs: Int[Array, "*b"]


class Predictions(NamedTuple):
    """What the network says of every anchor, before any decoding.

    `box` holds the residuals in the paper's order (x, y, z, w, l, h, r), `class_logit` the logit of the
    anchor's own class, `direction` two logits, `iou` the raw IoU output in about [-1, 1], None without that branch.
    """

    box: Float[Array, "*b A 7"]
    class_logit: Float[Array, "*b A"]
    direction: Float[Array, "*b A 2"]
    iou: Float[Array, "*b A"] | None


class Targets(NamedTuple):
    """What the network should say of every anchor.

    `label` is 1 for a positive anchor, 0 for a negative one, -1 for one that does not count. `truth` is the index of
    the truth box that a positive anchor is matched to, `box` the residuals to it in the paper's order and `direction`
    its direction class; the others have -1, zeros and 0 there.
    """

    label: Int[Array, "*b A"]
    truth: Int[Array, "*b A"]
    box: Float[Array, "*b A 7"]
    direction: Int[Array, "*b A"]


class LossTerms(NamedTuple):
    """The parts of the loss before their weights, and `total`, the weighted sum."""

    classification: Float[Array, "*b"]
    box: Float[Array, "*b"]
    direction: Float[Array, "*b"]
    iou: Float[Array, "*b"]
    total: Float[Array, "*b"]


class TrainState(NamedTuple):
    """Everything that a training step changes.

    `ema` is the running mean of the parameters, None where the config asks for none; evaluation and prediction use
    it when it is there. `skipped` counts updates that were not finite and therefore left out.
    """

    step: Int[Array, ""]
    params: Any
    batch_stats: Any
    optimizer: Any
    ema: Any
    skipped: Int[Array, ""]


class Counts(NamedTuple):
    """How much of a scene was used, and how much every fixed capacity had to drop.

    `points_dropped` are those that are not finite and those in range whose voxel was over capacity; points beyond
    the fixed number per voxel are not among them: the method leaves them out by design.
    """

    points_given: Int[Array, "*b"]
    points_in_range: Int[Array, "*b"]
    points_dropped: Int[Array, "*b"]
    voxels_kept: Int[Array, "*b"]
    voxels_dropped: Int[Array, "*b"]
    sites_kept: Int[Array, "*b S"]
    sites_dropped: Int[Array, "*b S"]
    candidates_kept: Int[Array, "*b"]
    candidates_dropped: Int[Array, "*b"]


class Candidates(NamedTuple):
    """Decoded anchors above the score threshold, best confidence first.

    `score` is the rectified confidence f = c * q**beta, `iou` the predicted IoU q, `anchor_distance` the
    BEV distance in metres between the box centre and its anchor's centre, `direction` the class (0 or 1).
    """

    boxes: Boxes
    score: Float[Array, "*b K"]
    iou: Float[Array, "*b K"]
    anchor_distance: Float[Array, "*b K"]
    direction: Int[Array, "*b K"]
    label: Int[Array, "*b K"]
    valid: Bool[Array, "*b K"]


class Detections(NamedTuple):
    """Final boxes in the order of their selection; the first `count` rows are real, the others zero."""

    boxes: Boxes
    score: Float[Array, "*b D"]
    label: Int[Array, "*b D"]
    count: Int[Array, "*b"]  # type: ignore[assignment]
    counts: Counts
