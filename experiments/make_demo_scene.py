"""Make the bundled scene of `ciassd demo`: a street seen by a simulated 64-beam LiDAR. NumPy alone, a few seconds.

    python experiments/make_demo_scene.py

Nothing in it was recorded: boxes for cars, walls and poles on a slightly rough plane, and for every beam the nearest
surface that it meets. The file holds `points` [N, 4] (x, y, z in metres, intensity) and `boxes` [M, 7], the cars
that at least 10 points hit (x, y, z, length, width, height, yaw).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

OUT = Path(__file__).parents[1] / "ciassd_jax" / "bundled" / "scene.npz"
SENSOR_HEIGHT = 1.73
RANGE = 80.0
# Elevations of the beams and azimuths, in degrees: KITTI's scanner, ahead only, about as its camera sees.
ELEVATIONS = np.linspace(2.0, -24.8, 64)
AZIMUTHS = np.arange(-45.0, 45.0, 0.2)
# Standard deviation of the range in metres, and the part of the beams that does not return.
RANGE_NOISE, LOSS = 0.015, 0.06
MINIMUM_POINTS = 10

# x, y, length, width, height, yaw in degrees: the cars, on the ground.
CARS = np.array(
    [
        (8.0, 3.4, 3.9, 1.62, 1.52, 178.0),
        (9.5, -3.6, 4.2, 1.70, 1.48, 2.0),
        (15.6, -3.9, 3.7, 1.60, 1.55, -1.0),
        (17.5, 0.2, 4.1, 1.65, 1.50, 4.0),
        (21.5, -9.0, 3.8, 1.60, 1.53, 92.0),
        (22.0, 4.0, 4.4, 1.74, 1.60, 181.0),
        (28.5, -3.7, 3.6, 1.58, 1.49, 0.0),
        (31.0, 11.5, 4.0, 1.63, 1.52, 65.0),
        (36.0, 3.6, 3.9, 1.61, 1.50, 179.0),
        (44.0, -4.1, 4.3, 1.72, 1.62, -3.0),
        (48.0, 8.5, 3.8, 1.60, 1.50, 120.0),
        (57.0, 3.5, 4.0, 1.64, 1.54, 180.0),
    ]
)
# The same for what is no car: walls of houses along the street, poles, a hedge.
OTHERS = np.array(
    [
        (12.0, 13.0, 22.0, 0.4, 4.5, 0.0),
        (43.0, 16.0, 26.0, 0.4, 5.0, 3.0),
        (19.0, -15.5, 30.0, 0.4, 5.0, 0.0),
        (52.0, -13.0, 24.0, 0.4, 4.0, -4.0),
        (6.0, 7.5, 0.25, 0.25, 4.0, 0.0),
        (25.0, 7.5, 0.25, 0.25, 4.0, 0.0),
        (13.0, -7.5, 0.25, 0.25, 4.0, 0.0),
        (33.0, -7.5, 0.25, 0.25, 4.0, 0.0),
        (40.0, -9.5, 6.0, 1.2, 1.1, 5.0),
    ]
)


def beams() -> np.ndarray:
    """Unit directions [R, 3] of all beams of one scan."""
    elevation, azimuth = np.meshgrid(np.radians(ELEVATIONS), np.radians(AZIMUTHS), indexing="ij")
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1).reshape(-1, 3)


def box_distances(directions: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Distance along each beam to the nearest face of a box, infinity where it misses (the slab method)."""
    center, size, yaw = box[:3], box[3:6], box[6]
    cos, sin = np.cos(yaw), np.sin(yaw)
    rotation = np.array([(cos, sin, 0), (-sin, cos, 0), (0, 0, 1)])
    with np.errstate(divide="ignore"):
        slopes = 1 / (directions @ rotation.T)
    middle = rotation @ center
    near = ((middle - np.copysign(size / 2, slopes)) * slopes).max(1)
    far = ((middle + np.copysign(size / 2, slopes)) * slopes).min(1)
    return np.where((near < far) & (near > 0), near, np.inf)


def standing(rows: np.ndarray) -> np.ndarray:
    """Boxes x, y, z, length, width, height, yaw in the LiDAR frame of rows that stand on the ground."""
    x, y, length, width, height, yaw = rows.T
    yaw = (np.radians(yaw) + np.pi) % (2 * np.pi) - np.pi
    return np.stack([x, y, height / 2 - SENSOR_HEIGHT, length, width, height, yaw], -1)


def make_scene(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and the cars that they hit."""
    rng = np.random.default_rng(seed)
    directions = beams()
    cars, others = standing(CARS), standing(OTHERS)
    with np.errstate(divide="ignore"):
        # Bumps of a centimetre or two.
        ground = -SENSOR_HEIGHT + rng.normal(0, 0.012, len(directions))
        to_ground = np.where(directions[:, 2] < 0, ground / directions[:, 2], np.inf)
    distances = np.stack([to_ground, *(box_distances(directions, box) for box in (*cars, *others))])
    surface, distance = distances.argmin(0), distances.min(0)
    seen = (distance < RANGE) & (rng.random(len(directions)) > LOSS)
    surface, distance, directions = surface[seen], distance[seen], directions[seen]
    # One grey value for each surface, less with the distance.
    grey = np.concatenate([[0.28], rng.uniform(0.15, 0.6, len(cars)), rng.uniform(0.2, 0.45, len(others))])
    intensity = grey[surface] * np.exp(-distance / 120) + rng.normal(0, 0.04, len(distance))
    position = directions * (distance + rng.normal(0, RANGE_NOISE, len(distance)))[:, None]
    points = np.concatenate([position.round(3), intensity.clip(0, 1).round(2)[:, None]], 1).astype(np.float32)
    hits = np.bincount(surface, minlength=len(grey))[1 : 1 + len(cars)]
    return points, cars[hits >= MINIMUM_POINTS]


if __name__ == "__main__":
    points, boxes = make_scene(seed=0)
    np.savez_compressed(OUT, points=points, boxes=boxes.astype(np.float32))
    print(f"Wrote {OUT}: {len(points)} points, {len(boxes)} of {len(CARS)} cars seen.")
