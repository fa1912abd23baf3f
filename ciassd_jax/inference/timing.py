"""How long detection takes on this machine: compilation, first call, and the calls after it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import cycle, islice
from typing import Any, TypeVar

import jax
import numpy as np

from ciassd_jax.config import Config
from ciassd_jax.inference.cost import program_memory
from ciassd_jax.inference.detector import Detector, pad_to_bucket
from ciassd_jax.inference.machine import describe_machine
from ciassd_jax.ops.camera import ANYWHERE
from ciassd_jax.types import Variables

T = TypeVar("T")
_HIT = "/jax/compilation_cache/cache_hits"
_PERCENTILES = (50, 90, 99)


def time_detection(
    variables: Variables, config: Config, clouds: Sequence[np.ndarray], *, batch_size: int = 1, repeats: int = 50
) -> dict[str, Any]:
    """Time a `Detector` on clouds [N, 4], `batch_size` of them a call; times are in seconds.

    `call` has the percentiles of `repeats` calls from points to boxes, `device` those of the program alone on data that
    is on the device, `host` those of the difference. `compile` comes from the compilation cache if `cached`. Raises
    ValueError for no clouds and numbers below 1.
    """
    if not clouds or min(batch_size, repeats) < 1:
        raise ValueError(f"{len(clouds)} clouds, {batch_size} a call, {repeats} calls: give at least 1 of each.")
    batches = [list(islice(cycle(clouds), i, i + batch_size)) for i in range(0, len(clouds), batch_size)]
    detector = Detector(variables, config)
    with _cache_hits() as hits:
        compiling, programs = timed(lambda: [detector.compile(max(map(len, batch)), batch_size) for batch in batches])
    first, results = timed(lambda: detector(batches[0], batch_size=batch_size))
    for batch in batches[1:]:
        results += detector(batch, batch_size=batch_size)
    call, device = _time_calls(detector, jax.device_put(variables), programs, batches, repeats)
    return {
        "batch_size": batch_size,
        "repeats": repeats,
        "dtype": config.dtype,
        "clouds": len(clouds),
        "points": _spread([result.counts["points"]["given"] for result in results]),
        "voxels": _spread([sum(result.counts["voxels"].values()) for result in results]),
        "boxes": _spread([len(result) for result in results]),
        "compile": compiling,
        "cached": bool(hits),
        "first_call": first,
        "call": _percentiles(call),
        "device": _percentiles(device),
        "host": _percentiles(np.subtract(call, device)),
        "frames_per_second": batch_size / float(np.median(call)),
        "memory": program_memory(programs[0]),
        "machine": describe_machine(),
    }


def timed(function: Callable[[], T]) -> tuple[float, T]:
    """Return the seconds of a call, and its result."""
    start = time.perf_counter()
    result = function()
    return time.perf_counter() - start, result


def _time_calls(
    detector: Detector, variables: Variables, programs: Sequence[Any], batches: Sequence[Any], repeats: int
) -> tuple[list[float], list[float]]:
    """Return the seconds of the calls and of the programs alone, taken in turns, so that other jobs disturb both."""
    size = len(batches[0])
    planes = jax.device_put(np.broadcast_to(ANYWHERE, (size, *ANYWHERE.shape)))
    inputs = [jax.device_put(pad_to_bucket(*batch, batch_size=size)) for batch in batches]
    call, device = [], []
    for batch, program, cloud in islice(cycle(zip(batches, programs, inputs, strict=True)), repeats):
        call.append(timed(lambda: detector(batch, batch_size=size))[0])  # noqa: B023
        device.append(timed(lambda: jax.block_until_ready(program(variables, cloud, frustum=planes)))[0])  # noqa: B023
    return call, device


@contextmanager
def _cache_hits() -> Iterator[list[str]]:
    """Collect the programs that the compilation cache returns."""
    hits: list[str] = []

    def listen(event: str, **more: Any) -> None:
        if event == _HIT:
            hits.append(event)

    jax.monitoring.register_event_listener(listen)
    try:
        yield hits
    finally:
        jax.monitoring.unregister_event_listener(listen)


def _percentiles(seconds: Any) -> dict[str, float]:
    return {f"p{p}": float(value) for p, value in zip(_PERCENTILES, np.percentile(seconds, _PERCENTILES), strict=True)}


def _spread(numbers: Sequence[int]) -> dict[str, int]:
    return {"min": min(numbers), "median": int(np.median(numbers)), "max": max(numbers)}
