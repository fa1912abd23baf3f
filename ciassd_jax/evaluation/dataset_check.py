"""The check of a labelled data set before training: its files, clouds, labels, classes and amounts."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from ciassd_jax.config import Config
from ciassd_jax.data.cloud_hints import describe_cloud
from ciassd_jax.data.custom import read_custom_frame
from ciassd_jax.data.folders import find_root, frame_files, is_custom
from ciassd_jax.data.frames import Frame
from ciassd_jax.data.kitti import crop_without_images, read_kitti_frame
from ciassd_jax.data.splits import (
    ALL,
    Places,
    find_file,
    listed_names,
    missing_files,
    present_paths,
    repeated_names,
    same_stem,
)
from ciassd_jax.evaluation.active_sites import occupied_voxels
from ciassd_jax.evaluation.class_check import (
    LabelScore,
    TypeSummary,
    check_classes,
    check_scores,
    count_targets,
    join_labels,
    score_labels,
    summarise_types,
)
from ciassd_jax.evaluation.frame_check import Finding, check_rows, explain_empty
from ciassd_jax.formats.errors import FormatWarning, InputError, Pathlike, collected_warnings, give_grouped
from ciassd_jax.formats.kitti_rows import ObjectRow
from ciassd_jax.formats.points import check_intensity
from ciassd_jax.ops.footprints import points_in_boxes

# Least fraction of the median number of points that a cloud should have.
_SPARSE = 0.1
# Share of the boxes that may lie where no point can be.
_MAX_HIDDEN = 0.1
# Points outside of all boxes that are kept of a frame, to find the ground.
_SAMPLE = 500


class Checked(NamedTuple):
    """A frame that could be read, with a sample of the points outside of all boxes.

    It had `points` points, of which `clipped` had an intensity that is clipped, `inside` lie in each box, and `voxels`
    voxels were occupied. `hidden` tells why objects that hold no point cannot hold any, by their index.
    """

    frame: Frame
    points: int
    clipped: int
    inside: Int[np.ndarray, " G"]
    voxels: int
    hidden: dict[int, str]


class Report(NamedTuple):
    """The check of a data set.

    `types` are in descending order of their numbers of objects, `targets` are the objects of each class in the range.
    """

    findings: tuple[Finding, ...]
    frames: tuple[Checked, ...]
    types: dict[str, TypeSummary]
    targets: dict[str, int]
    scores: tuple[LabelScore, ...]

    @property
    def verdict(self) -> str:
        """One sentence: whether training can start, or the first error."""
        errors = [finding.text for finding in self.findings if finding.serious]
        if errors:
            return f"not ready: {len(errors)} {'errors' if len(errors) > 1 else 'error'}; first: {errors[0]}"
        odd = f"; findings worth a look: {len(self.findings)}" if self.findings else ""
        if all(one.frame.rows is None for one in self.frames):
            return f"ready to predict: {len(self.frames)} frames, without labels{odd}."
        objects = ", ".join(f"{count} {name}" for name, count in self.targets.items())
        return f"ready to train: {objects} objects in range in {len(self.frames)} frames{odd}."


def check_dataset(
    root: Pathlike | None,
    split: str | None = None,
    *,
    config: Config | None = None,
    image_size: tuple[int, int] | None = None,
    columns: int | Sequence[str] | None = None,
    track: Callable[[Sequence[str]], Iterable[str]] = iter,
) -> Report:
    """Read all frames of a split, or, by default, all existing frames and split files, and report what is wrong.

    `config` (default: the paper's) gives the input, the grid, the classes and the capacities; `root`, `image_size` and
    `columns` are those of `open_dataset`; `track` wraps the iteration over the frames, for a progress bar. Raises
    InputError without any frame to read.
    """
    config, root = config or Config(), find_root(root)
    folder, places = frame_files(root, split or ALL)
    listed, source = listed_names(root, split or ALL, folder, places)
    needed = [paths for kind, paths in places.items() if kind != "label"]
    names = [name for name in dict.fromkeys(listed) if all(find_file(folder, paths, name) for paths in needed)]
    if not names:
        raise InputError(f"{source} names no frame that exists; check the path.")
    used = set(listed) if split else _used_names(root, listed)
    findings = [*_check_names(listed, source, folder, places, used), *([] if split else _check_split_files(root))]
    if twice := same_stem(present_paths(folder, places["cloud"])):
        findings.append(Finding("cloud", True, f"{twice[0]} and {twice[1]} are clouds of one frame; remove one."))
    if not is_custom(root) and image_size is None and (guess := crop_without_images(folder, names)):
        findings.append(Finding("image size", False, guess))
    read: Callable[..., Frame] = partial(read_kitti_frame, folder=folder, image_size=image_size)
    read = partial(read_custom_frame, root=root) if is_custom(root) else read
    # A frame may lack its label file, and those of test have none.
    read = partial(read, labelled=None if "label" in places else False, columns=columns)
    frames: list[Checked] = []
    with collected_warnings() as told:
        for name in track(names):
            cloud = find_file(folder, places["cloud"], name)
            frames += _check_frame(partial(read, name), str(cloud), config, findings)
    return _report([*_once(_without_images(findings, frames), "intensity"), *_group(told)], frames, config)


def _report(findings: list[Finding], frames: Sequence[Checked], config: Config) -> Report:
    """Add what only all frames together show."""
    labelled = [one for one in frames if one.frame.rows is not None]
    frames_with_labels, inside = [one.frame for one in labelled], [one.inside for one in labelled]
    labels, scores = join_labels(frames_with_labels, inside), score_labels(frames_with_labels, inside, config)
    findings += [*_check_clouds(frames, config), *(check_classes(labels, config) if labelled else ())]
    findings += [*_check_empty(labelled), *_check_amounts(frames, config), *check_scores(scores)]
    types, targets = summarise_types(labels, config), count_targets(labels, config)
    return Report(tuple(findings), tuple(frames), types, targets, tuple(scores))


def _used_names(root: Path, names: Sequence[str]) -> set[str]:
    """Return the frames that any file of ImageSets but test.txt lists, or all of them without such a file."""
    used: set[str] = set()
    for path in present_paths(root, ("ImageSets/{}.txt",)):
        if path.stem != "test":
            with suppress(InputError):  # `_check_split_files` reports it.
                used.update(listed_names(root, path.stem, *frame_files(root, path.stem))[0])
    return used or set(names)


def _check_names(
    names: Sequence[str], source: str, folder: Path, places: Places, used: Collection[str]
) -> Iterator[Finding]:
    for clause in repeated_names(names):
        yield Finding("split", True, f"{source}: {clause}; list it once.")
    for clause in missing_files(folder, places, [name for name in names if name in used]):
        remedy = "copy them, or list only the other frames in ImageSets; without objects a label file is empty"
        yield Finding("missing file", True, f"{source}: {clause}; {remedy}.")
    for clause in missing_files(folder, places, [name for name in names if name not in used]):
        text = f"{source}: of the frames that ImageSets does not list for training or validation, {clause}"
        yield Finding("missing file", False, f"{text}; these are not used.")


def _check_split_files(root: Path) -> Iterator[Finding]:
    """Check each file of ImageSets, and that train and val share no frame."""
    splits = {}
    for path in present_paths(root, ("ImageSets/{}.txt",)):
        folder, places = frame_files(root, path.stem)
        try:
            names, source = listed_names(root, path.stem, folder, places)
        except InputError as error:
            yield Finding("split", True, str(error))
            continue
        splits[path.stem] = set(names)
        yield from _check_names(names, source, folder, {"cloud": places["cloud"]}, names)
    if is_custom(root) and "train" not in splits:
        path = root / "ImageSets/train.txt"
        text = f"{path} does not exist; list the frames to train on there, one per line, and others in val.txt."
        yield Finding("split", False, text)
    shared = sorted(splits.get("train", set()) & splits.get("val", set()))
    if shared:
        text = f"{root / 'ImageSets'}: train.txt and val.txt share {len(shared)} frames, the first {shared[0]}"
        yield Finding("split", True, f"{text}; remove them from one of the two.")


def _check_frame(read: Callable[..., Frame], cloud: str, config: Config, findings: list[Finding]) -> Iterator[Checked]:
    """Read and check one frame; yields nothing for one that cannot be read."""
    problems: list[InputError] = []
    try:
        frame = read(problems=problems)
    except InputError as error:
        findings.append(Finding("unreadable file", True, str(error)))
        return
    findings += [Finding("label row", True, str(problem)) for problem in problems]
    findings += check_rows(frame)
    if not len(frame.points):
        text = f"{cloud}: no point is left; check the calibration and the cloud."
        findings.append(Finding("few points", True, text))
    clipped = 0
    try:
        _, clipped = check_intensity(frame.points, config.input.intensity_scale, cloud)
    except InputError as error:
        findings.append(Finding("intensity", True, str(error)))
    held = np.asarray(points_in_boxes(frame.points, frame.boxes))
    inside, voxels = held.sum(-1), len(occupied_voxels(frame.points, config))
    background = frame.points[~held.any(0)]
    sample = background[:: max(len(background) // _SAMPLE, 1)]
    hidden = explain_empty(frame, inside)
    yield Checked(frame._replace(points=sample), len(frame.points), clipped, inside, voxels, hidden)


def _without_images(findings: Sequence[Finding], frames: Sequence[Checked]) -> list[Finding]:
    """Say once that no label has an image box, instead of naming each as an error: these are of another format."""
    rows = [row for one in frames for row in one.frame.objects if isinstance(row, ObjectRow)]
    if not rows or any(row.has_image_box for row in rows):
        return list(findings)
    text = f"None of the {len(rows)} objects has an image box; their difficulty is by the number of points instead."
    return [*(one for one in findings if one.kind != "image box"), Finding("image box", False, text)]


def _once(findings: Sequence[Finding], kind: str) -> Iterator[Finding]:
    """Keep the first finding of a kind that all frames tend to have, with the number of the others."""
    alike = [finding for finding in findings if finding.kind == kind]
    yield from (finding for finding in findings if finding.kind != kind)
    if alike:
        more = f" Other frames with this problem: {len(alike) - 1}." if len(alike) > 1 else ""
        yield alike[0]._replace(text=alike[0].text + more)


def _group(told: Sequence[FormatWarning]) -> Iterator[Finding]:
    with collected_warnings() as grouped:
        give_grouped(told)
    yield from (Finding("points", False, str(warning)) for warning in grouped)


def _check_clouds(frames: Sequence[Checked], config: Config) -> Iterator[Finding]:
    """Find clouds that are unlike what the config expects, and clouds far smaller than the others."""
    clipped = [one for one in frames if one.clipped]
    if clipped:
        points = sum(one.clipped for one in clipped)
        text = f"{points} points in {len(clipped)} of {len(frames)} frames, the first {clipped[0].frame.name}, have an"
        scale = config.input.intensity_scale
        yield Finding("intensity", False, f"{text} intensity outside [0, {scale:g}]; training clips it.")
    sample = np.concatenate([np.zeros((0, 4), np.float32), *(one.frame.points for one in frames)])
    # Whether the range fits is seen from objects, where there are any.
    anywhere = (-math.inf,) * 3, (math.inf,) * 3
    extent = anywhere if any(len(one.inside) for one in frames) else config.range
    for hint in describe_cloud(sample, *extent, config.ground, config.input.z_shift):
        yield Finding("cloud", False, hint)
    usual = float(np.median([one.points for one in frames] or [0]))
    for one in frames:
        if 0 < one.points < _SPARSE * usual:
            text = f"Frame {one.frame.name}: {one.points} points where {usual:.0f} are usual; check its cloud."
            yield Finding("few points", False, text)


def _check_empty(frames: Sequence[Checked]) -> Iterator[Finding]:
    """Find boxes without points: those that cannot have any by their reason, and the others one by one."""
    hidden: dict[str, list[str]] = {}
    others = []
    for one in frames:
        for index in np.flatnonzero(one.inside == 0).tolist():
            row = one.frame.objects[index]
            if index in one.hidden:
                hidden.setdefault(one.hidden[index], []).append(row.place)
            else:
                others.append(f"{row.place}: no point lies inside this {row.type}; check its box.")
    total = sum(len(one.inside) for one in frames)
    for reason, places in hidden.items():
        text = f"{len(places)} of {total} boxes hold no point because they lie {reason}, the first {places[0]}"
        remedy = "remove these labels, as nothing can be learned from them"
        if "camera" in reason:
            remedy = f"{remedy}, or use the custom layout, whose clouds are not cropped"
        yield Finding("hidden", len(places) > _MAX_HIDDEN * total, f"{text}; {remedy}.")
    yield from (Finding("no point", False, text) for text in others)
    if len(others) > total / 2:
        remedy = "check that labels, calibration and clouds belong together, and the axes of the boxes."
        yield Finding("no point", True, f"{len(others)} of {total} boxes hold no point; {remedy}")


def _check_amounts(frames: Sequence[Checked], config: Config) -> Iterator[Finding]:
    """Find frames over a capacity."""
    for what, option, capacity, amounts in (
        ("points", "data.max_points", config.data.max_points, [one.points for one in frames]),
        ("objects", "data.max_boxes", config.data.max_boxes, [len(one.inside) for one in frames]),
        ("occupied voxels", "grid.max_voxels", config.grid.max_voxels, [one.voxels for one in frames]),
    ):
        if above := sum(amount > capacity for amount in amounts):
            text = f"{above} of {len(amounts)} frames have more than {capacity} {what}, up to {max(amounts)}"
            yield Finding("capacity", False, f"{text}; the rest is cut and counted, so raise {option} to keep it.")
