"""How long do the programs take to compile? Trace, lowering and compilation seconds, whole and by part.

    python benchmarks/bench_compile.py                          # tiny, car_lite, car
    python benchmarks/bench_compile.py --presets tiny --parts   # and the parts of each program

Nothing is read from or written to the compilation cache. Seconds are of the wall clock, `cpu` those of all threads,
which other jobs on the machine disturb less. With `--json` one object per program is printed instead of a table.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

import jax
from programs import predict, predict_parts, train_parts, train_step

import ciassd_jax


def measure(function: Callable[..., Any], arguments: tuple[Any, ...]) -> dict[str, float]:
    """Seconds of each stage, and the size of the program."""
    jax.clear_caches()
    moments, cpu = [time.perf_counter()], time.process_time()
    stage: Any = jax.jit(function)
    stage = stage.trace(*arguments)
    moments.append(time.perf_counter())
    stage = stage.lower()
    moments.append(time.perf_counter())
    lines = stage.as_text().count("\n")
    start = time.perf_counter()
    stage.compile()
    trace, lower = moments[1] - moments[0], moments[2] - moments[1]
    compiled = time.perf_counter() - start
    return {"trace": trace, "lower": lower, "compile": compiled, "cpu": time.process_time() - cpu, "lines": lines}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", nargs="+", default=["tiny", "car_lite", "car"])
    parser.add_argument("--batch", type=int, default=1, help="clouds or scenes")
    parser.add_argument("--parts", action="store_true", help="also each part alone")
    parser.add_argument("--only", help="programs and parts whose name contains this text")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    jax.config.update("jax_enable_compilation_cache", False)
    if not options.json:
        print(f"{'preset':<10} {'program':<38} {'trace':>7} {'lower':>7} {'compile':>8} {'cpu':>7} {'lines':>7}")
    for preset in options.presets:
        config = getattr(ciassd_jax, preset)()
        programs = [predict(config, options.batch), train_step(config, options.batch)]
        if options.parts:
            programs += [*predict_parts(config, options.batch), *train_parts(config, options.batch)]
        for name, function, arguments in programs:
            if options.only and options.only not in name:
                continue
            found = measure(function, arguments)
            if options.json:
                print(json.dumps({"preset": preset, "program": name, **found}), flush=True)
                continue
            seconds = f"{found['trace']:>7.2f} {found['lower']:>7.2f} {found['compile']:>8.2f} {found['cpu']:>7.2f}"
            print(f"{preset:<10} {name:<38} {seconds} {found['lines']:>7.0f}", flush=True)


if __name__ == "__main__":
    main()
