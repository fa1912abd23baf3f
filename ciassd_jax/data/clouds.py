"""Point clouds to run the detector on, with their calibrations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from ciassd_jax.data.folders import frame_files, is_custom, is_kitti, open_dataset
from ciassd_jax.data.frames import clean_points
from ciassd_jax.data.kitti import crop_to_view, is_reduced
from ciassd_jax.data.splits import ALL, find_file, same_stem, with_suffixes
from ciassd_jax.formats.errors import InputError, Pathlike, collected_warnings, read_bytes
from ciassd_jax.formats.kitti_camera import IMAGE_SUFFIXES, Camera, read_camera
from ciassd_jax.formats.points import POINT_SUFFIXES, read_points


class CloudFile(NamedTuple):
    """A file of points, and its camera if known."""

    cloud: Path
    camera: Camera | None


def find_clouds(
    path: Pathlike,
    *,
    split: str = ALL,
    calib: Pathlike | None = None,
    image_size: tuple[int, int] | None = None,
    columns: int | Sequence[str] | None = None,
    problems: list[InputError] | None = None,
) -> list[CloudFile]:
    """Return the cloud at `path`, the clouds in that folder in the order of their names, or those of a data set.

    `split` selects the frames of a data set (`open_dataset`). Each cloud comes with its camera: `calib` is a
    calibration file for all clouds or a folder with one per cloud; it defaults to `X/calib/NAME.txt` for
    `X/velodyne*/NAME.bin` if that exists. The size of the image is `image_size`, else that of `X/image_2/NAME.png` or
    `.jpg`, else KITTI's for the focal length. `columns` are those of the clouds (`read_points`). Names that start with
    a dot are no clouds.

    Raises InputError for a cloud or a calibration that cannot be used; of several clouds only names and sizes are
    checked. With a list of `problems`, these errors are appended to it instead, and the other clouds are returned.
    """
    clouds, found = _find_clouds(Path(path), split, image_size, columns), []
    for cloud in clouds:
        try:
            _check_cloud(cloud, columns, whole=len(clouds) == 1)
            found.append(CloudFile(cloud, _find_camera(cloud, calib, image_size)))
        except InputError as error:
            if problems is None:
                raise
            problems.append(error)
    return found


def read_cloud(file: CloudFile, columns: int | Sequence[str] | None = None) -> tuple[Float32[np.ndarray, "P 4"], int]:
    """Read the finite points of a cloud that its camera sees, and the number of those that it does not see.

    As in evaluation, a cloud without a camera and one in a folder velodyne_reduced are not cropped. Raises InputError
    as `read_points`.
    """
    points = clean_points(read_points(file.cloud, columns), file.cloud)
    seen = points if file.camera is None or is_reduced(file.cloud) else crop_to_view(points, file.camera)
    return seen, len(points) - len(seen)


def find_image(cloud: Path) -> Path | None:
    """Return the image of a cloud in KITTI's layout, or None if it does not exist."""
    return find_beside(cloud, "image_2", *with_suffixes("", IMAGE_SUFFIXES)) if _in_kitti(cloud) else None


def find_beside(cloud: Path, folder: str, *suffixes: str) -> Path | None:
    """Return the first file of the same frame in a folder beside the cloud's, or None if none exists."""
    # Absolute, because a relative path may not name the cloud's folder.
    stem = cloud.absolute().parent.parent / folder / cloud.stem
    return next((path for suffix in suffixes if (path := stem.with_name(stem.name + suffix)).is_file()), None)


def _find_clouds(
    path: Path, split: str, image_size: tuple[int, int] | None, columns: int | Sequence[str] | None
) -> list[Path]:
    if not path.is_dir():
        return [path]
    if is_kitti(path) or is_custom(path):
        names = open_dataset(path, split, image_size, columns, need_labels=False).names
        folder, places = frame_files(path, split)
        return [cloud for name in names if (cloud := find_file(folder, places["cloud"], name))]
    clouds = sorted(p for p in path.iterdir() if p.suffix.lower() in POINT_SUFFIXES and not p.name.startswith("."))
    if not clouds:
        raise InputError(f"{path} holds no point cloud; give a folder of {', '.join(POINT_SUFFIXES)} files.")
    # The stem names the results.
    twice = same_stem(clouds)
    if twice:
        raise InputError(
            f"{twice[0]} and {twice[1]} would both be written as {twice[0].stem}.json; rename one of them."
        )
    return clouds


def _check_cloud(cloud: Path, columns: int | Sequence[str] | None, *, whole: bool) -> None:
    """Raise InputError for a cloud that cannot be used, judged by its name and size alone unless `whole`."""
    read_bytes(cloud, 0)
    width = columns if isinstance(columns, int) else 4 if columns is None else len(columns)
    size, suffix = cloud.stat().st_size, cloud.suffix.lower()
    if whole or not size or suffix not in POINT_SUFFIXES or (suffix == ".bin" and size % (4 * width)):
        with collected_warnings():
            read_points(cloud, columns)


def _find_camera(cloud: Path, given: Pathlike | None, image_size: tuple[int, int] | None) -> Camera | None:
    path = _find_calibration(cloud, given)
    if path is None:
        return None
    return read_camera(path, find_image(cloud), image_size)


def _find_calibration(cloud: Path, given: Pathlike | None) -> Path | None:
    if given is None:
        return find_beside(cloud, "calib", ".txt") if _in_kitti(cloud) else None
    path = Path(given)
    if not path.is_dir():
        return path
    path = path / f"{cloud.stem}.txt"
    if not path.is_file():
        raise InputError(f"{path} does not exist, so {cloud} has no calibration; add it, or leave out `calib`.")
    return path


def _in_kitti(cloud: Path) -> bool:
    return cloud.absolute().parent.name.startswith("velodyne")
