"""The block that scripts parse, the tables and the JSON."""

import json
import re

import numpy as np
from scenes import found, label, random_frames, records

from ciassd_jax.evaluation import Evaluation, evaluate, format_block, format_tables, to_json


def an_evaluation() -> Evaluation:
    return evaluate(*records(random_frames(np.random.default_rng(0), 40)))


def test_the_block() -> None:
    evaluation = an_evaluation()
    blocks = re.findall(
        r"^(\w+) (AP|AP_R40)@(\d\.\d\d), (\d\.\d\d), (\d\.\d\d):\n"
        r"bbox AP:(.+)\nbev  AP:(.+)\n3d   AP:(.+)\naos  AP:(.+)$",
        format_block(evaluation),
        re.MULTILINE,
    )
    titles = [f"{name} {title}@{a}, {b}, {c}" for name, title, a, b, c, *_ in blocks]
    assert titles[:5] == [
        "Car AP@0.70, 0.70, 0.70",
        "Car AP_R40@0.70, 0.70, 0.70",
        "Car AP@0.70, 0.50, 0.50",
        "Car AP_R40@0.70, 0.50, 0.50",
        "Pedestrian AP@0.50, 0.50, 0.50",
    ]
    assert len(titles) == 12
    for name, title, official, limit, _, *lines in blocks:
        recall = "R40" if title == "AP_R40" else "R11"
        for metric, line in zip(("bbox", "bev", "3d", "aos"), lines, strict=True):
            used = float(limit if metric in ("bev", "3d") else official)
            values = evaluation.precision(name, metric, used, recall)
            np.testing.assert_allclose([float(value) for value in line.split(", ")], values, atol=5.1e-5)


def test_the_block_of_what_is_not_evaluated() -> None:
    detection = found(label(), 1.0, bbox=(-1.0, 100, 80, 160))
    block = format_block(evaluate(*records([([label()], [detection])])))
    assert block.splitlines()[:4] == [
        "Car AP@0.70, 0.70, 0.70:",
        "bbox AP:nan, nan, nan",
        "bev  AP:9.0909, 9.0909, 9.0909",
        "3d   AP:9.0909, 9.0909, 9.0909",
    ]
    assert "aos" not in block
    assert "Pedestrian" not in block
    assert format_block(evaluate([], [])) == ""


def test_json_has_every_place() -> None:
    evaluation = an_evaluation()
    written = to_json(evaluation)
    assert json.loads(json.dumps(written, allow_nan=False)) == written
    assert list(written) == ["Car", "Pedestrian", "Cyclist"]
    for name, limits in (("Car", ["0.70", "0.50"]), ("Pedestrian", ["0.50", "0.25"]), ("Cyclist", ["0.50", "0.25"])):
        assert sorted(written[name]) == ["3d", "aos", "bbox", "bev"]
        for metric, by_recall in written[name].items():
            assert sorted(by_recall) == ["R11", "R40"]
            for recall, by_limit in by_recall.items():
                assert list(by_limit) == (limits if metric in ("bev", "3d") else limits[:1])
                for limit, values in by_limit.items():
                    assert values == evaluation.precision(name, metric, float(limit), recall)


def test_json_has_null_for_what_is_no_number() -> None:
    rows = [label(name="Person_sitting", bbox=(100, 100, 200, 180)), label(name="DontCare", bbox=(70, 90, 180, 190))]
    truth = label(name="Pedestrian", bbox=(140, 100, 240, 180))
    results = [found(truth, 0.9, bbox=(75, 100, 175, 180)), found(truth, 0.8, bbox=(110, 100, 210, 180))]
    written = to_json(evaluate(*records([([rows[0], truth, rows[1]], results)])))
    assert written["Pedestrian"]["bbox"] == {"R11": {"0.50": [None] * 3}, "R40": {"0.50": [0.0] * 3}}
    assert written["Car"]["3d"] == {"R11": {"0.70": None, "0.50": None}, "R40": {"0.70": None, "0.50": None}}
    json.dumps(written, allow_nan=False)


def test_the_tables() -> None:
    evaluation = an_evaluation()
    text = format_tables(evaluation)
    easy, moderate, hard = evaluation.precision("Car", "3d", 0.7)
    assert re.search(rf"^Car +3d +0\.70 +{easy:.2f} +{moderate:.2f} +{hard:.2f} ", text, re.MULTILINE)
    number = evaluation.by_distance[1].curves[2].num_truths
    assert re.search(rf"^Car +bev +20-40 m .* {number}$", text, re.MULTILINE)
    assert f"Car {evaluation.correlation['Car']:.3f}" in text
    assert "By number of points" not in text
    assert "Nothing by number of points" in text
    assert "fewer than 41 cannot reach 100" in text


def test_enough_objects_need_no_word() -> None:
    rows = [label(place % 5, location=(4.0 * (place % 5), 1.7, 10.0 + 20 * (place // 50))) for place in range(150)]
    frames = [([row], [found(row, 1.0)]) for row in rows]
    assert "fewer than 41" not in format_tables(evaluate(*records(frames)))


def test_a_part_without_objects_has_no_ap() -> None:
    text = format_tables(evaluate(*records([([label()], [found(label(), 1.0)])])))
    assert re.search(r"^Car +3d +20-40 m +0\.00 +0\.00 +0\.00 +1 +1 +1$", text, re.MULTILINE)
    assert re.search(r"^Car +3d +40\+ m +- +- +- +0 +0 +0$", text, re.MULTILINE)


def test_without_a_camera_the_report_says_so() -> None:
    truths, detections = records([([label()], [found(label(), 1.0)])])
    truths = [frame._replace(image_boxes=None, alpha=None, points=np.array([70])) for frame in truths]
    detections = [frame._replace(image_boxes=None, alpha=None, points=np.array([70])) for frame in detections]
    evaluation = evaluate(truths, detections)
    text = format_tables(evaluation)
    assert "None of the 1 labels has an image box" in text
    assert ": difficulty is by the number of points in an object's box," in text
    assert re.search(r"^Car +3d +20-100 points ", text, re.MULTILINE)
    assert "Nothing by number of points" not in text
    assert to_json(evaluation)["Car"]["bbox"]["R40"] == {"0.70": None}


def test_orientation_that_is_off_is_said() -> None:
    rows = [label(), label(3)]
    text = format_tables(evaluate(*records([(rows, [found(rows[0], 1.0), found(rows[1], 0.5, alpha=-10.0)])])))
    assert "Orientation (aos) is not evaluated" in text
    assert not re.search(r"^Car +aos", text, re.MULTILINE)
