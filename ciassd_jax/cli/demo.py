"""`ciassd demo`: from points to pictures, on simulated streets or on a cloud of one's own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from ciassd_jax.cli.config_options import ConfigOptions
from ciassd_jax.cli.messages import UsageError, warnings_as_lines
from ciassd_jax.cli.options import Columns, Folder, Thresholds, WeightsFile, open_simulated, read_columns
from ciassd_jax.formats.points import read_points
from ciassd_jax.formats.writing import check_folder, replacing
from ciassd_jax.inference.detector import Detector
from ciassd_jax.inference.results import write_json
from ciassd_jax.view.bev import plot_frame
from ciassd_jax.view.html import view_html
from ciassd_jax.view.view_frame import ViewFrame, frame_to_view, mark_targets


@dataclass(frozen=True)
class Demo:
    """Run the whole pipeline on simulated streets or on a file, and write results, pictures and a 3D page."""

    file: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(help_behavior_hint="")] = None
    """A cloud of your own instead of simulated ones."""
    weights: WeightsFile[Path] = Path("car_lite")
    """Weights file, or the name of bundled weights; the bundled ones were trained on simulated streets alone."""
    out: Folder[Path] = Path("ciassd_demo")
    """Folder for the results."""
    scenes: int = 3
    """Number of streets to simulate."""
    seed: int = 0
    """Seed of the streets."""
    columns: Columns = None
    thresholds: Annotated[Thresholds, tyro.conf.OmitArgPrefixes] = field(default_factory=Thresholds)
    config_options: Annotated[ConfigOptions, tyro.conf.OmitArgPrefixes] = field(default_factory=ConfigOptions)

    def run(self) -> int:
        if self.scenes < 1:
            raise UsageError(f"--scenes {self.scenes} shows nothing; ask for at least 1.")
        with warnings_as_lines(self.file or "simulated street"):
            short = self.thresholds.fields()
            weights = self.config_options.load(self.weights, short)
            check_folder(self.out)
            frames = self._frames()
            detector = Detector(weights.variables, weights.config)
            detector.compile(max(len(frame.points) for frame in frames))
            written, shown = [], []
            for frame in frames:
                result = detector(frame.points, source=self.file or frame.name)
                objects = "" if self.file else f", {len(frame.truth)} labelled objects"
                print(f"\n{frame.name}: {len(frame.points)} points{objects}\n{result}", flush=True)
                shown.append(result.show_in(mark_targets(frame, weights.config)))
                written.append(write_json(self.out / f"{frame.name}.json", result))
            print()
            for draw in (_draw_pictures, _draw_page):
                written += _try_to_draw(draw, shown, self.out)
        print("Wrote " + ", ".join(map(str, written)) + ".")
        return 0

    def _frames(self) -> list[ViewFrame]:
        """The file's points, or simulated scenes with their labels as the camera sees them."""
        if self.file is not None:
            return [ViewFrame(self.file.stem, read_points(self.file, read_columns(self.columns)))]
        print(f"Simulating {self.scenes} streets, scanned by a LiDAR with 64 beams.", flush=True)
        dataset = open_simulated("all", self.scenes, self.seed)
        return [frame_to_view(dataset.read(index))._replace(name=f"street_{index}") for index in range(self.scenes)]


Draw = Callable[[Sequence[ViewFrame], Path], list[Path]]


def _try_to_draw(draw: Draw, frames: Sequence[ViewFrame], out: Path) -> list[Path]:
    """Return what was written; without the libraries for it print what to install and return nothing."""
    try:
        return draw(frames, out)
    except ModuleNotFoundError as error:
        print(error)
        return []


def _draw_pictures(frames: Sequence[ViewFrame], out: Path) -> list[Path]:
    """A picture from above of every frame."""
    paths = [out / f"{frame.name}.png" for frame in frames]
    for frame, path in zip(frames, paths, strict=True):
        with replacing(path) as temporary:
            plot_frame(frame).savefig(temporary, format="png")
    return paths


def _draw_page(frames: Sequence[ViewFrame], out: Path) -> list[Path]:
    """One 3D page of all frames."""
    return [view_html(frames, title="ciassd demo").save(out / "view.html")]
