"""Text files with one record per line."""

from __future__ import annotations

import codecs
from collections.abc import Callable
from typing import TypeVar

from ciassd_jax.formats.errors import InputError, Pathlike, read_bytes

Row = TypeVar("Row")


def read_text(path: Pathlike) -> str:
    """Return the text of a file in UTF-8, or in UTF-16 with its mark; raises InputError as `read_bytes`."""
    data = read_bytes(path)
    encoding = "utf-16" if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"
    # Bytes that are not text become values that are not numbers, which the parsers refuse by name.
    return data.decode(encoding, errors="replace")


def read_lines(path: Pathlike) -> list[tuple[str, str]]:
    """Return the lines of a file that are not blank, each with its place for messages: "FILE, line N"."""
    lines = enumerate(read_text(path).split("\n"), 1)
    return [(f"{path}, line {number}", line) for number, line in lines if line.strip()]


def parse_lines(
    path: Pathlike, parse: Callable[[str, str], Row], problems: list[InputError] | None = None
) -> list[Row]:
    """Return `parse(line, place)` of every line that is not blank.

    Raises the InputError of the first malformed line. With a list of `problems`, the errors of all malformed lines
    are appended to it instead, and the other lines are returned.
    """
    rows = []
    for place, line in read_lines(path):
        try:
            rows.append(parse(line, place))
        except InputError as error:
            if problems is None:
                raise
            problems.append(error)
    return rows
