"""`ciassd predict`: detections of one cloud, or of a folder of clouds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from ciassd_jax.cli.config_options import ConfigOptions
from ciassd_jax.cli.messages import warnings_as_lines
from ciassd_jax.cli.options import Columns, Dtype, ImageSize, MinScore, ScoreThreshold, Unset, read_columns
from ciassd_jax.data.clouds import CloudFile, find_clouds, read_cloud
from ciassd_jax.formats.kitti_camera import frustum_of
from ciassd_jax.formats.writing import check_folder
from ciassd_jax.inference.detector import Detector
from ciassd_jax.inference.results import FrameResult, write_result


@dataclass(frozen=True)
class Predict:
    """Detect objects in a cloud or a folder of clouds.

    Writes OUT/NAME.json for every cloud. A cloud with a calibration is cropped to the camera's view, and KITTI's rows
    are written as OUT/NAME.txt.
    """

    path: Annotated[Path, tyro.conf.Positional]
    """A .bin, .npy, .npz, .pcd or .ply file, or a folder of such files."""
    weights: Path
    """Weights file (.safetensors, or a released .pth), or the name of bundled weights."""
    out: Path
    """Folder for the results."""
    calib: Unset[Path] = None
    """Calibration file, or a folder of them; found without this option in KITTI's layout."""
    image_size: ImageSize = None
    columns: Columns = None
    config_options: Annotated[ConfigOptions, tyro.conf.OmitArgPrefixes] = field(default_factory=ConfigOptions)
    dtype: Unset[Dtype] = None
    """Compute type of the network."""
    score_threshold: ScoreThreshold = None
    min_score: MinScore = None

    def run(self) -> int:
        clouds = find_clouds(
            self.path, calib=self.calib, image_size=self.image_size, columns=read_columns(self.columns)
        )
        short = {
            "dtype": self.dtype,
            "detection.score_threshold": self.score_threshold,
            "detection.min_score": self.min_score,
        }
        weights = self.config_options.load(self.weights, short)
        check_folder(self.out)
        detector = Detector(weights.variables, weights.config)
        if self.path.is_dir():
            with warnings_as_lines(self.path):
                self._folder(detector, clouds)
        else:
            with warnings_as_lines(self.path):
                result, written, cropped = self._cloud(detector, clouds[0])
            print(f"{self.path}: {_table(result)}")
            print(f"{_cropped(cropped)}Wrote {' and '.join(map(str, written))}.")
        return 0

    def _cloud(self, detector: Detector, cloud: CloudFile) -> tuple[FrameResult, list[Path], int]:
        """Detect, write, and return the number of points that the camera does not see."""
        points, cropped = read_cloud(cloud, read_columns(self.columns))
        result = detector(points, frustum=frustum_of(cloud.camera), source=cloud.cloud)
        return result, write_result(result, cloud.cloud.stem, self.out, cloud.camera), cropped

    def _folder(self, detector: Detector, clouds: Sequence[CloudFile]) -> None:
        from tqdm.auto import tqdm

        boxes, seconds, cropped = 0, 0.0, 0
        with tqdm(clouds, unit="frame", disable=None) as bar:
            for cloud in bar:
                result, _, outside = self._cloud(detector, cloud)
                best = f"best {result.scores.max():.2f}" if len(result) else "none"
                bar.write(f"{cloud.cloud.name}: {len(result)} boxes, {best}, {result.seconds:.3f} s")
                boxes, seconds, cropped = boxes + len(result), seconds + result.seconds, cropped + outside
        print(
            f"{_cropped(cropped)}{len(clouds)} frames, {boxes} boxes, {seconds / len(clouds):.3f} s per frame without "
            f"reading and compilation; results are in {self.out}."
        )


def _cropped(number: int) -> str:
    """A sentence on the points that were left out, or nothing."""
    return f"Left out {number} points that the camera does not see, as in evaluation. " if number else ""


def _table(result: FrameResult) -> str:
    """The number of detections and a row for each."""
    rows = [f"{len(result)} detections in {1e3 * result.seconds:.0f} ms"]
    if len(result):
        rows.append("  class       score       x       y       z  length   width  height     yaw")
    for label, score, box in zip(result.labels, result.scores, result.boxes, strict=True):
        rows.append(f"  {label:<10} {score:>6.3f} " + " ".join(f"{value:>7.2f}" for value in box))
    return "\n".join(rows)
