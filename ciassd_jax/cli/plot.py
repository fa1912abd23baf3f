"""`ciassd plot`: the curves of one or several trainings as a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ciassd_jax.cli.messages import UsageError
from ciassd_jax.cli.options import Unset
from ciassd_jax.formats.writing import check_file, replacing
from ciassd_jax.training.metrics import read_metrics
from ciassd_jax.view.curves import plot_curves


@dataclass(frozen=True)
class Plot:
    """Draw the curves of trainings: loss and its terms, learning rate, positive anchors, validation scores."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN ...", help_behavior_hint="")]
    """The folder of a training, finished or not, or of several to compare."""
    out: Annotated[Unset[Path], tyro.conf.arg(metavar="FILE.png")] = None
    """The picture to write; by default curves.png in the folder of the first training."""

    def run(self) -> int:
        if not self.runs:
            raise UsageError("Nothing to draw; give the folder of a training.")
        out = self.out or self.runs[0] / "curves.png"
        if out.suffix.lower() != ".png":
            raise UsageError(f"--out {out} must end in .png; choose such a name.")
        runs = {str(run): read_metrics(run) for run in self.runs}
        check_file(out)
        try:
            figure = plot_curves(runs)
        except ModuleNotFoundError as error:
            raise UsageError(str(error)) from error
        with replacing(out) as temporary:
            figure.savefig(temporary, format="png")
        drawn = ", ".join(f"{name} up to step {lines[-1]['step']}" for name, lines in runs.items())
        print(f"Wrote {out}: {drawn}.")
        return 0
