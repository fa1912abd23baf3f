"""`ciassd info`: what a config is and costs."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ciassd_jax.cli.options import Preset, Unset, load_as
from ciassd_jax.config import Config
from ciassd_jax.config.presets import PRESETS
from ciassd_jax.inference import cost


@dataclass(frozen=True)
class Info:
    """Show a config, its parameters, its floating-point operations and the memory of the compiled program."""

    preset: Unset[Preset] = None
    """A preset; `car` if neither a preset nor weights are given."""
    weights: Unset[Path] = None
    """Show the config of this weights file, or of the bundled weights of this name."""
    points: int = 20000
    """Points per cloud that the program is compiled for."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        config = load_as(self.weights, self.preset).config if self.weights else PRESETS[self.preset or "car"]()
        facts = {
            "config": json.loads(config.to_json()),
            "parameters": cost.count_parameters(config),
            "flops": cost.count_flops(config),
            "memory": cost.compiled_memory(config, self.points),
        }
        print(json.dumps(facts) if self.json else _describe(config, facts, self.points))
        return 0


def _describe(config: Config, facts: dict[str, Any], points: int) -> str:
    """The facts as text."""
    lines = [config.to_json()]
    for part, count in facts["parameters"].items():
        lines.append(f"{part:<10} {count:>12,} parameters  {facts['flops'][part] / 1e9:>8.2f} GFLOP")
    lines.append("FLOPs are one scene's convolutions with the backbone at full capacity; real scenes need fewer.")
    memory = facts["memory"]
    sizes = ", ".join(
        f"{name} unknown" if memory[name] is None else f"{name} {memory[name] / 1e6:.1f} MB"
        for name in ("arguments", "outputs", "temporaries")
    )
    lines.append(f"Compiled for {memory['platform']} and up to {points} points: {sizes}.")
    return "\n".join(lines)
