"""Checkpoints: which ones are kept, damaged ones, refused ones, and states restored to the same bits."""

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
import optax
import pytest
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from small import random_variables, small_config

from ciassd_jax import create_train_state
from ciassd_jax.data.loader import LoaderState
from ciassd_jax.formats.errors import FormatWarning, InputError
from ciassd_jax.model.checks import variables_of
from ciassd_jax.training import distributed
from ciassd_jax.training.checkpoint import Checkpoints, checkpoint_steps, checkpoint_variables, first_difference
from ciassd_jax.types import TrainState

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


@pytest.mark.smoke
def test_the_last_and_the_best_are_kept_and_restored(tmp_path: Path, state: TrainState) -> None:
    save(tmp_path, state, {2: 1.0, 4: 5.0, 6: 3.0, 8: None, 10: None})
    with Checkpoints(tmp_path, CONFIG, keep=2) as checkpoints:
        assert checkpoints.steps == [4, 8, 10]
        restored = checkpoints.restore(state)
    assert restored is not None
    assert (restored.loader, restored.score) == (LOADER._replace(batch=10), None)
    assert_same_bits(restored.state, at(state, 10))


def test_the_weights_of_a_checkpoint_are_read_alone(tmp_path: Path, state: TrainState) -> None:
    save(tmp_path, state, {2: 1.0, 4: None})
    # What a running training writes is left alone.
    (tmp_path / "6.orbax-checkpoint-tmp").mkdir()
    assert checkpoint_steps(tmp_path) == [2, 4]
    variables = checkpoint_variables(tmp_path, 4)
    jax.tree.map(np.testing.assert_array_equal, variables, variables_of(at(state, 4)))
    assert (tmp_path / "6.orbax-checkpoint-tmp").is_dir()
    _empty_data(tmp_path / "4")
    with pytest.raises(InputError, match=r"/4 cannot be read \(.*\); remove this folder to evaluate the others\.$"):
        checkpoint_variables(tmp_path, 4)


def test_without_a_moving_average_the_parameters_are_read(tmp_path: Path, state: TrainState) -> None:
    config = replace(CONFIG, schedule=replace(CONFIG.schedule, ema_decay=0.0))
    with Checkpoints(tmp_path, config) as checkpoints:
        checkpoints.save(state._replace(ema=None), LOADER)
    variables = checkpoint_variables(tmp_path, 0)
    jax.tree.map(np.testing.assert_array_equal, variables, variables_of(state._replace(ema=None)))


def test_a_folder_without_checkpoints_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has no checkpoint; give the folder of a training"):
        checkpoint_steps(tmp_path / "absent")


def test_an_empty_folder_has_no_checkpoint(tmp_path: Path, state: TrainState) -> None:
    with Checkpoints(tmp_path / "new", CONFIG) as checkpoints:
        assert checkpoints.restore(state) is None


def _truncate(folder: Path) -> None:
    for path in folder.rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _keep_little(folder: Path) -> None:
    """What a kill leaves under the name of a complete checkpoint."""
    shutil.rmtree(folder)
    (folder / "state").mkdir(parents=True)


def _empty_data(folder: Path) -> None:
    for path in (folder / "state").rglob("d/*"):
        path.write_bytes(b"")


def _lose_progress(folder: Path) -> None:
    shutil.rmtree(folder / "progress")


