"""What would an H100 or a TPU v5e get to run? The compilers' reports; neither device is needed, and nothing runs.

    python benchmarks/bench_accelerators.py                                              # both, car and car_lite
    python benchmarks/bench_accelerators.py --targets h100 --presets car --parts --only predict
    python benchmarks/bench_accelerators.py --targets h100 --presets car --devices 8     # the sharded train_step

JAX compiles ahead of time for a device that is only described. This is no measurement of speed: it says what compiles,
in which time and memory, and what would be slow: loops of unknown length and conditionals (a GPU's host reads a value
back each time round), counted loops and many kernels (each a launch of microseconds), and for the TPU the compiler's
own estimate. The compiler counts an operation of unknown cost as minus one second: the report adds these back and says
how many there are. Needs Python 3.12 and `pip install -e '.[accelerators]'`. libtpu allows one process at a time.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

os.environ["JAX_PLATFORMS"] = "cpu"
# Without them libtpu asks the network for the TPU that it runs on.
os.environ.update(TPU_SKIP_MDS_QUERY="1", TPU_WORKER_HOSTNAMES="localhost", TPU_ACCELERATOR_TYPE="v5litepod-16")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import jax
import numpy as np
from compiled_hlo import Summary, summarise
from jax.experimental import topologies
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from programs import Program, predict, predict_parts, train_parts, train_step

from ciassd_jax.config import Config
from ciassd_jax.config.presets import PRESETS
from ciassd_jax.training.distributed import AXIS, shard_step

H100 = Path(__file__).with_name("h100.txtpb")


class Target(NamedTuple):
    """A device: JAX's name of the platform, the package of its compiler, its memory, and how it meets others.

    A ring moves `link` bytes per second out of each device, and a collective of any size takes `latency` seconds.
    """

    platform: str
    package: str
    memory: float
    link: float
    latency: float


TARGETS = {
    # NVLink 4: 450 GB/s per direction; about 20 us for a small all-reduce of NCCL.
    "h100": Target("cuda", "jax-cuda13-pjrt", 84942979072, 450e9, 20e-6),
    # The compiler's limit of 15.75 GiB; 1600 Gbit/s per chip; about 1 us a hop, and 12 hops on a 4 x 4 torus.
    "v5e": Target("tpu", "libtpu", 15.75 * 2**30, 200e9, 12e-6),
}
V5E = {1: "2x2", 4: "2x2", 8: "2x4", 16: "4x4", 64: "8x8", 256: "16x16"}


def described_devices(target: str, count: int) -> list[Any]:
    """Devices that exist only on paper."""
    if target == "h100":
        size = f"1x1x{count}"
        described = {"topology_name": "", "topology": size, "target_config": H100.read_text()}
    elif count in V5E:
        described = {"topology_name": f"v5e:{V5E[count]}"}
    else:
        raise SystemExit(f"There is no v5e of {count} chips; choose --devices from {', '.join(map(str, V5E))}.")
    return topologies.get_topology_desc(platform=TARGETS[target].platform, **described).devices[:count]


class TooLargeError(Exception):
    """The program needs `args[0]` bytes of a device's memory, more than it has."""


class Compiled(NamedTuple):
    """Seconds to trace and lower and to compile, bytes on each device, the compiler's estimate, and what is in it.

    `of_unknown_cost` operations are not in the estimate.
    """

    lower_s: float
    compile_s: float
    temporary: int
    memory: int
    estimate_ms: float | None
    of_unknown_cost: int
    summary: Summary


def compile_for(target: str, program: Any, arguments: Sequence[Any]) -> Compiled:
    """Compile a jitted function for shapes that carry a sharding over described devices."""
    start = time.perf_counter()
    lowered = program.trace(*arguments).lower(lowering_platforms=(TARGETS[target].platform,))
    middle = time.perf_counter()
    try:
        compiled = lowered.compile()
    except jax.errors.JaxRuntimeError as error:
        needed = re.search(r"RESOURCE_EXHAUSTED.*?\(([\d.]+)([KMGT])\) exceeds", str(error), re.DOTALL)
        if needed is None:
            raise
        raise TooLargeError(float(needed[1]) * 1024 ** (1 + "KMGT".index(needed[2]))) from error
    end = time.perf_counter()
    memory, cost = compiled.memory_analysis(), compiled.cost_analysis() or {}
    kept = memory.argument_size_in_bytes + memory.output_size_in_bytes - memory.alias_size_in_bytes
    temporary = memory.temp_size_in_bytes
    seconds = cost.get("optimal_seconds")
    unknown = max(0, math.ceil(-(seconds or 0)))
    estimate = None if seconds is None else 1e3 * (seconds + unknown)
    summary = summarise(compiled.as_text())
    return Compiled(middle - start, end - middle, temporary, kept + temporary, estimate, unknown, summary)


