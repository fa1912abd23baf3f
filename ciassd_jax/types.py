"""Records that pass from one stage to the next.

Every record is a NamedTuple of arrays. Shapes are given for one scene; a batch is the same record with a leading axis
B on every leaf. Real entries come first, padding after them. A record prints types and shapes, and few numbers.

Letters of shapes:
    B     scenes of a batch
    P     points
    V     voxel or site slots
    A     anchors
    G     truth boxes
    D     detections
    H, W  cells of the bird's-eye-view (BEV) map along y and x
    C     channels
    S     strided stages of the backbone
    N     classes
    K, J  candidates, or offsets of a sparse kernel; its columns along y and x
    O, Q  objects for ground-truth sampling, their points

Coordinates are in the LiDAR frame: x forward, y left, z up, in metres. Yaw is counter-clockwise from +x, in radians.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, UInt32

Array = jax.Array | np.ndarray
# {"params": ..., "batch_stats": ...} as in Flax, or a train state.
Variables = Any


class PointCloud(NamedTuple):
    """Points as (x, y, z, intensity), intensity in [0, 1]; the first `count` rows are real."""

    points: Float[Array, "*b P 4"]
    count: Int[Array, "*b"]  # type: ignore[assignment]


class Boxes(NamedTuple):
    """Boxes as geometric centre (x, y, z), size (length, width, height) and yaw."""

    center: Float[Array, "*b 3"]
    size: Float[Array, "*b 3"]
    yaw: Float[Array, "*b"]

    @classmethod
    def from_array(cls, array: Float[Array, "*b 7"]) -> Boxes:
        """Return boxes from (x, y, z, length, width, height, yaw) on the last axis."""
        return cls(array[..., :3], array[..., 3:6], array[..., 6])

    def to_array(self) -> Float[Array, "*b 7"]:
        """Return (x, y, z, length, width, height, yaw) on a new last axis; NumPy if all leaves are."""
        numpy = all(isinstance(leaf, np.ndarray) for leaf in self)
        parts = [self.center, self.size, self.yaw[..., None]]
        return np.concatenate(parts, -1) if numpy else jnp.concatenate(parts, -1)


class GroundTruth(NamedTuple):
    """Labelled boxes of a scene; the first `count` rows are real, the others zero with label -1.

    `label` is the class that a box is a target of; a similar class counts as it. Label -1 marks an obstacle: an object
    that is no target but keeps sampled objects away.
    """

    boxes: Boxes
    label: Int[Array, "*b G"]
    count: Int[Array, "*b"]  # type: ignore[assignment]


class Scene(NamedTuple):
    """A labelled frame, padded: the loader's output and the input of `train_step`.

    `frame` is the index of the frame in its data set, -1 for a scene that only fills a batch. `points_cut`, `boxes_cut`
    and `objects_cut` (objects drawn from the ground-truth database) count what was over capacity.
    """

    cloud: PointCloud
    truth: GroundTruth
    frame: Int[Array, "*b"]
    points_cut: Int[Array, "*b"]
    boxes_cut: Int[Array, "*b"]
    objects_cut: Int[Array, "*b"]


class SampledObjects(NamedTuple):
    """Objects drawn from the ground-truth database for one scene, in the LiDAR frame and the order of the draw.

    Slots where `valid` hold an object. Each class has two rounds of slots, each of `gt_sampling_up_to`. Point q belongs
    to the object in slot `owner[q]`; for padding points `owner` is the number of slots. `wanted` is the number of
    objects of each class that the scene still lacks, `cut` counts objects whose points did not fit.
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

    `features` are the mean of a voxel's first points, `coordinates` are (z, y, x), and `first_point` is the index of
    the first point in the voxel. `dropped` counts voxels over capacity, `points_given` all points of the cloud,
    `points_dropped` those that are not finite or have an intensity beyond 1000, and those whose voxel was dropped.
    """

    features: Float[Array, "*b V C"]
    coordinates: Int[Array, "*b V 3"]
    num_points: Int[Array, "*b V"]
    first_point: Int[Array, "*b V"]
    count: Int[Array, "*b"]  # type: ignore[assignment]
    dropped: Int[Array, "*b"]
    points_given: Int[Array, "*b"]
    points_in_range: Int[Array, "*b"]
    points_dropped: Int[Array, "*b"]


class Sites(NamedTuple):
    """Active sites of one grid by ascending linear key; the key of padding is the largest int32.

    `masks` and `starts` find a site's slot (`ops/sites.py`): for every BEV column (y, x) one bit per active z, in words
    of 32, and the slot of the lowest site, undefined for an empty column. The dense backend has none.
    """

    keys: Int[Array, "*b V"]
    count: Int[Array, "*b"]  # type: ignore[assignment]
    masks: UInt32[Array, "*b words Y X"] | None = None
    starts: Int[Array, "*b Y X"] | None = None


class NeighbourTable(NamedTuple):
    """The input sites that each output site reads, and the transposed table for the backward pass.

    `inputs[j, v]` is the run (`ops/runs.py`) of the inputs of output site v in column j of its window (y, x), and
    `outputs[j, u]` the run of the outputs that read input site u. The followers are those of the sites that the runs
    consist of. The first `num_outputs` and `num_inputs` sites of a scene are real.
    """

    inputs: Int[Array, "*b J V"]
    outputs: Int[Array, "*b J U"]
    input_followers: Int[Array, "*b U"]
    output_followers: Int[Array, "*b V"]
    num_outputs: Int[Array, "*b"]
    num_inputs: Int[Array, "*b"]


class Predictions(NamedTuple):
    """The network's output for every anchor, not decoded.

    `box` holds the residuals in the paper's order (x, y, z, w, l, h, r), `class_logit` the logit of the anchor's own
    class, `direction` two logits, `iou` the raw IoU output in about [-1, 1]; it is None without that branch.
    """

    box: Float[Array, "*b A 7"]
    class_logit: Float[Array, "*b A"]
    direction: Float[Array, "*b A 2"]
    iou: Float[Array, "*b A"] | None


class Targets(NamedTuple):
    """The training targets of every anchor.

    `label` is 1 for a positive anchor, 0 for a negative one and -1 for an ignored one. For a positive anchor `truth` is
    the index of its truth box, `box` the residuals to that box in the paper's order and `direction` its direction
    class; for other anchors these are -1, zeros and 0.
    """

    label: Int[Array, "*b A"]
    truth: Int[Array, "*b A"]
    box: Float[Array, "*b A 7"]
    direction: Int[Array, "*b A"]


class LossTerms(NamedTuple):
    """The unweighted terms of the loss, and `total`, their weighted sum."""

    classification: Float[Array, "*b"]
    box: Float[Array, "*b"]
    direction: Float[Array, "*b"]
    iou: Float[Array, "*b"]
    total: Float[Array, "*b"]


class LossOutput(NamedTuple):
    """What `compute_loss` finds besides the loss.

    `terms` are means over the scenes, `batch_stats` the new running statistics, `predictions` the network's output and
    `features` the BEV map that the head read. `counts` are the overflow counts by name, sums over the scenes.
    """

    terms: LossTerms
    targets: Targets
    predictions: Predictions
    features: Float[Array, "B H W C"]
    batch_stats: Any
    counts: dict[str, jax.Array]


class TrainState(NamedTuple):
    """Everything that a training step changes.

    `ema` is the running mean of the parameters, None if `schedule.ema_decay` is 0; evaluation and prediction use it in
    place of `params`. `skipped` counts updates that were skipped because they were not finite.
    """

    step: Int[Array, ""]
    params: Any
    batch_stats: Any
    optimizer: Any
    ema: Any
    skipped: Int[Array, ""]


class Counts(NamedTuple):
    """How much of a scene was used, and how much did not fit into the fixed capacities.

    `points_dropped` counts points that are not finite or have an intensity beyond 1000, and points in range whose voxel
    was over capacity. Points beyond `grid.max_points_per_voxel` are not counted: the method ignores them by design.
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

    `score` is the rectified confidence f = c * q**beta (paper equation 6), `iou` the predicted IoU q, `anchor_distance`
    the BEV distance in metres between the centres of box and anchor, `direction` the direction class, 0 or 1.
    """

    boxes: Boxes
    score: Float[Array, "*b K"]
    iou: Float[Array, "*b K"]
    anchor_distance: Float[Array, "*b K"]
    direction: Int[Array, "*b K"]
    label: Int[Array, "*b K"]
    valid: Bool[Array, "*b K"]


class Detections(NamedTuple):
    """Final boxes in the order of selection; the first `count` rows are real, the others zero."""

    boxes: Boxes
    score: Float[Array, "*b D"]
    label: Int[Array, "*b D"]
    count: Int[Array, "*b"]  # type: ignore[assignment]
    counts: Counts


# Longer arrays print as type and shape.
_MOST_PRINTED = 8


def _describe_record(record: Any) -> str:
    """Return the record's name and fields in short."""
    fields = ", ".join(f"{name}={_describe(value)}" for name, value in record._asdict().items())
    return f"{type(record).__name__}({fields})"