@pytest.mark.smoke
@pytest.mark.parametrize("damage", [_truncate, _keep_little, _empty_data, _lose_progress])
def test_a_damaged_checkpoint_is_replaced_by_the_previous_one(
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


def test_a_half_written_folder_is_removed(tmp_path: Path, state: TrainState) -> None:
    save(tmp_path, state, {2: None})
    shutil.copytree(tmp_path / "2", tmp_path / "4.orbax-checkpoint-tmp")
    with Checkpoints(tmp_path, CONFIG) as checkpoints:
        assert checkpoints.steps == [2]
        checkpoints.save(at(state, 4), LOADER)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["2", "4"]


def test_nothing_is_removed_if_all_are_damaged(tmp_path: Path, state: TrainState) -> None:
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


def edit_progress(folder: Path, edit: Callable[[dict], object]) -> None:
    """Change what a checkpoint holds beside the state."""
    path = folder / "progress" / "metadata"
    progress = json.loads(path.read_text())
    edit(progress)
    path.write_text(json.dumps(progress))


@pytest.mark.parametrize("earlier", [False, True], ids=["now", "by an earlier version"])
def test_another_optimizer_is_refused_and_nothing_is_removed(tmp_path: Path, state: TrainState, earlier: bool) -> None:
    save(tmp_path, state, {2: None})
    if earlier:
        edit_progress(tmp_path / "2", lambda progress: progress.pop("optimizer"))
    other = state._replace(optimizer=optax.sgd(0.1, momentum=0.9).init(state.params))
    with Checkpoints(tmp_path, CONFIG) as checkpoints:
        with pytest.raises(InputError, match=r"2 has the state of another optimizer; use the optimizer that"):
            checkpoints.restore(other)
        assert checkpoints.steps == [2]
        assert checkpoints.restore(state) is not None


def test_the_key_of_a_noisy_optimizer_is_kept(tmp_path: Path) -> None:
    optimizer = optax.chain(optax.add_noise(0.01, 0.55, jax.random.key(7)), optax.sgd(0.1))
    state = create_train_state(jax.random.key(0), CONFIG, variables=random_variables(CONFIG), optimizer=optimizer)
    state = distributed.replicate(state, distributed.data_mesh(1))
    with Checkpoints(tmp_path, CONFIG) as checkpoints:
        checkpoints.save(state._replace(step=state.step + 1), LOADER)
        restored = checkpoints.restore(state)
    assert restored is not None
    assert (jax.random.key_data(restored.state.optimizer[0].rng_key) == jax.random.key_data(jax.random.key(7))).all()


def test_a_run_of_an_earlier_format_is_refused_and_kept(tmp_path: Path, state: TrainState) -> None:
    save(tmp_path, state, {2: None, 4: None})
    for step in (2, 4):
        edit_progress(tmp_path / str(step), lambda progress: progress.pop("format"))
    before = sorted(path for path in tmp_path.rglob("*"))
    with (
        Checkpoints(tmp_path, CONFIG) as checkpoints,
        pytest.raises(InputError, match=r"/4 was written by another version .*last\.safetensors\.$"),
    ):
        checkpoints.restore(state)
    assert sorted(path for path in tmp_path.rglob("*")) == before


def test_fields_that_a_saved_config_lacks_take_their_defaults(tmp_path: Path, state: TrainState) -> None:
    save(tmp_path, state, {2: None})
    edit_progress(tmp_path / "2", lambda progress: progress["config"]["schedule"].pop("remat"))
    with Checkpoints(tmp_path, CONFIG) as checkpoints:
        assert checkpoints.restore(state) is not None
    with (
        Checkpoints(tmp_path, replace(CONFIG, schedule=replace(CONFIG.schedule, remat=True))) as checkpoints,
        pytest.raises(InputError, match=r"config\.schedule\.remat is False there and True here"),
    ):
        checkpoints.restore(state)


def test_a_field_of_a_later_version_is_named(tmp_path: Path, state: TrainState) -> None:
    save(tmp_path, state, {2: None})
    edit_progress(tmp_path / "2", lambda progress: progress["config"]["loss"].update(new_weight=1.0))
    with Checkpoints(tmp_path, CONFIG) as checkpoints, pytest.raises(InputError, match="new_weight"):
        checkpoints.restore(state)
    assert (tmp_path / "2").is_dir()


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
    """Limit the size of files in bytes, which fails like a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


# Orbax leaves coroutines and callbacks behind.
@pytest.mark.smoke
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore:coroutine:RuntimeWarning")
def test_a_failed_write_is_one_sentence_and_keeps_the_earlier_ones(
    tmp_path: Path, state: TrainState, caplog: pytest.LogCaptureFixture
) -> None:
    save(tmp_path, state, {2: None})
    # Pages of traces would exceed the limit if the output goes to a file.
    for name in ("absl", "asyncio"):
        caplog.set_level("CRITICAL", name)
    with limited_files(20_000), pytest.raises(InputError, match=r"cannot be written to .* \(File too large\)"):
        save(tmp_path, state, {4: None})
    with Checkpoints(tmp_path, CONFIG) as checkpoints:
        restored = checkpoints.restore(state)
    assert restored is not None
    assert_same_bits(restored.state, at(state, 2))
    gc.collect()


def test_a_disk_with_too_little_space_is_not_written_to(tmp_path: Path, state: TrainState) -> None:
    save(tmp_path, state, {2: None})
    # 4 PB that need no memory.
    huge = at(state, 4)._replace(ema=np.broadcast_to(np.float32(0), 10**15))
    with (
        Checkpoints(tmp_path, CONFIG) as checkpoints,
        pytest.raises(InputError, match=r"cannot be written to .* \(No space left on device\); free some space"),
    ):
        checkpoints.save(huge, LOADER)
    assert [path.name for path in tmp_path.iterdir()] == ["2"]


def test_a_folder_that_cannot_be_created_is_refused(tmp_path: Path) -> None:
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
