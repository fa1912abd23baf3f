"""Figure 4: confidence against the true overlap, before and after rectification.

    python experiments/run.py figure4_iou_scatter --data KITTI --weights cia_ssd.pth

Each point is a decoded box above the score threshold, before NMS. Its overlap is the 3D IoU with the nearest object.
Results: README.md.
"""

from __future__ import annotations

from experiment_report import Report
from measuring import decode_all
from plots import plot_scatter
from study import Study

from ciassd_jax.evaluation.breakdown import pearson


def run(study: Study) -> Report:
    """Correlate three quantities with the overlap; plot the boxes of the first seed."""
    config, dataset = study.config, study.validation()
    decoded = [decode_all(variables, config, dataset) for variables in study.networks("full", config)]
    exponent = config.detection.iou_exponent
    quantities = {
        "class probability c": [boxes.probability for boxes in decoded],
        "predicted IoU": [boxes.predicted_iou for boxes in decoded],
        f"rectified confidence c * iou^{exponent:g}": [boxes.confidence(exponent) for boxes in decoded],
    }
    rows = [
        {
            "quantity": title,
            "PCC with the 3D overlap": [
                pearson(value, boxes.overlap) for value, boxes in zip(values, decoded, strict=True)
            ],
        }
        for title, values in quantities.items()
    ]
    notes = (f"{sum(len(boxes.overlap) for boxes in decoded):,} boxes of {len(dataset)} frames.",)
    first = {title: values[0] for title, values in quantities.items()}
    figure = plot_scatter(first, decoded[0].overlap)
    return Report("Figure 4: confidence and overlap", rows, notes, {"": figure})
