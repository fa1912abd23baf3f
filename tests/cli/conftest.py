"""The program `ciassd` called in this process, weights for it, and streets that need no simulation."""

from collections.abc import Callable
from pathlib import Path

import pytest
from cli_files import Run
from mini_folders import write_kitti
from small import random_variables, small_config

from ciassd_jax import open_dataset, save_weights
from ciassd_jax.cli import main
from ciassd_jax.data.frames import Dataset, Frame
from ciassd_jax.simulation import split_synthetic


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., Run]:
    """Run `ciassd` with these arguments."""

    def call(*arguments: object) -> Run:
        code = main([str(argument) for argument in arguments])
        return Run(code, *capsys.readouterr())

    return call


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    save_weights(tmp_path / "small.safetensors", random_variables(small_config()), small_config())
    return tmp_path / "small.safetensors"


@pytest.fixture
def streets(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Frames of files in place of simulated ones, and the (seed, number) of each call."""
    dataset, calls = open_dataset(write_kitti(tmp_path_factory.mktemp("streets")), "all"), []

    def read(name: str) -> Frame:
        return dataset.read(int(name) % len(dataset))._replace(name=name)

    def open_streets(seed: int, frames: int) -> Dataset:
        calls.append((seed, frames))
        return Dataset(split_synthetic(frames)["all"], read)

    monkeypatch.setattr("ciassd_jax.cli.options.open_synthetic", open_streets)
    return calls
