"""The cost of a config: parameters, floating-point operations, and memory of the compiled program."""

from __future__ import annotations

from math import prod
from typing import Any

import jax

from ciassd_jax.config import Config
from ciassd_jax.inference.detector import bucket_of
from ciassd_jax.inference.predict import compile_predict
from ciassd_jax.model.network import variable_shapes

PARTS = ("backbone", "neck", "head")


def count_parameters(config: Config) -> dict[str, int]:
    """Return the number of trainable parameters of each part and in total."""
    params = variable_shapes(config)["params"]
    counts = {part: sum(prod(leaf.shape) for leaf in jax.tree.leaves(params[part])) for part in PARTS}
    return counts | {"total": sum(counts.values())}


def count_flops(config: Config) -> dict[str, int]:
    """Return the floating-point operations of one scene's convolutions, by part and in total.

    A multiply-add counts as two. The backbone is counted at full capacity; a scene with fewer sites costs less.
    """
    params = variable_shapes(config)["params"]
    cells = prod(config.bev_shape)
    counts = dict.fromkeys(PARTS, 0)
    for part in PARTS:
        for keys, leaf in jax.tree_util.tree_flatten_with_path(params[part])[0]:
            if keys[-1].key == "kernel":
                counts[part] += 2 * prod(leaf.shape) * _positions(part, keys[0].key, config, cells)
    return counts | {"total": sum(counts.values())}


def _positions(part: str, layer: str, config: Config, cells: int) -> int:
    """Return the number of positions where a layer's kernel is applied."""
    if part == "backbone":
        capacities = config.backbone.capacities(config.grid.max_voxels)
        return capacities[-1] if layer == "out" else capacities[int(layer[len("stage")])]
    # The semantic branch has half the resolution; a transposed convolution applies its kernel once per input cell.
    half = layer.startswith(("semantic_0", "semantic_1", "semantic_2", "semantic_lateral", "upsample"))
    return cells // 4 if half else cells


def compiled_memory(config: Config, num_points: int) -> dict[str, Any]:
    """Return the platform, and the `program_memory` of `predict` for clouds of up to `num_points` points."""
    program = compile_predict(config.for_inference(), bucket_of(num_points))
    return {"platform": jax.default_backend(), **program_memory(program)}


def program_memory(program: jax.stages.Compiled) -> dict[str, int | None]:
    """Return the bytes of arguments, outputs and temporaries of a program; None if the backend does not report them."""
    memory: Any = program.memory_analysis()
    names = {"arguments": "argument", "outputs": "output", "temporaries": "temp"}
    return {name: getattr(memory, f"{field}_size_in_bytes", None) for name, field in names.items()}
