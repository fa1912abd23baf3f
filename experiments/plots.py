"""The plots of the experiments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

BLUE, ORANGE, GREY = "#3f6aa8", "#d9822b", "#8a8a86"


def plot_bars(rows: Sequence[Mapping[str, Any]], column: str) -> Figure:
    """Draw one column of a table as bars: the mean, and a line over the range of several values."""
    names = [str(next(iter(row.values()))) for row in rows]
    values = [np.atleast_1d(np.asarray(row[column], float)) for row in rows]
    means = np.array([value.mean() for value in values])
    figure = Figure(figsize=(8, 0.45 * len(rows) + 1.1), dpi=130, layout="constrained")
    axes = figure.subplots()
    places = np.arange(len(rows))[::-1]
    axes.barh(places, means, 0.6, color=BLUE)
    for place, value, mean in zip(places, values, means, strict=True):
        if len(value) > 1:
            axes.plot([value.min(), value.max()], [place, place], color="black", linewidth=1.5)
        axes.annotate(f"{mean:.4g}", (value.max(), place), (4, 0), textcoords="offset points", va="center", fontsize=8)
    axes.set_yticks(places, names)
    axes.set_xlabel(column)
    axes.margins(x=0.12)
    # Give the axis a length if all bars are zero.
    axes.set_xlim(0, None if means.any() else 1)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def plot_beta(rows: Sequence[Mapping[str, Any]], column: str) -> Figure:
    """Draw accuracy and correlation against beta, with a faint line for each seed."""
    figure = Figure(figsize=(7, 4), dpi=130, layout="constrained")
    left = figure.subplots()
    right = left.twinx()
    betas = [row["beta"] for row in rows]
    for axes, name, color in ((left, column, BLUE), (right, "PCC", ORANGE)):
        values = np.array([row[name] for row in rows], float)
        axes.plot(betas, values, color=color, alpha=0.3, linewidth=1)
        axes.plot(betas, values.mean(1), "o-", color=color)
        axes.set_ylabel(name, color=color)
        axes.tick_params(axis="y", labelcolor=color)
        axes.spines["top"].set_visible(False)
    left.set_xlabel("beta")
    return figure


def plot_scatter(quantities: Mapping[str, np.ndarray], overlap: np.ndarray) -> Figure:
    """Draw one panel per quantity: its value against the overlap of the same box."""
    figure = Figure(figsize=(4.2 * len(quantities), 4.2), dpi=130, layout="constrained")
    # Keep thousands of points distinguishable.
    alpha = float(np.clip(400 / max(len(overlap), 1), 0.1, 0.7))
    for axes, (title, values) in zip(figure.subplots(1, len(quantities), sharey=True), quantities.items(), strict=True):
        axes.plot([0, 1], [0, 1], color=GREY, linewidth=0.8)
        axes.plot(values, overlap, "o", markersize=3.5, alpha=alpha, color=BLUE, markeredgewidth=0)
        axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal", xlabel=title)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("3D IoU with the nearest object")
    return figure
