"""`Config`: a whole detector."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Literal

from ciassd_jax.config.json import rebuild
from ciassd_jax.config.model import (
    CAR,
    BackboneConfig,
    ClassConfig,
    DetectionConfig,
    GridConfig,
    HeadConfig,
    NeckConfig,
)
from ciassd_jax.config.training import DataConfig, LossConfig, ScheduleConfig


@dataclass(frozen=True)
class Config:
    """A whole detector. The defaults are the paper's (`car()`)."""

    grid: GridConfig = field(default_factory=GridConfig)
    backbone: BackboneConfig = field(default_factory=BackboneConfig)
    neck: NeckConfig = field(default_factory=NeckConfig)
    classes: tuple[ClassConfig, ...] = (CAR,)
    head: HeadConfig = field(default_factory=HeadConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    detection: DetectionConfig = field(default_factory=DetectionConfig)
    data: DataConfig = field(default_factory=DataConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    # Compute type of the network; parameters, BatchNorm, coordinates, IoU and NMS stay float32. "float64" is for exact
    # comparisons and needs jax_enable_x64.
    dtype: Literal["float32", "bfloat16", "float64"] = "float32"

    def __post_init__(self) -> None:
        if not self.classes or len({c.name for c in self.classes}) != len(self.classes):
            raise ValueError("classes: at least one is needed, each with its own name.")
        if self.dtype not in ("float32", "bfloat16", "float64"):
            raise ValueError(f"dtype: {self.dtype!r} is unknown; choose 'float32', 'bfloat16' or 'float64'.")
        if self.backbone.stages[0].capacity != self.grid.max_voxels:
            raise ValueError(
                f"backbone: the first stage holds {self.backbone.stages[0].capacity} sites but the grid "
                f"{self.grid.max_voxels} voxels; the two must be equal."
            )
        multiple = 2 * self.backbone.stride
        for axis, cells in zip("xy", self.grid.cells, strict=False):
            if cells % multiple:
                below = cells // multiple * multiple
                raise ValueError(
                    f"grid.{axis}: {cells} voxels are not divisible by {multiple} ({self.backbone.stride} voxels "
                    f"per BEV cell, halved once more in the neck); the nearest valid count is "
                    f"{f'{below} or ' if below else ''}{below + multiple}."
                )
        depths = [shape[0] for shape in self.backbone.stage_shapes(self.grid.shape)]
        if depths[-1] < 1:
            raise ValueError(
                f"grid.z: {self.grid.cells[2]} voxels shrink to {' -> '.join(map(str, depths))} layers; "
                "use smaller voxels, a taller range or fewer stages."
            )

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names in label order: label 0 is the first."""
        return tuple(c.name for c in self.classes)

    @property
    def bev_shape(self) -> tuple[int, int]:
        """Cells (y, x) of the BEV map."""
        return self.backbone.stage_shapes(self.grid.shape)[-1][1:]

    @property
    def bev_channels(self) -> int:
        """Channels of the BEV map: the z layers folded into the features."""
        return self.backbone.out_channels * self.backbone.stage_shapes(self.grid.shape)[-1][0]

    @property
    def anchors_per_cell(self) -> int:
        """One anchor for every class and angle."""
        return len(self.classes) * len(self.head.angles)

    def to_json(self) -> str:
        """The whole config as JSON text."""
        return json.dumps(asdict(self), indent=1)

    @classmethod
    def from_json(cls, text: str) -> Config:
        """Read `to_json`'s text; unknown or missing fields and wrong types are a ValueError that names them."""
        try:
            data = json.loads(text)
        except json.JSONDecodeError as error:
            raise ValueError(f"The config is no valid JSON ({error}).") from error
        return rebuild(cls, data, "config")
