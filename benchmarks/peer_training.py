"""The same training step in plain PyTorch on the CPU: the peer for speed and numbers.

It trains like preset `car`, from points to new parameters: voxeliser and dense layers of `peer_torch.py`, sparse layers
of `peer_sparse.py`, targets, losses, AdamW. It shares no code with `ciassd_jax`. It needs the extra `peer`:

    python benchmarks/peer_training.py --check      # compare losses and gradients with ours, on real frames
    python benchmarks/peer_training.py --batch 4    # time of each part of a step
"""

import argparse
import statistics
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from peer_sparse import Kernel, Pairs, SparseConvolution, pair_tables
from peer_torch import ANCHOR_SIZE, BRANCHES, SPARSE_LAYERS, Neck, conv_norm_relu, overlap_area, voxelize
from real_frames import SHARED, real_batches
from torch import nn
from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy, smooth_l1_loss

STEPS, PEAK_RATE, MAX_NORM = 55680, 3e-3, 35.0
MATCHED, UNMATCHED = 0.6, 0.45
WEIGHTS = {"classification": 1.0, "box": 2.0, "direction": 0.2, "iou": 1.0}
STAGES = (
    *("voxelize", "pair tables", "sparse forward", "dense forward", "targets and losses"),
    *("dense backward", "sparse backward", "optimizer"),
)
TERM_TOLERANCE, GRADIENT_TOLERANCE = 1e-4, 1e-2  # relative


class TrainingPeer(nn.Module):
    """The network of preset `car` for a batch of clouds; parameters have the released names."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for cin, cout, *rest in SPARSE_LAYERS:
            offsets = 3 if rest[0] == (3, 1, 1) else 27
            layers += [Kernel(cin, cout, offsets), nn.BatchNorm1d(cout, eps=1e-3), nn.ReLU(inplace=True)]
        self.backbone = nn.ModuleDict({"middle_conv": nn.ModuleList(layers)})

        def attention() -> nn.Module:
            return nn.Sequential(*conv_norm_relu(128, 1, 3)[:2])

        self.neck = Neck()
        self.neck.w_0, self.neck.w_1 = attention(), attention()
        head = {name: nn.Conv2d(128, 2 * width, 1) for name, width in BRANCHES.items()}
        self.bbox_head = nn.ModuleDict({"tasks": nn.ModuleList([nn.ModuleDict(head)])})
        for module in self.modules():
            if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
                module.momentum = 0.01

    def encode(self, features: torch.Tensor, tables: list[Pairs], sites: torch.Tensor, batch: int) -> torch.Tensor:
        """Return the BEV map (B, 128, 200, 176); channel = feature * 2 + z."""
        layers = iter(self.backbone["middle_conv"])
        for kernel, norm, relu, pairs in zip(layers, layers, layers, tables, strict=True):
            features = relu(norm(SparseConvolution.apply(features, kernel.weight, pairs)))
        bev = features.new_zeros(batch, 200, 176, 64, 2)
        scene, z, y, x = sites.long().unbind(1)
        bev[scene, y, x, :, z] = features
        return bev.flatten(3).permute(0, 3, 1, 2)  # channels last in memory

    def predict(self, bev: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return the output (B, 70400, width) of each branch in anchor order."""
        shared, head = self.neck(bev), self.bbox_head["tasks"][0]
        return {
            name: head[name](shared).permute(0, 2, 3, 1).reshape(len(bev), -1, width)
            for name, width in BRANCHES.items()
        }


def make_anchors() -> torch.Tensor:
    """Return the anchors (70400, 7) as x, y, z, w, l, h, r: y slowest, then x, then r."""
    y, x, r = np.meshgrid(np.arange(200) * 0.4 - 39.8, np.arange(176) * 0.4 + 0.2, [0, np.pi / 2], indexing="ij")
    fixed = np.broadcast_to([-1.0, *ANCHOR_SIZE], (*x.shape, 4))
    anchors = np.concatenate([x[..., None], y[..., None], fixed, r[..., None]], -1).reshape(-1, 7)
    return torch.from_numpy(anchors.astype(np.float32))


