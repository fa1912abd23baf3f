"""Training steps composed by a user: an own optimizer, frozen parts, an own loss term."""

from dataclasses import replace
from functools import cache, partial
from typing import Any

import chex
import flax.core
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from small import random_scene, random_variables, small_config

from ciassd_jax import Config, apply_gradients, compute_loss, create_train_state, predict_features, train_step
from ciassd_jax.model.anchors import make_anchors
from ciassd_jax.model.frozen import check_frozen
from ciassd_jax.model.head import MultiTaskHead
from ciassd_jax.model.network import predict_raw
from ciassd_jax.training.losses import detection_loss
from ciassd_jax.types import LossOutput, LossTerms, Scene, TrainState

loss_and_gradient = jax.jit(jax.value_and_grad(compute_loss, has_aux=True))


def with_frozen(*parts: str, **schedule: Any) -> Config:
    config = small_config()
    return replace(config, schedule=replace(config.schedule, total_steps=20, frozen=parts, **schedule))


@cache
def batch() -> Scene:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *(random_scene(small_config(), i) for i in range(2)))


def fresh(config: Config, optimizer: optax.GradientTransformation | None = None) -> TrainState:
    return create_train_state(
        jax.random.key(0), config, variables=random_variables(small_config()), optimizer=optimizer
    )


@pytest.fixture(scope="module")
def composed() -> Any:
    """State, output and gradient of the default config, by public functions."""
    config = with_frozen()
    state = fresh(config)
    (loss, output), gradient = loss_and_gradient(state.params, state.batch_stats, batch(), config)
    return config, state, loss, output, gradient


def test_the_parts_make_the_step(composed):
    config, state, loss, output, gradient = composed
    whole, metrics = jax.jit(train_step)(state, batch(), config)
    mine = jax.jit(apply_gradients)(state, gradient, output, config)
    chex.assert_trees_all_close(mine, whole, rtol=0, atol=1e-6)
    assert float(metrics["loss"]) == pytest.approx(float(loss), rel=1e-6)
    assert float(loss) == float(output.terms.total)
    counts = {name: int(value) for name, value in output.counts.items()}
    assert counts == {name: int(metrics[name]) for name in counts}
    assert counts["points_given"] == int(batch().cloud.count.sum())
    assert counts["boxes_given"] == 4
    assert output.predictions.class_logit.shape == output.targets.label.shape
    features = jax.jit(predict_features)(state, batch().cloud, config)
    assert output.features.shape == features.shape


def little_state(optimizer: optax.GradientTransformation) -> tuple[TrainState, Any, LossOutput]:
    """A state of few parameters, a gradient, and an output with a loss."""
    rng = np.random.default_rng(0)
    params, gradient = (
        {part: {"kernel": jnp.asarray(rng.normal(size=(3, 4)), jnp.float32)} for part in ("neck", "head")}
        for _ in range(2)
    )
    zero = jnp.zeros((), jnp.int32)
    terms = LossTerms(*jnp.arange(5.0))
    return TrainState(zero, params, {}, optimizer.init(params), None, zero), gradient, LossOutput(terms, *5 * ({},))


def updated(optimizer: optax.GradientTransformation, config: Config) -> tuple[TrainState, TrainState, Any]:
    state, gradient, output = little_state(optimizer)
    step = jax.jit(partial(apply_gradients, config=config, optimizer=optimizer))
    return state, step(state, gradient, output), gradient


@pytest.mark.parametrize(
    "optimizer",
    [
        optax.sgd(0.1),
        optax.adamw(optax.constant_schedule(1e-3)),
        optax.MultiSteps(optax.sgd(0.1), 2),
        optax.multi_transform(
            {"a": optax.sgd(0.1), "b": optax.set_to_zero()}, lambda params: {n: "ab"[n == "head"] for n in params}
        ),
        optax.chain(optax.add_noise(0.01, 0.55, jax.random.key(0)), optax.sgd(0.1)),
        optax.chain(optax.sgd(0.1), optax.contrib.reduce_on_plateau(patience=1)),
    ],
    ids=["sgd", "adamw", "accumulated", "by part", "noisy", "plateau"],
)
def test_any_optax_transformation_updates_as_alone(no_type_checks, optimizer):
    state, after, gradient = updated(optimizer, with_frozen())
    alone = optax.with_extra_args_support(optimizer)
    changes, expected = alone.update(gradient, state.optimizer, state.params, value=jnp.float32(4))
    chex.assert_trees_all_close(after.params, optax.apply_updates(state.params, changes), rtol=1e-6)
    assert jax.tree.structure(after.optimizer) == jax.tree.structure(expected)


