"""A frame's camera from its files: the calibration and the size of the image."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from ciassd_jax.formats.errors import InputError, Pathlike
from ciassd_jax.formats.kitti import Calibration, image_size_for, lidar_to_image, read_calibration, read_png_size
from ciassd_jax.ops.camera import frustum_planes


class Camera(NamedTuple):
    """The camera of a frame: its calibration and the (width, height) of its image in pixels."""

    calibration: Calibration
    image_size: tuple[int, int]


def read_camera(path: Pathlike, image: Path | None = None, image_size: tuple[int, int] | None = None) -> Camera:
    """The camera of the calibration file `path`.

    The size of the image is as given, else that of the PNG file `image` where it is there, else KITTI's for the focal
    length. Raises InputError, one sentence with the remedy, where none of them says it or a file is malformed.
    """
    calibration = read_calibration(path)
    if image_size is None and image is not None and image.is_file():
        image_size = read_png_size(image)
    size = image_size or image_size_for(calibration)
    if size is None:
        raise InputError(
            f"{path} has a focal length of {calibration.projection[0, 0]:g} pixels, which is none of KITTI's, so the "
            "image could be of any size; give it with --image-size WIDTH HEIGHT."
        )
    return Camera(calibration, size)


def frustum_of(camera: Camera | None) -> Float64[np.ndarray, "6 4"] | None:
    """`view_planes` of a camera; None without one."""
    return None if camera is None else view_planes(camera)


def view_planes(camera: Camera) -> Float64[np.ndarray, "6 4"]:
    """The half-spaces of what the camera sees, for LiDAR points (`ops.camera.frustum_planes`)."""
    width, height = camera.image_size
    return frustum_planes(lidar_to_image(camera.calibration), width=width, height=height)
