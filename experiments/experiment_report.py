"""The report of an experiment: JSON, a Markdown table and figures."""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from matplotlib.figure import Figure

from ciassd_jax import __version__
from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.writing import replacing, write_text
from ciassd_jax.training.checkpoint import first_difference

# A table cell: text, a number, one number per seed, or None if it is unknown.
Cell = str | int | float | Sequence[float] | None


class Report(NamedTuple):
    """A title, the rows of a table (all with the same columns), notes, and figures by name."""

    title: str
    rows: Sequence[Mapping[str, Cell]]
    notes: Sequence[str]
    figures: Mapping[str, Figure]


def check_results(folder: Path, name: str, settings: dict[str, Any]) -> None:
    """Raise InputError if `folder` holds results of this experiment with other settings."""
    path = folder / f"{name}.json"
    if not path.exists():
        return
    try:
        saved = json.loads(path.read_text(encoding="utf-8"))["settings"]
    except (ValueError, LookupError, TypeError) as error:
        raise InputError(f"{path} is not a result of an experiment; choose another folder with --out.") from error
    settings = json.loads(json.dumps(settings))
    if saved != settings:
        difference = first_difference(saved, settings, "settings")
        raise InputError(f"{path} belongs to another run: {difference}; choose another folder with --out.")


def write_report(report: Report, folder: Path, name: str, settings: dict[str, Any], facts: dict[str, Any]) -> None:
    """Write NAME.json, NAME.md and the figures NAME.png or NAME_KEY.png."""
    files = {key: f"{name}_{key}.png" if key else f"{name}.png" for key in report.figures}
    for key, figure in report.figures.items():
        with replacing(folder / files[key]) as path:
            figure.savefig(path, format="png")
    rows = [{column: _plain(cell) for column, cell in row.items()} for row in report.rows]
    content = {"title": report.title, "rows": rows, "notes": report.notes, "settings": settings, "facts": facts}
    write_text(folder / f"{name}.json", json.dumps(content, indent=1, allow_nan=False))
    write_text(folder / f"{name}.md", to_markdown(report, facts, list(files.values())))


def to_markdown(report: Report, facts: Mapping[str, Any], pictures: Sequence[str] = ()) -> str:
    """Return the report as a Markdown page."""
    lines = [f"# {report.title}", "", *table(report.rows), ""]
    lines += [f"- {note}" for note in report.notes]
    lines += ["", *(f"- {name}: {value}" for name, value in facts.items())]
    for picture in pictures:
        lines += ["", f"![{report.title}]({picture})"]
    return "\n".join(lines)


def table(rows: Sequence[Mapping[str, Cell]]) -> list[str]:
    """Return the rows as a Markdown table."""
    columns = list(rows[0])
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    return lines + ["| " + " | ".join(to_text(row[column]) for column in columns) + " |" for row in rows]


def to_text(cell: Cell) -> str:
    """Format one value, the mean and range of several, or a dash for none."""
    if cell is None:
        return "-"
    if isinstance(cell, str):
        return cell
    if isinstance(cell, int):
        return f"{cell:,}"
    values = [cell] if isinstance(cell, float) else list(cell)
    if not values or any(math.isnan(value) for value in values):
        return "-"
    digits = 2 if max(map(abs, values)) >= 1 else 3
    text = f"{np.mean(values):.{digits}f}"
    return text if len(values) == 1 else f"{text} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def facts_of_run(command: str, seconds: float, seeds: int) -> dict[str, Any]:
    """Return command, commit, machine, versions, seeds and time of a run."""
    return {
        "command": f"`{command}`",
        "commit": _commit(),
        "machine": machine(),
        "versions": f"ciassd_jax {__version__}, JAX {jax.__version__}, Python {platform.python_version()}",
        "seeds": seeds,
        "time": f"{seconds / 60:.1f} minutes, excluding trainings that were already complete",
    }


def machine() -> str:
    """Describe the accelerators and the processor."""
    device = jax.devices()[0]
    kind = "" if device.platform == "cpu" else f"{len(jax.devices())} x {device.device_kind}, "
    information = Path("/proc/cpuinfo")
    names = information.read_text().splitlines() if information.is_file() else []
    processor = next((line.split(":")[1].strip() for line in names if line.startswith("model name")), "")
    return f"{kind}{os.cpu_count()} cores of {processor or platform.processor() or platform.machine()}"


def _commit() -> str:
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _plain(cell: Cell) -> Any:
    """Convert a cell for JSON; NaN becomes null."""
    if cell is None or isinstance(cell, str | int):
        return cell
    values = [None if math.isnan(value) else float(value) for value in ([cell] if isinstance(cell, float) else cell)]
    return values[0] if isinstance(cell, float) else values
