"""Detections for files: which clouds, which calibration, and what is written for each frame."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ciassd_jax.detector import Detector, FrameResult
from ciassd_jax.formats import kitti
from ciassd_jax.formats.errors import FormatError
from ciassd_jax.formats.points import POINT_SUFFIXES, read_points
from ciassd_jax.ops.camera import frustum_planes
from ciassd_jax.types import Boxes


class Camera(NamedTuple):
    """A frame's calibration and its image's size (width, height) in pixels."""

    calibration: kitti.Calibration
    image_size: tuple[int, int]


class Frame(NamedTuple):
    """One cloud to detect in: the name of its results, its file, and its camera where one is known."""

    name: str
    path: Path
    camera: Camera | None


def find_frames(path: Path, *, calib: Path | None = None, image_size: tuple[int, int] | None = None) -> list[Frame]:
    """The cloud at `path`, or those in that folder by name, with their cameras; checks every file before any work.

    `calib` is one calibration for all or a folder of them; without it, `X/calib/NAME.txt` beside `X/velodyne*/NAME`
    is taken where it exists. Raises FormatError.
    """
    if path.is_dir():
        clouds = sorted(p for p in path.iterdir() if p.suffix.lower() in POINT_SUFFIXES)
        if not clouds:
            raise FormatError(f"{path} holds no cloud; name a folder with files of {', '.join(POINT_SUFFIXES)}.")
    else:
        clouds = [path]
    seen: dict[str, Path] = {}
    for cloud in clouds:
        _check_cloud(cloud)
        if cloud.stem in seen:
            raise FormatError(f"{seen[cloud.stem]} and {cloud} would write the same results; rename one of them.")
        seen[cloud.stem] = cloud
    return [Frame(cloud.stem, cloud, _camera_of(cloud, calib, image_size)) for cloud in clouds]


def detect_frames(detector: Detector, frames: Iterable[Frame], out: Path) -> Iterator[tuple[Frame, FrameResult]]:
    """Detect in each frame and write `OUT/NAME.json`, and with a camera the KITTI rows `OUT/NAME.txt`."""
    for frame in frames:
        points = read_points(frame.path)
        planes = None
        if frame.camera is not None:
            width, height = frame.camera.image_size
            planes = frustum_planes(kitti.lidar_to_image(frame.camera.calibration), width=width, height=height)
        result = detector.detect(points, frustum=planes)
        write_atomically(out / f"{frame.name}.json", json.dumps(result.to_dict()))
        if frame.camera is not None:
            write_atomically(out / f"{frame.name}.txt", kitti_text(result, frame.camera))
        yield frame, result


def kitti_text(result: FrameResult, camera: Camera) -> str:
    """The result's boxes that are seen in the image as KITTI rows, best score first."""
    boxes = Boxes.from_array(result.boxes.astype(np.float64))
    rows, _ = kitti.boxes_to_rows(boxes, result.scores, result.labels, camera.calibration, camera.image_size)
    return "".join(kitti.format_row(row) + "\n" for row in rows)


def prepare_folder(out: Path) -> Path:
    """Make the output folder and prove that it can be written; raises FormatError."""
    probe = out / ".write_test"
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise FormatError(f"{out} cannot be written ({error.strerror}); choose another --out.") from error
    return out


def write_atomically(path: Path, text: str) -> None:
    """Write a text file whole or not at all."""
    draft = path.with_name(f".{path.name}.part")
    try:
        draft.write_text(text)
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)


def _check_cloud(cloud: Path) -> None:
    if cloud.suffix.lower() not in POINT_SUFFIXES or not cloud.is_file():
        read_points(cloud)  # Its sentence says what is wrong.
    size = cloud.stat().st_size
    if size == 0 or (cloud.suffix.lower() == ".bin" and size % 16):
        read_points(cloud)


def _camera_of(cloud: Path, calib: Path | None, image_size: tuple[int, int] | None) -> Camera | None:
    root = cloud.resolve().parent.parent
    if calib is None:
        beside = root / "calib" / f"{cloud.stem}.txt"
        if not (cloud.resolve().parent.name.startswith("velodyne") and beside.is_file()):
            return None
        calib = beside
    elif calib.is_dir():
        calib = calib / f"{cloud.stem}.txt"
    calibration = kitti.read_calibration(calib)
    image = root / "image_2" / f"{cloud.stem}.png"
    if image_size is None and image.is_file():
        image_size = kitti.read_png_size(image)
    image_size = image_size or kitti.image_size_for(calibration)
    if image_size is None:
        raise FormatError(
            f"{calib} is of no known camera (its focal length is {calibration.projection[0, 0]:g}); "
            "give the image's size with --image-size WIDTH HEIGHT."
        )
    return Camera(calibration, image_size)
