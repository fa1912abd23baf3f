"""Accuracy of several settings of the post-processing from one pass of the network over the frames."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
from tqdm.auto import tqdm

from ciassd_jax import Boxes, Config
from ciassd_jax.config import DetectionConfig
from ciassd_jax.data.frames import Dataset, Frame
from ciassd_jax.data.scenes import target_labels
from ciassd_jax.evaluation import Evaluation
from ciassd_jax.evaluation.objects import LabelledObjects
from ciassd_jax.formats.errors import DroppedWarning
from ciassd_jax.formats.kitti_camera import view_planes
from ciassd_jax.inference.detector import pad_to_bucket
from ciassd_jax.inference.postprocess import postprocess, select_candidates
from ciassd_jax.inference.results import frame_result
from ciassd_jax.inference.scoring import Scored, describe_dropped, labelled_frames, score_frame, score_frames
from ciassd_jax.model.anchors import make_anchors
from ciassd_jax.model.network import RawPredictions, predict_raw
from ciassd_jax.ops.camera import ANYWHERE
from ciassd_jax.ops.iou import iou_3d
from ciassd_jax.training.validation import precision_of
from ciassd_jax.types import Candidates, Predictions, Variables

_predict_raw = jax.jit(predict_raw)
_postprocess = jax.jit(postprocess)


class DecodedBoxes(NamedTuple):
    """The decoded boxes of all frames whose class probability reaches the threshold, before NMS.

    `overlap` is the 3D IoU with the object whose centre is nearest in the plane. Frames without objects are skipped.
    """

    probability: np.ndarray
    predicted_iou: np.ndarray
    overlap: np.ndarray

    def confidence(self, exponent: float) -> np.ndarray:
        """Return the rectified confidence c * iou ** exponent (paper equation 6)."""
        return self.probability * np.abs(self.predicted_iou) ** exponent


class Predicted(NamedTuple):
    """A frame with its labels and the network's raw predictions."""

    frame: Frame
    truth: LabelledObjects
    raw: RawPredictions


def score_settings(
    variables: Variables, config: Config, settings: Mapping[str, DetectionConfig], dataset: Dataset
) -> dict[str, Evaluation]:
    """Evaluate each setting of the post-processing on the same raw predictions."""
    return _evaluate([_score(one, config, settings) for one in _predictions(variables, config, dataset)], config)


def decode_all(variables: Variables, config: Config, dataset: Dataset) -> DecodedBoxes:
    """Return all decoded boxes above the score threshold, without a limit on their number."""
    return _join([_decode(one, config) for one in _predictions(variables, config, dataset)])


def score_and_decode(
    variables: Variables, config: Config, settings: Mapping[str, DetectionConfig], dataset: Dataset
) -> tuple[dict[str, Evaluation], DecodedBoxes]:
    """Return the results of `score_settings` and `decode_all` from one pass of the network."""
    scored, decoded = [], []
    for one in _predictions(variables, config, dataset):
        scored.append(_score(one, config, settings))
        decoded.append(_decode(one, config))
    return _evaluate(scored, config), _join(decoded)


def _predictions(variables: Variables, config: Config, dataset: Dataset) -> Iterator[Predicted]:
    config, variables = config.for_inference(), jax.device_put(variables)

    def track(names: Sequence[str]) -> Iterable[str]:
        return tqdm(names, unit="frame", leave=False, disable=None)

    for frame, truth in labelled_frames(dataset, track):
        yield Predicted(frame, truth, _predict_raw(variables, pad_to_bucket(frame.points), config))


def _score(one: Predicted, config: Config, settings: Mapping[str, DetectionConfig]) -> dict[str, Scored]:
    config = config.for_inference()
    planes = ANYWHERE if one.frame.camera is None else view_planes(one.frame.camera)
    scored = {}
    for name, setting in settings.items():
        batch = _postprocess(one.raw, replace(config, detection=setting), frustum=planes[None])
        scored[name] = score_frame(
            one.frame, one.truth, frame_result(batch, 0, config.class_names, 0.0, {"clipped": 0, "invalid": 0})
        )
    return scored


def _evaluate(frames: Sequence[Mapping[str, Scored]], config: Config) -> dict[str, Evaluation]:
    scored = {name: [frame[name] for frame in frames] for name in frames[0]}
    # Most settings drop the same: warn once.
    for dropped in sorted({describe_dropped(of_setting) for of_setting in scored.values()} - {""}):
        warnings.warn(dropped, DroppedWarning, stacklevel=3)
    return {name: score_frames(of_setting, config) for name, of_setting in scored.items()}


@jax.jit
def _candidates(predictions: Predictions, config: Config) -> Candidates:
    anchors, labels = make_anchors(config)
    every = replace(config.detection, iou_exponent=0.0, max_candidates=len(labels))
    scene = jax.tree.map(lambda leaf: leaf[0], predictions)
    return select_candidates(scene, anchors, labels, every)[0]


def _decode(one: Predicted, config: Config) -> DecodedBoxes:
    found: Any = jax.device_get(_candidates(one.raw.predictions, config.for_inference()))
    truth = target_boxes(one.frame, config)
    found = jax.tree.map(lambda leaf: leaf[found.valid & (len(truth.yaw) > 0)].astype(np.float64), found)
    overlap = nearest_overlap(found.boxes, truth) if len(found.score) else np.zeros(0)
    return DecodedBoxes(found.score, found.iou, overlap)


def _join(parts: Sequence[DecodedBoxes]) -> DecodedBoxes:
    return DecodedBoxes(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def target_boxes(frame: Frame, config: Config) -> Boxes:
    """Return the objects of a frame that are targets of the config's classes."""
    wanted = target_labels(frame, config) >= 0
    return Boxes(*(leaf[wanted] for leaf in frame.boxes))


def nearest_overlap(boxes: Boxes, truth: Boxes) -> np.ndarray:
    """Return the 3D IoU of each box with the true box whose centre is nearest in the plane."""
    apart = np.linalg.norm(boxes.center[:, None, :2] - truth.center[None, :, :2], axis=-1)
    nearest = apart.argmin(1)
    return np.asarray(iou_3d(boxes, Boxes(*(leaf[nearest] for leaf in truth))))


def precision_columns(evaluations: Sequence[Evaluation], name: str = "Car") -> dict[str, list[float]]:
    """Return the columns of a table: AP in percent of one class, one value per evaluation; the paper's R11 first."""
    measures = {
        "3D R11 easy": ("3d", 0.7, "R11", 0),
        "3D R11 moderate": ("3d", 0.7, "R11", 1),
        "3D R11 hard": ("3d", 0.7, "R11", 2),
        "3D R40 moderate": ("3d", 0.7, "R40", 1),
        "BEV R40 moderate": ("bev", 0.7, "R40", 1),
        "3D R40 moderate at 0.5": ("3d", 0.5, "R40", 1),
    }
    return {
        title: [precision_of(evaluation, name, *measure) for evaluation in evaluations]  # type: ignore[arg-type]
        for title, measure in measures.items()
    }


def is_too_small(rows: Sequence[Mapping[str, Any]], column: str = "3D R40 moderate") -> bool:
    """Return whether no row reaches an AP of 1 % on average over the seeds, too little to compare."""
    return all(sum(row[column]) < len(row[column]) for row in rows)
