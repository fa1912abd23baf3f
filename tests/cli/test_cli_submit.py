"""Results for KITTI's server: 7518 files, sound rows, one archive."""

import zipfile
from pathlib import Path
from typing import Any

import pytest

from ciassd_jax.cli.submit import check_results, write_submission
from ciassd_jax.formats.errors import InputError

ROW = "Car 0.0 0 -1.5 100 150 200 250 1.5 1.6 3.9 1 1.6 20 -1.5 0.9"


@pytest.fixture(scope="module")
def complete(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sound folder of 7518 files, most of them empty."""
    folder = tmp_path_factory.mktemp("results")
    for frame in range(7518):
        (folder / f"{frame:06d}.txt").write_text(f"{ROW}\n" if frame < 3 else "")
    return folder


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Three files, so that the others are missing."""
    folder = tmp_path / "results"
    folder.mkdir()
    for frame in range(3):
        (folder / f"{frame:06d}.txt").write_text(f"{ROW}\n{ROW.replace('100 150', '90 140')}\n")
    return folder


def test_a_complete_folder_becomes_an_archive(complete: Path, tmp_path: Path) -> None:
    assert check_results(complete) == []
    (complete / "000000.json").write_text("{}")
    assert write_submission(complete, tmp_path / "out" / "a.zip") == 7518
    with zipfile.ZipFile(tmp_path / "out" / "a.zip") as archive:
        assert archive.testzip() is None
        names = archive.namelist()
        assert names == [f"{frame:06d}.txt" for frame in range(7518)]
        assert archive.read("000002.txt").decode() == f"{ROW}\n"
        assert archive.read("007517.txt") == b""
    write_submission(complete, tmp_path / "b.zip")
    assert (tmp_path / "b.zip").read_bytes() == (tmp_path / "out" / "a.zip").read_bytes()


def test_the_command_writes_the_archive_or_lists_the_problems(run: Any, complete: Path, tmp_path: Path) -> None:
    result = run("submit", complete, tmp_path / "a.zip")
    assert (result.code, result.out) == (0, f"Wrote {tmp_path / 'a.zip'} with 7518 files.\n")
    (complete / "000007.txt").write_text("Car\n")
    (complete / "000008.txt").unlink()
    result = run("submit", complete, tmp_path / "b.zip")
    for name in ("000007.txt", "000008.txt"):
        (complete / name).write_text("")
    assert result.code == 1
    missing, bad, summary = result.out.splitlines()
    assert missing.startswith(f"{complete}: 1 of 7518 files are missing (000008.txt); ")
    assert bad.startswith(f"{complete / '000007.txt'}, line 1: 1 columns")
    assert summary == f"2 problems; {tmp_path / 'b.zip'} was not written."
    assert not (tmp_path / "b.zip").exists()


def test_missing_and_foreign_files(results: Path, tmp_path: Path) -> None:
    (results / "007518.txt").write_text("")
    (results / "notes.txt").write_text("not a result")
    missing, foreign = check_results(results)
    assert missing == (
        f"{results}: 7515 of 7518 files are missing (000003.txt, 000004.txt, 000005.txt, ...); write one for every "
        "test frame, empty where nothing was detected."
    )
    assert foreign == f"{results}: 2 files belong to no test frame (007518.txt, notes.txt); remove them."
    with pytest.raises(InputError, match="7515 of 7518 files are missing"):
        write_submission(results, tmp_path / "a.zip")
    assert not (tmp_path / "a.zip").exists()


def test_an_empty_folder(tmp_path: Path) -> None:
    (problem,) = check_results(tmp_path)
    assert "7518 of 7518 files are missing" in problem


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (ROW.rsplit(" ", 1)[0], "a result has 16 columns, the score last; add the score."),
        (ROW + " 1", "17 columns; a label has 15 and a result 16, so write it again."),
        (ROW.replace("0.9", "nan"), "the score is not finite; write a number there."),
        (ROW.replace("0.9", "high"), "could not convert string to float: 'high'; write a number there"),
        (ROW.replace("100 150", "300 150"), "the image box is empty; give its edges in pixels"),
        (ROW.replace("1.5 1.6 3.9", "-1 -1 -1"), "height, width and length must be positive; correct or remove"),
        (ROW, "the same row as in {path}, line 1; remove one of the two."),
    ],
)
def test_a_bad_row_is_named_by_file_and_line(results: Path, row: str, message: str) -> None:
    path = results / "000001.txt"
    path.write_text(f"{ROW}\n\n{row}\n")
    _, problem = check_results(results)
    assert problem.startswith(f"{path}, line 3: {message.format(path=path)}")
