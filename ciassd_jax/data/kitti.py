"""KITTI's folders of the object benchmark, read as downloaded."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from ciassd_jax.data.frames import Dataset, Frame, clean_points
from ciassd_jax.data.splits import Places, find_file, present_files, split_names
from ciassd_jax.formats.errors import FormatWarning, InputError
from ciassd_jax.formats.kitti_boxes import rows_to_boxes
from ciassd_jax.formats.kitti_camera import Camera, read_camera, view_planes
from ciassd_jax.formats.kitti_rows import DONT_CARE, ObjectRow, difficulty_of, read_labels
from ciassd_jax.formats.points import read_points, write_bin
from ciassd_jax.formats.writing import replacing
from ciassd_jax.ops.camera import inside_planes

REDUCED, FULL = "velodyne_reduced/{}.bin", "velodyne/{}.bin"
IMAGE = "image_2/{}.png"
PLACES: Places = {"cloud": (REDUCED, FULL), "calibration": ("calib/{}.txt",), "label": ("label_2/{}.txt",)}


def open_kitti(root: Path, split: str, image_size: tuple[int, int] | None = None) -> Dataset:
    """Open the frames of a split in ROOT/training, or of the split "test" in ROOT/testing, which has no labels.

    `split` is train, val, trainval, test, "all", or the name of a file in ROOT/ImageSets. `image_size` (width, height)
    overrides the sizes of the images. A FormatWarning tells of full clouds to crop without their images.
    """
    folder, places = kitti_folder(root, split)
    names = split_names(root, split, folder, places)
    if image_size is None and (guess := crop_without_images(folder, names)):
        warnings.warn(guess, FormatWarning, stacklevel=3)
    return Dataset(
        names,
        partial(read_kitti_frame, folder=folder, labelled="label" in places, image_size=image_size),
        partial(present_files, folder=folder, places=places),
    )


def kitti_folder(root: Path, split: str) -> tuple[Path, Places]:
    """Return the folder of a split's frames, and the files that each of them has there."""
    if split != "test":
        return root / "training", PLACES
    return root / "testing", {kind: paths for kind, paths in PLACES.items() if kind != "label"}


def read_kitti_frame(
    name: str,
    *,
    folder: Path,
    labelled: bool = True,
    image_size: tuple[int, int] | None = None,
    problems: list[InputError] | None = None,
) -> Frame:
    """Read one frame; without a reduced cloud the full one is cropped to the camera's view.

    Raises InputError for a file that is missing or malformed. With a list of `problems`, the errors of malformed label
    lines are appended to it instead, and the frame has the other rows.
    """
    camera = read_camera(folder / f"calib/{name}.txt", folder / IMAGE.format(name), image_size)
    points = read_seen_points(folder, name, camera)
    rows = tuple(read_labels(folder / f"label_2/{name}.txt", problems)) if labelled else None
    return kitti_frame(name, points, rows, camera)


def kitti_frame(
    name: str, points: Float32[np.ndarray, "P 4"], rows: tuple[ObjectRow, ...] | None, camera: Camera
) -> Frame:
    """Return a frame with KITTI's label rows, DontCare among them; `rows` are None for a frame without labels."""
    objects = [row for row in rows or () if row.type != DONT_CARE]
    difficulty = np.array([difficulty_of(row) for row in objects], np.int64)
    boxes = rows_to_boxes(objects, camera.calibration)
    return Frame(name, points, boxes, tuple(row.type for row in objects), difficulty, camera, rows)


def read_seen_points(folder: Path, name: str, camera: Camera) -> Float32[np.ndarray, "P 4"]:
    """Read the frame's reduced cloud, or crop its full one to the camera's view."""
    path = find_file(folder, PLACES["cloud"], name)
    if path is None:
        raise InputError(f"{folder / FULL.format(name)} does not exist; copy it, or remove the frame from the split.")
    points = clean_points(read_points(path), path)
    reduced = path.parent.name == Path(REDUCED).parent.name
    return points if reduced else crop_to_view(points, camera)


def crop_to_view(points: Float32[np.ndarray, "N 4"], camera: Camera) -> Float32[np.ndarray, "P 4"]:
    """Return the points that the camera sees: strictly inside the image and nearer than 100 m."""
    return points[inside_planes(points[:, :3].astype(np.float64), view_planes(camera))]


def write_reduced(
    root: Path, image_size: tuple[int, int] | None, track: Callable[[Sequence[Path]], Iterable[Path]] = iter
) -> int:
    """Write `velodyne_reduced` beside every full cloud that lacks it; returns the number of files written.

    `track` wraps the iteration over the clouds, for a progress bar. Raises InputError for a file that cannot be read
    or written.
    """
    full = sorted(path for part in ("training", "testing") for path in (root / part).glob(FULL.format("*")))
    clouds = [path for path in full if not (path.parents[1] / REDUCED.format(path.stem)).is_file()]
    for path in track(clouds):
        folder, name = path.parents[1], path.stem
        camera = read_camera(folder / f"calib/{name}.txt", folder / IMAGE.format(name), image_size)
        points = crop_to_view(clean_points(read_points(path), path), camera)
        with replacing(folder / REDUCED.format(name)) as temporary:
            write_bin(temporary, points)
    return len(clouds)


def crop_without_images(folder: Path, names: Sequence[str]) -> str | None:
    """Return one sentence on full clouds that must be cropped to images of unknown size, or None without any."""
    guessed = sum(not any((folder / path.format(name)).is_file() for path in (REDUCED, IMAGE)) for name in names)
    if not guessed:
        return None
    return (
        f"{folder / IMAGE.format('NAME')} is missing for {guessed} of {len(names)} frames whose clouds are cropped to "
        "the image; the usual size for the camera's focal length is used instead."
    )
