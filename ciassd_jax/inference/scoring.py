"""A detector over a labelled data set: its detections, their files, and their average precision."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ciassd_jax.data.frames import Dataset, Frame
from ciassd_jax.data.kitti import PLACES
from ciassd_jax.evaluation.objects import DetectedObjects, LabelledObjects, detections_from_rows, labels_from_rows
from ciassd_jax.evaluation.summary import Evaluation, evaluate
from ciassd_jax.formats.errors import DroppedWarning, FormatWarning, InputError, Pathlike
from ciassd_jax.formats.kitti_camera import frustum_of
from ciassd_jax.formats.kitti_rows import DONT_CARE, format_row, read_rows
from ciassd_jax.formats.writing import replacing
from ciassd_jax.inference.detector import Detector
from ciassd_jax.inference.results import FrameResult
from ciassd_jax.ops.footprints import points_in_boxes
from ciassd_jax.types import Boxes

# The weights that training leaves in its folder, the better ones first: best by validation, and of the last step.
TRAINED = ("best.safetensors", "last.safetensors")


class ScoredFrame(NamedTuple):
    """A frame's labels and detections as they are evaluated, and the detections as lines of a file.

    `lines` are rows of the data set's own layout with the score last: KITTI's with a camera (SPEC 11.1), without one
    x, y, z, length, width, height, yaw in the LiDAR frame, and the class. All numbers have 4 decimals.
    """

    name: str
    truth: LabelledObjects
    detections: DetectedObjects
    lines: tuple[str, ...]
    result: FrameResult


def score_dataset(
    detector: Detector, dataset: Dataset, track: Callable[[Sequence[str]], Iterable[str]] = iter
) -> Evaluation:
    """Average precision of a detector on the frames of a data set; as `detect_dataset` and `score_frames`."""
    return score_frames(detect_dataset(detector, dataset, track))


def score_frames(frames: Sequence[ScoredFrame]) -> Evaluation:
    """Average precision by KITTI's rules; without a camera, difficulty is by the number of points in a box."""
    return evaluate([frame.truth for frame in frames], [frame.detections for frame in frames])


def detect_dataset(
    detector: Detector, dataset: Dataset, track: Callable[[Sequence[str]], Iterable[str]] = iter
) -> list[ScoredFrame]:
    """Detect in every frame of a data set, where there is a camera only what it sees.

    `track` sees the names go by, for a progress bar. What the frames lack (FormatWarning) and what the program had to
    drop (DroppedWarning) is summed over all frames and warned of at the end. Raises InputError for a frame
    that cannot be read or has no labels.
    """
    scored: list[ScoredFrame] = []
    for frame, truth in labelled_frames(dataset, track):
        with warnings.catch_warnings():
            # The counts of the results say the same.
            warnings.filterwarnings("ignore", "Dropped ", DroppedWarning)
            result = detector.detect(frame.points, frustum=frustum_of(frame.camera))
        scored.append(score_frame(frame, truth, result))
    if dropped := describe_dropped(scored):
        warnings.warn(dropped, DroppedWarning, stacklevel=2)
    return scored


def labelled_frames(
    dataset: Dataset, track: Callable[[Sequence[str]], Iterable[str]] = iter
) -> Iterator[tuple[Frame, LabelledObjects]]:
    """The frames of a data set, each with the labels that it is scored by; warnings and errors as `detect_dataset`."""
    lacking: dict[str, list[str]] = {}
    for index, _ in enumerate(track(dataset.names)):
        sources = dataset.sources(index)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", FormatWarning)
            frame = dataset.read(index)
            truth = _labels(frame, sources)
        for one in caught:
            if issubclass(one.category, FormatWarning):
                text = str(one.message)
                lacking.setdefault(_kind(text, sources), []).append(text)
            else:
                warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
        yield frame, truth
    for first, *others in lacking.values():
        likewise = f" Other frames likewise: {len(others)}." if others else ""
        warnings.warn(first + likewise, FormatWarning, stacklevel=3)