def on_one(target: str, function: Callable[..., Any], arguments: Sequence[Any]) -> Compiled:
    """Compile a function for one device."""
    return compile_for(target, jax.jit(function), placed(arguments, Mesh(np.array(described_devices(target, 1)), AXIS)))


def on_many(target: str, config: Config, batch: int, count: int, *, automatic: bool) -> Compiled:
    """Compile the training step for `count` devices of `batch` scenes each, as the training loop does.

    With `automatic`, by XLA's own partitioning of the step for one device.
    """
    mesh = Mesh(np.array(described_devices(target, count)), AXIS)
    _, function, (state, scenes) = train_step(config, batch * count)
    program = jax.jit(function, donate_argnums=0) if automatic else shard_step(function, mesh)
    return compile_for(target, program, (placed(state, mesh), placed(scenes, mesh, AXIS)))


def placed(tree: Any, mesh: Mesh, *axes: str) -> Any:
    """Shapes with a sharding: copies on all devices, or rows shared along an axis."""
    sharding = NamedSharding(mesh, PartitionSpec(*axes))
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding), tree)


class Table:
    """Rows as Markdown or JSON, each printed as soon as it is there; what does not fit is said after them."""

    def __init__(self, columns: Sequence[str], as_json: bool) -> None:
        self.columns, self.as_json, self.remarks, self.rows = columns, as_json, list[str](), 0
        if not as_json:
            print(f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}", flush=True)

    def add(self, row: dict[str, Any]) -> None:
        self.rows += 1
        if self.as_json:
            print(json.dumps(row), flush=True)
            return
        cells = (row.get(name) for name in self.columns)
        shown = ("" if cell is None else f"{cell:.1f}" if isinstance(cell, float) else str(cell) for cell in cells)
        print(f"| {' | '.join(shown)} |", flush=True)

    def add_compiled(
        self, of: dict[str, Any], work: Callable[[], Compiled], more: Callable[[Compiled], dict[str, Any]]
    ) -> Compiled | None:
        """Add the row of a program, or of what it needs if that is too much; return the program if it compiled."""
        memory, found = TARGETS[of["target"]].memory, None
        try:
            found = work()
            needed, row = found.memory, of | more(found)
        except TooLargeError as error:
            needed, row = error.args[0], dict(of)
        over = needed - memory
        self.add(row | {"device MB": round(needed / 1e6)} | ({"too many MB": round(over / 1e6)} if over > 0 else {}))
        if over > 0:
            what = " ".join(str(value) for value in of.values())
            self.remarks.append(
                f"{what}: needs {needed / 1e9:.1f} GB, {over / 1e9:.1f} GB more than the {memory / 1e9:.1f} GB of the "
                "device; choose a smaller --batch."
            )
        return found

    def close(self) -> None:
        print("".join(f"\n{remark}" for remark in self.remarks), file=sys.stderr if self.as_json else sys.stdout)


def report_one(options: argparse.Namespace) -> None:
    """One row for each program, and for each part of it."""
    columns = ["target", "preset", "dtype", "batch", "program", "lower s", "compile s", "temporary MB", "device MB"]
    columns += ["unknown loops", "counted steps", "conditionals", "kernels", "estimate ms", "of unknown cost"]
    table = Table(columns, options.json)
    for target, preset, dtype, batch in cases(options):
        config = replace(PRESETS[preset](), dtype=dtype)
        of = {"target": target, "preset": preset, "dtype": dtype, "batch": batch}
        for whole, parts in ((predict, predict_parts), (train_step, train_parts)):
            whole_program: Program = whole(config, batch)
            report_programs(table, of, [whole_program], options.only)
            if options.parts:
                named = [(f"{whole_program[0]}: {name}", *rest) for name, *rest in parts(config, batch)]
                report_programs(table, of, named, options.only, total=f"{whole_program[0]}: sum of these parts")
    if not table.rows:
        raise SystemExit(f"No program is called {options.only!r}; without --only all are listed.")
    table.close()


