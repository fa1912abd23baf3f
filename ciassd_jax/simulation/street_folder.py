"""A folder of synthetic frames in KITTI's layout."""

from __future__ import annotations

import os
import shutil
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import cast

import numpy as np
from jaxtyping import Float32, UInt8

from ciassd_jax.data.frames import Frame
from ciassd_jax.data.kitti import FULL, IMAGE
from ciassd_jax.formats.errors import InputError, Pathlike
from ciassd_jax.formats.kitti_camera import Camera, lidar_to_image
from ciassd_jax.formats.kitti_rows import ObjectRow, write_rows
from ciassd_jax.formats.points import write_bin
from ciassd_jax.formats.writing import check_folder, replacing, write_text
from ciassd_jax.ops.camera import project
from ciassd_jax.simulation.road_users import kind_names
from ciassd_jax.simulation.sensor import Lidar
from ciassd_jax.simulation.streets import make_frame, split_synthetic
from ciassd_jax.simulation.virtual_camera import calibration_text, virtual_camera

# Marks folders that `write_synthetic` wrote, so that nothing else is ever overwritten.
MARK = "synthetic.txt"
_PARTS = ("training", "ImageSets", MARK)
# A depth image shows this range of depths in metres; a point is a square of this many pixels.
_DEPTHS, _DOT = (3.0, 80.0), 3


def write_synthetic(
    out: Pathlike,
    *,
    frames: int,
    seed: int,
    overwrite: bool = False,
    lidar: Lidar | None = None,
    own_class: str | None = None,
    track: Callable[[range], Iterable[int]] = iter,
) -> int:
    """Write frames 0 to `frames` - 1 of a seed as OUT/training and OUT/ImageSets; returns the sum of `dropped` pairs.

    The splits are those of `split_synthetic`; `lidar` and `own_class` are as in `make_frame`. `overwrite` replaces what
    this function wrote there before. `track` wraps the iteration over the frames, for a progress bar. Raises InputError
    for a folder or an `own_class` that cannot be used, and without pillow.
    """
    folder = Path(out)
    kind_names(own_class)
    _require_pillow()
    _clear(folder, overwrite)
    write_text(folder / MARK, f"{frames} synthetic frames of seed {seed}, written by `ciassd data synth`")
    splits = split_synthetic(frames)
    for split in ("train", "val", "trainval"):
        with replacing(folder / "ImageSets" / f"{split}.txt") as temporary:
            temporary.write_text("".join(f"{name}\n" for name in splits[split]))
    made = make_frames(seed, range(frames), lidar, own_class)
    total = 0
    for _ in track(range(frames)):
        frame, dropped = next(made)
        _write_frame(folder / "training", frame)
        total += dropped
    return total


def make_frames(
    seed: int, indices: Iterable[int], lidar: Lidar | None = None, own_class: str | None = None
) -> Iterator[tuple[Frame, int]]:
    """Yield `make_frame` of each index in order, with one thread per core."""
    threads = os.cpu_count() or 1
    pending: deque = deque()
    with ThreadPoolExecutor(threads) as pool:
        for index in indices:
            pending.append(pool.submit(make_frame, seed, index, lidar, own_class))
            if len(pending) > threads:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()


def _clear(folder: Path, overwrite: bool) -> None:
    """Empty the folder if that is allowed; raises InputError otherwise."""
    check_folder(folder)
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    if not overwrite:
        raise InputError(f"{folder} is not empty; choose another folder, or replace its content with `overwrite`.")
    if not (folder / MARK).is_file():
        raise InputError(f"{folder} was not written by `write_synthetic` and stays; choose another folder.")
    for part in _PARTS:
        path = folder / part
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def _write_frame(folder: Path, frame: Frame) -> None:
    """Write the four files of a frame."""
    rows = cast(tuple[ObjectRow, ...], frame.rows)
    with replacing(folder / FULL.format(frame.name)) as temporary:
        write_bin(temporary, frame.points)
    with replacing(folder / f"calib/{frame.name}.txt") as temporary:
        temporary.write_text(calibration_text())
    with replacing(folder / f"label_2/{frame.name}.txt") as temporary:
        write_rows(temporary, rows)
    with replacing(folder / IMAGE.format(frame.name)) as temporary:
        _write_png(temporary, depth_image(frame.points, virtual_camera()))


def depth_image(points: Float32[np.ndarray, "P 4"], camera: Camera) -> UInt8[np.ndarray, "H W"]:
    """Return the points as the camera sees them: brightness is linear in inverse depth, and black means no point."""
    width, height = camera.image_size
    pixels, depth = project(points[:, :3].astype(np.float64), lidar_to_image(camera.calibration))
    near, far = _DEPTHS
    seen = (depth > near) & (depth < far)
    pixels, depth = pixels[seen], depth[seen]
    bright = 30 + 225 * (1 / depth - 1 / far) / (1 / near - 1 / far)
    image = np.zeros((height, width), np.uint8)
    corner = np.floor(pixels).astype(np.int64) - _DOT // 2
    for right in range(_DOT):
        for down in range(_DOT):
            u, v = corner[:, 0] + right, corner[:, 1] + down
            inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
            np.maximum.at(image, (v[inside], u[inside]), bright[inside].astype(np.uint8))
    return image


def _require_pillow() -> None:
    try:
        import PIL.Image  # noqa: F401
    except ModuleNotFoundError:
        raise InputError("Depth images need pillow; run `pip install 'ciassd_jax[viz]'`.") from None


def _write_png(path: Path, image: UInt8[np.ndarray, "H W"]) -> None:
    from PIL import Image

    Image.fromarray(image).save(path, format="PNG", compress_level=1)
