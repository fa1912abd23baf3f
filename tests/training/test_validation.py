"""The numbers that a training writes, and the one that keeps the best weights."""

from dataclasses import replace

import numpy as np
import pytest

from ciassd_jax.config import ClassConfig
from ciassd_jax.config.presets import car
from ciassd_jax.evaluation import DetectedObjects, Evaluation, LabelledObjects, evaluate, limits_of
from ciassd_jax.training.validation import describe_score, format_scores, precisions
from ciassd_jax.types import Boxes

CONFIG = replace(car(), classes=(ClassConfig(name="Car"), ClassConfig(name="Forklift", eval_overlap=0.4)))


def an_evaluation(config, found: dict[str, int], each: int = 41) -> Evaluation:
    """Of each class `each` objects in frames of their own, some of them found exactly."""
    truths, detections = [], []
    for name in found:
        for index in range(each):
            box = Boxes(np.array([[10.0, 0, -1]]), np.array([[4, 1.6, 1.5]]), np.zeros(1))
            truths.append(LabelledObjects((name,), np.zeros(1, int), box))
            kind = name if index < found[name] else "Other"
            detections.append(DetectedObjects((kind,), np.ones(1), box))
    return evaluate(truths, detections, limits_of(config))


def test_every_class_has_its_numbers_and_the_score_is_their_mean() -> None:
    numbers = precisions(an_evaluation(CONFIG, {"car": 41, "Forklift": 20}), CONFIG)
    assert next(iter(numbers)) == "score"
    assert list(numbers)[1:] == [
        "Car_3d_0.70_hard_R40",
        "Car_3d_0.50_hard_R40",
        "Car_bev_0.70_hard_R40",
        "Car_bev_0.50_hard_R40",
        "Forklift_3d_0.40_hard_R40",
        "Forklift_bev_0.40_hard_R40",
    ]
    assert numbers["Car_3d_0.70_hard_R40"] == pytest.approx(100)
    assert 40 < numbers["Forklift_3d_0.40_hard_R40"] < 60
    assert numbers["score"] == pytest.approx((100 + numbers["Forklift_3d_0.40_hard_R40"]) / 2)


def test_a_class_without_detections_counts_as_0() -> None:
    numbers = precisions(an_evaluation(CONFIG, {"Car": 41, "Forklift": 0}), CONFIG)
    assert numbers["Forklift_3d_0.40_hard_R40"] == 0
    assert numbers["score"] == pytest.approx(50)


def test_with_cars_only_the_score_is_theirs() -> None:
    numbers = precisions(an_evaluation(car(), {"Car": 30}), car())
    assert numbers["score"] == numbers["Car_3d_0.70_hard_R40"] > 0


def test_scores_of_checkpoints_are_one_table() -> None:
    numbers = precisions(an_evaluation(CONFIG, {"Car": 41, "Forklift": 0}), CONFIG)
    assert format_scores({8: numbers | {"score": 7.0}, 1000: numbers}).splitlines() == [
        "AP in percent, hard, R40; the score is the mean in 3D",
        "    step   score   Car 3D 0.70   Car BEV 0.70   Forklift 3D 0.40   Forklift BEV 0.40",
        "       8    7.00        100.00         100.00               0.00                0.00",
        "    1000   50.00        100.00         100.00               0.00                0.00   best",
    ]


def test_a_score_in_a_few_words() -> None:
    numbers = precisions(an_evaluation(CONFIG, {"Car": 41, "Forklift": 0}), CONFIG) | {"detections": 9}
    assert describe_score(numbers) == "AP 50.00 (Car 100.00, Forklift 0.00), 9 detections"
