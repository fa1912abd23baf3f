"""What all matplotlib pictures share: the figure, the colours and the captions of boxes."""

from __future__ import annotations

import io
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from ciassd_jax.view.viz_extra import require

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Truth that is no target has a dimmed red.
TRUTH, DIMMED, FOUND = "#d62728", "#e6a3a1", "#13a538"
DIMMED_MEANING = "truth that is no target"


def new_picture(**options: Any) -> Figure:
    """Return an empty figure that notebooks display as the value of a cell, with or without pyplot.

    `options` are those of matplotlib's Figure. There is no window and no global state.
    """
    require("Pictures", "matplotlib")
    return _picture_class()(**options)


@cache
def _picture_class() -> type[Figure]:
    from matplotlib.figure import Figure

    class Picture(Figure):
        def _repr_png_(self) -> bytes:
            stream = io.BytesIO()
            self.savefig(stream, format="png")
            return stream.getvalue()

    return Picture


def captions_of(count: int, scores: np.ndarray | None, labels: Sequence[str] | None) -> list[str]:
    """Return the caption of each of `count` boxes: its class and its score, as far as they are given."""
    parts = [list(labels or []), [] if scores is None else [f"{score:.2f}" for score in scores]]
    return [" ".join(part[i] for part in parts if part) for i in range(count)]
