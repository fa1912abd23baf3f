"""What users pass to the network: train states and dictionaries alike, and one sentence for what does not fit.

The checks read shapes and types alone. Under `jax.jit` they run while the program is traced, and cost nothing later.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from ciassd_jax.types import PointCloud, Variables

_PARTS = ("params", "batch_stats")


def variables_of(state_or_variables: Variables) -> dict[str, Any]:
    """Return {"params", "batch_stats"} as dictionaries.

    The argument is a mapping with both, or a train state, of this package or with these fields; of a state with a
    running mean `ema` that is taken for the parameters. Raises ValueError for anything else.
    """
    given = state_or_variables
    if isinstance(given, Mapping):
        found = {name: given.get(name) for name in _PARTS}
    else:
        found = {name: getattr(given, name, None) for name in _PARTS}
        if getattr(given, "ema", None) is not None:
            found["params"] = given.ema
    for name, part in found.items():
        if not isinstance(part, Mapping):
            raise ValueError(
                f'The variables have no dictionary "{name}"; pass {{"params": ..., "batch_stats": ...}}, or a train '
                "state with both."
            )
    return {name: _as_dict(part) for name, part in found.items()}


def check_variables(variables: Variables, expected: Any) -> None:
    """Raise ValueError unless variables have the tree and the shapes of those that are expected."""
    given, wanted = (
        {jax.tree_util.keystr(path, simple=True, separator="/"): np.shape(leaf) for path, leaf in leaves}
        for leaves in map(jax.tree_util.tree_leaves_with_path, (variables, expected))
    )
    faults = [f"{path} is missing" for path in wanted.keys() - given.keys()]
    faults += [f"{path} is not part of the network" for path in given.keys() - wanted.keys()]
    faults += [
        f"{path} has the shape {shape} instead of {wanted[path]}"
        for path, shape in given.items()
        if wanted.get(path, shape) != shape
    ]
    if faults:
        first, *others = sorted(faults)
        more = f", and {len(others)} more" if others else ""
        raise ValueError(
            f'The variables do not fit the config: {first}{more}; pass {{"params": ..., "batch_stats": ...}} with the '
            "config that they were made for."
        )


def check_cloud(cloud: PointCloud, frustum: Any = None) -> None:
    """Raise ValueError unless a cloud is a batch: float32 points [B, P, 4], integer count [B], frustum [B, 6, 4]."""
    if not isinstance(cloud, PointCloud) or any(isinstance(leaf, list | tuple) for leaf in cloud):
        kinds = f" of {type(cloud.points).__name__}" if isinstance(cloud, PointCloud) else ""
        raise ValueError(
            f"The cloud is a {type(cloud).__name__}{kinds}; give a `PointCloud` of two arrays, points [B, P, 4] and "
            "count [B]."
        )
    shape, count = np.shape(cloud.points), np.shape(cloud.count)
    if len(shape) == 2:
        raise ValueError(
            f"points have the shape {shape} without a batch axis; add one, for a single cloud `points[None]` and "
            "`count[None]`."
        )
    if len(shape) != 3 or shape[2] != 4 or 0 in shape:
        raise ValueError(
            f"points have the shape {shape}; give [B, P, 4] with B and P of at least 1: x, y, z in metres and "
            "intensity of each point."
        )
    if count != shape[:1]:
        raise ValueError(f"count has the shape {count}; give {shape[:1]}, the number of points of each cloud.")
    # As JAX sees them: unless x64 is enabled, NumPy's float64 is float32.
    points, counts = (jax.dtypes.canonicalize_dtype(jax.numpy.result_type(leaf)) for leaf in cloud)
    if points != np.float32 or not np.issubdtype(counts, np.integer):
        raise ValueError(f"points and count are of type {points} and {counts}; convert them to float32 and int32.")
    if frustum is not None and np.shape(frustum) != (planes := (shape[0], 6, 4)):
        raise ValueError(
            f"frustum has the shape {np.shape(frustum)}; give {planes}, the six planes of each cloud's camera "
            "(`ops.camera.frustum_planes`)."
        )


def _as_dict(tree: Any) -> Any:
    return {name: _as_dict(part) for name, part in tree.items()} if isinstance(tree, Mapping) else tree
