"""Convex solids, of which everything in a synthetic scene is built, and their intersections with rays.

In its own frame, a solid has u forward, v left and w up from its origin, rotated by yaw about z. It is the intersection
of six half-spaces, whose faces may slope, with an ellipsoid or elliptic cylinder around the origin.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from ciassd_jax.types import Array

Number = Array | float | int
# Smallest rate and curvature: a ray parallel to a face meets it far away instead of dividing by zero.
_FLAT = 1e-9


class Solids(NamedTuple):
    """Solids in the LiDAR frame; lengths in metres.

    A solid contains the points (u, v, w) of its frame with u <= front + lean[0] w, -u <= rear + lean[1] w,
    |v| <= side + lean[2] w, w <= top + lean[3] u, -w <= bottom, and curve . (u^2, v^2, w^2) <= 1. `limits` are (front,
    rear, side, top, bottom), and `curve` are inverse squared radii, 0 for none. `material` is an index into
    `materials.MATERIALS`, `shade` a factor on its reflectance, and `owner` the object it belongs to, -1 for none.
    """

    origin: Float[Array, "*s 3"]
    yaw: Float[Array, "*s"]
    limits: Float[Array, "*s 5"]
    lean: Float[Array, "*s 4"]
    curve: Float[Array, "*s 3"]
    material: Int[Array, "*s"]
    shade: Float[Array, "*s"]
    owner: Int[Array, "*s"]
    present: Bool[Array, "*s"]


def solid(
    origin: tuple[Number, Number, Number],
    limits: tuple[Number, ...],
    material: int,
    *,
    lean: tuple[Number, ...] = (0.0, 0.0, 0.0, 0.0),
    radii: tuple[Number, ...] = (jnp.inf, jnp.inf, jnp.inf),
    shade: Number = 1.0,
) -> Solids:
    """Return one solid, aligned with its object; `radii` are those of the ellipsoid, infinite for none."""
    return Solids(
        origin=_row(origin),
        yaw=jnp.zeros(()),
        limits=_row(limits),
        lean=_row(lean),
        curve=_row(radii) ** -2,
        material=jnp.array(material, jnp.int32),
        shade=jnp.asarray(shade, jnp.float32),
        owner=jnp.array(-1, jnp.int32),
        present=jnp.array(True),
    )


def block(center: tuple, size: tuple, material: int, **more: Number | tuple) -> Solids:
    """Return a box of (length, width, height) around `center`."""
    length, width, height = (edge / 2 for edge in size)
    return solid(center, (length, length, width, height, height), material, **more)  # type: ignore[arg-type]


def column(base: tuple, radius: Number, height: Number, material: int) -> Solids:
    """Return an upright cylinder on `base`."""
    limits = (radius, radius, radius, height, 0.0)
    return solid(base, limits, material, radii=(radius, radius, jnp.inf))


def ellipsoid(center: tuple, radii: tuple, material: int, **more: Number) -> Solids:
    """Return an ellipsoid around `center`."""
    limits = (radii[0], radii[0], radii[1], radii[2], radii[2])
    return solid(center, limits, material, radii=radii, **more)  # type: ignore[arg-type]


def stack(solids: list[Solids]) -> Solids:
    """Stack single solids along a leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *solids)


def place(solids: Solids, position: Float[Array, " 3"], yaw: Float[Array, ""]) -> Solids:
    """Rotate the solids [S] of an object at the origin by `yaw`, then move them to `position`."""
    cosine, sine = jnp.cos(yaw), jnp.sin(yaw)
    x, y, z = solids.origin[:, 0], solids.origin[:, 1], solids.origin[:, 2]
    turned = jnp.stack([x * cosine - y * sine, x * sine + y * cosine, z], -1)
    return solids._replace(origin=turned + position[None], yaw=solids.yaw + yaw)


def _row(values: tuple[Number, ...]) -> Array:
    return jnp.stack([jnp.asarray(value, jnp.float32) for value in values])


