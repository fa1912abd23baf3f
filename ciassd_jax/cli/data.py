"""Commands around a data set: data check, data prepare, data synth, submit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ciassd_jax.cli.inference import Preset
from ciassd_jax.cli.messages import UsageError, frames_with_bar, warnings_as_lines
from ciassd_jax.config.presets import PRESETS
from ciassd_jax.formats.errors import InputError

if TYPE_CHECKING:
    from ciassd_jax.evaluation.check_scores import PerfectScore
    from ciassd_jax.evaluation.findings import Finding, Report

Root = Annotated[Path | None, tyro.conf.Positional]


@dataclass(frozen=True)
class Check:
    """Read a whole data set and say what is missing or odd; exit code 1 if something must be mended."""

    root: Root = None
    """Folder in KITTI's or OpenPCDet's custom layout; KITTI_ROOT without it."""
    split: str | None = None
    """train, val, trainval, test or a file of ImageSets; without it every frame and all split files."""
    preset: Preset = "car"
    """Its grid, classes and capacities are what the data are checked against."""
    image_size: tuple[int, int] | None = None
    """Width and height of the images in pixels, for cameras that KITTI does not have."""
    most: int = 10
    """So many findings of a kind are listed, the others counted."""

    def run(self) -> int:
        from ciassd_jax.evaluation.check_scores import find_imperfect, score_truth
        from ciassd_jax.evaluation.dataset_check import check_dataset

        config = PRESETS[self.preset]()
        report = check_dataset(self.root, self.split, config=config, image_size=self.image_size, track=frames_with_bar)
        scores = score_truth(report.frames)
        findings = [*report.findings, *find_imperfect(scores)]
        for part in (_listing(findings, self.most), _table(report), _score_table(scores)):
            print(*part, sep="\n", end="\n" if part else "")
        serious = sum(finding.serious for finding in findings)
        print(f"{serious} findings must be mended, {len(findings) - serious} are worth a look.")
        return 1 if serious else 0


@dataclass(frozen=True)
class Prepare:
    """Build the ground-truth database that training pastes objects from."""

    root: Root = None
    """Folder in KITTI's or OpenPCDet's custom layout; KITTI_ROOT without it."""
    split: str = "train"
    """The frames whose objects are collected."""
    out: Path | None = None
    """Folder for the database; the data set's own without it."""
    reduce: bool = False
    """First write every full cloud of a KITTI folder, cropped to the camera's view, to velodyne_reduced beside it."""
    image_size: tuple[int, int] | None = None
    """Width and height of the images in pixels, for cameras that KITTI does not have."""

    def run(self) -> int:
        from ciassd_jax.data.folders import database_path, find_root, is_custom, open_dataset
        from ciassd_jax.data.gt_sampling import build_database
        from ciassd_jax.data.kitti import write_reduced
        from ciassd_jax.formats.writing import check_folder

        root = find_root(self.root)
        path = database_path(self.out or root, self.split)
        check_folder(path.parent)
        with warnings_as_lines(root):
            if self.reduce:
                if is_custom(root):
                    raise InputError(f"{root} has no camera to crop clouds to; leave out --reduce.")
                print(f"Wrote {write_reduced(root, self.image_size, frames_with_bar)} cropped clouds.")
            dataset = open_dataset(root, self.split, self.image_size)
            build_database(dataset, path, frames_with_bar)
        print(f"Wrote the objects of {len(dataset)} frames to {path}.")
        return 0


@dataclass(frozen=True)
class Synth:
    """Write synthetic LiDAR scenes as a folder in KITTI's layout; every fourth frame is of the split val."""

    out: Annotated[Path, tyro.conf.Positional]
    """The folder; new or empty, unless with --overwrite."""
    frames: int = 100
    """How many frames to write."""
    seed: int = 0
    """Frame i depends on the seed and i alone."""
    overwrite: bool = False
    """Replace what an earlier `data synth` wrote there."""

    def run(self) -> int:
        from ciassd_jax.simulation import write_synthetic

        if self.frames < 1:
            raise UsageError(f"--frames {self.frames} makes no data set; ask for at least 1.")
        if not 0 <= self.seed < 2**31:
            raise UsageError(f"--seed {self.seed} is outside 0..{2**31 - 1}; choose one inside.")
        dropped = write_synthetic(
            self.out, frames=self.frames, seed=self.seed, overwrite=self.overwrite, track=frames_with_bar
        )
        if dropped:
            print(f"Pairs of a far solid and a tile of rays over capacity, and not seen: {dropped}.")
        print(f"Wrote {self.frames} frames to {self.out}.")
        return 0


