"""`ciassd submit`: results as the archive that KITTI's test server accepts."""

from __future__ import annotations

import zipfile
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ciassd_jax.cli.messages import UsageError
from ciassd_jax.data.splits import official_split, present_paths
from ciassd_jax.formats.errors import InputError, Pathlike, read_bytes
from ciassd_jax.formats.kitti_rows import parse_row
from ciassd_jax.formats.lines import read_lines
from ciassd_jax.formats.writing import check_file, replacing

# A fixed date, so that the same results give the same archive.
_TIME = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True)
class Submit:
    """Check the results of KITTI's 7518 test frames and zip them for its server; exit code 1 if a check fails."""

    results: Annotated[Path, tyro.conf.Positional]
    """Folder of NNNNNN.txt: one file for every test frame, empty where nothing was detected."""
    out: Annotated[Path, tyro.conf.Positional]
    """The archive to write; its name ends in .zip."""

    def run(self) -> int:
        if self.out.suffix != ".zip":
            raise UsageError(f"{self.out} must end in .zip; choose such a name.")
        if not self.results.is_dir():
            raise UsageError(f"{self.results} is not a folder; give the folder that holds the results.")
        check_file(self.out)
        problems = check_results(self.results)
        for problem in problems:
            print(problem)
        if problems:
            print(f"{len(problems)} problems; {self.out} was not written.")
            return 1
        print(f"Wrote {self.out} with {write_submission(self.results, self.out)} files.")
        return 0


def check_results(folder: Pathlike) -> list[str]:
    """Return what the server would refuse or misread, one sentence each with file, line and remedy.

    There must be one file for each of the 7518 test frames, and every line must have 16 columns, the score last.
    """
    expected = {f"{name}.txt" for name in official_split("test") or ()}
    found = {path.name for path in present_paths(Path(folder), ("{}.txt",))}
    problems = []
    if missing := expected - found:
        problems.append(
            f"{folder}: {len(missing)} of {len(expected)} files are missing ({_some(missing)}); write one for every "
            "test frame, empty where nothing was detected."
        )
    if unexpected := found - expected:
        problems.append(
            f"{folder}: {len(unexpected)} files belong to no test frame ({_some(unexpected)}); remove them."
        )
    for name in sorted(found & expected):
        problems += _check_file(Path(folder) / name)
    return problems


def write_submission(folder: Pathlike, archive: Pathlike) -> int:
    """Zip the results and return their number; raises InputError with the first problem of `check_results`."""
    problems = check_results(folder)
    if problems:
        raise InputError(problems[0])
    paths = present_paths(Path(folder), ("{}.txt",))
    with replacing(archive) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as stream:
        for path in paths:
            stream.writestr(zipfile.ZipInfo(path.name, _TIME), read_bytes(path), zipfile.ZIP_DEFLATED)
    return len(paths)


def _check_file(path: Path) -> Iterator[str]:
    """One sentence for every problem of a file."""
    seen: dict[str, str] = {}
    for place, line in read_lines(path):
        try:
            row = parse_row(line, place)
        except InputError as error:
            yield str(error)
            continue
        x1, y1, x2, y2 = row.bbox
        if row.score is None:
            yield f"{place}: a result has 16 columns, the score last; add the score."
        if x2 <= x1 or y2 <= y1:
            yield f"{place}: the image box is empty; give its edges in pixels, or remove the line."
        if min(row.dimensions) <= 0:
            yield f"{place}: height, width and length must be positive; correct or remove the line."
        if seen.setdefault(line.strip(), place) != place:
            yield f"{place}: the same row as in {seen[line.strip()]}; remove one of the two."


def _some(names: Collection[str]) -> str:
    """The first three names."""
    return ", ".join(sorted(names)[:3]) + (", ..." if len(names) > 3 else "")
