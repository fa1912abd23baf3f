"""The record that a page shows, and how to build it from frames and scenes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, UInt8

from ciassd_jax.config import Config
from ciassd_jax.data.frames import Frame
from ciassd_jax.formats.kitti_camera import Camera
from ciassd_jax.types import Scene

NO_BOXES = np.zeros((0, 7))
# What tables, pictures and pages say of the scores that they show.
SCORE_MEANING = "score: class probability × predicted IoU⁴, after NMS"  # noqa: RUF001


class ViewFrame(NamedTuple):
    """A frame to view: N points, D detected boxes and G boxes of the ground truth, in the LiDAR frame.

    The first columns of `points` are x, y, z (metres); boxes are x, y, z, length, width, height, yaw. `scores` are None
    for boxes without scores, and labels may be empty. `image` is shown only with a `camera` that projects the boxes.
    `whole` clouds have points that the camera does not see, and that a detector should not get. Boxes of the ground
    truth that are not `is_target` are dimmed; None stands for targets only.
    """

    name: str
    points: Float[np.ndarray, "N columns"]
    boxes: Float[np.ndarray, "D 7"] = NO_BOXES
    scores: Float[np.ndarray, " D"] | None = None
    labels: Sequence[str] = ()
    truth: Float[np.ndarray, "G 7"] = NO_BOXES
    truth_labels: Sequence[str] = ()
    camera: Camera | None = None
    image: UInt8[np.ndarray, "rows columns 3"] | None = None
    whole: bool = False
    is_target: Bool[np.ndarray, " G"] | None = None


def frame_to_view(frame: Frame, image: UInt8[np.ndarray, "rows columns 3"] | None = None) -> ViewFrame:
    """Return the view of a labelled frame, with its objects as the ground truth."""
    truth = np.asarray(frame.boxes.to_array())
    return ViewFrame(frame.name, frame.points, truth=truth, truth_labels=frame.names, camera=frame.camera, image=image)


def mark_targets(frame: ViewFrame, config: Config) -> ViewFrame:
    """Return the frame with the objects that the config learns as targets: those of its classes and similar ones."""
    learned = config.labels_by_name(similar=config.data.augmentation.similar_classes)
    return frame._replace(is_target=np.array([name.lower() in learned for name in frame.truth_labels], bool))


def scene_to_view(scene: Scene, class_names: Sequence[str]) -> list[ViewFrame]:
    """Return the view of a training scene, or of each scene of a batch.

    Padding is left out. Obstacles, whose label is negative, are named "other" and are no targets.
    """
    if np.ndim(scene.frame) == 0:
        scene = jax.tree.map(lambda leaf: np.asarray(leaf)[None], scene)
    frames = []
    for index, frame in enumerate(np.asarray(scene.frame).tolist()):
        one = jax.tree.map(lambda leaf, index=index: np.asarray(leaf)[index], scene)
        real = slice(int(one.truth.count))
        label = one.truth.label[real]
        names = tuple(class_names[number] if number >= 0 else "other" for number in label.tolist())
        points, truth = one.cloud.points[: int(one.cloud.count)], one.truth.boxes.to_array()[real]
        frames.append(ViewFrame(f"frame {frame}", points, truth=truth, truth_labels=names, is_target=label >= 0))
    return frames
