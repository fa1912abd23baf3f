"""The virtual camera of synthetic frames: KITTI's of 2011-09-26, the day when most frames were recorded."""

from __future__ import annotations

import numpy as np

from ciassd_jax.formats.kitti_camera import Calibration, Camera

IMAGE_SIZE = (1242, 375)
_FOCAL, _CENTER = 721.5377, (609.5593, 172.854)
# The fourth columns of P0 to P3, from the positions of the cameras.
_SHIFTS = (
    (0.0, 0.0, 0.0),
    (-387.5744, 0.0, 0.0),
    (44.85728, 0.2163791, 0.002745884),
    (-339.5242, 2.199936, 0.002729905),
)
_RECTIFICATION = (
    (0.9999239, 0.00983776, -0.007445048),
    (-0.009869795, 0.9999421, -0.004278459),
    (0.007402527, 0.004351614, 0.9999631),
)
_LIDAR_TO_CAMERA = (
    (0.007533745, -0.9999714, -0.000616602, -0.004069766),
    (0.01480249, 0.0007280733, -0.9998902, -0.07631618),
    (0.9998621, 0.00752379, 0.01480755, -0.2717806),
)
_IMU_TO_LIDAR = (
    (0.9999976, 0.0007553071, -0.002035826, -0.8086759),
    (-0.0007854027, 0.9998898, -0.01482298, 0.3195559),
    (0.002024406, 0.01482454, 0.9998881, -0.7997231),
)


def virtual_camera() -> Camera:
    """Return the left colour camera."""
    return Camera(Calibration(_projection(2), np.array(_RECTIFICATION), np.array(_LIDAR_TO_CAMERA)), IMAGE_SIZE)


def calibration_text() -> str:
    """Return the text of a calibration file in KITTI's format."""
    matrices = {f"P{index}": _projection(index) for index in range(4)} | {
        "R0_rect": np.array(_RECTIFICATION),
        "Tr_velo_to_cam": np.array(_LIDAR_TO_CAMERA),
        "Tr_imu_to_velo": np.array(_IMU_TO_LIDAR),
    }
    lines = (f"{name}: {' '.join(f'{value:.12e}' for value in matrix.ravel())}" for name, matrix in matrices.items())
    return "\n".join(lines) + "\n"


def _projection(index: int) -> np.ndarray:
    intrinsic = np.array([[_FOCAL, 0.0, _CENTER[0]], [0.0, _FOCAL, _CENTER[1]], [0.0, 0.0, 1.0]])
    return np.column_stack([intrinsic, _SHIFTS[index]])
