"""Scores of weights in training: average precision on a data set, and how many objects are found."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from ciassd_jax.config import Config
from ciassd_jax.data.frames import Dataset
from ciassd_jax.data.scenes import target_labels
from ciassd_jax.evaluation import Evaluation, format_json, format_report, limits_of
from ciassd_jax.evaluation.kitti_ap import Metric, Recall
from ciassd_jax.formats.errors import Pathlike
from ciassd_jax.formats.kitti_camera import frustum_of
from ciassd_jax.formats.kitti_rows import DIFFICULTIES
from ciassd_jax.formats.writing import write_text
from ciassd_jax.inference.detector import Detector
from ciassd_jax.inference.scoring import detect_dataset, score_dataset, score_frames, write_frames
from ciassd_jax.ops.iou import iou_3d
from ciassd_jax.training.checkpoint import checkpoint_steps, checkpoint_variables
from ciassd_jax.types import Boxes, Variables


def score_weights(
    state_or_variables: Variables, dataset: Dataset, config: Config, folder: Pathlike
) -> dict[str, float]:
    """Return `precisions` of the weights and the number of their detections.

    Writes result.json, table.txt and data/NAME.txt per frame to `folder`.
    """
    frames = detect_dataset(Detector(state_or_variables, config), dataset)
    evaluation = score_frames(frames, config)
    folder = Path(folder)
    write_frames(frames, folder / "data")
    write_text(folder / "result.json", format_json(evaluation))
    write_text(folder / "table.txt", format_report(evaluation))
    return precisions(evaluation, config) | {"detections": sum(len(frame.result) for frame in frames)}


def score_checkpoints(
    workdir: Pathlike,
    dataset: Dataset,
    config: Config,
    track: Callable[[Sequence[str]], Iterable[str]] = iter,
    *,
    batch_size: int = 1,
) -> dict[int, dict[str, float]]:
    """Return `precisions` of every checkpoint in the folder of a training, by step.

    `track` wraps the iteration over the frames of each, for a progress bar. Raises InputError if there is no
    checkpoint, and for one that cannot be read.
    """
    folder = Path(workdir) / "checkpoints"
    # All at once, because a running training removes checkpoints.
    weights = {step: checkpoint_variables(folder, step) for step in checkpoint_steps(folder)}
    return {
        step: precisions(score_dataset(Detector(variables, config), dataset, track, batch_size=batch_size), config)
        for step, variables in weights.items()
    }


def format_scores(scores: Mapping[int, Mapping[str, float]]) -> str:
    """Return a table of `score_checkpoints`: one row per step, with AP of each class at its strict limit."""
    strict = _strict_names(next(iter(scores.values())))
    titles = {"score": "score"} | {
        name: f"{kind} {metric.upper()} {name.split('_')[-3]}" for (kind, metric), name in strict.items()
    }
    best = max(scores, key=lambda step: scores[step]["score"])
    lines = [f"{'step':>8}" + "".join(f"{title:>{len(title) + 3}}" for title in titles.values())]
    for step, numbers in scores.items():
        row = "".join(f"{numbers[name]:>{len(title) + 3}.2f}" for name, title in titles.items())
        lines.append(f"{step:>8}{row}{'   best' if step == best else ''}")
    level, recall = next(iter(strict.values())).split("_")[-2:]
    return "\n".join([f"AP in percent, {level}, {recall}; the score is the mean in 3D", *lines])


def precisions(evaluation: Evaluation, config: Config) -> dict[str, float]:
    """Return AP R40 in percent, in 3D and BEV at the limits of every class, after "score".

    The score is the mean over the classes in 3D at the strict limit. The level is moderate by KITTI's difficulty, and
    hard, which has all but the emptiest objects, where the number of points is the difficulty. AP is 0 if nothing was
    detected, where KITTI's program prints nothing.
    """
    limits, level = limits_of(config), 1 if evaluation.difficulty == "kitti" else 2
    metrics: tuple[Metric, ...] = ("3d", "bev")
    numbers = {
        f"{name}_{metric}_{limit:.2f}_{DIFFICULTIES[level].name}_R40": precision_of(
            evaluation, name, metric, limit, level=level
        )
        for name, of_class in limits.items()
        for metric in metrics
        for limit in of_class
    }
    strict = [precision_of(evaluation, name, "3d", of_class[0], level=level) for name, of_class in limits.items()]
    return {"score": sum(strict) / len(strict)} | numbers


def describe_score(numbers: Mapping[str, float]) -> str:
    """Return the score of `score_weights`, its part of each class, and the number of detections, in a few words."""
    strict = _strict_names(numbers)
    classes = ", ".join(f"{kind} {numbers[name]:.2f}" for (kind, metric), name in strict.items() if metric == "3d")
    return f"AP {numbers['score']:.2f} ({classes}), {numbers['detections']:.0f} detections"


def _strict_names(numbers: Mapping[str, float]) -> dict[tuple[str, str], str]:
    """Return the names of `precisions` at the strict limit, by class and metric."""
    names: dict[tuple[str, str], str] = {}
    for name in numbers:
        kind, *parts = name.rsplit("_", 4)
        if len(parts) == 4:
            # The strict limit of a class comes first.
            names.setdefault((kind, parts[0]), name)
    return names


def precision_of(
    evaluation: Evaluation, name: str, metric: Metric, limit: float, recall: Recall = "R40", level: int = 1
) -> float:
    """Return AP in percent at a level of difficulty (0 easy, 1 moderate, 2 hard); 0 if nothing was evaluated."""
    levels = evaluation.precision(name, metric, limit, recall)
    return 0.0 if levels is None else float(np.nan_to_num(levels[level]))


def count_found(
    variables: Variables, dataset: Dataset, config: Config, *, hardest: int | None = None
) -> tuple[int, int]:
    """Return (found, targets): how many targets in all frames are found, with their class and enough 3D IoU.

    The IoU must reach the strict limit of the class in evaluation. Targets are the labelled objects of a configured
    class whose centre lies in the grid, with `hardest` only those of KITTI's difficulties up to it (0 easy, 1 moderate,
    2 hard).
    """
    detector, found, targets = Detector(variables, config), 0, 0
    low, high = map(np.array, config.range)
    limits = [of_class[0] for of_class in limits_of(config).values()]
    for index in range(len(dataset)):
        frame = dataset.read(index)
        result = detector(frame.points, frustum=frustum_of(frame.camera))
        boxes = Boxes.from_array(result.boxes.astype(np.float64))
        label = target_labels(frame, config)
        center = frame.boxes.center
        wanted = (label >= 0) & ((center >= low) & (center <= high)).all(-1)
        if hardest is not None:
            wanted &= (frame.difficulty >= 0) & (frame.difficulty <= hardest)
        for row in np.flatnonzero(wanted):
            overlap = iou_3d(Boxes(*(leaf[row][None] for leaf in frame.boxes)), boxes)
            same = np.array([name == config.class_names[label[row]] for name in result.labels], bool)
            found += bool((same & (overlap >= limits[label[row]])).any())
            targets += 1
    return found, targets
