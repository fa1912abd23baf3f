"""Every count, curve and AP of the official evaluator, on real frames and on the edge cases."""

import json
from pathlib import Path

import numpy as np
import pytest

from ciassd_jax.evaluation.kitti_ap import Curve, Evaluand, average_precision, is_evaluated, prepare, trace_curve
from ciassd_jax.evaluation.objects import detections_from_rows, labels_from_rows
from ciassd_jax.formats.kitti_rows import read_results, read_rows

pytestmark = pytest.mark.reference

CASES = [
    "alpha_invalid",
    "class_without_detections",
    "class_without_gt",
    "dontcare_only_frames",
    "dontcare_raw_tracking_columns",
    "empty_label_frames",
    "frames_without_result_file",
    "gt_height_boundary",
    "identical_and_special_rotations",
    "iou_equal_limit",
    "negative_left_edge",
    "neighbour_classes",
    "occlusion_truncation_boundary",
    "orientation_errors",
    "pass1_score_pass2_overlap",
    "perfect_001_gt",
    "perfect_010_gt",
    "perfect_039_gt",
    "perfect_040_gt",
    "perfect_041_gt",
    "perfect_042_gt",
    "row_format",
    "small_det_other_class",
    "small_det_same_class",
    "synthetic_scenes",
    "two_d_only_submission",
    "type_name_case",
    "zero_over_zero_precision",
]
LEVELS = ("easy", "moderate", "hard")


def load(labels: Path, results: Path) -> Evaluand:
    names = sorted(path.name for path in results.iterdir())
    return prepare(
        [labels_from_rows(read_rows(labels / name)) for name in names],
        [detections_from_rows(read_results(results / name).rows) for name in names],
    )


def check_counts(curve: Curve, expected: dict) -> None:
    """Counts exactly; curves, which end with the last threshold or go on with zeros, to 1e-8 of 1."""
    assert curve.num_truths == expected["n_gt"]
    np.testing.assert_array_equal(curve.thresholds, expected["thresholds"])
    for ours, theirs in ((curve.true, "tp"), (curve.false, "fp"), (curve.missed, "fn")):
        np.testing.assert_array_equal(ours, expected[theirs])
    close = {"rtol": 0, "atol": 1e-8}
    precision = np.array(expected["precision"], float)
    np.testing.assert_allclose(curve.precision[: len(precision)], precision, **close)
    if "aos" in expected:
        np.testing.assert_allclose(curve.similarity, expected["similarity"], **close)
        np.testing.assert_allclose(curve.orientation[: len(precision)], np.array(expected["aos"], float), **close)


def check(evaluand: Evaluand, expected: dict, curves: dict, ap: dict, num_truths: dict) -> None:
    for limits, by_class in ap.items():
        for index, (name, by_metric) in enumerate(by_class.items()):
            for metric, values in by_metric.items():
                assert is_evaluated(evaluand.detections, name, metric) == (values is not None), (name, metric)
                if values is None:
                    continue
                geometry = "bbox" if metric == "aos" else metric
                limit = expected["min_overlap"][limits][geometry][index]
                traced = [trace_curve(evaluand, name, geometry, limit, level) for level in range(3)]
                assert [curve.num_truths for curve in traced] == num_truths[name]
                for recall in ("R40", "R11"):
                    ours = [
                        average_precision(c.orientation if metric == "aos" else c.precision, recall) for c in traced
                    ]
                    np.testing.assert_allclose(ours, np.array(values[recall], float), rtol=0, atol=1e-6)
                for level, curve in zip(LEVELS, traced, strict=True):
                    if metric in curves.get(limits, {}).get(name, {}):
                        check_counts(curve, curves[limits][name][metric][level])


@pytest.mark.parametrize("case", CASES)
def test_edge_case(shared: Path, case: str) -> None:
    folder = shared / "kitti_eval" / "edge" / case
    expected = json.loads((folder / "expected.json").read_text())
    evaluand = load(folder / "label_2", folder / "data")
    if case == "gt_height_boundary":
        # Its curves are those of the other rule.
        check(evaluand, expected, {}, expected["ap_devkit_rule"], expected["n_gt_devkit_rule"])
    else:
        check(evaluand, expected, expected["curves"], expected["ap"], expected["n_gt"])


def test_every_edge_case_is_here(shared: Path) -> None:
    assert sorted(path.name for path in (shared / "kitti_eval" / "edge").iterdir()) == CASES


def test_real_frames(shared: Path) -> None:
    folder = shared / "kitti_eval" / "kitti155"
    expected = json.loads((folder / "expected.json").read_text())
    curves = json.loads((folder / "curves.json").read_text())
    evaluand = load(shared / "kitti" / "training" / "label_2", folder / "data")
    check(evaluand, expected, curves, expected["ap"], expected["n_gt"])
