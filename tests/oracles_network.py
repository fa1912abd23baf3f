"""The whole of inference for one scene in plain NumPy and float64: points to predictions, predictions to boxes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from oracles import (
    Cluster,
    paper_di_nms_loop,
    polygon_iou_matrix,
    released_di_nms_loop,
    sparse_convolution_loop,
    upsample_loop,
    voxelize_loop,
)

from ciassd_jax.config import Config
from ciassd_jax.model.anchors import make_anchors
from ciassd_jax.types import Predictions

LOOPS = {"paper": paper_di_nms_loop, "released": released_di_nms_loop}


class Layer(NamedTuple):
    """Kernel and BatchNorm of one layer by name, out of the variables of a part of the network."""

    params: Mapping[str, Any]
    statistics: Mapping[str, Any]

    def kernel(self, name: str) -> np.ndarray:
        return np.asarray(self.params[name]["kernel"], np.float64)

    def normalize(self, name: str, x: np.ndarray) -> np.ndarray:
        """BatchNorm with the running statistics."""
        norm, seen = self.params[name]["norm"], self.statistics[name]["norm"]
        scale, bias, mean, variance = (
            np.asarray(one, np.float64) for one in (norm["scale"], norm["bias"], seen["mean"], seen["var"])
        )
        return (x - mean) / np.sqrt(variance + 1e-3) * scale + bias


def predict_by_loop(variables: Mapping[str, Any], points: np.ndarray, config: Config) -> Predictions:
    """Raw predictions of one scene, whose sites must fit every capacity."""
    backbone, neck = (Layer(variables["params"][p], variables["batch_stats"][p]) for p in ("backbone", "neck"))
    features = ssfa(neck, bev_map(backbone, points, config))
    head = variables["params"]["head"]

    def branch(name: str, *shape: int) -> np.ndarray:
        result = convolve_2d(features, np.asarray(head[name]["kernel"], np.float64))
        return (result + np.asarray(head[name].get("bias", 0))).reshape(-1, *shape)

    return Predictions(branch("box", 7), branch("class"), branch("direction", 2), branch("iou"))


def bev_map(layers: Layer, points: np.ndarray, config: Config) -> np.ndarray:
    """Voxeliser and SPConvNet (paper sections 4.1 and 3.1): features [H, W, C * Z] of the BEV map."""
    grid, backbone = config.grid, config.backbone
    voxels = voxelize_loop(
        points,
        minimum=grid.minimum,
        voxel_size=grid.voxel_size,
        cells=grid.cells,
        max_points=grid.max_points_per_voxel,
        max_voxels=grid.max_voxels,
        overflow=grid.overflow,
    )
    coordinates, x = voxels.coordinates, voxels.mean
    shapes = backbone.stage_shapes(grid.shape)

    def layer(name: str, shape: tuple, **geometry: Any) -> tuple[np.ndarray, np.ndarray]:
        found, y = sparse_convolution_loop(coordinates, x, layers.kernel(name), shape=shape, **geometry)
        return found, np.maximum(layers.normalize(name, y), 0)

    same = {"stride": (1, 1, 1), "padding": (1, 1, 1), "submanifold": True}
    for i, stage in enumerate(backbone.stages):
        if i > 0:
            strided = {"stride": (2, 2, 2), "padding": (stage.z_padding, 1, 1), "submanifold": False}
            coordinates, x = layer(f"stage{i}_down", shapes[i - 1], **strided)
        for j in range(stage.layers):
            coordinates, x = layer(f"stage{i}_{j}", shapes[i], **same)
    coordinates, x = layer("out", shapes[-2], stride=(2, 1, 1), padding=(0, 0, 0), submanifold=False)
    dense = np.zeros((*shapes[-1], x.shape[1]))
    dense[tuple(coordinates.T)] = x
    return dense.transpose(1, 2, 3, 0).reshape(*shapes[-1][1:], -1)


def ssfa(layers: Layer, bev: np.ndarray) -> np.ndarray:
    """Spatial-Semantic Feature Aggregation (paper section 3.2 and Figure 3)."""

    def conv(name: str, x: np.ndarray, stride: int = 1) -> np.ndarray:
        return layers.normalize(name, convolve_2d(x, layers.kernel(name), stride))

    def relu(name: str, x: np.ndarray, stride: int = 1) -> np.ndarray:
        return np.maximum(conv(name, x, stride), 0)

    def upsample(name: str, x: np.ndarray) -> np.ndarray:
        return np.maximum(layers.normalize(name, upsample_loop(x[None], layers.kernel(name))[0]), 0)

    spatial = bev
    for i in range(3):
        spatial = relu(f"spatial_{i}", spatial)
    semantic = relu("semantic_0", spatial, 2)
    for i in (1, 2):
        semantic = relu(f"semantic_{i}", semantic)
    spatial, semantic = relu("spatial_lateral", spatial), relu("semantic_lateral", semantic)
    enriched = relu("spatial_out", upsample("upsample_to_spatial", semantic) + spatial)
    raised = relu("semantic_out", upsample("upsample_semantic", semantic))
    attention = np.exp([conv("spatial_attention", enriched), conv("semantic_attention", raised)])
    weight = attention / attention.sum(0)
    return weight[0] * enriched + weight[1] * raised


def convolve_2d(x: np.ndarray, kernel: np.ndarray, stride: int = 1) -> np.ndarray:
    """Convolution of [H, W, C] by [k, k, C, O], padded by k // 2 zeros."""
    size = kernel.shape[0]
    around = size // 2
    padded = np.pad(x, ((around, around), (around, around), (0, 0)))
    height, width = x.shape[0] // stride, x.shape[1] // stride
    result = np.zeros((height, width, kernel.shape[-1]))
    for i, j in np.ndindex(size, size):
        result += padded[i : i + stride * height : stride, j : j + stride * width : stride] @ kernel[i, j]
    return result


