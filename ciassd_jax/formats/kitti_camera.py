"""KITTI's camera: its calibration file, the size of its image, and what it sees.

The rectified camera frame has x right, y down and z forward, in metres; pixels are (u, v) of the left colour image.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from ciassd_jax.formats.errors import InputError, Pathlike, read_bytes
from ciassd_jax.formats.lines import read_text
from ciassd_jax.ops.camera import frustum_planes

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")

# Width and height of the image by focal length, which differ between KITTI's recording days.
_IMAGE_SIZES = {
    721.5377: (1242, 375),
    707.0493: (1224, 370),
    718.3351: (1238, 374),
    718.856: (1241, 376),
}
# The first bytes of a JPEG file, the markers of its frame header (SOF0 to SOF15, without DHT, JPG and DAC), and the
# number of bytes to read in which an image usually has its header.
_JPEG, _FRAME_MARKERS, _HEADER = b"\xff\xd8", {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}, 2**16
# Names of each matrix in the object and the tracking benchmark, and its shape.
_MATRICES = (
    (("P2",), (3, 4)),
    (("R0_rect", "R_rect"), (3, 3)),
    (("Tr_velo_to_cam", "Tr_velo_cam"), (3, 4)),
)


class Calibration(NamedTuple):
    """P2 (camera to pixels), R0 (camera to rectified camera) and the transform from LiDAR to camera."""

    projection: Float64[np.ndarray, "3 4"]
    rectification: Float64[np.ndarray, "3 3"]
    velodyne_to_camera: Float64[np.ndarray, "3 4"]


class Camera(NamedTuple):
    """The camera of a frame: its calibration and the (width, height) of its image in pixels."""

    calibration: Calibration
    image_size: tuple[int, int]


def read_camera(path: Pathlike, image: Path | None = None, image_size: tuple[int, int] | None = None) -> Camera:
    """Read the camera from the calibration file `path`.

    The size of the image is `image_size`, else that of the PNG or JPEG file `image` if it exists, else KITTI's for the
    focal length. Raises InputError, one sentence with the remedy, if the size is unknown or a file is malformed.
    """
    calibration = read_calibration(path)
    if image_size is None and image is not None and image.is_file():
        image_size = read_image_size(image)
    size = image_size or image_size_for(calibration)
    if size is None:
        raise InputError(
            f"{path} has a focal length of {calibration.projection[0, 0]:g} pixels, which is none of KITTI's, so the "
            "size of the image is unknown; give it as `image_size` (width, height)."
        )
    return Camera(calibration, size)


def read_calibration(path: Pathlike) -> Calibration:
    """Read P2, R0_rect and Tr_velo_to_cam (tracking: R_rect, Tr_velo_cam) by name, in float64.

    Raises InputError, one sentence with the remedy, for a line that is missing or does not hold such a matrix.
    """
    lines = {}
    for line in read_text(path).splitlines():
        key, *values = line.replace(":", " ", 1).split() or [""]
        lines[key] = values
    matrices = []
    for keys, shape in _MATRICES:
        found = [lines[key] for key in keys if key in lines]
        if not found:
            raise InputError(f"{path} has no line {keys[0]}; use the calibration file that KITTI gives for the frame.")
        try:
            matrix = np.array(found[0], np.float64).reshape(shape)
            usable = bool(np.isfinite(matrix).all()) and abs(np.linalg.det(matrix[:, :3])) > 1e-6
        except ValueError:
            usable = False
        if not usable:
            raise InputError(
                f"{path}, line {keys[0]}: not the {math.prod(shape)} numbers of an invertible matrix; "
                "copy the file again."
            )
        matrices.append(matrix)
    return Calibration(*matrices)


def read_image_size(path: Pathlike) -> tuple[int, int]:
    """Return width and height in pixels from the header of a PNG or JPEG file; raises InputError for another file."""
    data = read_bytes(path, _HEADER)
    size = _png_size(data) or _jpeg_size(data)
    # A camera may write previews and profiles before the header of the image itself.
    if size is None and data.startswith(_JPEG):
        size = _jpeg_size(read_bytes(path))
    if size is None:
        raise InputError(
            f"{path} is not a PNG or JPEG image; copy it again, or give its size as `image_size` (width, height)."
        )
    return size


def _png_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height from the first chunk of a PNG file, or None."""
    if len(data) < 24 or data[:8] != b"\x89PNG\r\n\x1a\n" or data[12:16] != b"IHDR":
        return None
    width, height = struct.unpack_from(">II", data, 16)
    return width, height


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height from the frame header of a JPEG file, or None."""
    place = len(_JPEG) if data.startswith(_JPEG) else len(data)
    while place + 9 <= len(data) and data[place] == 0xFF:
        if data[place + 1] in _FRAME_MARKERS:
            height, width = struct.unpack_from(">HH", data, place + 5)
            return width, height
        # A marker may be preceded by any number of bytes 0xFF; the length of a segment counts its own two bytes.
        place += 1 if data[place + 1] == 0xFF else 2 + struct.unpack_from(">H", data, place + 2)[0]
    return None


def image_size_for(calibration: Calibration) -> tuple[int, int] | None:
    """Return width and height in pixels of KITTI's images with this focal length; None for any other camera."""
    focal_length = calibration.projection[0, 0]
    return next((size for key, size in _IMAGE_SIZES.items() if abs(key - focal_length) < 1e-3), None)


def lidar_to_camera(calibration: Calibration) -> Float64[np.ndarray, "3 4"]:
    """Return R0 @ Tr, which takes homogeneous LiDAR points to the rectified camera frame."""
    return calibration.rectification @ calibration.velodyne_to_camera


def lidar_to_image(calibration: Calibration) -> Float64[np.ndarray, "3 4"]:
    """Return P2 @ R0 @ Tr, which takes homogeneous LiDAR points to (u * depth, v * depth, depth)."""
    return calibration.projection @ np.vstack([lidar_to_camera(calibration), [0.0, 0.0, 0.0, 1.0]])


def view_planes(camera: Camera) -> Float64[np.ndarray, "6 4"]:
    """Return the half-spaces of what the camera sees, for LiDAR points (`ops.camera.frustum_planes`)."""
    width, height = camera.image_size
    return frustum_planes(lidar_to_image(camera.calibration), width=width, height=height)


def frustum_of(camera: Camera | None) -> Float64[np.ndarray, "6 4"] | None:
    """Return the `view_planes` of a camera, or None without one."""
    return None if camera is None else view_planes(camera)
