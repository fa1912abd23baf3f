"""The command eval: AP by KITTI's official rules, of a network or of result files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ciassd_jax.cli.inference import Preset, load_as, override
from ciassd_jax.cli.messages import UsageError, warnings_as_lines

if TYPE_CHECKING:
    from ciassd_jax.evaluation import Evaluation
    from ciassd_jax.inference.scoring import ScoredFrame


@dataclass(frozen=True)
class Text:
    """Evaluate a folder of result files; touches no device."""

    labels: Annotated[Path, tyro.conf.Positional]
    """Folder of label files NNNNNN.txt, such as training/label_2."""
    results: Annotated[Path, tyro.conf.Positional]
    """Folder of result files with the same names; frames without one are not evaluated."""
    json: Path | None = None
    """Also write AP to this file: class, metric, R11 or R40, overlap, [easy, moderate, hard]."""

    def run(self) -> int:
        from ciassd_jax.evaluation import evaluate, format_json, format_report, read_folders
        from ciassd_jax.formats.writing import check_folder, write_text

        if self.json is not None:
            check_folder(self.json.parent)
        with warnings_as_lines(self.results):
            truths, detections = read_folders(self.labels, self.results)
        evaluation = evaluate(truths, detections)
        if self.json is not None:
            write_text(self.json, format_json(evaluation))
        print(format_report(evaluation))
        if self.json is not None:
            print(f"Wrote {self.json}.")
        return 0


@dataclass(frozen=True)
class Evaluate:
    """Average precision by KITTI's official rules, in 2D, bird's-eye view, 3D and of orientation.

    Of a network: name its weights with --weights or --workdir. Of files: eval txt LABELS RESULTS.
    """

    weights: Path | None = None
    """Weights: a file that training or `ciassd convert` wrote, a released .pth, or the name of bundled ones."""
    workdir: Path | None = None
    """Or the folder of a training, whose best weights are taken."""
    data: Path | None = None
    """Folder in KITTI's or OpenPCDet's custom layout; KITTI_ROOT without it."""
    split: str = "val"
    """train, val, trainval, all or a file of ImageSets."""
    image_size: tuple[int, int] | None = None
    """Width and height of the images in pixels, for cameras that KITTI does not have."""
    out: Path | None = None
    """Folder for NAME.txt of every frame with its detections, result.json and table.log."""
    json: Path | None = None
    """Also write AP to this file: class, metric, R11 or R40, overlap, [easy, moderate, hard]."""
    preset: Preset | None = None
    """Use this preset instead of the config in the weights file; the parameters must fit."""
    score_threshold: float | None = None
    """Class probability that a candidate needs (the preset's: 0.3)."""
    source: Annotated[
        Annotated[Text, tyro.conf.subcommand("txt")] | Annotated[None, tyro.conf.subcommand("network")],
        tyro.conf.arg(name=""),
    ] = None
    """What made the detections."""

    def run(self) -> int:
        if self.source is None:
            return self._network()
        if replace(self, source=None) != Evaluate():
            raise UsageError("`ciassd eval txt` compares files, so its only option is --json, after LABELS RESULTS.")
        return self.source.run()

    def _network(self) -> int:
        from ciassd_jax.data.folders import find_root, open_dataset
        from ciassd_jax.evaluation import format_report
        from ciassd_jax.formats.writing import check_folder
        from ciassd_jax.inference.detector import Detector
        from ciassd_jax.inference.scoring import detect_dataset, score_frames

        weights = load_as(self._weights(), self.preset)
        config = override(weights.config, None, self.score_threshold)
        root = find_root(self.data)
        for folder in (self.out, self.json and self.json.parent):
            if folder is not None:
                check_folder(folder)
        with warnings_as_lines(root):
            dataset = open_dataset(root, self.split, self.image_size)
            frames = detect_dataset(Detector(weights.variables, config), dataset, _progress)
        evaluation = score_frames(frames)
        print(format_report(evaluation))
        boxes, seconds = sum(len(frame.lines) for frame in frames), sum(frame.result.seconds for frame in frames)
        milliseconds = f"{1e3 * seconds / len(frames):.0f} ms a frame"
        print(f"\n{len(frames)} frames, {boxes} boxes, {milliseconds} without reading and compilation.")
        self._write(frames, evaluation)
        return 0

    def _weights(self) -> Path:
        from ciassd_jax.inference.scoring import find_trained

        if self.weights is not None and self.workdir is None:
            return self.weights
        if self.workdir is not None and self.weights is None:
            return find_trained(self.workdir)
        raise UsageError(
            "Give either --weights FILE or --workdir FOLDER, or compare files with `ciassd eval txt LABELS RESULTS`."
        )

    def _write(self, frames: Sequence[ScoredFrame], evaluation: Evaluation) -> None:
        from ciassd_jax.evaluation import format_json, format_report
        from ciassd_jax.formats.writing import write_text
        from ciassd_jax.inference.scoring import write_frames

        if self.out is not None:
            write_frames(frames, self.out)
            write_text(self.out / "result.json", format_json(evaluation))
            # A .txt would be a frame to whatever reads the folder.
            write_text(self.out / "table.log", format_report(evaluation))
        if self.json is not None:
            write_text(self.json, format_json(evaluation))
        written = [str(path) for path in (self.out, self.json) if path is not None]
        if written:
            print(f"Wrote {' and '.join(written)}.")


def _progress(names: Sequence[str]) -> Iterable[str]:
    from tqdm.auto import tqdm

    return tqdm(names, unit="frame")
