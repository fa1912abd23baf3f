"""`ciassd eval`: average precision by KITTI's rules, of a network or of result files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from json import dumps
from pathlib import Path
from typing import Annotated

import tyro

from ciassd_jax.cli.config_options import ConfigOptions
from ciassd_jax.cli.messages import UsageError, frames_with_bar, warnings_as_lines
from ciassd_jax.cli.options import (
    BatchSize,
    Dtype,
    File,
    Folder,
    Frames,
    Split,
    Thresholds,
    Unset,
    WeightsFile,
    check_batch_size,
)
from ciassd_jax.config import Config
from ciassd_jax.data.frames import Dataset
from ciassd_jax.evaluation import LIMITS, Evaluation, Limits, evaluate, format_json, format_report, read_folders
from ciassd_jax.formats.writing import check_file, check_folder, write_text
from ciassd_jax.inference.detector import Detector
from ciassd_jax.inference.scoring import Scored, detect_dataset, find_trained, score_frames, write_frames
from ciassd_jax.training.validation import format_scores, score_checkpoints


@dataclass(frozen=True)
class Text:
    """Evaluate a folder of result files; this starts no device."""

    labels: Annotated[Path, tyro.conf.Positional]
    """Folder of label files NNNNNN.txt, such as training/label_2."""
    results: Annotated[Path, tyro.conf.Positional]
    """Folder of result files with the same names; frames without a result file are not evaluated."""
    overlap: Annotated[
        tuple[tuple[str, ...], ...],
        tyro.conf.UseAppendAction,
        tyro.conf.arg(metavar="CLASS=OVERLAP ...", help_behavior_hint=""),
    ] = ()
    """Also evaluate other classes, such as Vehicle=0.5 Forklift=0.4, or KITTI's at another overlap."""
    json: File[Unset[Path]] = None
    """Also write AP to this file: class, metric, R11 or R40, overlap, [easy, moderate, hard]."""

    def run(self) -> int:
        limits = _add_overlaps(LIMITS, chain.from_iterable(self.overlap))
        if self.json is not None:
            check_file(self.json)
        with warnings_as_lines(self.results):
            truths, detections = read_folders(self.labels, self.results)
        evaluation = evaluate(truths, detections, limits)
        if self.json is not None:
            write_text(self.json, format_json(evaluation))
        print(format_report(evaluation))
        if evaluation.left_out:
            overlaps = " ".join(f"{name}=0.5" for name in evaluation.left_out)
            print(f"\n--overlap {overlaps} evaluates them too, at an overlap of 0.5.")
        if self.json is not None:
            print(f"Wrote {self.json}.")
        return 0


def _add_overlaps(limits: Limits, given: Iterable[str]) -> Limits:
    """Return the limits with those of texts CLASS=OVERLAP, which replace those of a class of the same name."""
    added: dict[str, tuple[float, ...]] = {}
    for text in given:
        name, _, number = text.rpartition("=")
        try:
            overlap = float(number)
        except ValueError:
            overlap = 0.0
        if not name or not 0 < overlap < 1:
            raise UsageError(
                f"--overlap {text} cannot be used; write CLASS=OVERLAP with an overlap between 0 and 1, such as "
                "Vehicle=0.5."
            )
        if name.lower() in map(str.lower, added):
            raise UsageError(f"--overlap names {name} twice, as case does not matter; give each class once.")
        added[name] = (overlap,)
    replaced = set(map(str.lower, added))
    return {name: of_class for name, of_class in limits.items() if name.lower() not in replaced} | added


