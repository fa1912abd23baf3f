"""Configs as frozen dataclasses: `model` and `training` hold the sections, `presets` the named detectors."""

from ciassd_jax.config.config import Config
from ciassd_jax.config.model import (
    CAR,
    BackboneConfig,
    ClassConfig,
    DetectionConfig,
    GridConfig,
    HeadConfig,
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
    "LossConfig",
    "NeckConfig",
    "ScheduleConfig",
    "StageConfig",
]
