"""`ciassd predict`: detections of one cloud, of a folder of clouds, or of a data set."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from ciassd_jax.cli.config_options import ConfigOptions
from ciassd_jax.cli.messages import UsageError, describe, tell, warnings_as_lines
from ciassd_jax.cli.options import (
    BatchSize,
    Columns,
    Dtype,
    Folder,
    ImageSize,
    Split,
    Thresholds,
    Unset,
    WeightsFile,
    check_batch_size,
    read_columns,
)
from ciassd_jax.data.clouds import CloudFile, find_clouds
from ciassd_jax.data.folders import is_custom, is_kitti
from ciassd_jax.data.splits import ALL
from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.writing import check_folder, replacing
from ciassd_jax.inference.cloud_files import ReadCloud, detect_clouds
from ciassd_jax.inference.detector import Detector
from ciassd_jax.inference.results import FrameResult, write_result
from ciassd_jax.view.bev import plot_frame
from ciassd_jax.view.html import view_html
from ciassd_jax.view.view_frame import ViewFrame
from ciassd_jax.view.viz_extra import require

# A page of more frames is slow in a browser.
_FRAMES_OF_PAGE = 20


@dataclass(frozen=True)
class Predict:
    """Detect objects in a cloud, in a folder of clouds or in the frames of a data set.

    Writes OUT/NAME.json for every cloud. A cloud with a calibration is cropped to the camera's view, and KITTI's rows
    are written as OUT/NAME.txt. Of several clouds, those that cannot be read are named at the end, with exit code 2;
    the others are done.
    """

    path: Annotated[Path, tyro.conf.Positional]
    """A .bin, .npy, .npz, .pcd or .ply file, a folder of such files, or a data set in KITTI's or OpenPCDet's custom
    layout."""
    weights: WeightsFile[Path]
    """Weights file (.safetensors, or a released .pth), or the name of bundled weights."""
    out: Folder[Path]
    """Folder for the results."""
    split: Split[Unset[str]] = None
    """The frames of a data set: all (the default), train, val, trainval, test or a file of ImageSets."""
    batch_size: BatchSize = 1
    calib: Annotated[Unset[Path], tyro.conf.arg(metavar="FILE|FOLDER")] = None
    """Calibration file, or a folder of them; found without this option in KITTI's layout."""
    png: bool = False
    """Also write OUT/NAME.png, a picture from above."""
    html: bool = False
    """Also write OUT/view.html, a 3D page of the first 20 clouds."""
    strict: bool = False
    """End at the first cloud that cannot be read."""
    image_size: ImageSize = None
    columns: Columns = None
    config_options: Annotated[ConfigOptions, tyro.conf.OmitArgPrefixes] = field(default_factory=ConfigOptions)
    dtype: Unset[Dtype] = None
    """Compute type of the network."""
    thresholds: Annotated[Thresholds, tyro.conf.OmitArgPrefixes] = field(default_factory=Thresholds)

    def run(self) -> int:
        self._check()
        problems: list[InputError] = []
        spared = problems if self.path.is_dir() and not self.strict else None
        with warnings_as_lines(self.path):
            clouds = find_clouds(
                self.path,
                split=self.split or ALL,
                calib=self.calib,
                image_size=self.image_size,
                columns=read_columns(self.columns),
                problems=spared,
            )
            detector = self._detector()
            if clouds:
                self._detect(detector, clouds, spared)
        for problem in problems:
            print(f"error: {describe(problem)}", file=sys.stderr)
        return 2 if problems else 0

    def _check(self) -> None:
        check_batch_size(self.batch_size)
        is_data_set = is_kitti(self.path) or is_custom(self.path)
        if self.split is not None and not is_data_set:
            raise UsageError(f"--split is for the root of a data set, which {self.path} is not; leave it out.")
        if self.calib is not None and is_data_set:
            raise UsageError(f"{self.path} has its own calibrations; leave out --calib.")
        try:
            require("Pictures", *["matplotlib"] * self.png)
            require("Pages", *["plotly", "PIL"] * self.html)
        except ModuleNotFoundError as error:
            raise UsageError(str(error)) from error

    def _detector(self) -> Detector:
        short = {"dtype": self.dtype, **self.thresholds.fields()}
        weights = self.config_options.load(self.weights, short)
        check_folder(self.out)
        return Detector(weights.variables, weights.config)

    def _detect(self, detector: Detector, clouds: Sequence[CloudFile], problems: list[InputError] | None) -> None:
        """Detect, write and print; the problems of single clouds are appended to `problems`."""
        from tqdm.auto import tqdm

        results: list[FrameResult] = []
        frames: list[ViewFrame] = []
        written: list[Path] = []
        outside = 0
        detected = detect_clouds(
            detector, clouds, read_columns(self.columns), batch_size=self.batch_size, problems=problems
        )
        with tqdm(detected, total=len(clouds), unit="frame", disable=None) as bar:
            for cloud, result in bar:
                frame = _view(cloud, result)
                written += self._write(cloud, result, frame)
                results.append(result)
                outside += cloud.outside
                frames += [frame] * (self.html and len(frames) < _FRAMES_OF_PAGE)
                if self.path.is_dir():
                    best = f"best {result.scores.max():.2f}" if len(result) else "none"
                    tell(f"{cloud.file.cloud.name}: {len(result)} boxes, {best}, {result.seconds:.3f} s")
        if frames:
            written.append(view_html(frames, title="ciassd predict").save(self.out / "view.html"))
        if self.path.is_dir():
            self._summarise(results, outside, len(frames))
        else:
            print(f"{self.path}: {_table(results[0])}")
            print(f"{_cropped(outside)}Wrote {' and '.join(map(str, written))}.")

    def _write(self, cloud: ReadCloud, result: FrameResult, frame: ViewFrame) -> list[Path]:
        written = write_result(result, frame.name, self.out, cloud.file.camera)
        if self.png:
            written.append(self.out / f"{frame.name}.png")
            with replacing(written[-1]) as temporary:
                plot_frame(frame).savefig(temporary, format="png")
        return written

    def _summarise(self, results: Sequence[FrameResult], outside: int, shown: int) -> None:
        seconds = sum(result.seconds for result in results) / max(len(results), 1)
        size = min(self.batch_size, len(results))
        batches = f", in batches of {size}" if size > 1 else ""
        print(
            f"{_cropped(outside)}{len(results)} frames, {sum(map(len, results))} boxes, {seconds:.3f} s per frame "
            f"without reading and compilation{batches}; results are in {self.out}."
        )
        if shown:
            others = f"; `ciassd view {self.path} --results {self.out} --names NAME` shows others"
            of_all = f"the first {shown} of {len(results)} frames{others}" if shown < len(results) else "all frames"
            print(f"{self.out / 'view.html'} shows {of_all}.")


def _view(cloud: ReadCloud, result: FrameResult) -> ViewFrame:
    return result.show_in(ViewFrame(cloud.file.cloud.stem, cloud.points, camera=cloud.file.camera))


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