def aligned(boxes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the lowest and highest x, y (N, 2) of boxes rotated to the nearest axis."""
    r = boxes[:, 6]
    turned = ((r - torch.floor(r / torch.pi + 0.5) * torch.pi).abs() > torch.pi / 4)[:, None]
    half = torch.where(turned, boxes[:, [4, 3]], boxes[:, [3, 4]]) / 2
    return boxes[:, :2] - half, boxes[:, :2] + half


def assign(truth: torch.Tensor, anchors: torch.Tensor, corners: tuple) -> tuple[torch.Tensor, torch.Tensor]:
    """Return label (A,) of each anchor (1, 0, -1 for ignored) and the index (A,) of the box that it overlaps most."""
    if not len(truth):
        return torch.zeros(len(anchors), dtype=torch.long), torch.zeros(len(anchors), dtype=torch.long)
    low, high = (side[:, None] for side in aligned(truth))
    sides = (torch.minimum(high, corners[1]) - torch.maximum(low, corners[0])).clamp_(min=0)
    shared = sides[..., 0] * sides[..., 1]
    iou = shared / ((high - low).prod(-1) + (corners[1] - corners[0]).prod(-1) - shared)
    best, nearest = iou.max(0)
    most = iou.amax(1, keepdim=True)
    positive = (best >= MATCHED) | ((iou == most) & (most > 0)).any(0)
    return torch.where(positive, 1, torch.where(best < UNMATCHED, 0, -1)), nearest


def box_overlap(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the 3D IoU (P,) of pairs of rotated boxes (P, 7)."""
    flat = [0, 1, 3, 4, 6]
    top = torch.minimum(a[:, 2] + a[:, 5] / 2, b[:, 2] + b[:, 5] / 2)
    bottom = torch.maximum(a[:, 2] - a[:, 5] / 2, b[:, 2] - b[:, 5] / 2)
    shared = overlap_area(a[:, flat], b[:, flat]) * (top - bottom).clamp(min=0)
    return shared / (a[:, 3:6].prod(1) + b[:, 3:6].prod(1) - shared).clamp(min=1e-7)


class TrainingStep:
    """A network with optimiser and schedule; calling it runs one update."""

    def __init__(self, peer: TrainingPeer, channels_last: bool = True) -> None:
        dense = nn.ModuleList([peer.neck, peer.bbox_head])
        self.layout = torch.channels_last if channels_last else torch.contiguous_format
        dense.to(memory_format=self.layout)
        self.peer = peer.train()
        self.dtype = peer.neck.w_0[0].weight.dtype
        self.anchors = make_anchors().to(self.dtype)
        self.corners = aligned(self.anchors)
        diagonal = float(np.hypot(*ANCHOR_SIZE[:2]))
        self.steps = torch.tensor([diagonal, diagonal, ANCHOR_SIZE[2]], dtype=self.dtype)
        self.optimizer = torch.optim.AdamW(
            peer.parameters(), PEAK_RATE / 10, betas=(0.95, 0.99), weight_decay=0.01, fused=True
        )
        self.schedule = torch.optim.lr_scheduler.OneCycleLR(
            self.optimizer, PEAK_RATE, STEPS, pct_start=0.4, div_factor=10, max_momentum=0.95
        )

    def __call__(
        self, clouds: Sequence[np.ndarray], truths: Sequence[torch.Tensor], timings: dict | None = None
    ) -> dict[str, float]:
        """Return loss terms and positives per scene; a truth is (x, y, z, w, l, h, r); `timings` gets the seconds."""
        clock, batch = [time.perf_counter()], len(clouds)

        def lap(result=None):
            clock.append(time.perf_counter())
            return result

        self.optimizer.zero_grad()
        voxels = [voxelize(points) for points in clouds]
        features = torch.cat([mean for mean, _ in voxels]).to(self.dtype)
        coordinates = torch.cat([cell for _, cell in voxels])
        coordinates[:, 0] = torch.arange(batch).repeat_interleave(torch.tensor([len(mean) for mean, _ in voxels]))
        lap()
        tables, sites = lap(pair_tables(coordinates, batch))
        bev = lap(self.peer.encode(features, tables, sites, batch))
        # Detached here, so that the two halves of the backward pass can be timed.
        middle = bev.detach().contiguous(memory_format=self.layout).requires_grad_()
        outputs = lap(self.peer.predict(middle))
        terms, positives = self.losses(outputs, truths)
        total = lap(sum(WEIGHTS[name] * term for name, term in terms.items()))
        total.backward()
        lap()
        bev.backward(middle.grad)
        lap()
        nn.utils.clip_grad_norm_(self.peer.parameters(), MAX_NORM)
        self.optimizer.step()
        self.schedule.step()
        lap()
        if timings is not None:
            timings.update(zip(STAGES, np.diff(clock).tolist(), strict=True))
        return {name: term.item() for name, term in terms.items()} | {"positives": positives / batch}

    def losses(
        self, outputs: dict[str, torch.Tensor], truths: Sequence[torch.Tensor]
    ) -> tuple[dict[str, torch.Tensor], int]:
        """Return the loss terms, each divided by the scene's positives and averaged, and the number of positives."""
        assigned = [assign(truth, self.anchors, self.corners) for truth in truths]
        label = torch.stack([each for each, _ in assigned])
        weight = 1 / (label == 1).sum(1).clamp(min=1) / len(truths)
        scene, anchor = torch.nonzero(label == 1, as_tuple=True)
        goal = torch.cat([truth[near[mine == 1]] for truth, (mine, near) in zip(truths, assigned, strict=True)])

        logit, target = outputs["conv_cls"][..., 0], (label == 1).to(self.dtype)
        entropy = binary_cross_entropy_with_logits(logit, target, reduction="none")
        # The focal factor is 1 - p of the target class; entropy = -log p gives it accurately.
        focal = torch.where(label == 1, 0.25, 0.75) * (-torch.expm1(-entropy)) ** 2 * entropy
        classification = (torch.where(label >= 0, focal, 0).sum(1) * weight).sum()

        weight, anchors = weight[scene], self.anchors[anchor]
        code = outputs["conv_box"][scene, anchor]
        center, size = (goal[:, :3] - anchors[:, :3]) / self.steps, torch.log(goal[:, 3:6] / anchors[:, 3:6])
        wanted = torch.cat([center, size, goal[:, 6:] - anchors[:, 6:]], 1)
        error = code - wanted
        error = torch.cat([error[:, :6], error[:, 6:].sin()], 1)
        box = (smooth(error).sum(1) * weight).sum()
        looks = (goal[:, 6] > 0).long()
        direction = (cross_entropy(outputs["conv_dir"][scene, anchor], looks, reduction="none") * weight).sum()
        with torch.no_grad():
            sizes = code[:, 3:6].exp() * anchors[:, 3:6]
            said = torch.cat([code[:, :3] * self.steps + anchors[:, :3], sizes, code[:, 6:] + anchors[:, 6:]], 1)
            overlap = box_overlap(said, goal)
        iou = (smooth(outputs["conv_iou"][scene, anchor, 0] - (2 * overlap - 1)) * weight).sum()
        return {"classification": classification, "box": box, "direction": direction, "iou": iou}, len(scene)


def smooth(error: torch.Tensor) -> torch.Tensor:
    """Return the smooth-L1 loss with sigma 3."""
    return smooth_l1_loss(error, torch.zeros_like(error), reduction="none", beta=1 / 9)


def to_peer(scene) -> tuple[list[np.ndarray], list[torch.Tensor]]:
    """Return clouds and truth boxes of a batched `Scene`, without padding."""
    points, count = np.asarray(scene.cloud.points), np.asarray(scene.cloud.count)
    rows, label = np.asarray(scene.truth.boxes.to_array()), np.asarray(scene.truth.label)
    r = -(rows[..., 6] + np.float32(np.pi / 2))
    r = r - np.floor(r / (2 * np.pi) + 0.5) * (2 * np.pi)
    boxes = np.concatenate([rows[..., [0, 1, 2, 4, 3, 5]], r[..., None]], -1).astype(np.float32)
    clouds = [np.ascontiguousarray(cloud[:n]) for cloud, n in zip(points, count, strict=True)]
    return clouds, [torch.from_numpy(each[mine >= 0]) for each, mine in zip(boxes, label, strict=True)]


def released_layout(name: str, ours: dict, targets: dict[str, str]) -> np.ndarray:
    """Return the leaf of our variables for a released name, with the peer's axes."""
    leaf = ours
    for key in targets[name].split("/"):
        leaf = leaf[key]
    value = np.asarray(leaf)
    if value.ndim == 5:
        return value.reshape(-1, *value.shape[3:])
    return value.transpose((2, 3, 0, 1) if "deconv" in name else (3, 2, 0, 1)) if value.ndim == 4 else value


def check(shared: Path, batch: int) -> bool:
    """Run one step of ours and of the peer from the same weights and scenes; return whether both agree.

    The peer runs in float64: in float32 its losses are up to 1e-4 and its backbone gradients up to 5e-2 off.
    """
    import jax
    import optax

    import ciassd_jax
    from ciassd_jax.inference.weights import load_released_weights

    config = ciassd_jax.car()
    state = ciassd_jax.create_train_state(jax.random.key(0), config)
    report = load_released_weights(shared / "golden/weights.safetensors").report
    targets = {row.source: row.target for row in report if row.target}
    targets["bbox_head.tasks.0.conv_iou.bias"] = "params/head/iou/bias"
    peer, scene = TrainingPeer(), real_batches(shared, config, batch, 1)[0]
    ours = {"params": state.params, "batch_stats": state.batch_stats}
    for name, value in peer.state_dict().items():
        if name in targets:
            value.copy_(torch.from_numpy(released_layout(name, ours, targets).copy()))
    step = TrainingStep(peer.double())
    new_state, metrics = jax.jit(ciassd_jax.train_step)(state, scene, config)
    clouds, truths = to_peer(scene)
    said = step(clouds, [truth.double() for truth in truths])
    worst = {name: (abs(value / float(metrics[name]) - 1), TERM_TOLERANCE) for name, value in said.items()}
    # After the first step Adam's first moment is the clipped gradient times a factor that both share.
    moments = {"params": optax.tree.get(new_state.optimizer, "mu")}
    for name, parameter in peer.named_parameters():
        mine, moment = released_layout(name, moments, targets), step.optimizer.state[parameter]["exp_avg"].numpy()
        difference, part = np.linalg.norm(mine - moment) / np.linalg.norm(moment), f"gradients of {name.split('.')[0]}"
        worst[part] = (max(worst.get(part, (0.0,))[0], difference), GRADIENT_TOLERANCE)
    for name, (difference, tolerance) in worst.items():
        print(f"{name:<24}{difference:9.1e}  tolerance {tolerance:.0e}")
    return all(difference <= tolerance for difference, tolerance in worst.values())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="compare losses and gradients with ours")
    parser.add_argument("--batch", type=int, default=2)
    parser.add_argument("--steps", type=int, default=5)
    parser.add_argument("--channels-first", action="store_true", help="use channels-first dense layers")
    parser.add_argument("--shared", type=Path, default=SHARED, help="folder of golden/ and kitti/")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.check:
        raise SystemExit(not check(options.shared, options.batch))
    from ciassd_jax import car

    step = TrainingStep(TrainingPeer(), not options.channels_first)
    runs: list[dict[str, float]] = [{} for _ in range(1 + options.steps)]
    for run, scene in zip(runs, real_batches(options.shared, car(), options.batch, len(runs)), strict=True):
        step(*to_peer(scene), run)
        run["step"] = sum(run.values())
    for name in runs[0]:  # the first is a warm-up
        print(f"{name:<20}{1e3 * statistics.median(run[name] for run in runs[1:]):8.0f} ms")


if __name__ == "__main__":
    main()
