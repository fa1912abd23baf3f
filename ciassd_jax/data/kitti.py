"""KITTI's folders of the object benchmark, read as downloaded."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from ciassd_jax.data.frames import Dataset, Frame, clean_points, difficulty_by_points
from ciassd_jax.data.splits import (
    Places,
    describe_places,
    find_file,
    present_files,
    present_paths,
    split_names,
    with_suffixes,
)
from ciassd_jax.formats.errors import InputError, grouped_warnings, warn_of_file
from ciassd_jax.formats.kitti_boxes import rows_to_boxes
from ciassd_jax.formats.kitti_camera import IMAGE_SUFFIXES, Camera, read_camera, view_planes
from ciassd_jax.formats.kitti_rows import ObjectRow, difficulty_of, is_dont_care, read_labels
from ciassd_jax.formats.points import read_points, write_bin
from ciassd_jax.formats.writing import replacing
from ciassd_jax.ops.camera import inside_planes
from ciassd_jax.ops.footprints import points_in_boxes
from ciassd_jax.types import Boxes

REDUCED, FULL = "velodyne_reduced/{}.bin", "velodyne/{}.bin"
IMAGE = "image_2/{}.png"
IMAGES = with_suffixes("image_2/{}", IMAGE_SUFFIXES)
PLACES: Places = {"cloud": (REDUCED, FULL), "calibration": ("calib/{}.txt",), "label": ("label_2/{}.txt",)}


def open_kitti(
    root: Path,
    split: str,
    image_size: tuple[int, int] | None = None,
    columns: int | Sequence[str] | None = None,
    *,
    need_labels: bool = True,
) -> Dataset:
    """Open the frames of a split in ROOT/training, or of the split "test" in ROOT/testing, which has no labels.

    `split` is train, val, trainval, test, "all", the name of a file in ROOT/ImageSets, or the path of such a file.
    `image_size` (width, height) overrides the sizes of the images, `columns` are those of the clouds (`read_points`).
    All frames of ROOT/training have labels, unless `need_labels` is false. A FormatWarning tells of full clouds to crop
    without their images. Raises InputError for a split without frames, and for frames without their files.
    """
    folder, places = kitti_folder(root, split)
    needed = {kind: paths for kind, paths in places.items() if need_labels or kind != "label"}
    names = split_names(root, split, folder, needed)
    if image_size is None and (guess := crop_without_images(folder, names)):
        warn_of_file(guess, stacklevel=4)
    labelled = "label" in places and (True if need_labels else None)
    return Dataset(
        names,
        partial(read_kitti_frame, folder=folder, labelled=labelled, image_size=image_size, columns=columns),
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
    labelled: bool | None = True,
    image_size: tuple[int, int] | None = None,
    columns: int | Sequence[str] | None = None,
    problems: list[InputError] | None = None,
) -> Frame:
    """Read one frame; without a reduced cloud the full one is cropped to the camera's view.

    With `labelled` None a frame may lack its label file; with false it is not read. Raises InputError for a file that
    is missing or malformed. With a list of `problems`, the errors of malformed label lines are appended to it instead,
    and the frame has the other rows.
    """
    camera, label = _read_camera(folder, name, image_size), folder / f"label_2/{name}.txt"
    points = read_seen_points(folder, name, camera, columns)
    read = label.is_file() if labelled is None else labelled
    rows = tuple(read_labels(label, problems)) if read else None
    return kitti_frame(name, points, rows, camera)


def kitti_frame(
    name: str, points: Float32[np.ndarray, "P 4"], rows: tuple[ObjectRow, ...] | None, camera: Camera
) -> Frame:
    """Return a frame with KITTI's label rows, DontCare among them; `rows` are None for a frame without labels.

    The difficulty of an object without an image box is by the number of points in its box.
    """
    objects = [row for row in rows or () if not is_dont_care(row.type)]
    boxes = rows_to_boxes(objects, camera.calibration)
    difficulty = np.array([difficulty_of(row) for row in objects], np.int64)
    bare = [index for index, row in enumerate(objects) if not row.has_image_box]
    if bare:
        inside = points_in_boxes(points, Boxes(*(leaf[bare] for leaf in boxes))).sum(-1)
        difficulty[bare] = difficulty_by_points(np.asarray(inside))
    return Frame(name, points, boxes, tuple(row.type for row in objects), difficulty, camera, rows)


def read_seen_points(
    folder: Path, name: str, camera: Camera, columns: int | Sequence[str] | None = None
) -> Float32[np.ndarray, "P 4"]:
    """Read the frame's reduced cloud, or crop its full one to the camera's view."""
    path = find_file(folder, PLACES["cloud"], name)
    if path is None:
        raise InputError(f"{folder / FULL.format(name)} does not exist; copy it, or remove the frame from the split.")
    points = clean_points(read_points(path, columns), path)
    return points if is_reduced(path) else crop_to_view(points, camera)


def is_reduced(cloud: Path) -> bool:
    """Return whether a cloud lies in a folder of clouds that are already cropped to the camera's view."""
    return cloud.absolute().parent.name == Path(REDUCED).parent.name


def crop_to_view(points: Float32[np.ndarray, "N 4"], camera: Camera) -> Float32[np.ndarray, "P 4"]:
    """Return the points that the camera sees: strictly inside the image and nearer than 100 m."""
    return points[inside_planes(points[:, :3].astype(np.float64), view_planes(camera))]


def write_reduced(
    root: Path,
    image_size: tuple[int, int] | None,
    track: Callable[[Sequence[Path]], Iterable[Path]] = iter,
    columns: int | Sequence[str] | None = None,
) -> int:
    """Write `velodyne_reduced` beside every full cloud that lacks it; returns the number of files written.

    `track` wraps the iteration over the clouds, for a progress bar. Gives one FormatWarning for each kind of problem.
    Raises InputError for a file that cannot be read or written.
    """
    full = [path for part in ("training", "testing") for path in present_paths(root / part, (FULL,))]
    clouds = [path for path in full if not (path.parents[1] / REDUCED.format(path.stem)).is_file()]
    with grouped_warnings():
        for path in track(clouds):
            folder, name = path.parents[1], path.stem
            camera = _read_camera(folder, name, image_size)
            points = crop_to_view(clean_points(read_points(path, columns), path), camera)
            with replacing(folder / REDUCED.format(name)) as temporary:
                write_bin(temporary, points)
    return len(clouds)


def crop_without_images(folder: Path, names: Sequence[str]) -> str | None:
    """Return one sentence on full clouds that must be cropped to images of unknown size, or None without any."""
    guessed = sum(find_file(folder, (REDUCED, *IMAGES), name) is None for name in names)
    if not guessed:
        return None
    return (
        f"{describe_places(folder, IMAGES)} is missing for {guessed} of {len(names)} frames whose clouds are cropped "
        "to the image; give its size as `image_size` (width, height), or the usual one for the camera's focal length "
        "is used."
    )


def _read_camera(folder: Path, name: str, image_size: tuple[int, int] | None) -> Camera:
    return read_camera(folder / f"calib/{name}.txt", find_file(folder, IMAGES, name), image_size)
