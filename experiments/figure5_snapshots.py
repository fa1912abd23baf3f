"""Figure 5: detections in the camera's image and from above; truth red, detections green.

    python experiments/run.py figure5_snapshots --data KITTI --weights cia_ssd.pth

Six frames, evenly spaced over val. Frames without an image are drawn from above only. Results: README.md.
"""

from __future__ import annotations

import numpy as np
from experiment_report import Report
from measuring import nearest_overlap, target_boxes
from study import Study

from ciassd_jax import Boxes, Detector
from ciassd_jax.formats.kitti_camera import frustum_of
from ciassd_jax.view.bev import plot_bev
from ciassd_jax.view.overlay import plot_overlay
from ciassd_jax.view.sources import find_sources, read_source

FRAMES = 6
MATCHED = 0.5


def run(study: Study) -> Report:
    """Detect in six frames and draw them."""
    config, dataset = study.config, study.validation()
    detector = Detector(study.networks("full", config)[0], config)
    sources = find_sources(study.data, "val") if study.data is not None else {}
    rows, figures = [], {}
    for index in sorted(set(np.linspace(0, len(dataset) - 1, FRAMES).astype(int).tolist())):
        frame = dataset.read(index)
        result, truth = detector(frame.points, frustum=frustum_of(frame.camera)), target_boxes(frame, config)
        found = Boxes.from_array(result.boxes.astype(np.float64))
        overlap = nearest_overlap(truth, found) if len(result) and len(truth.yaw) else np.zeros(len(truth.yaw))
        matched = int((overlap >= MATCHED).sum())
        rows.append({"frame": frame.name, "cars": len(truth.yaw), "detections": len(result), "cars found": matched})
        boxes = result.boxes, np.asarray(truth.to_array()), result.scores, result.labels
        figures[f"{frame.name}_above"] = plot_bev(frame.points, *boxes, title=frame.name)
        source = read_source(sources[frame.name], image=True) if frame.name in sources else None
        if source is not None and source.image is not None and frame.camera is not None:
            figures[f"{frame.name}_image"] = plot_overlay(source.image, frame.camera.calibration, *boxes)
    notes = (f"A car is found if the 3D IoU with its nearest detection is at least {MATCHED}.",)
    return Report("Figure 5: snapshots", rows, notes, figures)
