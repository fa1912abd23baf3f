"""The accelerators' form of the whole network, on the CPU, beside the CPU's own."""

from dataclasses import replace
from typing import Any

import chex
import jax
import numpy as np
import pytest
from small import random_scene, random_variables

from ciassd_jax import Config, create_train_state, predict, tiny, train_step
from ciassd_jax.types import Scene


def config_of(program: str) -> Config:
    """`tiny()` with so little room that a crowded scene loses voxels and sites."""
    config = tiny()
    first, second, third = config.backbone.stages
    stages = (first, replace(second, capacity=160), replace(third, capacity=80))
    return replace(
        config,
        grid=replace(config.grid, max_voxels=256),
        backbone=replace(config.backbone, stages=stages, out_capacity=60),
        classes=(replace(config.classes[0], support_threshold=1.0),),
        program=program,
    )


def scenes() -> Scene:
    """A sparse, an empty and a crowded one."""
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *(random_scene(tiny(), seed) for seed in range(3)))
    return batch._replace(cloud=batch.cloud._replace(count=np.array([100, 0, 600], np.int32)))


def of_each_form(function: Any, *arguments: Any) -> tuple[Any, Any, Any]:
    """Results of the accelerators' form, of the same again, and of the CPU's."""
    run = jax.jit(function)
    return jax.device_get([run(*arguments, config_of(program)) for program in ("accelerator", "accelerator", "cpu")])


def test_detections_are_the_same():
    mine, again, expected = of_each_form(predict, random_variables(tiny()), scenes().cloud)
    chex.assert_trees_all_equal(mine, again)
    dropped = expected.counts.voxels_dropped, expected.counts.sites_dropped.sum(1)
    assert [(number > 0).tolist() for number in (expected.count, *dropped)] == [
        [True, False, True],
        [False, False, True],
        [True, False, True],
    ]
    chex.assert_trees_all_equal(
        (mine.count, mine.label, mine.counts), (expected.count, expected.label, expected.counts)
    )
    chex.assert_trees_all_close(mine.boxes, expected.boxes, rtol=0, atol=1e-4)
    chex.assert_trees_all_close(mine.score, expected.score, rtol=0, atol=1e-5)


@pytest.mark.slow
def test_a_step_is_the_same():
    """Adam's first moment is a multiple of the gradient."""
    state = create_train_state(jax.random.key(0), tiny(), variables=random_variables(tiny()))
    first, again, other = of_each_form(train_step, state, scenes())
    chex.assert_trees_all_equal(first, again)
    (mine, metrics), (expected, expected_metrics) = first, other
    close = {"rtol": 1e-5, "atol": 1e-6}
    chex.assert_trees_all_close(metrics, expected_metrics, **close)
    chex.assert_trees_all_close((mine.params, mine.batch_stats), (expected.params, expected.batch_stats), **close)
    gradient, reference = (state.optimizer[1].inner_state.mu for state in (mine, expected))
    np.testing.assert_allclose(gradient, reference, rtol=0, atol=1e-5 * abs(reference).max())
