"""The sections of a config that define the detector: input, grid, network, classes and post-processing.

Every section is a frozen, hashable dataclass of numbers, strings and tuples. It raises ValueError for a wrong value.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class InputConfig:
    """What the network makes of a cloud's numbers, so that another sensor's clouds look as those of training did."""

    # The intensity in the clouds that the network reads as 1: 255 for intensities of 0..255.
    intensity_scale: float = 1.0
    # Metres that the network adds to z. Boxes, and the labels they are compared with, stay in the cloud's frame.
    z_shift: float = 0.0

    def __post_init__(self) -> None:
        if not 0 < self.intensity_scale < math.inf:
            raise ValueError(f"input.intensity_scale: {self.intensity_scale} must be positive and finite.")
        if not math.isfinite(self.z_shift):
            raise ValueError(f"input.z_shift: {self.z_shift} must be finite.")


@dataclass(frozen=True)
class GridConfig:
    """The voxel grid, in metres along x, y, z (paper section 4.1)."""

    minimum: tuple[float, float, float] = (0.0, -40.0, -3.0)
    maximum: tuple[float, float, float] = (70.4, 40.0, 1.0)
    voxel_size: tuple[float, float, float] = (0.05, 0.05, 0.1)
    max_points_per_voxel: int = 5
    max_voxels: int = 20000
    # When max_voxels are in use, "skip" ignores points in further voxels; "stop" ignores every point after the first
    # such point, as the released code does.
    overflow: Literal["skip", "stop"] = "skip"

    def __post_init__(self) -> None:
        for axis, low, high, size in zip("xyz", self.minimum, self.maximum, self.voxel_size, strict=True):
            if not (size > 0 and 0 < high - low < math.inf):
                raise ValueError(
                    f"grid.minimum to grid.maximum along {axis}: range {low}..{high} with voxel size {size} is empty "
                    "or unbounded; the maximum must exceed the minimum, both be finite, and the voxel size positive."
                )
            cells = (high - low) / size
            if round(cells) < 1 or abs(cells - round(cells)) > 1e-3:
                raise ValueError(
                    f"grid.maximum along {axis}: {high - low:g} m is {cells:.3f} voxels of {size} m, not a whole "
                    f"number; the nearest valid maximum is {low + max(round(cells), 1) * size:g}."
                )
        if self.max_points_per_voxel < 1 or self.max_voxels < 1:
            raise ValueError("grid: max_points_per_voxel and max_voxels must be at least 1.")
        if self.overflow not in ("skip", "stop"):
            raise ValueError(f"grid: overflow {self.overflow!r} is unknown; choose 'skip' or 'stop'.")
        depth, height, width = self.shape
        if depth * height * width >= 2**31:
            raise ValueError(
                f"grid: {depth} x {height} x {width} voxels exceed the 32-bit keys of the sparse "
                "convolutions; use larger voxels or a smaller range."
            )

    @property
    def cells(self) -> tuple[int, int, int]:
        """Number of voxels along x, y, z."""
        x, y, z = (
            round((high - low) / size)
            for low, high, size in zip(self.minimum, self.maximum, self.voxel_size, strict=True)
        )
        return x, y, z

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (z, y, x) of the sparse grid, with one empty layer on top as in SECOND."""
        x, y, z = self.cells
        return z + 1, y, x


@dataclass(frozen=True)
class StageConfig:
    """One resolution of the backbone: a strided convolution (none in the first stage), then submanifold convolutions.

    `capacity` is the number of site slots. The first stage has none: its sites are the voxels, `grid.max_voxels`.
    """

    channels: int
    layers: int
    capacity: int | None = None
    z_padding: int = 1

    def __post_init__(self) -> None:
        slots = 1 if self.capacity is None else self.capacity
        if self.channels < 1 or self.layers < 0 or slots < 1 or self.z_padding not in (0, 1):
            raise ValueError(
                f"backbone stage {self}: channels and capacity must be at least 1, layers at least 0, z_padding 0 or 1."
            )


