"""KITTI's label rows of a synthetic scene: what is visible in the image of the virtual camera, and how much of it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int

from ciassd_jax.formats.kitti_boxes import boxes_to_rows
from ciassd_jax.formats.kitti_camera import Camera, lidar_to_image
from ciassd_jax.formats.kitti_rows import DONT_CARE, ObjectRow
from ciassd_jax.ops.footprints import box_corners
from ciassd_jax.simulation.road_users import KINDS
from ciassd_jax.types import Boxes

# The largest hidden fraction for the occlusions 0 (fully visible), 1 (partly) and 2 (largely occluded).
_HIDDEN = (0.2, 0.55, 0.85)
# A labelled object has at least this many rays, this height in pixels, and this fraction inside the image.
_MIN_RAYS, _MIN_HEIGHT, _MIN_INSIDE = 4, 17.0, 0.05
# Depth in metres below which the pixels of a corner are meaningless.
_NEAREST_DEPTH = 0.5
_DONT_CARE_ROW = ObjectRow(DONT_CARE, -1.0, -1, -10.0, (0, 0, 0, 0), (-1, -1, -1), (-1000, -1000, -1000), -10.0)


def label_rows(
    boxes: Boxes,
    kind: Int[np.ndarray, " O"],
    through: Int[np.ndarray, " O"],
    arriving: Int[np.ndarray, " O"],
    camera: Camera,
    names: tuple[str, ...] = KINDS,
    max_range: float = np.inf,
) -> list[ObjectRow]:
    """Return the label rows of the objects in the image, nearest first; those that are hardly visible are DontCare.

    So are objects with a centre farther than `max_range` metres. `names` are those of the kinds.

    Of the rays `through` a box, the `arriving` ones are not stopped before it. Occlusion is 0, 1 or 2 if at most 20, 55
    or 85 % of them are stopped; an object that is hidden more has no row. Truncation is the fraction of the projected
    box outside the image.
    """
    rows, kept = boxes_to_rows(boxes, np.zeros(len(kind)), [names[index] for index in kind], *camera)
    inside = _part_inside(boxes, rows, kept, camera)
    hidden = 1 - arriving[kept] / np.maximum(through[kept], 1)
    unseen = (arriving < _MIN_RAYS) | (np.linalg.norm(boxes.center, axis=-1) > max_range)
    labelled = []
    order = np.argsort([row.location[2] for row in rows], kind="stable")
    for index in order.tolist():
        row = rows[index]
        x1, y1, x2, y2 = row.bbox
        if hidden[index] > _HIDDEN[-1] or inside[index] < _MIN_INSIDE or x2 - x1 < 2 or y2 - y1 < 2:
            continue
        if unseen[kept[index]] or y2 - y1 < _MIN_HEIGHT:
            labelled.append(_DONT_CARE_ROW._replace(bbox=row.bbox))
            continue
        occluded = int(np.searchsorted(_HIDDEN, hidden[index]))
        alpha = (row.alpha + np.pi) % (2 * np.pi) - np.pi
        labelled.append(row._replace(truncated=1 - inside[index], occluded=occluded, alpha=alpha, score=None))
    return labelled


def _part_inside(
    boxes: Boxes, rows: list[ObjectRow], kept: Int[np.ndarray, " kept"], camera: Camera
) -> Float64[np.ndarray, " kept"]:
    """The fraction of each projected box's area inside the image."""
    corners = box_corners(Boxes(*(leaf[kept] for leaf in boxes)))
    projected = np.concatenate([corners, np.ones_like(corners[..., :1])], -1) @ lidar_to_image(camera.calibration).T
    # A corner beside or behind the camera counts as just in front of it.
    pixels = projected[..., :2] / np.maximum(projected[..., 2:], _NEAREST_DEPTH)
    whole = np.prod(np.ptp(pixels, axis=1), -1)
    bbox = np.array([row.bbox for row in rows]).reshape(-1, 4)
    return np.minimum(np.prod(bbox[:, 2:] - bbox[:, :2], -1) / np.maximum(whole, 1e-9), 1)
