"""Objects without labels, of one or two solids each: trees, poles, hedges, walls, houses, bushes, containers."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ciassd_jax.simulation.ground import Ground, ground_height, road_to_lidar
from ciassd_jax.simulation.materials import material
from ciassd_jax.simulation.slots import Chance, Slots
from ciassd_jax.simulation.solids import Solids, block, column, ellipsoid, place, stack
from ciassd_jax.types import Array

TREE, POLE, HEDGE, WALL, HOUSE, BUSH, CONTAINER = range(7)


class _Kind(NamedTuple):
    """A kind of clutter: slots on both sides, range of sizes (length, width, height), distances from the pavement.

    All in metres. An object stands `near` from the pavement, plus up to `jitter`, drawn once per scene, plus up to
    `far`, of which small values are more likely.
    """

    kind: int
    slots: int
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    near: float
    jitter: float
    far: float


_KINDS = (
    _Kind(POLE, 16, (0.1, 0.1, 1.0), (0.3, 0.3, 6.0), -0.9, 0.6, 0.3),
    _Kind(HOUSE, 16, (6.0, 6.0, 5.0), (30.0, 10.0, 12.0), 1.0, 8.0, 4.0),
    _Kind(TREE, 20, (0.2, 0.2, 5.0), (0.7, 0.7, 9.0), -0.6, 0.0, 22.0),
    _Kind(HEDGE, 12, (3.0, 0.6, 0.8), (16.0, 1.5, 2.2), 0.3, 1.0, 9.0),
    _Kind(WALL, 8, (3.0, 0.15, 0.7), (20.0, 0.4, 2.2), 0.3, 1.0, 12.0),
    _Kind(CONTAINER, 8, (0.6, 0.5, 0.9), (5.0, 2.3, 2.4), 0.2, 0.0, 20.0),
    _Kind(BUSH, 20, (0.8, 0.8, 0.6), (3.5, 3.0, 3.0), 0.0, 0.0, 20.0),
)
NUM_CLUTTER, NUM_CLUTTER_KINDS = sum(kind.slots for kind in _KINDS), len(_KINDS)
_BACK, _STREET = -55.0, 130.0


def draw_clutter(chance: Chance, of_kinds: Chance, ground: Ground) -> Slots:
    """Draw clutter on both sides of the road; of two that collide, the later one is removed."""
    index = np.repeat(np.arange(len(_KINDS)), [kind.slots for kind in _KINDS])
    table = [_KINDS[i] for i in index]
    low, high = (jnp.array([getattr(kind, name) for kind in table]) for name in ("low", "high"))
    near, jitter, far = (np.array([getattr(kind, name) for kind in table]) for name in ("near", "jitter", "far"))
    place = np.concatenate([np.arange(kind.slots) // 2 / (kind.slots // 2) for kind in _KINDS])
    step = np.array([2 / kind.slots for kind in table])
    side = np.tile([1, -1], len(table) // 2)
    part = jnp.stack([chance.uniform() for _ in range(3)], -1) ** 1.5
    size = low + (high - low) * part
    # The distance drawn is that of the near side, but for poles and trees that of the centre.
    reach = np.array([kind.kind not in (POLE, TREE) for kind in table]) * size[:, 1] / 2
    away = ground.half_width + jnp.maximum(ground.pavement + near + jitter * of_kinds.uniform()[index], 0.3)
    away = away + far * chance.uniform() ** 2 + reach
    return Slots(
        u=_BACK + _STREET * (place + step * chance.uniform()),
        v=ground.middle + side * away,
        yaw=jnp.where(chance.flip(0.15), 0.5, 0.02) * chance.normal(),
        kind=jnp.array([kind.kind for kind in table]),
        present=chance.uniform() < of_kinds.uniform(0.4, 1.0)[index],
        size=size,
    )


def clutter_solids(slots: Slots, ground: Ground) -> Solids:
    """Return the solids, two for each slot."""
    assert slots.size is not None
    x, y = road_to_lidar(ground, slots.u, slots.v)
    base = jnp.stack([x, y, ground_height(ground, x, y) - 0.1], -1)
    parts = jax.vmap(_shape)(slots.size, slots.kind)
    parts = jax.vmap(place)(parts, base, slots.yaw + ground.yaw)
    parts = parts._replace(present=parts.present & slots.present[:, None])
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), parts)


def _shape(size: Float[Array, " 3"], kind: Array) -> Solids:
    """Build the solids of every kind and select one."""
    length, width, height = size
    none = block((0, 0, 0), (0, 0, 0), 0)._replace(present=jnp.array(False))
    upright = (0, 0, height / 2)
    crown = (0.35 * height, 0.35 * height, 0.35 * height)
    built = [
        [
            column((0, 0, 0), width / 2, height * 0.6, material("wood")),
            ellipsoid((0, 0, 0.65 * height), crown, material("foliage")),
        ],
        [column((0, 0, 0), width / 2, height, material("metal")), none],
        [block(upright, (length, width, height), material("foliage"), lean=(0, 0, -0.08, 0)), none],
        [block(upright, (length, width, height), material("wall")), none],
        [
            block(upright, (length, width, height), material("wall")),
            block((0, -0.1, 1.5), (0.3 * length, width + 0.3, 3.0), material("wall"), shade=0.6),
        ],
        [ellipsoid((0, 0, 0.4 * height), (length / 2, width / 2, 0.6 * height), material("foliage")), none],
        [block(upright, (length, width, height), material("wall"), shade=0.7), none],
    ]
    kinds = [stack(parts) for parts in built]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves)[kind], *kinds)
