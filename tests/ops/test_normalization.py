"""The closed gradient of batch normalisation beside differentiation of its definition."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ciassd_jax.ops.normalization import batch_norm

EPSILON = 1e-3


def by_definition(x, real, scale, bias):
    """Gather the real entries, take NumPy's moments, normalise everything."""
    mean, variance = (
        (jnp.zeros(x.shape[-1]), jnp.zeros(x.shape[-1])) if not real.any() else (x[real].mean(0), x[real].var(0))
    )
    return (x - mean[None]) / jnp.sqrt(variance[None] + EPSILON) * scale[None] + bias[None]


@pytest.mark.parametrize("share", [None, 0.0, 0.1, 0.6])
def test_value_and_gradients_are_those_of_the_definition(share):
    """The function that is differentiated reads the other entries too; without real ones they still have gradients."""
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        x, scale, bias = (jnp.array(rng.normal(size=shape) + 1) for shape in ((40, 3), (3,), (3,)))
        real = np.ones(40, bool) if share is None else rng.random(40) < share
        given = None if share is None else jnp.array(real)

        def run(function):
            return jax.value_and_grad(lambda *arrays: jnp.sin(function(*arrays)).sum(), argnums=(0, 1, 2))(
                x, scale, bias
            )

        jax.tree.map(
            partial(np.testing.assert_allclose, rtol=1e-10, atol=1e-12),
            run(lambda x, scale, bias: batch_norm(x, given, scale, bias, EPSILON)[0]),
            run(lambda x, scale, bias: by_definition(x, real, scale, bias)),
        )


@pytest.mark.smoke
def test_shards_pool_value_and_gradient():
    """Four shards with unequal numbers of real entries, one without any, are as one."""
    rng = np.random.default_rng(1)
    with jax.enable_x64(True):
        x, scale, bias = (jnp.array(rng.normal(size=shape)) for shape in ((4, 10, 3), (3,), (3,)))
        real = jnp.array(rng.random((4, 10)) < np.array([0.9, 0.5, 0.2, 0.0])[:, None])

        def loss(x, real, axis_name):
            return jnp.sin(batch_norm(x, real, scale, bias, EPSILON, axis_name)[0]).sum()

        whole = jax.grad(loss)(x.reshape(40, 3), real.reshape(40), None)
        shards = jax.vmap(jax.grad(partial(loss, axis_name="shards")), axis_name="shards")(x, real)
        np.testing.assert_allclose(shards.reshape(40, 3), whole, rtol=1e-10, atol=1e-12)
