"""Checkpoints: what stays, what a damaged one does, and that a state comes back with the same bits."""

import gc
import json
import resource
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from small import random_variables, small_config

from ciassd_jax import create_train_state
from ciassd_jax.data.loader import LoaderState
from ciassd_jax.formats.errors import FormatWarning, InputError
from ciassd_jax.training.checkpoint import Checkpoints, first_difference
from ciassd_jax.types import TrainState

# Where files cannot be read or written, orbax leaves what it had begun behind: coroutines and callbacks.
pytestmark = pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning", "ignore:coroutine:RuntimeWarning"
)
CONFIG = replace(small_config(), schedule=replace(small_config().schedule, ema_decay=0.9))
LOADER = LoaderState(batch=0, seed=3, batch_size=2, frames=5, checksum=77)


@pytest.fixture(scope="module")
def state() -> TrainState:
    return create_train_state(jax.random.key(0), CONFIG, variables=random_variables(CONFIG))


def at(state: TrainState, step: int) -> TrainState:
    """A state that differs from those of other steps in every kind of leaf."""
    return jax.tree.map(lambda leaf: leaf + jnp.asarray(step, leaf.dtype), state)._replace(step=jnp.int32(step))


def save(folder: Path, state: TrainState, scores: dict[int, float | None]) -> None:
    with Checkpoints(folder, CONFIG, keep=2) as checkpoints:
        for step, score in scores.items():
            checkpoints.save(at(state, step), LOADER._replace(batch=step), score=score)


def assert_same_bits(some: TrainState, others: TrainState) -> None:
    assert jax.tree.structure(some) == jax.tree.structure(others)
    jax.tree.map(np.testing.assert_array_equal, some, others)


def test_the_last_and_the_best_stay_and_come_back(tmp_path: Path, state: TrainState) -> None:
    save(tmp_path, state, {2: 1.0, 4: 5.0, 6: 3.0, 8: None, 10: None})
    with Checkpoints(tmp_path, CONFIG, keep=2) as checkpoints:
        assert checkpoints.steps == [4, 8, 10]
        restored = checkpoints.restore(state)
    assert restored is not None
    assert (restored.loader, restored.score) == (LOADER._replace(batch=10), None)
    assert_same_bits(restored.state, at(state, 10))


def test_an_empty_folder_has_nothing_to_go_on_from(tmp_path: Path, state: TrainState) -> None:
    with Checkpoints(tmp_path / "new", CONFIG) as checkpoints:
        assert checkpoints.restore(state) is None


def _truncate(folder: Path) -> None:
    for path in folder.rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _keep_little(folder: Path) -> None:
    """As a kill before the end would leave it under the name of a complete one."""
    shutil.rmtree(folder)
    (folder / "state").mkdir(parents=True)


def _empty_data(folder: Path) -> None:
    for path in (folder / "state").rglob("d/*"):
        path.write_bytes(b"")


def _lose_progress(folder: Path) -> None:
    shutil.rmtree(folder / "progress")


@pytest.mark.parametrize("damage", [_truncate, _keep_little, _empty_data, _lose_progress])
def test_a_damaged_checkpoint_gives_way_to_the_one_before(
    damage: Callable[[Path], None], tmp_path: Path, state: TrainState
) -> None:
    save(tmp_path, state, {2: None, 4: None})
    damage(tmp_path / "4")
    with Checkpoints(tmp_path, CONFIG, keep=2) as checkpoints:
        if 4 in checkpoints.steps:
            with pytest.warns(FormatWarning, match="is damaged"):
                restored = checkpoints.restore(state)
        else:
            restored = checkpoints.restore(state)
        assert restored is not None
        assert_same_bits(restored.state, at(state, 2))
        checkpoints.save(at(state, 4), LOADER)
        checkpoints.wait()
        again = checkpoints.restore(state)
    assert again is not None
    assert_same_bits(again.state, at(state, 4))


