"""The check of a labelled data set before training: files, rows, amounts, and the score of the labels themselves."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
from jaxtyping import Float, Int

from ciassd_jax.config import Config, GridConfig
from ciassd_jax.data.custom import read_custom_frame
from ciassd_jax.data.folders import find_root, frame_files, is_custom
from ciassd_jax.data.frames import Frame
from ciassd_jax.data.kitti import crop_without_images, read_kitti_frame
from ciassd_jax.data.splits import ALL, Places, find_file, listed_names, missing_files, repeated_names
from ciassd_jax.evaluation.kitti_ap import LIMITS, METRICS, Metric, possible_precision
from ciassd_jax.evaluation.objects import DetectedObjects, LabelledObjects, detections_from_rows, labels_from_rows
from ciassd_jax.evaluation.overlap import image_overlap
from ciassd_jax.evaluation.summary import evaluate
from ciassd_jax.formats.custom_rows import CustomRow
from ciassd_jax.formats.errors import FormatWarning, InputError, Pathlike
from ciassd_jax.formats.kitti_boxes import boxes_to_rows
from ciassd_jax.formats.kitti_rows import ObjectRow
from ciassd_jax.ops.footprints import points_in_boxes

# Labels are rounded to two decimals, so that half a turn may read 3.15.
_MAX_HEADING = math.pi + 0.01
# Median length / width below which a type has them swapped, and above which a single object may have.
_WIDE, _LONG = 1 / 1.2, 1.5
# Fewer objects of a type have no typical shape and height.
_FEW = 5
# Least median overlap of labelled and projected image boxes, which are drawn by hand: one of 155 real frames has 0.5.
_SAME = 0.25
# Least fraction of the median number of points that a cloud should have.
_SPARSE = 0.1


class Finding(NamedTuple):
    """One sentence: file, line, problem, remedy. Serious findings must be corrected, the others are worth a look."""

    kind: str
    serious: bool
    text: str


class Checked(NamedTuple):
    """A frame that could be read, without its points: their number, those inside each box, and the occupied voxels."""

    frame: Frame
    points: int
    inside: Int[np.ndarray, " G"]
    voxels: int


class TypeSummary(NamedTuple):
    """The objects of one type: their number, how many are out of the grid's range, and how many hold no point.

    `size` (length, width, height) and `center_z` are medians in metres.
    """

    objects: int
    out_of_range: int
    without_points: int
    size: tuple[float, float, float]
    center_z: float


class LabelScore(NamedTuple):
    """AP R40 in percent of the labels as detections, for one class and metric, at each difficulty.

    `possible` is what the official rule gives for this number of objects if all are found: 100 from CURVE_POINTS on.
    """

    name: str
    metric: Metric
    objects: tuple[int, ...]
    score: tuple[float, ...]
    possible: tuple[float, ...]


class Report(NamedTuple):
    """The check of a data set; `types` are in descending order of their numbers of objects."""

    findings: tuple[Finding, ...]
    frames: tuple[Checked, ...]
    types: dict[str, TypeSummary]
    scores: tuple[LabelScore, ...]


def check_dataset(
    root: Pathlike | None,
    split: str | None = None,
    *,
    config: Config | None = None,
    image_size: tuple[int, int] | None = None,
    track: Callable[[Sequence[str]], Iterable[str]] = iter,
) -> Report:
    """Read all frames of a split, or, by default, all existing frames and split files, and report what is wrong.

    `config` (default: the paper's) gives the grid, the classes and the capacities; `root` and `image_size` are those
    of `open_dataset`; `track` wraps the iteration over the frames, for a progress bar. Raises InputError without any
    frame to read.
    """
    config, root = config or Config(), find_root(root)
    folder, places = frame_files(root, split or ALL)
    listed, source = listed_names(root, split or ALL, folder, places)
    needed = [paths for kind, paths in places.items() if kind != "label"]
    names = [name for name in dict.fromkeys(listed) if all(find_file(folder, paths, name) for paths in needed)]
    if not names:
        raise InputError(f"{source} names no frame that exists; check the path.")
    findings = [*_check_names(listed, source, folder, places), *([] if split else _check_split_files(root))]
    read: Callable[..., Frame] = partial(read_custom_frame, root=root)
    if not is_custom(root):
        read = partial(read_kitti_frame, folder=folder, image_size=image_size)
        if image_size is None and (guess := crop_without_images(folder, names)):
            findings.append(Finding("image size", False, guess))
    frames = []
    for name in track(names):
        cloud, label = (find_file(folder, places.get(kind, ()), name) for kind in ("cloud", "label"))
        try:
            frame = _read(partial(read, name, labelled=label is not None), findings)
        except InputError as error:
            findings.append(Finding("unreadable file", True, str(error)))
            continue
        inside = np.asarray(points_in_boxes(frame.points, frame.boxes)).sum(-1)
        findings += _check_frame(frame, inside, cloud)
        count, voxels = len(frame.points), _count_voxels(frame.points, config.grid)
        frames.append(Checked(frame._replace(points=np.zeros((0, 4), np.float32)), count, inside, voxels))
    (found, types), scores = _check_types(frames, config), _score_labels([one.frame for one in frames])
    findings += [*found, *_check_amounts(frames, config), *_check_scores(scores)]
    return Report(tuple(findings), tuple(frames), types, tuple(scores))


def _read(read: Callable[..., Frame], findings: list[Finding]) -> Frame:
    """Read a frame; malformed label lines and warnings become findings."""
    problems: list[InputError] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", FormatWarning)
        frame = read(problems=problems)
    findings += [Finding("points", False, str(one.message)) for one in caught]
    findings += [Finding("label row", True, str(problem)) for problem in problems]
    return frame


def _check_names(names: Sequence[str], source: str, folder: Path, places: Places) -> Iterator[Finding]:
    for clause in repeated_names(names):
        yield Finding("split", True, f"{source}: {clause}; list it once.")
    for clause in missing_files(folder, places, names):
        yield Finding("missing file", True, f"{source}: {clause}; copy them, or remove the frames from the list.")


def _check_split_files(root: Path) -> Iterator[Finding]:
    """Check each file of ImageSets, and that train and val share no frame."""
    splits = {}
    for path in sorted((root / "ImageSets").glob("*.txt")):
        folder, places = frame_files(root, path.stem)
        names, source = listed_names(root, path.stem, folder, places)
        splits[path.stem] = set(names)
        yield from _check_names(names, source, folder, {"cloud": places["cloud"]})
    shared = sorted(splits.get("train", set()) & splits.get("val", set()))
    if shared:
        text = f"{root / 'ImageSets'}: train.txt and val.txt share {len(shared)} frames, the first {shared[0]}"
        yield Finding("split", True, f"{text}; remove them from one of the two.")


def _check_frame(frame: Frame, inside: Int[np.ndarray, " G"], cloud: Path | None) -> Iterator[Finding]:
    if ((frame.points[:, 3] < 0) | (frame.points[:, 3] > 1)).any():
        yield Finding("intensity", False, f"{cloud}: intensities are not all in [0, 1]; scale them.")
    if not len(frame.points):
        yield Finding("few points", True, f"{cloud}: no point is left; check the calibration and the cloud.")
    places: dict[ObjectRow | CustomRow, str] = {}
    for row in frame.rows or ():
        if (first := places.setdefault(row._replace(place=""), row.place)) != row.place:
            text = f"{row.place}: the same object as in {first}; remove one of the two lines."
            yield Finding("repeated row", True, text)
    for row, size, count in zip(frame.objects, frame.boxes.size, inside, strict=True):
        yield from _check_row(row, size)
        if not count:
            yield Finding("no point", False, f"{row.place}: no point lies inside this {row.type}; check its box.")
    if frame.camera is not None:
        yield from _check_projection(frame)


def _check_row(row: ObjectRow | CustomRow, size: Float[np.ndarray, 3]) -> Iterator[Finding]:
    place = row.place
    if (size <= 0).any():
        edges = " x ".join(f"{edge:g}" for edge in size)
        yield Finding("size", True, f"{place}: the size {edges} is not positive; correct or remove the line.")
    heading = row.box[6] if isinstance(row, CustomRow) else row.rotation_y
    if abs(heading) > _MAX_HEADING:
        yield Finding("heading", True, f"{place}: the heading {heading:g} is outside [-pi, pi]; wrap it, in radians.")
    if isinstance(row, CustomRow):
        return
    if row.bbox[2] <= row.bbox[0] or row.bbox[3] <= row.bbox[1]:
        yield Finding("image box", True, f"{place}: the image box is empty; write left, top, right, bottom in pixels.")
    if not 0 <= row.truncated <= 1 or row.occluded not in range(4):
        yield Finding("occlusion", True, f"{place}: truncation must lie in 0..1 and occlusion be 0, 1, 2 or 3.")
    if row.score is not None:
        yield Finding("score", False, f"{place}: a label has no score; remove the last column.")


def _check_projection(frame: Frame) -> Iterator[Finding]:
    """Compare the image boxes of fully visible objects with the projections of their boxes."""
    pairs = [(row, seen) for row, seen in _projected(frame) if row.truncated == 0 and row.occluded == 0]
    overlap = float(np.median([image_overlap(row.bbox, seen.bbox) if seen else 0.0 for row, seen in pairs] or [1.0]))
    if overlap < _SAME:
        text = f"the boxes project elsewhere than their image boxes lie (overlap {overlap:.2f})"
        place = f"{pairs[0][0].place} and others"
        yield Finding("projection", False, f"{place}: {text}; check that label and calibration belong together.")


def _projected(frame: Frame) -> list[tuple[ObjectRow, ObjectRow | None]]:
    """Return each object's row, and the row made of its box in the LiDAR frame if that is in the image."""
    assert frame.camera is not None
    rows = cast(list[ObjectRow], frame.objects)
    made, kept = boxes_to_rows(frame.boxes, np.ones(len(rows)), frame.names, *frame.camera)
    seen = dict(zip(kept.tolist(), made, strict=True))
    return [(row, seen.get(index)) for index, row in enumerate(rows)]


def _check_types(frames: Sequence[Checked], config: Config) -> tuple[list[Finding], dict[str, TypeSummary]]:
    """Check and summarise the objects of each type together, the most frequent type first."""
    types = np.array([name for one in frames for name in one.frame.names], np.str_)
    places = np.array([row.place for one in frames for row in one.frame.objects], np.str_)
    boxes = np.concatenate([np.zeros((0, 7)), *(one.frame.boxes.to_array() for one in frames)])
    inside = np.concatenate([np.zeros(0, np.int64), *(one.inside for one in frames)])
    findings: list[Finding] = []
    summaries = {}
    for name, _ in Counter(types.tolist()).most_common():
        mine = types == name
        findings += _check_type(name, places[mine], boxes[mine], config)
        summaries[name] = _summarise(boxes[mine], inside[mine], config.grid)
    return findings, summaries


def _check_type(name: str, places: np.ndarray, boxes: Float[np.ndarray, "G 7"], config: Config) -> Iterator[Finding]:
    """Check the objects of a type together: length and width swapped, heights."""
    ratio = boxes[:, 3] / np.where(boxes[:, 4] > 0, boxes[:, 4], np.inf)
    if len(boxes) >= _FEW and np.median(ratio) < _WIDE:
        text = f"{(ratio < 1).sum()} of {len(boxes)} objects of type {name} are wider than long"
        yield Finding("swapped", True, f"{places[0]} and others: {text}; swap their length and width.")
    elif len(boxes) >= _FEW and np.median(ratio) > _LONG:
        for index in np.flatnonzero(ratio < 1):
            text = f"this {name} is {boxes[index, 3]:g} m long and {boxes[index, 4]:g} m wide; swap the two."
            yield Finding("swapped", False, f"{places[index]}: {text}")
    low, high, typical = config.grid.minimum[2], config.grid.maximum[2], np.median(boxes[:, 2])
    for one in config.classes:
        if name not in (one.name, *one.similar):
            continue
        for index in np.flatnonzero((boxes[:, 2] < low) | (boxes[:, 2] > high)):
            text = f"the centre of this {name} is at z = {boxes[index, 2]:.2f}, outside the grid's {low:g}..{high:g} m"
            yield Finding("height", False, f"{places[index]}: {text}; check the line, or choose the grid for it.")
        if name == one.name and len(boxes) >= _FEW and abs(typical - one.center_z) > one.height / 2:
            text = f"the centres of type {name} are typically at z = {typical:.2f}, but its anchors at {one.center_z:g}"
            remedy = "check that z is the middle of the box, or set the class's center_z."
            yield Finding("height", False, f"{places[0]} and others: {text}; {remedy}")


def _summarise(boxes: Float[np.ndarray, "G 7"], inside: Int[np.ndarray, " G"], grid: GridConfig) -> TypeSummary:
    center = boxes[:, :3]
    outside = ((center < np.array(grid.minimum)) | (center > np.array(grid.maximum))).any(-1)
    z, length, width, height = np.median(boxes[:, 2:6], axis=0).tolist()
    return TypeSummary(len(center), int(outside.sum()), int((inside == 0).sum()), (length, width, height), z)


def _count_voxels(points: Float[np.ndarray, "P 4"], grid: GridConfig) -> int:
    """Return the number of occupied voxels."""
    cells = np.floor((points[:, :3] - np.array(grid.minimum, np.float32)) / np.array(grid.voxel_size, np.float32))
    inside = ((cells >= 0) & (cells < np.array(grid.cells))).all(-1)
    return len(np.unique(np.ravel_multi_index(tuple(cells[inside].astype(np.int64).T), tuple(grid.cells))))


def _check_amounts(frames: Sequence[Checked], config: Config) -> Iterator[Finding]:
    """Find boxes that mostly hold no point, clouds far smaller than usual, and frames over a capacity."""
    inside = [count for one in frames for count in one.inside.tolist()]
    if inside.count(0) > len(inside) / 2:
        remedy = "check that labels, calibration and clouds belong together, and the axes of the boxes."
        yield Finding("no point", True, f"{inside.count(0)} of {len(inside)} boxes hold no point; {remedy}")
    usual = float(np.median([one.points for one in frames] or [0]))
    for one in frames:
        if 0 < one.points < _SPARSE * usual:
            text = f"Frame {one.frame.name}: {one.points} points where {usual:.0f} are usual; check its cloud."
            yield Finding("few points", False, text)
    for what, option, capacity, amounts in (
        ("points", "data.max_points", config.data.max_points, [one.points for one in frames]),
        ("objects", "data.max_boxes", config.data.max_boxes, [len(one.inside) for one in frames]),
        ("occupied voxels", "grid.max_voxels", config.grid.max_voxels, [one.voxels for one in frames]),
    ):
        if above := sum(amount > capacity for amount in amounts):
            text = f"{above} of {len(amounts)} frames have more than {capacity} {what}, up to {max(amounts)}"
            yield Finding("capacity", False, f"{text}; the rest is cut and counted, so raise {option} to keep it.")


def _score_labels(frames: Sequence[Frame]) -> list[LabelScore]:
    """Score the labels as detections of score 1, for every class and metric that can be evaluated."""
    pairs = [_as_detections(frame) for frame in frames]
    found = evaluate([truth for truth, _ in pairs], [detections for _, detections in pairs])
    scores = []
    for name, (limit, _) in LIMITS.items():
        for metric in METRICS:
            curves, score = found.curves[name, metric, limit], found.precision(name, metric, limit)
            if curves is not None and score is not None:
                objects = tuple(curve.num_truths for curve in curves)
                scores.append(LabelScore(name, metric, objects, tuple(score), tuple(map(possible_precision, objects))))
    return scores


def _as_detections(frame: Frame) -> tuple[LabelledObjects, DetectedObjects]:
    """Return the labels and the same as detections; with a camera, through the LiDAR frame and back."""
    if frame.camera is None:
        labels = LabelledObjects(frame.names, frame.difficulty, frame.boxes)
        return labels, DetectedObjects(frame.names, np.ones(len(frame.names)), frame.boxes)
    pairs, fields = _projected(frame), ("location", "dimensions", "rotation_y")
    found = [row._replace(score=1.0, **{name: getattr(seen or row, name) for name in fields}) for row, seen in pairs]
    return labels_from_rows([row for row, _ in pairs]), detections_from_rows(found)


def _check_scores(scores: Sequence[LabelScore]) -> Iterator[Finding]:
    for one in scores:
        if one.score != one.possible:
            score, possible = (", ".join(f"{value:.2f}" for value in values) for values in (one.score, one.possible))
            text = f"{one.name} {one.metric}: labels as detections score {score} where {possible} is possible"
            yield Finding("score", True, f"{text}; look for labels that cover each other.")
