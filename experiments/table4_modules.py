"""Table 4: the contributions of SSFA, confidence rectification and DI-NMS.

    python experiments/run.py table4_modules --data KITTI --budget 55680 --preset car --seeds 3

The baseline has SECOND's neck, no IoU branch and plain rotated NMS. Every row adds one module to the row above. Three
trainings per seed: rectification and NMS only change the post-processing. Results: README.md.
"""

from __future__ import annotations

from experiment_report import Report
from measuring import is_too_small, precision_columns, score_settings
from plots import plot_bars
from study import Study, with_detection, with_neck, without_iou

# Published 3D AP (R11, moderate) of the full method on KITTI's val (paper Table 2); other rows were not available.
PAPER = 79.81
WHOLE = "+ DI-NMS (the paper's)"


def run(study: Study) -> Report:
    """Train the three networks; score the last one with four kinds of post-processing."""
    config = study.config
    plain, rotated = with_detection(config, nms="rotated", iou_exponent=0.0), with_detection(config, nms="rotated")
    networks = {
        "baseline": (without_iou(with_neck(config, "second")), {"baseline: SECOND's neck": plain}),
        "ssfa": (without_iou(config), {"+ SSFA": plain}),
        "full": (
            config,
            {
                "+ IoU branch, confidence as it is": plain,
                "+ rectified confidence": rotated,
                WHOLE: with_detection(config, nms="paper"),
                "... or DI-NMS (the released code's)": with_detection(config, nms="released"),
            },
        ),
    }
    rows = []
    for variant, (network, settings) in networks.items():
        trained = study.networks(variant, network)
        found = [score_settings(variables, network, settings, study.validation()) for variables in trained]
        for title in settings:
            paper = PAPER if title == WHOLE else None
            rows.append(
                {"modules": title, **precision_columns([one[title] for one in found]), "paper, 3D R11 moderate": paper}
            )
    return Report("Table 4: the modules", rows, (judge_order(rows),), {"": plot_bars(rows, "3D R40 moderate")})


def judge_order(rows: list[dict]) -> str:
    """Say whether each row of the paper's table improves on the row above, on average over the seeds."""
    steps = [row for row in rows if not row["modules"].startswith("...")]
    means = [sum(row["3D R40 moderate"]) / len(row["3D R40 moderate"]) for row in steps]
    if is_too_small(steps):
        return "The paper's order is neither confirmed nor refuted: no row reaches 1 %, the budget is too small."
    worse = [row["modules"] for row, mean, before in zip(steps[1:], means[1:], means, strict=False) if mean < before]
    if not worse:
        return "The paper's order is confirmed: no row has a lower 3D R40 moderate than the row above."
    return f"The paper's order is not confirmed: 3D R40 moderate falls with {', '.join(repr(name) for name in worse)}."
