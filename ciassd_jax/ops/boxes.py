"""Box arithmetic, and everything that speaks of the paper's angle r = KITTI's rotation_y = -(yaw + pi/2)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ciassd_jax.types import Array, Boxes


def wrap_angle(angle: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The same angle in [-pi, pi), in radians (SPEC section 10.5)."""
    return angle - jnp.floor(angle / (2 * jnp.pi) + 0.5) * (2 * jnp.pi)


def yaw_to_r(yaw: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Counter-clockwise yaw from +x to the paper's clockwise r; its own inverse."""
    return -(yaw + np.pi / 2)


def r_to_yaw(r: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The paper's r to yaw."""
    return -r - np.pi / 2


def to_paper(boxes: Boxes) -> Float[Array, "*n 7"]:
    """Boxes as the paper's (x, y, z, w, l, h, r); r as computed, not wrapped."""
    length, width, height = boxes.size[..., 0], boxes.size[..., 1], boxes.size[..., 2]
    x, y, z = boxes.center[..., 0], boxes.center[..., 1], boxes.center[..., 2]
    return jnp.stack([x, y, z, width, length, height, yaw_to_r(boxes.yaw)], -1)


def from_paper(array: Float[Array, "*n 7"]) -> Boxes:
    """Boxes from the paper's (x, y, z, w, l, h, r)."""
    size = jnp.stack([array[..., 4], array[..., 3], array[..., 5]], -1)
    return Boxes(array[..., :3], size, r_to_yaw(array[..., 6]))


def encode(boxes: Boxes, anchors: Boxes) -> Float[Array, "*n 7"]:
    """Residuals of boxes on anchors in the paper's order x, y, z, w, l, h, r (SPEC section 6.3).

    The centre is divided by the anchor's footprint diagonal and height, sizes by their logarithm's difference;
    the angle difference is not wrapped. Sizes must be positive.
    """
    length, width, height = anchors.size[..., 0], anchors.size[..., 1], anchors.size[..., 2]
    diagonal = jnp.sqrt(length**2 + width**2)
    offset = boxes.center - anchors.center
    scale = jnp.log(boxes.size / anchors.size)
    return jnp.stack(
        [
            offset[..., 0] / diagonal,
            offset[..., 1] / diagonal,
            offset[..., 2] / height,
            scale[..., 1],
            scale[..., 0],
            scale[..., 2],
            yaw_to_r(boxes.yaw) - yaw_to_r(anchors.yaw),
        ],
        -1,
    )


def decode(residuals: Float[Array, "*n 7"], anchors: Boxes) -> Boxes:
    """Inverse of `encode`: no wrapping, no clamping."""
    length, width, height = anchors.size[..., 0], anchors.size[..., 1], anchors.size[..., 2]
    diagonal = jnp.sqrt(length**2 + width**2)
    step = jnp.stack([diagonal, diagonal, height], -1)
    scale = jnp.stack([residuals[..., 4], residuals[..., 3], residuals[..., 5]], -1)
    r = residuals[..., 6] + yaw_to_r(anchors.yaw)
    return Boxes(residuals[..., :3] * step + anchors.center, jnp.exp(scale) * anchors.size, r_to_yaw(r))


def wrap_r(boxes: Boxes) -> Boxes:
    """The same boxes with r in [-pi, pi), as truth is encoded (SPEC section 2.2, step 10)."""
    return boxes._replace(yaw=r_to_yaw(wrap_angle(yaw_to_r(boxes.yaw))))


def direction_target(boxes: Boxes) -> Int[Array, "*n"]:
    """The direction class that says of a box of wrapped r where it looks: 1 if r > 0, else 0 (SPEC section 6.4)."""
    return (yaw_to_r(boxes.yaw) > 0).astype(jnp.int32)


def nearest_aligned(boxes: Boxes) -> tuple[Float[Array, "*n 2"], Float[Array, "*n 2"]]:
    """Lowest and highest x, y of the footprints once turned to the nearest axis (SPEC section 7.1)."""
    r = yaw_to_r(boxes.yaw)
    turned = jnp.abs(r - jnp.floor(r / np.pi + 0.5) * np.pi) > np.pi / 4
    length, width = boxes.size[..., 0], boxes.size[..., 1]
    half = jnp.stack([jnp.where(turned, length, width), jnp.where(turned, width, length)], -1) / 2
    return boxes.center[..., :2] - half, boxes.center[..., :2] + half


def apply_direction(boxes: Boxes, direction: Int[Array, "*n"]) -> Boxes:
    """Turn a box by pi where its angle disagrees with the direction class: (r > 0) xor (direction == 1)."""
    turn = (yaw_to_r(boxes.yaw) > 0) != (direction == 1)
    return boxes._replace(yaw=boxes.yaw - jnp.where(turn, np.pi, 0.0).astype(boxes.yaw.dtype))


def inside_range(
    boxes: Boxes, minimum: tuple[float, float, float], maximum: tuple[float, float, float]
) -> Bool[Array, "*n"]:
    """Whether the centre lies in the closed range (x, y, z); false for NaN."""
    shape = (1,) * (boxes.center.ndim - 1) + (3,)
    low = jnp.array(minimum, boxes.center.dtype).reshape(shape)
    high = jnp.array(maximum, boxes.center.dtype).reshape(shape)
    return jnp.all((boxes.center >= low) & (boxes.center <= high), -1)
