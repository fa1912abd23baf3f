"""Places where something may stand, and which of them stay free."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from ciassd_jax.ops.footprints import footprints_collide
from ciassd_jax.types import Array, Boxes

# Draws that a group may use.
_DRAWS = 40
# The car that carries the sensor, with some room.
_EGO = (6.0, 2.6, 1.5)


class Chance:
    """Independent uniform draws [D, n] for n slots, or [D] for one; every use takes the next ones."""

    def __init__(self, draws: Float[Array, " D *n"]) -> None:
        self._draws = iter(draws)

    def uniform(self, low: Array | float = 0.0, high: Array | float = 1.0) -> Array:
        """Uniform in [low, high)."""
        return low + (high - low) * next(self._draws)

    def normal(self) -> Array:
        """Mean 0 and deviation 1, bell-shaped and within [-3, 3]: the sum of three uniform draws."""
        # The inverse of the normal distribution takes the compiler ten times as long.
        return 2 * (next(self._draws) + next(self._draws) + next(self._draws) - 1.5)

    def flip(self, probability: Array | float) -> Array:
        """True with a probability."""
        return next(self._draws) < probability


def deal(key: jax.Array, *slots: int) -> list[Chance]:
    """Draws for groups of so many slots; scalars for a single one."""
    # One call: each call of the generator takes the compiler a third of a second.
    draws = jax.random.uniform(key, (_DRAWS, sum(slots)))
    parts = jnp.split(draws, list(itertools.accumulate(slots))[:-1], axis=1)
    return [Chance(part[:, 0] if part.shape[1] == 1 else part) for part in parts]


class Slots(NamedTuple):
    """Places along (u) and across (v) the road in metres, headings to the road, what stands there, and whether it does.

    `size` (length, width, height) is given where it does not follow from the kind.
    """

    u: Float[Array, " n"]
    v: Float[Array, " n"]
    yaw: Float[Array, " n"]
    kind: Int[Array, " n"]
    present: Bool[Array, " n"]
    size: Float[Array, "n 3"] | None = None


def join(*groups: Slots) -> Slots:
    """All slots of several groups, in order."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *groups)


def keep_apart(boxes: Boxes, present: Bool[Array, " n"], *, margin: float, moving: Bool[Array, " n"]) -> Array:
    """Which boxes stay: those that stand in no earlier present one and not in the car that carries the sensor.

    `margin` is the least distance in metres between two. One that gave way still keeps later ones away.
    """
    size = jnp.maximum(boxes.size + margin, 0.0)
    wide = boxes._replace(size=jnp.where(moving[:, None], size + jnp.array([[2.0, 0.0, 0.0]]), size))
    first = jax.tree.map(lambda leaf: leaf[:, None], wide)
    second = jax.tree.map(lambda leaf: leaf[None], wide)
    earlier = jnp.tril(jnp.ones((len(present),) * 2, bool), -1)
    blocked = jnp.any(footprints_collide(first, second) & earlier & present[None], 1)
    ego = Boxes(jnp.zeros((1, 3)), jnp.array([_EGO]), jnp.zeros(1))
    return present & ~blocked & ~footprints_collide(wide, ego)
