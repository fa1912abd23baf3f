"""`ciassd export`: one file, and options that cannot be used."""

import re
from pathlib import Path
from typing import Any

import pytest
from small import small_cloud

from ciassd_jax import load_exported
from ciassd_jax.inference import export


@pytest.mark.slow
def test_export_writes_a_file_that_loads(run: Any, weights: Path, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(export, "_street", lambda index, config, num_points: small_cloud(index))
    out = tmp_path / "out" / "car.ciassd"
    options = ("--points", 640, "--batch", 2, "--platforms", "cpu", "tpu", "--config.detection.min-score", 0.01)
    result = run("export", "--weights", weights, out, *options)
    assert (result.code, result.err) == (0, "Compiling the exported predict for 2 x 640 points, once.\n")
    assert re.fullmatch(r"Wrote \S+car.ciassd: 2 x 640 points .* cpu, tpu, 0\.\d MB; \d+ boxes .*\.\n", result.out)
    loaded = load_exported(out)
    assert loaded.manifest["platforms"] == ["cpu", "tpu"]
    assert loaded.config.detection.min_score == 0.01
    assert [one.name for one in out.parent.iterdir()] == ["car.ciassd"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--points", 0), "error: --points is 0; give at least 1.\n"),
        (("--batch", -1), "error: --batch is -1; give at least 1.\n"),
    ],
)
def test_impossible_options_are_refused(run: Any, weights: Path, tmp_path: Path, options: Any, message: str) -> None:
    result = run("export", "--weights", weights, tmp_path / "car.ciassd", *options)
    assert (result.code, result.err) == (2, message)


def test_a_place_that_cannot_be_written_is_refused_before_compiling(run: Any, weights: Path) -> None:
    result = run("export", "--weights", weights, weights / "car.ciassd")
    assert result.code == 2
    assert re.fullmatch(r"error: \S+ cannot be a folder, as .* is a file; choose another place\.\n", result.err)
