"""What each switch changes of the network: parameters, arithmetic, and which parts stay the same.

    python experiments/run.py parts_of_variants --preset car

No data is needed, nothing runs. Results: README.md.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import jax
from plots import plot_bars
from report import Report
from study import Study, with_detection, with_neck, without_iou
from table3_data import ROWS, with_switches

from ciassd_jax import Config, init_variables
from ciassd_jax.inference.cost import PARTS, count_flops, count_parameters


def run(study: Study) -> Report:
    """One row for each variant of the config."""
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
        "GFLOP of one scene's convolutions, the backbone at full capacity. SA-SSD's neck gives twice the channels, and "
        "the head's kernels follow.",
    )
    return Report("What each switch changes", rows, notes, {"": plot_bars(rows, "neck, GFLOP")})


def trees_of(config: Config) -> dict[str, Any]:
    """Names and shapes of the parameters of every part."""
    params: Any = jax.eval_shape(partial(init_variables, config=config), jax.random.key(0))["params"]
    return {part: jax.tree.map(lambda leaf: (leaf.shape, str(leaf.dtype)), params[part]) for part in PARTS}
