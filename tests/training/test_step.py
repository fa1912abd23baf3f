"""The training step: schedule and optimiser by hand, skipped updates, and the same update on any number of devices."""

import json
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small import random_scene, random_variables, small_cloud, small_config

from ciassd_jax import Config, car, create_train_state, make_batches, train_step
from ciassd_jax.config import ScheduleConfig
from ciassd_jax.data.frames import Dataset, Frame
from ciassd_jax.data.loader import finish_scenes
from ciassd_jax.model.checks import variables_of
from ciassd_jax.training.optimizer import learning_rate, make_optimizer, momentum
from ciassd_jax.types import Boxes, Scene

step = jax.jit(train_step, static_argnames=("config", "axis_name"))


def short(**schedule: Any) -> Config:
    """A config for twenty steps; most tests share the program of its defaults."""
    config = small_config()
    return replace(config, schedule=replace(config.schedule, **{"total_steps": 20, "ema_decay": 0.5} | schedule))


@cache
def batch(scenes: int = 2) -> Scene:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *(random_scene(small_config(), i) for i in range(scenes)))


def fresh(config: Config) -> Any:
    return create_train_state(jax.random.key(0), config, variables=random_variables(small_config()))


def test_one_cycle_as_released():
    """Learning rate and b1 of the released code at some steps."""
    schedule = car().schedule
    for at, rate, decay in (
        (0, 3e-4, 0.95),
        (928, 3.1154944e-4, 0.94957224),
        (11136, 1.65e-3, 0.90),
        (22272, 3e-3, 0.85),
        (38976, 1.500015e-3, 0.90),
        (55679, 3.0006632e-8, 0.95),
    ):
        np.testing.assert_allclose(learning_rate(at, schedule), rate, rtol=2e-5, atol=1e-10)
        np.testing.assert_allclose(momentum(at, schedule), decay, rtol=2e-6)


def test_plain_cosine_falls_from_the_peak_to_zero():
    schedule = ScheduleConfig(kind="cosine", total_steps=100)
    rates = [float(learning_rate(at, schedule)) for at in range(101)]
    assert rates[0] == pytest.approx(3e-3)
    assert rates[50] == pytest.approx(1.5e-3)
    assert rates[100] == pytest.approx(0, abs=1e-9)
    assert all(np.diff(rates) < 0)
    assert float(momentum(70, schedule)) == pytest.approx(0.95)


@pytest.mark.parametrize("scale", [1e-3, 100.0])
def test_optimizer_is_clipped_adam_with_decay_first(scale):
    """By hand in float64: clip, p (1 - rate decay), and Adam with the current b1 in its bias correction."""
    schedule = ScheduleConfig(total_steps=10)
    rng = np.random.default_rng(0)
    params = {"kernel": rng.normal(size=(3, 4)), "bias": rng.normal(size=4)}
    with jax.enable_x64(True):
        optimizer = make_optimizer(schedule)
        mine = jax.tree.map(jnp.asarray, params)
        state = optimizer.init(mine)
        first = second = jax.tree.map(np.zeros_like, params)
        for at in range(6):
            gradient = {name: scale * rng.normal(size=leaf.shape) for name, leaf in params.items()}
            changes, state = optimizer.update(gradient, state, mine)
            mine = jax.tree.map(jnp.add, mine, changes)

            norm = np.sqrt(sum((leaf**2).sum() for leaf in gradient.values()))
            rate, decay = float(learning_rate(at, schedule)), float(momentum(at, schedule))
            for name, leaf in gradient.items():
                leaf = leaf * min(1, 35 / norm)
                first = first | {name: decay * first[name] + (1 - decay) * leaf}
                second = second | {name: 0.99 * second[name] + 0.01 * leaf**2}
                mean = first[name] / (1 - decay ** (at + 1))
                spread = np.sqrt(second[name] / (1 - 0.99 ** (at + 1)))
                params[name] = params[name] * (1 - rate * 0.01) - rate * mean / (spread + 1e-8)
        chex.assert_trees_all_close(mine, params, rtol=1e-6)


@pytest.mark.smoke
def test_twenty_steps_learn_and_repeat_bit_for_bit():
    config = short()

    def run() -> tuple[Any, list[float]]:
        state, losses = fresh(config), []
        for _ in range(20):
            state, metrics = step(state, batch(), config)
            losses.append(float(metrics["loss"]))
        return state, losses

    (state, losses), (again, repeated) = run(), run()
    assert losses == repeated
    chex.assert_trees_all_equal(state, again)
    assert losses[-1] < 0.7 * losses[0]
    assert int(state.step) == 20
    assert int(state.skipped) == 0


def test_metrics_are_scalars_with_the_overflow_counts():
    config = short()
    crowded = batch()._replace(points_cut=np.array([3, 4], np.int32), boxes_cut=np.array([1, 0], np.int32))
    _, metrics = step(fresh(config), crowded, config)
    assert {name: value.shape for name, value in metrics.items()} == dict.fromkeys(metrics, ())
    assert {"loss", "classification", "box", "direction", "iou", "positives", "gradient_norm"} <= set(metrics)
    assert (int(metrics["points_cut"]), int(metrics["boxes_cut"]), int(metrics["objects_cut"])) == (7, 1, 0)
    assert int(metrics["voxels_dropped"]) == int(metrics["sites_dropped"]) == 0
    terms = [float(metrics[name]) for name in ("classification", "box", "direction", "iou")]
    assert float(metrics["loss"]) == pytest.approx(np.dot(terms, (1, 2, 0.2, 1)), rel=1e-6)


