"""The network of `peer_torch.py` on a GPU, with spconv-triton in place of spconv.

`gpu.py` runs this file in a process of its own, so that JAX and torch do not share one. Weights are random, which does
not change the time. Post-processing is left out: the peer's loops over boxes on the host, as no deployed one does.

    python benchmarks/gpu_peer.py CLOUDS.npz --cpu     # checks this file with spconv (extra `peer`), no measurement
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

Row = dict[str, Any]


def peer_rows(clouds: Sequence[np.ndarray], batches: Sequence[int], repeats: int, seconds: float) -> Iterator[Row]:
    """Run this file for at most `seconds`, and yield its rows as it prints them."""
    with tempfile.TemporaryDirectory() as folder:
        np.savez(f"{folder}/clouds.npz", *clouds)
        command = [sys.executable, __file__, f"{folder}/clouds.npz", "--repeats", str(repeats)]
        command += ["--batches", *map(str, batches)]
        with (
            open(f"{folder}/errors", "w+") as errors,
            subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True) as process,
        ):
            timer = threading.Timer(seconds, process.kill)
            timer.start()
            try:
                yield from map(json.loads, process.stdout or ())
                status = process.wait()
                over = not timer.is_alive()
            finally:
                timer.cancel()
            errors.seek(0)
            last = (errors.read().splitlines() or [f"it ended with status {status}"])[-1]
        if over:
            yield {"skipped": f"the remaining {seconds:.0f} s were over"}
        elif status:
            yield {"error": last}


def missing() -> str | None:
    """Return why the peer cannot run here."""
    for name in ("torch", "triton", "spconv_triton"):
        if find_spec(name) is None:
            return f"{name} is not installed"
    import torch

    return None if torch.cuda.is_available() else "torch finds no GPU"


def import_peer(cpu: bool) -> Any:
    """Return `peer_torch`, which imports spconv-triton under the name of spconv."""
    if not cpu:
        import spconv_triton.pytorch

        sys.modules |= {"spconv": spconv_triton, "spconv.pytorch": spconv_triton.pytorch}
    import peer_torch

    return peer_torch


class Network:
    """The peer's network for batches, on a device."""

    def __init__(self, cpu: bool) -> None:
        import torch

        self.peer, self.device = import_peer(cpu), "cpu" if cpu else "cuda"
        torch.manual_seed(0)
        model = self.peer.PeerDetector().eval().to(self.device)
        torch.nn.ModuleList([model.neck, model.bbox_head]).to(memory_format=torch.channels_last)
        self.model, self.dtype = model, torch.float32

    def voxels(self, clouds: Sequence[np.ndarray]) -> tuple[Any, Any]:
        """Return features and coordinates of the voxels of some clouds."""
        import torch

        features, coordinates = zip(*map(self.peer.voxelize, clouds), strict=True)
        for index, each in enumerate(coordinates):
            each[:, 0] = index
        return torch.cat(features).to(self.device, self.dtype), torch.cat(coordinates).to(self.device)

    def __call__(self, features: Any, coordinates: Any, batch: int) -> dict[str, Any]:
        """Return the output (batch, anchors, width) of each branch, as `PeerDetector` does for one cloud."""
        sparse = self.peer.spconv.SparseConvTensor(features, coordinates, self.peer.SPARSE_SHAPE, batch)
        sparse = self.model.backbone["middle_conv"](sparse)
        bev = sparse.features.new_zeros(batch, 200, 176, 64, 2)
        index, z, y, x = sparse.indices.long().unbind(1)
        bev[index, y, x, :, z] = sparse.features
        shared, head = self.model.neck(bev.flatten(3).permute(0, 3, 1, 2)), self.model.bbox_head["tasks"][0]
        return {
            name: head[name](shared).permute(0, 2, 3, 1).reshape(batch, -1, width)
            for name, width in self.peer.BRANCHES.items()
        }

    def use(self, precision: str) -> None:
        """Compute in float32, TF32 or float16 from now on."""
        import torch

        tf32 = precision == "TF32"
        torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = tf32
        if self.device == "cuda":
            import spconv_triton

            spconv_triton.constants.SPCONV_ALLOW_TF32 = tf32
        self.dtype = torch.float16 if precision == "float16" else torch.float32
        self.model.to(self.dtype)


def timed(function: Callable[[], Any], wait: Callable[[], None], repeats: int) -> Row:
    """Time calls that are each waited for; the first ones compile and tune the kernels."""
    start = time.perf_counter()
    for _ in range(3):
        function()
    wait()
    tuning, seconds = time.perf_counter() - start, []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        wait()
        seconds.append(1e3 * (time.perf_counter() - start))
    times = {"median_ms": statistics.median(seconds), "min_ms": min(seconds), "max_ms": max(seconds)}
    return times | {"tuning_s": tuning}


def measure(clouds: list[np.ndarray], batches: list[int], repeats: int, cpu: bool) -> Iterator[Row]:
    """Time the network, from voxels on the device to raw predictions, in each precision and batch size."""
    import torch

    torch.backends.cudnn.benchmark = True
    network, reference = Network(cpu), None
    wait = (lambda: None) if cpu else torch.cuda.synchronize
    for precision in ("float32",) if cpu else ("float32", "TF32", "float16"):
        network.use(precision)
        for batch in batches:
            features, coordinates = network.voxels(clouds[:batch])
            row = timed(lambda given=(features, coordinates, batch): network(*given), wait, repeats)
            logit = network(features, coordinates, batch)["conv_cls"][0].float()
            reference = logit if reference is None else reference
            difference = float((logit - reference).abs().max())
            about = {"stage": "network", "dtype": precision, "batch": batch, "voxels": len(features)}
            yield about | row | {"frames_per_s": 1e3 * batch / row["median_ms"], "logit_from_float32": difference}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clouds", type=Path)
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 4, 16])
    parser.add_argument("--repeats", type=int, default=50)
    parser.add_argument("--cpu", action="store_true")
    options = parser.parse_args()
    reason = None if options.cpu else missing()
    if reason is not None:
        print(json.dumps({"not measured": reason}))
        return
    import torch

    with torch.inference_mode(), np.load(options.clouds) as clouds:
        for row in measure(list(clouds.values()), options.batches, options.repeats, options.cpu):
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
