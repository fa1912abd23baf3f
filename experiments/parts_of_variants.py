"""What each switch changes in the network: parameters, FLOPs and parameter trees.

    python experiments/run.py parts_of_variants --preset car

Needs no data and runs nothing. Results: README.md.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import jax
from experiment_report import Report
from plots import plot_bars
from study import Study, with_detection, with_neck, without_iou
from table3_data import ROWS, with_switches

from ciassd_jax import Config, init_variables
from ciassd_jax.inference.cost import PARTS, count_flops, count_parameters


def run(study: Study) -> Report:
    """Make one row per variant of the config."""
    config = study.config
    nothing = dict.fromkeys(filter(None, ROWS.values()), False)
    variants = {
        "the paper's": config,
        "neck: SECOND's": with_neck(config, "second"),
        "neck: SA-SSD's": with_neck(config, "sassd"),
        "no IoU branch": without_iou(config),
        "beta 0": replace(config, detection=with_detection(config, iou_exponent=0.0)),
        "rotated NMS": replace(config, detection=with_detection(config, nms="rotated")),
        "none of Table 3's data": with_switches(config, nothing),
    }
    whole, rows = trees_of(config), []
    for title, variant in variants.items():
        parameters, flops, trees = count_parameters(variant), count_flops(variant), trees_of(variant)
        row: dict[str, Any] = {"variant": title}
        row |= {f"{part}, parameters": parameters[part] for part in PARTS}
        row |= {f"{part}, GFLOP": flops[part] / 1e9 for part in PARTS}
        row["other parameter trees"] = ", ".join(part for part in PARTS if trees[part] != whole[part]) or "none"
        rows.append(row)
    notes = (
        "GFLOP of the convolutions of one scene, the backbone at full capacity. SA-SSD's neck has twice the output "
        "channels, which changes the head's kernels.",
    )
    return Report("What each switch changes", rows, notes, {"": plot_bars(rows, "neck, GFLOP")})


def trees_of(config: Config) -> dict[str, Any]:
    """Return the names, shapes and types of the parameters of each part."""
    params: Any = jax.eval_shape(partial(init_variables, config=config), jax.random.key(0))["params"]
    return {part: jax.tree.map(lambda leaf: (leaf.shape, str(leaf.dtype)), params[part]) for part in PARTS}
