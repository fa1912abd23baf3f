"""Slow references in plain NumPy: the definitions that the fast code is held against."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class VoxelsByLoop(NamedTuple):
    """Voxels in the order in which the cloud touches them, and what was left out."""

    coordinates: np.ndarray
    num_points: np.ndarray
    first_point: np.ndarray
    mean: np.ndarray
    dropped: int
    points_in_range: int
    points_dropped: int


def voxelize_loop(
    points: np.ndarray, *, minimum, voxel_size, cells, max_points: int, max_voxels: int, overflow: str
) -> VoxelsByLoop:
    """SPEC section 3, point after point; points that are not finite do not count."""
    minimum, voxel_size = np.array(minimum, np.float32), np.array(voxel_size, np.float32)
    members: dict[tuple, list[int]] = {}
    lost, in_range, points_dropped, stopped = set(), 0, 0, False
    for i, point in enumerate(points):
        with np.errstate(over="ignore"):
            cell = np.floor((point[:3] - minimum) / voxel_size)
        if not (np.isfinite(point).all() and (cell >= 0).all() and (cell < cells).all()):
            continue
        in_range += 1
        key = tuple(int(c) for c in cell[::-1])
        if key not in members and len(members) == max_voxels:
            lost.add(key)
            stopped |= overflow == "stop"
        if stopped or key in lost:
            points_dropped += 1
        else:
            members.setdefault(key, []).append(i)
    stored = [indices[:max_points] for indices in members.values()]
    return VoxelsByLoop(
        coordinates=np.array(list(members), int).reshape(-1, 3),
        num_points=np.array([len(s) for s in stored], int),
        first_point=np.array([s[0] for s in stored], int),
        mean=np.array([points[s].astype(np.float64).mean(0) for s in stored]).reshape(-1, 4),
        dropped=len(lost),
        points_in_range=in_range,
        points_dropped=points_dropped,
    )


def sparse_convolution_loop(
    coords: np.ndarray, features: np.ndarray, weight: np.ndarray, stride, padding, shape, submanifold: bool
) -> tuple[np.ndarray, np.ndarray]:
    """SPEC section 4 for one scene, in float64: every input adds to the outputs whose windows hold it.

    `coords` (N, 3) are (z, y, x) in any order, `weight` is (kD, kH, kW, Cin, Cout), `shape` the grid of the
    input. Returns the active outputs, sorted lexicographically, and their features.
    """
    kernel = weight.shape[:3]
    if submanifold:
        stride, padding = (1, 1, 1), [k // 2 for k in kernel]
    out_shape = [(n + 2 * p - k) // s + 1 for n, p, k, s in zip(shape, padding, kernel, stride, strict=True)]
    active = {tuple(c) for c in coords.tolist()}
    result: dict[tuple, np.ndarray] = {}
    for coord, feature in zip(coords.tolist(), features.astype(np.float64), strict=True):
        for offset in np.ndindex(*kernel):
            steps = [divmod(i + p - k, s) for i, p, k, s in zip(coord, padding, offset, stride, strict=True)]
            output = tuple(quotient for quotient, _ in steps)
            if any(remainder for _, remainder in steps) or (submanifold and output not in active):
                continue
            if all(0 <= o < n for o, n in zip(output, out_shape, strict=True)):
                product = feature @ weight[offset].astype(np.float64)
                result[output] = result.get(output, 0) + product
    ordered = sorted(result)
    return (
        np.array(ordered, int).reshape(-1, 3),
        np.array([result[o] for o in ordered]).reshape(-1, weight.shape[-1]),
    )