def report_programs(
    table: Table, of: dict[str, Any], programs: Iterable[Program], only: str, total: str | None = None
) -> None:
    """A row for each program whose name contains `only`, and one of the sum of their estimates."""
    estimates = []
    for name, function, arguments in programs:
        if only not in name:
            continue
        found = table.add_compiled(
            of | {"program": name}, lambda f=function, a=arguments: on_one(of["target"], f, a), describe
        )
        estimates.append(found.estimate_ms if found else None)
    if total and estimates and None not in estimates:
        table.add(of | {"program": total, "estimate ms": sum(estimates)})


def describe(found: Compiled) -> dict[str, Any]:
    summary = found.summary
    return {
        "lower s": found.lower_s,
        "compile s": found.compile_s,
        "temporary MB": found.temporary / 1e6,
        "unknown loops": summary.unknown_loops,
        "counted steps": summary.counted_steps,
        "conditionals": summary.conditionals,
        "kernels": sum(summary.kernels.values()),
        "estimate ms": found.estimate_ms,
        "of unknown cost": None if found.estimate_ms is None else found.of_unknown_cost,
        "by kind": summary.kernels,
    }


def report_many(options: argparse.Namespace) -> None:
    """The sharded training step: memory of a device, what travels, and how it would scale."""
    count = options.devices
    columns = ["target", "devices", "preset", "dtype", "scenes each", "partitioning", "compile s", "device MB"]
    columns += ["collectives (number, MB)", "communication ms", f"efficiency at {options.step_ms:g} ms"]
    table = Table(columns, options.json)
    for target, preset, dtype, batch in cases(options):
        config = replace(PRESETS[preset](), dtype=dtype)
        of = {"target": target, "devices": count, "preset": preset, "dtype": dtype, "scenes each": batch}

        def travel(found: Compiled, target: str = target) -> dict[str, Any]:
            seconds, sent = communication(TARGETS[target], found.summary.collectives, count), found.summary.collectives
            return {
                "compile s": found.compile_s,
                "collectives (number, MB)": "; ".join(f"{k} {n}, {size / 1e6:.2f}" for k, (n, size) in sent.items()),
                "communication ms": 1e3 * seconds,
                columns[-1]: f"{100 * options.step_ms / (options.step_ms + 1e3 * seconds):.0f} %",
            }

        for automatic in (False, True) if options.automatic else (False,):
            partitioning = "XLA's" if automatic else "ours"
            work = lambda t=target, c=config, b=batch, a=automatic: on_many(t, c, b, count, automatic=a)  # noqa: E731
            table.add_compiled(of | {"partitioning": partitioning}, work, travel)
    table.close()


def communication(target: Target, collectives: dict[str, tuple[int, int]], count: int) -> float:
    """Seconds of a step's collectives one after another on a ring, of which none overlaps with arithmetic."""
    ring = {"all-reduce": 2 * (count - 1) / count, "reduce-scatter": count - 1, "collective-permute": 1}
    return sum(
        number * target.latency + ring.get(kind, (count - 1) / count) * size / target.link
        for kind, (number, size) in collectives.items()
    )


def cases(options: argparse.Namespace) -> Iterable[tuple[str, str, str, int]]:
    for target in options.targets:
        for preset in options.presets:
            for dtype in options.dtypes:
                for batch in options.batch:
                    yield target, preset, dtype, batch


def positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 1")
    return int(text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--targets", nargs="+", choices=TARGETS, default=list(TARGETS))
    parser.add_argument("--presets", nargs="+", choices=PRESETS, default=["car", "car_lite"])
    parser.add_argument("--dtypes", nargs="+", choices=("float32", "bfloat16"), default=["float32", "bfloat16"])
    parser.add_argument(
        "--batch", nargs="+", type=positive, default=[1, 4], help="scenes, with --devices of each device"
    )
    parser.add_argument("--parts", action="store_true", help="also each part alone")
    parser.add_argument("--only", default="", help="programs and parts whose name contains this text")
    parser.add_argument("--devices", type=positive, help="report the training step for so many devices instead")
    parser.add_argument("--automatic", action="store_true", help="with --devices, also as XLA partitions it by itself")
    parser.add_argument("--step-ms", type=float, default=20, help="assumed step without communication, for --devices")
    parser.add_argument("--json", action="store_true", help="one object a row instead of a Markdown table")
    options = parser.parse_args()
    jax.config.update("jax_enable_compilation_cache", False)
    for target in options.targets:
        try:
            version(TARGETS[target].package)
        except PackageNotFoundError:
            raise SystemExit(
                f"The compiler for {target} is not installed; on Python 3.12 or newer, run pip install -e "
                "'.[accelerators]'."
            ) from None
    report_many(options) if options.devices else report_one(options)


if __name__ == "__main__":
    main()
