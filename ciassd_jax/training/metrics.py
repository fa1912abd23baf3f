"""Training metrics over time: the lines of metrics.jsonl, one JSON object each, and those for the reader's eye."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ciassd_jax.formats.errors import InputError, Pathlike

METRICS = "metrics.jsonl"
# Metrics of which a summary takes the last value instead of the mean, and the endings of those that it sums.
_STATES = ("learning_rate", "momentum", "skipped")
_COUNTS = ("_given", "_kept", "_cut", "_dropped")
_TERMS = {"classification": "cls", "box": "box", "direction": "dir", "iou": "iou"}


def summarise(rows: Sequence[Mapping[str, np.ndarray]]) -> dict[str, float]:
    """Return the metrics of several steps as one: the sum of counts, the last of states, else the mean."""
    numbers = {}
    for name in rows[0]:
        values = [row[name] for row in rows]
        if name in _STATES:
            numbers[name] = float(values[-1])
        else:
            numbers[name] = float(np.sum(values) if name.endswith(_COUNTS) else np.mean(values))
    return numbers


def describe_metrics(step: int, total: int, numbers: Mapping[str, float], *, scenes: int, remaining: float) -> str:
    """Return one line on the summarised metrics of a training of `total` steps with `scenes` each.

    `remaining` is the estimate of the seconds to the end. The line has what was dropped, in percent of what was given,
    and a warning if no anchor was positive.
    """
    terms = " ".join(f"{short} {numbers[name]:.3g}" for name, short in _TERMS.items())
    parts = [
        f"step {step:>{len(str(total))}}/{total}",
        f"ETA {_duration(remaining)}",
        # An optimiser of one's own does not tell its rate.
        *([f"lr {numbers['learning_rate']:.1e}"] if "learning_rate" in numbers else []),
        f"loss {numbers['loss']:.4g} ({terms})",
        f"positives {numbers['positives']:.1f}",
        f"{scenes / numbers['seconds']:.3g} frames/s",
        *([dropped] if (dropped := _describe_dropped(numbers)) else []),
        *([f"{numbers['skipped']:.0f} updates skipped, not finite"] if numbers["skipped"] else []),
    ]
    if not numbers["positives"]:
        parts.append("warning: no anchor is positive, so nothing is learned; run `ciassd data check` with this config")
    return "  ".join(parts)


def _describe_dropped(numbers: Mapping[str, float]) -> str:
    """Return what was cut or dropped, in percent of what was given; as a number where that is not known."""
    phrases = []
    for what in ("points", "boxes", "objects", "voxels", "sites"):
        given, kept, cut, dropped = (numbers.get(what + ending, 0.0) for ending in _COUNTS)
        # Points and boxes are cut before they are given to the step.
        if lost := cut + dropped:
            before = given + cut if given else kept + dropped
            phrases.append(f"{what} {100 * lost / before:.3g}%" if given or kept else f"{what} {lost:.0f}")
    return f"dropped {', '.join(phrases)}" if phrases else ""


def _duration(seconds: float) -> str:
    """Return a time in two units, such as 2d03h, 3h05m, 12m30s, or 45s."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    days, hours = divmod(hours, 24)
    if days:
        return f"{days}d{hours:02}h"
    if hours:
        return f"{hours}h{minutes:02}m"
    return f"{minutes}m{rest:02}s" if minutes else f"{rest}s"


def read_metrics(workdir: Pathlike) -> list[dict[str, Any]]:
    """Return the lines of a training's metrics.jsonl; numbers that were not finite are None.

    Raises InputError if the folder has no such file, or one without a line.
    """
    path = Path(workdir) / METRICS
    if not path.is_file():
        raise InputError(f"{workdir} has no {METRICS}; give the folder of a training.")
    lines = list(parse_lines(path))
    if not lines:
        raise InputError(f"{path} has no complete line yet; wait until the training has logged its first steps.")
    return lines


def parse_lines(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the complete lines of a metrics file, none if it is missing; a killed run may truncate the last one."""
    if not path.is_file():
        return
    for text in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            line = json.loads(text)
        except json.JSONDecodeError:
            continue
        if isinstance(line, dict) and isinstance(line.get("step"), int) and _is_numeric(line.values()):
            yield line


def _is_numeric(values: Iterable[Any]) -> bool:
    return all(isinstance(value, int | float | None) for value in values)


def format_line(line: Mapping[str, Any]) -> str:
    """Return a line of a metrics file, with its end."""
    return json.dumps(line, allow_nan=False) + "\n"
