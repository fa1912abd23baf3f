"""`ciassd demo`: results, pictures and a page."""

import re
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from cli_files import names_in
from small import small_cloud

from ciassd_jax.formats.points import write_bin
from ciassd_jax.simulation import Lidar, open_synthetic

SMALL_LIDAR = Lidar(upper=(2.0, -8.0, 8), lower=(-9.0, -24.0, 8), columns=256)


@pytest.mark.slow
def test_demo_detects_in_simulated_streets(run: Any, weights: Path, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("ciassd_jax.cli.options.open_synthetic", partial(open_synthetic, lidar=SMALL_LIDAR))
    result = run("demo", "--weights", weights, "--scenes", "2", "--seed", "3")
    assert result.code == 0
    assert len(re.findall(r"^street_\d: \d+ points, \d+ labelled objects\n\d+ detections", result.out, re.M)) == 2
    names = ["street_0.json", "street_0.png", "street_1.json", "street_1.png", "view.html"]
    assert names_in(tmp_path / "ciassd_demo") == names
    last = result.out.splitlines()[-1]
    assert all(f"ciassd_demo/{name}" in last for name in names)


@pytest.mark.smoke
def test_demo_of_a_file_and_weights_of_your_own(run: Any, weights: Path, tmp_path: Path) -> None:
    write_bin(tmp_path / "street.bin", small_cloud())
    result = run("demo", tmp_path / "street.bin", "--weights", weights, "--out", tmp_path / "out")
    assert (result.code, result.complaints) == (0, "")
    assert "label" not in result.out
    assert names_in(tmp_path / "out") == ["street.json", "street.png", "view.html"]


def test_demo_of_no_scenes_is_refused(run: Any) -> None:
    result = run("demo", "--scenes", "0")
    assert result.code == 2
    assert re.fullmatch(r"error: --scenes .*at least 1\.\n", result.err)


def test_demo_without_pictures_names_the_extra(run: Any, weights: Path, tmp_path: Path, monkeypatch: Any) -> None:
    write_bin(tmp_path / "street.bin", small_cloud())
    for library in ("matplotlib", "plotly"):
        monkeypatch.setitem(sys.modules, library, None)
    result = run("demo", tmp_path / "street.bin", "--weights", weights, "--out", tmp_path / "out")
    assert result.code == 0
    assert result.out.count("pip install 'ciassd_jax[viz]'") == 2
    assert names_in(tmp_path / "out") == ["street.json"]
