"""Folders of text: what is read, what is warned of and what is refused."""

import warnings
from pathlib import Path

import pytest
from scenes import found, label

from ciassd_jax.evaluation import evaluate, read_folders
from ciassd_jax.formats.errors import FormatWarning, InputError
from ciassd_jax.formats.kitti_rows import format_row, write_rows


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """Labels and results of three frames with one car each."""
    labels, results = tmp_path / "label_2", tmp_path / "data"
    labels.mkdir()
    results.mkdir()
    for frame in range(3):
        write_rows(labels / f"{frame:06}.txt", [label(frame)])
        write_rows(results / f"{frame:06}.txt", [found(label(frame), 0.5 + frame / 10)])
    return labels, results


def test_frames_in_the_order_of_names(folders: tuple[Path, Path]) -> None:
    truths, detections = read_folders(*folders)
    assert [frame.score.tolist() for frame in detections] == [[0.5], [0.6], [0.7]]
    assert [frame.difficulty.tolist() for frame in truths] == [[0], [0], [0]]
    assert [curve.true.tolist() for curve in evaluate(truths, detections).curves["Car", "3d", 0.7]] == [[1, 2, 3]] * 3


def test_frames_without_results_are_left_out_and_counted(folders: tuple[Path, Path]) -> None:
    (folders[1] / "000001.txt").unlink()
    with pytest.warns(FormatWarning, match=r"without a result file are not evaluated: 1 of 3, 000001.txt first"):
        truths, _ = read_folders(*folders)
    assert len(truths) == 2


def test_an_empty_result_file_is_a_frame_without_detections(folders: tuple[Path, Path]) -> None:
    (folders[1] / "000001.txt").write_text("")
    truths, detections = read_folders(*folders)
    assert [len(frame.types) for frame in detections] == [1, 0, 1]
    assert evaluate(truths, detections).curves["Car", "3d", 0.7][0].missed.tolist() == [2, 1]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("Car 0 0", r"Rows of fewer than 16 columns were left out: 1 in all, the first is .*000002.txt, line 2\."),
        (
            format_row(found(label(7), 0.1)) + " 7",
            r"more than 16 columns was ignored: 1 in all, .*line 2\.",
        ),
        (
            format_row(found(label(2), 0.7)),
            r"Rows that repeat another .* false positives: 1 in all, .*02.txt, line 2\.",
        ),
    ],
)
def test_odd_rows_are_counted(folders: tuple[Path, Path], line: str, message: str) -> None:
    with open(folders[1] / "000002.txt", "a") as stream:
        stream.write(line + "\n")
    with warnings.catch_warnings(record=True) as caught, pytest.warns(FormatWarning, match=message):
        read_folders(*folders)
    assert not caught


def test_a_repeated_row_is_a_false_positive(folders: tuple[Path, Path]) -> None:
    write_rows(folders[1] / "000002.txt", [found(label(2), 0.7)] * 2)
    with pytest.warns(FormatWarning, match="repeat"):
        evaluation = evaluate(*read_folders(*folders))
    assert evaluation.curves["Car", "3d", 0.7][0].false.tolist() == [1, 1, 1]


def test_folders_that_cannot_be_used(folders: tuple[Path, Path], tmp_path: Path) -> None:
    labels, results = folders
    for pair in ((tmp_path / "none", results), (labels, tmp_path / "none")):
        with pytest.raises(InputError, match=r"none does not exist; name the folder that holds the \w+ as NNNNNN.txt"):
            read_folders(*pair)
    with pytest.raises(InputError, match=r"000000.txt is a file; name the folder that holds the results"):
        read_folders(labels, results / "000000.txt")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"empty has no .txt files; name the folder that holds the results"):
        read_folders(labels, tmp_path / "empty")
    with pytest.raises(InputError, match=rf"has no .txt files; name {results}\."):
        read_folders(labels, tmp_path)


def test_results_of_other_frames(folders: tuple[Path, Path]) -> None:
    write_rows(folders[1] / "000009.txt", [])
    with pytest.raises(InputError, match=r"data/000009.txt has no labels in .*label_2 \(1 such files\); remove"):
        read_folders(*folders)


def test_values_that_are_no_numbers(folders: tuple[Path, Path]) -> None:
    labels, results = folders
    text = (results / "000001.txt").read_text()
    (results / "000001.txt").write_text(text.replace("0.6000\n", "nan\n"))
    with pytest.raises(InputError, match=r"000001.txt, line 1: the score is not finite; write a number there\."):
        read_folders(labels, results)
    (results / "000001.txt").write_text(text)
    (labels / "000000.txt").write_text("Car 0 0 x\n")
    with pytest.raises(InputError, match=r"label_2/000000.txt, line 1: 4 columns; a label has 15"):
        read_folders(labels, results)
