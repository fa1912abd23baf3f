"""The README's walk with another sensor and an own class: from files to a detector by commands alone."""

import json
from pathlib import Path
from typing import Any

import pytest

from ciassd_jax import Config, load_weights


@pytest.mark.slow
def test_from_files_to_a_detector(run: Any, tmp_path: Path) -> None:
    def done(*arguments: object) -> str:
        result = run(*arguments)
        assert result.code == 0, result.err
        return result.out

    yard, config, work = tmp_path / "yard", tmp_path / "forklift.json", tmp_path / "run"
    sensor = ("--beams", 32, "--sensor-height", 2.1, "--max-range", 40, "--class", "Forklift")
    done("data", "synth", yard, "--frames", 12, *sensor)
    coarse = ("--config.grid.voxel-size", 0.2, 0.2, 0.2, "--config.grid.minimum", 0, -6.4, -3)
    config.write_text(done("data", "suggest", yard, "--preset", "tiny", *coarse, "--classes", "forklift"))
    suggested = Config.from_json(config.read_text())
    assert suggested.class_names == ("Forklift",)
    assert "objects of class Forklift" in done("info", "--config", config, "--data", yard)
    assert done("data", "check", yard, "--config", config).splitlines()[-1].startswith("Verdict: ready to train: ")
    scale = ("--intensity-scale", 2)
    trained = done(
        "train", "--config", config, "--data", yard, "--workdir", work, "--steps", 3, "--log-every", 1, *scale
    )
    assert "(Forklift " in trained
    lines = [json.loads(line) for line in (work / "metrics.jsonl").read_text().splitlines()]
    assert all(line["positives"] > 0 for line in lines if "positives" in line)
    assert load_weights(work / "last.safetensors").config.input.intensity_scale == 2
    assert "Forklift" in done("eval", "--workdir", work, "--data", yard)
    clouds = yard / "training" / "velodyne"
    out = done("predict", clouds, "--weights", work / "last.safetensors", "--out", tmp_path / "results")
    assert "points that the camera does not see" in out
    assert len(list((tmp_path / "results").glob("*.txt"))) == 12
