"""Anchors on the BEV map: one for every cell, class and angle (paper section 4.1)."""

from __future__ import annotations

import numpy as np

from ciassd_jax.config import Config
from ciassd_jax.types import Boxes


def make_anchors(config: Config) -> tuple[Boxes, np.ndarray]:
    """Return the anchors [A] as NumPy float32 and the class label [A] of each.

    Order: y slowest, then x, then class, then angle. Centres, in the frame of the clouds, are computed in float64 and
    rounded once.
    """
    height, width = config.bev_shape
    grid, stride = config.grid, config.backbone.stride
    x, y = (
        grid.minimum[axis] + (np.arange(cells) + 0.5) * grid.voxel_size[axis] * stride
        for axis, cells in ((0, width), (1, height))
    )
    sizes = np.array([(c.length, c.width, c.height) for c in config.classes])
    heights = np.array([c.center_z for c in config.classes]) - config.input.z_shift
    yaws = -np.array(config.head.angles) - np.pi / 2
    shape = (height, width, len(config.classes), len(config.head.angles))
    center = np.stack(
        [
            np.broadcast_to(x[None, :, None, None], shape),
            np.broadcast_to(y[:, None, None, None], shape),
            np.broadcast_to(heights[None, None, :, None], shape),
        ],
        -1,
    )
    size = np.broadcast_to(sizes[None, None, :, None], (*shape, 3))
    yaw = np.broadcast_to(yaws[None, None, None], shape)
    label = np.broadcast_to(np.arange(len(config.classes), dtype=np.int32)[None, None, :, None], shape)
    boxes = Boxes(center.reshape(-1, 3), size.reshape(-1, 3), yaw.reshape(-1))
    return Boxes(*(np.asarray(leaf, np.float32) for leaf in boxes)), label.reshape(-1)
