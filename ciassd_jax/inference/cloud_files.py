"""Detection in files of points, such as those of a folder: in batches, while a thread reads the next ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from ciassd_jax.data.ahead import read_ahead
from ciassd_jax.data.clouds import CloudFile, read_cloud
from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.kitti_camera import frustum_of
from ciassd_jax.formats.points import check_intensity
from ciassd_jax.inference.detector import Detector
from ciassd_jax.inference.results import FrameResult


class ReadCloud(NamedTuple):
    """A file, its points that the camera sees, and the number of those that it does not see."""

    file: CloudFile
    points: Float32[np.ndarray, "P 4"]
    outside: int


def detect_clouds(
    detector: Detector,
    clouds: Sequence[CloudFile],
    columns: int | Sequence[str] | None = None,
    *,
    batch_size: int = 1,
    problems: list[InputError] | None = None,
) -> Iterator[tuple[ReadCloud, FrameResult]]:
    """Yield each cloud and its detections, in order; `batch_size` clouds are detected at once.

    `columns` are those of `read_points`. Raises InputError for a cloud that cannot be used. With a list of `problems`,
    the errors are appended to it instead, and the other clouds are detected.
    """
    # A program for more clouds than there are would only compile longer.
    batch_size = min(batch_size, len(clouds))
    readable = _readable(detector.config.input.intensity_scale, clouds, columns, batch_size, problems)
    while batch := list(islice(readable, batch_size)):
        results = detector(
            [cloud.points for cloud in batch],
            frustum=[frustum_of(cloud.file.camera) for cloud in batch],
            source=[cloud.file.cloud for cloud in batch],
            batch_size=batch_size,
        )
        yield from zip(batch, results, strict=True)


def _readable(
    scale: float,
    clouds: Sequence[CloudFile],
    columns: int | Sequence[str] | None,
    ahead: int,
    problems: list[InputError] | None,
) -> Iterator[ReadCloud]:
    """Yield the clouds that a detector with this intensity scale can use."""

    def read(file: CloudFile) -> ReadCloud:
        points, outside = read_cloud(file, columns)
        # The detector checks it too, but an error there would cost the whole batch.
        check_intensity(points, scale, file.cloud)
        return ReadCloud(file, points, outside)

    for take in read_ahead(read, clouds, ahead):
        try:
            cloud = take()
        except InputError as error:
            if problems is None:
                raise
            problems.append(error)
        else:
            yield cloud
