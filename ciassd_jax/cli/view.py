"""The command that shows frames: view."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ciassd_jax.cli.inference import load_as
from ciassd_jax.cli.messages import UsageError, frames_with_bar, warnings_as_lines
from ciassd_jax.formats.errors import FormatWarning, InputError

if TYPE_CHECKING:
    from ciassd_jax.inference.detector import Detector
    from ciassd_jax.view.sources import Source
    from ciassd_jax.view.view_frame import ViewFrame


@dataclass(frozen=True)
class View:
    """Show points, ground truth and detections in 3D: one page for any browser, which needs no network."""

    path: Annotated[Path, tyro.conf.Positional]
    """A cloud, a folder of clouds, or a data set in KITTI's or OpenPCDet's custom layout."""
    out: Path = Path("view.html")
    """The page to write."""
    weights: Path | None = None
    """Detect with these weights."""
    results: Path | None = None
    """Or show what `ciassd predict` or `ciassd eval --out` wrote to this folder: NAME.json or NAME.txt."""
    frames: tuple[str, ...] = ()
    """Names of the frames to show; without them the first ones."""
    most: int = 20
    """So many frames are shown where none are named."""
    split: str = "all"
    """The frames of a data set: all, train, val, trainval, test or a file of its ImageSets."""
    image: bool = False
    """Show the camera's image too, with the boxes projected into it."""
    image_size: tuple[int, int] | None = None
    """Width and height of the images in pixels, for cameras that KITTI does not have."""

    def run(self) -> int:
        from ciassd_jax.formats.writing import check_folder
        from ciassd_jax.view.html import view_html
        from ciassd_jax.view.viz_extra import require

        try:
            require("Pages", "plotly", "PIL")
        except ModuleNotFoundError as error:
            raise UsageError(str(error)) from error
        self._check()
        check_folder(self.out.parent)
        with warnings_as_lines(self.path):
            frames = self._read()
            page = view_html(frames, title=f"{self.path.name or self.path} - ciassd view")
        page.save(self.out)
        boxes = f"{sum(len(f.truth) for f in frames)} true and {sum(len(f.boxes) for f in frames)} detected boxes"
        number = "1 frame" if len(frames) == 1 else f"{len(frames)} frames"
        print(f"Wrote {self.out}: {number}, {boxes}, {len(page.html) / 1e6:.1f} MB; open it in a browser.")
        return 0

    def _check(self) -> None:
        if self.weights and self.results:
            raise UsageError("--weights detects and --results shows what was detected; give one of them.")
        if self.most < 1:
            raise UsageError(f"--most {self.most} shows no frame; give a number from 1.")
        if self.out.suffix.lower() not in (".html", ".htm"):
            raise UsageError(f"--out {self.out} must end in .html; name the page so.")
        if self.results and not self.results.is_dir():
            raise InputError(f"{self.results} is no folder; name the one that holds the results.")

    def _read(self) -> list[ViewFrame]:
        """The chosen frames with their detections."""
        from ciassd_jax.view.sources import find_sources, read_source

        sources = self._choose(find_sources(self.path, self.split, self.image_size))
        if self.image and not any(source.image for source in sources.values()):
            raise InputError(f"{self.path} has no images in image_2 beside its clouds; leave out --image.")
        detector = self._detector()
        frames = [read_source(sources[name], image=self.image) for name in frames_with_bar(list(sources))]
        if detector is not None:
            return [_detect(detector, frame) for frame in frames_with_bar(frames)]
        return frames if self.results is None else _add_saved(frames, self.results)

    def _choose(self, sources: dict[str, Source]) -> dict[str, Source]:
        """The frames that are named, or the first ones and a line on how many there are."""
        unknown = [name for name in self.frames if name not in sources]
        if unknown:
            some = ", ".join(list(sources)[:3]) + (", ..." if len(sources) > 3 else "")
            raise UsageError(f"{self.path} has no frame {unknown[0]}; it has {some}.")
        if self.frames:
            return {name: sources[name] for name in self.frames}
        if len(sources) > self.most:
            print(f"Showing the first {self.most} of {len(sources)} frames; --frames names others, --most shows more.")
        return dict(list(sources.items())[: self.most])

    def _detector(self) -> Detector | None:
        if self.weights is None:
            return None
        from ciassd_jax.inference.detector import Detector

        weights = load_as(self.weights, None)
        return Detector(weights.variables, weights.config)


def _detect(detector: Detector, frame: ViewFrame) -> ViewFrame:
    """The frame with what the detector finds, where there is a camera only what it sees."""
    from ciassd_jax.formats.kitti_camera import frustum_of

    with warnings_as_lines(frame.name):
        return detector.detect(frame.points, frustum=frustum_of(frame.camera)).show_in(frame)


def _add_saved(frames: Sequence[ViewFrame], folder: Path) -> list[ViewFrame]:
    """The frames with their saved detections; a warning counts those that have none."""
    from ciassd_jax.view.sources import add_saved

    found = [add_saved(frame, folder) for frame in frames]
    lacking = [frame.name for frame, with_saved in zip(frames, found, strict=True) if with_saved is None]
    if len(lacking) == len(frames):
        raise InputError(
            f"{folder} has neither {lacking[0]}.json nor {lacking[0]}.txt nor one for another frame; "
            "name the folder that holds the results of these frames."
        )
    if lacking:
        text = f"{folder} has no results for {len(lacking)} of {len(frames)} frames, {lacking[0]} first."
        warnings.warn(text, FormatWarning, stacklevel=2)
    return [saved or frame for frame, saved in zip(frames, found, strict=True)]