def test_a_frozen_part_stands_still_under_the_weight_decay_of_any_optimizer(no_type_checks):
    state, after, _ = updated(optax.adamw(0.1, weight_decay=0.5), with_frozen("head"))
    chex.assert_trees_all_equal(after.params["head"], state.params["head"])
    assert (after.params["neck"]["kernel"] != state.params["neck"]["kernel"]).all()


@pytest.mark.slow
def test_an_own_optimizer_in_the_step(composed):
    config, _, _, _, gradient = composed
    optimizer = optax.sgd(0.1)
    state = fresh(config, optimizer)
    after, metrics = jax.jit(partial(train_step, config=config, optimizer=optimizer))(state, batch())
    expected = jax.tree.map(lambda leaf, slope: leaf - 0.1 * slope, state.params, gradient)
    chex.assert_trees_all_close(after.params, expected, rtol=1e-5, atol=1e-5)
    assert not {"learning_rate", "momentum"} & set(metrics)


def test_frozen_parts_keep_every_bit_and_the_others_learn():
    config = with_frozen("backbone", "neck/spatial_0", ema_decay=0.9)
    step, state = jax.jit(train_step), fresh(config)
    start, losses = state, []
    for _ in range(6):
        state, metrics = step(state, batch(), config)
        losses.append(float(metrics["loss"]))
    for name in ("params", "batch_stats", "ema"):
        before, after = getattr(start, name), getattr(state, name)
        chex.assert_trees_all_equal(after["backbone"], before["backbone"])
        chex.assert_trees_all_equal(after["neck"]["spatial_0"], before["neck"]["spatial_0"])
        changed = jax.tree.map(
            lambda one, other: bool((one != other).any()), after["neck"]["spatial_1"], before["neck"]["spatial_1"]
        )
        assert jax.tree.all(changed), name
    assert losses[-1] < losses[0]


@pytest.mark.slow
def test_frozen_batch_norm_uses_its_running_statistics():
    """With the whole trunk frozen, the loss of training is that of the network in evaluation mode."""
    config = with_frozen("backbone", "neck")
    state = fresh(config)
    stats = jax.tree.map(lambda leaf: leaf + 0.3, state.batch_stats)
    (loss, output), gradient = loss_and_gradient(state.params, stats, batch(), config)
    variables = {"params": state.params, "batch_stats": stats}
    raw = jax.jit(predict_raw, static_argnames="config")(variables, batch().cloud, config)
    anchors, _ = make_anchors(config)
    expected = jax.jit(partial(detection_loss, config=config.loss))(raw.predictions, output.targets, anchors)
    assert float(loss) == pytest.approx(float(expected.total), rel=1e-5)
    chex.assert_trees_all_equal(output.batch_stats, stats)
    assert not any(leaf.any() for leaf in jax.tree.leaves((gradient["backbone"], gradient["neck"])))
    assert all(branch["bias"].any() for branch in gradient["head"].values())


@pytest.mark.slow
def test_the_gradient_of_the_other_parts_is_that_of_the_whole():
    """Only the head is left: its gradient by way of running statistics, compared with finite differences."""
    config = with_frozen("backbone", "neck")
    state = fresh(config)
    (_, _), gradient = loss_and_gradient(state.params, state.batch_stats, batch(), config)
    bias, step = state.params["head"]["class"]["bias"], 1e-2

    def loss(change: float) -> float:
        params = {
            **state.params,
            "head": {**state.params["head"], "class": {**state.params["head"]["class"], "bias": bias + change}},
        }
        return float(jax.jit(compute_loss)(params, state.batch_stats, batch(), config)[0])

    slope = (loss(step) - loss(-step)) / (2 * step)
    assert float(gradient["head"]["class"]["bias"].sum()) == pytest.approx(slope, rel=1e-2)


