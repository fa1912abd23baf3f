"""Configs as frozen dataclasses. The sections are in `model` and `training`, the named configs in `presets`."""

from ciassd_jax.config.config import Config
from ciassd_jax.config.model import (
    CAR,
    BackboneConfig,
    ClassConfig,
    DetectionConfig,
    GridConfig,
    HeadConfig,
    InputConfig,
    NeckConfig,
    StageConfig,
)
from ciassd_jax.config.training import AugmentationConfig, DataConfig, LossConfig, ScheduleConfig

__all__ = [
    "CAR",
    "AugmentationConfig",
    "BackboneConfig",
    "ClassConfig",
    "Config",
    "DataConfig",
    "DetectionConfig",
    "GridConfig",
    "HeadConfig",
    "InputConfig",
    "LossConfig",
    "NeckConfig",
    "ScheduleConfig",
    "StageConfig",
]
