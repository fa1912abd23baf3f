"""The same detector in plain PyTorch and spconv on the CPU: the peer for speed and numbers.

It follows the released configuration (preset `car_released`) from points to boxes, without the frustum filter, and
shares no code with `ciassd_jax`. It needs the extra `peer`:

    python benchmarks/peer_torch.py --check    # compare with the reference data in ../shared
    python benchmarks/peer_torch.py            # median time of each stage over a few frames
"""

import argparse
import itertools
import statistics
import time
from pathlib import Path

import numpy as np
import spconv.pytorch as spconv
import torch
from safetensors.torch import load_file
from torch import nn

RANGE_MIN = np.array([0.0, -40.0, -3.0], np.float32)
VOXEL_SIZE = np.array([0.05, 0.05, 0.1], np.float32)
GRID = np.array([1408, 1600, 40])  # x, y, z
SPARSE_SHAPE = [41, 1600, 1408]  # z, y, x: one empty layer on top
MAX_POINTS, MAX_VOXELS = 5, 20000
ANCHOR_SIZE = (1.6, 3.9, 1.56)
SCORE_THRESHOLD, MAX_CANDIDATES, OVERLAP, SUPPORT = 0.3, 1000, 0.3, 2.6
STAGES = ("voxelize", "sparse backbone", "neck+head", "post-processing")
BRANCHES = {"conv_box": 7, "conv_cls": 1, "conv_iou": 1, "conv_dir": 2}  # numbers per anchor
FRAMES, REPEATS = ("000010", "000068", "000095"), 5

# fmt: off
SPARSE_LAYERS = (  # in, out; then the key of a submanifold layer, or kernel, stride and padding
    (4, 16, "subm0"), (16, 16, "subm0"), (16, 32, 3, 2, 1),
    (32, 32, "subm1"), (32, 32, "subm1"), (32, 64, 3, 2, 1),
    (64, 64, "subm2"), (64, 64, "subm2"), (64, 64, "subm2"), (64, 64, 3, 2, (0, 1, 1)),
    (64, 64, "subm3"), (64, 64, "subm3"), (64, 64, "subm3"), (64, 64, (3, 1, 1), (2, 1, 1), 0),
)
TOLERANCES = {
    "bev_value": 1e-4, "ssfa_value": 5e-3,
    "box_preds": 5e-4, "cls_preds": 5e-3, "dir_cls_preds": 1e-3, "iou_preds": 2e-4,
    "nms_boxes": 5e-3, "nms_scores": 1e-3, "nms_dirs": 0.0, "final_boxes": 5e-3,
}
# fmt: on


