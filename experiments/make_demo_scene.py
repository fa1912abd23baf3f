"""Makes the synthetic scene of `ciassd demo`: a 64-beam scan of a street with box-shaped cars, poles and walls.

Command: python experiments/make_demo_scene.py
"""

from pathlib import Path

import numpy as np

SENSOR_HEIGHT = 1.73
OUT = Path(__file__).parents[1] / "ciassd_jax" / "bundled" / "scene.npz"


def cast(directions: np.ndarray, boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance along each ray [R, 3] from the sensor to the nearest box [M, 7] and which one; inf and -1 for none."""
    nearest, which = np.full(len(directions), np.inf), np.full(len(directions), -1)
    for i, (x, y, z, length, width, height, yaw) in enumerate(boxes):
        cosine, sine = np.cos(yaw), np.sin(yaw)
        turn = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
        origin, rays = turn @ -np.array([x, y, z]), directions @ turn.T
        half = np.array([length, width, height]) / 2
        near = (-half * np.sign(rays) - origin) / rays
        far = (half * np.sign(rays) - origin) / rays
        entry, leave = near.max(1), far.min(1)
        hit = (entry > 0) & (entry < leave) & (entry < nearest)
        nearest[hit], which[hit] = entry[hit], i
    return nearest, which


def main() -> None:
    """Scan the street and write points and the cars that at least ten of them hit."""
    rng = np.random.default_rng(0)
    ground = -SENSOR_HEIGHT
    cars = [
        (x, side + rng.normal(0, 0.2), ground + 0.75, rng.normal(3.9, 0.3), rng.normal(1.6, 0.08), 1.5, yaw)
        for side, yaw in ((-5.5, 0.0), (5.5, np.pi))
        for x in np.arange(8, 60, 7.5) + rng.normal(0, 0.5)
    ]
    cars += [(14, 1.6, ground + 0.75, 4.1, 1.65, 1.5, 0.1), (31, -1.8, ground + 0.78, 4.3, 1.7, 1.55, -2.9)]
    walls = [(35, side, ground + 2, 70, 0.5, 4, 0.0) for side in (-14.0, 15.0)]
    poles = [(x, y, ground + 2.5, 0.2, 0.2, 5, 0.0) for x in range(10, 70, 12) for y in (-8.5, 8.5)]
    boxes = np.array(cars + walls + poles)

    elevation = np.deg2rad(np.linspace(2.0, -24.8, 64))
    azimuth = np.deg2rad(np.arange(-45, 45, 0.1728))
    e, a = (grid.ravel() for grid in np.meshgrid(elevation, azimuth, indexing="ij"))
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], 1)
    to_ground = np.where(rays[:, 2] < 0, ground / np.minimum(rays[:, 2], -1e-9), np.inf)
    to_box, which = cast(rays, boxes)
    which[to_ground <= to_box] = -1
    distance = np.minimum(to_ground, to_box)
    seen = (distance < 80) & (rng.random(len(rays)) > 0.1)
    points = rays * (distance + rng.normal(0, 0.015, len(rays)))[:, None]
    intensity = np.where(which < 0, 0.25, np.where(which < len(cars), 0.5, 0.35)) + rng.normal(0, 0.05, len(rays))
    cloud = np.concatenate([points, intensity.clip(0, 1)[:, None]], 1)[seen].astype(np.float32)
    hits = np.bincount(which[seen & (which >= 0)], minlength=len(boxes))[: len(cars)]
    OUT.parent.mkdir(exist_ok=True)
    np.savez_compressed(OUT, points=cloud, boxes=boxes[: len(cars)][hits >= 10].astype(np.float32))
    print(f"Wrote {OUT}: {len(cloud)} points, {(hits >= 10).sum()} of {len(cars)} cars seen.")


if __name__ == "__main__":
    main()