def cross(solids: Solids, direction: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """Return the horizontal distances in metres at which rays enter and leave solids; a miss has enter >= leave.

    `direction` is (du, dv, dw) in the solids' frames per metre of horizontal distance; all arguments broadcast.
    """
    enter: Array = jnp.float32(-jnp.inf)
    leave: Array = jnp.float32(jnp.inf)
    for start, rate, _ in _faces(solids, direction):
        rate = jnp.where(jnp.abs(rate) < _FLAT, _FLAT, rate)
        distance = -start / rate
        enter = jnp.maximum(enter, jnp.where(rate < 0, distance, -jnp.inf))
        leave = jnp.minimum(leave, jnp.where(rate < 0, jnp.inf, distance))
    near, far = _cross_ellipsoid(solids, direction)
    return jnp.maximum(enter, near), jnp.minimum(leave, far)


def incidence(solids: Solids, direction: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """Return where rays enter the solids that they hit, as `cross`, and the cosine of incidence there."""
    du, dv, dw = direction
    length = jnp.sqrt(du**2 + dv**2 + dw**2)
    enter, cosine = _cross_ellipsoid(solids, direction)[0], _ellipsoid_cosine(solids, direction, length)
    for start, rate, norm in _faces(solids, direction):
        rate = jnp.where(jnp.abs(rate) < _FLAT, _FLAT, rate)
        distance = jnp.where(rate < 0, -start / rate, -jnp.inf)
        cosine = jnp.where(distance > enter, -rate / (norm * length), cosine)
        enter = jnp.maximum(enter, distance)
    return enter, cosine


def sensor_in(solids: Solids) -> tuple[Array, Array, Array]:
    """Return the position (u, v, w) of the sensor in the solids' frames."""
    cosine, sine = jnp.cos(solids.yaw), jnp.sin(solids.yaw)
    x, y, z = solids.origin[..., 0], solids.origin[..., 1], solids.origin[..., 2]
    return -(x * cosine + y * sine), x * sine - y * cosine, -z


def extent(solids: Solids) -> tuple[Array, Array, Array, Array, Array]:
    """Return bounds on how far solids extend forward, backward, sideways, up and down from their origins."""
    front, rear, side, top, bottom = (solids.limits[..., i] for i in range(5))
    radii = 1 / jnp.sqrt(jnp.maximum(solids.curve, _FLAT**2))
    high = jnp.minimum(top + jnp.maximum(solids.lean[..., 3] * front, -solids.lean[..., 3] * rear), radii[..., 2])
    low = jnp.minimum(bottom, radii[..., 2])

    def reach(limit: Array, lean: Array, radius: Array) -> Array:
        return jnp.minimum(limit + jnp.maximum(lean * high, -lean * low), radius)

    front = reach(front, solids.lean[..., 0], radii[..., 0])
    rear = reach(rear, solids.lean[..., 1], radii[..., 0])
    return front, rear, reach(side, solids.lean[..., 2], radii[..., 1]), high, low


def _faces(solids: Solids, direction: tuple[Array, Array, Array]) -> list[tuple[Array, Array, Array]]:
    """For every half-space: left minus right side at the sensor, its rate along rays, and the length of the normal."""
    du, dv, dw = direction
    u, v, w = sensor_in(solids)
    front, rear, side, top, bottom = (solids.limits[..., i] for i in range(5))
    ahead, behind, across, above = (solids.lean[..., i] for i in range(4))
    return [
        (u - ahead * w - front, du - ahead * dw, jnp.sqrt(1 + ahead**2)),
        (-u - behind * w - rear, -du - behind * dw, jnp.sqrt(1 + behind**2)),
        (v - across * w - side, dv - across * dw, jnp.sqrt(1 + across**2)),
        (-v - across * w - side, -dv - across * dw, jnp.sqrt(1 + across**2)),
        (w - above * u - top, dw - above * du, jnp.sqrt(1 + above**2)),
        (-w - bottom, -dw, jnp.ones_like(w)),
    ]


def _cross_ellipsoid(solids: Solids, direction: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """Where rays enter and leave the ellipsoid: the roots of a quadratic, or (inf, -inf) without roots."""
    square, half, rest = jnp.zeros(()), jnp.zeros(()), -jnp.ones(())
    for axis, (place, rate) in enumerate(zip(sensor_in(solids), direction, strict=True)):
        curve = solids.curve[..., axis]
        square, half, rest = square + curve * rate**2, half + curve * place * rate, rest + curve * place**2
    # Without curvature the quadratic is -1 <= 0: everywhere inside.
    square = jnp.maximum(square, _FLAT)
    inside = half**2 - square * rest
    root = jnp.sqrt(jnp.maximum(inside, 0.0))
    hit = inside > 0
    return jnp.where(hit, (-half - root) / square, jnp.inf), jnp.where(hit, (-half + root) / square, -jnp.inf)


def _ellipsoid_cosine(solids: Solids, direction: tuple[Array, Array, Array], length: Array) -> Array:
    """Cosine of incidence where rays enter the ellipsoid, from the gradient there."""
    enter, _ = _cross_ellipsoid(solids, direction)
    along, square = jnp.zeros(()), jnp.zeros(())
    for axis, (place, rate) in enumerate(zip(sensor_in(solids), direction, strict=True)):
        gradient = solids.curve[..., axis] * (place + enter * rate)
        along, square = along - gradient * rate, square + gradient**2
    return along / (jnp.sqrt(jnp.maximum(square, _FLAT**2)) * length)
