"""Boxes and their footprints on the ground: corners, collisions, and the points inside a box.

Every function works on JAX and NumPy arrays and keeps their float type; a mix of both gives JAX arrays.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from ciassd_jax.types import Array, Boxes


def footprint_corners(boxes: Boxes) -> Float[Array, "*n 4 2"]:
    """Return the corners (x, y) of the footprints in metres, counter-clockwise from the front left one."""
    xp = boxes.size.__array_namespace__()
    cosine, sine = xp.cos(boxes.yaw), xp.sin(boxes.yaw)
    along, across = boxes.size[..., 0] / 2, boxes.size[..., 1] / 2
    corners = [
        xp.stack(
            [
                boxes.center[..., 0] + front * along * cosine - left * across * sine,
                boxes.center[..., 1] + front * along * sine + left * across * cosine,
            ],
            -1,
        )
        for front, left in ((1, 1), (-1, 1), (-1, -1), (1, -1))
    ]
    return xp.stack(corners, -2)


def box_corners(boxes: Boxes) -> Float[Array, "*n 8 3"]:
    """Return the corners (x, y, z) of boxes in metres: the four at the bottom, then the four above them."""
    xp = boxes.size.__array_namespace__()
    around, middle, half = footprint_corners(boxes), boxes.center[..., 2:, None], boxes.size[..., 2:, None] / 2
    flat = xp.zeros_like(around[..., :1])
    return xp.concatenate([xp.concatenate([around, flat + middle + side * half], -1) for side in (-1, 1)], -2)


def footprints_collide(a: Boxes, b: Boxes) -> Bool[Array, "*n"]:
    """Return whether the interiors of two footprints intersect, by the separating axis theorem.

    Leading axes broadcast. Footprints that only touch do not collide, and one without area (padding) never does.
    """
    xp = (a.size + b.size).__array_namespace__()
    turn = b.yaw - a.yaw
    cosine, sine = abs(xp.cos(turn)), abs(xp.sin(turn))
    dx, dy = b.center[..., 0] - a.center[..., 0], b.center[..., 1] - a.center[..., 1]
    collide = (a.size[..., 0] * a.size[..., 1] > 0) & (b.size[..., 0] * b.size[..., 1] > 0)
    for one, other in ((a, b), (b, a)):
        along, across = one.size[..., 0] / 2, one.size[..., 1] / 2
        length, width = other.size[..., 0] / 2, other.size[..., 1] / 2
        axis_x, axis_y = xp.cos(one.yaw), xp.sin(one.yaw)
        collide &= abs(dx * axis_x + dy * axis_y) < along + length * cosine + width * sine
        collide &= abs(dy * axis_x - dx * axis_y) < across + length * sine + width * cosine
    return collide


# A damaged coordinate may be near the largest float32.
@np.errstate(over="ignore", invalid="ignore")
def points_in_boxes(points: Float[Array, "P C"], boxes: Boxes) -> Bool[Array, "G P"]:
    """Return which of P points (x, y, z first) lie strictly inside which of G boxes.

    NaN is inside nothing, and nothing is inside a box without volume.
    """
    dx, dy, dz = (points[None, :, axis] - boxes.center[:, axis, None] for axis in range(3))
    xp = dx.__array_namespace__()
    along, across, above = (boxes.size[:, axis, None] / 2 for axis in range(3))
    cosine, sine = xp.cos(boxes.yaw)[:, None], xp.sin(boxes.yaw)[:, None]
    inside = (xp.abs(dx * cosine + dy * sine) < along) & (xp.abs(dy * cosine - dx * sine) < across)
    return inside & (xp.abs(dz) < above)
