"""Slots where an object may stand, random draws for them, and the removal of objects that collide."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from ciassd_jax.ops.footprints import footprints_collide
from ciassd_jax.types import Array, Boxes

# Draws per slot of a group.
_DRAWS = 40
# Length, width and height of the car that carries the sensor, with a margin.
_EGO = (6.0, 2.6, 1.5)


class Chance:
    """Independent uniform draws [D, n] for n slots, or [D] for one; every method consumes the next ones."""

    def __init__(self, draws: Float[Array, " D *n"]) -> None:
        self._draws = iter(draws)

    def uniform(self, low: Array | float = 0.0, high: Array | float = 1.0) -> Array:
        """Return numbers that are uniform in [low, high)."""
        return low + (high - low) * next(self._draws)

    def normal(self) -> Array:
        """Return approximately standard normal numbers in [-3, 3], scaled sums of three uniform draws."""
        # The inverse of the normal distribution takes ten times as long to compile.
        return 2 * (next(self._draws) + next(self._draws) + next(self._draws) - 1.5)

    def flip(self, probability: Array | float) -> Array:
        """Return True with the given probability."""
        return next(self._draws) < probability


def deal(key: jax.Array, *slots: int) -> list[Chance]:
    """Return the draws of each group, given its number of slots; a group of one slot draws scalars."""
    # One call for all: each call of the generator adds a third of a second to compilation.
    draws = jax.random.uniform(key, (_DRAWS, sum(slots)))
    parts = jnp.split(draws, list(itertools.accumulate(slots))[:-1], axis=1)
    return [Chance(part[:, 0] if part.shape[1] == 1 else part) for part in parts]


class Slots(NamedTuple):
    """Objects that may be present: position along (u) and across (v) the road in metres, yaw relative to it, and kind.

    `size` (length, width, height) is None if the kind determines it.
    """

    u: Float[Array, " n"]
    v: Float[Array, " n"]
    yaw: Float[Array, " n"]
    kind: Int[Array, " n"]
    present: Bool[Array, " n"]
    size: Float[Array, "n 3"] | None = None


def join(*groups: Slots) -> Slots:
    """Concatenate groups of slots."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *groups)


def keep_apart(boxes: Boxes, present: Bool[Array, " n"], *, margin: float, moving: Bool[Array, " n"]) -> Array:
    """Return which boxes stay: those that collide with no earlier present box and not with the sensor's car.

    `margin` is the smallest distance in metres between two boxes; `moving` ones need two more metres along their
    length. A box that is removed still blocks later ones.
    """
    size = jnp.maximum(boxes.size + margin, 0.0)
    wide = boxes._replace(size=jnp.where(moving[:, None], size + jnp.array([[2.0, 0.0, 0.0]]), size))
    first = jax.tree.map(lambda leaf: leaf[:, None], wide)
    second = jax.tree.map(lambda leaf: leaf[None], wide)
    earlier = jnp.tril(jnp.ones((len(present),) * 2, bool), -1)
    blocked = jnp.any(footprints_collide(first, second) & earlier & present[None], 1)
    ego = Boxes(jnp.zeros((1, 3)), jnp.array([_EGO]), jnp.zeros(1))
    return present & ~blocked & ~footprints_collide(wide, ego)
