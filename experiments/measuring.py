"""Accuracy of many ways of post-processing from one pass of a network over the frames."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
from tqdm.auto import tqdm

from ciassd_jax import Boxes, Config
from ciassd_jax.anchors import make_anchors
from ciassd_jax.config import DetectionConfig
from ciassd_jax.data.frames import Dataset, Frame
from ciassd_jax.data.scenes import target_labels
from ciassd_jax.detections import select_candidates
from ciassd_jax.detector import ANYWHERE, DroppedWarning, frame_result, pad_to_bucket
from ciassd_jax.evaluation import Evaluation
from ciassd_jax.formats.kitti_camera import view_planes
from ciassd_jax.ops.iou import iou_3d
from ciassd_jax.prediction import postprocess, predict_raw
from ciassd_jax.scoring import describe_dropped, labelled_frames, score_frame, score_frames
from ciassd_jax.types import Candidates, PointCloud, Predictions, Variables

_predict_raw = jax.jit(predict_raw, static_argnames="config")
_postprocess = jax.jit(postprocess, static_argnames="config")


class DecodedBoxes(NamedTuple):
    """Every decoded box of all frames whose class probability reaches the threshold, before any suppression.

    `overlap` is its 3D IoU with the object whose centre is nearest in the plane; boxes of frames without an object
    are left out.
    """

    probability: np.ndarray
    predicted_iou: np.ndarray
    overlap: np.ndarray

    def confidence(self, exponent: float) -> np.ndarray:
        """The rectified confidence, c * iou ** exponent (paper equation 6)."""
        return self.probability * np.abs(self.predicted_iou) ** exponent


def score_settings(
    variables: Variables, config: Config, settings: Mapping[str, DetectionConfig], dataset: Dataset
) -> dict[str, Evaluation]:
    """The evaluation of every setting of the post-processing; all are given the same raw predictions."""
    config = without_training(config)
    scored: dict[str, list] = {name: [] for name in settings}
    for frame, truth, cloud, raw in _raw_predictions(variables, config, dataset):
        planes = ANYWHERE if frame.camera is None else view_planes(frame.camera)
        for name, setting in settings.items():
            batch = _postprocess(raw, cloud, replace(config, detection=setting), frustum=planes[None])
            scored[name].append(score_frame(frame, truth, frame_result(batch, config, 0.0)))
    # Most settings lose the same.
    for dropped in sorted({describe_dropped(frames) for frames in scored.values()} - {""}):
        warnings.warn(dropped, DroppedWarning, stacklevel=2)
    return {name: score_frames(frames) for name, frames in scored.items()}


def decode_all(variables: Variables, config: Config, dataset: Dataset) -> DecodedBoxes:
    """Every decoded box above the score threshold, however many."""
    anchors, labels = make_anchors(config)
    every = replace(config.detection, iou_exponent=0.0, max_candidates=len(labels))

    @jax.jit
    def decode(predictions: Predictions) -> Candidates:
        scene = jax.tree.map(lambda leaf: leaf[0], predictions)
        return select_candidates(scene, anchors, labels, every)[0]

    parts = []
    for frame, _, _, raw in _raw_predictions(variables, config, dataset):
        found: Any = jax.device_get(decode(raw.predictions))
        found = jax.tree.map(lambda leaf, valid=found.valid: leaf[valid], found)
        truth = target_boxes(frame, config)
        if len(truth.yaw):
            overlap = nearest_overlap(Boxes(*(leaf.astype(np.float64) for leaf in found.boxes)), truth)
            parts.append((found.score, found.iou, overlap))
    columns = [np.concatenate(column).astype(np.float64) for column in zip(*parts, strict=True)] if parts else []
    return DecodedBoxes(*(columns or [np.zeros(0)] * 3))


def without_training(config: Config) -> Config:
    """The config without what only training reads, so that all networks of one shape share their programs."""
    plain = Config()
    return replace(config, data=plain.data, loss=plain.loss, schedule=plain.schedule)


def target_boxes(frame: Frame, config: Config) -> Boxes:
    """The objects of a frame that the config's classes stand for."""
    wanted = target_labels(frame, config) >= 0
    return Boxes(*(leaf[wanted] for leaf in frame.boxes))


def nearest_overlap(boxes: Boxes, truth: Boxes) -> np.ndarray:
    """3D IoU of each box with the true one whose centre is nearest in the plane."""
    apart = np.linalg.norm(boxes.center[:, None, :2] - truth.center[None, :, :2], axis=-1)
    nearest = apart.argmin(1)
    return np.asarray(iou_3d(boxes, Boxes(*(leaf[nearest] for leaf in truth))))


def precisions(evaluations: Sequence[Evaluation], name: str = "Car") -> dict[str, list[float]]:
    """AP in percent of one class by measure, one value for each evaluation: the paper's R11 first, then R40."""
    columns = {}
    for title, metric, limit, recall, level in (
        ("3D R11 easy", "3d", 0.7, "R11", 0),
        ("3D R11 moderate", "3d", 0.7, "R11", 1),
        ("3D R11 hard", "3d", 0.7, "R11", 2),
        ("3D R40 moderate", "3d", 0.7, "R40", 1),
        ("BEV R40 moderate", "bev", 0.7, "R40", 1),
        ("3D R40 moderate at 0.5", "3d", 0.5, "R40", 1),
    ):
        values = [evaluation.precision(name, metric, limit, recall) for evaluation in evaluations]  # type: ignore[arg-type]
        columns[title] = [0.0 if value is None else value[level] for value in values]
    return columns


def _raw_predictions(
    variables: Variables, config: Config, dataset: Dataset
) -> Iterator[tuple[Frame, Any, PointCloud, Any]]:
    """The frames with their labels, their padded cloud and what the network says of it."""
    config, variables = without_training(config), jax.device_put(variables)

    def track(names: Sequence[str]) -> Iterable[str]:
        return tqdm(names, unit="frame", leave=False, disable=None)

    for frame, truth in labelled_frames(dataset, track):
        cloud = pad_to_bucket(frame.points)
        yield frame, truth, cloud, _predict_raw(variables, cloud, config)
