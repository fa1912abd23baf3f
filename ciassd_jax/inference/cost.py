"""What a config costs: parameters, arithmetic, and the memory of the compiled program."""

from __future__ import annotations

from functools import partial
from math import prod
from typing import Any

import jax
import numpy as np

from ciassd_jax.config import Config
from ciassd_jax.inference.detector import Detector
from ciassd_jax.model.network import init_variables

PARTS = ("backbone", "neck", "head")


def count_parameters(config: Config) -> dict[str, int]:
    """Trainable parameters of each part and in all."""
    params = jax.eval_shape(partial(init_variables, config=config), jax.random.key(0))["params"]
    counts = {part: sum(prod(leaf.shape) for leaf in jax.tree.leaves(params[part])) for part in PARTS}
    return counts | {"total": sum(counts.values())}


def count_flops(config: Config) -> dict[str, int]:
    """Floating-point operations of one scene's convolutions, by part and in all.

    Two for each multiply-add. The backbone is counted at full capacity: a real scene costs what it fills.
    """
    params = jax.eval_shape(partial(init_variables, config=config), jax.random.key(0))["params"]
    cells = prod(config.bev_shape)
    counts = dict.fromkeys(PARTS, 0)
    for part in PARTS:
        for keys, leaf in jax.tree_util.tree_flatten_with_path(params[part])[0]:
            if keys[-1].key == "kernel":
                counts[part] += 2 * prod(leaf.shape) * _positions(part, keys[0].key, config, cells)
    return counts | {"total": sum(counts.values())}


def _positions(part: str, layer: str, config: Config, cells: int) -> int:
    """How often a layer's kernel is applied."""
    if part == "backbone":
        capacities = config.backbone.capacities(config.grid.max_voxels)
        return capacities[-1] if layer == "out" else capacities[int(layer[len("stage")])]
    # The semantic branch works at half resolution; a transposed convolution applies its taps once per input.
    half = layer.startswith(("semantic_0", "semantic_1", "semantic_2", "semantic_lateral", "upsample"))
    return cells // 4 if half else cells


def compiled_memory(config: Config, num_points: int) -> dict[str, Any]:
    """Bytes of the compiled `predict` for clouds of up to so many points, and the platform that it was built for."""
    variables = jax.tree.map(
        lambda leaf: np.zeros(leaf.shape, leaf.dtype),
        jax.eval_shape(partial(init_variables, config=config), jax.random.key(0)),
    )
    memory: Any = Detector(variables, config).compile(num_points).memory_analysis()
    # Not every backend reports its memory.
    return {
        "platform": jax.default_backend(),
        "arguments": getattr(memory, "argument_size_in_bytes", None),
        "outputs": getattr(memory, "output_size_in_bytes", None),
        "temporaries": getattr(memory, "temp_size_in_bytes", None),
    }
