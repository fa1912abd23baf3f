"""Frames to view from files: clouds, folders of clouds and data sets, with labels, images and saved detections."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from ciassd_jax.data.clouds import CloudFile, find_beside, find_clouds, find_image
from ciassd_jax.data.folders import is_custom, is_kitti, open_dataset
from ciassd_jax.data.frames import Dataset, clean_points
from ciassd_jax.data.kitti import IMAGES, crop_to_view, is_reduced, kitti_folder, kitti_frame
from ciassd_jax.data.splits import find_file
from ciassd_jax.formats.custom_rows import parse_custom_row, read_custom_rows
from ciassd_jax.formats.errors import InputError, read_bytes, warn_of_file
from ciassd_jax.formats.kitti_boxes import rows_to_boxes
from ciassd_jax.formats.kitti_camera import Camera
from ciassd_jax.formats.kitti_rows import is_dont_care, read_labels, read_rows
from ciassd_jax.formats.lines import read_lines
from ciassd_jax.formats.points import read_points
from ciassd_jax.view.view_frame import ViewFrame, frame_to_view
from ciassd_jax.view.viz_extra import require

# Folders of clouds, and the folders beside them with their labels: KITTI's and OpenPCDet's custom layout.
_LABELS = {"velodyne": "label_2", "velodyne_reduced": "label_2", "points": "labels"}


class Source(NamedTuple):
    """A frame that can be read, and the file of its image if it exists."""

    read: Callable[[], ViewFrame]
    image: Path | None


def find_sources(
    path: Path,
    split: str = "all",
    image_size: tuple[int, int] | None = None,
    columns: int | Sequence[str] | None = None,
) -> dict[str, Source]:
    """Return the frames at `path` by name.

    `path` is a file of points, a folder of such files, or a data set, of which `split` selects the frames, with or
    without labels. A data set in KITTI's layout has clouds cropped to the camera's view; the other layout is
    OpenPCDet's custom one. Clouds of a folder are shown whole, with the labels and images beside them. `image_size`
    (width, height) overrides that of KITTI's images, `columns` are those of the clouds. Raises InputError, one sentence
    with the remedy, for any other path.
    """
    if is_custom(path) or is_kitti(path):
        folder = None if is_custom(path) else kitti_folder(path, split)[0]
        return dataset_sources(open_dataset(path, split, image_size, columns, need_labels=False), folder)
    inside = next((path / name for name in _LABELS if (path / name).is_dir()), None)
    if inside:
        raise InputError(f"{path} is part of a data set; name {path.parent} for the whole, or {inside} for its clouds.")
    clouds = find_clouds(path, image_size=image_size, columns=columns)
    return {file.cloud.stem: Source(partial(_read_cloud, file, columns), find_image(file.cloud)) for file in clouds}


def dataset_sources(dataset: Dataset, folder: Path | None = None) -> dict[str, Source]:
    """Return the frames of a data set by name; `folder` is that of a KITTI split, for the images."""

    def read(name: str) -> ViewFrame:
        return frame_to_view(dataset.read_frame(name))

    def image(name: str) -> Path | None:
        return None if folder is None else find_file(folder, IMAGES, name)

    return {name: Source(partial(read, name), image(name)) for name in dataset.names}


def detector_points(frame: ViewFrame) -> Float[np.ndarray, "P columns"]:
    """Return the points of a frame for a detector: of a whole cloud only those that the camera sees."""
    return crop_to_view(frame.points, frame.camera) if frame.whole and frame.camera else frame.points


def read_source(source: Source, *, image: bool = False) -> ViewFrame:
    """Read a frame, with its image if `image` is true and the file exists.

    Raises InputError for a file that cannot be used.
    """
    frame = source.read()
    return frame._replace(image=read_image(source.image)) if image and source.image else frame


def read_image(path: Path) -> UInt8[np.ndarray, "rows columns 3"]:
    """Read the colours of an image.

    Raises InputError if the file is not an image, and ModuleNotFoundError without pillow.
    """
    require("Images", "PIL")
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"))
    except (UnidentifiedImageError, OSError, SyntaxError) as error:
        raise InputError(f"{path} cannot be read as an image; copy it again, or leave out the images.") from error


def add_saved(frame: ViewFrame, folder: Path, min_score: float = -np.inf) -> ViewFrame | None:
    """Return the frame with its detections saved in `folder` as NAME.json, else as NAME.txt; None without either.

    Detections of a score below `min_score` are left out. JSON is as written by `inference.results.write_result`. Rows
    of text are KITTI's; for a frame without a camera they are x, y, z, length, width, height, yaw, class, score. Raises
    InputError for a file in another format.
    """
    path = _existing(folder, f"{frame.name}.json") or _existing(folder, f"{frame.name}.txt")
    if path is None:
        return None
    if path.suffix == ".json":
        boxes, scores, labels = _read_json(path)
    elif frame.camera is not None:
        boxes, scores, labels = _read_kitti(path, frame.camera)
    else:
        boxes, scores, labels = _read_custom(path)
    # Scores that are not finite stay, for the page tells of them.
    chosen = np.flatnonzero(~(scores < min_score))
    return frame._replace(boxes=boxes[chosen], scores=scores[chosen], labels=tuple(labels[i] for i in chosen))


_Saved = tuple[np.ndarray, np.ndarray, tuple[str, ...]]


def _read_cloud(file: CloudFile, columns: int | Sequence[str] | None) -> ViewFrame:
    """A whole cloud, with the objects of the label file beside it."""
    name, points = file.cloud.stem, clean_points(read_points(file.cloud, columns), file.cloud)
    frame = ViewFrame(name, points, camera=file.camera, whole=not is_reduced(file.cloud))
    folder = _LABELS.get(file.cloud.absolute().parent.name)
    path = find_beside(file.cloud, folder, ".txt") if folder else None
    if path is not None and folder == "labels":
        rows = read_custom_rows(path)
        boxes = np.array([row.box for row in rows], np.float64).reshape(-1, 7)
        return frame._replace(truth=boxes, truth_labels=tuple(row.type for row in rows))
    if path is not None and file.camera is not None:
        labelled = frame_to_view(kitti_frame(name, points, tuple(read_labels(path)), file.camera))
        return labelled._replace(whole=frame.whole)
    if path is not None:
        warn_of_file(f"{file.cloud} has no calibration, so its labels are not shown.", file.cloud)
    return frame


def _read_json(path: Path) -> _Saved:
    try:
        content = json.loads(read_bytes(path))
        boxes = np.array(content["boxes"], np.float64).reshape(-1, 7)
        scores, labels = np.array(content["scores"], np.float64), tuple(map(str, content["labels"]))
        fits = scores.shape == (len(boxes),) and len(labels) == len(boxes)
    except (ValueError, TypeError, LookupError):
        fits = False
    if not fits:
        raise InputError(f"{path} does not hold detections with boxes, scores and labels; write it again.")
    return boxes, scores, labels


def _read_kitti(path: Path, camera: Camera) -> _Saved:
    rows = [row for row in read_rows(path) if not is_dont_care(row.type)]
    if any(row.score is None for row in rows):
        raise InputError(f"{path} has rows without a score, which are not detections; name the folder of results.")
    scores = np.array([row.score for row in rows], np.float64)
    return np.asarray(rows_to_boxes(rows, camera.calibration).to_array()), scores, tuple(row.type for row in rows)


def _read_custom(path: Path) -> _Saved:
    rows, scores = [], []
    for place, line in read_lines(path):
        *columns, score = line.split()
        if len(columns) == 14:
            raise InputError(f"{path} holds KITTI's rows, which need a camera; give the frame a calibration.")
        rows.append(parse_custom_row(" ".join(columns), place))
        try:
            scores.append(float(score))
        except ValueError as error:
            raise InputError(f"{place}: {error}; write the score last.") from None
    boxes = np.array([row.box for row in rows], np.float64).reshape(-1, 7)
    return boxes, np.array(scores, np.float64), tuple(row.type for row in rows)


def _existing(folder: Path | None, name: str) -> Path | None:
    return folder / name if folder is not None and (folder / name).is_file() else None