def _describe(value: Any) -> str:
    if _is_array(value):
        if _is_printed(value):
            return np.array2string(np.asarray(jax.device_get(value)), precision=4, separator=", ")
        return f"{value.dtype.name}[{', '.join(map(str, value.shape))}]"
    leaves = jax.tree.leaves(value)
    if type(value).__repr__ is _describe_record or not any(map(_is_array, leaves)):
        return repr(value)
    numbers = sum(math.prod(getattr(leaf, "shape", ())) for leaf in leaves)
    return f"{{{len(leaves)} arrays, {numbers:,} numbers}}"


def _is_array(value: Any) -> bool:
    return hasattr(value, "shape") and hasattr(value, "dtype") and not isinstance(value, type)


def _is_printed(array: Any) -> bool:
    """Whether the numbers are few and at hand: not traced, donated, or on other hosts."""
    if array.ndim > 1 or array.size > _MOST_PRINTED or not isinstance(array.dtype, np.dtype):
        return False
    if isinstance(array, jax.Array):
        return not isinstance(array, jax.core.Tracer) and array.is_fully_addressable and not array.is_deleted()
    return isinstance(array, np.ndarray | np.generic)


# Every record above; its own `repr` would print all numbers.
for _record in [value for value in globals().values() if hasattr(value, "_fields")]:
    _record.__repr__ = _describe_record
