"""`Detector`: a network with its weights, for notebooks and the command line."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from ciassd_jax.config import Config
from ciassd_jax.formats.errors import FormatError
from ciassd_jax.formats.points import scale_intensity
from ciassd_jax.prediction import predict, variables_of
from ciassd_jax.types import Array, Counts, Detections, PointCloud, Variables
from ciassd_jax.weights import load_weights

if TYPE_CHECKING:
    from ciassd_jax.view.bev import Picture
    from ciassd_jax.view.html import Page

BUNDLED = Path(__file__).parent / "bundled"
# Points per bucket; four times as many for ever larger clouds.
SMALLEST_BUCKET = 32768
# Half-spaces that hold every point: no camera, no frustum.
ANYWHERE = np.tile(np.array([0, 0, 0, 1], np.float32), (6, 1))


class DroppedWarning(UserWarning):
    """Part of the input was not used; the message says how much and why."""


@dataclass(frozen=True)
class FrameResult:
    """Detections of one frame as NumPy arrays.

    `boxes` [N, 7] are x, y, z, length, width, height (metres) and yaw in [-pi, pi), in the LiDAR frame and the order
    of selection; `labels` are class names; `seconds` is the time from points to boxes without compilation.
    """

    boxes: np.ndarray
    scores: np.ndarray
    labels: tuple[str, ...]
    counts: dict[str, Any]
    seconds: float

    def __len__(self) -> int:
        return len(self.scores)

    def __repr__(self) -> str:
        head = f"{len(self)} detections in {1e3 * self.seconds:.0f} ms"
        rows = [
            f"  {label:<10} {score:.2f}  at ({x:6.2f}, {y:6.2f}, {z:5.2f})  {length:.2f} x {width:.2f} x {height:.2f} m"
            f"  yaw {yaw:+.2f}"
            for label, score, (x, y, z, length, width, height, yaw) in zip(
                self.labels[:10], self.scores, self.boxes, strict=False
            )
        ]
        more = [f"  ... and {len(self) - 10} more"] if len(self) > 10 else []
        return "\n".join([head, *rows, *more])

    def plot_bev(self, points: np.ndarray, truth: np.ndarray | None = None) -> Picture:
        """Bird's-eye view of points [N, 4], these and true boxes [G, 7]: a matplotlib figure that notebooks show."""
        from ciassd_jax.view.bev import plot_bev

        return plot_bev(np.asarray(points), self.boxes, truth, self.scores, self.labels)

    def view(self, points: np.ndarray, truth: np.ndarray | None = None, *, name: str = "points") -> Page:
        """These boxes, the points [N, 4] and true boxes [G, 7] in 3D: a page; notebooks show it, `.save(path)`."""
        from ciassd_jax.view.frames import NO_BOXES, ViewFrame
        from ciassd_jax.view.html import view_html

        true_boxes = NO_BOXES if truth is None else np.asarray(truth)
        frame = ViewFrame(name, np.asarray(points), self.boxes, self.scores, self.labels, true_boxes)
        return view_html([frame], title=name)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, strings and lists, ready for JSON."""
        return {
            "boxes": self.boxes.tolist(),
            "scores": self.scores.tolist(),
            "labels": list(self.labels),
            "counts": self.counts,
            "seconds": self.seconds,
        }


class Detector:
    """A network with its weights: points in, detections out.

    Clouds are padded to a bucket of points and the program is compiled once per bucket.
    """

    def __init__(self, variables: Variables, config: Config) -> None:
        self.config = config
        self._variables = jax.device_put(variables_of(variables))
        self._programs: dict[int, jax.stages.Compiled] = {}

    def with_variables(self, variables: Variables) -> Detector:
        """The same detector with other weights; both share their compiled programs."""
        other = Detector(variables, self.config)
        other._programs = self._programs
        return other

    @classmethod
    def from_pretrained(cls, path_or_name: str | os.PathLike[str]) -> Detector:
        """Load a weights file (`.safetensors` of ours or a released `.pth`), or bundled weights by name."""
        weights = load_weights(find_weights(path_or_name))
        return cls(weights.variables, weights.config)

    def __call__(
        self, points: Array | Sequence[Array], *, frustum: np.ndarray | None = None
    ) -> FrameResult | list[FrameResult]:
        """Detections in points [N, 4] (x, y, z in metres, intensity), or one result for each of a list of them.

        `frustum` [6, 4] (`ops.camera.frustum_planes`) drops boxes outside the camera's view. Warns where points,
        voxels, sites or candidates were dropped, and divides intensities of 0..255 by 255.
        """
        if isinstance(points, np.ndarray | jax.Array):
            return self._detect(points, frustum)
        results = []
        # No comprehension: it would be one more level between a warning and the caller's line.
        for cloud in points:
            results.append(self._detect(cloud, frustum))
        return results

    def detect(self, points: Array, *, frustum: np.ndarray | None = None) -> FrameResult:
        """Detections of one cloud; as calling the detector with it."""
        return self._detect(points, frustum)

    def _detect(self, points: Array, frustum: np.ndarray | None) -> FrameResult:
        points = _check_points(np.asarray(points))
        program = self.compile(len(points))
        start = time.perf_counter()
        planes = ANYWHERE if frustum is None else np.asarray(frustum, np.float32)
        batch = jax.device_get(program(self._variables, pad_to_bucket(points), frustum=planes[None]))
        result = frame_result(batch, self.config, time.perf_counter() - start)
        _warn_of_drops(result.counts, int((~np.isfinite(points).all(1)).sum()))
        return result

    def compile(self, num_points: int) -> jax.stages.Compiled:
        """The program for clouds of up to so many points, compiled on first use."""
        bucket = bucket_of(num_points)
        if bucket not in self._programs:
            cloud = PointCloud(np.zeros((1, bucket, 4), np.float32), np.zeros(1, np.int32))
            step = jax.jit(predict, static_argnames="config")
            self._programs[bucket] = step.lower(self._variables, cloud, self.config, frustum=ANYWHERE[None]).compile()
        return self._programs[bucket]


def bucket_of(num_points: int) -> int:
    """The padded size of a cloud of so many points: programs are compiled for a few sizes only."""
    bucket = SMALLEST_BUCKET
    while bucket < num_points:
        bucket *= 4
    return bucket


def pad_to_bucket(points: np.ndarray) -> PointCloud:
    """Points [N, 4] as a batch of one cloud, padded to its bucket."""
    padded = np.zeros((1, bucket_of(len(points)), 4), np.float32)
    padded[0, : len(points)] = points
    return PointCloud(padded, np.array([len(points)], np.int32))


def frame_result(batch: Detections, config: Config, seconds: float) -> FrameResult:
    """The detections of a batch of one scene, which took so long, as NumPy arrays."""
    scene = jax.tree.map(lambda leaf: np.asarray(leaf[0]), batch)
    count = int(scene.count)
    labels = tuple(config.class_names[label] for label in scene.label[:count])
    return FrameResult(
        scene.boxes.to_array()[:count], scene.score[:count], labels, _plain_counts(scene.counts), seconds
    )


def find_weights(path_or_name: str | os.PathLike[str]) -> Path:
    """A path as it is; the file of bundled weights for a name without suffix or folder."""
    path = Path(path_or_name)
    if path.suffix or len(path.parts) > 1:
        return path
    bundled = sorted(p.stem for p in BUNDLED.glob("*.safetensors"))
    if path.name not in bundled:
        have = f"bundled are {', '.join(bundled)}" if bundled else "none are bundled yet"
        raise FormatError(f"{path.name!r} names no bundled weights ({have}); give the path of a weights file.")
    return BUNDLED / f"{path.name}.safetensors"


def _check_points(points: np.ndarray) -> np.ndarray:
    """Points as float32 [N, 4] with intensity in [0, 1]."""
    if points.ndim != 2 or points.shape[1] != 4:
        raise ValueError(f"points have the shape {points.shape}; give [N, 4]: x, y, z in metres and intensity.")
    points, top = scale_intensity(np.asarray(points, np.float32))
    if top is not None:
        warnings.warn(
            f"{len(points)} intensities of up to {top:g} were divided by 255: the network reads [0, 1].",
            DroppedWarning,
            stacklevel=4,
        )
    return points


def _plain_counts(counts: Counts) -> dict[str, Any]:
    """Counts of one scene as nested plain numbers."""
    value = {name: np.asarray(leaf).tolist() for name, leaf in counts._asdict().items()}
    return {
        "points": {name: value[f"points_{name}"] for name in ("given", "in_range", "dropped")},
        "voxels": {name: value[f"voxels_{name}"] for name in ("kept", "dropped")},
        "sites": [
            {"kept": kept, "dropped": dropped}
            for kept, dropped in zip(value["sites_kept"], value["sites_dropped"], strict=True)
        ],
        "candidates": {name: value[f"candidates_{name}"] for name in ("kept", "dropped")},
    }


def _warn_of_drops(counts: dict[str, Any], not_finite: int) -> None:
    """One warning that names everything that was not used; none where all was."""
    lost = []
    points, voxels = counts["points"], counts["voxels"]
    if not_finite:
        lost.append(f"{not_finite} of {points['given']} points that are not finite")
    if not points["in_range"]:
        lost.append(f"all {points['given']} points, none of which is in range")
    if voxels["dropped"]:
        lost.append(
            f"{voxels['dropped']} voxels beyond the {voxels['kept']} that fit (grid.max_voxels), with "
            f"{points['dropped'] - not_finite} points"
        )
    lost += [
        f"{stage['dropped']} sites of backbone stage {i + 1} beyond the {stage['kept']} that fit (its capacity)"
        for i, stage in enumerate(counts["sites"])
        if stage["dropped"]
    ]
    if counts["candidates"]["dropped"]:
        lost.append(f"{counts['candidates']['dropped']} candidates beyond detection.max_candidates")
    if lost:
        warnings.warn("Dropped " + "; ".join(lost) + ".", DroppedWarning, stacklevel=4)
