"""The rows of label files in OpenPCDet's custom layout: boxes in the LiDAR frame."""

from __future__ import annotations

import math
from typing import NamedTuple

from ciassd_jax.formats.errors import InputError, Pathlike
from ciassd_jax.formats.lines import parse_lines

_COLUMNS = "x y z dx dy dz heading class"


class CustomRow(NamedTuple):
    """One object: its box (x, y, z, length, width, height, yaw) in the LiDAR frame, and its type.

    `place` names the line in messages, "FILE, line N"; it is empty for rows that were not read from a file.
    """

    box: tuple[float, ...]
    type: str
    place: str = ""


def read_custom_rows(path: Pathlike, problems: list[InputError] | None = None) -> list[CustomRow]:
    """Read a label file of rows `x y z dx dy dz heading class`; an empty file has no rows.

    Raises InputError, one sentence with file, line and remedy, for any other line. With a list of `problems`, the
    errors of all malformed lines are appended to it instead, and the other rows are returned.
    """
    return parse_lines(path, parse_custom_row, problems)


def parse_custom_row(line: str, place: str) -> CustomRow:
    """Parse one line; `place` names it in the InputError for a malformed one."""
    columns = line.split()
    if len(columns) != 8:
        raise InputError(f"{place}: {len(columns)} columns; a label has the 8 {_COLUMNS}, so write it again.")
    try:
        box = tuple(float(column) for column in columns[:7])
    except ValueError as error:
        raise InputError(f"{place}: {error}; write a number there.") from None
    if not all(map(math.isfinite, box)):
        raise InputError(f"{place}: a value is not finite; write a number there.")
    return CustomRow(box, columns[7], place)
