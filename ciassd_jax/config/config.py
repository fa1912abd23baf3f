"""`Config`: everything that defines a detector and its training."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import jax

from ciassd_jax.config.json import rebuild
from ciassd_jax.config.model import (
    CAR,
    BackboneConfig,
    ClassConfig,
    DetectionConfig,
    GridConfig,
    HeadConfig,
    InputConfig,
    NeckConfig,
)
from ciassd_jax.config.training import DataConfig, LossConfig, ScheduleConfig

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Config:
    """Everything that defines a detector and its training. The defaults are the paper's, `car()`."""

    input: InputConfig = field(default_factory=InputConfig)
    grid: GridConfig = field(default_factory=GridConfig)
    backbone: BackboneConfig = field(default_factory=BackboneConfig)
    neck: NeckConfig = field(default_factory=NeckConfig)
    classes: tuple[ClassConfig, ...] = (CAR,)
    head: HeadConfig = field(default_factory=HeadConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    detection: DetectionConfig = field(default_factory=DetectionConfig)
    data: DataConfig = field(default_factory=DataConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    # Type of the convolutions; parameters, BatchNorm, the head, coordinates, IoU and NMS stay float32. "float64" serves
    # exact comparisons and needs `jax_enable_x64`.
    dtype: Literal["float32", "bfloat16", "float64"] = "float32"
    # Form of the computations that a CPU and an accelerator do differently: "auto" chooses by the platform that is
    # compiled for. "accelerator" runs on a CPU too, slowly.
    program: Literal["auto", "cpu", "accelerator"] = "auto"

    def __post_init__(self) -> None:
        if not self.classes or len({c.name.lower() for c in self.classes}) != len(self.classes):
            raise ValueError("classes: give at least one, each with its own name; case does not matter.")
        if self.dtype not in ("float32", "bfloat16", "float64"):
            raise ValueError(f"dtype: {self.dtype!r} is unknown; choose 'float32', 'bfloat16' or 'float64'.")
        if self.program not in ("auto", "cpu", "accelerator"):
            raise ValueError(f"program: {self.program!r} is unknown; choose 'auto', 'cpu' or 'accelerator'.")
        self._check_grid()

    def _check_grid(self) -> None:
        """Raise ValueError for a grid that the network cannot halve down to whole BEV cells and at least one layer."""
        multiple, grid = 2 * self.backbone.stride, self.grid
        for axis, cells, low, size in zip("xy", grid.cells, grid.minimum, grid.voxel_size, strict=False):
            if cells % multiple:
                below = cells // multiple * multiple
                valid = " or ".join(f"{low + n * size:g}" for n in (below, below + multiple) if n)
                raise ValueError(
                    f"grid.maximum along {axis}: {cells} voxels are not divisible by {multiple} (a BEV cell has "
                    f"{self.backbone.stride}, and the neck halves the map); the nearest valid maximum is {valid}."
                )
        depths = [shape[0] for shape in self.backbone.stage_shapes(grid.shape)]
        if depths[-1] < 1:
            raise ValueError(
                f"grid.maximum along z: {grid.cells[2]} voxels shrink to {' -> '.join(map(str, depths))} layers; "
                "use smaller voxels, a taller range or fewer stages."
            )

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names of the classes in the order of their labels."""
        return tuple(c.name for c in self.classes)

    def labels_by_name(self, *, similar: bool) -> dict[str, int]:
        """Return the class of each label name in lower case, with `similar` also of the names that count as a class."""
        labels = {name.lower(): label for label, one in enumerate(self.classes) for name in one.similar if similar}
        return labels | {one.name.lower(): label for label, one in enumerate(self.classes)}

    @property
    def range(self) -> tuple[Vector, Vector]:
        """Minimum and maximum (x, y, z) of the grid in the frame of the clouds, in metres."""
        shift, (x, y, low), (right, left, high) = self.input.z_shift, self.grid.minimum, self.grid.maximum
        return (x, y, low - shift), (right, left, high - shift)

    @property
    def ground(self) -> float:
        """Height in metres at which the anchors of the first class stand, in the frame of the clouds."""
        return self.classes[0].center_z - self.classes[0].height / 2 - self.input.z_shift

    @property
    def bev_shape(self) -> tuple[int, int]:
        """Cells (y, x) of the BEV map."""
        return self.backbone.stage_shapes(self.grid.shape)[-1][1:]

    @property
    def bev_channels(self) -> int:
        """Channels of the BEV map, with the z layers folded into them."""
        return self.backbone.out_channels * self.backbone.stage_shapes(self.grid.shape)[-1][0]

    @property
    def anchors_per_cell(self) -> int:
        """Number of anchors per BEV cell: one for each class and angle."""
        return len(self.classes) * len(self.head.angles)

    def to_json(self) -> str:
        """Return the config as JSON text, without `program`: that is a choice of the machine, not of the detector."""
        return json.dumps({name: value for name, value in asdict(self).items() if name != "program"}, indent=1)

    @classmethod
    def from_json(cls, text: str) -> Config:
        """Read a config from the text of `to_json`, of this or an earlier version.

        A missing field has its default. Raises ValueError, naming the field, for an unknown field and for a value of
        the wrong type or range.
        """
        try:
            data = json.loads(text)
        except json.JSONDecodeError as error:
            raise ValueError(f"The config is not valid JSON ({error}).") from error
        return rebuild(cls, _without_first_capacity(data), "config")

    def for_inference(self) -> Config:
        """Return the config with the default for every field that `predict` does not read.

        Configs that differ only in training become equal, so that they share one compiled program.
        """
        unread = {name: getattr(_UNREAD_CLASS, name) for name in _UNREAD_CLASS_FIELDS}
        classes = tuple(replace(one, **unread) for one in self.classes)
        return replace(self, classes=classes, loss=LossConfig(), data=DataConfig(), schedule=ScheduleConfig())


# A pytree without leaves: `jax.jit` treats a config as static without `static_argnames`.
jax.tree_util.register_static(Config)

# Fields of a class that only target assignment, ground-truth sampling and evaluation read.
_UNREAD_CLASS_FIELDS = (
    "matched",
    "unmatched",
    "similar",
    "eval_overlap",
    "gt_sampling_up_to",
    "gt_sampling_min_points",
)
_UNREAD_CLASS = ClassConfig()


def _without_first_capacity(data: Any) -> Any:
    """Return parsed JSON without the first stage's capacity, which in earlier versions repeated `grid.max_voxels`."""
    try:
        first, max_voxels = data["backbone"]["stages"][0], data["grid"]["max_voxels"]
        if first["capacity"] != max_voxels:
            return data
    except (KeyError, IndexError, TypeError):
        return data
    stages = [{name: value for name, value in first.items() if name != "capacity"}, *data["backbone"]["stages"][1:]]
    return data | {"backbone": data["backbone"] | {"stages": stages}}
