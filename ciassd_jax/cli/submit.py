"""A folder of results as the archive that KITTI's test server takes."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from ciassd_jax.data.splits import official_split
from ciassd_jax.formats.errors import InputError, Pathlike, read_bytes
from ciassd_jax.formats.kitti_rows import parse_row
from ciassd_jax.formats.lines import read_lines
from ciassd_jax.formats.writing import replacing

# Fixed, so that the same results make the same archive.
_TIME = (1980, 1, 1, 0, 0, 0)


def check_results(folder: Pathlike) -> list[str]:
    """What the server would refuse or misread, one sentence each with file, line and remedy; empty if all is well.

    There must be one file for each of the 7518 test frames and every line a row of 16 columns, the score last.
    """
    names = official_split("test")
    assert names is not None
    wanted = {f"{name}.txt" for name in names}
    found = {path.name for path in Path(folder).glob("*.txt")}
    problems = []
    if wanted - found:
        problems.append(
            f"{folder}: {len(wanted - found)} of {len(wanted)} files are missing ({_some(wanted - found)}); write one "
            "for every test frame, empty where nothing was detected."
        )
    if found - wanted:
        problems.append(
            f"{folder}: {len(found - wanted)} files belong to no test frame ({_some(found - wanted)}); remove them."
        )
    for name in sorted(found & wanted):
        problems += _check_file(Path(folder) / name)
    return problems


def write_submission(folder: Pathlike, archive: Pathlike) -> int:
    """Zip the results, files at the top level; returns their number. Raises InputError for the first problem."""
    problems = check_results(folder)
    if problems:
        raise InputError(problems[0])
    paths = sorted(Path(folder).glob("*.txt"))
    with replacing(archive) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as stream:
        for path in paths:
            entry = zipfile.ZipInfo(path.name, _TIME)
            stream.writestr(entry, read_bytes(path), zipfile.ZIP_DEFLATED)
    return len(paths)


def _check_file(path: Path) -> Iterator[str]:
    seen: dict[str, str] = {}
    for place, line in read_lines(path):
        try:
            row = parse_row(line, place)
        except InputError as error:
            yield str(error)
            continue
        x1, y1, x2, y2 = row.bbox
        if row.score is None:
            yield f"{place}: a result has 16 columns, the score last; add it."
        if x2 <= x1 or y2 <= y1:
            yield f"{place}: the image box is empty; write its edges in pixels, or leave out what is not seen."
        if min(row.dimensions) <= 0:
            yield f"{place}: the height, width and length must be positive; mend or remove the line."
        if seen.setdefault(line.strip(), place) != place:
            yield f"{place}: the same row as in {seen[line.strip()]}; remove one of the two."


def _some(names: Sequence[str] | set[str]) -> str:
    """The first few names."""
    return ", ".join(sorted(names)[:3]) + (", ..." if len(names) > 3 else "")