@dataclass(frozen=True)
class Evaluate:
    """Compute average precision (AP) by KITTI's rules, in 2D, bird's-eye view and 3D, and of the orientation.

    Of a network: `ciassd eval --weights FILE`. Of a folder of result files: `ciassd eval txt LABELS RESULTS`.
    """

    data_set: Annotated[Frames, tyro.conf.OmitArgPrefixes] = field(default_factory=Frames)
    weights: WeightsFile[Unset[Path]] = None
    """Weights file (.safetensors, or a released .pth), or the name of bundled weights."""
    workdir: Folder[Unset[Path]] = None
    """Or the folder of a training, whose best weights are evaluated."""
    every: Annotated[bool, tyro.conf.arg(name="all")] = False
    """Evaluate every checkpoint in --workdir, and print one table of AP by step; --json writes it too."""
    batch_size: BatchSize = 1
    split: Split[str] = "val"
    """The frames to evaluate: train, val, trainval, all or a file of ImageSets."""
    seed: int = 0
    """Seed of simulated frames."""
    out: Folder[Unset[Path]] = None
    """Folder for the detections of every frame (NAME.txt), result.json and table.log."""
    json: File[Unset[Path]] = None
    """Also write AP to this file: class, metric, R11 or R40, overlap, [easy, moderate, hard]."""
    config_options: Annotated[ConfigOptions, tyro.conf.OmitArgPrefixes] = field(default_factory=ConfigOptions)
    dtype: Unset[Dtype] = None
    """Compute type of the network; by default that of the weights."""
    thresholds: Annotated[Thresholds, tyro.conf.OmitArgPrefixes] = field(default_factory=Thresholds)
    files: Annotated[
        Annotated[Text, tyro.conf.subcommand("txt")] | None,
        tyro.conf.arg(name="", help="Instead of a network:"),
    ] = None

    def run(self) -> int:
        if self.files is None:
            return self._network()
        if replace(self, files=None) != Evaluate():
            raise UsageError("`ciassd eval txt LABELS RESULTS` has --json and --overlap only; leave out the others.")
        return self.files.run()

    def _network(self) -> int:
        check_batch_size(self.batch_size)
        short = {"dtype": self.dtype, **self.thresholds.fields()}
        weights = self.config_options.load(self._weights(), short)
        folder = self.data_set.find_folder()
        for out in (self.out, self.json and self.json.parent):
            if out is not None:
                check_folder(out)
        with warnings_as_lines(folder or "simulated frames"):
            dataset = self.data_set.open(self.split, self.seed)
            if self.every:
                return self._checkpoints(dataset, weights.config)
            detector = Detector(weights.variables, weights.config)
            frames = detect_dataset(detector, dataset, frames_with_bar, batch_size=self.batch_size)
        evaluation = score_frames(frames, weights.config)
        print(format_report(evaluation))
        boxes, seconds = sum(len(frame.lines) for frame in frames), sum(frame.result.seconds for frame in frames)
        milliseconds = f"{1e3 * seconds / len(frames):.0f} ms per frame without reading and compilation"
        size = min(self.batch_size, len(frames))
        batches = f", in batches of {size}" if size > 1 else ""
        print(f"\n{len(frames)} frames, {boxes} boxes, {milliseconds}{batches}.")
        self._write(frames, evaluation)
        return 0

    def _checkpoints(self, dataset: Dataset, config: Config) -> int:
        assert self.workdir is not None
        scores = score_checkpoints(self.workdir, dataset, config, frames_with_bar, batch_size=self.batch_size)
        print(format_scores(scores))
        if self.json is not None:
            write_text(self.json, dumps(scores, indent=1))
            print(f"Wrote {self.json}.")
        return 0

    def _weights(self) -> Path:
        if self.every and (self.workdir is None or self.out is not None):
            raise UsageError("--all prints one table for the checkpoints of --workdir; give that, without --out.")
        if self.weights is not None and self.workdir is None:
            return self.weights
        if self.workdir is not None and self.weights is None:
            return find_trained(self.workdir)
        raise UsageError(
            "Give either --weights FILE or --workdir FOLDER, or compare files with `ciassd eval txt LABELS RESULTS`."
        )

    def _write(self, frames: Sequence[Scored], evaluation: Evaluation) -> None:
        if self.out is not None:
            write_frames(frames, self.out)
            write_text(self.out / "result.json", format_json(evaluation))
            # Named .txt, the table would look like the results of a frame.
            write_text(self.out / "table.log", format_report(evaluation))
        if self.json is not None:
            write_text(self.json, format_json(evaluation))
        written = [str(path) for path in (self.out, self.json) if path is not None]
        if written:
            print(f"Wrote {' and '.join(written)}.")
