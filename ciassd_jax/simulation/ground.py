"""The ground of a synthetic scene: a road with kerbs, a crossing street, pavements and the area beyond.

The road is a paraboloid, and the rest is the same surface raised by the kerb, so that rays are cast analytically.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from ciassd_jax.simulation.materials import material
from ciassd_jax.types import Array


class Ground(NamedTuple):
    """z = -sensor_height + slope . (x, y) + bend (x^2 + y^2) / 2 on the road, `kerb` metres more elsewhere.

    The road runs along u, where (u, v) are (x, y) rotated by -yaw. It covers |v - middle| < half_width, and a crossing
    street covers |u - crossing| < crossing_half; in a scene without a crossing it is out of sight. Pavements extend
    `pavement` metres from the road. `beyond` is the material of the area behind them, grass or paving, which is uneven
    by `roughness` (standard deviation, metres). `shade` is a factor on all reflectances of the ground.
    """

    sensor_height: Float[Array, "*s"]
    slope: Float[Array, "*s 2"]
    bend: Float[Array, "*s"]
    yaw: Float[Array, "*s"]
    middle: Float[Array, "*s"]
    half_width: Float[Array, "*s"]
    crossing: Float[Array, "*s"]
    crossing_half: Float[Array, "*s"]
    kerb: Float[Array, "*s"]
    pavement: Float[Array, "*s"]
    beyond: Int[Array, "*s"]
    shade: Float[Array, "*s"]
    roughness: Float[Array, "*s"]


def road_to_lidar(ground: Ground, u: Array, v: Array) -> tuple[Array, Array]:
    """Return (x, y) of positions (u, v) along and across the road."""
    cosine, sine = jnp.cos(ground.yaw), jnp.sin(ground.yaw)
    return u * cosine - v * sine, u * sine + v * cosine


def ground_height(ground: Ground, x: Array, y: Array) -> Array:
    """Return z of the ground at (x, y), with the kerb."""
    plane = ground.slope[0] * x + ground.slope[1] * y + ground.bend * (x**2 + y**2) / 2 - ground.sensor_height
    return plane + jnp.where(_on_road(ground, x, y), 0.0, ground.kerb)


def cast_ground(
    ground: Ground,
    azimuth: Float[Array, " columns"],
    tangent: Float[Array, " rows"],
    uneven: Float[Array, "rows columns"],
) -> tuple[Array, Array, Array]:
    """Return where rays hit the ground: horizontal distances (inf for none), cosines of incidence, materials.

    `uneven` holds standard normal numbers for the height of rough ground.
    """
    x, y = jnp.cos(azimuth)[None], jnp.sin(azimuth)[None]
    fall = ground.slope[0] * x + ground.slope[1] * y - tangent[:, None]
    road = _meet(ground, ground.sensor_height, fall)
    raised = _meet(ground, ground.sensor_height - ground.kerb, fall)
    # A ray that hits neither the road nor the raised surface hits the kerbstone between them.
    on_road = _on_road(ground, road * x, road * y)
    off_road = ~_on_road(ground, raised * x, raised * y)
    distance = jnp.where(off_road, raised, jnp.where(on_road, road, (raised + road) / 2))
    far = off_road & _beyond(ground, raised * x, raised * y)
    rough = jnp.where(far, ground.roughness, 0.004) * uneven
    distance = jnp.where(far | on_road, _meet(ground, _height_at(ground, off_road) - rough, fall), distance)
    cosine = jnp.maximum(fall, 0) / jnp.sqrt(1 + tangent[:, None] ** 2)
    kind = jnp.where(off_road, jnp.where(far, ground.beyond, material("paving")), material("asphalt"))
    return distance, cosine, kind


def _height_at(ground: Ground, off_road: Bool[Array, "rows columns"]) -> Array:
    return ground.sensor_height - jnp.where(off_road, ground.kerb, 0.0)


def _meet(ground: Ground, height: Array, fall: Array) -> Array:
    """Where rays that fall `fall` per metre hit the surface `height` below: bend/2 t^2 + fall t = height."""
    root = jnp.sqrt(jnp.maximum(fall**2 + 2 * ground.bend * height, 0.0))
    never = (fall**2 + 2 * ground.bend * height < 0) | (fall + root <= 1e-4)
    return jnp.where(never, jnp.inf, 2 * height / jnp.maximum(fall + root, 1e-4))


def _on_road(ground: Ground, x: Array, y: Array) -> Array:
    along, across = _along_and_across(ground, x, y)
    return (jnp.abs(across - ground.middle) < ground.half_width) | (
        jnp.abs(along - ground.crossing) < ground.crossing_half
    )


def _beyond(ground: Ground, x: Array, y: Array) -> Array:
    across = _along_and_across(ground, x, y)[1]
    return jnp.abs(across - ground.middle) > ground.half_width + ground.pavement


def _along_and_across(ground: Ground, x: Array, y: Array) -> tuple[Array, Array]:
    """Positions (x, y) as (u, v)."""
    cosine, sine = jnp.cos(ground.yaw), jnp.sin(ground.yaw)
    return x * cosine + y * sine, y * cosine - x * sine
