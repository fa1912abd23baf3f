"""Overlap of rotated boxes without sorting vertices: branch-free, for all pairs at once.

Written once for jax.numpy and for NumPy, which the evaluator uses in float64.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from ciassd_jax.ops.platform import by_platform
from ciassd_jax.types import Array, Boxes


def intersection_bev(a: Boxes, b: Boxes) -> Float[Array, "*n"]:
    """Return the area in square metres that the footprints of `a` and `b` share; leading axes broadcast.

    In the frame of `a`, its rectangle is |x| <= p, |y| <= q. The edges of both, each clipped by the other, bound
    the intersection; the sum of their cross products is twice its area. Crossings are computed once and used for
    both edges, so that nearly parallel edges close up. Edges that coincide count half from each side: once
    where the rectangles lie on the same side, not at all where they only touch.
    """
    xp = np if isinstance(a.yaw, np.ndarray) and isinstance(b.yaw, np.ndarray) else jnp
    cosine_a, sine_a, cosine_b, sine_b = xp.cos(a.yaw), xp.sin(a.yaw), xp.cos(b.yaw), xp.sin(b.yaw)
    dx, dy = b.center[..., 0] - a.center[..., 0], b.center[..., 1] - a.center[..., 1]
    x, y = cosine_a * dx + sine_a * dy, cosine_a * dy - sine_a * dx
    p, q = a.size[..., 0] / 2, a.size[..., 1] / 2
    # Of the angle from a to b, by products: sines of every pair would take most of the time.
    cosine, sine = cosine_a * cosine_b + sine_a * sine_b, cosine_a * sine_b - sine_a * cosine_b
    u, v = b.size[..., 0] / 2, b.size[..., 1] / 2
    ux, uy, vx, vy = u * cosine, u * sine, -v * sine, v * cosine
    starts = [
        (x - ux - vx, y - uy - vy),
        (x + ux - vx, y + uy - vy),
        (x + ux + vx, y + uy + vy),
        (x - ux + vx, y - uy + vy),
    ]
    # The edges of `b` as (step, 1 / step) in x and y. Opposite edges differ in sign: four divisions serve all.
    along, across = [[(2 * step, _inverse(xp, 2 * step)) for step in edge] for edge in ((ux, uy), (vx, vy))]
    back, home = [[(-step, -inverse) for step, inverse in edge] for edge in (along, across)]

    twice = xp.zeros_like(x + p + u)
    # The part of each edge of `a` on x = +-p and y = +-q that is inside b, as [low, high] and a weight.
    on_x = [[-q, q, 1.0], [-q, q, 1.0]]
    on_y = [[-p, p, 1.0], [-p, p, 1.0]]
    for number, ((sx, sy), (step_x, step_y)) in enumerate(zip(starts, (along, across, back, home), strict=True)):
        if number == 2 and xp is jnp:
            on_x, on_y, twice = _two_kernels((on_x, on_y, twice))
        low_x, high_x, weight_x = _clip(xp, sx, step_x, sy, step_y[0], p, on_x, left=-1)
        low_y, high_y, weight_y = _clip(xp, sy, step_y, sx, step_x[0], q, on_y, left=1)
        low = xp.maximum(xp.maximum(low_x, low_y), 0)
        high = xp.minimum(xp.minimum(high_x, high_y), 1)
        cross = sx * step_y[0] - sy * step_x[0]
        twice = twice + xp.maximum(high - low, 0) * weight_x * weight_y * cross
    for half, edges in ((p, on_x), (q, on_y)):
        for low, high, weight in edges:
            twice = twice + xp.maximum(high - low, 0) * weight * half
    # Zero-area boxes pass every clip test; their overlap is set to 0.
    return xp.where(u * v == 0, 0, xp.maximum(twice, 0) / 2)


def _two_kernels(values: Any) -> Any:
    """Halve an accelerator's kernel: the time to compile one grows with the square of its length."""
    return by_platform("auto", values, cpu=lambda same: same, accelerator=lax.optimization_barrier)


def _inverse(xp: ModuleType, step: Array) -> Array:
    """1 / step, and 0 for an edge that is parallel to the lines it is clipped by."""
    # The reciprocal of a smaller number is not finite.
    parallel = xp.abs(step) < np.finfo(step.dtype).tiny
    return xp.where(parallel, 0, 1 / xp.where(parallel, 1, step))


def _clip(
    xp: ModuleType,
    s: Array,
    step: tuple[Array, Array],
    s_other: Array,
    e_other: Array,
    half: Array,
    edges: list[list],
    left: int,
) -> tuple[Array, Array, Array]:
    """Clip the edge s + t * e to |.| <= half, and the edges of `a` on these two lines to its left side.

    Returns the range of t and the weight of the edge; narrows `edges` = [at -half, at +half] in place. `left` is
    +1 where growing `e` bounds the other coordinate from above, else -1. `step` is (e, 1 / e).
    """
    e, inverse = step
    parallel = inverse == 0
    crossings = []
    weight: Array | float = 1.0
    for line, edge in zip((-half, half), edges, strict=True):
        t = (line - s) * inverse
        crossings.append(t)
        at = s_other + t * e_other
        grows = left * e > 0
        edge[0] = xp.where(parallel | grows, edge[0], xp.maximum(edge[0], at))
        edge[1] = xp.where(parallel | ~grows, edge[1], xp.minimum(edge[1], at))
        # A parallel edge has the whole line on one side, or on itself.
        side = left * e_other * (s - line)
        on_line = parallel & (s == line)
        edge[2] = edge[2] * xp.where(on_line, 0.5, xp.where(parallel & (side > 0), 0.0, 1.0))
        weight = weight * xp.where(on_line, 0.5, 1.0)
    outside = parallel & ((s > half) | (s < -half))
    low = xp.where(parallel, 0, xp.minimum(*crossings))
    high = xp.where(parallel, 1, xp.maximum(*crossings))
    return low, high, weight * xp.where(outside, 0.0, 1.0)


def iou_bev(a: Boxes, b: Boxes) -> Float[Array, "*n"]:
    """Return the intersection over union of the rotated footprints; 0 where both are empty."""
    shared = intersection_bev(a, b)
    union = a.size[..., 0] * a.size[..., 1] + b.size[..., 0] * b.size[..., 1] - shared
    return shared / union.clip(1e-7)


def iou_3d(a: Boxes, b: Boxes) -> Float[Array, "*n"]:
    """Return the intersection over union of the volumes; 0 where both are empty."""
    xp = np if isinstance(a.yaw, np.ndarray) and isinstance(b.yaw, np.ndarray) else jnp
    top = xp.minimum(a.center[..., 2] + a.size[..., 2] / 2, b.center[..., 2] + b.size[..., 2] / 2)
    bottom = xp.maximum(a.center[..., 2] - a.size[..., 2] / 2, b.center[..., 2] - b.size[..., 2] / 2)
    shared = intersection_bev(a, b) * (top - bottom).clip(0)
    union = a.size.prod(-1) + b.size.prod(-1) - shared
    return shared / union.clip(1e-7)
