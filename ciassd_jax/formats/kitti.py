"""KITTI's calibration, label and result files, and its camera's view of boxes (SPEC sections 1 and 11.1).

The rectified camera has x right, y down, z forward, in metres; pixels are (u, v) of the left colour image.
A row's location is the bottom centre of the box, its rotation_y is -(yaw + pi / 2).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int

from ciassd_jax.formats.errors import InputError, Pathlike, read_bytes
from ciassd_jax.types import Array, Boxes


class Calibration(NamedTuple):
    """P2 (camera to pixels), R0 (camera to rectified camera) and the transform from LiDAR to camera."""

    projection: Float64[np.ndarray, "3 4"]
    rectification: Float64[np.ndarray, "3 3"]
    velodyne_to_camera: Float64[np.ndarray, "3 4"]


class ObjectRow(NamedTuple):
    """One line of a label file, or with a score of a result file.

    `alpha` and `rotation_y` in radians, `bbox` (x1, y1, x2, y2) in pixels, `dimensions` (height, width,
    length) and `location` (x, y, z) in metres in the rectified camera frame.
    """

    type: str
    truncated: float
    occluded: int
    alpha: float
    bbox: tuple[float, float, float, float]
    dimensions: tuple[float, float, float]
    location: tuple[float, float, float]
    rotation_y: float
    score: float | None = None


# Width and height by focal length: KITTI's recording days differ in both.
_IMAGE_SIZES = {
    721.5377: (1242, 375),
    707.0493: (1224, 370),
    718.3351: (1238, 374),
    718.856: (1241, 376),
}
# Names of a matrix in the object and tracking benchmarks, and its shape.
_MATRICES = (
    (("P2",), (3, 4)),
    (("R0_rect", "R_rect"), (3, 3)),
    (("Tr_velo_to_cam", "Tr_velo_cam"), (3, 4)),
)
# Fractions of (length, height, width) along the box's x, y, z; the location is the bottom, and y points down.
_CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-1.0, 0.0) for z in (-0.5, 0.5)])
# Corners that differ in one coordinate, in both directions.
_EDGES = np.array([(first, first ^ bit) for first in range(8) for bit in (1, 2, 4)])
_NEAREST_DEPTH = 0.001


def read_calibration(path: Pathlike) -> Calibration:
    """Read P2, R0_rect and Tr_velo_to_cam (tracking: R_rect, Tr_velo_cam) by name, in float64.

    Raises InputError, one sentence with the remedy, for a line that is missing or is no such matrix.
    """
    lines = {}
    for line in _read_text(path).splitlines():
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


def lidar_to_image(calibration: Calibration) -> Float64[np.ndarray, "3 4"]:
    """P2 @ R0 @ Tr: homogeneous LiDAR points to (u * depth, v * depth, depth)."""
    return calibration.projection @ np.vstack([_lidar_to_camera(calibration), [0.0, 0.0, 0.0, 1.0]])


def image_size_for(calibration: Calibration) -> tuple[int, int] | None:
    """Width and height in pixels of KITTI's image with this focal length; None for any other camera."""
    focal_length = calibration.projection[0, 0]
    return next((size for key, size in _IMAGE_SIZES.items() if abs(key - focal_length) < 1e-3), None)


def read_png_size(path: Pathlike) -> tuple[int, int]:
    """Width and height in pixels from a PNG's header; raises InputError if it is none."""
    data = read_bytes(path, 24)
    if len(data) < 24 or data[:8] != b"\x89PNG\r\n\x1a\n" or data[12:16] != b"IHDR":
        raise InputError(f"{path} is no PNG image; give the frame's image_2 file or the image size.")
    width, height = struct.unpack(">II", data[16:24])
    return width, height


def read_rows(path: Pathlike) -> list[ObjectRow]:
    """Read a label file (15 columns) or a result file (16, the score last); an empty file holds no objects.

    Raises InputError, one sentence with file, line and remedy, for any other line.
    """
    return [parse_row(line, place) for place, line in read_lines(path)]


def read_lines(path: Pathlike) -> list[tuple[str, str]]:
    """The lines of a text file that are not blank, each with its place for messages: "FILE, line N"."""
    lines = enumerate(_read_text(path).split("\n"), 1)
    return [(f"{path}, line {number}", line) for number, line in lines if line.strip()]


def parse_row(line: str, place: str) -> ObjectRow:
    """Read one line; `place` names it in the InputError for a line that is no row."""
    columns = line.split()
    if len(columns) not in (15, 16):
        raise InputError(f"{place}: {len(columns)} columns; a label has 15 and a result 16, so write it again.")
    try:
        occluded = int(columns[2])
        truncated, _, alpha, *values = (float(column) for column in columns[1:])
    except ValueError as error:
        raise InputError(f"{place}: {error}; write a number there, for the occlusion a whole one.") from None
    if not all(map(math.isfinite, (truncated, alpha, *values))):
        raise InputError(f"{place}: a value is not finite; write a number there.")
    x1, y1, x2, y2, height, width, length, x, y, z, rotation_y, *score = values
    return ObjectRow(
        columns[0],
        truncated,
        occluded,
        alpha,
        (x1, y1, x2, y2),
        (height, width, length),
        (x, y, z),
        rotation_y,
        *score,
    )


def format_row(row: ObjectRow) -> str:
    """One line without its end: 15 columns, or 16 with a score; 4 decimals, occlusion as an integer."""
    values = [row.alpha, *row.bbox, *row.dimensions, *row.location, row.rotation_y]
    if row.score is not None:
        values.append(row.score)
    return " ".join([row.type, f"{row.truncated:.4f}", f"{row.occluded}", *(f"{value:.4f}" for value in values)])


