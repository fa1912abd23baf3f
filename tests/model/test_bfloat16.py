"""In bfloat16 only the activations and kernels of backbone and neck are rounded; all else stays float32."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import ClosedJaxpr, Jaxpr
from small import random_scene, random_variables, small_config

from ciassd_jax import create_train_state, predict, tiny, train_step
from ciassd_jax.model.network import predict_raw

CONFIG = replace(tiny(), dtype="bfloat16")
HALF = jnp.dtype("bfloat16")


def scenes(config):
    return jax.tree.map(lambda *leaves: np.stack(leaves), *(random_scene(config, seed) for seed in (0, 1)))


def infer(state, batch):
    return predict(state, batch.cloud, CONFIG)


def train(state, batch):
    return train_step(state, batch, CONFIG)


def raw(state, batch):
    """Voxels and what the network says of every anchor."""
    return predict_raw(state, batch.cloud, CONFIG)


def arguments():
    return jax.eval_shape(partial(create_train_state, config=CONFIG), jax.random.key(0)), scenes(CONFIG)


def equations(jaxpr: Jaxpr, scope: str = "") -> Iterator[tuple[str, Any]]:
    """Every equation without a program of its own, and the names of the scopes that it is in."""
    for equation in jaxpr.eqns:
        name = f"{scope}/{equation.source_info.name_stack}"
        values = jax.tree.leaves(list(equation.params.values()))
        inner = [getattr(value, "jaxpr", value) for value in values if isinstance(value, ClosedJaxpr | Jaxpr)]
        for program in inner:
            yield from equations(program, name)
        if not inner:
            yield name, equation


def dtypes(variables) -> set:
    return {variable.aval.dtype for variable in variables}


@pytest.mark.smoke
@pytest.mark.parametrize("function", [infer, train])
def test_only_the_network_rounds(function):
    """Of both platforms' programs: voxels, head, targets, losses, boxes, overlap, NMS and update touch no bfloat16."""
    found = list(equations(jax.make_jaxpr(function)(*arguments()).jaxpr))
    scopes = {"voxelize", "postprocess"} if function is infer else {"voxelize", "targets", "losses"}
    assert all(any(scope in name for name, _ in found) for scope in {"CIASSD", *scopes})
    rounded = [(name, equation) for name, equation in found if HALF in dtypes([*equation.invars, *equation.outvars])]
    assert rounded
    assert all("CIASSD" in name for name, _ in rounded)
    # BatchNorm reads and writes bfloat16, and computes nothing in it.
    normalisation = {equation.primitive.name for name, equation in rounded if "/norm" in name}
    assert normalisation <= {"convert_element_type", "optimization_barrier"}
    # The head converts its input, and on the way back the gradient of it.
    head = [equation.primitive.name for name, equation in rounded if "/head" in name]
    assert head == ["convert_element_type"] * (1 if function is infer else 2)
    # No coordinate, index or count comes from a rounded number.
    casts = [equation for _, equation in rounded if equation.primitive.name == "convert_element_type"]
    results = set().union(*(dtypes(cast.outvars) for cast in casts if HALF in dtypes(cast.invars)))
    assert results <= {HALF, jnp.dtype("float32")}


@pytest.mark.smoke
@pytest.mark.parametrize("function", [raw, infer, train])
def test_what_goes_in_and_comes_out_is_float32(function):
    """Parameters, batch statistics, optimiser; voxels, predictions, detections and metrics."""
    state, batch = arguments()
    leaves = jax.tree.leaves((state, jax.eval_shape(function, state, batch)))
    assert {leaf.dtype for leaf in leaves} <= {jnp.dtype(name) for name in ("float32", "int32", "bool")}


@pytest.mark.slow
def test_a_step_is_near_that_in_float32():
    """Losses and gradient; Adam's first moment is a multiple of the latter."""
    config = small_config()
    # In float32 the program of test_step.py, compiled once for both.
    config = replace(config, schedule=replace(config.schedule, total_steps=20, ema_decay=0.5))
    state = create_train_state(jax.random.key(0), config, variables=random_variables(small_config()))

    def run(dtype):
        after, metrics = jax.jit(train_step)(state, scenes(config), replace(config, dtype=dtype))
        return jax.device_get((metrics, after))

    (exact, expected), (near, after) = run("float32"), run("bfloat16")
    chex.assert_trees_all_equal_shapes_and_dtypes((near, after), (exact, expected))
    assert near["positives"] == exact["positives"] > 0
    for name in ("classification", "box", "direction", "iou", "loss"):
        np.testing.assert_allclose(near[name], exact[name], rtol=5e-3, err_msg=name)
        assert near[name] != exact[name]
    np.testing.assert_allclose(near["gradient_norm"], exact["gradient_norm"], rtol=0.03)
    gradient, rounded = (state.optimizer[1].inner_state.mu for state in (expected, after))
    assert np.vdot(gradient, rounded) > 0.95 * np.linalg.norm(gradient) * np.linalg.norm(rounded)
