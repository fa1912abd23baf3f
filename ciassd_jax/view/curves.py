"""The curves of trainings, drawn with matplotlib."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ciassd_jax.view.picture import new_picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The lines of a run, each with its step and numbers by name; a number that was not finite is None.
Lines = Sequence[Mapping[str, Any]]
_TITLES = {
    "loss": "loss",
    "classification": "classification loss",
    "box": "box loss",
    "direction": "direction loss",
    "iou": "IoU loss",
    "learning_rate": "learning rate",
    "positives": "positive anchors per scene",
}
_COLUMNS = 4
_STYLES: Sequence[Any] = ("-", "--", "-.", ":")


def plot_curves(runs: Mapping[str, Lines]) -> Figure:
    """Return a picture of the lines of metrics.jsonl of runs by name, with one panel per quantity over the steps.

    The quantities are the loss and its terms, the learning rate, the positive anchors, and the AP of each class on the
    validation frames with their mean, the score; those that no run has are left out. A curve has a gap where its number
    was not finite. Raises ModuleNotFoundError without matplotlib.
    """
    panels = {title: {name: ""} for name, title in _TITLES.items()} | _precisions(runs.values())
    panels = {title: names for title, names in panels.items() if any(_has(lines, names) for lines in runs.values())}
    rows = max(math.ceil(len(panels) / _COLUMNS), 1)
    figure = new_picture(figsize=(4 * _COLUMNS, 3 * rows + 0.4), dpi=100, layout="constrained")
    for place, (title, names) in enumerate(panels.items(), 1):
        axes = figure.add_subplot(rows, _COLUMNS, place)
        for index, lines in enumerate(runs.values()):
            for style, name in zip(_STYLES, names, strict=False):
                _draw(axes, lines, name, f"C{index}", style)
        _dress(axes, title, names)
    _name(figure, list(runs))
    return figure


def _precisions(runs: Iterable[Lines]) -> dict[str, dict[str, str]]:
    """Return the titles of the classes' panels, and the names of the numbers of each with what they are."""
    panels: dict[str, dict[str, str]] = {}
    for name in dict.fromkeys(name for lines in runs for line in lines for name in line):
        kind, *parts = name.rsplit("_", 4)
        if len(parts) == 4:
            metric, limit, level, recall = parts
            title = f"AP of {kind}, {level}, {recall} (%)"
            panels.setdefault(title, {})[name] = f"{metric.upper()} at {limit}"
    mean = {"validation score: mean 3D AP (%)": {"score": ""}} if len(panels) > 1 else {}
    return mean | panels


def _has(lines: Lines, names: Iterable[str]) -> bool:
    return any(name in line for line in lines for name in names)


def _draw(axes: Axes, lines: Lines, name: str, color: str, style: str) -> None:
    """Draw one number of a run; few points also as dots."""
    found = [(line["step"], line[name]) for line in lines if name in line]
    steps, values = np.array(found, np.float64).reshape(-1, 2).T
    marker = "o" if len(found) <= 30 else ""
    axes.plot(steps, values, color=color, linestyle=style, linewidth=1.3, marker=marker, markersize=3)


def _dress(axes: Axes, title: str, names: Mapping[str, str]) -> None:
    """The title, a light grid, a logarithmic scale for a loss that falls far, and what each style of line is."""
    from matplotlib.lines import Line2D
    from matplotlib.ticker import LogLocator

    axes.set_title(title, fontsize=10, loc="left")
    axes.set_xlabel("step", fontsize=8)
    axes.tick_params(labelsize=8, which="both")
    axes.grid(color="#ebebe8", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    low, high = axes.dataLim.intervaly
    if title.endswith("loss") and high > 10 * low > 0:
        axes.set_yscale("log")
        axes.yaxis.set_minor_locator(LogLocator(subs=(2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("{x:g}")
    if title.endswith("(%)"):
        axes.set_ylim(0, max(1, axes.get_ylim()[1]))
    if len(names) > 1:
        handles = [
            Line2D([], [], color="black", linestyle=style, linewidth=1.3, label=label)
            for style, label in zip(_STYLES, names.values(), strict=False)
        ]
        axes.legend(handles=handles, fontsize=8, framealpha=0.9)


def _name(figure: Figure, names: Sequence[str]) -> None:
    """The name of the run as the title, or of several beside their colours."""
    from matplotlib.lines import Line2D

    if len(names) == 1:
        figure.suptitle(names[0], fontsize=11, x=0.01, ha="left")
        return
    handles = [Line2D([], [], color=f"C{index}", linewidth=2, label=name) for index, name in enumerate(names)]
    figure.legend(handles=handles, loc="outside upper left", fontsize=10, ncols=3, frameon=False)
