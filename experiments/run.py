"""Reproduce one of the paper's tables or figures on any data set in KITTI's layout.

    python experiments/run.py NAME --data ROOT [--seeds 3] [--budget STEPS] [--out DIR]

Trains the networks that the experiment needs, scores them on the split val of ROOT, and writes DIR/NAME.json, a table
with the paper's numbers and the plots. Re-run the same command to resume. Experiments in one DIR share their trainings.
Trainings follow the preset except for --budget, --batch-size and --learning-rate.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import figure4_iou_scatter
import figure5_snapshots
import memory_of_necks
import parts_of_variants
import table3_data
import table4_modules
import table5_beta
import table6_runtime
from experiment_report import Report, check_results, facts_of_run, to_markdown, write_report
from study import Study

from ciassd_jax import Config, open_dataset
from ciassd_jax.__main__ import keep_programs
from ciassd_jax.cli.config_options import ConfigOptions
from ciassd_jax.cli.messages import warnings_as_lines
from ciassd_jax.config.presets import PRESETS
from ciassd_jax.data.folders import find_root
from ciassd_jax.data.workers import WorkerError
from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.writing import check_folder
from ciassd_jax.inference.weights import Weights
from ciassd_jax.training.loop import TrainingError


class Experiment(NamedTuple):
    """The function to run, whether it reads frames, and whether it can measure weights instead of training."""

    run: Callable[[Study], Report]
    takes_data: bool = True
    takes_weights: bool = True


EXPERIMENTS = {
    "table3_data": Experiment(table3_data.run, takes_weights=False),
    "table4_modules": Experiment(table4_modules.run, takes_weights=False),
    "table5_beta": Experiment(table5_beta.run),
    "table6_runtime": Experiment(table6_runtime.run),
    "memory_of_necks": Experiment(memory_of_necks.run, takes_data=False, takes_weights=False),
    "parts_of_variants": Experiment(parts_of_variants.run, takes_data=False, takes_weights=False),
    "figure4_iou_scatter": Experiment(figure4_iou_scatter.run),
    "figure5_snapshots": Experiment(figure5_snapshots.run),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run an experiment; return 2 and print one sentence if the options or the data cannot be used."""
    options = parse(arguments)
    try:
        with warnings_as_lines(options.data or "KITTI_ROOT"):
            run(options, shlex.join(["python", "experiments/run.py", *(arguments or sys.argv[1:])]))
    except (InputError, WorkerError, TrainingError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def run(options: argparse.Namespace, command: str) -> None:
    """Check the options, run the experiment and write its report."""
    experiment = EXPERIMENTS[options.name]
    if options.weights is not None and not experiment.takes_weights:
        raise InputError(f"{options.name} trains the networks that it compares; remove --weights.")
    data = find_root(options.data) if experiment.takes_data else None
    weights = None if options.weights is None else ConfigOptions(options.preset).load(options.weights)
    config = config_of(options, weights)
    settings = settings_of(config, options, data)
    check_folder(options.out)
    check_results(options.out, options.name, settings)
    given = None if weights is None else weights.variables
    start = time.perf_counter()
    report = experiment.run(Study(data, options.out, config, options.seeds, given))
    facts = facts_of_run(command, time.perf_counter() - start, options.seeds)
    write_report(report, options.out, options.name, settings, facts)
    print(to_markdown(report, facts))
    print(f"\nWritten to {options.out / options.name}.json, .md and .png.")


def config_of(options: argparse.Namespace, weights: Weights | None) -> Config:
    """Return the config of the weights, or the preset, with the schedule of the options."""
    config = weights.config if weights else PRESETS[options.preset or "car_lite"]()
    changes = {"total_steps": options.budget, "batch_size": options.batch_size, "learning_rate": options.learning_rate}
    given = {name: value for name, value in changes.items() if value is not None}
    return replace(config, schedule=replace(config.schedule, **given))


def settings_of(config: Config, options: argparse.Namespace, data: Path | None) -> dict[str, Any]:
    """Return what all results in one folder must share; the number of seeds may differ."""
    return {
        "config": json.loads(config.to_json()),
        "data": None if data is None else {"folder": data.resolve().name, "val": len(open_dataset(data, "val"))},
        "weights": None if options.weights is None else str(options.weights),
    }


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the options; argparse exits with 2 and the valid names for an unknown one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=EXPERIMENTS)
    parser.add_argument("--data", type=Path, help="folder in KITTI's layout (default: KITTI_ROOT)")
    parser.add_argument(
        "--out", type=Path, default=Path("results"), help="folder of trainings and results (default: results)"
    )
    parser.add_argument("--preset", choices=PRESETS, help="the config (default: that of the weights, or car_lite)")
    parser.add_argument("--seeds", type=_positive, default=1, help="trainings per variant (default: 1)")
    parser.add_argument("--budget", type=_positive, help="steps of each training (default: the preset's)")
    parser.add_argument("--batch-size", type=_positive, help="scenes per step (default: the preset's)")
    parser.add_argument("--learning-rate", type=float, help="peak learning rate (default: the preset's)")
    parser.add_argument(
        "--weights",
        type=Path,
        help="measure these instead of training: a weights file, a released .pth or a bundled name",
    )
    return parser.parse_args(arguments)


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is less than 1")
    return value


if __name__ == "__main__":
    keep_programs()
    sys.exit(main())
