"""Point clouds to run the detector on, with their calibrations."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ciassd_jax.formats.errors import FormatWarning, InputError, Pathlike, read_bytes
from ciassd_jax.formats.kitti_camera import Camera, read_camera
from ciassd_jax.formats.points import POINT_SUFFIXES, read_points


class CloudFile(NamedTuple):
    """A file of points, and its camera if known."""

    cloud: Path
    camera: Camera | None


def find_clouds(
    path: Pathlike, *, calib: Pathlike | None = None, image_size: tuple[int, int] | None = None
) -> list[CloudFile]:
    """Return the cloud at `path`, or the clouds in that folder in the order of their names, each with its camera.

    `calib` is a calibration file for all clouds or a folder with one per cloud; it defaults to `X/calib/NAME.txt` for
    `X/velodyne*/NAME.bin` if that exists. The size of the image is `image_size`, else that of `X/image_2/NAME.png`,
    else KITTI's for the focal length. Raises InputError for a cloud or a calibration that cannot be used; of several
    clouds only names and sizes are checked.
    """
    clouds = _find_clouds(Path(path))
    for cloud in clouds:
        _check_cloud(cloud, whole=len(clouds) == 1)
    return [CloudFile(cloud, _find_camera(cloud, calib, image_size)) for cloud in clouds]


def find_beside(cloud: Path, folder: str, suffix: str) -> Path | None:
    """Return the file of the same frame in a folder beside the cloud's, or None if it does not exist."""
    # Absolute, because a relative path may not name the cloud's folder.
    path = cloud.absolute().parent.parent / folder / f"{cloud.stem}{suffix}"
    return path if path.is_file() else None


def _find_clouds(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    clouds = sorted(p for p in path.iterdir() if p.suffix.lower() in POINT_SUFFIXES)
    if not clouds:
        raise InputError(f"{path} holds no point cloud; give a folder of {', '.join(POINT_SUFFIXES)} files.")
    _check_distinct(clouds)
    return clouds


def _check_distinct(clouds: Sequence[Path]) -> None:
    """Raise InputError for two clouds of one stem, which names their results."""
    by_stem: dict[str, Path] = {}
    for cloud in clouds:
        other = by_stem.setdefault(cloud.stem, cloud)
        if other is not cloud:
            raise InputError(f"{other} and {cloud} would both be written as {cloud.stem}.json; rename one of them.")


def _check_cloud(cloud: Path, *, whole: bool) -> None:
    """Raise InputError for a cloud that cannot be used, judged by its name and size alone unless `whole`."""
    read_bytes(cloud, 0)
    size, suffix = cloud.stat().st_size, cloud.suffix.lower()
    if whole or not size or suffix not in POINT_SUFFIXES or (suffix == ".bin" and size % 16):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FormatWarning)
            read_points(cloud)


def _find_camera(cloud: Path, given: Pathlike | None, image_size: tuple[int, int] | None) -> Camera | None:
    path = _find_calibration(cloud, given)
    if path is None:
        return None
    return read_camera(path, _beside(cloud, "image_2", ".png"), image_size)


def _find_calibration(cloud: Path, given: Pathlike | None) -> Path | None:
    if given is None:
        return _beside(cloud, "calib", ".txt")
    path = Path(given)
    if not path.is_dir():
        return path
    path = path / f"{cloud.stem}.txt"
    if not path.is_file():
        raise InputError(f"{path} does not exist, so {cloud} has no calibration; add it, or leave out `calib`.")
    return path


def _beside(cloud: Path, folder: str, suffix: str) -> Path | None:
    """Return `find_beside` for a cloud in KITTI's layout, else None."""
    return find_beside(cloud, folder, suffix) if cloud.absolute().parent.name.startswith("velodyne") else None
