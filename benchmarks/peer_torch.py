"""The same detector in plain PyTorch and spconv on the CPU: a peer to compare speed and numbers with.

It follows the released configuration (preset `car_released`) from points to boxes and shares no code with
`ciassd_jax`. The camera-frustum filter is left out, because it needs a calibration. Install the extra `peer`
and run it from the repository root:

    python benchmarks/peer_torch.py --check    # compare with the reference data in ../shared
    python benchmarks/peer_torch.py            # median time of each stage over a few frames
"""

import argparse
import statistics
import sys
import time
from pathlib import Path

import numpy as np
import spconv.pytorch as spconv
import torch
from safetensors.torch import load_file
from torch import nn
from torch.nn import functional

RANGE_MIN = np.array([0.0, -40.0, -3.0], np.float32)
VOXEL_SIZE = np.array([0.05, 0.05, 0.1], np.float32)
GRID = np.array([1408, 1600, 40])  # x, y, z
SPARSE_SHAPE = [41, 1600, 1408]  # z, y, x: one empty layer on top
MAX_POINTS, MAX_VOXELS = 5, 20000
ANCHOR_SIZE = (1.6, 3.9, 1.56)
SCORE_THRESHOLD, MAX_CANDIDATES, OVERLAP, SUPPORT = 0.3, 1000, 0.3, 2.6
STAGES = ("voxelize", "sparse backbone", "neck+head", "post-processing")
BRANCHES = {"conv_box": 7, "conv_cls": 1, "conv_iou": 1, "conv_dir": 2}  # numbers an anchor
FRAMES = ("000010", "000068", "000095")

# fmt: off
SPARSE_LAYERS = (  # in, out, then the key of a submanifold layer, or kernel, stride and padding
    (4, 16, "subm0"), (16, 16, "subm0"), (16, 32, 3, 2, 1),
    (32, 32, "subm1"), (32, 32, "subm1"), (32, 64, 3, 2, 1),
    (64, 64, "subm2"), (64, 64, "subm2"), (64, 64, "subm2"), (64, 64, 3, 2, (0, 1, 1)),
    (64, 64, "subm3"), (64, 64, "subm3"), (64, 64, "subm3"), (64, 64, (3, 1, 1), (2, 1, 1), 0),
)
TOLERANCES = {
    "bev_value": 1e-4, "ssfa_value": 5e-3,
    "box_preds": 5e-4, "cls_preds": 5e-3, "dir_cls_preds": 1e-3, "iou_preds": 2e-4,
    "nms_boxes": 5e-3, "nms_scores": 1e-3, "nms_dirs": 0.0, "final_boxes": 5e-3, "final_scores": 1e-3,
}
# fmt: on


