"""AP against plain loops, by the rules of the official program one at a time, and by its properties."""

import numpy as np
import pytest
from plain_ap import plain_curve
from scenes import Frames, found, label, random_frames, records

from ciassd_jax.evaluation import evaluate
from ciassd_jax.evaluation.kitti_ap import LIMITS, Curve, prepare, trace_curve
from ciassd_jax.formats.kitti_rows import ObjectRow


def curve_of(
    truths: list[ObjectRow], detections: list[ObjectRow], level: int = 0, geometry="bbox", name="Car"
) -> Curve:
    return trace_curve(prepare(*records([(truths, detections)])), name, geometry, LIMITS[name][0], level)


def counts(curve: Curve) -> list[tuple[int, int, int]]:
    """(hits, false positives, missed) at each threshold."""
    return list(zip(curve.true.tolist(), curve.false.tolist(), curve.missed.tolist(), strict=True))


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_agrees_with_plain_loops(seed: int) -> None:
    frames = random_frames(np.random.default_rng(seed), 50)
    evaluand = prepare(*records(frames))
    hits = 0
    for name, limits in LIMITS.items():
        for geometry in ("bbox", "bev", "3d"):
            for limit in limits:
                for level in range(3):
                    curve = trace_curve(evaluand, name, geometry, limit, level)
                    plain = plain_curve(frames, name.lower(), geometry, limit, level)
                    assert curve.num_truths == plain.num_truths
                    assert curve.thresholds.tolist() == plain.thresholds
                    assert counts(curve) == list(zip(plain.true, plain.false, plain.missed, strict=True))
                    np.testing.assert_allclose(curve.similarity, plain.similarity, rtol=0, atol=1e-9)
                    np.testing.assert_array_equal(curve.precision, plain.precision)
                    hits += sum(plain.true)
    assert hits > 1000


@pytest.mark.smoke
@pytest.mark.parametrize("number", [1, 10, 39, 40, 41, 42, 200])
def test_perfect_detections(number: int) -> None:
    """Every object found: the curve has a point for each, 41 at most."""
    truths = [label(place) for place in range(number)]
    detections = [found(row, 1 + place) for place, row in enumerate(truths)]
    evaluation = evaluate(*records([(truths, detections)]))
    for metric in ("bbox", "bev", "3d", "aos"):
        expected = min(number - 1, 40) / 40 * 100
        np.testing.assert_allclose(evaluation.precision("Car", metric, 0.7), [expected] * 3, atol=1e-9)
    assert len(evaluation.curves["Car", "3d", 0.7][0].thresholds) == min(number, 41)


def test_objects_at_the_height_limit_are_ignored() -> None:
    row = label(bbox=(0, 100, 80, 140))
    for level, number in enumerate((0, 1, 1)):
        curve = curve_of([row], [found(row, 1.0)], level)
        assert (curve.num_truths, counts(curve)) == (number, [(1, 0, 0)] * number)


def test_a_low_detection_is_neutral_whatever_its_class() -> None:
    truth = label(bbox=(0, 100, 80, 145))
    low = found(label(name="Pedestrian", bbox=(0, 100, 80, 139.9)), 0.9)
    hit = label(5)
    # The object that the low one takes is neither hit nor missed, yet counts.
    curve = curve_of([truth, hit], [low, found(hit, 0.8)])
    assert (curve.num_truths, counts(curve)) == (2, [(1, 0, 0)])
    # High enough, it is of another class.
    assert counts(curve_of([truth, hit], [low, found(hit, 0.8)], level=1)) == [(1, 0, 1)]


def test_the_first_row_of_neutral_detections_is_taken() -> None:
    first, second = label(bbox=(0, 0, 100, 45)), label(bbox=(14, 0, 114, 45))
    # Both are too low; only the first object overlaps the second one enough.
    low = [found(first, 0.9, bbox=(7, 0, 107, 39)), found(first, 0.9, bbox=(0, 0, 100, 39))]
    hit = label(5)
    assert counts(curve_of([first, second, hit], [*low, found(hit, 0.5)])) == [(1, 0, 1)]
    assert counts(curve_of([first, second, hit], [*low[::-1], found(hit, 0.5)])) == [(1, 0, 0)]


