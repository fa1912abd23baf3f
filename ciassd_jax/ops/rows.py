"""Rows of arrays: of many taken together, and those that follow each row."""

from __future__ import annotations

from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from ciassd_jax.types import Array

Tree = TypeVar("Tree")


def take_rows(tree: Tree, index: Int[Array, " K"]) -> Tree:
    """Rows `index` of every leaf [N, ...]; the leaves of one type are gathered side by side, in one operation."""
    leaves, structure = jax.tree.flatten(tree)
    arrays = [jnp.asarray(leaf) for leaf in leaves]
    # Truth values travel as integers.
    plain = [array.astype(jnp.int32) if array.dtype == bool else array for array in arrays]
    taken: dict[int, jax.Array] = {}
    for dtype in dict.fromkeys(array.dtype for array in plain):
        mine = [i for i, array in enumerate(plain) if array.dtype == dtype]
        columns = [plain[i].reshape(plain[i].shape[0], -1) for i in mine]
        rows = jnp.concatenate(columns, 1)[index]
        first = 0
        for i, column in zip(mine, columns, strict=True):
            part = rows[:, first : first + column.shape[1]]
            taken[i] = part.reshape(len(index), *arrays[i].shape[1:]).astype(arrays[i].dtype)
            first += column.shape[1]
    return jax.tree.unflatten(structure, [taken[i] for i in range(len(arrays))])


def rows_ahead(array: Array, k: int, fill: int | np.integer) -> jax.Array:
    """For each row the one k places after it; rows of `fill` after the end."""
    return jnp.concatenate([array[k:], jnp.full_like(array[:k], fill)])
