"""The memory of the necks: in the paper, SSFA needs 10 % more than SECOND's neck and SA-SSD's module 27 % more.

    python experiments/run.py memory_of_necks --preset car

The memory that the compiler reserves for temporaries, weights and batch, for `predict` on one cloud and for a training
step of one scene. Needs no data; the programs are compiled but not run. Results: README.md.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from experiment_report import Report
from plots import plot_bars
from study import Study, with_neck

from ciassd_jax import Boxes, Config, GroundTruth, PointCloud, Scene, create_train_state, train_step
from ciassd_jax.inference.cost import compiled_memory, count_flops, count_parameters
from ciassd_jax.inference.detector import SMALLEST_BUCKET

NECKS = {"second": "SECOND's, the baseline", "ssfa": "SSFA", "sassd": "SA-SSD's"}
PAPER = {"second": "+0 %", "ssfa": "+10 %", "sassd": "+27 %"}


def run(study: Study) -> Report:
    """Compile both programs with each neck."""
    rows = []
    for kind, title in NECKS.items():
        config = with_neck(study.config, kind)
        inference = sum(value for value in compiled_memory(config, SMALLEST_BUCKET).values() if isinstance(value, int))
        rows.append(
            {
                "neck": title,
                "parameters": count_parameters(config)["neck"],
                "GFLOP a scene": count_flops(config)["neck"] / 1e9,
                "predict, MB": inference / 1e6,
                "training step, MB": training_memory(config) / 1e6,
                "paper": PAPER[kind],
            }
        )
    for name in ("predict", "training step"):
        for row in rows:
            row[f"{name} more"] = f"{100 * (row[f'{name}, MB'] / rows[0][f'{name}, MB'] - 1):+.0f} %"
    notes = (f"A training step of one scene. Compiled for {jax.default_backend()}; other devices need other amounts.",)
    return Report("Memory of the necks", rows, notes, {"": plot_bars(rows, "training step, MB")})


def training_memory(config: Config) -> int:
    """Return the bytes of a compiled training step of one scene."""
    state = jax.eval_shape(partial(create_train_state, config=config), jax.random.key(0))
    points, boxes = config.data.max_points, config.data.max_boxes

    def scene() -> Scene:
        truth = Boxes(jnp.zeros((1, boxes, 3)), jnp.zeros((1, boxes, 3)), jnp.zeros((1, boxes)))
        none = jnp.zeros(1, jnp.int32)
        labels = GroundTruth(truth, jnp.zeros((1, boxes), jnp.int32), none)
        return Scene(PointCloud(jnp.zeros((1, points, 4)), none), labels, *[none] * (len(Scene._fields) - 2))

    memory: Any = jax.jit(train_step).lower(state, jax.eval_shape(scene), config).compile().memory_analysis()
    return memory.argument_size_in_bytes + memory.output_size_in_bytes + memory.temp_size_in_bytes
