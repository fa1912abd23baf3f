"""Table 5: accuracy and correlation against beta, the exponent of the predicted IoU in the confidence.

    python experiments/run.py table5_beta --data KITTI --weights cia_ssd.pth

Without DI-NMS, as in the paper. All values of beta use the same raw predictions. PCC is Pearson's correlation between
the confidence of a decoded box above the score threshold, before NMS, and its 3D IoU with the nearest object. Results:
README.md.
"""

from __future__ import annotations

from experiment_report import Report
from measuring import precision_columns, score_and_decode
from plots import plot_beta
from study import Study, with_detection

from ciassd_jax.evaluation.breakdown import pearson

BETAS = range(7)


def run(study: Study) -> Report:
    """Score the full network with each beta."""
    config, dataset = study.config, study.validation()
    settings = {str(beta): with_detection(config, nms="rotated", iou_exponent=float(beta)) for beta in BETAS}
    networks = study.networks("full", config)
    found, decoded = zip(
        *(score_and_decode(variables, config, settings, dataset) for variables in networks), strict=True
    )
    rows = []
    for beta in BETAS:
        pcc = [pearson(boxes.confidence(beta), boxes.overlap) for boxes in decoded]
        rows.append({"beta": beta, **precision_columns([one[str(beta)] for one in found]), "PCC": pcc})
    notes = [_maximum(rows, "3D R40 moderate"), _maximum(rows, "PCC")]
    notes.append(f"PCC over {sum(len(boxes.overlap) for boxes in decoded):,} boxes. The paper uses beta = 4.")
    return Report("Table 5: beta", rows, notes, {"": plot_beta(rows, "3D R40 moderate")})


def _maximum(rows: list[dict], column: str) -> str:
    """Say where a column is largest, on average over the seeds."""
    means = [sum(row[column]) / len(row[column]) for row in rows]
    best = max(range(len(rows)), key=means.__getitem__)
    return f"{column} is largest at beta = {rows[best]['beta']}: {means[best]:.3f}, against {means[0]:.3f} at beta = 0."
