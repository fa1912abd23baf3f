"""The record of a training: `metrics.jsonl`, one JSON object a line, and TensorBoard events where there is a writer."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.writing import replacing

# Metrics that are a state rather than an amount of each step.
_STATES = ("learning_rate", "momentum", "skipped")


class MetricsLog:
    """Lines of numbers by step; close it at the end.

    Lines of steps after `step`, where training goes on, were written by a run that was cut off; they are removed.
    `lines` are those of the folder so far. Raises InputError where nothing can be written.
    """

    def __init__(self, workdir: Path, step: int, say: Callable[[str], object] = print) -> None:
        self.path = workdir / "metrics.jsonl"
        self.lines = [line for line in _read(self.path) if line["step"] <= step]
        with replacing(self.path) as temporary:
            temporary.write_text("".join(map(_format, self.lines)), encoding="utf-8")
        self._stream = open(self.path, "a", encoding="utf-8")  # noqa: SIM115
        self._events = _open_events(workdir / "tb", step, say)

    def write(self, step: int, numbers: Mapping[str, float]) -> None:
        """Add a line, on the disk at once; what is not finite becomes null."""
        line = {"step": step, **{name: value if math.isfinite(value) else None for name, value in numbers.items()}}
        with self._refusing():
            self._stream.write(_format(line))
            self._stream.flush()
        self.lines.append(line)
        if self._events is not None:
            for name, value in numbers.items():
                self._events.add_scalar(name, value, step)

    def close(self) -> None:
        with self._refusing():
            self._stream.close()
            if self._events is not None:
                self._events.close()

    @contextmanager
    def _refusing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise InputError(
                f"{self.path} cannot be written ({error.strerror}); free some space and run again: the checkpoints "
                "are intact."
            ) from error


def summarise(rows: Sequence[Mapping[str, np.ndarray]]) -> dict[str, float]:
    """The metrics of several steps as one: states as they are at the end, sums of what was left out, and means."""
    numbers = {}
    for name in rows[0]:
        values = [row[name] for row in rows]
        if name in _STATES:
            numbers[name] = float(values[-1])
        else:
            numbers[name] = float(np.sum(values) if is_left_out(name) else np.mean(values))
    return numbers


def is_left_out(name: str) -> bool:
    """Whether a metric counts what did not fit."""
    return name.endswith(("_cut", "_dropped"))


def _read(path: Path) -> Iterator[dict[str, Any]]:
    """The complete lines of a record; a killed run may leave the last one cut."""
    if not path.is_file():
        return
    for text in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            line = json.loads(text)
        except json.JSONDecodeError:
            continue
        if isinstance(line, dict) and isinstance(line.get("step"), int):
            yield line


def _format(line: Mapping[str, Any]) -> str:
    return json.dumps(line, allow_nan=False) + "\n"


def _open_events(folder: Path, step: int, say: Callable[[str], object]) -> Any:
    try:
        writer = importlib.import_module("tensorboardX").SummaryWriter
    except ImportError:
        say("No TensorBoard events are written, as tensorboardX is not installed; metrics.jsonl has the same numbers.")
        return None
    return writer(str(folder), purge_step=step + 1)
