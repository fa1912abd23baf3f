"""Lines on the metrics of a training: for the reader's eye, and those of metrics.jsonl."""

from pathlib import Path

import numpy as np
import pytest

from ciassd_jax.formats.errors import InputError
from ciassd_jax.training.metrics import describe_metrics, read_metrics, summarise

NUMBERS = {
    "loss": 1.23456,
    "classification": 0.5,
    "box": 0.25,
    "direction": 0.125,
    "iou": 0.0625,
    "positives": 33.25,
    "learning_rate": 2.8e-3,
    "skipped": 0.0,
    "seconds": 0.5,
}
LINE = (
    "step  1200/55680  ETA 7h34m  lr 2.8e-03  loss 1.235 (cls 0.5 box 0.25 dir 0.125 iou 0.0625)  positives 33.2"
    "  8 frames/s"
)


def describe(**others: float) -> str:
    return describe_metrics(1200, 55680, NUMBERS | others, scenes=4, remaining=27_240.0)


def test_a_line_fits_a_terminal() -> None:
    assert describe() == LINE
    assert len(LINE) < 130


def test_what_was_dropped_is_a_share_of_what_was_given() -> None:
    points = {"points_given": 950.0, "points_cut": 50.0, "points_dropped": 19.0}
    others = {"boxes_given": 3.0, "boxes_cut": 1.0, "objects_cut": 2.0, "voxels_kept": 100.0, "voxels_dropped": 0.0}
    line = describe(**points, **others, sites_kept=997.0, sites_dropped=3.0)
    assert line == f"{LINE}  dropped points 6.9%, boxes 25%, objects 2, sites 0.3%"


def test_an_optimizer_of_ones_own_has_no_learning_rate() -> None:
    numbers = {name: value for name, value in NUMBERS.items() if name != "learning_rate"}
    line = describe_metrics(1200, 55680, numbers, scenes=4, remaining=27_240.0)
    assert line == LINE.replace("lr 2.8e-03  ", "")


def test_steps_without_positives_and_skipped_updates_are_told() -> None:
    assert "no anchor is positive, so nothing is learned" in describe(positives=0.0)
    assert "no anchor is positive" not in describe()
    assert describe(skipped=3.0) == f"{LINE}  3 updates skipped, not finite"


@pytest.mark.parametrize(
    ("seconds", "text"), [(0, "0s"), (59.6, "1m00s"), (750, "12m30s"), (11_100, "3h05m"), (183_600, "2d03h")]
)
def test_durations_have_two_units(seconds: float, text: str) -> None:
    assert f"ETA {text} " in describe_metrics(1, 9, NUMBERS, scenes=1, remaining=float(seconds))


def test_a_summary_sums_counts_and_takes_the_last_of_states() -> None:
    rows = [{"loss": step, "skipped": step, "sites_kept": 10, "sites_dropped": 2} for step in (1, 2)]
    assert summarise([{name: np.array(value) for name, value in row.items()} for row in rows]) == {
        "loss": 1.5,
        "skipped": 2.0,
        "sites_kept": 20.0,
        "sites_dropped": 4.0,
    }


def test_a_line_that_a_kill_cut_is_left_out(tmp_path: Path) -> None:
    (tmp_path / "metrics.jsonl").write_text('{"step": 2, "loss": null}\n\n{"step": 4, "lo')
    assert read_metrics(tmp_path) == [{"step": 2, "loss": None}]


def test_a_line_of_other_things_than_numbers_is_left_out(tmp_path: Path) -> None:
    (tmp_path / "metrics.jsonl").write_text('{"step": 2, "loss": "low"}\n{"step": 4, "loss": 1.5}\n')
    assert read_metrics(tmp_path) == [{"step": 4, "loss": 1.5}]


def test_a_folder_without_metrics_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has no metrics\.jsonl; give the folder of a training"):
        read_metrics(tmp_path)
    (tmp_path / "metrics.jsonl").write_text("")
    with pytest.raises(InputError, match="has no complete line yet"):
        read_metrics(tmp_path)
