"""Frames to look at from files: clouds, folders of them and data sets, with labels, images and saved detections."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from ciassd_jax.data.clouds import CloudFile, find_beside, find_clouds
from ciassd_jax.data.folders import is_custom, open_dataset
from ciassd_jax.data.frames import clean_points
from ciassd_jax.data.kitti import IMAGE, kitti_folder
from ciassd_jax.formats.custom_rows import CustomRow, parse_custom_row, read_custom_rows
from ciassd_jax.formats.errors import FormatWarning, InputError, read_bytes
from ciassd_jax.formats.kitti_boxes import rows_to_boxes
from ciassd_jax.formats.kitti_camera import Camera
from ciassd_jax.formats.kitti_rows import DONT_CARE, read_labels, read_rows
from ciassd_jax.formats.lines import read_lines
from ciassd_jax.formats.points import read_points
from ciassd_jax.view.view_frame import ViewFrame, frame_to_view

# Folders of clouds, and where their labels lie beside them: KITTI's and OpenPCDet's custom layout.
_LABELS = {"velodyne": "label_2", "velodyne_reduced": "label_2", "points": "labels"}


class Source(NamedTuple):
    """A frame that can be read, and the file of its image where there is one."""

    read: Callable[[], ViewFrame]
    image: Path | None


def find_sources(path: Path, split: str = "all", image_size: tuple[int, int] | None = None) -> dict[str, Source]:
    """The frames at `path` by name: of a file of points, of a folder of such files, or of a split of a data set.

    A data set is a folder in KITTI's layout, whose clouds are cropped to the camera's view, or in OpenPCDet's custom
    layout. Clouds of a folder are shown whole; labels and images in such a layout beside it belong to them.
    Raises InputError, one sentence with the remedy, for a path that is none of these.
    """
    if any((path / part).is_dir() for part in ("training", "testing", "points")):
        dataset = open_dataset(path, split, image_size)
        folder = None if is_custom(path) else kitti_folder(path, split)[0]
        return {
            name: Source(partial(_read_labelled, dataset.read_frame, name), _existing(folder, IMAGE.format(name)))
            for name in dataset.names
        }
    inside = next((path / name for name in _LABELS if (path / name).is_dir()), None)
    if inside:
        raise InputError(f"{path} is part of a data set; name {path.parent} for the whole, or {inside} for its clouds.")
    clouds = find_clouds(path, image_size=image_size)
    return {
        file.cloud.stem: Source(partial(_read_cloud, file), find_beside(file.cloud, "image_2", ".png"))
        for file in clouds
    }


def read_source(source: Source, *, image: bool = False) -> ViewFrame:
    """Read a frame, with its image where one is wanted and there; InputError for a file that cannot be used."""
    frame = source.read()
    return frame._replace(image=read_image(source.image)) if image and source.image else frame


def read_image(path: Path) -> UInt8[np.ndarray, "rows columns 3"]:
    """Read an image's colours; InputError if it is none."""
    try:
        from PIL import Image, UnidentifiedImageError
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("Images need pillow; get it with `pip install 'ciassd_jax[viz]'`.") from error
    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"))
    except (UnidentifiedImageError, OSError, SyntaxError) as error:
        raise InputError(f"{path} cannot be read as an image; copy it again, or leave out the images.") from error


def add_saved(frame: ViewFrame, folder: Path) -> ViewFrame | None:
    """The frame with the detections that `folder` holds for it: NAME.json, else NAME.txt; None if it has neither.

    JSON is what `ciassd predict` writes. Rows are KITTI's, or without a camera those of `ciassd eval`: x, y, z, length,
    width, height, yaw, class, score. Raises InputError for a file that is neither.
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
    return frame._replace(boxes=boxes, scores=scores, labels=labels)


_Saved = tuple[np.ndarray, np.ndarray, tuple[str, ...]]


def _read_labelled(read_frame: Callable, name: str) -> ViewFrame:
    return frame_to_view(read_frame(name))


def _read_cloud(file: CloudFile) -> ViewFrame:
    """A cloud as it is, with the objects of the label file beside it."""
    points = clean_points(read_points(file.cloud), file.cloud)
    frame = ViewFrame(file.cloud.stem, points, camera=file.camera)
    kind = _LABELS.get(file.cloud.absolute().parent.name)
    path = find_beside(file.cloud, kind, ".txt") if kind else None
    if path is None:
        return frame
    if kind == "labels":
        rows: list[CustomRow] = read_custom_rows(path)
        boxes = np.array([row.box for row in rows], np.float64).reshape(-1, 7)
        return frame._replace(truth=boxes, truth_labels=tuple(row.type for row in rows))
    if file.camera is None:
        warnings.warn(f"{path} is not shown, as {file.cloud} has no calibration.", FormatWarning, stacklevel=3)
        return frame
    objects = [row for row in read_labels(path) if row.type != DONT_CARE]
    boxes = np.asarray(rows_to_boxes(objects, file.camera.calibration).to_array())
    return frame._replace(truth=boxes, truth_labels=tuple(row.type for row in objects))


def _read_json(path: Path) -> _Saved:
    try:
        content = json.loads(read_bytes(path))
        boxes = np.array(content["boxes"], np.float64).reshape(-1, 7)
        scores, labels = np.array(content["scores"], np.float64), tuple(map(str, content["labels"]))
        fits = scores.shape == (len(boxes),) and len(labels) == len(boxes)
    except (ValueError, TypeError, LookupError):
        fits = False
    if not fits:
        raise InputError(f"{path} holds no detections as `ciassd predict` writes them; write it again.")
    return boxes, scores, labels


def _read_kitti(path: Path, camera: Camera) -> _Saved:
    rows = [row for row in read_rows(path) if row.type != DONT_CARE]
    if any(row.score is None for row in rows):
        raise InputError(f"{path} has rows without a score, so they are no detections; name the folder of results.")
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
