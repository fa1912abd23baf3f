"""The record of a training in its folder: config.json, versions.json, metrics.jsonl, tb/ and train.log."""

from __future__ import annotations

import importlib
import json
import math
import platform
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax

from ciassd_jax.config import Config
from ciassd_jax.data.loader import LoaderState
from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.writing import replacing, write_text
from ciassd_jax.training.metrics import METRICS, format_line, parse_lines


class Record:
    """The metrics and the log of a training, opened at the step that it starts or resumes from; use it in `with`.

    Lines of metrics.jsonl at later steps come from an interrupted run and are removed; `lines` holds all that the file
    has. train.log keeps every line that was logged, with its time, and the error that ended the training. TensorBoard
    events are written if tensorboardX is installed. Raises InputError if a file cannot be written.
    """

    def __init__(self, folder: Path, step: int, log: Callable[[str], object] = print) -> None:
        self.folder, self.path, self._show = folder, folder / METRICS, log
        self.lines = [line for line in parse_lines(self.path) if line["step"] <= step]
        with replacing(self.path) as temporary:
            temporary.write_text("".join(map(format_line, self.lines)), encoding="utf-8")
        with self._refusing():
            self._metrics = open(self.path, "a", encoding="utf-8")  # noqa: SIM115
            self._log = open(folder / "train.log", "a", encoding="utf-8")  # noqa: SIM115
        if step:
            self.log(f"Resuming from step {step} in {folder}.")
        self._events = self._open_events(step)

    @property
    def best(self) -> float | None:
        """The best validation score so far, earlier parts of the run included."""
        return max((line["score"] for line in self.lines if "score" in line), default=None)

    def log(self, text: str) -> None:
        """Show a line, and append it to train.log with the time."""
        self._show(text)
        with self._refusing():
            self._append(text)

    def write(self, step: int, numbers: Mapping[str, float]) -> None:
        """Append a line to metrics.jsonl and flush it; non-finite numbers become null."""
        line = {"step": step, **{name: value if math.isfinite(value) else None for name, value in numbers.items()}}
        with self._refusing():
            self._metrics.write(format_line(line))
            self._metrics.flush()
        self.lines.append(line)
        if self._events is not None:
            for name, value in numbers.items():
                self._events.add_scalar(name, value, step)

    def close(self) -> None:
        """Close the files."""
        with self._refusing():
            self._metrics.close()
            self._log.close()
            if self._events is not None:
                self._events.close()

    def __enter__(self) -> Record:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, *_: object) -> None:
        if kind is None:
            self.close()
            return
        # The error that is being raised comes first.
        with suppress(OSError, InputError):
            self._append(f"{kind.__name__}: {error}")
            self.close()

    def _append(self, text: str) -> None:
        self._log.write(f"{datetime.now().isoformat(' ', 'seconds')}  {text}\n")
        self._log.flush()

    def _open_events(self, step: int) -> Any:
        try:
            writer = importlib.import_module("tensorboardX").SummaryWriter
        except ImportError:
            self.log(f"tensorboardX is not installed, so no TensorBoard events are written; {METRICS} has the numbers.")
            return None
        return writer(str(self.folder / "tb"), purge_step=step + 1)

    @contextmanager
    def _refusing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise InputError(
                f"{self.folder} cannot be written ({error.strerror}); free some space and run again: the checkpoints "
                "are intact."
            ) from error


def open_record(folder: Path, config: Config, loader: LoaderState, step: int, log: Callable[[str], object]) -> Record:
    """Write config.json, and versions.json with versions, devices and what the loader reads; open the record."""
    packages = ("ciassd_jax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "grain", "numpy")
    facts = {
        **{name: version(name) for name in packages},
        "python": platform.python_version(),
        "devices": [f"{device.platform} {device.device_kind}" for device in jax.devices()],
        **{name: value for name, value in loader._asdict().items() if name != "batch"},
    }
    write_text(folder / "config.json", config.to_json())
    write_text(folder / "versions.json", json.dumps(facts, indent=1))
    return Record(folder, step, log)
