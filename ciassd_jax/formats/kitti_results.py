"""Result files as the official evaluator reads them: rows of a wrong length do not stop it."""

from __future__ import annotations

import math
from typing import NamedTuple

from ciassd_jax.formats.errors import InputError, Pathlike, read_bytes
from ciassd_jax.formats.kitti import ObjectRow

_COLUMNS = 16


class ResultFile(NamedTuple):
    """The rows of a result file, and the numbers of its lines (from 1) that deserve a word.

    `short` lines have fewer than 16 columns and give no row; of `long` ones the surplus is skipped; `repeated`
    lines say exactly what an earlier line of the file says, and count once more.
    """

    rows: list[ObjectRow]
    short: list[int]
    long: list[int]
    repeated: list[int]


def read_results(path: Pathlike) -> ResultFile:
    """Read a result file by the official rule; blank lines are nothing, an empty file holds no objects.

    Raises InputError, one sentence with file, line and remedy, for a value that is no finite number.
    """
    # Bytes that are no text become values that are no numbers.
    text = read_bytes(path).decode("utf-8-sig", errors="replace")
    found = ResultFile([], [], [], [])
    seen = set()
    for number, line in enumerate(text.split("\n"), 1):
        columns = line.split()
        if not columns:
            continue
        if len(columns) < _COLUMNS:
            found.short.append(number)
            continue
        if len(columns) > _COLUMNS:
            found.long.append(number)
        row = _parse(columns[:_COLUMNS], f"{path}, line {number}")
        if row in seen:
            found.repeated.append(number)
        seen.add(row)
        found.rows.append(row)
    return found


def _parse(columns: list[str], place: str) -> ObjectRow:
    try:
        truncated, occluded, alpha, *values = map(float, columns[1:])
    except ValueError as error:
        raise InputError(f"{place}: {error}; write a number there.") from None
    if not all(map(math.isfinite, (truncated, occluded, alpha, *values))):
        what = "a value" if math.isfinite(values[-1]) else "the score"
        raise InputError(f"{place}: {what} is not finite; write a number there.")
    x1, y1, x2, y2, height, width, length, x, y, z, rotation_y, score = values
    return ObjectRow(
        columns[0],
        truncated,
        int(occluded),
        alpha,
        (x1, y1, x2, y2),
        (height, width, length),
        (x, y, z),
        rotation_y,
        score,
    )