def voxelize(points: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the means of the first 5 points of each voxel (V, 4) and coordinates (V, 4) as batch, z, y, x."""
    points = np.ascontiguousarray(points, np.float32)
    index = np.floor((points[:, :3] - RANGE_MIN) / VOXEL_SIZE)
    inside = ((index >= 0) & (index < GRID)).all(1)
    points, index = points[inside], index[inside].astype(np.int64)
    cell = (index[:, 2] * GRID[1] + index[:, 1]) * GRID[0] + index[:, 0]
    _, first, voxel = np.unique(cell, return_index=True, return_inverse=True)
    voxel = np.argsort(np.argsort(first))[voxel]  # numbered by first point
    first = np.sort(first)
    if len(first) > MAX_VOXELS:  # the released loop stops here
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


def conv_norm_relu(cin: int, cout: int, kernel: int, stride: int = 1) -> list[nn.Module]:
    return _block(nn.Conv2d(cin, cout, kernel, stride, kernel // 2, bias=False))


def _sparse_conv(cin: int, cout: int, *rest) -> list[nn.Module]:
    if len(rest) == 1:
        conv = spconv.SubMConv3d(cin, cout, 3, padding=1, bias=False, indice_key=rest[0])
    else:
        conv = spconv.SparseConv3d(cin, cout, *rest, bias=False)
    return _block(conv, nn.BatchNorm1d)


class Neck(nn.Module):
    """SSFA (paper section 3.2): a spatial and a semantic branch, fused by a softmax per cell."""

    def __init__(self) -> None:
        super().__init__()
        # The identity replaces the released code's padding layer, which shifts the names by one.
        spatial = (*conv_norm_relu(128, 128, 3), *conv_norm_relu(128, 128, 3), *conv_norm_relu(128, 128, 3))
        self.bottom_up_block_0 = nn.Sequential(nn.Identity(), *spatial)
        semantic = (*conv_norm_relu(128, 256, 3, stride=2), *conv_norm_relu(256, 256, 3), *conv_norm_relu(256, 256, 3))
        self.bottom_up_block_1 = nn.Sequential(*semantic)
        self.trans_0, self.trans_1 = (
            nn.Sequential(*conv_norm_relu(128, 128, 1)),
            nn.Sequential(*conv_norm_relu(256, 256, 1)),
        )
        self.deconv_block_0 = nn.Sequential(*_block(nn.ConvTranspose2d(256, 128, 3, 2, 1, 1, bias=False)))
        self.deconv_block_1 = nn.Sequential(*_block(nn.ConvTranspose2d(256, 128, 3, 2, 1, 1, bias=False)))
        self.conv_0, self.conv_1 = (
            nn.Sequential(*conv_norm_relu(128, 128, 3)),
            nn.Sequential(*conv_norm_relu(128, 128, 3)),
        )
        self.w_0, self.w_1 = (
            nn.Sequential(*conv_norm_relu(128, 1, 1)[:2]),
            nn.Sequential(*conv_norm_relu(128, 1, 1)[:2]),
        )

    def forward(self, bev: torch.Tensor) -> torch.Tensor:
        spatial = self.bottom_up_block_0(bev)
        semantic = self.trans_1(self.bottom_up_block_1(spatial))
        spatial = self.conv_0(self.deconv_block_0(semantic) + self.trans_0(spatial))
        semantic = self.conv_1(self.deconv_block_1(semantic))
        attention = torch.cat([self.w_0(spatial), self.w_1(semantic)], 1).softmax(1)
        return spatial * attention[:, :1] + semantic * attention[:, 1:]


class PeerDetector(nn.Module):
    """Sparse encoder, SSFA neck and head for one cloud; parameters have the released names."""

    def __init__(self) -> None:
        super().__init__()
        layers = [part for layer in SPARSE_LAYERS for part in _sparse_conv(*layer)]
        self.backbone = nn.ModuleDict({"middle_conv": spconv.SparseSequential(*layers)})
        self.neck = Neck()
        head = {name: nn.Conv2d(128, 2 * width, 1) for name, width in BRANCHES.items()}
        head["conv_iou"] = nn.Conv2d(128, 2, 3, padding=1, bias=False)
        self.bbox_head = nn.ModuleDict({"tasks": nn.ModuleList([nn.ModuleDict(head)])})

    def encode(self, features: torch.Tensor, coordinates: torch.Tensor) -> torch.Tensor:
        """Return the BEV map (1, 128, 200, 176) of voxels; channel = feature * 2 + z."""
        # One thread for the sparse part: the CPU scatter-add of spconv 2.3.8 shares its row pointers between threads,
        # so with two the sums are wrong and differ from run to run.
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            sparse = spconv.SparseConvTensor(features, coordinates, SPARSE_SHAPE, batch_size=1)
            sparse = self.backbone["middle_conv"](sparse)
        finally:
            torch.set_num_threads(threads)
        # spconv's dense() gives the same numbers but indexes with a list, which torch deprecates.
        bev = sparse.features.new_zeros(1, 200, 176, 64, 2)
        batch, z, y, x = sparse.indices.long().unbind(1)
        bev[batch, y, x, :, z] = sparse.features
        return bev.flatten(3).permute(0, 3, 1, 2)  # channels last in memory

    def predict(self, bev: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return the output (70400, width) of each branch in anchor order."""
        shared, head = self.neck(bev), self.bbox_head["tasks"][0]
        return {name: head[name](shared)[0].permute(1, 2, 0).reshape(-1, BRANCHES[name]) for name in BRANCHES}

    @torch.inference_mode()
    def detect(self, points: np.ndarray, timings: dict | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """Return boxes (N, 7) as x, y, z, w, l, h, r and scores (N,); `timings` receives the seconds of `STAGES`."""
        clock = [time.perf_counter()]

        def lap(result):
            clock.append(time.perf_counter())
            return result

        bev = lap(self.encode(*lap(voxelize(points))))
        outputs = lap(self.predict(bev))
        boxes, scores, direction = suppress(*decode(outputs))
        boxes[:, 6] += torch.pi * ((boxes[:, 6] > 0) != (direction == 1))
        low, high = torch.tensor([[0.0, -40.0, -5.0], [70.4, 40.0, 5.0]])
        inside = ((boxes[:, :3] >= low) & (boxes[:, :3] <= high)).all(1)  # drops NaN too
        boxes, scores = lap((boxes[inside], scores[inside]))
        if timings is not None:
            timings.update(zip(STAGES, np.diff(clock).tolist(), strict=True))
        return boxes, scores


def load_peer(path: str | Path) -> PeerDetector:
    """Return the network in inference mode with the parameters of a safetensors file in the released layout."""
    # Sparse kernels: (kD, kH, kW, Cin, Cout) of spconv 1 to (Cout, kD, kH, kW, Cin) of spconv 2.
    state = {name: x.permute(4, 0, 1, 2, 3) if x.ndim == 5 else x for name, x in load_file(path).items()}
    peer = PeerDetector()
    peer.load_state_dict(state)
    nn.ModuleList([peer.neck, peer.bbox_head]).to(memory_format=torch.channels_last)
    return peer.eval()


def decode(outputs: dict[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
    """Return boxes, scores, predicted IoUs, directions and anchors of at most 1000 candidates, best first."""
    score = outputs["conv_cls"][:, 0].sigmoid()
    kept = torch.nonzero(score >= SCORE_THRESHOLD)[:, 0]
    quality = (outputs["conv_iou"][kept, 0] + 1) / 2
    score, order = (score[kept] * quality**4).sort(descending=True, stable=True)
    score, kept, quality = (part[:MAX_CANDIDATES] for part in (score, kept[order], quality[order]))
    # Anchor order: rows (y) slowest, then columns (x), then the angles 0 and 1.57.
    x, y, angle = 0.2 + kept // 2 % 176 * 0.4, kept // 352 * 0.4 - 39.8, kept % 2 * 1.57
    fixed = torch.tensor([-1.0, *ANCHOR_SIZE]).expand(len(kept), 4)
    anchors = torch.cat([x[:, None], y[:, None], fixed, angle[:, None]], 1)
    code, diagonal = outputs["conv_box"][kept], float(np.hypot(*ANCHOR_SIZE[:2]))
    center = code[:, :3] * torch.tensor([diagonal, diagonal, ANCHOR_SIZE[2]]) + anchors[:, :3]
    boxes = torch.cat([center, code[:, 3:6].exp() * anchors[:, 3:6], code[:, 6:] + anchors[:, 6:]], 1)
    return boxes, score, quality, outputs["conv_dir"][kept].argmax(1), anchors


def overlap_area(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the intersection area (P,) of pairs of rotated rectangles (P, 5) as x, y, w, l, r.

    The outline of `a` is moved to the frame of `b` and clamped to it. Parts outside `b` collapse onto its border and
    enclose no area, so the area within the clamped outline is the intersection.
    """
    outline = torch.tensor([[-0.5, -0.5], [-0.5, 0.5], [0.5, 0.5], [0.5, -0.5]]) * a[:, None, 2:4]
    outline = torch.view_as_complex(outline) * torch.exp(-1j * a[:, 4:])
    outline = outline + torch.complex(*(a - b)[:, None, :2].unbind(-1))
    outline = torch.view_as_real(outline * torch.exp(1j * b[:, 4:]))
    for axis in (0, 1):  # add two corners to every edge, where it crosses the borders of this axis
        edge, border = outline.roll(-1, 1) - outline, b[:, 2 + axis, None, None] / 2
        step = torch.where(edge[..., axis] == 0, 1.0, edge[..., axis])[..., None]
        crossing = (torch.cat([-border, border], 2) - outline[..., axis, None]) / step
        where = nn.functional.pad(crossing.clamp(0, 1).sort(-1).values, (1, 0))[..., None]
        outline = outline[:, :, None] + where * edge[:, :, None]
        outline[..., axis] = outline[..., axis].clamp(-border, border)
        outline = outline.flatten(1, 2)
    x, y = outline.unbind(-1)
    return (x * y.roll(-1, 1) - y * x.roll(-1, 1)).sum(1).abs() / 2


def pairwise_iou(boxes: torch.Tensor) -> torch.Tensor:
    """Return the rotated BEV IoU (K, K), computed only for pairs whose circumscribed circles meet."""
    flat = boxes[:, [0, 1, 3, 4, 6]].double()
    radius = flat[:, 2:4].norm(dim=1) / 2
    near = torch.cdist(flat[:, :2], flat[:, :2]) < radius[:, None] + radius + 1e-3
    i, j = torch.nonzero(near.triu(1), as_tuple=True)
    area = flat[:, 2] * flat[:, 3]
    overlap = overlap_area(flat[i], flat[j])
    iou = torch.eye(len(flat), dtype=flat.dtype)
    iou[i, j] = iou[j, i] = overlap / (area[i] + area[j] - overlap)
    return iou.float()


def suppress(boxes, score, quality, direction, anchors) -> tuple[torch.Tensor, ...]:
    """Apply the released distance-variant IoU-weighted NMS; return averaged boxes, refined scores and directions.

    Support and average use all candidates, suppressed or not, so they do not depend on the order of the greedy loop,
    which only picks the seeds. A seed at 60 m or beyond averages to NaN.
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
    iou, member = iou[seeds], iou[seeds] > OVERLAP
    zone = torch.bucketize(boxes[seeds, :2].norm(dim=1), torch.tensor([20.0, 40.0, 60.0]), right=True)
    variance = torch.tensor([0.0009, 0.009, 0.1, torch.nan])[zone][:, None]
    weight = torch.exp(-((1 - iou) ** 2) / variance) * quality * member
    averaged = weight @ boxes / weight.sum(1, keepdim=True)
    return averaged, torch.where(member, refined, -torch.inf).amax(1), direction[seeds]


@torch.inference_mode()
def check(peer: PeerDetector, clouds: dict[str, np.ndarray], golden: np.lib.npyio.NpzFile) -> bool:
    """Print the largest difference of each quantity to the reference data; return whether all are within tolerance."""
    worst = dict.fromkeys(TOLERANCES, 0.0)
    for frame, points in clouds.items():
        bev = peer.encode(*voxelize(points))
        outputs = peer.predict(bev)
        heads = ("box_preds", "cls_preds", "iou_preds", "dir_cls_preds")
        ours = dict(zip(heads, outputs.values(), strict=True))
        ours["bev_value"] = bev.flatten()[golden[f"{frame}_bev_index"]]
        ours["ssfa_value"] = peer.neck(bev).flatten()[golden[f"{frame}_ssfa_index"]]
        ours["nms_boxes"], ours["nms_scores"], ours["nms_dirs"] = suppress(*decode(outputs))
        # Without the frustum filter there are more final boxes: compare each reference box with the nearest.
        boxes, _ = peer.detect(points)
        final = torch.from_numpy(golden[f"{frame}_final_boxes"]).float()
        ours["final_boxes"] = boxes[torch.cdist(final, boxes, torch.inf).argmin(1)]
        for name in worst:
            found, expected = ours[name].numpy().ravel(), golden[f"{frame}_{name}"].ravel()
            np.testing.assert_array_equal(np.isnan(found), np.isnan(expected), name)  # also checks the shapes
            worst[name] = max(worst[name], np.nanmax(np.abs(found - expected)))
    for name, tolerance in TOLERANCES.items():
        print(f"{name:<14}{worst[name]:9.1e}  tolerance {tolerance:.0e}")
    return all(worst[name] <= tolerance for name, tolerance in TOLERANCES.items())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="compare with the reference data")
    parser.add_argument("--shared", type=Path, default=Path("../shared"), help="folder of golden/ and kitti/")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    peer = load_peer(options.shared / "golden" / "weights.safetensors")
    folder = options.shared / "kitti" / "training" / "velodyne_reduced"
    clouds = {frame: np.fromfile(folder / f"{frame}.bin", "<f4").reshape(-1, 4) for frame in FRAMES}
    if options.check:
        raise SystemExit(not check(peer, clouds, np.load(options.shared / "golden" / "network.npz")))
    runs: list[dict[str, float]] = [{} for _ in range(len(clouds) * (1 + REPEATS))]
    for run, points in zip(runs, itertools.cycle(clouds.values()), strict=False):
        peer.detect(points, run)
        run["points to boxes"] = sum(run.values())
    for name in runs[0]:  # the first round is a warm-up
        print(f"{name:<16}{1e3 * statistics.median(run[name] for run in runs[len(clouds) :]):8.1f} ms")


if __name__ == "__main__":
    main()
