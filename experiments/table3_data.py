"""Table 3: the contribution of each step of data preparation.

    python experiments/run.py table3_data --data KITTI --budget 55680 --preset car --seeds 3

As in the paper, the network is the baseline: SECOND's neck, no IoU branch, plain rotated NMS. Every row adds one switch
to the row above: six trainings per seed. Results: README.md.
"""

from __future__ import annotations

from dataclasses import replace

from experiment_report import Report
from measuring import is_too_small, precision_columns, score_settings
from plots import plot_bars
from study import Study, with_detection, with_neck, without_iou

from ciassd_jax import Config

PLOTTED = "3D R40 moderate at 0.5"
ROWS = {
    "nothing": None,
    "+ global flip, rotation, scaling": "global_transform",
    "+ noise on each object": "object_noise",
    "+ pasted objects": "gt_sampling",
    "+ vans count as cars": "similar_classes",
    "+ only easy, moderate and hard objects pasted": "difficulty_filter",
}


def run(study: Study) -> Report:
    """Train and score the switches of each row."""
    baseline = without_iou(with_neck(study.config, "second"))
    config = with_switches(baseline, dict.fromkeys(filter(None, ROWS.values()), False))
    rows = []
    for row, (title, switch) in enumerate(ROWS.items()):
        if switch is not None:
            config = with_switches(config, {switch: True})
        settings = {title: with_detection(config, nms="rotated")}
        networks = study.networks(f"table3-{row}-{switch or 'nothing'}", config)
        found = [score_settings(one, config, settings, study.validation())[title] for one in networks]
        rows.append({"data": title, **precision_columns(found)})
    notes = ["The paper's numbers of this table were not available. Each row adds its switch to the row above."]
    if is_too_small(rows, PLOTTED):
        notes.append(f"No row reaches 1 % in {PLOTTED}: the budget is too small to compare them.")
    return Report("Table 3: the data's preparation", rows, notes, {"": plot_bars(rows, PLOTTED)})


def with_switches(config: Config, switches: dict[str, bool]) -> Config:
    """Return the config with some of Table 3's switches set."""
    augmentation = replace(config.data.augmentation, **switches)
    return replace(config, data=replace(config.data, augmentation=augmentation))
