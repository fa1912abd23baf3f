"""Slow references of targets and losses: loops over anchors, with the paper's angle r."""

from __future__ import annotations

import math

import numpy as np

Limits = tuple[float, float]


def aligned(box: np.ndarray) -> tuple[float, float, float, float]:
    """(x0, y0, x1, y1) of the box (x, y, z, w, l, h, r) rotated to the nearest axis."""
    x, y, _, width, length, _, r = (float(value) for value in box)
    if abs(r - math.floor(r / math.pi + 0.5) * math.pi) > math.pi / 4:
        width, length = length, width
    return x - width / 2, y - length / 2, x + width / 2, y + length / 2


def nearest_iou_by_loop(boxes: np.ndarray, anchors: np.ndarray) -> np.ndarray:
    """Nearest IoU [A, G] in float32, from boxes and anchors (x, y, z, w, l, h, r)."""
    result = np.zeros((len(anchors), len(boxes)), np.float32)
    sides = [aligned(box) for box in boxes]
    for i, anchor in enumerate(anchors):
        x0, y0, x1, y1 = aligned(anchor)
        for j, (u0, v0, u1, v1) in enumerate(sides):
            width, height = min(x1, u1) - max(x0, u0), min(y1, v1) - max(y0, v0)
            if width > 0 and height > 0:
                shared = width * height
                result[i, j] = shared / ((x1 - x0) * (y1 - y0) + (u1 - u0) * (v1 - v0) - shared)
    return result


def assign_by_loop(iou: np.ndarray, matched: float, unmatched: float) -> tuple[np.ndarray, np.ndarray]:
    """Label and matched box of every anchor of one class, from its IoU [A, G] with the boxes of that class."""
    label, owner = np.zeros(len(iou), int), np.full(len(iou), -1)
    if not iou.size:
        return label, owner
    best_of_box = [max(iou[:, j]) for j in range(iou.shape[1])]
    for i, row in enumerate(iou):
        best = int(np.argmax(row))
        forced = any(value == most > 0 for value, most in zip(row, best_of_box, strict=True))
        if forced or row[best] >= np.float32(matched):
            label[i], owner[i] = 1, best
        elif row[best] >= np.float32(unmatched):
            label[i] = -1
    return label, owner


def encode_by_hand(box: np.ndarray, anchor: np.ndarray) -> np.ndarray:
    """Residuals of a box on an anchor, with r wrapped to [-pi, pi)."""
    x, y, z, width, length, height, r = (float(value) for value in box)
    xa, ya, za, wa, la, ha, ra = (float(value) for value in anchor)
    diagonal = math.hypot(la, wa)
    r -= math.floor(r / (2 * math.pi) + 0.5) * 2 * math.pi
    sizes = [math.log(width / wa), math.log(length / la), math.log(height / ha)]
    return np.array([(x - xa) / diagonal, (y - ya) / diagonal, (z - za) / ha, *sizes, r - ra])


def focal_by_hand(logit: float, label: int, alpha: float, gamma: float) -> float:
    """Focal loss of one anchor (paper section 3.3)."""
    if label < 0:
        return 0.0
    cross_entropy = max(logit, 0) - logit * label + math.log1p(math.exp(-abs(logit)))
    other = 1 / (1 + math.exp(logit if label else -logit))
    return (alpha if label else 1 - alpha) * other**gamma * cross_entropy


def smooth_l1_by_hand(error: float, sigma: float) -> float:
    """Smooth-L1 loss of one error."""
    beta = 1 / sigma**2
    return error**2 / (2 * beta) if abs(error) <= beta else abs(error) - beta / 2
