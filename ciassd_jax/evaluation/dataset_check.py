"""The check of a whole data set, before a training finds out."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from ciassd_jax.config import Config, GridConfig
from ciassd_jax.data.custom import PLACES as CUSTOM_PLACES
from ciassd_jax.data.folders import find_root, is_custom
from ciassd_jax.data.frames import clean_points
from ciassd_jax.data.kitti import IMAGE, crop_to_view, crop_without_images, kitti_folder
from ciassd_jax.data.splits import ALL, Places, find_file, listed_names, missing_files, repeated_names
from ciassd_jax.evaluation.check_labels import check_object, check_projection, check_types, read_labelled
from ciassd_jax.evaluation.findings import CheckedFrame, Finding, Labelled, Report, TypeSummary
from ciassd_jax.formats.errors import FormatWarning, InputError, Pathlike
from ciassd_jax.formats.kitti_camera import Camera, read_camera
from ciassd_jax.formats.points import read_points
from ciassd_jax.ops.footprints import points_in_boxes
from ciassd_jax.types import Boxes

# A cloud with less than this part of the usual number of points is odd.
_SPARSE = 0.1


def check_dataset(
    root: Pathlike | None,
    split: str | None = None,
    *,
    config: Config | None = None,
    image_size: tuple[int, int] | None = None,
    track: Callable[[Sequence[str]], Iterable[str]] = iter,
) -> Report:
    """Read every frame of a split, or without one all that are there and the split files, and say what is odd.

    `config` says the grid, the classes and the capacities (the paper's without one); `root` and `image_size` are as
    for `open_dataset`; `track` sees the frames go by, for a progress bar. Raises InputError where there is no frame.
    """
    config, folder = config or Config(), find_root(root)
    root, places = folder, CUSTOM_PLACES
    if not is_custom(root):
        folder, places = kitti_folder(root, split or ALL)
    listed, source = listed_names(root, split or ALL, folder, places)
    needed = [paths for kind, paths in places.items() if kind != "label"]
    names = [name for name in dict.fromkeys(listed) if all(find_file(folder, paths, name) for paths in needed)]
    if not names:
        raise InputError(f"{source} names no frame that is there; check the path.")
    findings = list(_check_names(listed, source, folder, places))
    findings += [] if split else _check_split_files(root)
    if not is_custom(root) and image_size is None and (guess := crop_without_images(folder, names)):
        findings.append(Finding("image size", False, guess))
    frames = []
    for name in track(names):
        frame, found = _check_frame(name, folder, places, config.grid, image_size)
        findings += found
        frames += [frame] if frame else []
    findings += check_types([labelled for frame in frames for labelled in frame.objects], config)
    findings += _check_amounts(frames, config)
    return Report(tuple(findings), tuple(frames), _summarise(frames, config.grid))


def _check_names(names: Sequence[str], source: str, folder: Path, places: Places) -> Iterator[Finding]:
    """Names that are listed twice or whose files are missing."""
    for sentence in repeated_names(names):
        yield Finding("split", True, f"{source}: {sentence}; list it once.")
    for sentence in missing_files(folder, places, names):
        yield Finding("missing file", True, f"{source}: {sentence}; copy them, or take the frames off the list.")


def _check_split_files(root: Path) -> Iterator[Finding]:
    """All of ImageSets: each file by itself, and whether train and val share frames."""
    splits = {}
    for path in sorted((root / "ImageSets").glob("*.txt")):
        folder, places = (root, CUSTOM_PLACES) if is_custom(root) else kitti_folder(root, path.stem)
        names, source = listed_names(root, path.stem, folder, places)
        splits[path.stem] = set(names)
        yield from _check_names(names, source, folder, {"cloud": places["cloud"]})
    shared = sorted(splits.get("train", set()) & splits.get("val", set()))
    if shared:
        yield Finding(
            "split",
            True,
            f"{root / 'ImageSets'}: train.txt and val.txt share {len(shared)} frames, the first {shared[0]}; take them "
            "off one of the two.",
        )


def _check_frame(
    name: str, folder: Path, places: Places, grid: GridConfig, image_size: tuple[int, int] | None
) -> tuple[CheckedFrame | None, list[Finding]]:
    """Everything about one frame whose cloud is there; no frame where its cloud or calibration cannot be read."""
    try:
        camera = None
        if "calibration" in places:
            camera = read_camera(folder / f"calib/{name}.txt", folder / IMAGE.format(name), image_size)
        points, findings = _read_cloud(name, folder, places, camera)
    except InputError as error:
        return None, [Finding("unreadable file", True, str(error))]
    label = find_file(folder, places.get("label", ()), name)
    objects: list[Labelled] = []
    if label is not None:
        objects, more = read_labelled(label, camera and camera.calibration)
        findings += more
    findings += [finding for labelled in objects for finding in check_object(labelled)]
    if camera is not None:
        findings += check_projection(objects, camera)
    boxes = Boxes.from_array(np.array([labelled.box for labelled in objects]).reshape(-1, 7))
    inside = np.asarray(points_in_boxes(points, boxes)).sum(-1)
    findings += [
        Finding("no point", False, f"{labelled.place}: no point lies inside this {labelled.type}; check its box.")
        for labelled, count in zip(objects, inside, strict=True)
        if not count
    ]
    return CheckedFrame(name, camera, tuple(objects), inside, len(points), _count_voxels(points, grid)), findings


def _read_cloud(
    name: str, folder: Path, places: Places, camera: Camera | None
) -> tuple[Float32[np.ndarray, "P 4"], list[Finding]]:
    """The frame's points as training would see them, and what is odd about their values."""
    path = find_file(folder, places["cloud"], name)
    assert path is not None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", FormatWarning)
        points = clean_points(read_points(path), path)
    findings = [Finding("points", False, str(one.message)) for one in caught]
    if ((points[:, 3] < 0) | (points[:, 3] > 1)).any():
        text = f"{path}: intensities are not all in [0, 1]; scale them so."
        findings.append(Finding("intensity", False, text))
    if camera is not None and path.parent.name != "velodyne_reduced":
        points = crop_to_view(points, camera)
    if not len(points):
        findings.append(Finding("few points", True, f"{path}: no point is left; check the calibration and the cloud."))
    return points, findings


def _count_voxels(points: Float32[np.ndarray, "P 4"], grid: GridConfig) -> int:
    """How many voxels of the grid are occupied."""
    shape = np.array(grid.cells)
    cells = np.floor((points[:, :3] - np.array(grid.minimum, np.float32)) / np.array(grid.voxel_size, np.float32))
    inside = ((cells >= 0) & (cells < shape)).all(-1)
    return len(np.unique(np.ravel_multi_index(tuple(cells[inside].astype(np.int64).T), tuple(shape))))


def _check_amounts(frames: Sequence[CheckedFrame], config: Config) -> Iterator[Finding]:
    """Boxes that mostly hold no point, clouds far smaller than usual, and frames beyond a capacity of the config."""
    inside = [count for frame in frames for count in frame.inside.tolist()]
    if inside.count(0) > len(inside) / 2:
        text = (
            f"{inside.count(0)} of {len(inside)} boxes hold no point; check that labels, calibration and clouds belong "
            "together, and the axes of the boxes."
        )
        yield Finding("no point", True, text)
    usual = float(np.median([frame.points for frame in frames])) if frames else 0
    for frame in frames:
        if 0 < frame.points < _SPARSE * usual:
            text = f"Frame {frame.name}: {frame.points} points where {usual:.0f} are usual; check its cloud."
            yield Finding("few points", False, text)
    for what, option, capacity, amounts in (
        ("points", "data.max_points", config.data.max_points, [frame.points for frame in frames]),
        ("objects", "data.max_boxes", config.data.max_boxes, [len(frame.objects) for frame in frames]),
        ("occupied voxels", "grid.max_voxels", config.grid.max_voxels, [frame.voxels for frame in frames]),
    ):
        above = sum(amount > capacity for amount in amounts)
        if above:
            text = (
                f"{above} of {len(amounts)} frames have more than {capacity} {what}, up to {max(amounts)}; the rest is "
                f"cut and counted, so raise {option} to keep it."
            )
            yield Finding("capacity", False, text)


def _summarise(frames: Sequence[CheckedFrame], grid: GridConfig) -> dict[str, TypeSummary]:
    """Objects by type, the most frequent first."""
    types = np.array([labelled.type for frame in frames for labelled in frame.objects], np.str_)
    boxes = np.array([labelled.box for frame in frames for labelled in frame.objects]).reshape(-1, 7)
    inside = np.array([count for frame in frames for count in frame.inside.tolist()])
    center = boxes[:, :3]
    outside = ((center < np.array(grid.minimum)) | (center > np.array(grid.maximum))).sum(-1) > 0
    summaries = {}
    for name in dict.fromkeys(types.tolist()):
        mine = types == name
        length, width, height = np.median(boxes[mine, 3:6], axis=0).tolist()
        summaries[name] = TypeSummary(
            objects=int(mine.sum()),
            out_of_range=int(outside[mine].sum()),
            without_points=int((inside[mine] == 0).sum()),
            size=(length, width, height),
            center_z=float(np.median(boxes[mine, 2])),
        )
    return dict(sorted(summaries.items(), key=lambda item: -item[1].objects))
