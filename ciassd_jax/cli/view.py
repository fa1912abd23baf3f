"""`ciassd view`: frames in 3D, as one page for a browser."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from ciassd_jax.cli.config_options import ConfigOptions
from ciassd_jax.cli.messages import UsageError, frames_with_bar, warnings_as_lines
from ciassd_jax.cli.options import (
    SIMULATED,
    Columns,
    File,
    Folder,
    ImageSize,
    Split,
    Thresholds,
    Unset,
    WeightsFile,
    open_simulated,
    read_columns,
)
from ciassd_jax.formats.errors import FormatWarning, InputError, warn_of_file
from ciassd_jax.formats.kitti_camera import frustum_of
from ciassd_jax.formats.points import check_intensity
from ciassd_jax.formats.writing import check_file
from ciassd_jax.inference.detector import Detector
from ciassd_jax.view.html import view_html
from ciassd_jax.view.sources import Source, add_saved, dataset_sources, detector_points, find_sources, read_source
from ciassd_jax.view.view_frame import ViewFrame, mark_targets
from ciassd_jax.view.viz_extra import require


@dataclass(frozen=True)
class View:
    """Show points, labelled boxes and detections in 3D: writes one page for any browser, which needs no network."""

    path: Annotated[str, tyro.conf.Positional]
    """A cloud, a folder of clouds, a data set in KITTI's or OpenPCDet's custom layout, or the word simulated."""
    out: File[Path] = Path("view.html")
    """The page to write."""
    weights: WeightsFile[Unset[Path]] = None
    """Detect objects with these weights."""
    results: Folder[Unset[Path]] = None
    """Or show the detections that `ciassd predict` or `ciassd eval --out` wrote to this folder: NAME.json or .txt."""
    frames: int = 20
    """Number of frames to show, the first ones, or to simulate."""
    names: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...", help_behavior_hint="")] = ()
    """Or the names of the frames to show."""
    split: Split[str] = "all"
    """The frames of a data set: all, train, val, trainval, test or a file of ImageSets."""
    seed: int = 0
    """Seed of simulated frames."""
    image: bool = False
    """Also show the camera's image, with the boxes projected into it."""
    image_size: ImageSize = None
    columns: Columns = None
    thresholds: Annotated[Thresholds, tyro.conf.OmitArgPrefixes] = field(default_factory=Thresholds)
    config_options: Annotated[ConfigOptions, tyro.conf.OmitArgPrefixes] = field(default_factory=ConfigOptions)

    def run(self) -> int:
        self._check()
        check_file(self.out)
        with warnings_as_lines(self.path):
            frames = self._read()
            page = view_html(frames, title=f"{Path(self.path).name or self.path} - ciassd view")
        page.save(self.out)
        boxes = f"{sum(len(f.truth) for f in frames)} labelled and {sum(len(f.boxes) for f in frames)} detected boxes"
        number = "1 frame" if len(frames) == 1 else f"{len(frames)} frames"
        print(f"Wrote {self.out}: {number}, {boxes}, {len(page.html) / 1e6:.1f} MB; open it in a browser.")
        return 0

    def _check(self) -> None:
        try:
            require("Pages", "plotly", "PIL")
        except ModuleNotFoundError as error:
            raise UsageError(str(error)) from error
        if self.weights and self.results:
            raise UsageError("--weights detects objects and --results shows saved detections; give one of them.")
        if self.thresholds.score_threshold is not None and not self.weights:
            raise UsageError("--score-threshold is for detecting; give --weights too, or use --min-score.")
        if self.thresholds.min_score is not None and not (self.weights or self.results):
            raise UsageError("--min-score is for detections; give --weights or --results too.")
        if self.frames < 1:
            raise UsageError(f"--frames {self.frames} shows nothing; ask for at least 1.")
        if self.out.suffix.lower() not in (".html", ".htm"):
            raise UsageError(f"--out {self.out} must end in .html; choose such a name.")
        if self.results and not self.results.is_dir():
            raise UsageError(f"{self.results} is not a folder; give the folder that holds the results.")

    def _read(self) -> list[ViewFrame]:
        """The chosen frames with their detections."""
        sources = self._choose(self._sources())
        if self.image and not any(source.image for source in sources.values()):
            raise UsageError(f"{self.path} has no images; leave out --image.")
        short = self.thresholds.fields()
        weights = self.config_options.load(self.weights, short) if self.weights else None
        config = weights.config if weights else self.config_options.resolve(short=short)
        frames = [read_source(sources[name], image=self.image) for name in frames_with_bar(list(sources))]
        if weights is not None:
            detector = Detector(weights.variables, config)
            if cropped := sum(frame.whole and frame.camera is not None for frame in frames):
                print(f"In {cropped} whole clouds the detector gets the points that the camera sees, as in evaluation.")
            return [mark_targets(_detect(detector, frame), config) for frame in frames_with_bar(frames)]
        for frame in frames:
            _check_intensity(frame, config.input.intensity_scale)
        if self.config_options.preset or self.config_options.config:
            frames = [mark_targets(frame, config) for frame in frames]
        return (
            frames if self.results is None else _add_saved(frames, self.results, config.detection.min_score or -np.inf)
        )

    def _sources(self) -> dict[str, Source]:
        if self.path != SIMULATED:
            return find_sources(Path(self.path), self.split, self.image_size, read_columns(self.columns))
        return dataset_sources(open_simulated(self.split, self.frames, self.seed))

    def _choose(self, sources: dict[str, Source]) -> dict[str, Source]:
        """The named frames, or the first ones; prints how many there are if not all are shown."""
        unknown = [name for name in self.names if name not in sources]
        if unknown:
            some = ", ".join(list(sources)[:3]) + (", ..." if len(sources) > 3 else "")
            raise UsageError(f"{self.path} has no frame {unknown[0]}; it has {some}.")
        if self.names:
            return {name: sources[name] for name in self.names}
        if len(sources) > self.frames:
            print(f"Showing the first {self.frames} of {len(sources)} frames; --frames shows more, --names others.")
        return dict(list(sources.items())[: self.frames])


