"""Slow references in plain NumPy: the definitions that the fast code is held against."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely


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
    """Voxelise point after point (paper section 4.1); points that are not finite are dropped and counted."""
    minimum, voxel_size = np.array(minimum, np.float32), np.array(voxel_size, np.float32)
    members: dict[tuple, list[int]] = {}
    lost, in_range, points_dropped, stopped = set(), 0, 0, False
    for i, point in enumerate(points):
        if not np.isfinite(point).all():
            points_dropped += 1
            continue
        with np.errstate(over="ignore"):
            cell = np.floor((point[:3] - minimum) / voxel_size)
        if not ((cell >= 0).all() and (cell < cells).all()):
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
    """Convolve the sites of one scene in float64: every input adds to the outputs whose windows hold it.

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


class Cluster(NamedTuple):
    """What a DI-NMS loop made of one candidate; only clusters with enough support are put out."""

    candidate: int
    support: float
    supported: bool
    members: list[int]
    box: np.ndarray
    score: float


def footprint_corners(boxes: np.ndarray) -> np.ndarray:
    """BEV corners (..., 4, 2), counter-clockwise, of boxes (..., 7) as x, y, z, length, width, height, yaw."""
    along, across = np.array([-1, 1, 1, -1]) / 2, np.array([-1, -1, 1, 1]) / 2
    u, v = boxes[..., 3:4] * along, boxes[..., 4:5] * across
    cosine, sine = np.cos(boxes[..., 6:7]), np.sin(boxes[..., 6:7])
    return np.stack([boxes[..., 0:1] + cosine * u - sine * v, boxes[..., 1:2] + sine * u + cosine * v], -1)


def polygon_iou(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Rotated BEV IoU of boxes (..., 7) by a general polygon clipper, to about 1e-10; both sizes positive.

    GEOS without a precision grid now and then finds no intersection of a box and its copy turned by pi (one
    of golden's pairs); on a grid of 1e-12 m it does not.
    """
    a, b = np.broadcast_arrays(np.asarray(a, np.float64), np.asarray(b, np.float64))
    a, b = a.copy(), b.copy()
    b[..., :2] -= a[..., :2]
    a[..., :2] = 0
    shapes = [shapely.polygons(footprint_corners(boxes)) for boxes in (a, b)]
    shared = shapely.area(shapely.intersection(*shapes, grid_size=1e-12))
    return shared / (a[..., 3] * a[..., 4] + b[..., 3] * b[..., 4] - shared)


def polygon_iou_matrix(boxes: np.ndarray) -> np.ndarray:
    """`polygon_iou` of every pair; the clipper sees only the pairs whose circumscribed circles meet."""
    radius = np.hypot(boxes[:, 3], boxes[:, 4]) / 2
    distance = np.hypot(boxes[:, None, 0] - boxes[None, :, 0], boxes[:, None, 1] - boxes[None, :, 1])
    rows, columns = np.nonzero(np.triu(distance <= radius[:, None] + radius[None] + 1e-6))
    result = np.zeros(distance.shape)
    result[rows, columns] = result[columns, rows] = polygon_iou(boxes[rows], boxes[columns])
    return result


def greedy_nms_loop(overlaps: np.ndarray, eligible: np.ndarray) -> np.ndarray:
    """Which entries greedy suppression keeps, one after the other in index order."""
    keep = np.zeros(len(eligible), bool)
    suppressed = ~eligible
    for i in range(len(eligible)):
        if not suppressed[i]:
            keep[i] = True
            suppressed |= overlaps[i]
    return keep


def refined_score(score: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """S = f * (1 - softmax(distance)) over all candidates, as it stands in Algorithm 1."""
    power = np.exp(distance)
    return score * (1 - power / power.sum())


def released_di_nms_loop(
    boxes: np.ndarray,
    score: np.ndarray,
    quality: np.ndarray,
    anchor_distance: np.ndarray,
    iou: np.ndarray,
    *,
    overlap: float,
    support_threshold: np.ndarray,
    sigma_squared: tuple[float, ...],
    distances: tuple[float, ...],
) -> list[Cluster]:
    """DI-NMS of the released code, one candidate after the other; the box is NaN beyond the last distance.

    `boxes` (K, 7) are x, y, z, length, width, height, yaw, `iou` (K, K) their overlaps. Where there are several
    classes, `iou` is zero between them: NMS per class, the one departure from the text.
    """
    refined = refined_score(score, anchor_distance**2)
    ranges = np.hypot(boxes[:, 0], boxes[:, 1])
    suppressed = np.zeros(len(boxes), bool)
    clusters = []
    while not suppressed.all():
        candidate = int(np.argmax(np.where(suppressed, -np.inf, score)))
        suppressed[candidate] = True
        v = iou[candidate]
        support = sum(v[j] * quality[j] for j in range(len(boxes)) if v[j] > 0)
        members = [j for j in range(len(boxes)) if v[j] > overlap]
        freshly = [j for j in range(len(boxes)) if v[j] >= overlap and not suppressed[j]]
        suppressed[freshly] = True
        supported = bool(support > support_threshold[candidate])
        if not supported:
            suppressed[freshly] = False
        box = np.full(7, np.nan)
        band = int(np.searchsorted(distances, ranges[candidate], side="right"))
        if band < len(distances):
            weight = np.exp(-((1 - v[members]) ** 2) / sigma_squared[band]) * quality[members]
            box = weight @ boxes[members] / weight.sum()
        clusters.append(Cluster(candidate, support, supported, members, box, refined[members].max()))
    return clusters


def paper_di_nms_loop(
    boxes: np.ndarray,
    score: np.ndarray,
    quality: np.ndarray,
    anchor_distance: np.ndarray,
    iou: np.ndarray,
    *,
    overlap: float,
    support_threshold: np.ndarray,
    sigma_squared: tuple[float, ...],
    distances: tuple[float, ...],
) -> list[Cluster]:
    """Algorithm 1 of the paper; arguments as of `released_di_nms_loop`."""
    refined = refined_score(score, anchor_distance)
    remaining = list(range(len(boxes)))
    clusters = []
    while remaining:
        candidate = max(remaining, key=lambda j: refined[j])
        members = [j for j in remaining if iou[candidate, j] > overlap]
        remaining = [j for j in remaining if j not in members and j != candidate]
        support = sum(iou[candidate, j] * quality[j] for j in members)
        total, mean = 0.0, np.zeros(7)
        for j in members:
            box = boxes[j].copy()
            while box[6] - boxes[candidate, 6] > np.pi / 2:
                box[6] -= np.pi
            while box[6] - boxes[candidate, 6] < -np.pi / 2:
                box[6] += np.pi
            band = sum(np.hypot(box[0], box[1]) >= limit for limit in distances)
            weight = np.exp(-((1 - iou[candidate, j]) ** 2) / sigma_squared[band]) * quality[j]
            total, mean = total + weight, mean + weight * box
        supported = bool(support > support_threshold[candidate])
        clusters.append(Cluster(candidate, support, supported, members, mean / total, refined[candidate]))
    return clusters


def upsample_loop(x: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Transposed convolution: out[2i - 1 + k] += in[i] * kernel[k] along each axis."""
    batch, height, width, _ = x.shape
    out = np.zeros((batch, 2 * height, 2 * width, kernel.shape[-1]))
    for i, j, k, m in np.ndindex(height, width, 3, 3):
        row, column = 2 * i - 1 + k, 2 * j - 1 + m
        if 0 <= row < 2 * height and 0 <= column < 2 * width:
            out[:, row, column] += x[:, i, j] @ kernel[k, m]
    return out
