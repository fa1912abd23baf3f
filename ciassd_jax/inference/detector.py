"""`Detector`: a network with its weights, for notebooks and the command line."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, overload

import jax
import numpy as np

from ciassd_jax.config import Config
from ciassd_jax.data.cloud_hints import describe_cloud
from ciassd_jax.formats.errors import DroppedWarning, Pathlike, warn_of_file
from ciassd_jax.formats.points import check_intensity
from ciassd_jax.inference.predict import compile_predict
from ciassd_jax.inference.results import FrameResult, frame_result
from ciassd_jax.inference.weights import find_weights, load_weights
from ciassd_jax.model.checks import variables_of
from ciassd_jax.ops.camera import ANYWHERE
from ciassd_jax.ops.voxelize import MAX_INTENSITY
from ciassd_jax.types import Array, PointCloud, Variables

# Clouds are padded to this number of points, or to 4, 16, ... times as many.
SMALLEST_BUCKET = 32768


class Detector:
    """A network with its weights: points in, detections out.

    Clouds are padded to one of a few sizes, and the program is compiled once per size. Detectors whose configs differ
    only in training share their programs.
    """

    def __init__(self, variables: Variables, config: Config) -> None:
        self.config = config
        self._variables = jax.device_put(jax.device_get(variables_of(variables)))
        self._is_first = True

    @classmethod
    def from_pretrained(
        cls, path_or_name: str | os.PathLike[str], *, intensity_scale: float | None = None, z_shift: float | None = None
    ) -> Detector:
        """Load a weights file (.safetensors, or a released .pth), or bundled weights by name.

        `intensity_scale` and `z_shift` replace those of `config.input`, for clouds of another sensor.
        """
        weights = load_weights(find_weights(path_or_name))
        given = {"intensity_scale": intensity_scale, "z_shift": z_shift}
        changed = {name: float(value) for name, value in given.items() if value is not None}
        return cls(weights.variables, replace(weights.config, input=replace(weights.config.input, **changed)))

    @overload
    def __call__(self, points: Array, *, frustum: np.ndarray | None = None, source: Pathlike = ...) -> FrameResult: ...

    @overload
    def __call__(
        self, points: Sequence[Array], *, frustum: np.ndarray | None = None, source: Pathlike = ...
    ) -> list[FrameResult]: ...

    def __call__(
        self, points: Array | Sequence[Array], *, frustum: np.ndarray | None = None, source: Pathlike = "The cloud"
    ) -> FrameResult | list[FrameResult]:
        """Detect objects in points [N, 4] (x, y, z in metres, intensity), or in each of a list of clouds.

        `frustum` [6, 4] (`ops.camera.frustum_planes`) drops boxes outside the camera's view. Intensities lie between 0
        and `config.input.intensity_scale`; single ones outside are clipped. Warns of these, and of points, voxels,
        sites and candidates that were dropped, and once if the cloud is unlike what the config expects; `source` names
        the cloud. Raises InputError if many intensities lie outside, and ValueError for points of another shape.
        """
        detect = partial(self._detect, frustum=frustum, source=source)
        if isinstance(points, np.ndarray | jax.Array):
            return detect(points)
        # Unlike a comprehension, `map` adds no frame, so warnings point to the caller's line.
        return list(map(detect, points))

    def _detect(self, points: Array, *, frustum: np.ndarray | None, source: Pathlike) -> FrameResult:
        scale = self.config.input.intensity_scale
        points, clipped = check_intensity(_check_shape(points), scale, source)
        if clipped:
            text = f"{source}: {clipped} of {len(points)} intensities were clipped to [0, {scale:g}]."
            warn_of_file(text, source, stacklevel=5)
        self._describe_first(points, source)
        program = self.compile(len(points))
        start = time.perf_counter()
        planes = ANYWHERE if frustum is None else np.asarray(frustum, np.float32)
        batch = jax.device_get(program(self._variables, pad_to_bucket(points), frustum=planes[None]))
        seconds = time.perf_counter() - start
        changed = {"clipped": clipped, "invalid": self._count_invalid(points)}
        result = frame_result(batch, 0, self.config.class_names, seconds, changed)
        _warn_of_drops(result.counts)
        return result

    def _describe_first(self, points: np.ndarray, source: Pathlike) -> None:
        """Give the hints on the first cloud; those on the others would be the same."""
        if self._is_first:
            self._is_first = False
            for hint in describe_cloud(points, *self.config.range, self.config.ground, self.config.input.z_shift):
                warn_of_file(f"{source}: {hint}", source, stacklevel=6)

    def _count_invalid(self, points: np.ndarray) -> int:
        """The points that the voxelisation drops whatever its capacity."""
        most = MAX_INTENSITY * self.config.input.intensity_scale
        return int((~(np.isfinite(points).all(1) & (np.abs(points[:, 3]) <= most))).sum())

    def compile(self, num_points: int) -> jax.stages.Compiled:
        """Return the program for clouds of up to `num_points` points, compiled on first use."""
        return compile_predict(self.config.for_inference(), bucket_of(num_points))


def bucket_of(num_points: int) -> int:
    """Return the size that a cloud of `num_points` points is padded to."""
    bucket = SMALLEST_BUCKET
    while bucket < num_points:
        bucket *= 4
    return bucket


def pad_to_bucket(points: np.ndarray) -> PointCloud:
    """Return points [N, 4] as a batch of one cloud, padded to its bucket."""
    padded = np.zeros((1, bucket_of(len(points)), 4), np.float32)
    padded[0, : len(points)] = points
    return PointCloud(padded, np.array([len(points)], np.int32))


@np.errstate(over="ignore")
def _check_shape(points: Array) -> np.ndarray:
    """Return points [N, 4] as float32."""
    if np.ndim(points) != 2 or np.shape(points)[1] != 4:
        remedy = "transpose them" if np.ndim(points) == 2 and np.shape(points)[0] == 4 else "give [N, 4]"
        raise ValueError(
            f"points have the shape {np.shape(points)}; {remedy}: x, y, z in metres and intensity of each point."
        )
    return np.asarray(points, np.float32)


def _warn_of_drops(counts: dict[str, Any]) -> None:
    """Warn once of everything that was dropped, if anything was."""
    lost = []
    points, voxels = counts["points"], counts["voxels"]
    if points["invalid"]:
        lost.append(
            f"{points['invalid']} of {points['given']} points that are not finite or have an impossible intensity"
        )
    if not points["in_range"]:
        lost.append(f"all {points['given']} points, none of which is in range")
    if voxels["dropped"]:
        lost.append(
            f"{voxels['dropped']} voxels beyond the {voxels['kept']} that fit (grid.max_voxels), with "
            f"{points['dropped'] - points['invalid']} points"
        )
    lost += [
        f"{stage['dropped']} sites of backbone stage {i + 1} beyond the {stage['kept']} that fit (its capacity)"
        for i, stage in enumerate(counts["sites"])
        if stage["dropped"]
    ]
    if counts["candidates"]["dropped"]:
        lost.append(f"{counts['candidates']['dropped']} candidates beyond detection.max_candidates")
    if not points["given"]:
        warnings.warn("The cloud has no points.", DroppedWarning, stacklevel=4)
    elif lost:
        warnings.warn("Dropped " + "; ".join(lost) + ".", DroppedWarning, stacklevel=4)
