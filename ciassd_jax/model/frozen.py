"""Frozen parts of the network: no update, no weight decay, and the running statistics of BatchNorm, unchanged.

A part is named by the path of its parameters, such as "backbone" or "neck/spatial_0".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

import flax.linen as nn
import jax
from jax import lax

from ciassd_jax.config import Config
from ciassd_jax.model.layers import MaskedBatchNorm
from ciassd_jax.model.network import variable_shapes


def is_frozen(path: Sequence[str], frozen: Sequence[str]) -> bool:
    """Return whether a path of names lies in one of the parts."""
    return any(tuple(path)[: len(names)] == names for names in (tuple(part.split("/")) for part in frozen))


def check_frozen(config: Config) -> None:
    """Raise ValueError unless every part of `schedule.frozen` exists, and something is left to train."""
    params = variable_shapes(config.for_inference())["params"]
    paths = [_names(keys) for keys, _ in jax.tree_util.tree_flatten_with_path(params)[0]]
    for part in config.schedule.frozen:
        if not any(is_frozen(path, (part,)) for path in paths):
            parts = sorted({"/".join(path[:depth]) for path in paths for depth in (1, 2)})
            raise ValueError(f"schedule.frozen: the network has no part {part!r}; its parts are {', '.join(parts)}.")
    if all(is_frozen(path, config.schedule.frozen) for path in paths):
        raise ValueError("schedule.frozen names the whole network, so nothing is trained; leave out a part.")


def stop_gradients(params: Any, frozen: Sequence[str]) -> Any:
    """Return the parameters, those of frozen parts without a gradient, so that none is computed for them."""
    return keep_frozen(params, lax.stop_gradient(params), frozen)


def keep_frozen(new: Any, old: Any, frozen: Sequence[str]) -> Any:
    """Return the new parameters, but the old ones in frozen parts."""
    if not frozen:
        return new
    return jax.tree_util.tree_map_with_path(
        lambda keys, after, before: before if is_frozen(_names(keys), frozen) else after, new, old
    )


def running_statistics(frozen: Sequence[str]) -> AbstractContextManager[None]:
    """In this context the BatchNorm layers of frozen parts use their running statistics in training too."""

    def intercept(call: Callable[..., Any], arguments: tuple, named: Mapping[str, Any], context: Any) -> Any:
        if isinstance(context.module, MaskedBatchNorm) and is_frozen(context.module.path, frozen):
            named = {**named, "train": False}
        return call(*arguments, **named)

    return nn.intercept_methods(intercept)


def _names(keys: Sequence[Any]) -> tuple[str, ...]:
    return tuple(key.key for key in keys)
