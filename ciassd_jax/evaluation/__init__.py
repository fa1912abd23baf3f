"""Evaluation by KITTI's official rules, in float64 NumPy."""

from ciassd_jax.evaluation.kitti_ap import LIMITS, Limits, limits_of
from ciassd_jax.evaluation.objects import DetectedObjects, LabelledObjects, detections_from_rows, labels_from_rows
from ciassd_jax.evaluation.report import format_block, format_json, format_report, format_tables, to_json
from ciassd_jax.evaluation.result_folders import read_folders
from ciassd_jax.evaluation.summary import Evaluation, evaluate

__all__ = [
    "LIMITS",
    "DetectedObjects",
    "Evaluation",
    "LabelledObjects",
    "Limits",
    "detections_from_rows",
    "evaluate",
    "format_block",
    "format_json",
    "format_report",
    "format_tables",
    "labels_from_rows",
    "limits_of",
    "read_folders",
    "to_json",
]
