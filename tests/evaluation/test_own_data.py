"""Classes that KITTI does not have, and labels without image boxes."""

from dataclasses import replace

import numpy as np
import pytest
from plain_ap import plain_curve
from scenes import Frames, found, label, random_frames, records

from ciassd_jax.config import ClassConfig
from ciassd_jax.config.presets import car
from ciassd_jax.data.frames import difficulty_by_points
from ciassd_jax.evaluation import LIMITS, Evaluation, evaluate, format_report, format_tables, limits_of, to_json

NO_BOX = (0.0, 0.0, 0.0, 0.0)


def renamed(frames: Frames, old: str, new: str) -> Frames:
    return [
        tuple([row._replace(type=new) if row.type.lower() == old else row for row in rows] for rows in frame)
        for frame in frames
    ]


def without_image_boxes(frames: Frames, share: float = 1.0, box=NO_BOX) -> Frames:
    rng = np.random.default_rng(0)
    return [
        ([row._replace(bbox=box) if rng.random() < share else row for row in rows], found) for rows, found in frames
    ]


def assert_same(one: Evaluation, name: str, other: Evaluation, other_name: str) -> None:
    """The same curves, to the last digit."""
    keys = [key for key in one.curves if key[0] == name]
    assert keys
    for _, metric, limit in keys:
        ours, theirs = one.curves[name, metric, limit], other.curves[other_name, metric, limit]
        assert (ours is None) == (theirs is None)
        for curve, expected in zip(ours or (), theirs or (), strict=True):
            for value, wanted in zip(curve, expected, strict=True):
                np.testing.assert_array_equal(value, wanted)


def test_case_does_not_matter_in_names() -> None:
    frames = records(random_frames(np.random.default_rng(0), 40))
    official = evaluate(*frames)
    shouted = evaluate(*frames, {name.upper(): limits for name, limits in LIMITS.items()})
    for name in LIMITS:
        assert_same(shouted, name.upper(), official, name)
        assert shouted.correlation[name.upper()] == official.correlation[name]
    assert format_tables(shouted).lower() == format_tables(official).lower()


def test_a_class_of_ones_own_is_evaluated_as_cyclists_are() -> None:
    """Cyclists have no neighbours either."""
    frames = random_frames(np.random.default_rng(1), 40)
    own = evaluate(*records(renamed(frames, "cyclist", "Forklift")), {"forklift": (0.5,), "Car": LIMITS["Car"]})
    official = evaluate(*records(frames))
    assert list(to_json(own)) == ["forklift", "Car"]
    assert_same(own, "forklift", official, "Cyclist")
    # What another class is called makes no difference.
    assert_same(own, "Car", official, "Car")
    assert own.precision("forklift", "3d", 0.5)[2] > 1


def test_a_class_of_ones_own_has_no_neighbours() -> None:
    frames = renamed(random_frames(np.random.default_rng(2), 40), "car", "Vehicle")
    curves = evaluate(*records(frames), {"Vehicle": (0.4,)}).curves["Vehicle", "3d", 0.4]
    for level, curve in enumerate(curves):
        plain = plain_curve(frames, "vehicle", "3d", 0.4, level)
        assert (curve.true.tolist(), curve.false.tolist(), curve.missed.tolist()) == (
            plain.true,
            plain.false,
            plain.missed,
        )


def test_limits_of_a_config() -> None:
    classes = (ClassConfig(name="pedestrian"), ClassConfig(name="Forklift", eval_overlap=0.4), ClassConfig(name="Bus"))
    limits = limits_of(replace(car(), classes=classes))
    assert list(limits.items()) == [("pedestrian", (0.5, 0.25)), ("Forklift", (0.4,)), ("Bus", (0.5,))]
    assert limits_of(car()) == {"Car": (0.7, 0.5)}


@pytest.mark.parametrize("limits", [{"Car": ()}, {"Car": (0.7, 0.0)}, {"Car": (2.0,)}, {"Car": (0.7,), "car": (0.5,)}])
def test_limits_that_cannot_be_used(limits: dict[str, tuple[float, ...]]) -> None:
    with pytest.raises(ValueError, match=r"limits: .*(overlaps between 0 and 1|name a class twice)"):
        evaluate([], [], limits)


def test_types_that_are_left_out_are_named() -> None:
    kinds = ["Car", "Van", "vehicle", "Vehicle", "Misc", "DontCare", "Person_sitting"]
    truths = [label(place, name) for place, name in enumerate(kinds)]
    detections = [found(row, 0.5) for row in truths if row.type not in ("Misc", "DontCare")]
    evaluation = evaluate(*records([(truths, detections)]))
    # Labels of neighbours take part.
    assert evaluation.left_out == {"vehicle": (2, 2), "Van": (0, 1), "Misc": (1, 0), "Person_sitting": (0, 1)}
    assert (
        "Not evaluated: 2 labels and 2 detections of vehicle, 1 label of Misc, 1 detection of Van, 1 detection of "
        "Person_sitting."
    ) in format_tables(evaluation)
    of_two = evaluate(*records([(truths, detections)]), {"VEHICLE": (0.5,), "Van": (0.5,)})
    assert of_two.left_out == {"Car": (1, 1), "Person_sitting": (1, 1), "Misc": (1, 0)}
    assert "Not evaluated: " not in format_tables(evaluate(*records([([label()], [found(label(), 1.0)])])))


