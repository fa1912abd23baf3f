"""KITTI's labels of a synthetic scene: what the virtual camera's image shows, and how much of it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int

from ciassd_jax.formats.kitti_boxes import boxes_to_rows
from ciassd_jax.formats.kitti_camera import Camera, lidar_to_image
from ciassd_jax.formats.kitti_rows import ObjectRow
from ciassd_jax.ops.footprints import box_corners
from ciassd_jax.simulation.road_users import KINDS
from ciassd_jax.types import Boxes

# Parts of an object that may be hidden for the occlusions 0 (visible), 1 (partly) and 2 (largely).
_HIDDEN = (0.2, 0.55, 0.85)
# An object needs so many rays to be labelled, so many pixels of height, and this part within the image.
_LEAST_RAYS, _LEAST_HEIGHT, _LEAST_INSIDE = 4, 17.0, 0.05
# Nearer than that to the camera's plane a corner's pixels mean nothing.
_NEAREST_DEPTH = 0.5
_DONT_CARE = ObjectRow("DontCare", -1.0, -1, -10.0, (0, 0, 0, 0), (-1, -1, -1), (-1000, -1000, -1000), -10.0)


def label_rows(
    boxes: Boxes,
    kind: Int[np.ndarray, " O"],
    through: Int[np.ndarray, " O"],
    arriving: Int[np.ndarray, " O"],
    camera: Camera,
) -> list[ObjectRow]:
    """Label rows, nearest first, of what is in the image; DontCare for what is too far or hardly in sight.

    Of the rays that go `through` a box those `arriving` are not stopped before it: occlusion is 0, 1 or 2 for up to 20,
    55 and 85 % stopped, and what is hidden more has no row, as nothing of it is in the image. Truncation is the part of
    the projected box outside the image.
    """
    names = [KINDS[index] for index in kind]
    rows, kept = boxes_to_rows(boxes, np.zeros(len(names)), names, *camera)
    inside = _part_inside(boxes, rows, kept, camera)
    hidden = 1 - arriving[kept] / np.maximum(through[kept], 1)
    labelled = []
    order = np.argsort([row.location[2] for row in rows], kind="stable")
    for index in order.tolist():
        row = rows[index]
        x1, y1, x2, y2 = row.bbox
        if hidden[index] > _HIDDEN[-1] or inside[index] < _LEAST_INSIDE or x2 - x1 < 2 or y2 - y1 < 2:
            continue
        if arriving[kept[index]] < _LEAST_RAYS or y2 - y1 < _LEAST_HEIGHT:
            labelled.append(_DONT_CARE._replace(bbox=row.bbox))
            continue
        occluded = int(np.searchsorted(_HIDDEN, hidden[index]))
        alpha = (row.alpha + np.pi) % (2 * np.pi) - np.pi
        labelled.append(row._replace(truncated=1 - inside[index], occluded=occluded, alpha=alpha, score=None))
    return labelled


def _part_inside(
    boxes: Boxes, rows: list[ObjectRow], kept: Int[np.ndarray, " kept"], camera: Camera
) -> Float64[np.ndarray, " kept"]:
    """Which part of each projected box's area lies in the image."""
    corners = box_corners(Boxes(*(leaf[kept] for leaf in boxes)))
    ahead = np.concatenate([corners, np.ones_like(corners[..., :1])], -1) @ lidar_to_image(camera.calibration).T
    # A corner beside or behind the camera counts as just before it.
    pixels = ahead[..., :2] / np.maximum(ahead[..., 2:], _NEAREST_DEPTH)
    whole = np.prod(np.ptp(pixels, axis=1), -1)
    bbox = np.array([row.bbox for row in rows]).reshape(-1, 4)
    return np.minimum(np.prod(bbox[:, 2:] - bbox[:, :2], -1) / np.maximum(whole, 1e-9), 1)
