"""What a page shows of a frame, and how it is made from frames, scenes and the detector's results."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, UInt8

from ciassd_jax.data.frames import Frame
from ciassd_jax.formats.kitti_camera import Camera
from ciassd_jax.types import Scene

NO_BOXES = np.zeros((0, 7))


class ViewFrame(NamedTuple):
    """A frame to look at: N points, D detected boxes and G boxes of the ground truth, in the LiDAR frame.

    `points` hold x, y, z (metres) first; boxes are x, y, z, length, width, height, yaw. `scores` are None for boxes
    that have none, labels may be left out. `image` is shown where there is also a `camera` to project boxes with.
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


def frame_to_view(frame: Frame, image: UInt8[np.ndarray, "rows columns 3"] | None = None) -> ViewFrame:
    """A labelled frame of a data set, its objects as the ground truth."""
    truth = np.asarray(frame.boxes.to_array())
    return ViewFrame(frame.name, frame.points, truth=truth, truth_labels=frame.names, camera=frame.camera, image=image)


def scene_to_view(scene: Scene, class_names: Sequence[str]) -> list[ViewFrame]:
    """A scene as training sees it, or each scene of a batch; without padding, and obstacles labelled "other"."""
    if np.ndim(scene.frame) == 0:
        scene = jax.tree.map(lambda leaf: np.asarray(leaf)[None], scene)
    frames = []
    for index, frame in enumerate(np.asarray(scene.frame).tolist()):
        one = jax.tree.map(lambda leaf, index=index: np.asarray(leaf)[index], scene)
        real = slice(int(one.truth.count))
        labels = tuple(class_names[label] if label >= 0 else "other" for label in one.truth.label[real].tolist())
        points, truth = one.cloud.points[: int(one.cloud.count)], one.truth.boxes.to_array()[real]
        frames.append(ViewFrame(f"frame {frame}", points, truth=truth, truth_labels=labels))
    return frames
