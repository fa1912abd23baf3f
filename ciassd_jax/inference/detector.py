"""`Detector`: a network with its weights, for notebooks and the command line."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Iterable, Iterator, Sequence, Sized
from dataclasses import replace
from itertools import chain, islice, repeat
from typing import Any, NamedTuple, overload

import jax
import numpy as np

from ciassd_jax.config import Config
from ciassd_jax.data.cloud_hints import describe_cloud
from ciassd_jax.formats.errors import DroppedWarning, Pathlike, warn_of_file
from ciassd_jax.formats.points import check_intensity
from ciassd_jax.inference.predict import compile_predict
from ciassd_jax.inference.results import FrameResult, frame_result
from ciassd_jax.inference.weights import load_weights
from ciassd_jax.model.network import fitting_variables
from ciassd_jax.ops.camera import ANYWHERE
from ciassd_jax.ops.voxelize import MAX_INTENSITY
from ciassd_jax.types import Array, Detections, PointCloud, Variables

# Clouds are padded to this number of points, or to 4, 16, ... times as many.
SMALLEST_BUCKET = 32768


class CloudDetector:
    """Points in, detections out, whatever program detects them; `config` is that of its network."""

    config: Config
    # Of several clouds, how many are detected at a time.
    batch_size = 1
    _is_first = True

    def __repr__(self) -> str:
        (x, y, _), (right, left, _) = self.config.range
        area = f"x {x:g}..{right:g}, y {y:g}..{left:g} m"
        return f"{type(self).__name__}({', '.join(self.config.class_names)} in {area})"

    @overload
    def __call__(  # type: ignore[overload-overlap]  # an array is not taken for an iterable of clouds
        self,
        points: Array,
        *,
        frustum: Array | None = None,
        source: Pathlike | None = None,
        batch_size: int | None = None,
    ) -> FrameResult: ...

    @overload
    def __call__(
        self,
        points: Iterable[Array],
        *,
        frustum: Array | Iterable[Array | None] | None = None,
        source: Iterable[Pathlike] | None = None,
        batch_size: int | None = None,
    ) -> list[FrameResult]: ...

    def __call__(
        self, points: Any, *, frustum: Any = None, source: Any = None, batch_size: int | None = None
    ) -> FrameResult | list[FrameResult]:
        """Detect objects in points [N, 4] (x, y, z in metres, intensity), or in each cloud of an iterable.

        The clouds of an iterable are detected `batch_size` at a time (by default one), by a program for that many
        clouds: each batch is padded to its largest cloud, the last one with empty clouds. This changes no result.
        Clouds are taken from the iterable as they are needed.

        `frustum` [6, 4] (`ops.camera.frustum_planes`) drops boxes outside the camera's view; for several clouds it is
        one for all, or an iterable with one or None for each. `source` is the name of the cloud in messages; for
        several clouds an iterable of names.

        Intensities lie between 0 and `config.input.intensity_scale`; single ones outside are clipped. Warns of these,
        and of points, voxels, sites and candidates that were dropped, and once if the cloud is unlike what the config
        expects. Raises InputError if many intensities lie outside, and ValueError for arguments of another shape and
        for a batch size below 1.
        """
        batch_size = self.batch_size if batch_size is None else batch_size
        if not isinstance(batch_size, int | np.integer) or batch_size < 1:
            raise ValueError(f"batch_size is {batch_size!r}; give a whole number of at least 1.")
        if isinstance(points, np.ndarray | jax.Array):
            return self._detect([_Cloud(points, frustum, "The cloud" if source is None else source)], 1)[0]
        batches = _batches(_each_cloud(points, frustum, source), int(batch_size))
        # Unlike a comprehension, `map` adds no frame, so warnings point to the caller's line.
        return list(chain.from_iterable(map(self._detect, batches, repeat(int(batch_size)))))

    def _detect(self, clouds: Sequence[_Cloud], batch_size: int) -> list[FrameResult]:
        """Detect objects in up to `batch_size` clouds at once."""
        scale, checked = self.config.input.intensity_scale, []
        for points, _, source in clouds:
            points, clipped = check_intensity(_check_shape(points, source), scale, source)
            if clipped:
                text = f"{source}: {clipped} of {len(points)} intensities were clipped to [0, {scale:g}]."
                warn_of_file(text, source, stacklevel=4)
            self._describe_first(points, source)
            checked.append((points, {"clipped": clipped, "invalid": self._count_invalid(points)}))
        frustum = np.stack([_planes_of(cloud) for cloud in clouds] + [ANYWHERE] * (batch_size - len(clouds)))
        batch, seconds = self._run([points for points, _ in checked], frustum)
        results = []
        for index, (_, changed) in enumerate(checked):
            results.append(frame_result(batch, index, self.config.class_names, seconds / len(clouds), changed))
            _warn_of_drops(results[-1].counts, clouds[index].source)
        return results

    def _run(self, clouds: Sequence[np.ndarray], frustum: np.ndarray) -> tuple[Detections, float]:
        """Return the detections of a batch, which has a frustum for each place, and the seconds without compilation."""
        raise NotImplementedError

    def _describe_first(self, points: np.ndarray, source: Pathlike) -> None:
        """Give the hints on the first cloud; those on the others would be the same."""
        if self._is_first:
            self._is_first = False
            for hint in describe_cloud(points, *self.config.range, self.config.ground, self.config.input.z_shift):
                warn_of_file(f"{source}: {hint}", source, stacklevel=5)

    def _count_invalid(self, points: np.ndarray) -> int:
        """The points that the voxelisation drops whatever its capacity."""
        most = MAX_INTENSITY * self.config.input.intensity_scale
        return int((~(np.isfinite(points).all(1) & (np.abs(points[:, 3]) <= most))).sum())


class Detector(CloudDetector):
    """A network with its weights: points in, detections out.

    Clouds are padded to one of a few sizes, and the program is compiled once per size. Detectors whose configs differ
    only in training share their programs. `variables` and `config` are those of the network. Raises ValueError for
    variables that do not fit the config.
    """

    def __init__(self, variables: Variables, config: Config) -> None:
        self.config = config
        self.variables = jax.device_put(jax.device_get(fitting_variables(variables, config)))

    @classmethod
    def from_pretrained(
        cls, path_or_name: str | os.PathLike[str], *, intensity_scale: float | None = None, z_shift: float | None = None
    ) -> Detector:
        """Load a weights file (.safetensors, or a released .pth), or bundled weights by name.

        `intensity_scale` and `z_shift` replace those of `config.input`, for clouds of another sensor.
        """
        weights = load_weights(path_or_name)
        given = {"intensity_scale": intensity_scale, "z_shift": z_shift}
        changed = {name: float(value) for name, value in given.items() if value is not None}
        return cls(weights.variables, replace(weights.config, input=replace(weights.config.input, **changed)))

    def _run(self, clouds: Sequence[np.ndarray], frustum: np.ndarray) -> tuple[Detections, float]:
        program = self.compile(max(map(len, clouds)), len(frustum))
        start = time.perf_counter()
        padded = pad_to_bucket(*clouds, batch_size=len(frustum))
        return jax.device_get(program(self.variables, padded, frustum=frustum)), time.perf_counter() - start

    def compile(self, num_points: int, batch_size: int = 1) -> jax.stages.Compiled:
        """Return the program for `batch_size` clouds of up to `num_points` points, compiled on first use."""
        return compile_predict(self.config.for_inference(), bucket_of(num_points), batch_size)


class _Cloud(NamedTuple):
    """One of the clouds that a detector is called with."""

    points: Array
    frustum: Array | None
    source: Pathlike


def bucket_of(num_points: int) -> int:
    """Return the size that a cloud of `num_points` points is padded to."""
    bucket = SMALLEST_BUCKET
    while bucket < num_points:
        bucket *= 4
    return bucket


def pad_to_bucket(*clouds: np.ndarray, batch_size: int = 1) -> PointCloud:
    """Return clouds [N, 4] as a batch: padded to the bucket of the largest, and by empty clouds to `batch_size`."""
    return pad_clouds(clouds, batch_size, bucket_of(max(map(len, clouds))))


def pad_clouds(clouds: Sequence[np.ndarray], batch_size: int, num_points: int) -> PointCloud:
    """Return clouds [N, 4] as a batch [batch_size, num_points, 4], filled with zeros."""
    count = np.array([len(points) for points in clouds] + [0] * (batch_size - len(clouds)), np.int32)
    padded = np.zeros((batch_size, num_points, 4), np.float32)
    for row, points in zip(padded, clouds, strict=False):
        row[: len(points)] = points
    return PointCloud(padded, count)


def _each_cloud(points: Iterable[Array], frustum: Any, source: Iterable[Pathlike] | None) -> Iterator[_Cloud]:
    """Yield each cloud with its frustum and its name."""
    if isinstance(source, str | os.PathLike):
        source = [source]
    shared = frustum is None or (isinstance(frustum, np.ndarray | jax.Array) and frustum.ndim == 2)
    lists = [points] + [frustum] * (not shared) + [source] * (source is not None)
    lengths = [len(given) for given in lists if isinstance(given, Sized)]
    if len(set(lengths)) > 1:
        counts = " and ".join(map(str, lengths))
        raise ValueError(f"points, frustum and source differ in length ({counts}); give one of each for every cloud.")
    for index, (cloud, *own) in enumerate(zip(*lists, strict=True)):
        name = f"Cloud {index}" if source is None else own.pop()
        yield _Cloud(cloud, frustum if shared else own.pop(), name)


def _batches(clouds: Iterator[_Cloud], batch_size: int) -> Iterator[list[_Cloud]]:
    while batch := list(islice(clouds, batch_size)):
        yield batch


@np.errstate(over="ignore")
def _check_shape(points: Array, source: Pathlike) -> np.ndarray:
    """Return points [N, 4] as float32."""
    shape = np.shape(points)
    if len(shape) != 2 or shape[1] != 4:
        remedy = "transpose them" if len(shape) == 2 and shape[0] == 4 else "give [N, 4]"
        raise ValueError(
            f"{source}: points have the shape {shape}; {remedy}: x, y, z in metres and intensity of each point."
        )
    return np.asarray(points, np.float32)


def _planes_of(cloud: _Cloud) -> np.ndarray:
    """Return the frustum of a cloud as float32 [6, 4]."""
    planes = ANYWHERE if cloud.frustum is None else np.asarray(cloud.frustum, np.float32)
    if planes.shape != ANYWHERE.shape:
        raise ValueError(
            f"{cloud.source}: its frustum has the shape {planes.shape}; give the planes [6, 4] of "
            "`ops.camera.frustum_planes`."
        )
    return planes


def _warn_of_drops(counts: dict[str, Any], source: Pathlike) -> None:
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
        warnings.warn(DroppedWarning(f"{source} has no points.", source), stacklevel=4)
    elif lost:
        warnings.warn(DroppedWarning(f"{source}: dropped {'; '.join(lost)}.", source), stacklevel=4)