def test_neighbours_and_hard_objects_take_one_detection_each() -> None:
    for neutral in (label(name="Van"), label(occluded=3)):
        other = label(5)
        detections = [found(label(), 0.9), found(label(), 0.8), found(other, 0.5)]
        assert counts(curve_of([neutral, other], detections)) == [(1, 1, 0)]
    assert counts(curve_of([label(name="Truck"), other], detections)) == [(1, 2, 0)]


def test_first_pass_by_score_second_by_overlap() -> None:
    truth = label()
    near, far = found(truth, 0.4), found(truth, 0.9, bbox=(8, 100, 88, 160))
    curve = curve_of([truth], [near, far])
    # The threshold is the better score; at it the other one is not seen.
    assert (curve.thresholds.tolist(), counts(curve)) == ([0.9], [(1, 0, 0)])
    second = label(5)
    curve = curve_of([truth, second], [near, far, found(second, 0.4, alpha=1.0)])
    assert (curve.thresholds.tolist(), counts(curve)) == ([0.9, 0.4], [(1, 0, 1), (2, 1, 0)])
    # Both see the exact one at 0.4: its angle counts, and that of `second` is 0.7 off.
    np.testing.assert_allclose(curve.similarity, [1, 1 + (1 + np.cos(0.7)) / 2])


def test_overlap_must_exceed_the_limit() -> None:
    truth = label(name="Pedestrian", bbox=(0, 0, 50, 100))
    assert counts(curve_of([truth], [found(truth, 1.0, bbox=(0, 0, 50, 50))], name="Pedestrian")) == []
    assert counts(curve_of([truth], [found(truth, 1.0, bbox=(0, 0, 50, 50.01))], name="Pedestrian")) == [(1, 0, 0)]


def test_dont_care_excuses_in_the_image_only() -> None:
    area = label(
        name="DontCare", bbox=(500, 100, 570, 160), dimensions=(-1, -1, -1), location=(-1000, -1000, -1000), alpha=-10.0
    )
    truth, inside = label(), found(label(5), 0.9)
    detections = [found(truth, 0.5), inside]
    assert counts(curve_of([truth, area], detections)) == [(1, 0, 0)]
    assert counts(curve_of([truth, area], detections, geometry="bev")) == [(1, 1, 0)]
    # 0.7 of it must be exceeded.
    assert counts(curve_of([truth, area._replace(bbox=(500, 100, 556, 160))], detections)) == [(1, 1, 0)]


def test_zero_over_zero_is_not_a_number() -> None:
    sitting = label(name="Person_sitting", bbox=(100, 100, 200, 180))
    truth = label(name="Pedestrian", bbox=(140, 100, 240, 180))
    area = label(name="DontCare", bbox=(70, 90, 180, 190))
    first = found(truth, 0.9, bbox=(75, 100, 175, 180))
    second = found(truth, 0.8, bbox=(110, 100, 210, 180))
    evaluation = evaluate(*records([([sitting, truth, area], [first, second])]))
    assert evaluation.precision("Pedestrian", "bbox", 0.5, "R40") == [0, 0, 0]
    assert np.isnan(evaluation.precision("Pedestrian", "bbox", 0.5, "R11")).all()
    assert np.isnan(evaluation.precision("Pedestrian", "aos", 0.5, "R11")).all()


def test_what_is_not_evaluated() -> None:
    car, walker = label(), label(3, "Pedestrian")
    evaluation = evaluate(*records([([car, walker], [found(car, 1.0)])]))
    assert evaluation.precision("Pedestrian", "3d", 0.5) is None
    assert evaluation.precision("Car", "aos", 0.7) is not None
    # A class without labels scores nothing rather than not a number.
    evaluation = evaluate(*records([([car], [found(walker, 1.0)])]))
    assert evaluation.precision("Pedestrian", "3d", 0.5) == [0, 0, 0]
    # One alpha of -10 anywhere, even of a class that nobody asks for.
    evaluation = evaluate(*records([([car], [found(car, 1.0), found(label(4, "Misc"), 1.0, alpha=-10.0)])]))
    assert evaluation.precision("Car", "aos", 0.7) is None
    assert evaluation.precision("Car", "bbox", 0.7) is not None
    # Negative left edges, and what a 2D detector writes.
    evaluation = evaluate(*records([([car], [found(car, 1.0, bbox=(-1.0, 100, 80, 160))])]))
    assert evaluation.precision("Car", "bbox", 0.7) is evaluation.precision("Car", "aos", 0.7) is None
    assert evaluation.precision("Car", "bev", 0.7) is not None
    for changes, bev, space in (
        ({"location": (-1000, -1000, -1000)}, None, None),
        ({"location": (0, -1000, 20)}, [0, 0, 0], None),
        ({"dimensions": (-1, 1.6, 4)}, [0, 0, 0], None),
        ({"dimensions": (1.5, -1.6, 4)}, None, None),
    ):
        evaluation = evaluate(*records([([car], [found(car, 1.0, **changes)])]))
        assert (evaluation.precision("Car", "bev", 0.7), evaluation.precision("Car", "3d", 0.7)) == (bev, space)
    flat = found(car, 1.0, dimensions=(-1, -1, -1), location=(-1000, -1000, -1000), rotation_y=-10)
    evaluation = evaluate(*records([([car], [flat])]))
    assert evaluation.precision("Car", "bev", 0.7) is evaluation.precision("Car", "3d", 0.7) is None
    assert evaluation.precision("Car", "bbox", 0.7) == [0, 0, 0]


