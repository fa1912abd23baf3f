"""The sections of a config that only training reads: data, losses, optimizer and schedule."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class AugmentationConfig:
    """The five switches of the paper's Table 3, and the numbers of each augmentation (paper section 4.1)."""

    global_transform: bool = True
    object_noise: bool = True
    gt_sampling: bool = True
    similar_classes: bool = True
    # Keep objects that are not easy, moderate or hard out of the database, and with `filter_scenes` out of the scenes.
    difficulty_filter: bool = True
    filter_scenes: bool = False

    flip_probability: float = 0.5
    max_rotation: float = 0.785
    min_scale: float = 0.95
    max_scale: float = 1.05
    # Noise of each object: standard deviation of the shift in metres, largest turn in radians, and number of tries.
    noise_shift: tuple[float, float, float] = (1.0, 1.0, 0.5)
    noise_rotation: float = 0.785
    noise_tries: int = 100

    def __post_init__(self) -> None:
        if not 0 <= self.flip_probability <= 1:
            raise ValueError(f"data.augmentation.flip_probability: {self.flip_probability} is outside [0, 1].")
        if not 0 < self.min_scale <= self.max_scale:
            raise ValueError("data.augmentation: scales must satisfy 0 < min_scale <= max_scale.")
        if min(self.max_rotation, self.noise_rotation, *self.noise_shift) < 0 or self.noise_tries < 1:
            raise ValueError("data.augmentation: rotations and shifts must be at least 0, noise_tries at least 1.")


@dataclass(frozen=True)
class DataConfig:
    """Capacities of a labelled scene, and augmentation."""

    max_points: int = 32768
    max_boxes: int = 64
    max_gt_sampling_points: int = 16384
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)

    def __post_init__(self) -> None:
        if min(self.max_points, self.max_boxes, self.max_gt_sampling_points) < 1:
            raise ValueError("data: max_points, max_boxes and max_gt_sampling_points must be at least 1.")


@dataclass(frozen=True)
class LossConfig:
    """Weights of the losses, that of the classification being 1, and their shapes (paper section 3.3)."""

    box_weight: float = 2.0
    direction_weight: float = 0.2
    iou_weight: float = 1.0
    focal_alpha: float = 0.25
    focal_gamma: float = 2.0
    # Smooth-L1 is quadratic up to an error of 1 / sigma squared.
    smooth_l1_sigma: float = 3.0

    def __post_init__(self) -> None:
        for name in ("box_weight", "direction_weight", "iou_weight", "focal_gamma"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"loss.{name}: {getattr(self, name)} must be at least 0 and finite.")
        if not 0 <= self.focal_alpha <= 1:
            raise ValueError(f"loss.focal_alpha: {self.focal_alpha} is outside [0, 1].")
        if not 0 < self.smooth_l1_sigma < math.inf:
            raise ValueError(f"loss.smooth_l1_sigma: {self.smooth_l1_sigma} must be positive and finite.")


@dataclass(frozen=True)
class ScheduleConfig:
    """The optimizer and its schedule: Adam with decoupled weight decay, gradient clipping, one cycle."""

    # 60 epochs of KITTI's 3712 frames in batches of 4.
    total_steps: int = 55680
    batch_size: int = 4

    kind: Literal["one_cycle", "cosine"] = "one_cycle"
    learning_rate: float = 3e-3
    # One cycle: the learning rate starts at 1 / div_factor of its peak, rises for this share of the steps, and ends at
    # 1 / final_div_factor of its start. Meanwhile b1 goes from the first value of b1_range to the second and back.
    warmup: float = 0.4
    div_factor: float = 10.0
    final_div_factor: float = 1e4
    b1_range: tuple[float, float] = (0.95, 0.85)

    b2: float = 0.99
    weight_decay: float = 0.01
    max_gradient_norm: float = 35.0
    # Number of batches per update.
    gradient_accumulation_steps: int = 1
    # Decay of the running mean of the parameters; 0 keeps none.
    ema_decay: float = 0.0
    # Recompute activations in the backward pass instead of storing them.
    remat: bool = False
    # Parts of the network that keep their weights and their BatchNorm statistics, by the path of their parameters:
    # "backbone", "neck", "head", or a layer such as "backbone/stage0_0".
    frozen: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if min(self.total_steps, self.batch_size, self.gradient_accumulation_steps) < 1:
            raise ValueError("schedule: total_steps, batch_size and gradient_accumulation_steps must be at least 1.")
        if self.kind not in ("one_cycle", "cosine"):
            raise ValueError(f"schedule.kind: {self.kind!r} is unknown; choose 'one_cycle' or 'cosine'.")
        if not (self.learning_rate > 0 and self.div_factor >= 1 and self.final_div_factor >= 1):
            raise ValueError("schedule: learning_rate must be positive, div_factor and final_div_factor at least 1.")
        low, high = sorted(self.b1_range)
        if not (0 < self.warmup < 1 and 0 <= low <= high < 1 and 0 <= self.b2 < 1):
            raise ValueError("schedule: warmup must lie in (0, 1), b1_range and b2 in [0, 1).")
        if self.weight_decay < 0 or self.max_gradient_norm <= 0 or not 0 <= self.ema_decay < 1:
            raise ValueError(
                "schedule: weight_decay must be at least 0, max_gradient_norm positive, ema_decay in [0, 1)."
            )
