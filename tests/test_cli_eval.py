"""`ciassd eval`, called in this process and, to see that no device starts, in its own."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from ciassd_jax.cli import main
from ciassd_jax.evaluation import evaluate, read_folders, to_json
from ciassd_jax.formats.kitti import ObjectRow, write_rows


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """Labels and exact results of two frames."""
    labels, results = tmp_path / "label_2", tmp_path / "results"
    labels.mkdir()
    results.mkdir()
    for frame in range(2):
        row = ObjectRow("Car", 0, 0, 0.1, (10, 20, 110, 80), (1.5, 1.6, 4), (frame, 1.7, 20), 0.2)
        write_rows(labels / f"{frame:06}.txt", [row])
        write_rows(results / f"{frame:06}.txt", [row._replace(score=0.5 + frame / 10)])
    return labels, results


def test_prints_the_block_and_writes_json(
    folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "result.json"
    assert main(["eval", "txt", *map(str, folders), "--json", str(out)]) == 0
    shown, said = capsys.readouterr()
    assert said == ""
    assert shown.startswith("Car AP@0.70, 0.70, 0.70:\nbbox AP:9.0909, 9.0909, 9.0909\n")
    assert shown.endswith(f"Wrote {out}.\n")
    assert json.loads(out.read_text()) == to_json(evaluate(*read_folders(*folders)))
    assert [path.name for path in out.parent.iterdir()] == ["result.json"]


def test_warnings_are_lines(folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    (folders[1] / "000001.txt").unlink()
    assert main(["eval", "txt", *map(str, folders)]) == 0
    said = capsys.readouterr().err
    assert said.startswith("warning: Frames of ")
    assert said.count("\n") == 1


@pytest.mark.parametrize("what", ["missing", "score", "json"])
def test_bad_input_is_one_sentence(
    what: str, folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    labels, results = folders
    arguments = {
        "missing": [labels, tmp_path / "absent"],
        "score": [labels, results],
        "json": [labels, results, "--json", labels / "000000.txt" / "out.json"],
    }
    if what == "score":
        with open(results / "000000.txt", "a") as stream:
            stream.write("Car 0 0 0 1 2 3 4 1 1 1 0 0 9 0 nan\n")
    assert main(["eval", "txt", *map(str, arguments[what])]) == 2
    shown, said = capsys.readouterr()
    assert shown == ""
    assert said.startswith("error: ")
    assert said.count("\n") == 1
    expected = {"missing": "absent does not exist", "score": "000000.txt, line 2: the score", "json": "is a file"}
    assert expected[what] in said


def test_nothing_to_evaluate(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval"]) == 2
    assert "ciassd eval txt LABELS RESULTS" in capsys.readouterr().err


def test_starts_no_device(folders: tuple[Path, Path]) -> None:
    code = (
        "import sys; from ciassd_jax.cli import main; import jax._src.xla_bridge as bridge; "
        "assert main(sys.argv[1:]) == 0; assert not bridge._backends, 'a device was initialised'"
    )
    command = [sys.executable, "-W", "error", "-c", code, "eval", "txt", *map(str, folders)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "3d   AP:" in done.stdout
