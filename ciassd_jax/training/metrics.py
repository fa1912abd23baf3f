"""Training metrics over time: `metrics.jsonl`, one JSON object per line, and TensorBoard events."""

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

# Metrics of which a summary takes the last value instead of the mean.
_STATES = ("learning_rate", "momentum", "skipped")


class MetricsLog:
    """The metrics file of a folder, opened to resume after `step`; close it at the end.

    Lines of later steps come from an interrupted run and are removed. `lines` holds all lines of the file. TensorBoard
    events are written if tensorboardX is installed. Raises InputError if the file cannot be written.
    """

    def __init__(self, workdir: Path, step: int, log: Callable[[str], object] = print) -> None:
        self.path = workdir / "metrics.jsonl"
        self.lines = [line for line in _read(self.path) if line["step"] <= step]
        with replacing(self.path) as temporary:
            temporary.write_text("".join(map(_format, self.lines)), encoding="utf-8")
        self._stream = open(self.path, "a", encoding="utf-8")  # noqa: SIM115
        self._events = _open_events(workdir / "tb", step, log)

    def write(self, step: int, numbers: Mapping[str, float]) -> None:
        """Append a line and flush it; non-finite numbers become null."""
        line = {"step": step, **{name: value if math.isfinite(value) else None for name, value in numbers.items()}}
        with self._refusing():
            self._stream.write(_format(line))
            self._stream.flush()
        self.lines.append(line)
        if self._events is not None:
            for name, value in numbers.items():
                self._events.add_scalar(name, value, step)

    def close(self) -> None:
        """Close the files."""
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
    """Return the metrics of several steps as one: the sum of overflow counts, the last of states, else the mean."""
    numbers = {}
    for name in rows[0]:
        values = [row[name] for row in rows]
        if name in _STATES:
            numbers[name] = float(values[-1])
        else:
            numbers[name] = float(np.sum(values) if _is_overflow_count(name) else np.mean(values))
    return numbers


def describe_metrics(step: int, total: int, numbers: Mapping[str, float]) -> str:
    """Return one line on the summarised metrics of a training of `total` steps.

    It has the overflow counts above 0, and a warning if no anchor was positive.
    """
    dropped = [f"{name} {value:.0f}" for name, value in numbers.items() if _is_overflow_count(name) and value]
    line = f"step {step}/{total}  epoch {numbers['epoch']:.2f}  loss {numbers['loss']:.4f}"
    line += f"  {numbers['seconds']:.2f} s/step" + (f"  ({', '.join(dropped)})" if dropped else "")
    if numbers["positives"]:
        return line
    return f"{line}  warning: no anchor is positive, so nothing is learned; run `ciassd data check` with this config"


def _is_overflow_count(name: str) -> bool:
    return name.endswith(("_cut", "_dropped"))


def _read(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the complete lines of a metrics file; a killed run may truncate the last one."""
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


def _open_events(folder: Path, step: int, log: Callable[[str], object]) -> Any:
    try:
        writer = importlib.import_module("tensorboardX").SummaryWriter
    except ImportError:
        log("tensorboardX is not installed, so no TensorBoard events are written; metrics.jsonl has the same numbers.")
        return None
    return writer(str(folder), purge_step=step + 1)
