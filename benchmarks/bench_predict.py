"""How long does a real frame take from points to boxes, compared with the same network in torch + spconv?

Command: pip install -e '.[peer]' && python benchmarks/bench_predict.py [--frames 10] [--shared ../shared]

Both detectors process the same frames alternately, on the same cores, after one warm-up each. Peak memory is measured
in a separate process for each. `--preset car_lite` times an untrained network of that preset without the peer.

`--weights car_lite --frames 16 --batch-sizes 1 4 8` times a detector with these weights in batches, without the peer.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
from functools import partial
from pathlib import Path

import jax
import numpy as np
from real_frames import SHARED

import ciassd_jax
from ciassd_jax.config.presets import PRESETS
from ciassd_jax.data.clouds import find_clouds, read_cloud
from ciassd_jax.formats.kitti_camera import frustum_of
from ciassd_jax.inference.timing import timed


def load_frames(shared: Path, number: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return points and frustum of evenly spaced real frames."""
    clouds = find_clouds(shared / "kitti/training/velodyne_reduced")
    chosen = clouds[:: max(1, len(clouds) // number)][:number]
    return [(read_cloud(cloud)[0], frustum_of(cloud.camera)) for cloud in chosen]


def our_detector(shared: Path, preset: str | None) -> ciassd_jax.Detector:
    """Return a detector with the reference weights, or an untrained one of a preset."""
    if preset is None:
        return ciassd_jax.Detector.from_pretrained(shared / "golden/weights.pth")
    config = PRESETS[preset]()
    return ciassd_jax.Detector(ciassd_jax.init_variables(jax.random.key(0), config), config)


def measure_batches(weights: str, arguments: argparse.Namespace) -> None:
    """Time passes over all frames in batches of each size, alternately, and print one line for each size."""
    detector = ciassd_jax.Detector.from_pretrained(weights)
    clouds, frustums = zip(*load_frames(arguments.shared, arguments.frames), strict=True)
    seconds: dict[int, list[float]] = {size: [] for size in arguments.batch_sizes}
    for repeat in range(1 + arguments.repeats):
        for size, values in seconds.items():
            taken, _ = timed(partial(detector, clouds, frustum=frustums, batch_size=size))
            # The first pass compiles.
            values += [taken / len(clouds)] * (repeat > 0)
    for size, values in seconds.items():
        median = statistics.median(values)
        print(
            f"batch {size}: {1e3 * median:.0f} ms per frame (median of {len(values)} passes over {len(clouds)} frames; "
            f"{1e3 * min(values):.0f} to {1e3 * max(values):.0f}), {1 / median:.1f} frames/s"
        )


def peer_detector(shared: Path):
    """Return the detection of the same network in torch + spconv on two threads."""
    import torch
    from peer_torch import load_peer

    torch.set_num_threads(2)
    return load_peer(shared / "golden/weights.safetensors").detect


def measure_alone(kind: str, arguments: argparse.Namespace) -> None:
    """Run one detector over the frames and print the peak memory of this process in MB."""
    detector = our_detector(arguments.shared, arguments.preset) if kind == "ours" else peer_detector(arguments.shared)
    for points, _ in load_frames(arguments.shared, arguments.frames):
        detector(points)
    # Not getrusage, whose maximum is inherited from the parent process.
    status = Path("/proc/self/status").read_text()
    print(int(status.split("VmHWM:")[1].split()[0]) / 1e3)


def peak_memory(kind: str, arguments: argparse.Namespace) -> float:
    """Return the peak memory in MB of a fresh process that runs one detector."""
    command = [sys.executable, __file__, "--alone", kind, "--frames", str(arguments.frames)]
    command += ["--shared", str(arguments.shared)] + (["--preset", arguments.preset] if arguments.preset else [])
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1])


def main() -> None:
    """Time both detectors alternately and print one line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--shared", type=Path, default=SHARED)
    parser.add_argument("--preset", choices=sorted(PRESETS))
    parser.add_argument("--weights", default="car_lite", help="file or name, for --batch-sizes")
    parser.add_argument("--batch-sizes", type=int, nargs="+")
    parser.add_argument("--alone", choices=("ours", "peer"))
    arguments = parser.parse_args()
    if arguments.alone:
        measure_alone(arguments.alone, arguments)
        return
    if arguments.batch_sizes:
        measure_batches(arguments.weights, arguments)
        return
    frames = load_frames(arguments.shared, arguments.frames)
    detectors = {"ours": our_detector(arguments.shared, arguments.preset)}
    if arguments.preset is None:
        detectors["peer"] = peer_detector(arguments.shared)
    seconds: dict[str, list[float]] = {name: [] for name in detectors}
    for detector in detectors.values():
        detector(frames[0][0])
    for _ in range(arguments.repeats):
        for points, planes in frames:
            for name, detector in detectors.items():
                options = {"frustum": planes} if name == "ours" else {}
                seconds[name].append(timed(partial(detector, points, **options))[0])
    for name, values in seconds.items():
        print(
            f"{name}: {1e3 * statistics.median(values):.0f} ms per frame (median; {1e3 * min(values):.0f} to "
            f"{1e3 * max(values):.0f}), {1 / statistics.median(values):.1f} frames/s, "
            f"peak {peak_memory(name, arguments):.0f} MB"
        )
    if "peer" in seconds:
        ratio = statistics.median(a / b for a, b in zip(seconds["ours"], seconds["peer"], strict=True))
        print(f"ours / peer: {ratio:.2f} (median over {len(seconds['ours'])} frames)")


if __name__ == "__main__":
    main()
