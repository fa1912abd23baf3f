"""Box arithmetic, and all that concerns the paper's angle r, KITTI's rotation_y = -(yaw + pi/2)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ciassd_jax.types import Array, Boxes


def wrap_angle(angle: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Wrap an angle in radians to [-pi, pi)."""
    return angle - jnp.floor(angle / (2 * jnp.pi) + 0.5) * (2 * jnp.pi)


def yaw_to_r(yaw: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Convert the counter-clockwise yaw from +x to the paper's clockwise r."""
    return -(yaw + np.pi / 2)


def r_to_yaw(r: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Convert the paper's r to yaw."""
    return -r - np.pi / 2


def to_paper(boxes: Boxes) -> Float[Array, "*n 7"]:
    """Convert boxes to the paper's (x, y, z, w, l, h, r); r is not wrapped."""
    length, width, height = boxes.size[..., 0], boxes.size[..., 1], boxes.size[..., 2]
    x, y, z = boxes.center[..., 0], boxes.center[..., 1], boxes.center[..., 2]
    return jnp.stack([x, y, z, width, length, height, yaw_to_r(boxes.yaw)], -1)


def from_paper(array: Float[Array, "*n 7"]) -> Boxes:
    """Convert the paper's (x, y, z, w, l, h, r) to boxes."""
    size = jnp.stack([array[..., 4], array[..., 3], array[..., 5]], -1)
    return Boxes(array[..., :3], size, r_to_yaw(array[..., 6]))


def encode(boxes: Boxes, anchors: Boxes) -> Float[Array, "*n 7"]:
    """Encode boxes as residuals on anchors in the paper's order x, y, z, w, l, h, r (paper section 3.3).

    Offsets of the centre are divided by the diagonal of the anchor's footprint and by its height; sizes are differences
    of logarithms; the difference of angles is not wrapped. Sizes must be positive.
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
    """Decode residuals on anchors, the inverse of `encode`, without wrapping or clamping."""
    length, width, height = anchors.size[..., 0], anchors.size[..., 1], anchors.size[..., 2]
    diagonal = jnp.sqrt(length**2 + width**2)
    step = jnp.stack([diagonal, diagonal, height], -1)
    scale = jnp.stack([residuals[..., 4], residuals[..., 3], residuals[..., 5]], -1)
    r = residuals[..., 6] + yaw_to_r(anchors.yaw)
    return Boxes(residuals[..., :3] * step + anchors.center, jnp.exp(scale) * anchors.size, r_to_yaw(r))


def wrap_r(boxes: Boxes) -> Boxes:
    """Wrap r to [-pi, pi), as is done with ground truth before it is encoded."""
    return boxes._replace(yaw=r_to_yaw(wrap_angle(yaw_to_r(boxes.yaw))))


def direction_target(boxes: Boxes) -> Int[Array, "*n"]:
    """Return the direction class of boxes with wrapped r: 1 if r > 0, else 0."""
    return (yaw_to_r(boxes.yaw) > 0).astype(jnp.int32)


def nearest_aligned(boxes: Boxes) -> tuple[Float[Array, "*n 2"], Float[Array, "*n 2"]]:
    """Return the lowest and highest x, y of the footprints, each turned to its nearest axis."""
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