@dataclass(frozen=True)
class Data:
    """Check, prepare or make up a data set."""

    action: Annotated[
        Annotated[Check, tyro.conf.subcommand("check", prefix_name=False)]
        | Annotated[Prepare, tyro.conf.subcommand("prepare", prefix_name=False)]
        | Annotated[Synth, tyro.conf.subcommand("synth", prefix_name=False)],
        tyro.conf.arg(name=""),
    ]

    def run(self) -> int:
        return self.action.run()


@dataclass(frozen=True)
class Submit:
    """Check the results of KITTI's 7518 test frames and zip them for its server; exit code 1 for bad ones."""

    results: Annotated[Path, tyro.conf.Positional]
    """Folder of NNNNNN.txt, one for every test frame, empty where nothing was detected."""
    out: Annotated[Path, tyro.conf.Positional]
    """The archive to write: OUT.zip."""

    def run(self) -> int:
        from ciassd_jax.cli.submit import check_results, write_submission
        from ciassd_jax.formats.writing import check_folder

        if self.out.suffix != ".zip":
            raise InputError(f"{self.out} must end in .zip; name the archive so.")
        if not self.results.is_dir():
            raise InputError(f"{self.results} is no folder; name the one that holds the results.")
        check_folder(self.out.parent)
        problems = check_results(self.results)
        for problem in problems:
            print(problem)
        if problems:
            print(f"{len(problems)} problems; {self.out} was not written.")
            return 1
        print(f"Wrote {self.out} with {write_submission(self.results, self.out)} files.")
        return 0


def _listing(findings: Sequence[Finding], most: int) -> list[str]:
    """Serious findings first, of each kind at most so many; the others of the kind in one line."""
    lines = []
    for serious, word in ((True, "error"), (False, "odd")):
        kinds: dict[str, list[str]] = {}
        for finding in findings:
            if finding.serious == serious:
                kinds.setdefault(finding.kind, []).append(finding.text)
        for kind, texts in kinds.items():
            lines += [f"{word}: {text}" for text in texts[:most]]
            if len(texts) > most:
                lines.append(f"{word}: ... and {len(texts) - most} more of this kind ({kind}); --most lists more.")
    return lines


def _table(report: Report) -> list[str]:
    """Amounts per frame and objects by type."""
    import numpy as np

    rows = [f"{len(report.frames)} frames       least   median     most"]
    for what in ("points", "voxels"):
        amounts = [getattr(frame, what) for frame in report.frames] or [0]
        least, median, most = np.quantile(amounts, (0, 0.5, 1), method="nearest").tolist()
        rows.append(f"{what:<12} {least:>9} {median:>8} {most:>8}")
    rows.append("type             objects  out of range  without points  length   width  height  centre z (medians, m)")
    for name, row in report.types.items():
        length, width, height = row.size
        rows.append(
            f"{name:<15} {row.objects:>8} {row.out_of_range:>13} {row.without_points:>15}"
            f"  {length:>6.2f}  {width:>6.2f}  {height:>6.2f}  {row.center_z:>8.2f}"
        )
    return rows


def _score_table(scores: Sequence[PerfectScore]) -> list[str]:
    """What the labels score as detections, and what that says where it is less than 100."""
    from ciassd_jax.evaluation.check_scores import FULL_CURVE

    if not scores:
        return []
    rows = ["Labels as detections      AP R40: easy  moderate    hard   objects"]
    for score in scores:
        precision = "  ".join(f"{value:>8.2f}" for value in score.score)
        rows.append(f"{score.name:<15} {score.metric:<10} {precision}   {', '.join(map(str, score.objects))}")
    if any(min(score.objects) < FULL_CURVE for score in scores):
        rows.append(
            f"By the official rule fewer than {FULL_CURVE} objects cannot score 100, however well they are found."
        )
    return rows