def test_a_half_written_folder_is_swept_away(tmp_path: Path, state: TrainState) -> None:
    save(tmp_path, state, {2: None})
    shutil.copytree(tmp_path / "2", tmp_path / "4.orbax-checkpoint-tmp")
    with Checkpoints(tmp_path, CONFIG) as checkpoints:
        assert checkpoints.steps == [2]
        checkpoints.save(at(state, 4), LOADER)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["2", "4"]


def test_only_damaged_ones_are_left_alone(tmp_path: Path, state: TrainState) -> None:
    save(tmp_path, state, {2: None, 4: None})
    for step in (2, 4):
        _empty_data(tmp_path / str(step))
    with Checkpoints(tmp_path, CONFIG) as checkpoints, pytest.raises(InputError, match="None of the checkpoints"):
        checkpoints.restore(state)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["2", "4"]


def test_another_config_is_refused_with_its_first_difference(tmp_path: Path, state: TrainState) -> None:
    save(tmp_path, state, {2: None})
    other = replace(CONFIG, loss=replace(CONFIG.loss, iou_weight=2.0))
    with (
        Checkpoints(tmp_path, other) as checkpoints,
        pytest.raises(InputError, match=r"config\.loss\.iou_weight is 1\.0 there and 2\.0 here"),
    ):
        checkpoints.restore(state)


@pytest.mark.parametrize(
    ("saved", "text"),
    [
        ({"a": 1, "b": 2}, "config.b is 2 there and 3 here"),
        ({"a": 1}, "config.b is new"),
        ({"a": 1, "b": 3, "c": 0}, "config.c is unknown here"),
        ({"a": [{"d": 1}], "b": 3}, "config.a is [{'d': 1}] there and 1 here"),
    ],
)
def test_first_difference(saved: dict, text: str) -> None:
    assert first_difference(saved, {"a": 1, "b": 3}) == text


def test_first_difference_in_a_list() -> None:
    assert first_difference([{"x": 1}, {"x": 2}], [{"x": 1}, {"x": 4}]) == "config[1].x is 2 there and 4 here"


def test_restores_on_another_number_of_devices(tmp_path: Path, state: TrainState) -> None:
    save(tmp_path, state, {2: None})
    devices = jax.devices()[:2]
    everywhere = NamedSharding(Mesh(np.array(devices), ("scenes",)), PartitionSpec())
    with Checkpoints(tmp_path, CONFIG) as checkpoints:
        restored = checkpoints.restore(jax.device_put(state, everywhere))
    assert restored is not None
    assert {leaf.sharding for leaf in jax.tree.leaves(restored.state)} == {everywhere}
    assert_same_bits(jax.device_get(restored.state), jax.device_get(at(state, 2)))


@contextmanager
def limited_files(size: int) -> Iterator[None]:
    """No file may grow beyond so many bytes: what a full disk looks like."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_is_one_sentence_and_leaves_the_earlier_ones(
    tmp_path: Path, state: TrainState, caplog: pytest.LogCaptureFixture
) -> None:
    save(tmp_path, state, {2: None})
    # Pages of traces would not fit the limit where output is caught in a file.
    for name in ("absl", "asyncio"):
        caplog.set_level("CRITICAL", name)
    with limited_files(20_000), pytest.raises(InputError, match=r"cannot be written to .* \(File too large\)"):
        save(tmp_path, state, {4: None})
    with Checkpoints(tmp_path, CONFIG) as checkpoints:
        restored = checkpoints.restore(state)
    assert restored is not None
    assert_same_bits(restored.state, at(state, 2))


def test_a_folder_that_cannot_be_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file"):
        Checkpoints(tmp_path / "file" / "checkpoints", CONFIG)
    with pytest.raises(ValueError, match="at least 1"):
        Checkpoints(tmp_path, CONFIG, keep=0)


def test_the_config_is_readable(tmp_path: Path, state: TrainState) -> None:
    save(tmp_path, state, {2: 7.5})
    progress = json.loads((tmp_path / "2" / "progress" / "metadata").read_text())
    assert progress["config"] == json.loads(CONFIG.to_json())
    assert progress["score"] == 7.5


@pytest.fixture(scope="module", autouse=True)
def _left_behind() -> Iterator[None]:
    """Collect it while this module's filter holds."""
    yield
    gc.collect()
