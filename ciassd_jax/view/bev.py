"""A bird's-eye view as a matplotlib figure: no pyplot, no global state, no display."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ciassd_jax.formats.errors import FormatError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TRUTH, PREDICTION = "#d62728", "#2ca02c"


def plot_bev(
    points: np.ndarray,
    *,
    boxes: np.ndarray | None = None,
    scores: np.ndarray | None = None,
    truth: np.ndarray | None = None,
    title: str = "",
) -> Figure:
    """Points [N, >=3] by height, truth [M, 7] in red and predicted boxes [D, 7] with score and heading in green.

    Boxes are x, y, z, length, width, height, yaw; all in metres in the LiDAR frame. The view is that of the points.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise FormatError("Pictures need matplotlib; install it with `pip install 'ciassd_jax[viz]'`.") from error
    figure = Figure(figsize=(9, 8), layout="constrained")
    axes = figure.add_subplot()
    points = points[np.isfinite(points).all(1)]
    shown = axes.scatter(
        points[:, 0], points[:, 1], c=points[:, 2].clip(-2.5, 1), s=0.6, cmap="viridis", linewidths=0, rasterized=True
    )
    figure.colorbar(shown, label="height (m)", shrink=0.6)
    if truth is not None:
        _draw(axes, truth, TRUTH, "ground truth", None)
    if boxes is not None:
        _draw(axes, boxes, PREDICTION, "detections", scores)
    axes.set(xlabel="x forward (m)", ylabel="y left (m)", title=title, aspect="equal")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper right")
    axes.margins(0.02)
    return figure


def _draw(axes: Axes, boxes: np.ndarray, colour: str, label: str, scores: np.ndarray | None) -> None:
    """Footprints, each with a line from its centre to its front."""
    for i, (x, y, _, length, width, _, yaw) in enumerate(boxes):
        forward = np.array([np.cos(yaw), np.sin(yaw)]) * length / 2
        left = np.array([-np.sin(yaw), np.cos(yaw)]) * width / 2
        centre = np.array([x, y])
        corners = np.stack([forward + left, forward - left, -forward - left, -forward + left, forward + left]) + centre
        axes.plot(*corners.T, color=colour, linewidth=1.3, label=label if i == 0 else None)
        axes.plot(*np.stack([centre, centre + forward]).T, color=colour, linewidth=1.3)
        if scores is not None:
            axes.annotate(f"{scores[i]:.2f}", centre + left * 1.4, color=colour, fontsize=7, ha="center")