def write_rows(path: Pathlike, rows: Iterable[ObjectRow]) -> None:
    """Write one line per row; no rows make an empty file."""
    Path(path).write_text("".join(format_row(row) + "\n" for row in rows), encoding="utf-8", newline="\n")


def boxes_to_rows(
    boxes: Boxes,
    scores: Float[Array, " D"],
    names: Sequence[str],
    calibration: Calibration,
    image_size: tuple[int, int],
) -> tuple[list[ObjectRow], Int[np.ndarray, " kept"]]:
    """Result rows of the boxes seen in the image, and the indices of those boxes.

    Steps of SPEC 11.1, but with the full P2; `image_size` is (width, height) in pixels. The image box is that
    of the part in front of the camera, clipped to [0, width] and [0, height]; alpha is not wrapped.
    """
    center, size, yaw = (np.asarray(leaf, np.float64) for leaf in boxes)
    rotation_y = (np.pi / 2 - yaw) % (2 * np.pi) - np.pi
    bottom = center - size * [0.0, 0.0, 0.5]
    transform = _lidar_to_camera(calibration)
    location = bottom @ transform[:, :3].T + transform[:, 3]
    image_boxes = _image_boxes(_camera_corners(location, size, rotation_y), calibration.projection)
    limit = np.array(image_size * 2, np.float64)
    # Comparisons with NaN are false: a box without finite numbers is dropped too.
    seen = (image_boxes[:, :2] <= limit[:2]).all(1) & (image_boxes[:, 2:] >= 0).all(1)
    image_boxes = image_boxes.clip(0, limit)
    alpha = rotation_y - np.arctan2(-center[:, 1], center[:, 0])
    kept = np.flatnonzero(seen)
    confidence = np.asarray(scores)
    rows = [
        ObjectRow(
            type=names[index],
            truncated=0.0,
            occluded=0,
            alpha=float(alpha[index]),
            bbox=tuple(image_boxes[index].tolist()),
            dimensions=tuple(size[index, ::-1].tolist()),
            location=tuple(location[index].tolist()),
            rotation_y=float(rotation_y[index]),
            score=float(confidence[index]),
        )
        for index in kept.tolist()
    ]
    return rows, kept


def rows_to_boxes(rows: Sequence[ObjectRow], calibration: Calibration) -> Boxes:
    """Boxes in the LiDAR frame, float64 NumPy, of every row as it stands: leave out DontCare before.

    Yaw is -(rotation_y + pi / 2), not wrapped.
    """
    location = np.array([row.location for row in rows], np.float64).reshape(-1, 3)
    size = np.array([row.dimensions[::-1] for row in rows], np.float64).reshape(-1, 3)
    rotation_y = np.array([row.rotation_y for row in rows], np.float64)
    transform = _lidar_to_camera(calibration)
    bottom = np.linalg.solve(transform[:, :3], (location - transform[:, 3]).T).T
    return Boxes(bottom + size * [0.0, 0.0, 0.5], size, -(rotation_y + np.pi / 2))


def _lidar_to_camera(calibration: Calibration) -> Float64[np.ndarray, "3 4"]:
    return calibration.rectification @ calibration.velodyne_to_camera


def _camera_corners(
    location: Float64[np.ndarray, "D 3"],
    size: Float64[np.ndarray, "D 3"],
    rotation_y: Float64[np.ndarray, " D"],
) -> Float64[np.ndarray, "D 8 3"]:
    """Corners in the camera frame, in the order of `_CORNERS`."""
    x, y, z = np.moveaxis(_CORNERS * size[:, None, [0, 2, 1]], -1, 0)
    cos, sin = np.cos(rotation_y)[:, None], np.sin(rotation_y)[:, None]
    return location[:, None] + np.stack([x * cos + z * sin, y, z * cos - x * sin], -1)


def _image_boxes(
    corners: Float64[np.ndarray, "D 8 3"], projection: Float64[np.ndarray, "3 4"]
) -> Float64[np.ndarray, "D 4"]:
    """Image boxes (x1, y1, x2, y2) of the parts in front of the camera; (inf, inf, -inf, -inf) for no part.

    A corner behind the camera would be mirrored by the division, so it moves along each edge that comes
    forward to the point of the smallest depth; projection keeps the part's convexity, hence its extremes.
    """
    projected = corners @ projection[:, :3].T + projection[:, 3]
    start, end = projected[:, _EDGES[:, 0]], projected[:, _EDGES[:, 1]]
    start_depth, end_depth = start[..., 2], end[..., 2]
    crossing = (start_depth < _NEAREST_DEPTH) & (end_depth > _NEAREST_DEPTH)
    way = np.where(crossing, end_depth - start_depth, 1)
    step = np.where(crossing, _NEAREST_DEPTH - start_depth, 0) / way
    points = start + step[..., None] * (end - start)
    visible = ((start_depth >= _NEAREST_DEPTH) | crossing)[..., None]
    pixels = points[..., :2] / np.where(visible, points[..., 2:], 1)
    low = pixels.min(1, where=visible, initial=np.inf)
    high = pixels.max(1, where=visible, initial=-np.inf)
    return np.concatenate([low, high], -1)


def _read_text(path: Pathlike) -> str:
    # Bytes that are no text become values that are no numbers, which the caller refuses by name.
    return read_bytes(path).decode("utf-8-sig", errors="replace")