def test_orientation() -> None:
    truths = [label(place) for place in range(41)]
    turned = [found(row, 1 + place, alpha=row.alpha + np.pi / 2) for place, row in enumerate(truths)]
    evaluation = evaluate(*records([(truths, turned)]))
    np.testing.assert_allclose(evaluation.precision("Car", "aos", 0.7), [50] * 3)
    np.testing.assert_allclose(evaluation.precision("Car", "bbox", 0.7), [100] * 3)


def every_precision(frames: Frames) -> np.ndarray:
    evaluation = evaluate(*records(frames))
    return np.array([evaluation.precision(*key, recall) for key in evaluation.curves for recall in ("R11", "R40")])


def test_the_order_of_frames_is_irrelevant() -> None:
    frames = random_frames(np.random.default_rng(5), 40)
    np.testing.assert_allclose(every_precision(frames[::-1]), every_precision(frames), atol=1e-9)


def test_a_monotonic_change_of_scores_is_irrelevant() -> None:
    frames = random_frames(np.random.default_rng(6), 40)
    changed = [(truths, [row._replace(score=row.score**3 - 7) for row in rows]) for truths, rows in frames]
    np.testing.assert_array_equal(every_precision(changed), every_precision(frames))


def test_false_detections_never_help() -> None:
    frames = random_frames(np.random.default_rng(7), 40)
    rng = np.random.default_rng(8)
    before = every_precision(frames)
    for score in (-1.0, 0.6, 2.0):
        far = [
            [found(label(50 + rng.integers(9), name), score) for name in ("Car", "Pedestrian", "Cyclist")]
            for _ in frames
        ]
        after = every_precision([(truths, rows + more) for (truths, rows), more in zip(frames, far, strict=True)])
        assert (after <= before + 1e-9).all()
        # Below every threshold they do nothing.
        assert (score > -1) == bool((after < before - 1e-3).any())


def test_precision_is_a_percentage_and_bounds_orientation() -> None:
    frames = random_frames(np.random.default_rng(9), 60)
    evaluation = evaluate(*records(frames))
    for name in LIMITS:
        both = [np.array(evaluation.precision(name, metric, LIMITS[name][0])) for metric in ("aos", "bbox")]
        ordered = np.array([np.zeros(3), *both, np.full(3, 100)])
        assert (np.diff(ordered, axis=0) >= 0).all()
        assert both[1].max() > 5


def test_nothing_at_all() -> None:
    for frames in ([], [([], [])], [([label()], [])]):
        evaluation = evaluate(*records(frames))
        assert set(evaluation.curves.values()) == {None}
    curve = curve_of([], [found(label(), 1.0)])
    assert (curve.num_truths, len(curve.thresholds), curve.precision.sum()) == (0, 0, 0)


def test_lists_that_do_not_fit() -> None:
    truths, detections = records([([label()], [found(label(), 1.0)])] * 2)
    with pytest.raises(ValueError, match="2 frames of labels, 1 of detections; give one for each"):
        evaluate(truths, detections[:1])
    with pytest.raises(ValueError, match="only labels or only detections have image boxes"):
        evaluate(truths, [frame._replace(image_boxes=None) for frame in detections])
    with pytest.raises(ValueError, match="alpha is given for some frames only"):
        evaluate([truths[0], truths[1]._replace(alpha=None)], detections)