def _detect(detector: Detector, frame: ViewFrame) -> ViewFrame:
    """The frame with its detections; with a camera only those that it sees."""
    with warnings_as_lines(frame.name):
        return detector(detector_points(frame), frustum=frustum_of(frame.camera), source=frame.name).show_in(frame)


def _check_intensity(frame: ViewFrame, scale: float) -> None:
    """Warn of a cloud that a detector would refuse; the page does not show intensities."""
    try:
        _, clipped = check_intensity(np.asarray(frame.points, np.float32), scale, frame.name)
    except InputError as error:
        warn_of_file(f"A detector would refuse it: {error}", frame.name)
        return
    if clipped:
        warn_of_file(f"{frame.name}: {clipped} intensities lie outside [0, {scale:g}].", frame.name)


def _add_saved(frames: Sequence[ViewFrame], folder: Path, min_score: float) -> list[ViewFrame]:
    """The frames with their saved detections from this score; warns of the number of frames without any."""
    found = [add_saved(frame, folder, min_score) for frame in frames]
    lacking = [frame.name for frame, with_saved in zip(frames, found, strict=True) if with_saved is None]
    if len(lacking) == len(frames):
        raise InputError(
            f"{folder} has neither {lacking[0]}.json nor {lacking[0]}.txt nor one for another frame; "
            "give the folder that holds the results of these frames."
        )
    if lacking:
        text = f"{folder} has no results for {len(lacking)} of {len(frames)} frames, {lacking[0]} first."
        warnings.warn(text, FormatWarning, stacklevel=2)
    return [saved or frame for frame, saved in zip(frames, found, strict=True)]