@pytest.mark.slow
def test_an_own_term_changes_the_gradient_by_its_own(composed):
    config, state, _, _, plain = composed

    def loss(params: Any) -> tuple[jax.Array, Any]:
        value, output = compute_loss(params, state.batch_stats, batch(), config)
        return value + 0.1 * optax.tree.norm(params["head"], squared=True), output

    (_, _), gradient = jax.jit(jax.value_and_grad(loss, has_aux=True))(state.params)
    expected = jax.tree.map(lambda slope, leaf: slope + 0.2 * leaf, plain["head"], state.params["head"])
    chex.assert_trees_all_close(gradient["head"], expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("parts", "says"),
    [
        (("backbon",), r"no part 'backbon'; its parts are backbone, .*head, head/box.*neck/spatial_0"),
        (("backbone/",), "no part 'backbone/'"),
        (("",), "no part ''"),
        (("backbone", "neck", "head"), "whole network"),
    ],
)
def test_an_unknown_part_is_named_before_anything_is_compiled(parts, says):
    config = with_frozen(*parts)
    with pytest.raises(ValueError, match=says):
        check_frozen(config)
    with pytest.raises(ValueError, match=says):
        fresh(config)
    state = fresh(with_frozen())
    with pytest.raises(ValueError, match=says):
        jax.eval_shape(partial(train_step, config=config), state, batch())


def test_the_state_of_another_config_or_optimizer_is_named(no_type_checks):
    state, gradient, output = little_state(optax.sgd(0.1))
    with pytest.raises(ValueError, match=r"of another optimizer; give `create_train_state` the same `optimizer`"):
        apply_gradients(state, gradient, output, with_frozen())
    with pytest.raises(ValueError, match=r"no `ema`, but schedule.ema_decay is 0.5"):
        apply_gradients(state, gradient, output, with_frozen(ema_decay=0.5), optimizer=optax.sgd(0.1))


def test_a_state_that_is_donated_shares_no_memory():
    """The states of these optimizers begin with the parameters, and with a key that the optimizer keeps."""
    optimizer = optax.chain(optax.add_noise(0.01, 0.55, jax.random.key(0)), optax.contrib.dog())
    variables = jax.tree.map(jnp.asarray, random_variables(small_config()))
    config = with_frozen(ema_decay=0.9)
    for _ in range(2):
        state = create_train_state(jax.random.key(0), config, variables=variables, optimizer=optimizer)
        jax.jit(lambda state: jax.tree.map(jnp.copy, state), donate_argnums=0)(state)
    assert not any(leaf.is_deleted() for leaf in jax.tree.leaves(variables))


def test_the_tree_of_a_state_keeps_its_type():
    config, optimizer = with_frozen("backbone"), optax.sgd(0.1)
    state = fresh(config, optimizer)
    frozen = state._replace(params=flax.core.freeze(state.params), batch_stats=flax.core.freeze(state.batch_stats))
    after, _ = jax.eval_shape(partial(train_step, config=config, optimizer=optimizer), frozen, batch())
    assert jax.tree.structure(after) == jax.tree.structure(frozen)


def test_misfits_are_named_before_anything_is_compiled(no_type_checks):
    config, variables = with_frozen(), random_variables(small_config())
    with pytest.raises(ValueError, match=r"do not fit the config: params/backbone/.* is missing"):
        create_train_state(jax.random.key(0), config, variables=variables | {"params": {"head": {}}})
    state = fresh(config)
    with pytest.raises(ValueError, match=r"points have the shape .* without a batch axis"):
        jax.eval_shape(partial(train_step, config=config), state, random_scene(config, 0))
    with pytest.raises(ValueError, match=r"batch_stats/backbone/.* is missing"):
        jax.eval_shape(partial(compute_loss, config=config), state.params, {}, batch())


def test_states_are_made_of_whatever_holds_variables():
    config = with_frozen()
    state = fresh(config)
    again = create_train_state(jax.random.key(1), config, variables=state)
    chex.assert_trees_all_equal(again.params, state.params)


def test_frozen_parts_are_of_training_alone():
    config = with_frozen("backbone")
    assert config.for_inference() == with_frozen().for_inference()
    assert Config.from_json(config.to_json()) == config


@pytest.mark.slow
def test_features_are_what_the_head_reads():
    config, variables = small_config(), random_variables(small_config())
    features = jax.jit(predict_features)(variables, batch().cloud, config)
    assert features.shape == (2, *config.bev_shape, config.neck.channels)
    head = MultiTaskHead(config.head, config.anchors_per_cell, jnp.dtype("float32"))
    raw = jax.jit(predict_raw)(variables, batch().cloud, config)
    chex.assert_trees_all_close(
        head.apply({"params": jax.tree.map(jnp.asarray, variables["params"]["head"])}, features),
        raw.predictions,
        rtol=1e-5,
        atol=1e-5,
    )