class Decided(NamedTuple):
    """Boxes [D, 7] (x, y, z, length, width, height, yaw), scores and labels, and how far decisions were from a tie."""

    boxes: np.ndarray
    score: np.ndarray
    label: np.ndarray
    margin: float


def postprocess_by_loop(raw: Predictions, config: Config) -> Decided:
    """Confidence rectification and DI-NMS (paper section 3.4) of one scene's raw predictions."""
    detection = config.detection
    raw = Predictions(*(np.asarray(leaf, np.float64) for leaf in raw))
    probability = 1 / (1 + np.exp(-raw.class_logit))
    quality = (raw.iou + 1) / 2
    if detection.clamp_iou:
        quality = quality.clip(0, 1)
    confidence = probability * np.abs(quality) ** detection.iou_exponent
    passing = np.flatnonzero(probability >= detection.score_threshold)
    chosen = passing[np.argsort(-confidence[passing], kind="stable")]
    next_best = confidence[chosen[detection.max_candidates :]].max(initial=0)
    chosen = chosen[: detection.max_candidates]
    anchors, labels = make_anchors(config)
    boxes = decode_by_hand(raw.box[chosen], anchors.to_array()[chosen])
    distance = np.hypot(*(boxes[:, :2] - anchors.center[chosen, :2]).T)
    iou = polygon_iou_matrix(boxes) * (labels[chosen, None] == labels[None, chosen])
    threshold = np.array([one.support_threshold for one in config.classes])[labels[chosen]]
    clusters: list[Cluster] = LOOPS[detection.nms](
        boxes,
        confidence[chosen],
        quality[chosen],
        distance,
        iou,
        overlap=detection.nms_iou_threshold,
        support_threshold=threshold,
        sigma_squared=detection.sigma_squared,
        distances=detection.sigma_distances,
    )
    margin = min(
        confidence[chosen].min() - next_best,
        abs(iou - detection.nms_iou_threshold).min(),
        abs(probability - detection.score_threshold).min(),
        *(abs(one.support - threshold[one.candidate]) for one in clusters),
    )
    low = [*config.grid.minimum[:2], detection.z_limits[0]]
    high = [*config.grid.maximum[:2], detection.z_limits[1]]
    found = [one for one in clusters if one.supported and ((low <= one.box[:3]) & (one.box[:3] <= high)).all()]
    owner = chosen[[one.candidate for one in found]]
    final = np.array([one.box for one in found]).reshape(-1, 7)
    # r > 0 should agree with the direction class.
    final[:, 6] -= np.pi * ((final[:, 6] < -np.pi / 2) != raw.direction[owner].argmax(1))
    return Decided(final, np.array([one.score for one in found]), labels[owner], margin)


def decode_by_hand(residuals: np.ndarray, anchors: np.ndarray) -> np.ndarray:
    """Boxes (x, y, z, l, w, h, yaw) from residuals (x, y, z, w, l, h, r) on anchors; r = -yaw - pi / 2."""
    diagonal = np.hypot(anchors[:, 3], anchors[:, 4])
    center = residuals[:, :3] * np.stack([diagonal, diagonal, anchors[:, 5]], -1) + anchors[:, :3]
    size = np.exp(residuals[:, [4, 3, 5]]) * anchors[:, 3:6]
    return np.concatenate([center, size, anchors[:, 6:] - residuals[:, 6:]], 1)
