"""Slow references of augmentation (section 4.1): box after box, with polygons by shapely."""

from __future__ import annotations

import numpy as np
import shapely


def footprint(box: np.ndarray) -> shapely.Polygon:
    """Footprint of (x, y, z, length, width, height, yaw)."""
    x, y, _, length, width, _, yaw = np.asarray(box, np.float64)
    heading, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
    return shapely.Polygon([[x, y] + a * length / 2 * heading + b * width / 2 * left for a, b in signs])


def collide(a: shapely.Polygon, b: shapely.Polygon) -> bool:
    """Whether two polygons share some area."""
    return a.intersection(b).area > 0


def accept_by_loop(
    truth: np.ndarray, boxes: np.ndarray, valid: np.ndarray, wanted: np.ndarray, gt_sampling_up_to: tuple[int, ...]
) -> np.ndarray:
    """Which of the drawn boxes (O, 7) are added to the truth boxes (n, 7)."""
    placed, accepted, start = [footprint(box) for box in truth], np.zeros(len(boxes), bool), 0
    for label, slots in enumerate(gt_sampling_up_to):
        missing = int(wanted[label])
        for _ in range(2):
            draws = [slot for slot in range(start, start + slots) if valid[slot]][:missing]
            while draws:
                draw = draws.pop(0)
                polygon = footprint(boxes[draw])
                if not any(collide(polygon, other) for other in placed + [footprint(boxes[slot]) for slot in draws]):
                    placed.append(polygon)
                    accepted[draw] = True
                    missing -= 1
            start += slots
    return accepted


def inside(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Which points lie strictly inside a box."""
    return (np.abs(box_coordinates(points, box)) < 1).all(-1)


def box_coordinates(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Points along the axes of a box, in half its length, width and height."""
    x, y, z = (np.asarray(points, np.float64)[:, :3] - box[:3]).T
    cosine, sine = np.cos(box[6]), np.sin(box[6])
    return np.stack([x * cosine + y * sine, y * cosine - x * sine, z], -1) / (box[3:6] / 2)


def move_by_loop(
    boxes: np.ndarray, targets: np.ndarray, points: np.ndarray, shifts: np.ndarray, turns: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Boxes (n, 7) and points after the noise, and which boxes moved; tries are (n, T, 3) and (n, T)."""
    boxes = boxes.astype(np.float64)
    moved, places, changed = boxes.copy(), points.astype(np.float64), np.zeros(len(boxes), bool)
    for slot in np.flatnonzero(targets):
        others = [footprint(box) for other, box in enumerate(moved) if other != slot]
        for shift, turn in zip(shifts[slot], turns[slot], strict=True):
            candidate = boxes[slot] + np.concatenate([shift, [0, 0, 0, turn]])
            if not any(collide(footprint(candidate), other) for other in others):
                moved[slot], changed[slot] = candidate, True
                break
    for index, point in enumerate(points):
        owners = [slot for slot in np.flatnonzero(targets) if inside(point[None], boxes[slot])[0]]
        if owners:
            before, after = boxes[owners[0]], moved[owners[0]]
            turn = after[6] - before[6]
            rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
            offset = places[index, :3] - before[:3]
            places[index, :3] = after[:3] + np.concatenate([rotation @ offset[:2], offset[2:]])
    return moved, places, changed
