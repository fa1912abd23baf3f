"""The switches of the paper's Table 4: what is switched off leaves everything else as it was."""

from functools import cache, partial
from math import prod

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small import random_scene, random_variables, small_config
from study import with_neck, without_iou

from ciassd_jax import Config, car, create_train_state, train_step
from ciassd_jax.inference.cost import count_flops, count_parameters
from ciassd_jax.inference.postprocess import postprocess
from ciassd_jax.model.network import init_variables, predict_raw


@cache
def shapes_of(config: Config) -> dict:
    variables = jax.eval_shape(partial(init_variables, config=config), jax.random.key(0))
    return jax.tree.map(lambda leaf: leaf.shape, variables["params"], is_leaf=lambda leaf: hasattr(leaf, "shape"))


@pytest.mark.parametrize(
    ("kind", "kernels"),
    [
        ("second", [(3, 3, 128, 128)] * 7),
        ("sassd", [(3, 3, 128, 256)] + [(3, 3, 256, 256)] * 6 + [(1, 1, 256, 256)]),
    ],
)
def test_a_neck_is_its_layers_and_nothing_else_changes(kind: str, kernels: list[tuple[int, ...]]) -> None:
    """Kernels of the necks that Table 4 compares with."""
    before, after = car(), with_neck(car(), kind)
    shapes, whole = shapes_of(after), shapes_of(before)
    assert shapes["backbone"] == whole["backbone"]
    assert [shapes["neck"][f"conv_{i}"]["kernel"] for i in range(len(kernels))] == kernels
    assert len(shapes["neck"]) == len(kernels)
    assert set(shapes["head"]) == set(whole["head"])
    weights = sum(map(prod, kernels))
    assert count_parameters(after)["neck"] == weights + 2 * sum(shape[-1] for shape in kernels)
    assert count_flops(after)["neck"] == 2 * weights * 200 * 176
    assert count_flops(after)["backbone"] == count_flops(before)["backbone"]


def test_without_the_iou_branch_only_that_is_gone() -> None:
    shapes, whole = shapes_of(without_iou(car())), shapes_of(car())
    head = {name: shape for name, shape in whole["head"].items() if name != "iou"}
    assert head != whole["head"]
    assert shapes == {**whole, "head": head}


def test_without_the_iou_branch_the_confidence_is_the_class_probability() -> None:
    config = small_config()
    variables = random_variables(config)
    bare = {**variables, "params": {**variables["params"], "head": dict(variables["params"]["head"])}}
    del bare["params"]["head"]["iou"]
    cloud = jax.tree.map(lambda leaf: leaf[None], random_scene(config, 0).cloud)
    config = without_iou(config)

    @jax.jit
    def both(variables, cloud):
        raw = predict_raw(variables, cloud, config)
        return raw.predictions, postprocess(raw, config)

    predictions, found = both(bare, cloud)
    assert predictions.iou is None
    number = int(found.count[0])
    assert number
    probability = np.asarray(jax.nn.sigmoid(predictions.class_logit[0]))
    distance = np.abs(probability[None] - np.asarray(found.score[0, :number, None])).min(1)
    np.testing.assert_allclose(distance, 0, atol=1e-6)


@pytest.mark.slow
def test_the_baseline_of_table_4_trains() -> None:
    config = without_iou(with_neck(small_config(), "second"))
    batch = jax.tree.map(lambda leaf: np.asarray(leaf)[None], random_scene(config, 0))
    state = create_train_state(jax.random.key(0), config, variables=random_variables(config))
    new, metrics = jax.jit(train_step, static_argnames="config")(state, batch, config)
    chex.assert_tree_all_finite(metrics)
    assert metrics["skipped"] == 0
    assert metrics["iou"] == 0
    moved = jax.tree.map(lambda a, b: bool(jnp.any(a != b)), new.params, state.params)
    assert all(jax.tree.leaves(moved))
