"""The weights that a training starts from: what was taken from a file, and frozen parts that nothing was taken for."""

from __future__ import annotations

from collections.abc import Sequence

from ciassd_jax.inference.weights import TensorReport, Weights
from ciassd_jax.model.frozen import is_frozen


def describe_taken(report: Sequence[TensorReport]) -> str:
    """Return a table: the tensors taken for each part of the network, then each that is fresh or left."""
    wanted = [row for row in report if row.expected is not None]
    lines = []
    for part in sorted({_path(row)[0] for row in wanted}):
        rows = [row for row in wanted if _path(row)[0] == part]
        lines.append(f"  {part:<9} {sum(not _is_fresh(row) for row in rows):>3} of {len(rows)} tensors")
    others = [row for row in report if _is_fresh(row) or row.status.startswith("left")]
    names = [row.target or row.source for row in others]
    width = max(map(len, names), default=0)
    for row, name in zip(others, names, strict=True):
        file, here = ("absent" if shape is None else str(shape) for shape in (row.shape, row.expected))
        lines.append(f"  {name:<{width}}  {row.status:<23}  file {file:<18}  config {here}")
    return "\n".join(lines)


def find_unloaded(frozen: Sequence[str], weights: Weights | None) -> list[str]:
    """Return the frozen parts in which parameters are fresh, all without weights."""
    if weights is None:
        return list(frozen)
    fresh = [_path(row) for row in weights.report if _is_fresh(row)]
    return [part for part in frozen if any(is_frozen(path, (part,)) for path in fresh)]


def _is_fresh(row: TensorReport) -> bool:
    return row.status.startswith("fresh")


def _path(row: TensorReport) -> list[str]:
    """The path of a tensor of the config within params or batch_stats."""
    return row.target.split("/")[1:]
