"""What the pure functions say of arguments that they cannot use, while they are traced."""

import types
from functools import partial
from typing import Any, NamedTuple

import chex
import flax.core
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax.training.train_state import TrainState
from small import random_scene, random_variables, small_cloud, small_config

from ciassd_jax import Detector, PointCloud, create_train_state, predict, predict_features, tiny, train_step
from ciassd_jax.model.checks import check_cloud, variables_of
from ciassd_jax.model.network import fitting_variables, predict_raw, variable_shapes

CONFIG = small_config()
CLOUD = PointCloud(np.zeros((2, 64, 4), np.float32), np.array([9, 0], np.int32))


def shapes(config: Any = CONFIG) -> dict[str, Any]:
    return variable_shapes(config.for_inference())


BAD_CLOUDS = {
    "no batch axis": (PointCloud(CLOUD.points[0], CLOUD.count[0]), r"\(64, 4\) without a batch axis; add one"),
    "three columns": (CLOUD._replace(points=CLOUD.points[..., :3]), r"points have the shape \(2, 64, 3\); give \[B, P"),
    "one count": (CLOUD._replace(count=CLOUD.count[:1]), r"count has the shape \(1,\); give \(2,\), the number"),
    "count of points": (CLOUD._replace(count=np.zeros((2, 64), np.int32)), r"count has the shape \(2, 64\); give"),
    "integers": (
        CLOUD._replace(points=CLOUD.points.astype(np.int32)),
        "of type int32 and int32; convert them to float",
    ),
    "half precision": (CLOUD._replace(points=CLOUD.points.astype(np.float16)), "of type float16 and int32; convert"),
    "a tuple": (
        tuple(CLOUD),
        r"^The cloud is a tuple; give a `PointCloud` of two arrays, points \[B, P, 4\] and count",
    ),
    "points alone": (CLOUD.points, "^The cloud is a .*; give a `PointCloud` of two arrays"),
    "lists": (
        CLOUD._replace(points=CLOUD.points.tolist()),
        "^The cloud is a PointCloud of list; give a `PointCloud` of",
    ),
    "no scene": (
        PointCloud(CLOUD.points[:0], CLOUD.count[:0]),
        r"shape \(0, 64, 4\); give \[B, P, 4\] with B and P of",
    ),
    "no point": (CLOUD._replace(points=CLOUD.points[:, :0]), r"shape \(2, 0, 4\); give \[B, P, 4\] with B and P of"),
    "count of floats": (CLOUD._replace(count=np.zeros(2, np.float32)), "of type float32 and float32; convert"),
}


@pytest.mark.parametrize("name", BAD_CLOUDS)
@pytest.mark.usefixtures("no_type_checks")
def test_a_cloud_that_is_no_batch_is_refused_by_all_functions(name: str) -> None:
    cloud, message = BAD_CLOUDS[name]
    state = jax.eval_shape(partial(create_train_state, config=CONFIG), jax.random.key(0))
    scenes = jax.tree.map(lambda *leaves: np.stack(leaves), *(random_scene(CONFIG, seed) for seed in range(2)))
    for function in (predict, predict_raw, predict_features):
        with pytest.raises(ValueError, match=message):
            jax.eval_shape(partial(function, config=CONFIG), shapes(), cloud)
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(partial(train_step, config=CONFIG), state, scenes._replace(cloud=cloud))


def test_float64_is_refused_where_jax_would_compute_in_it() -> None:
    wide = CLOUD._replace(points=CLOUD.points.astype(np.float64), count=CLOUD.count.astype(np.int64))
    check_cloud(wide)
    with jax.enable_x64(True), pytest.raises(ValueError, match="of type float64 and int64; convert them to float32"):
        check_cloud(wide)


