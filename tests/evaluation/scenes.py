"""Rows and random frames for the tests of evaluation."""

from __future__ import annotations

import numpy as np

from ciassd_jax.evaluation import DetectedObjects, LabelledObjects, detections_from_rows, labels_from_rows
from ciassd_jax.formats.kitti_rows import ObjectRow

Frames = list[tuple[list[ObjectRow], list[ObjectRow]]]
NAMES = ["Car", "car", "Van", "Pedestrian", "Person_sitting", "Cyclist", "Truck", "DontCare"]
CHANCES = [0.3, 0.05, 0.1, 0.2, 0.05, 0.2, 0.05, 0.05]
SIZES = {"Car": (1.5, 1.6, 4.0), "Van": (2.0, 1.9, 5.0), "Pedestrian": (1.7, 0.6, 0.8), "Cyclist": (1.7, 0.6, 1.8)}


def label(place: int = 0, name: str = "Car", **changes) -> ObjectRow:
    """An easy object 20 m ahead, 10 m beside that of the place before."""
    row = ObjectRow(
        type=name,
        truncated=0.0,
        occluded=0,
        alpha=0.3,
        bbox=(100.0 * place, 100.0, 100.0 * place + 80, 160.0),
        dimensions=SIZES.get(name, (1.5, 1.6, 4.0)),
        location=(10.0 * place, 1.7, 20.0),
        rotation_y=0.1,
    )
    return row._replace(**changes)


def found(row: ObjectRow, score: float, **changes) -> ObjectRow:
    """The row as a detection."""
    return row._replace(truncated=-1.0, occluded=-1, score=score, **changes)


def records(frames: Frames) -> tuple[list[LabelledObjects], list[DetectedObjects]]:
    """Frames of rows as what `evaluate` takes."""
    return [labels_from_rows(rows) for rows, _ in frames], [detections_from_rows(rows) for _, rows in frames]


def random_frames(rng: np.random.Generator, num_frames: int) -> Frames:
    """Crowded frames with neighbours, DontCare, low objects, repeated rows, equal scores and other spellings."""
    return [_random_frame(rng) for _ in range(num_frames)]


def _random_frame(rng: np.random.Generator) -> tuple[list[ObjectRow], list[ObjectRow]]:
    truths = []
    for place in range(rng.integers(0, 9)):
        name = rng.choice(NAMES, p=CHANCES)
        row = label(place, str(name), alpha=rng.uniform(-3, 3), rotation_y=rng.uniform(-3, 3))
        height = rng.choice([25.0, 30.0, 40.0, 60.0, 60.0])
        # Neighbours are so close that they compete for detections.
        x, left = place // 2 * 8 + rng.normal() * 0.2, place // 2 * 100 + rng.normal() * 5
        row = row._replace(
            bbox=(left, 100.0, left + 80, 100.0 + height),
            location=(x, 1.7 + rng.normal() * 0.05, 20.0),
            rotation_y=place // 2 + rng.normal() * 0.03,
            truncated=float(rng.choice([0, 0, 0, 0.15, 0.2, 0.4, 0.8])),
            occluded=int(rng.choice([0, 0, 0, 1, 2, 3])),
        )
        if name == "DontCare":
            row = row._replace(location=(-1000.0, -1000.0, -1000.0), dimensions=(-1.0, -1.0, -1.0), alpha=-10.0)
        truths.append(row)
    detections = []
    for row in truths:
        for _ in range(rng.integers(0, 4)):
            if row.type == "DontCare":
                row = row._replace(location=(rng.uniform(-40, 40), 1.7, 50.0), dimensions=SIZES["Car"], alpha=0.0)
            moved = np.array(row.bbox) + np.repeat(rng.normal(0, 3, 2), 2)[[0, 2, 1, 3]]
            location = np.array(row.location) + rng.normal(0, [0.1, 0.05, 0.1])
            name = str(rng.choice([row.type] * 4 + ["Car", "Pedestrian", "CYCLIST"]))
            score = float(rng.choice([rng.uniform(0, 1), 0.5, 0.75]))
            changes = {"type": name, "bbox": tuple(moved.tolist()), "location": tuple(location.tolist())}
            detections.append(found(row, score, alpha=row.alpha + rng.normal(), **changes))
    repeated = [row for row in detections if rng.random() < 0.1]
    return truths, detections + repeated