def test_a_long_name_keeps_the_columns() -> None:
    row = label(name="construction_vehicle")
    text = format_report(evaluate(*records([([row], [found(row, 1.0)])]), {row.type: (0.5,), "Car": (0.7, 0.5)}))
    assert text.startswith(f"{row.type} AP@0.50, 0.50, 0.50:\nbbox AP:9.0909")
    table = text[text.index("AP in percent") :].splitlines()
    assert len({line.index("3d") for line in table if " 3d " in line}) == 1


@pytest.mark.parametrize("box", [NO_BOX, (-1.0, -1.0, -1.0, -1.0), (5.0, 5.0, 5.0, 80.0)])
def test_without_any_image_box_every_label_counts(box: tuple[float, ...]) -> None:
    frames = random_frames(np.random.default_rng(3), 40)
    evaluation = evaluate(*records(without_image_boxes(frames, box=box)))
    truths, detections = records(frames)
    bare = [frame._replace(image_boxes=None, alpha=None, difficulty=0 * frame.difficulty) for frame in truths]
    expected = evaluate(bare, [frame._replace(image_boxes=None, alpha=None) for frame in detections])
    assert not evaluation.has_camera
    for name in LIMITS:
        assert_same(evaluation, name, expected, name)
        assert evaluation.curves[name, "bbox", LIMITS[name][0]] is None
    assert evaluation.precision("Car", "3d", 0.7)[0] > 5
    number = sum(row.type != "DontCare" for rows, _ in frames for row in rows)
    assert f"None of the {number} labels has an image box, so none has KITTI's difficulty: every label counts" in (
        format_tables(evaluation)
    )


def test_without_any_image_box_difficulty_is_by_the_number_of_points() -> None:
    frames = without_image_boxes(random_frames(np.random.default_rng(4), 40))
    rng = np.random.default_rng(5)
    truths, detections = records(frames)
    truths = [frame._replace(points=rng.integers(0, 150, len(frame.types))) for frame in truths]
    evaluation = evaluate(truths, detections)
    graded = [
        frame._replace(difficulty=difficulty_by_points(frame.points), image_boxes=None, alpha=None) for frame in truths
    ]
    expected = evaluate(graded, [frame._replace(image_boxes=None, alpha=None) for frame in detections])
    for name in LIMITS:
        assert_same(evaluation, name, expected, name)
    assert ": difficulty is by the number of points in an object's box," in format_tables(evaluation)


def test_one_image_box_keeps_kittis_rule() -> None:
    """Labels without one have no difficulty then, in frames without any as well."""
    frames = random_frames(np.random.default_rng(6), 40)
    mixed = without_image_boxes(frames[:20]) + frames[20:]
    evaluation = evaluate(*records(mixed))
    assert evaluation.has_camera
    for level, curve in enumerate(evaluation.curves["Car", "3d", 0.7]):
        plain = plain_curve(mixed, "car", "3d", 0.7, level)
        assert (curve.num_truths, curve.true.tolist(), curve.false.tolist()) == (
            plain.num_truths,
            plain.true,
            plain.false,
        )
    number, total = (sum(row.type != "DontCare" for rows, _ in some for row in rows) for some in (frames[:20], frames))
    assert f"\n\n{number} of {total} labels have no image box, so no difficulty: they" in format_tables(evaluation)


def test_detections_without_image_boxes_are_counted() -> None:
    rows = [label(), label(3)]
    text = format_tables(evaluate(*records([(rows, [found(rows[0], 1.0, bbox=NO_BOX), found(rows[1], 0.5)])])))
    assert "\n\n1 of 2 detections have no image box: too low, they do not count." in text
    assert "labels have no image box" not in text


def test_areas_are_no_labels() -> None:
    """An image box of DontCare says nothing of those of the labels."""
    frames = [([label(bbox=NO_BOX), label(3, "DontCare")], [found(label(), 1.0)])]
    assert not evaluate(*records(frames)).has_camera
    assert evaluate(*records([([label(3, "DontCare", bbox=NO_BOX)], [found(label(), 1.0)])])).has_camera


def test_data_without_a_camera_and_without_labels() -> None:
    truths, detections = records([([], [found(label(), 1.0)])])
    bare = [frame._replace(image_boxes=None, alpha=None) for frame in detections]
    evaluation = evaluate([frame._replace(image_boxes=None, alpha=None) for frame in truths], bare)
    assert not evaluation.has_camera
    assert "too low, they do not count" not in format_tables(evaluation)