def voxelize(points: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Means of the first 5 points of each voxel (V, 4) and coordinates (V, 4) as batch, z, y, x.

    Voxels come in the order of their first point; at voxel 20001 the rest of the cloud is dropped.
    """
    points = np.ascontiguousarray(points, np.float32)
    index = np.floor((points[:, :3] - RANGE_MIN) / VOXEL_SIZE)
    inside = ((index >= 0) & (index < GRID)).all(1)
    points, index = points[inside], index[inside].astype(np.int64)
    cell = (index[:, 2] * GRID[1] + index[:, 1]) * GRID[0] + index[:, 0]
    _, first, voxel = np.unique(cell, return_index=True, return_inverse=True)
    voxel = np.argsort(np.argsort(first))[voxel]  # numbered in the order of the first point
    first = np.sort(first)
    if len(first) > MAX_VOXELS:
        points, voxel, first = points[: first[MAX_VOXELS]], voxel[: first[MAX_VOXELS]], first[:MAX_VOXELS]
    order, count = np.argsort(voxel, kind="stable"), np.bincount(voxel)
    slot = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
    order, slot = order[slot < MAX_POINTS], slot[slot < MAX_POINTS]
    stored = np.zeros((len(first), MAX_POINTS, 4), np.float32)
    stored[voxel[order], slot] = points[order]
    features = stored.sum(1) / np.minimum(count, MAX_POINTS).astype(np.float32)[:, None]
    coordinates = np.pad(index[first, ::-1], ((0, 0), (1, 0))).astype(np.int32)
    return torch.from_numpy(features), torch.from_numpy(coordinates)


def _block(conv: nn.Module, norm: type[nn.Module] = nn.BatchNorm2d) -> list[nn.Module]:
    return [conv, norm(conv.out_channels, eps=1e-3), nn.ReLU()]


def _conv(cin: int, cout: int, kernel: int, stride: int = 1) -> list[nn.Module]:
    return _block(nn.Conv2d(cin, cout, kernel, stride, kernel // 2, bias=False))


def _deconv() -> list[nn.Module]:
    return _block(nn.ConvTranspose2d(256, 128, 3, 2, padding=1, output_padding=1, bias=False))


def _sparse_conv(cin: int, cout: int, *rest) -> list[nn.Module]:
    if len(rest) == 1:
        conv = spconv.SubMConv3d(cin, cout, 3, padding=1, bias=False, indice_key=rest[0])
    else:
        conv = spconv.SparseConv3d(cin, cout, *rest, bias=False)
    return _block(conv, nn.BatchNorm1d)


class Neck(nn.Module):
    """SSFA (paper, section 3.2): a spatial and a semantic branch, mixed per cell by a softmax."""

    def __init__(self) -> None:
        super().__init__()
        # The identity stands for the released code's padding layer, which shifts the names by one.
        spatial = (*_conv(128, 128, 3), *_conv(128, 128, 3), *_conv(128, 128, 3))
        self.bottom_up_block_0 = nn.Sequential(nn.Identity(), *spatial)
        semantic = (*_conv(128, 256, 3, stride=2), *_conv(256, 256, 3), *_conv(256, 256, 3))
        self.bottom_up_block_1 = nn.Sequential(*semantic)
        self.trans_0, self.trans_1 = nn.Sequential(*_conv(128, 128, 1)), nn.Sequential(*_conv(256, 256, 1))
        self.deconv_block_0, self.deconv_block_1 = nn.Sequential(*_deconv()), nn.Sequential(*_deconv())
        self.conv_0, self.conv_1 = nn.Sequential(*_conv(128, 128, 3)), nn.Sequential(*_conv(128, 128, 3))
        self.w_0, self.w_1 = nn.Sequential(*_conv(128, 1, 1)[:2]), nn.Sequential(*_conv(128, 1, 1)[:2])

    def forward(self, bev: torch.Tensor) -> torch.Tensor:
        spatial = self.bottom_up_block_0(bev)
        semantic = self.trans_1(self.bottom_up_block_1(spatial))
        spatial = self.conv_0(self.deconv_block_0(semantic) + self.trans_0(spatial))
        semantic = self.conv_1(self.deconv_block_1(semantic))
        attention = torch.cat([self.w_0(spatial), self.w_1(semantic)], 1).softmax(1)
        return spatial * attention[:, :1] + semantic * attention[:, 1:]


class PeerDetector(nn.Module):
    """Sparse encoder, SSFA neck and head for one cloud at a time, named as in the released weights.

    The IoU branch is a 3x3 convolution without bias, or 1x1 with bias as in the published weight file.
    """

    def __init__(self, iou_kernel: int = 3) -> None:
        super().__init__()
        layers = [part for layer in SPARSE_LAYERS for part in _sparse_conv(*layer)]
        self.backbone = nn.ModuleDict({"middle_conv": spconv.SparseSequential(*layers)})
        self.neck = Neck()
        head = {name: nn.Conv2d(128, 2 * width, 1) for name, width in BRANCHES.items()}
        if iou_kernel != 1:
            head["conv_iou"] = nn.Conv2d(128, 2, iou_kernel, padding=iou_kernel // 2, bias=False)
        self.bbox_head = nn.ModuleDict({"tasks": nn.ModuleList([nn.ModuleDict(head)])})

    def encode(self, features: torch.Tensor, coordinates: torch.Tensor) -> torch.Tensor:
        """Bird's-eye-view map (1, 128, 200, 176) of voxels; channel = feature * 2 + z.

        The sparse part runs on one thread: spconv's (2.3.8) scatter-add on the CPU shares its row pointers
        between threads, so with two its sums are wrong and differ from run to run.
        """
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            sparse = spconv.SparseConvTensor(features, coordinates, SPARSE_SHAPE, batch_size=1)
            sparse = self.backbone["middle_conv"](sparse)
        finally:
            torch.set_num_threads(threads)
        # spconv's own dense() gives the same numbers, but indexes with a list, which torch deprecates.
        bev = sparse.features.new_zeros(1, 200, 176, 64, 2)
        batch, z, y, x = sparse.indices.long().unbind(1)
        bev[batch, y, x, :, z] = sparse.features
        return bev.flatten(3).permute(0, 3, 1, 2)  # channels last in memory

    def predict(self, bev: torch.Tensor) -> dict[str, torch.Tensor]:
        """Output (70400, width) of each branch in anchor order."""
        shared, head = self.neck(bev), self.bbox_head["tasks"][0]
        return {name: head[name](shared)[0].permute(1, 2, 0).reshape(-1, BRANCHES[name]) for name in BRANCHES}

    @torch.inference_mode()
    def detect(self, points: np.ndarray, timings: dict | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """Boxes (N, 7) as x, y, z, w, l, h, r and scores (N,) of one cloud (P, 4).

        `timings`, if given, receives the seconds of each stage in `STAGES`.
        """
        clock = [time.perf_counter()]

        def lap(result):
            clock.append(time.perf_counter())
            return result

        bev = lap(self.encode(*lap(voxelize(points))))
        outputs = lap(self.predict(bev))
        boxes, scores, _ = lap(finish(*suppress(*decode(outputs))))
        if timings is not None:
            timings.update(zip(STAGES, np.diff(clock).tolist(), strict=True))
        return boxes, scores


def load_peer(path: str | Path) -> PeerDetector:
    """The network in inference mode with the released parameters of a safetensors file."""
    state = {name: value.float() for name, value in load_file(path).items()}
    for name, value in state.items():
        if value.ndim == 5:  # (kD, kH, kW, Cin, Cout) of spconv 1 to (Cout, kD, kH, kW, Cin) of spconv 2
            state[name] = value.permute(4, 0, 1, 2, 3).contiguous()
    peer = PeerDetector(iou_kernel=state["bbox_head.tasks.0.conv_iou.weight"].shape[-1])
    peer.load_state_dict(state)
    peer.neck.to(memory_format=torch.channels_last)
    peer.bbox_head.to(memory_format=torch.channels_last)
    return peer.eval()


def anchors_at(number: torch.Tensor) -> torch.Tensor:
    """Anchors (N, 7) by number: rows (y) slowest, then columns (x), then the angles 0 and 1.57."""
    x, y, angle = 0.2 + number // 2 % 176 * 0.4, number // 352 * 0.4 - 39.8, number % 2 * 1.57
    fixed = torch.tensor([-1.0, *ANCHOR_SIZE]).expand(len(number), 4)
    return torch.cat([x[:, None], y[:, None], fixed, angle[:, None]], 1)


def decode(outputs: dict[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
    """At most 1000 candidates, best first: boxes, scores, predicted overlaps, directions, anchors.

    The score is sigmoid(class) * q^4 with q the predicted overlap; candidates have sigmoid(class) >= 0.3.
    """
    score = outputs["conv_cls"][:, 0].sigmoid()
    kept = torch.nonzero(score >= SCORE_THRESHOLD)[:, 0]
    quality = (outputs["conv_iou"][kept, 0] + 1) / 2
    score, order = (score[kept] * quality**4).sort(descending=True, stable=True)
    order = order[:MAX_CANDIDATES]
    kept, quality, score = kept[order], quality[order], score[:MAX_CANDIDATES]
    code, anchors = outputs["conv_box"][kept], anchors_at(kept)
    diagonal = float(np.hypot(*ANCHOR_SIZE[:2]))
    center = code[:, :3] * torch.tensor([diagonal, diagonal, ANCHOR_SIZE[2]]) + anchors[:, :3]
    boxes = torch.cat([center, code[:, 3:6].exp() * anchors[:, 3:6], code[:, 6:] + anchors[:, 6:]], 1)
    return boxes, score, quality, outputs["conv_dir"][kept].argmax(1), anchors


def _fold_into_slab(polygon: torch.Tensor, axis: int, half: torch.Tensor) -> torch.Tensor:
    """Image (P, 3V, 2) of closed polygons (P, V, 2) under clamping one coordinate to [-half, half]."""
    edge = polygon.roll(-1, 1) - polygon
    step = torch.where(edge[..., axis] == 0, 1.0, edge[..., axis])
    limits = torch.stack([-half, half], 1)[:, None]  # (P, 1, 2)
    crossing = ((limits - polygon[..., axis, None]) / step[..., None]).clamp(0, 1).sort(-1).values
    corners = polygon[:, :, None] + functional.pad(crossing, (1, 0))[..., None] * edge[:, :, None]
    corners[..., axis] = corners[..., axis].clamp(-half[:, None, None], half[:, None, None])
    return corners.flatten(1, 2)


def overlap_area(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Area of intersection (P,) of pairs of rotated rectangles (P, 5) as x, y, w, l, r.

    The outline of `a` is moved to the frame of `b` and clamped into it. Clamping flattens what is outside
    onto the border of `b`, where it encloses nothing; the area within the folded outline is the answer.
    """
    polygon = torch.tensor([[-0.5, -0.5], [-0.5, 0.5], [0.5, 0.5], [0.5, -0.5]]) * a[:, None, 2:4]
    polygon = torch.view_as_complex(polygon) * torch.exp(-1j * a[:, 4:])
    polygon = polygon + torch.view_as_complex((a - b)[:, None, :2].contiguous())
    polygon = torch.view_as_real(polygon * torch.exp(1j * b[:, 4:]))
    for axis in (0, 1):
        polygon = _fold_into_slab(polygon, axis, b[:, 2 + axis] / 2)
    x, y = polygon.unbind(-1)
    return (x * y.roll(-1, 1) - y * x.roll(-1, 1)).sum(1).abs() / 2


def pairwise_iou(boxes: torch.Tensor) -> torch.Tensor:
    """Rotated bird's-eye-view IoU (K, K); only pairs whose circumscribed circles meet are computed."""
    flat = boxes[:, [0, 1, 3, 4, 6]].double()
    radius = flat[:, 2:4].norm(dim=1) / 2
    distance = (flat[:, None, :2] - flat[None, :, :2]).norm(dim=-1)
    i, j = torch.nonzero((distance < radius[:, None] + radius).triu(1), as_tuple=True)
    area = flat[:, 2] * flat[:, 3]
    overlap = overlap_area(flat[i], flat[j])
    iou = torch.eye(len(flat), dtype=flat.dtype)
    iou[i, j] = iou[j, i] = overlap / (area[i] + area[j] - overlap)
    return iou.float()


def suppress(boxes, score, quality, direction, anchors) -> tuple[torch.Tensor, ...]:
    """The released distance-variant IoU-weighted NMS: averaged boxes, refined scores, directions.

    Support and average run over all candidates, suppressed or not, so they do not depend on the order of
    the greedy loop, which only picks the seeds. A seed at 60 m or beyond averages to NaN.
    """
    if not len(boxes):
        return boxes, score, direction
    offset = ((boxes[:, :2] - anchors[:, :2]) ** 2).sum(1)
    refined = score * (1 - offset.softmax(0))
    iou = pairwise_iou(boxes)
    free, seeds = torch.ones(len(boxes), dtype=torch.bool), []
    for seed in torch.nonzero(iou @ quality > SUPPORT)[:, 0].tolist():
        if free[seed]:
            seeds.append(seed)
            free &= iou[seed] < OVERLAP
    iou, distance = iou[seeds], boxes[seeds, :2].norm(dim=1)
    member = iou > OVERLAP
    zone = torch.bucketize(distance, torch.tensor([20.0, 40.0, 60.0]), right=True)
    variance = torch.tensor([0.0009, 0.009, 0.1, 1.0])[zone][:, None]
    weight = torch.exp(-((1 - iou) ** 2) / variance) * quality * (member & (distance < 60)[:, None])
    averaged = weight @ boxes / weight.sum(1, keepdim=True)
    return averaged, torch.where(member, refined, -torch.inf).amax(1), direction[seeds]


def finish(boxes, scores, direction) -> tuple[torch.Tensor, ...]:
    """Turn boxes by pi where the direction class says so and drop those outside the range."""
    turned = torch.where((boxes[:, 6] > 0) != (direction == 1), torch.pi, 0.0)
    boxes = torch.cat([boxes[:, :6], (boxes[:, 6] + turned)[:, None]], 1)
    low, high = torch.tensor([[0.0, -40.0, -5.0], [70.4, 40.0, 5.0]])
    inside = ((boxes[:, :3] >= low) & (boxes[:, :3] <= high)).all(1)
    return boxes[inside], scores[inside], direction[inside]


def read_points(shared: Path, frame: str) -> np.ndarray:
    """Points (P, 4) of a KITTI training frame, already cut to the camera's field of view."""
    path = shared / "kitti" / "training" / "velodyne_reduced" / f"{frame}.bin"
    return np.fromfile(path, "<f4").reshape(-1, 4)


def _worst(ours: np.ndarray, reference: np.ndarray) -> float:
    """Largest difference; infinite if the shapes or the places of NaN differ."""
    if ours.shape != reference.shape or (np.isnan(ours) != np.isnan(reference)).any():
        return np.inf
    return float(np.nanmax(np.abs(ours - reference), initial=0.0))


@torch.inference_mode()
def check(peer: PeerDetector, shared: Path) -> bool:
    """Print the worst difference of each quantity over the reference frames; True if all are tolerable."""
    worst = dict.fromkeys(TOLERANCES, 0.0)
    for frame in FRAMES:
        with np.load(shared / "golden" / "network.npz") as file:
            golden = {key[7:]: file[key] for key in file.files if key.startswith(frame)}
        points = read_points(shared, frame)
        bev = peer.encode(*voxelize(points))
        ours = {name[5:] + "_preds": value for name, value in peer.predict(bev).items()}
        ours["dir_cls_preds"] = ours.pop("dir_preds")
        ours["bev_value"] = bev.flatten()[golden["bev_index"]]
        ours["ssfa_value"] = peer.neck(bev).flatten()[golden["ssfa_index"]]
        found = suppress(*decode(peer.predict(bev)))
        ours |= dict(zip(("nms_boxes", "nms_scores", "nms_dirs"), found, strict=True))
        # Without the frustum filter there are more final boxes: take the nearest of each of the reference.
        boxes, scores = peer.detect(points)
        nearest = torch.cdist(torch.from_numpy(golden["final_boxes"]).float(), boxes, torch.inf).argmin(1)
        ours |= {"final_boxes": boxes[nearest], "final_scores": scores[nearest]}
        for name in TOLERANCES:
            worst[name] = max(worst[name], _worst(ours[name].numpy().ravel(), golden[name].ravel()))
    for name, tolerance in TOLERANCES.items():
        print(f"{name:<14}{worst[name]:9.1e}  tolerance {tolerance:.0e}")
    return all(worst[name] <= tolerance for name, tolerance in TOLERANCES.items())


def measure(peer: PeerDetector, shared: Path, repeats: int) -> None:
    """Print the median milliseconds of each stage over the reference frames."""
    runs: list[dict[str, float]] = []
    for points in (read_points(shared, frame) for frame in FRAMES):
        peer.detect(points)
        for _ in range(repeats):
            runs.append({})
            peer.detect(points, runs[-1])
    for name in STAGES:
        print(f"{name:<16}{1e3 * statistics.median(run[name] for run in runs):8.1f} ms")
    print(f"{'points to boxes':<16}{1e3 * statistics.median(sum(run.values()) for run in runs):8.1f} ms")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="compare with the reference data")
    parser.add_argument("--shared", type=Path, default=Path("../shared"), help="folder of golden/ and kitti/")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=5, help="timed runs of each frame")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    peer = load_peer(options.shared / "golden" / "weights.safetensors")
    if options.check:
        sys.exit(not check(peer, options.shared))
    measure(peer, options.shared, options.repeats)


if __name__ == "__main__":
    main()
