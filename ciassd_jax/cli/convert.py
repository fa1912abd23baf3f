"""`ciassd convert`: released weights as a file of this package."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ciassd_jax.cli.messages import UsageError
from ciassd_jax.formats.writing import check_file
from ciassd_jax.inference.weights import load_released_weights, load_weights, save_weights


@dataclass(frozen=True)
class Convert:
    """Convert the authors' released weights to a weights file of this package, and report every tensor.

    A .pth is read without torch, and no code in it is run.
    """

    source: Annotated[Path, tyro.conf.Positional]
    """A released .pth, or a .safetensors with the released names; with --half also a file of this package."""
    out: Annotated[Path, tyro.conf.Positional]
    """The file to write; its name ends in .safetensors."""
    half: bool = False
    """Store kernels as float16."""

    def run(self) -> int:
        if self.out.suffix != ".safetensors":
            raise UsageError(f"{self.out} must end in .safetensors; choose such a name.")
        if self.out.resolve() == self.source.resolve():
            raise UsageError(f"{self.out} is the input itself; choose another name for the output.")
        check_file(self.out)
        weights = (load_weights if self.half else load_released_weights)(self.source)
        for row in weights.report:
            print(f"{row.status:<10}  {row.source:<58}  {row.target:<50}  {row.shape}")
        save_weights(self.out, weights.variables, weights.config, half_kernels=self.half)
        used = sum(row.status != "counter" for row in weights.report)
        print(f"Wrote {self.out}: {used} tensors; {len(weights.report) - used} counters were not needed.")
        return 0
