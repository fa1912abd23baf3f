"""`Detector`: a network with its weights, for notebooks and the command line."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from ciassd_jax.config import Config
from ciassd_jax.formats.errors import DroppedWarning
from ciassd_jax.formats.points import scale_intensity
from ciassd_jax.inference.predict import predict
from ciassd_jax.inference.results import FrameResult, frame_result
from ciassd_jax.inference.weights import find_weights, load_weights
from ciassd_jax.model.network import variables_of
from ciassd_jax.ops.camera import ANYWHERE
from ciassd_jax.types import Array, PointCloud, Variables

# Points per bucket; four times as many for ever larger clouds.
SMALLEST_BUCKET = 32768


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
