"""Result files as the official evaluator reads them."""

from pathlib import Path

import pytest

from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.kitti import ObjectRow, read_rows, write_rows
from ciassd_jax.formats.kitti_results import read_results

ROW = "Car -1 -1 0.25 10 20 110 80 1.5 1.6 3.9 -20 1.6 15 0.5 0.75"


def write(folder: Path, *lines: str) -> Path:
    path = folder / "000007.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_row(tmp_path: Path) -> None:
    found = read_results(write(tmp_path, ROW))
    expected = ObjectRow("Car", -1, -1, 0.25, (10, 20, 110, 80), (1.5, 1.6, 3.9), (-20, 1.6, 15), 0.5, 0.75)
    assert found == ([expected], [], [], [])


def test_our_own_rows_read_alike(tmp_path: Path) -> None:
    path = tmp_path / "000001.txt"
    write_rows(path, read_rows(write(tmp_path, ROW, ROW.replace("Car", "Van"))))
    assert read_results(path).rows == read_rows(path)


def test_lengths_and_repetitions(tmp_path: Path) -> None:
    path = write(tmp_path, ROW, "", "  ", ROW.rsplit(" ", 1)[0], ROW + " 0.5 x", ROW.replace(" ", "   "), "Car")
    found = read_results(path)
    assert len(found.rows) == 3
    assert found[1:] == ([4, 7], [5], [5, 6])


def test_occlusion_may_be_written_as_a_fraction(tmp_path: Path) -> None:
    assert read_results(write(tmp_path, ROW.replace("-1 -1", "0.00 0.00"))).rows[0].occluded == 0


def test_an_empty_file(tmp_path: Path) -> None:
    (tmp_path / "empty.txt").touch()
    assert read_results(tmp_path / "empty.txt") == ([], [], [], [])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("0.75", "nan", r"000007.txt, line 2: the score is not finite; write a number there\."),
        ("0.75", "-inf", r"000007.txt, line 2: the score is not finite; write a number there\."),
        ("3.9", "nan", r"000007.txt, line 2: a value is not finite; write a number there\."),
        ("3.9", "long", r"000007.txt, line 2: could not convert .*'long'; write a number there\."),
    ],
)
def test_no_numbers(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_results(write(tmp_path, ROW, ROW.replace(old, new)))


def test_bytes_that_are_no_text(tmp_path: Path) -> None:
    path = tmp_path / "000000.txt"
    path.write_bytes(b"Car " + b"\xff " * 15)
    with pytest.raises(InputError, match=r"000000.txt, line 1: could not convert"):
        read_results(path)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        read_results(tmp_path / "none.txt")
