"""`ciassd data check`: what is missing or odd in a data set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from ciassd_jax.cli.config_options import ConfigOptions
from ciassd_jax.cli.messages import describe, frames_with_bar
from ciassd_jax.cli.options import Columns, ImageSize, Split, Unset, read_columns
from ciassd_jax.evaluation.class_check import LabelScore
from ciassd_jax.evaluation.dataset_check import Report, check_dataset
from ciassd_jax.evaluation.frame_check import Finding
from ciassd_jax.evaluation.kitti_ap import CURVE_POINTS


@dataclass(frozen=True)
class Check:
    """Read a whole data set and report what is missing or odd; exit code 1 if there are errors."""

    root: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(help_behavior_hint="")] = None
    """Folder in KITTI's or OpenPCDet's custom layout; by default the variable KITTI_ROOT."""
    split: Split[Unset[str]] = None
    """train, val, trainval, test, or a file that lists frames. Default: every frame and all split files."""
    config_options: Annotated[ConfigOptions, tyro.conf.OmitArgPrefixes] = field(default_factory=ConfigOptions)
    image_size: ImageSize = None
    columns: Columns = None
    most: int = 10
    """Findings of one kind to list; the others are counted."""

    def run(self) -> int:
        config = self.config_options.resolve()
        report = check_dataset(
            self.root,
            self.split,
            config=config,
            image_size=self.image_size,
            columns=read_columns(self.columns),
            track=frames_with_bar,
        )
        for part in (_listing(report.findings, self.most), _table(report), _score_table(report.scores)):
            print(*part, sep="\n", end="\n" if part else "")
        print(f"Verdict: {describe(report.verdict)}")
        return 1 if any(finding.serious for finding in report.findings) else 0


def _listing(findings: Sequence[Finding], most: int) -> list[str]:
    """Errors first; of each kind at most `most`, then the number of the others."""
    lines = []
    for serious, word in ((True, "error"), (False, "odd")):
        kinds: dict[str, list[str]] = {}
        for finding in findings:
            if finding.serious == serious:
                kinds.setdefault(finding.kind, []).append(describe(finding.text))
        for kind, texts in kinds.items():
            lines += [f"{word}: {text}" for text in texts[:most]]
            if len(texts) > most:
                lines.append(f"{word}: ... and {len(texts) - most} more of this kind ({kind}); --most lists more.")
    return lines


def _table(report: Report) -> list[str]:
    """Points and voxels per frame, and objects by type."""
    rows = [f"{len(report.frames)} frames       least   median     most"]
    for what in ("points", "voxels"):
        amounts = [getattr(frame, what) for frame in report.frames] or [0]
        least, median, most = np.quantile(amounts, (0, 0.5, 1), method="nearest").tolist()
        rows.append(f"{what:<12} {least:>9} {median:>8} {most:>8}")
    rows.append(
        "type             objects   out of range  without points  length   width  height  centre z (medians, m)"
    )
    for name, row in report.types.items():
        length, width, height = row.size
        outside = f"{row.out_of_range} ({row.out_of_range / row.objects:.0%})"
        rows.append(
            f"{name:<15} {row.objects:>8} {outside:>14} {row.without_points:>15}"
            f"  {length:>6.2f}  {width:>6.2f}  {height:>6.2f}  {row.center_z:>8.2f}"
        )
    return rows


def _score_table(scores: Sequence[LabelScore]) -> list[str]:
    """AP of the labels as detections, and why it may be below 100."""
    if not scores:
        return []
    rows = ["Labels as detections      AP R40: easy  moderate    hard   objects"]
    for score in scores:
        precision = "  ".join(f"{value:>8.2f}" for value in score.score)
        rows.append(f"{score.name:<15} {score.metric:<10} {precision}   {', '.join(map(str, score.objects))}")
    if any(min(score.objects) < CURVE_POINTS for score in scores):
        rows.append(f"By KITTI's rule fewer than {CURVE_POINTS} objects cannot score 100, however well they are found.")
    return rows