@pytest.mark.filterwarnings("ignore:overflow encountered")
def test_a_non_finite_update_is_skipped_and_counted():
    config = short()
    state, _ = step(fresh(config), batch(), config)
    params = jax.tree.map(jnp.asarray, state.params)
    params["head"]["box"]["kernel"] = params["head"]["box"]["kernel"].at[0, 0, 0, 0].set(jnp.nan)
    broken = state._replace(params=params)
    after, metrics = step(broken, batch(), config)
    assert not np.isfinite(metrics["loss"])
    assert (int(after.step), int(after.skipped), int(metrics["skipped"])) == (2, 1, 1)
    for name in ("params", "batch_stats", "optimizer", "ema"):
        chex.assert_trees_all_equal(getattr(after, name), getattr(broken, name))
    repaired, _ = step(after._replace(params=state.params), batch(), config)
    assert jax.tree.all(jax.tree.map(lambda leaf: bool(jnp.isfinite(leaf).all()), repaired.params))


@pytest.mark.parametrize("empty", ["no boxes", "no points", "nothing"])
def test_empty_scenes_stay_finite(empty):
    config = short()
    scenes = batch()
    if empty != "no points":
        truth = scenes.truth._replace(count=np.zeros(2, np.int32), label=np.full_like(scenes.truth.label, -1))
        scenes = scenes._replace(truth=truth)
    if empty != "no boxes":
        scenes = scenes._replace(cloud=scenes.cloud._replace(count=np.zeros(2, np.int32)))
    state, metrics = step(fresh(config), scenes, config)
    assert int(state.skipped) == 0
    assert all(np.isfinite(value) for value in metrics.values())
    assert jax.tree.all(jax.tree.map(lambda leaf: bool(jnp.isfinite(leaf).all()), state.params))


def test_an_epoch_of_all_sizes_is_traced_once():
    """Frames without points, without boxes, and with more points than fit share one program per part."""
    config, clouds = short(), {"many": 5000, "none": 0, "one": 1, "some": 300, "few": 40, "usual": 600}

    def read(name: str) -> Frame:
        objects = 0 if name in ("none", "few") else 2
        boxes = Boxes.from_array(np.tile([8.0, 1, -1, 3.9, 1.6, 1.5, 0.3], (objects, 1)))
        points = small_cloud(count=clouds[name])
        return Frame(name, points, boxes, ("Car",) * objects, np.zeros(objects, np.int64), None)

    state, sizes = fresh(config), []
    with make_batches(Dataset(tuple(clouds), read), config, seed=0, batch_size=2) as batches:
        for _ in range(3):
            state, metrics = step(state, next(batches), config)
            sizes.append((step._cache_size(), finish_scenes._cache_size()))
    assert len(set(sizes)) == 1
    assert all(np.isfinite(value) for value in metrics.values())
    assert int(state.skipped) == 0


def test_prediction_uses_the_moving_average_of_the_parameters():
    config = short()
    start = fresh(config)
    state, _ = step(start, batch(), config)
    expected = jax.tree.map(lambda old, new: (old + new) / 2, start.params, state.params)
    chex.assert_trees_all_close(state.ema, expected, rtol=1e-6, atol=1e-9)
    chex.assert_trees_all_equal(variables_of(state)["params"], state.ema)
    plain = fresh(short(ema_decay=0.0))
    assert plain.ema is None
    chex.assert_trees_all_equal(variables_of(plain)["params"], plain.params)


def test_accumulated_gradients_make_the_update_of_their_mean():
    rng = np.random.default_rng(0)
    params, *gradients = ({"kernel": rng.normal(size=(3, 4)).astype(np.float32)} for _ in range(3))
    twice, once = (make_optimizer(ScheduleConfig(total_steps=10, gradient_accumulation_steps=n)) for n in (2, 1))
    state = twice.init(params)
    first, state = jax.jit(twice.update)(gradients[0], state, params)
    assert not first["kernel"].any()
    second, _ = jax.jit(twice.update)(gradients[1], state, params)
    mean = jax.tree.map(lambda a, b: (a + b) / 2, *gradients)
    expected, _ = jax.jit(once.update)(mean, once.init(params), params)
    chex.assert_trees_all_close(second, expected, rtol=1e-5)


@pytest.mark.slow
def test_accumulated_steps_make_one_update():
    config = short(gradient_accumulation_steps=2)
    start = fresh(config)
    once, _ = step(start, batch(), config)
    chex.assert_trees_all_equal(once.params, start.params)
    twice, metrics = step(once, batch(), config)
    assert float(metrics["learning_rate"]) == pytest.approx(3e-4)
    whole, _ = step(fresh(short()), batch(), short())
    # Both gradients are equal: batch statistics differ between the steps, but training mode does not read them.
    chex.assert_trees_all_close(twice.params, whole.params, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_rematerialised_gradients_are_the_same():
    config = short()
    plain, _ = step(fresh(config), batch(), config)
    again = short(remat=True)
    other, _ = step(fresh(again), batch(), again)
    chex.assert_trees_all_close(plain.params, other.params, rtol=0, atol=1e-5)


@pytest.mark.slow
def test_several_devices_make_the_same_update():
    """Gradients to 1e-6 relative and parameters to 1e-5, in float64; pooled statistics and metrics too.

    `devices.py` measures all cases in one process with eight forced devices.
    """
    command = [sys.executable, str(Path(__file__).parents[1] / "devices.py")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found.pop("restored") == {"1 to 4": True, "4 to 1": True}
    assert set(found) == {f"{case} {scenes}" for case in ("pmap 2", "sharded 4") for scenes in ("unequal", "one empty")}
    for case, difference in found.items():
        assert difference["gradient"] <= 1e-6, case
        assert difference["params"] <= 1e-5, case
        assert difference["batch_stats"] <= 1e-9, case
        assert difference["metrics"] <= 1e-6, case
