"""How much of a config's grid a cloud occupies: its voxels, and the active sites of every stage of the backbone."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from ciassd_jax.config import Config

Triple = tuple[int, int, int]


# A damaged coordinate may be near the largest float32.
@np.errstate(over="ignore")
def occupied_voxels(points: Float[np.ndarray, "P 4"], config: Config) -> Int[np.ndarray, " V"]:
    """Return the voxels that hold a point of a cloud, as indices into the flat grid `config.grid.shape`."""
    grid = config.grid
    lifted = points[:, :3] + np.array([0, 0, config.input.z_shift], np.float32)
    cells = np.floor((lifted - np.array(grid.minimum, np.float32)) / np.array(grid.voxel_size, np.float32))
    inside = ((cells >= 0) & (cells < np.array(grid.cells))).all(-1)
    return _flat(cells[inside].astype(np.int64).T[::-1], grid.shape)


def count_sites(points: Float[np.ndarray, "P 4"], config: Config) -> tuple[int, ...]:
    """Return how many voxels a cloud occupies, and how many sites are active after each strided convolution."""
    shapes = config.backbone.stage_shapes(config.grid.shape)
    paddings = [(stage.z_padding, 1, 1) for stage in config.backbone.stages[1:]]
    sites = occupied_voxels(points, config)
    counts = [len(sites)]
    # The last convolution is along z alone.
    for shape, out_shape, padding in zip(shapes, shapes[1:], [*paddings, (0,)], strict=False):
        coordinates = np.stack(np.unravel_index(sites, shape))
        for axis, before in enumerate(padding):
            coordinates = _strided(coordinates, axis, before, out_shape[axis])
        sites = _flat(coordinates, out_shape)
        counts.append(len(sites))
    return tuple(counts)


def _strided(coordinates: Int[np.ndarray, "3 V"], axis: int, padding: int, size: int) -> Int[np.ndarray, "3 V2"]:
    """Return the `size` outputs along an axis that see an input with a kernel of 3 and a stride of 2, repeatedly."""
    place = coordinates[axis] + padding
    last, first = coordinates.copy(), coordinates[:, place % 2 == 0]
    last[axis], first[axis] = place // 2, place[place % 2 == 0] // 2 - 1
    outputs = np.concatenate([last, first], 1)
    return outputs[:, (outputs[axis] >= 0) & (outputs[axis] < size)]


def _flat(coordinates: Int[np.ndarray, "3 V"], shape: Triple) -> Int[np.ndarray, " V2"]:
    """Return the distinct indices into the flat grid."""
    return np.unique(np.ravel_multi_index(tuple(coordinates), shape))
