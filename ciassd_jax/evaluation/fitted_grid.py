"""The smallest grid that holds a data set's boxes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from ciassd_jax.config import Config, GridConfig
from ciassd_jax.formats.errors import InputError
from ciassd_jax.ops.footprints import footprint_corners
from ciassd_jax.types import Boxes

# Share of the boxes to hold, and metres of room below and above them.
_HELD, _Z_MARGIN = 0.99, 0.2


def fit_grid(boxes: Float[np.ndarray, "G 7"], base: Config) -> GridConfig:
    """Return the base config's grid with the smallest valid range that holds 99 % of the boxes.

    The range includes the sensor and is symmetric in y, because augmentation mirrors y. It has the layers of the base
    config, so that trained parameters fit, or more if they are too few. Raises InputError for a range with too many
    voxels.
    """
    grid, unit = base.grid, 2 * base.backbone.stride
    back, front, side, down, up = _limits(_reach(boxes, base), grid.maximum[2] - grid.minimum[2]).tolist()
    x, y, _ = grid.voxel_size
    west, east, half = _snapped(back, unit * x), _snapped(front, unit * x), _snapped(side, unit // 2 * y)
    low, high = _fit_layers(down, up, grid)
    try:
        return replace(grid, minimum=(0 - west, -half, low), maximum=(east, half, high))
    except ValueError as error:
        raise InputError(
            f"The boxes reach from x = {-west:g} to {east:g} m and {half:g} m to the side, too far for voxels of "
            f"{x:g} m; leave out far ones, or choose a larger grid.voxel_size."
        ) from error


def boxes_held(boxes: Float[np.ndarray, "G 7"], config: Config) -> Bool[np.ndarray, " G"]:
    """Return which boxes lie inside the range: footprints, bottoms and tops."""
    (left, right, low), (x, y, high) = config.grid.minimum, config.grid.maximum
    room = np.array([-left, x, min(-right, y), _Z_MARGIN - low, high + _Z_MARGIN])
    return np.asarray((_reach(boxes, config) <= room + 1e-6).all(1))


def _reach(boxes: Float[np.ndarray, "G 7"], config: Config) -> Float[np.ndarray, "G 5"]:
    """Return how far each box reaches back, ahead, to either side, down and up in the network's frame, with margin."""
    x, y = footprint_corners(Boxes.from_array(boxes)).transpose(2, 0, 1)
    z, half = boxes[:, 2] + config.input.z_shift, boxes[:, 5] / 2 + _Z_MARGIN
    # A camera's view begins at the sensor, even if an object beside it does not.
    back = np.where(boxes[:, 0] < 0, -x.min(1), 0)
    return np.stack([back, x.max(1), abs(y).max(1), half - z, half + z], 1)


def _limits(reach: Float[np.ndarray, "G 5"], least_height: float) -> Float[np.ndarray, " 5"]:
    """Return the five limits of the smallest range that holds enough of G boxes, found greedily.

    In every turn the boxes that reach furthest in one direction are left out, the direction and their number being
    those that shrink the volume most per box.
    """

    def log_volume(limits: Float[np.ndarray, "M 5"]) -> Float[np.ndarray, " M"]:
        back, front, side, down, up = limits.T
        return np.log((back + front.clip(0)) * side * (down + up).clip(least_height))

    spare = int((1 - _HELD) * len(reach) + 1e-9)
    while spare:
        order = np.argsort(-reach, axis=0)
        furthest = np.take_along_axis(reach, order, 0)[: spare + 1]
        number = np.arange(1, spare + 1)
        trials = np.broadcast_to(furthest[0], (5, spare, 5)).copy()
        for side in range(5):
            trials[side, :, side] = furthest[1:, side]
        shrinks = log_volume(furthest[:1]) - log_volume(trials.reshape(-1, 5)).reshape(5, spare)
        side, last = np.unravel_index((shrinks / number).argmax(), shrinks.shape)
        reach = np.delete(reach, order[: last + 1, side], axis=0)
        spare -= int(last) + 1
    return reach.max(0)


def _snapped(metres: float, step: float) -> float:
    """Round up to a multiple of the step, at least 0."""
    return round(max(np.ceil(metres / step - 1e-6), 0) * step, 6)


def _fit_layers(down: float, up: float, grid: GridConfig) -> tuple[float, float]:
    """Return the base grid's range in z, the same moved, or a taller one."""
    low, high = grid.minimum[2], grid.maximum[2]
    if -down >= low and up <= high:
        return low, high
    size, layers = grid.voxel_size[2], grid.cells[2]
    bottom, top = int(np.floor(-down / size + 1e-6)), int(np.ceil(up / size - 1e-6))
    bottom -= max(layers - (top - bottom), 0) // 2
    return round(bottom * size, 6), round(max(top, bottom + layers) * size, 6)
