"""The rows of KITTI's label and result files, and their difficulty."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from ciassd_jax.formats.errors import InputError, Pathlike
from ciassd_jax.formats.lines import parse_lines, read_lines

# The type of areas without labels.
DONT_CARE = "DontCare"
_RESULT_COLUMNS = 16


class ObjectRow(NamedTuple):
    """One line of a label file, or, with a score, of a result file.

    `alpha` and `rotation_y` are in radians, `bbox` (x1, y1, x2, y2) in pixels, `dimensions` (height, width, length)
    and `location` (x, y, z of the bottom centre, rectified camera frame) in metres. `place` names the line in
    messages, "FILE, line N"; it is empty for rows that were not read from a file.
    """

    type: str
    truncated: float
    occluded: int
    alpha: float
    bbox: tuple[float, float, float, float]
    dimensions: tuple[float, float, float]
    location: tuple[float, float, float]
    rotation_y: float
    score: float | None = None
    place: str = ""

    @property
    def has_image_box(self) -> bool:
        """Whether the image box has an area; labels that come from other formats often have none."""
        x1, y1, x2, y2 = self.bbox
        return x2 > x1 and y2 > y1


class ResultFile(NamedTuple):
    """The rows of a result file, and the places ("FILE, line N") of its irregular lines.

    `short` lines have fewer than 16 columns and give no row, `long` lines have surplus columns, which are ignored,
    and `repeated` lines equal an earlier line of the file.
    """

    rows: list[ObjectRow]
    short: list[str]
    long: list[str]
    repeated: list[str]


class Difficulty(NamedTuple):
    """A level of difficulty: image boxes higher than `min_height` pixels, occlusion and truncation up to a maximum."""

    name: str
    min_height: float
    max_occlusion: int
    max_truncation: float


DIFFICULTIES = (
    Difficulty("easy", 40, 0, 0.15),
    Difficulty("moderate", 25, 1, 0.30),
    Difficulty("hard", 25, 2, 0.50),
)


def difficulty_of(row: ObjectRow) -> int:
    """Return the index in DIFFICULTIES of the easiest level that admits a label, or -1.

    As in KITTI's devkit, the minimum height is exclusive and the maxima are inclusive.
    """
    height = row.bbox[3] - row.bbox[1]
    for index, level in enumerate(DIFFICULTIES):
        if height > level.min_height and row.occluded <= level.max_occlusion and row.truncated <= level.max_truncation:
            return index
    return -1


def read_rows(path: Pathlike) -> list[ObjectRow]:
    """Read a label file (15 columns) or a result file (16, the score last); an empty file has no rows.

    Raises InputError, one sentence with file, line and remedy, for any other line.
    """
    return parse_lines(path, parse_row)


def read_labels(path: Pathlike, problems: list[InputError] | None = None) -> list[ObjectRow]:
    """Read a label file, of objects of any type; DontCare areas are rows too.

    Raises InputError as `read_rows`. With a list of `problems`, the errors of all malformed lines are appended to it
    instead, and the other rows are returned.
    """
    return parse_lines(path, parse_row, problems)


def is_dont_care(row_type: str) -> bool:
    """Return whether rows of a type are areas without labels; case does not matter."""
    return row_type.lower() == DONT_CARE.lower()


def parse_row(line: str, place: str) -> ObjectRow:
    """Parse a line of 15 or 16 columns; `place` names it in the InputError for any other line."""
    columns = line.split()
    if len(columns) not in (15, 16):
        raise InputError(f"{place}: {len(columns)} columns; a label has 15 and a result 16, so write it again.")
    row = _parse_columns(columns, place)
    if row.occluded != float(columns[2]):
        raise InputError(f"{place}: the occlusion {columns[2]} is not a whole number; write 0, 1, 2 or 3.")
    return row


def read_results(path: Pathlike) -> ResultFile:
    """Read a result file as KITTI's evaluator does, which skips short lines and surplus columns.

    Raises InputError, one sentence with file, line and remedy, for a value that is not a finite number.
    """
    found = ResultFile([], [], [], [])
    seen = set()
    for place, line in read_lines(path):
        columns = line.split()
        if len(columns) < _RESULT_COLUMNS:
            found.short.append(place)
            continue
        if len(columns) > _RESULT_COLUMNS:
            found.long.append(place)
        row = _parse_columns(columns[:_RESULT_COLUMNS], place)
        values = row._replace(place="")
        if values in seen:
            found.repeated.append(place)
        seen.add(values)
        found.rows.append(row)
    return found


def format_row(row: ObjectRow) -> str:
    """Return a line without its end: 15 columns, or 16 with a score; 4 decimals, occlusion as an integer."""
    values = [row.alpha, *row.bbox, *row.dimensions, *row.location, row.rotation_y]
    if row.score is not None:
        values.append(row.score)
    return " ".join([row.type, f"{row.truncated:.4f}", f"{row.occluded}", *(f"{value:.4f}" for value in values)])


def write_rows(path: Pathlike, rows: Iterable[ObjectRow]) -> None:
    """Write one line per row; without rows the file is empty."""
    Path(path).write_text("".join(format_row(row) + "\n" for row in rows), encoding="utf-8", newline="\n")


def _parse_columns(columns: list[str], place: str) -> ObjectRow:
    """Parse 15 or 16 columns; a fraction in the occlusion is dropped."""
    try:
        values = [float(column) for column in columns[1:]]
    except ValueError as error:
        raise InputError(f"{place}: {error}; write a number there.") from None
    if not all(map(math.isfinite, values)):
        what = "the score" if all(map(math.isfinite, values[:14])) else "a value"
        raise InputError(f"{place}: {what} is not finite; write a number there.")
    truncated, occluded, alpha, x1, y1, x2, y2, height, width, length, x, y, z, rotation_y, *score = values
    return ObjectRow(
        type=columns[0],
        truncated=truncated,
        occluded=int(occluded),
        alpha=alpha,
        bbox=(x1, y1, x2, y2),
        dimensions=(height, width, length),
        location=(x, y, z),
        rotation_y=rotation_y,
        score=score[0] if score else None,
        place=place,
    )