def describe_dropped(frames: Sequence[ScoredFrame]) -> str:
    """A sentence on what was not used, summed over the frames; empty where nothing was lost."""
    dropped = _dropped(frames)
    return f"Dropped {'; '.join(dropped)}." if dropped else ""


def score_frame(frame: Frame, truth: LabelledObjects, result: FrameResult) -> ScoredFrame:
    """A frame of `labelled_frames` and its detections, made ready for evaluation."""
    boxes = Boxes.from_array(result.boxes)
    inside = np.asarray(points_in_boxes(frame.points, boxes)).sum(-1)
    if frame.camera is not None:
        rows, kept = result.rows(frame.camera)
        found = detections_from_rows(rows)._replace(points=inside[kept])
        return ScoredFrame(frame.name, truth, found, tuple(map(format_row, rows)), result)
    found = DetectedObjects(result.labels, result.scores.astype(np.float64), boxes, points=inside)
    lines = [
        " ".join([*(f"{value:.4f}" for value in box), label, f"{score:.4f}"])
        for box, label, score in zip(result.boxes, result.labels, result.scores, strict=True)
    ]
    return ScoredFrame(frame.name, truth, found, tuple(lines), result)


def write_frames(frames: Sequence[ScoredFrame], folder: Pathlike) -> None:
    """Write the lines of every frame to `folder/NAME.txt`, empty where nothing was detected; each file whole."""
    for frame in frames:
        with replacing(Path(folder) / f"{frame.name}.txt") as path:
            path.write_text("".join(f"{line}\n" for line in frame.lines), encoding="utf-8", newline="\n")


def find_trained(workdir: Pathlike) -> Path:
    """The weights that training left in its folder, the best where there are some; raises InputError without any."""
    for name in TRAINED:
        if (Path(workdir) / name).is_file():
            return Path(workdir) / name
    raise InputError(f"{workdir} has neither {' nor '.join(TRAINED)}; name the folder of a training that saved some.")


def _labels(frame: Frame, sources: Iterable[Path]) -> LabelledObjects:
    """With a camera the rows of the label file as they are, DontCare among them; else the boxes of the frame."""
    inside = np.asarray(points_in_boxes(frame.points, frame.boxes)).sum(-1)
    if frame.camera is None:
        return LabelledObjects(frame.names, frame.difficulty, frame.boxes, points=inside)
    folder = Path(PLACES["label"][0]).parent.name
    path = next((path for path in sources if path.parent.name == folder), None)
    if path is None:
        raise InputError(f"Frame {frame.name} has no labels to compare with; take a split of labelled frames.")
    rows = read_rows(path)
    points = np.zeros(len(rows), np.int64)
    points[[row.type != DONT_CARE for row in rows]] = inside
    return labels_from_rows(rows)._replace(points=points)


def _kind(text: str, sources: Iterable[Path]) -> str:
    """What a warning says whatever the frame: without its files and numbers."""
    for path in sources:
        text = text.replace(str(path), "")
    return re.sub(r"\d[\d.e+]*", "", text)


def _dropped(frames: Sequence[ScoredFrame]) -> list[str]:
    """What was not used, summed over the frames, one phrase for each reason."""
    amounts: dict[str, list[int]] = {}
    for frame in frames:
        counts = frame.result.counts
        lost = {"voxels beyond grid.max_voxels": counts["voxels"]["dropped"]}
        for stage, sites in enumerate(counts["sites"], 1):
            lost[f"sites of backbone stage {stage} beyond its capacity"] = sites["dropped"]
        lost["candidates beyond detection.max_candidates"] = counts["candidates"]["dropped"]
        points = counts["points"]
        lost["points where none is in range"] = 0 if points["in_range"] else points["given"]
        for reason, amount in lost.items():
            amounts.setdefault(reason, []).append(amount)
    return [
        f"{sum(each)} {reason} (in {np.count_nonzero(each)} of {len(each)} frames)"
        for reason, each in amounts.items()
        if any(each)
    ]