@dataclass(frozen=True)
class BackboneConfig:
    """SPConvNet, the sparse 3D encoder (paper section 3.1)."""

    stages: tuple[StageConfig, ...] = (
        StageConfig(channels=16, layers=2),
        StageConfig(channels=32, layers=2, capacity=48000),
        StageConfig(channels=64, layers=3, capacity=36000),
        StageConfig(channels=64, layers=3, capacity=18000, z_padding=0),
    )
    out_channels: int = 64
    out_capacity: int = 16000
    # "gather" computes active sites only. "dense" computes the whole grid; it is the definition, for small grids.
    backend: Literal["gather", "dense"] = "gather"

    def __post_init__(self) -> None:
        if not self.stages:
            raise ValueError("backbone: give at least one stage.")
        first, *others = (stage.capacity for stage in self.stages)
        if first is not None:
            raise ValueError(
                f"backbone.stages[0].capacity: the first stage has no capacity of its own; remove the {first} and set "
                "grid.max_voxels."
            )
        if None in others:
            raise ValueError(
                f"backbone.stages[{1 + others.index(None)}].capacity is missing; only that of the first stage is None."
            )
        if self.backend not in ("gather", "dense"):
            raise ValueError(f"backbone: backend {self.backend!r} is unknown; choose 'gather' or 'dense'.")

    def stage_shapes(self, shape: tuple[int, int, int]) -> tuple[tuple[int, int, int], ...]:
        """Return the grid shape (z, y, x) of every stage and of the output, from that of the input."""
        shapes = [shape]
        for stage in self.stages[1:]:
            depth, height, width = shapes[-1]
            shapes.append(((depth + 2 * stage.z_padding - 3) // 2 + 1, (height - 1) // 2 + 1, (width - 1) // 2 + 1))
        depth, height, width = shapes[-1]
        shapes.append(((depth - 3) // 2 + 1, height, width))
        return tuple(shapes)

    def capacities(self, max_voxels: int) -> tuple[int, ...]:
        """Return the number of site slots of every stage and of the output."""
        return (max_voxels, *(stage.capacity or 0 for stage in self.stages[1:]), self.out_capacity)

    @property
    def stride(self) -> int:
        """Voxels per BEV cell along x and y."""
        return 2 ** (len(self.stages) - 1)


@dataclass(frozen=True)
class NeckConfig:
    """The neck, from the BEV map to the features of the head.

    "ssfa" is the paper's (section 3.2); its semantic branch has twice the channels. The others are the baselines of
    Table 4: "second" has seven 3 x 3 convolutions, "sassd" seven of twice the channels and one of 1 x 1.
    """

    kind: Literal["ssfa", "second", "sassd"] = "ssfa"
    channels: int = 128
    attention_kernel: Literal[1, 3] = 3

    def __post_init__(self) -> None:
        if self.channels < 1 or self.attention_kernel not in (1, 3):
            raise ValueError(f"neck {self}: channels must be at least 1 and attention_kernel 1 or 3.")
        if self.kind not in ("ssfa", "second", "sassd"):
            raise ValueError(f"neck.kind: {self.kind!r} is unknown; choose 'ssfa', 'second' or 'sassd'.")


@dataclass(frozen=True)
class ClassConfig:
    """One class: its anchor (size and height of the centre in metres), thresholds, and ground-truth sampling."""

    name: str = "Car"
    width: float = 1.6
    length: float = 3.9
    height: float = 1.56
    center_z: float = -1.0
    # Overlap with a truth box from which an anchor is positive, and below which it is negative.
    matched: float = 0.6
    unmatched: float = 0.45
    # A detection needs more IoU-weighted support than this (mu of Algorithm 1).
    support_threshold: float = 2.6
    # Labels that count as this class in training (paper section 4.1: vans as cars). Case does not matter in names.
    similar: tuple[str, ...] = ()
    # Overlap that a detection must exceed in evaluation. KITTI's three classes have the official ones instead.
    eval_overlap: float = 0.5
    # Ground-truth sampling adds objects until a scene has this number of the class; 0 adds none.
    gt_sampling_up_to: int = 0
    # Objects with fewer points are not sampled.
    gt_sampling_min_points: int = 5

    def __post_init__(self) -> None:
        if min(self.width, self.length, self.height) <= 0:
            raise ValueError(f"class {self.name}: width, length and height must be positive.")
        if not 0 < self.unmatched <= self.matched <= 1:
            raise ValueError(f"class {self.name}: thresholds must satisfy 0 < unmatched <= matched <= 1.")
        if not 0 < self.eval_overlap < 1:
            raise ValueError(f"class {self.name}: eval_overlap {self.eval_overlap} is outside (0, 1).")
        if self.gt_sampling_up_to < 0 or self.gt_sampling_min_points < 1:
            raise ValueError(
                f"class {self.name}: gt_sampling_up_to must be at least 0 and gt_sampling_min_points at least 1."
            )


CAR = ClassConfig(similar=("Van",), gt_sampling_up_to=15)


@dataclass(frozen=True)
class HeadConfig:
    """The multi-task head (paper section 3.3); `angles` are r of the anchors, in radians."""

    angles: tuple[float, ...] = (0.0, math.pi / 2)
    # Without the IoU branch q is 1 for every box, so the confidence is the class probability.
    predict_iou: bool = True

    iou_kernel: Literal[1, 3] = 1
    iou_bias: bool = True

    def __post_init__(self) -> None:
        if not self.angles or self.iou_kernel not in (1, 3):
            raise ValueError(f"head {self}: give at least one angle; iou_kernel must be 1 or 3.")


@dataclass(frozen=True)
class DetectionConfig:
    """From raw predictions to boxes (paper section 3.4 and Algorithm 1)."""

    # The class probability from which an anchor is a candidate, before its score is rectified.
    score_threshold: float = 0.3
    # The rectified score from which a box is a detection. It changes none of the other boxes.
    min_score: float = 0.0

    max_candidates: int = 1000
    iou_exponent: float = 4.0
    clamp_iou: bool = True
    nms: Literal["paper", "released", "rotated"] = "paper"
    nms_iou_threshold: float = 0.3
    # sigma squared of the Gaussian weight (equation 8) for boxes nearer than each distance in metres, and beyond the
    # last. With nms="released" there are no boxes from the last distance on.
    sigma_squared: tuple[float, float, float, float] = (0.0009, 0.009, 0.1, 1.0)
    sigma_distances: tuple[float, float, float] = (20.0, 40.0, 60.0)
    # Boxes whose centre is lower or higher than this, in the network's frame, are dropped.
    z_limits: tuple[float, float] = (-5.0, 5.0)

    def __post_init__(self) -> None:
        for name in ("score_threshold", "min_score"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"detection.{name}: {getattr(self, name)} is outside [0, 1).")
        if self.max_candidates < 1:
            raise ValueError("detection.max_candidates must be at least 1.")
        if self.nms not in ("paper", "released", "rotated"):
            raise ValueError(f"detection.nms: {self.nms!r} is unknown; choose 'paper', 'released' or 'rotated'.")
        if min(self.sigma_squared) <= 0 or list(self.sigma_distances) != sorted(self.sigma_distances):
            raise ValueError("detection: sigma_squared must be positive and sigma_distances ascending.")
