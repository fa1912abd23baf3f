"""The named configs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from ciassd_jax.config import (
    CAR,
    BackboneConfig,
    ClassConfig,
    Config,
    DataConfig,
    DetectionConfig,
    GridConfig,
    HeadConfig,
    NeckConfig,
    StageConfig,
)


def car() -> Config:
    """The paper's car detector on KITTI; METHOD.md, section 1, lists what the paper leaves open and the choice made."""
    return Config()


def car_released() -> Config:
    """The authors' released code, quirks included; with their weights it gives their boxes."""
    config = car()
    return replace(
        config,
        grid=replace(config.grid, overflow="stop"),
        neck=replace(config.neck, attention_kernel=1),
        head=HeadConfig(angles=(0.0, 1.57), iou_kernel=3, iou_bias=False),
        detection=replace(config.detection, nms="released", clamp_iou=False),
    )


def car_lite() -> Config:
    """The same method sized for a CPU: about ten frames per second on two cores (benchmarks/README.md).

    Voxels of twice the size give BEV cells of 0.8 m: a quarter of the cells and two thirds of the sites. Half the
    channels quarter the arithmetic of the neck, which takes most of the time. Cells of 0.4 m with a neck of 32 channels
    would take half as long again, since convolutions of few channels run on one core. The second stage has the most
    sites and therefore no submanifold convolution.
    """
    return Config(
        # With cells of twice the size, a quarter of the boxes around a car support one another.
        classes=(replace(CAR, support_threshold=CAR.support_threshold / 4),),
        grid=GridConfig(voxel_size=(0.1, 0.1, 0.2), max_voxels=14000),
        backbone=BackboneConfig(
            stages=(
                StageConfig(channels=8, layers=1),
                StageConfig(channels=16, layers=0, capacity=18000),
                StageConfig(channels=32, layers=1, capacity=12000),
                StageConfig(channels=32, layers=2, capacity=5000),
            ),
            out_channels=32,
            out_capacity=3000,
        ),
        neck=NeckConfig(channels=64),
        detection=DetectionConfig(max_candidates=256),
    )


def three_class() -> Config:
    """Cars, pedestrians and cyclists; not in the paper and not tuned."""
    pedestrian = ClassConfig(
        name="Pedestrian",
        width=0.6,
        length=0.8,
        height=1.73,
        center_z=-0.6,
        matched=0.5,
        unmatched=0.35,
        support_threshold=1.0,
    )
    return replace(car(), classes=(CAR, pedestrian, replace(pedestrian, name="Cyclist", length=1.76)))


def tiny() -> Config:
    """A toy of the same structure for tests and notebooks: 12.8 m x 12.8 m, 53 thousand parameters."""
    return Config(
        grid=GridConfig(
            minimum=(0.0, -6.4, -3.0), maximum=(12.8, 6.4, 1.0), voxel_size=(0.1, 0.1, 0.2), max_voxels=2048
        ),
        backbone=BackboneConfig(
            stages=(
                StageConfig(channels=4, layers=1),
                StageConfig(channels=8, layers=1, capacity=2048),
                StageConfig(channels=8, layers=1, capacity=1024),
            ),
            out_channels=8,
            out_capacity=1024,
        ),
        neck=NeckConfig(channels=16),
        detection=DetectionConfig(max_candidates=128),
        data=DataConfig(max_points=4096, max_boxes=16, max_gt_sampling_points=2048),
    )


PRESETS: dict[str, Callable[[], Config]] = {
    preset.__name__: preset for preset in (car, car_released, car_lite, three_class, tiny)
}
