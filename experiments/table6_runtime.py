"""Table 6: the time per frame, in three parts.

    python experiments/run.py table6_runtime --data KITTI --weights WEIGHTS

Batch 1, five runs over the same frames, the median frame of each run. Pre-processing pads and voxelises the cloud, the
network maps voxels to raw predictions, post-processing decodes, rectifies, suppresses and filters. Each part is a
compiled program of its own; the last row is `predict`, which runs all of them as one program. Results: README.md.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import jax
import numpy as np
from experiment_report import Report
from plots import plot_bars
from study import Study

from ciassd_jax import Config, PointCloud
from ciassd_jax.data.frames import Frame
from ciassd_jax.formats.kitti_camera import view_planes
from ciassd_jax.inference.detector import pad_to_bucket
from ciassd_jax.inference.postprocess import postprocess
from ciassd_jax.inference.predict import predict
from ciassd_jax.model.network import predict_voxels, voxelize_batch
from ciassd_jax.ops.camera import ANYWHERE
from ciassd_jax.types import Variables

# Milliseconds per frame on a GPU.
PAPER = {"pre-processing": 2.84, "network": 24.33, "post-processing": 3.59}
FRAMES, RUNS = 20, 5


def run(study: Study) -> Report:
    """Time the parts on up to twenty frames."""
    config, dataset = study.config, study.validation()
    frames = [dataset.read(index) for index in range(min(FRAMES, len(dataset)))]
    parts = parts_of(study.networks("full", config)[0], config)
    runs = [[parts(frame) for frame in frames] for _ in range(RUNS + 1)]
    # The first run includes compilation.
    medians = {part: [float(np.median([one[part] for one in run])) for run in runs[1:]] for part in runs[0][0]}
    whole = medians.pop("whole in one program")
    medians["sum"] = [sum(values) for values in zip(*medians.values(), strict=True)]
    medians["whole in one program"] = whole
    paper: dict[str, float] = PAPER | {"sum": round(sum(PAPER.values()), 2)}
    rows = [{"part": part, "milliseconds": values, "paper": paper.get(part)} for part, values in medians.items()]
    notes = [
        f"Median of {len(frames)} frames, mean and range of {RUNS} runs, batch 1.",
        "The paper measured `car()` on a GPU; the machine used here is below.",
    ]
    return Report("Table 6: run time", rows, notes, {"": plot_bars(rows, "milliseconds")})


def parts_of(variables: Variables, config: Config) -> Callable[[Frame], dict[str, float]]:
    """Return a function that measures the milliseconds of each part on a frame."""
    variables = jax.device_put(variables)
    voxelize = jax.jit(partial(voxelize_batch, config=config))
    network = jax.jit(partial(predict_voxels, config=config))
    finish = jax.jit(partial(postprocess, config=config))
    whole = jax.jit(partial(predict, config=config))

    def measure(frame: Frame) -> dict[str, float]:
        planes = (ANYWHERE if frame.camera is None else view_planes(frame.camera))[None]
        start = time.perf_counter()
        cloud: PointCloud = pad_to_bucket(frame.points)
        voxels = jax.block_until_ready(voxelize(cloud))
        voxelized = time.perf_counter()
        raw = jax.block_until_ready(network(variables, voxels))
        predicted = time.perf_counter()
        jax.device_get(finish(raw, frustum=planes))
        finished = time.perf_counter()
        jax.device_get(whole(variables, pad_to_bucket(frame.points), frustum=planes))
        ended = time.perf_counter()
        seconds = voxelized - start, predicted - voxelized, finished - predicted, ended - finished
        return dict(zip((*PAPER, "whole in one program"), (1e3 * part for part in seconds), strict=True))

    return measure
