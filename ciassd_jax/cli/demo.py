"""`ciassd demo`: from points to pictures, on simulated streets or on a cloud of the user's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from ciassd_jax.formats.points import read_points
from ciassd_jax.formats.writing import check_folder, replacing
from ciassd_jax.inference.detector import Detector
from ciassd_jax.inference.results import write_json
from ciassd_jax.inference.weights import Weights
from ciassd_jax.simulation import open_synthetic
from ciassd_jax.view.view_frame import ViewFrame, frame_to_view


def run_demo(file: Path | None, weights: Weights, out: Path, *, scenes: int, seed: int) -> None:
    """Detect in `file`, or in so many simulated scenes; print what is found, write JSON and pictures to `out`."""
    check_folder(out)
    frames = [ViewFrame(file.stem, read_points(file))] if file is not None else simulated_frames(scenes, seed)
    detector = Detector(weights.variables, weights.config)
    print("Compiling the detector; what is compiled once is kept for the next run.", flush=True)
    detector.compile(max(len(frame.points) for frame in frames))
    shown, written = [], []
    for frame in frames:
        result = detector.detect(frame.points)
        cars = f", {len(frame.truth)} objects in its label" if file is None else ""
        print(f"\n{frame.name}: {len(frame.points)} points{cars}\n{result}", flush=True)
        shown.append(result.show_in(frame))
        written.append(write_json(out / f"{frame.name}.json", result))
    print()
    for draw in (_pictures, _page):
        written += _drawn(draw, shown, out)
    print("Wrote " + ", ".join(map(str, written)) + ".")


def simulated_frames(number: int, seed: int) -> list[ViewFrame]:
    """Scenes with their ground truth, as the camera's view shows them."""
    print(f"Simulating {number} streets as a LiDAR with 64 beams sees them.", flush=True)
    dataset = open_synthetic(seed, number)
    return [frame_to_view(dataset.read(index))._replace(name=f"street_{index}") for index in range(number)]


def _drawn(draw: Callable[[Sequence[ViewFrame], Path], list[Path]], frames: list[ViewFrame], out: Path) -> list[Path]:
    """What was drawn; nothing, and a sentence that says what is missing, without the extra for pictures."""
    try:
        return draw(frames, out)
    except ModuleNotFoundError as error:
        print(error)
        return []


def _pictures(frames: Sequence[ViewFrame], out: Path) -> list[Path]:
    from ciassd_jax.view.bev import plot_bev

    paths = [out / f"{frame.name}.png" for frame in frames]
    for frame, path in zip(frames, paths, strict=True):
        truth = frame.truth if len(frame.truth) else None
        figure = plot_bev(frame.points, frame.boxes, truth, frame.scores, frame.labels, title=frame.name)
        with replacing(path) as temporary:
            figure.savefig(temporary, format="png")
    return paths


def _page(frames: Sequence[ViewFrame], out: Path) -> list[Path]:
    from ciassd_jax.view.html import view_html

    return [view_html(frames, title="ciassd demo").save(out / "view.html")]
