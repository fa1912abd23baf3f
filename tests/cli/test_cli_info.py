"""`ciassd info`: parameters, arithmetic and memory."""

import json
import re
from pathlib import Path
from typing import Any

from small import small_config

from ciassd_jax import tiny


def test_info_counts_parameters_and_arithmetic(run: Any, weights: Path) -> None:
    result = run("info", "--weights", weights, "--points", 1000, "--json")
    assert (result.code, result.complaints) == (0, "")
    facts = json.loads(result.out)
    assert facts["config"] == json.loads(small_config().to_json())
    # Convolutions, then scale and bias of each BatchNorm; the voxels' 4 numbers come in.
    kernels = [27 * 4 * 4, 27 * 4 * 8, 27 * 8 * 8, 3 * 8 * 8]
    assert facts["parameters"]["backbone"] == sum(kernels) + 2 * (4 + 8 + 8 + 8)
    capacities = [2048, 2048, 2048, 1024]
    assert facts["flops"]["backbone"] == sum(2 * k * n for k, n in zip(kernels, capacities, strict=True))
    # Box, class, direction and IoU of two anchors on 16 channels, on 64 x 64 cells.
    assert facts["parameters"]["head"] == 2 * (7 + 1 + 2 + 1) * 17
    assert facts["flops"]["head"] == 2 * 2 * (7 + 1 + 2 + 1) * 16 * 64 * 64
    full = [9 * 40 * 16, 9 * 16 * 16, 9 * 16 * 16, 16 * 16, 9 * 16 * 16, 9 * 16 * 16, 9 * 16, 9 * 16]
    half = [9 * 16 * 32, 9 * 32 * 32, 9 * 32 * 32, 32 * 32, 9 * 32 * 16, 9 * 32 * 16]
    assert facts["flops"]["neck"] == 2 * 64 * 64 * sum(full) + 2 * 32 * 32 * sum(half)
    for part in ("parameters", "flops"):
        assert facts[part]["total"] == sum(facts[part][name] for name in ("backbone", "neck", "head"))
    assert facts["memory"]["platform"] == "cpu"
    assert min(facts["memory"][name] for name in ("arguments", "outputs", "temporaries")) > 0


def test_info_for_readers_names_the_capacity_and_the_platform(run: Any, weights: Path) -> None:
    result = run("info", "--weights", weights, "--points", 1000)
    assert "at full capacity" in result.out
    assert re.search(r"backbone +\d[\d,]* parameters +\d+\.\d\d GFLOP", result.out)
    assert re.search(r"Compiled for cpu and up to 1000 points: arguments \d+\.\d MB, outputs ", result.out)


def test_info_of_a_preset_needs_no_weights(run: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr("ciassd_jax.inference.cost.compiled_memory", lambda config, points: {"platform": "none"})
    facts = json.loads(run("info", "--preset", "tiny", "--json").out)
    assert facts["config"] == json.loads(tiny().to_json())