@pytest.mark.parametrize("shape", [(6, 4), (1, 6, 4), (2, 4, 6)])
@pytest.mark.usefixtures("no_type_checks")
def test_a_frustum_of_another_shape_is_refused(shape: tuple[int, ...]) -> None:
    traced = jax.jit(partial(predict, config=CONFIG)).lower
    with pytest.raises(ValueError, match=r"^frustum has the shape \(.*\); give \(2, 6, 4\), the six planes of each"):
        traced(shapes(), CLOUD, frustum=np.zeros(shape, np.float32))


def nested(variables: Any) -> dict[str, Any]:
    return {"params": {"params": variables["params"]}, "batch_stats": variables["batch_stats"]}


BAD_VARIABLES = {
    "no statistics": (lambda v: {"params": v["params"]}, 'no dictionary "batch_stats"; pass {"params": ..., "batch_st'),
    "parameters alone": (lambda v: v["params"], 'no dictionary "params"; pass'),
    "nested twice": (nested, "config: params/backbone/.* is missing, and .* more; pass .* the config that they were"),
    "another config": (lambda _: shapes(tiny()), r"config: .*, and \d+ more; pass"),
    "a number": (lambda _: 3, 'no dictionary "params"; pass'),
    "one shape": (
        lambda v: jax.tree.map(lambda leaf: np.zeros((*leaf.shape[:-1], leaf.shape[-1] + 1)), v),
        r"config: batch_stats/backbone/\S+ has the shape \(\d+,\) instead of \(\d+,\), and",
    ),
}


@pytest.mark.parametrize("name", BAD_VARIABLES)
@pytest.mark.usefixtures("no_type_checks")
def test_variables_that_do_not_fit_are_refused_in_one_sentence(name: str) -> None:
    change, message = BAD_VARIABLES[name]
    for function in (predict, predict_raw, predict_features):
        with pytest.raises(ValueError, match=f"^The variables (have|do not fit the) .*{message}") as raised:
            jax.eval_shape(lambda cloud, run=function: run(change(shapes()), cloud, CONFIG), CLOUD)
        assert "\n" not in str(raised.value)
    with pytest.raises(ValueError, match=message):
        Detector(change(random_variables(CONFIG)), CONFIG)


class State(TrainState):
    """A state of Flax as its documentation extends it for BatchNorm."""

    batch_stats: Any = None


class Own(NamedTuple):
    params: Any
    batch_stats: Any


def test_mappings_and_states_are_accepted_alike() -> None:
    variables = random_variables(CONFIG)
    optimizer, module = optax.sgd(0.1), nn.Dense(1)
    given = {
        "dictionary": variables | {"other": {}},
        "FrozenDict": flax.core.freeze(variables),
        "mapping": types.MappingProxyType({name: types.MappingProxyType(part) for name, part in variables.items()}),
        "state": create_train_state(jax.random.key(0), CONFIG, variables=variables),
        "Flax's state": State.create(apply_fn=module.apply, tx=optimizer, **variables),
        "named tuple": Own(**variables),
    }
    for name, one in given.items():
        found = fitting_variables(one, CONFIG)
        assert type(found["params"]["backbone"]) is dict, name
        chex.assert_trees_all_equal(found, variables)
    state = given["state"]._replace(ema=jax.tree.map(jnp.zeros_like, variables["params"]))
    chex.assert_trees_all_equal(variables_of(state)["params"], state.ema)


def test_checks_cost_nothing_when_the_program_runs() -> None:
    """They leave no operation in the program, and a second call does not trace it again."""
    jaxpr = jax.make_jaxpr(lambda cloud: check_cloud(cloud, np.zeros((2, 6, 4))) or cloud.count)(CLOUD)
    assert not jaxpr.eqns
    small = small_cloud(0, 64)[None].repeat(2, 0)
    run = jax.jit(chex.assert_max_traces(lambda cloud: check_cloud(cloud) or cloud.points.sum(), n=1))
    assert run(CLOUD) == 0
    assert run(CLOUD._replace(points=small)) != 0
