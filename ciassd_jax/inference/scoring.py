"""Run a detector over a labelled data set, write its detections, and compute their average precision."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ciassd_jax.config import Config
from ciassd_jax.data.ahead import read_ahead
from ciassd_jax.data.frames import Dataset, Frame
from ciassd_jax.evaluation.kitti_ap import LIMITS, limits_of
from ciassd_jax.evaluation.objects import DetectedObjects, LabelledObjects, detections_from_rows, labels_from_frame
from ciassd_jax.evaluation.summary import Evaluation, evaluate
from ciassd_jax.formats.errors import (
    DroppedWarning,
    FormatWarning,
    InputError,
    Pathlike,
    collected_warnings,
    give_grouped,
)
from ciassd_jax.formats.kitti_camera import frustum_of
from ciassd_jax.formats.kitti_rows import format_row
from ciassd_jax.formats.writing import replacing
from ciassd_jax.inference.detector import Detector
from ciassd_jax.inference.results import FrameResult
from ciassd_jax.ops.footprints import points_in_boxes
from ciassd_jax.types import Boxes

# Weights in the folder of a training, in order of preference: the best by validation, and the last.
TRAINED = ("best.safetensors", "last.safetensors")


class Scored(NamedTuple):
    """The labels and detections of a frame, ready for evaluation, and the detections as lines of a file.

    With a camera, `lines` are KITTI's rows. Without one they are x, y, z, length, width, height and yaw in the LiDAR
    frame, the class, and the score. Numbers have 4 decimals.
    """

    name: str
    truth: LabelledObjects
    detections: DetectedObjects
    lines: tuple[str, ...]
    result: FrameResult


def score_dataset(
    detector: Detector,
    dataset: Dataset,
    track: Callable[[Sequence[str]], Iterable[str]] = iter,
    *,
    batch_size: int = 1,
) -> Evaluation:
    """Return the average precision of a detector on a data set: `score_frames` of `detect_dataset`."""
    return score_frames(detect_dataset(detector, dataset, track, batch_size=batch_size), detector.config)


def score_frames(frames: Sequence[Scored], config: Config) -> Evaluation:
    """Return the average precision of the config's classes by KITTI's rules, at the overlaps of `limits_of`.

    Without a camera, the points in a box define its difficulty. Labels that are `similar` to a class count as the
    class, as in training; those of KITTI's classes are neutral, as in the official program.
    """
    official = {name.lower() for name in LIMITS}
    counted = {
        name.lower(): one.name for one in config.classes if one.name.lower() not in official for name in one.similar
    }
    truths = [
        frame.truth._replace(types=tuple(counted.get(name.lower(), name) for name in frame.truth.types))
        for frame in frames
    ]
    return evaluate(truths, [frame.detections for frame in frames], limits_of(config))


def detect_dataset(
    detector: Detector,
    dataset: Dataset,
    track: Callable[[Sequence[str]], Iterable[str]] = iter,
    *,
    batch_size: int = 1,
) -> list[Scored]:
    """Detect objects in every frame of a data set; in a frame with a camera only those in its view.

    `batch_size` frames are detected at once, while a thread reads the next ones. `track` wraps the iteration over the
    names, for a progress bar. Gives one FormatWarning for each kind of problem with the frames, and one DroppedWarning
    with everything that was dropped, summed over the frames. Raises InputError for a frame that cannot be read or has
    no labels.
    """
    # A program for more frames than there are would only compile longer.
    scored, batch_size = list[Scored](), min(batch_size, len(dataset))
    frames = labelled_frames(dataset, track, ahead=batch_size)
    while batch := list(islice(frames, batch_size)):
        with warnings.catch_warnings():
            # `describe_dropped` sums the same counts over all frames.
            warnings.filterwarnings("ignore", ".*: dropped ", DroppedWarning)
            results = detector(
                [frame.points for frame, _ in batch],
                frustum=[frustum_of(frame.camera) for frame, _ in batch],
                source=[f"Frame {frame.name}" for frame, _ in batch],
                batch_size=batch_size,
            )
        scored += [score_frame(*labelled, result) for labelled, result in zip(batch, results, strict=True)]
    if dropped := describe_dropped(scored):
        warnings.warn(dropped, DroppedWarning, stacklevel=2)
    return scored


def labelled_frames(
    dataset: Dataset, track: Callable[[Sequence[str]], Iterable[str]] = iter, *, ahead: int = 1
) -> Iterator[tuple[Frame, LabelledObjects]]:
    """Yield each frame of a data set and its labels, while a thread reads the next ones.

    Warnings and errors are those of `detect_dataset`.
    """
    found: list[FormatWarning] = []
    reading = read_ahead(dataset.read, range(len(dataset)), ahead)
    for _, take in zip(track(dataset.names), reading, strict=True):
        with collected_warnings() as caught:
            frame = take()
        truth = labels_from_frame(frame)
        found += caught
        yield frame, truth
    give_grouped(found, stacklevel=4)


def describe_dropped(frames: Sequence[Scored]) -> str:
    """Return a sentence that lists what was dropped, summed over the frames; empty if nothing was."""
    dropped = _dropped(frames)
    return f"Dropped {'; '.join(dropped)}." if dropped else ""


def score_frame(frame: Frame, truth: LabelledObjects, result: FrameResult) -> Scored:
    """Prepare a frame of `labelled_frames` and its detections for evaluation."""
    boxes = Boxes.from_array(result.boxes)
    inside = np.asarray(points_in_boxes(frame.points, boxes)).sum(-1)
    if frame.camera is not None:
        rows, kept = result.rows(frame.camera)
        found = detections_from_rows(rows)._replace(points=inside[kept])
        return Scored(frame.name, truth, found, tuple(map(format_row, rows)), result)
    found = DetectedObjects(result.labels, result.scores.astype(np.float64), boxes, points=inside)
    lines = [
        " ".join([*(f"{value:.4f}" for value in box), label, f"{score:.4f}"])
        for box, label, score in zip(result.boxes, result.labels, result.scores, strict=True)
    ]
    return Scored(frame.name, truth, found, tuple(lines), result)


def write_frames(frames: Sequence[Scored], folder: Pathlike) -> None:
    """Write the lines of each frame to `folder/NAME.txt`; a frame without detections gives an empty file."""
    for frame in frames:
        with replacing(Path(folder) / f"{frame.name}.txt") as path:
            path.write_text("".join(f"{line}\n" for line in frame.lines), encoding="utf-8", newline="\n")


def find_trained(workdir: Pathlike) -> Path:
    """Return the path of the first of TRAINED in the folder of a training; raise InputError if there is none."""
    for name in TRAINED:
        if (Path(workdir) / name).is_file():
            return Path(workdir) / name
    raise InputError(f"{workdir} has neither {' nor '.join(TRAINED)}; give the folder of a training with weights.")


def _dropped(frames: Sequence[Scored]) -> list[str]:
    """Return one phrase per reason, with the number dropped in all frames."""
    amounts: dict[str, list[int]] = {}
    for frame in frames:
        counts = frame.result.counts
        lost = {"voxels beyond grid.max_voxels": counts["voxels"]["dropped"]}
        for stage, sites in enumerate(counts["sites"], 1):
            lost[f"sites of backbone stage {stage} beyond its capacity"] = sites["dropped"]
        lost["candidates beyond detection.max_candidates"] = counts["candidates"]["dropped"]
        points = counts["points"]
        lost["points with an impossible intensity"] = points["invalid"]
        lost["points of frames without a point in range"] = 0 if points["in_range"] else points["given"]
        for reason, amount in lost.items():
            amounts.setdefault(reason, []).append(amount)
    return [
        f"{sum(each)} {reason} (in {np.count_nonzero(each)} of {len(each)} frames)"
        for reason, each in amounts.items()
        if any(each)
    ]
