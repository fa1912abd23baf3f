"""Hints that a cloud is not what a config expects."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

Vector = tuple[float, float, float]

_MIN_POINTS = 1000
# No more points are read.
_SAMPLE = 20_000
_MIN_IN_RANGE = 0.1
# Heights of points this near are counted in bins of two steps; the fullest is the ground if it has this share.
_NEAR, _STEP, _MIN_GROUND = 40.0, 0.2, 0.2
# Hills and curbs move the ground of KITTI's frames by up to 0.4 m.
_MAX_GAP = 0.5
# A slope that falls away may have this share of the points below the ground near the sensor.
_MAX_BELOW = 0.3


def describe_cloud(
    points: Float32[np.ndarray, "N 4"], minimum: Vector, maximum: Vector, ground: float, z_shift: float = 0.0
) -> list[str]:
    """Return a sentence with the remedy for each way in which finite points differ from what a config expects.

    Few points lie in the range from `minimum` to `maximum`, or the ground that they show is not at the height
    `ground` where the anchors stand; all in metres in the frame of the points, that is, before `z_shift` is added.
    Fewer than 1000 points give no hint.
    """
    if len(points) < _MIN_POINTS:
        return []
    coordinates = points[:: -(-len(points) // _SAMPLE), :3]
    hints = []
    inside = (
        ((coordinates >= np.array(minimum, np.float32)) & (coordinates < np.array(maximum, np.float32))).all(1).mean()
    )
    if inside < _MIN_IN_RANGE:
        extent = ", ".join(
            f"{axis} {low:g} to {high:g}" for axis, low, high in zip("xyz", minimum, maximum, strict=True)
        )
        hints.append(
            f"Only {100 * inside:.2g} % of the points lie in the range {extent} m; "
            "save metres with x forward and z up, or change grid.minimum and grid.maximum."
        )
    height = _ground_height(coordinates, ground)
    if height is not None and (coordinates[:, 2] < height - _MAX_GAP).mean() > _MAX_BELOW:
        hints.append("Many points lie below what seems to be the ground; save them with z up.")
    elif height is not None and abs(height - ground) > _MAX_GAP:
        hints.append(
            f"The ground seems to be at z = {height:.2f} m, but the anchors stand at {ground:.2f} m; "
            f"pass {z_shift + ground - height:.2f} as `z_shift`."
        )
    return hints


def _ground_height(coordinates: Float32[np.ndarray, "N 3"], ground: float) -> float | None:
    """Return the most frequent height near the sensor, or None if no height is frequent."""
    # A damaged coordinate may be near the largest float32.
    near = np.hypot(coordinates[:, 0], coordinates[:, 1], dtype=np.float64) < _NEAR
    lowest = ground - 10
    heights = coordinates[near & (np.abs(coordinates[:, 2] - ground) < 10), 2]
    if len(heights) < _MIN_POINTS:
        return None
    steps = ((heights - lowest) / _STEP).astype(int)
    counts = np.bincount(steps, minlength=2)
    pairs = counts[:-1] + counts[1:]
    fullest = int(pairs.argmax())
    if pairs[fullest] < _MIN_GROUND * len(heights):
        return None
    return float(np.median(heights[(steps == fullest) | (steps == fullest + 1)]))
