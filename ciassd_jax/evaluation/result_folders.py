"""Folders of label and result files in the layout of KITTI's devkit: NNNNNN.txt, one per frame."""

from __future__ import annotations

import warnings
from pathlib import Path

from ciassd_jax.evaluation.objects import DetectedObjects, LabelledObjects, detections_from_rows, labels_from_rows
from ciassd_jax.formats.errors import FormatWarning, InputError, Pathlike
from ciassd_jax.formats.kitti_rows import read_results, read_rows

# Fields of ResultFile, and how their lines are evaluated.
_ODD_ROWS = {
    "short": "Rows of fewer than 16 columns were left out",
    "long": "The surplus of rows of more than 16 columns was ignored",
    "repeated": "Rows that repeat another of their file count again, as false positives",
}


def read_folders(labels: Pathlike, results: Pathlike) -> tuple[list[LabelledObjects], list[DetectedObjects]]:
    """Read all frames that have a result file, in the order of their names.

    As in the official program, frames without a result file are not evaluated, rows of fewer than 16 columns are
    dropped, surplus columns are ignored, and a repeated row counts again, as a false positive. A FormatWarning tells
    the number of each and names the first. Raises InputError, one sentence with the remedy, for a folder that is
    missing or has no .txt files, for results of frames without labels, and as `read_rows` and `read_results`.
    """
    label_files = _text_files(labels, "labels")
    result_files = _text_files(results, "results")
    unknown = sorted(result_files.keys() - label_files.keys())
    if unknown:
        raise InputError(
            f"{result_files[unknown[0]]} has no labels in {labels} ({len(unknown)} such files); remove the results of "
            "other frames or name the folder with their labels."
        )
    missing = sorted(label_files.keys() - result_files.keys())
    if missing:
        _warn(
            f"Frames of {labels} without a result file are not evaluated: {len(missing)} of {len(label_files)}, "
            f"{missing[0]} first; for a frame without detections write an empty file."
        )
    truths = [labels_from_rows(read_rows(label_files[name])) for name in result_files]
    read = {path: read_results(path) for path in result_files.values()}
    for field, what in _ODD_ROWS.items():
        places = [place for found in read.values() for place in getattr(found, field)]
        if places:
            _warn(f"{what}: {len(places)} in all, the first is {places[0]}.")
    return truths, [detections_from_rows(found.rows) for found in read.values()]


def _text_files(folder: Pathlike, what: str) -> dict[str, Path]:
    """Return the .txt files of a folder by name, in order."""
    path = Path(folder)
    if not path.is_dir():
        state = "is a file" if path.exists() else "does not exist"
        raise InputError(f"{folder} {state}; name the folder that holds the {what} as NNNNNN.txt.")
    try:
        visible = sorted(file for file in path.iterdir() if not file.name.startswith("."))
        files = {file.name: file for file in visible if file.suffix == ".txt"}
    except OSError as error:
        raise InputError(f"{folder} cannot be read ({error.strerror}); check its permissions.") from error
    if not files:
        inner = next((name for name in ("data", "label_2", "training/label_2") if (path / name).is_dir()), None)
        remedy = f"name {path / inner}" if inner else f"name the folder that holds the {what} as NNNNNN.txt"
        raise InputError(f"{folder} has no .txt files; {remedy}.")
    return files


def _warn(message: str) -> None:
    warnings.warn(message, FormatWarning, stacklevel=3)
