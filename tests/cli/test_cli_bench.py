"""`ciassd bench`: a table and JSON of what detection takes."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from small import small_cloud

from ciassd_jax.formats.points import write_bin


def test_bench_of_a_folder_gives_a_table_and_json(run: Any, weights: Path, tmp_path: Path) -> None:
    (tmp_path / "clouds").mkdir()
    for seed in range(3):
        write_bin(tmp_path / "clouds" / f"{seed}.bin", small_cloud(seed, 500 + 100 * seed))
    file = tmp_path / "out" / "bench.json"
    options = ("--data", tmp_path / "clouds", "--repeats", 3, "--json", file)
    result = run("bench", "--weights", weights, *options)
    assert result.code == 0
    numbers = json.loads(file.read_text())
    assert numbers["points"] == {"min": 500, "median": 600, "max": 700}
    assert 0 < numbers["voxels"]["min"] <= numbers["voxels"]["max"] <= 700
    for part in ("call", "device"):
        assert 0 < numbers[part]["p50"] <= numbers[part]["p90"] <= numbers[part]["p99"]
    assert numbers["frames_per_second"] == pytest.approx(1 / numbers["call"]["p50"])
    assert min(numbers[name] for name in ("compile", "first_call")) > 0
    assert numbers["memory"]["arguments"] > 0
    assert numbers["machine"]["platform"] == "cpu"
    assert isinstance(numbers["cached"], bool)
    rows = dict(line.split(maxsplit=1) for line in result.out.splitlines() if not line.startswith("first call"))
    assert rows["points"] == "500 to 700 per cloud, median 600"
    assert rows["speed"].startswith(f"{numbers['frames_per_second']:.1f} frames/s")
    assert rows["Wrote"] == f"{file}."


@pytest.mark.slow
def test_bench_simulates_by_default_and_takes_batches(run: Any, weights: Path, streets: Any) -> None:
    result = run("bench", "--weights", weights, "--repeats", 1, "--batch-size", 9)
    assert result.code == 0
    assert "9 of simulated, 9 per call" in result.out
    assert streets == [(0, 9)]


@pytest.mark.parametrize("option", ["--batch-size", "--repeats"])
def test_numbers_below_1_are_refused(run: Any, weights: Path, option: str) -> None:
    result = run("bench", "--weights", weights, option, 0)
    assert result.code == 2
    assert re.fullmatch(f"error: {option} is 0; .* at least 1 .*\\.\n", result.err)
