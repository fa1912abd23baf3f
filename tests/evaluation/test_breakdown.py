"""Parts by distance and by number of points, correlation, and data without a camera."""

import numpy as np
import pytest
from scenes import found, label, random_frames, records

from ciassd_jax.evaluation import DetectedObjects, Evaluation, LabelledObjects, evaluate
from ciassd_jax.evaluation.breakdown import Row
from ciassd_jax.evaluation.kitti_ap import average_precision
from ciassd_jax.types import Boxes


def at(distance: float, **changes):
    """A car whose centre is that far ahead."""
    return label(location=(0.0, 1.7, distance), **changes)


def part(rows: list[Row], name: str, geometry: str = "3d") -> Row:
    return next(row for row in rows if (row.part, row.geometry) == (name, geometry))


def test_parts_hold_every_object_once() -> None:
    evaluation = evaluate(*records(random_frames(np.random.default_rng(0), 30)))
    for name, limit in (("Car", 0.7), ("Pedestrian", 0.5), ("Cyclist", 0.5)):
        rows = [row for row in evaluation.by_distance if row.name == name and row.geometry == "bev"]
        assert len(rows) == 3
        for level, curve in enumerate(evaluation.curves[name, "bev", limit]):
            assert sum(row.curves[level].num_truths for row in rows) == curve.num_truths


def test_a_part_counts_its_own_errors_only() -> None:
    truths = [at(distance) for distance in (10.0, 20.0, 39.9, 50.0)]
    false = [at(15.0, bbox=(900, 0, 980, 60)), at(45.0, bbox=(700, 0, 780, 60))]
    detections = [found(row, 0.5 + row.location[2] / 1000) for row in truths] + [found(row, 0.9) for row in false]
    rows = evaluate(*records([(truths, detections)])).by_distance
    assert [part(rows, name).curves[0].num_truths for name in ("0-20 m", "20-40 m", "40+ m")] == [1, 2, 1]
    assert [part(rows, name).curves[0].false.tolist() for name in ("0-20 m", "20-40 m", "40+ m")] == [[1], [0, 0], [1]]


def test_a_detection_beyond_the_border_still_finds_its_object() -> None:
    rows = evaluate(*records([([at(19.95)], [found(at(20.05), 1.0)])])).by_distance
    curve = part(rows, "0-20 m").curves[0]
    assert (curve.num_truths, curve.true.tolist(), curve.false.tolist()) == (1, [1], [0])
    assert len(part(rows, "20-40 m").curves[0].thresholds) == 0


def lidar_frame(points: list[int], score: float = 0.5) -> tuple[LabelledObjects, DetectedObjects]:
    """Cars side by side in the LiDAR frame, each detected exactly."""
    places = np.arange(len(points), dtype=float)
    center = np.stack([np.full(len(points), 15.0), 5 * places, np.full(len(points), -1.0)], -1)
    boxes = Boxes(center, np.tile([4.0, 1.6, 1.5], (len(points), 1)), np.zeros(len(points)))
    names, inside = ("Car",) * len(points), np.array(points)
    difficulty = np.select([inside >= 50, inside >= 20, inside >= 5], [0, 1, 2], -1)
    return (
        LabelledObjects(names, difficulty, boxes, points=inside),
        DetectedObjects(names, score + places / 100, boxes, points=inside),
    )


def test_without_a_camera() -> None:
    """Difficulty is as given, no detection is too low, and image boxes are not used."""
    truth, detected = lidar_frame([3, 10, 30, 60, 200])
    evaluation = evaluate([truth], [detected])
    assert not evaluation.has_camera
    assert [curve.num_truths for curve in evaluation.curves["Car", "3d", 0.7]] == [2, 3, 4]
    assert [curve.true.tolist() for curve in evaluation.curves["Car", "bev", 0.7]] == [[1, 2], [1, 2, 3], [1, 2, 3, 4]]
    assert not any(curve.false.any() for curve in evaluation.curves["Car", "3d", 0.7])
    assert evaluation.curves["Car", "bbox", 0.7] is evaluation.curves["Car", "aos", 0.7] is None


def test_by_points() -> None:
    evaluation = evaluate(*([record] for record in lidar_frame([3, 19, 20, 99, 100])))
    counted = {row.part: [curve.num_truths for curve in row.curves] for row in evaluation.by_points}
    assert counted == {"0-20 points": [0, 0, 1], "20-100 points": [1, 2, 2], "100+ points": [1, 1, 1]}
    np.testing.assert_allclose(
        average_precision(part(evaluation.by_points, "100+ points").curves[0].precision, "R11"), 100 / 11
    )
    truth, detected = lidar_frame([3, 19])
    assert evaluate([truth], [detected._replace(points=None)]).by_points == []


def correlated(scores: list[float], shifts: list[float]) -> Evaluation:
    truths = [label(place, rotation_y=0.0) for place in range(len(shifts))]
    detections = [
        found(row, score, location=(row.location[0] + shift, *row.location[1:]))
        for row, score, shift in zip(truths, scores, shifts, strict=True)
    ]
    # One that overlaps nothing has no overlap to tell.
    return evaluate(*records([(truths, [*detections, found(label(40), 0.99)])]))


def test_correlation() -> None:
    # Shifted by s along a length of 4 the overlap is (4 - s) / (4 + s): 1, 0.6, 1/3.
    shifts = [0.0, 1.0, 2.0]
    overlap = np.array([1, 0.6, 1 / 3])
    assert correlated(list(overlap), shifts).correlation["Car"] == pytest.approx(1, abs=1e-9)
    assert correlated(list(-overlap), shifts).correlation["Car"] == pytest.approx(-1, abs=1e-9)
    assert np.isnan(correlated([0.5, 0.5, 0.5], shifts).correlation["Car"])
    assert np.isnan(correlated([0.5], [0.0]).correlation["Car"])
    assert np.isnan(correlated([0.5, 0.7], [0.0, 1.0]).correlation["Pedestrian"])
