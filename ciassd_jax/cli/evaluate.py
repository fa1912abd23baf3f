"""The command eval: AP by KITTI's official rules."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ciassd_jax.cli.messages import UsageError, warnings_as_lines


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
        from ciassd_jax.evaluation import evaluate, format_block, format_tables, read_folders, to_json
        from ciassd_jax.formats.writing import check_folder, replacing

        if self.json is not None:
            check_folder(self.json.parent)
        with warnings_as_lines(self.results):
            truths, detections = read_folders(self.labels, self.results)
        evaluation = evaluate(truths, detections)
        print(f"{format_block(evaluation)}\n\n{format_tables(evaluation)}".strip())
        if self.json is not None:
            with replacing(self.json) as path:
                path.write_text(json.dumps(to_json(evaluation), indent=1, allow_nan=False) + "\n", encoding="utf-8")
            print(f"Wrote {self.json}.")
        return 0


@dataclass(frozen=True)
class Evaluate:
    """Average precision by KITTI's official rules: 2D, bird's-eye view, 3D and orientation."""

    source: Annotated[
        Annotated[Text, tyro.conf.subcommand("txt")]
        | Annotated[None, tyro.conf.subcommand("network", description="A trained network; cannot be evaluated yet.")],
        tyro.conf.arg(name=""),
    ] = None
    """What made the detections."""

    def run(self) -> int:
        if self.source is None:
            raise UsageError("There is nothing to evaluate; say `ciassd eval txt LABELS RESULTS`.")
        return self.source.run()
