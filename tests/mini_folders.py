"""Data sets of a few synthetic frames, in KITTI's layout and in OpenPCDet's custom one."""

import struct
from pathlib import Path

import numpy as np
from small import CALIBRATION, IMAGE_SIZE

from ciassd_jax.formats.kitti_boxes import boxes_to_rows
from ciassd_jax.formats.kitti_camera import read_calibration
from ciassd_jax.formats.kitti_rows import format_row
from ciassd_jax.formats.points import write_bin
from ciassd_jax.types import Boxes

# All in the view of the camera and within the grid of `tiny()`: x, y, z, length, width, height, yaw.
OBJECTS = {
    "Car": (8.0, 1.0, -1.0, 3.9, 1.6, 1.5, 0.3),
    "Van": (10.0, -3.5, -0.8, 4.6, 1.9, 2.0, -1.2),
    "Pedestrian": (6.0, -1.5, -0.7, 0.8, 0.6, 1.7, 2.0),
}
NAMES = ("000000", "000001", "000004")
DONT_CARE = "DontCare -1 -1 -10 10 20 30 40 -1 -1 -1 -1000 -1000 -1000 -10"


def object_boxes() -> Boxes:
    return Boxes.from_array(np.array(list(OBJECTS.values())))


def object_points(seed: int, per_object: int = 60) -> np.ndarray:
    """Points within the middle of every object."""
    rng = np.random.default_rng(seed)
    parts = []
    for x, y, z, length, width, height, yaw in OBJECTS.values():
        along, across, up = (rng.uniform(-0.45, 0.45, (per_object, 3)) * (length, width, height)).T
        parts.append(
            np.stack(
                [
                    x + along * np.cos(yaw) - across * np.sin(yaw),
                    y + along * np.sin(yaw) + across * np.cos(yaw),
                    z + up,
                    rng.uniform(0, 1, per_object),
                ],
                -1,
            )
        )
    return np.concatenate(parts).astype(np.float32)


def full_cloud(seed: int) -> np.ndarray:
    """Points all around the sensor, the objects' among them, in no order."""
    rng = np.random.default_rng(seed)
    around = rng.uniform((-30, -30, -2, 0), (30, 30, 1, 1), (800, 4))
    points = np.concatenate([around, object_points(seed)]).astype(np.float32)
    return points[rng.permutation(len(points))]


def png_header(width: int, height: int) -> bytes:
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", width, height)


def write_kitti(
    root: Path, *, part: str = "training", clouds: str = "velodyne", names: tuple[str, ...] = NAMES
) -> Path:
    """Frames of full clouds, or with `velodyne_reduced` of the objects' points alone."""
    folder = root / part
    for name in (clouds, "calib", "image_2", "label_2"):
        (folder / name).mkdir(parents=True)
    for seed, name in enumerate(names):
        points = full_cloud(seed) if clouds == "velodyne" else object_points(seed)
        write_bin(folder / clouds / f"{name}.bin", points)
        (folder / "calib" / f"{name}.txt").write_text(CALIBRATION)
        (folder / "image_2" / f"{name}.png").write_bytes(png_header(*IMAGE_SIZE))
        calibration = read_calibration(folder / "calib" / f"{name}.txt")
        rows, _ = boxes_to_rows(object_boxes(), np.zeros(len(OBJECTS)), list(OBJECTS), calibration, IMAGE_SIZE)
        lines = [format_row(row._replace(score=None)) for row in rows]
        (folder / "label_2" / f"{name}.txt").write_text("\n".join([lines[0], DONT_CARE, *lines[1:]]) + "\n")
    return root


def write_custom(root: Path, names: tuple[str, ...] = ("a", "b")) -> Path:
    for name in ("points", "labels", "ImageSets"):
        (root / name).mkdir(parents=True)
    for seed, name in enumerate(names):
        np.save(root / "points" / f"{name}.npy", full_cloud(seed))
        rows = (" ".join([*map(str, box), kind]) + "\n" for kind, box in OBJECTS.items())
        (root / "labels" / f"{name}.txt").write_text("".join(rows))
    (root / "ImageSets" / "train.txt").write_text("\n".join(names) + "\n")
    return root


def write_split(root: Path, split: str, *names: str) -> None:
    (root / "ImageSets").mkdir(exist_ok=True)
    (root / "ImageSets" / f"{split}.txt").write_text("".join(f"{name}\n" for name in names))
