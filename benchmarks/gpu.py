"""What does the package take on an accelerator, and does it find the same boxes there as on a CPU?

    python benchmarks/gpu.py --out gpu.jsonl     # within eight minutes on one GPU
    python benchmarks/gpu.py --smoke             # every part at toy size, on a CPU

The most important part comes first, and each row is written as soon as it is measured. A part that fails writes a row
with its error, the others still run, and the exit status is 1. A part that would no longer fit into `--minutes` writes
a row that says so. Inputs are on the device before a clock starts, and the first call of a program is not timed.
"""

from __future__ import annotations

import argparse
import json
import platform
import shutil
import subprocess
import time
from collections.abc import Callable, Collection, Iterator
from functools import partial
from itertools import product
from pathlib import Path

import jax
from gpu_parts import Plan, Row, Rows, agreement, frames_of, kernels, predictor, stages, trainer, whole
from gpu_peer import peer_rows

KINDS = ("agreement", "predict", "stages", "train_step", "kernels", "peer")
GUESS = 40.0  # seconds of the first part of a kind
FULL = Plan(("car", "car_lite"), ("float32", "bfloat16"), (1, 4, 16), (4, 8), frames=32, repeats=50)
# The boxes of the smoke test are those of `car_lite`: `tiny` has no weights, and random ones find none.
SMOKE = Plan(("tiny",), ("bfloat16",), (1,), (2,), frames=2, repeats=2)


def parts(plan: Plan, end: float) -> Iterator[tuple[str, str, Callable[[], Rows]]]:
    """Kind, name and measurement of each part, the most important first."""
    first, training = plan.presets[0], plan.train_batches[0]
    for preset in ("car_lite",) if plan.presets == SMOKE.presets else plan.presets:
        yield "agreement", preset, partial(agreement, plan, preset)
    for preset, batch, dtype in product(plan.presets, plan.batches, plan.dtypes):
        make = partial(predictor, plan, preset, dtype, batch)
        yield "predict", f"{preset} {dtype} batch {batch}", partial(whole, plan, make, batch)
    for batch, dtype in product(plan.batches[:2], plan.dtypes):
        yield "stages", f"{first} {dtype} batch {batch}", partial(stages, plan, first, dtype, batch)
    for batch in plan.train_batches:
        make = partial(trainer, plan, first, batch)
        yield "train_step", f"{first} float32 batch {batch}", partial(whole, plan, make, batch)
    programs = {
        f"predict {first} batch 1": partial(predictor, plan, first, plan.dtypes[0], 1),
        f"train_step {first} batch {training}": partial(trainer, plan, first, training),
    }
    for name, make in programs.items():
        yield "kernels", name, partial(kernels, plan, make)
    clouds = [frame.points for frame in frames_of(plan)[0]]
    yield "peer", "torch, spconv-triton", lambda: peer_rows(clouds, plan.batches, plan.repeats, end - time.monotonic())


def machine(plan: Plan) -> Row:
    """Return what the numbers depend on."""
    git = ["git", "describe", "--always", "--dirty"] if shutil.which("git") else ["true"]
    commit = subprocess.run(git, cwd=Path(__file__).parent, capture_output=True, text=True).stdout.strip()
    versions = {"jax": jax.__version__, "python": platform.python_version(), "commit": commit or "unknown"}
    return versions | {"frames": plan.frames, "data": frames_of(plan)[1]}


def write(file: Path | None, part: str, what: str, row: Row) -> None:
    """Print a row, and append it to the file as a line of JSON."""
    cells = [f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}" for name, value in row.items()]
    print(f"{part:<10} | {what:<28} | {', '.join(cells)}", flush=True)
    if file is not None:
        with file.open("a") as out:
            out.write(json.dumps({"part": part, "what": what} | row) + "\n")


def run(plan: Plan, kinds: Collection[str], file: Path | None, end: float) -> bool:
    """Run the parts that fit in the time, and return whether none failed."""
    longest: dict[str, float] = {}
    errors = 0
    for kind, what, measure in parts(plan, end):
        start, expected = time.monotonic(), longest.get(kind, GUESS)
        if kind not in kinds:
            continue
        if start + expected > end:
            write(file, kind, what, {"skipped": f"takes about {expected:.0f} s, but {end - start:.0f} s are left"})
            continue
        try:
            for row in measure():
                write(file, kind, what, row)
                errors += "error" in row
        except Exception as error:
            message = (str(error).splitlines() or [""])[0]
            write(file, kind, what, {"error": f"{type(error).__name__}: {message}"})
            errors += 1
        longest[kind] = max(longest.get(kind, 0), time.monotonic() - start)
    return errors == 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="file that the rows are appended to as JSON")
    parser.add_argument("--frames", type=Path, default=FULL.folder, help="data set; without it frames are simulated")
    parser.add_argument("--weights", type=Path, default=FULL.weights, help="weights of car for the agreement")
    parser.add_argument("--minutes", type=float, default=8)
    parser.add_argument("--parts", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--smoke", action="store_true", help="toy size")
    options = parser.parse_args()
    end = time.monotonic() + 60 * options.minutes
    plan = (SMOKE if options.smoke else FULL)._replace(folder=options.frames, weights=options.weights)
    write(options.out, "machine", jax.devices()[0].device_kind, machine(plan))
    if not run(plan, options.parts, options.out, end):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
