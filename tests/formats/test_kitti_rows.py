"""KITTI's rows: label files, result files as the official evaluator reads them, and levels of difficulty."""

from itertools import pairwise
from pathlib import Path

import pytest
from kitti_samples import ROW, assert_refused

from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.kitti_rows import (
    DIFFICULTIES,
    ObjectRow,
    difficulty_of,
    format_row,
    is_dont_care,
    read_labels,
    read_results,
    read_rows,
    write_rows,
)

RESULT = "Car -1 -1 0.25 10 20 110 80 1.5 1.6 3.9 -20 1.6 15 0.5 0.75"


def test_rows_are_read_and_written(tmp_path):
    path = tmp_path / "a.txt"
    label = "Cyclist 0.50 3 -1.5 1 2 3 4 1.6 0.5 1.7 -5 1.6 15.25 0.1"
    path.write_bytes(f"{label}\r\n\n{label} 0.25".encode())
    row = ObjectRow("Cyclist", 0.5, 3, -1.5, (1, 2, 3, 4), (1.6, 0.5, 1.7), (-5, 1.6, 15.25), 0.1)
    first, third = f"{path}, line 1", f"{path}, line 3"
    assert read_rows(path) == [row._replace(place=first), row._replace(score=0.25, place=third)]
    assert format_row(row) == (
        "Cyclist 0.5000 3 -1.5000 1.0000 2.0000 3.0000 4.0000 1.6000 0.5000 1.7000 -5.0000 1.6000 15.2500 0.1000"
    )
    assert format_row(row._replace(score=0.25)) == format_row(row) + " 0.2500"
    write_rows(path, [row, row._replace(score=0.25)])
    assert [one._replace(place="") for one in read_rows(path)] == [row, row._replace(score=0.25)]
    write_rows(path, [])
    assert path.read_bytes() == b""
    assert read_rows(path) == []


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("Car 0 0 0", "line 2: 4 columns; a label has 15 and a result 16, so write it again"),
        ("Car" + " 0" * 16, "line 2: 17 columns"),
        ("Car 0 0 x" + " 0" * 11, "line 2: could not convert string to float: 'x'; write a number there"),
        ("Car 0 0.5" + " 0" * 12, r"line 2: the occlusion 0\.5 is not a whole number; write"),
        ("Car 0 0 nan" + " 0" * 11, "line 2: a value is not finite; write a number there"),
        ("\x00\xff\x93", "line 2: 1 columns"),
    ],
)
def test_an_unusable_row_gets_one_sentence(tmp_path, line, message):
    (tmp_path / "a.txt").write_bytes(f"{format_row(ROW)}\n{line}\n".encode("latin-1"))
    assert_refused(read_rows, tmp_path / "a.txt", message)


def test_every_problem_of_a_label_file_is_collected_and_any_type_is_read(tmp_path):
    path = tmp_path / "a.txt"
    label = format_row(ROW._replace(score=None))
    path.write_text(f"{label}\nCar 0\n{label.replace('Car', 'forklift')}\n{label.replace('Car 0.0000', 'Car nan')}\n")
    problems: list[InputError] = []
    rows = read_labels(path, problems)
    assert [(row.type, row.place) for row in rows] == [("Car", f"{path}, line 1"), ("forklift", f"{path}, line 3")]
    first, second = map(str, problems)
    assert first.startswith(f"{path}, line 2: 2 columns")
    assert second.startswith(f"{path}, line 4: a value is not finite")
    with pytest.raises(InputError, match="line 2: 2 columns"):
        read_labels(path)


def test_areas_without_labels_are_known_in_any_case():
    assert [is_dont_care(name) for name in ("DontCare", "dontcare", "DONTCARE", "Car")] == [True, True, True, False]


def test_no_file_and_a_directory(tmp_path):
    assert_refused(read_rows, tmp_path / "no.txt", "does not exist; check the path")
    assert_refused(read_rows, tmp_path, "is a directory; name a file inside it")


def write(folder: Path, *lines: str) -> Path:
    path = folder / "000007.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_row(tmp_path: Path) -> None:
    path = write(tmp_path, RESULT)
    found = read_results(path)
    place = f"{path}, line 1"
    expected = ObjectRow("Car", -1, -1, 0.25, (10, 20, 110, 80), (1.5, 1.6, 3.9), (-20, 1.6, 15), 0.5, 0.75, place)
    assert found == ([expected], [], [], [])


def test_our_own_rows_read_alike(tmp_path: Path) -> None:
    path = tmp_path / "000001.txt"
    write_rows(path, read_rows(write(tmp_path, RESULT, RESULT.replace("Car", "Van"))))
    assert read_results(path).rows == read_rows(path)
    assert len(read_rows(path)) == 2


def test_lengths_and_repetitions(tmp_path: Path) -> None:
    path = write(
        tmp_path, RESULT, "", "  ", RESULT.rsplit(" ", 1)[0], RESULT + " 0.5 x", RESULT.replace(" ", "   "), "Car"
    )
    found = read_results(path)
    assert len(found.rows) == 3
    lines = [[place.removeprefix(f"{path}, line ") for place in places] for places in found[1:]]
    assert lines == [["4", "7"], ["5"], ["5", "6"]]


def test_occlusion_may_be_written_as_a_fraction(tmp_path: Path) -> None:
    assert read_results(write(tmp_path, RESULT.replace("-1 -1", "0.00 0.00"))).rows[0].occluded == 0


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
        read_results(write(tmp_path, RESULT, RESULT.replace(old, new)))


def test_bytes_that_are_no_text(tmp_path: Path) -> None:
    path = tmp_path / "000000.txt"
    path.write_bytes(b"Car " + b"\xff " * 15)
    with pytest.raises(InputError, match=r"000000.txt, line 1: could not convert"):
        read_results(path)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        read_results(tmp_path / "none.txt")


def car(height: float, occluded: int = 0, truncated: float = 0.0) -> ObjectRow:
    return ObjectRow("Car", truncated, occluded, 0.0, (0, 0, 50, height), (1.5, 1.6, 4), (0, 1.7, 20), 0.0)


@pytest.mark.parametrize(
    ("height", "occluded", "truncated", "expected"),
    [
        (41, 0, 0.0, 0),
        (40, 0, 0.0, 1),
        (25, 0, 0.0, -1),
        (25.01, 0, 0.0, 1),
        (99, 1, 0.0, 1),
        (99, 2, 0.0, 2),
        (99, 3, 0.0, -1),
        (99, -1, -1.0, 0),
        (99, 0, 0.15, 0),
        (99, 0, 0.1501, 1),
        (99, 0, 0.3, 1),
        (99, 0, 0.31, 2),
        (99, 0, 0.5, 2),
        (99, 0, 0.51, -1),
    ],
)
def test_difficulty(height: float, occluded: int, truncated: float, expected: int) -> None:
    assert difficulty_of(car(height, occluded, truncated)) == expected


def test_levels_are_nested() -> None:
    for easier, harder in pairwise(DIFFICULTIES):
        assert easier.min_height >= harder.min_height
        assert easier.max_occlusion < harder.max_occlusion
        assert easier.max_truncation < harder.max_truncation
