"""BatchNorm over real entries against its formula, and convolutions against loops."""

from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh, PartitionSpec
from oracles import upsample_loop

from ciassd_jax.model.layers import (
    EPSILON,
    MOMENTUM,
    ConvNormRelu,
    MaskedBatchNorm,
    SparseConvNormRelu,
    UpsampleNormRelu,
)

CHANNELS = 5


def random_variables(seed: int) -> dict:
    rng = np.random.default_rng(seed)
    draw = partial(rng.uniform, 0.5, 2.0, CHANNELS)
    return {
        "params": {"scale": jnp.float32(draw()), "bias": jnp.float32(draw() - 1)},
        "batch_stats": {"mean": jnp.float32(draw() - 1), "var": jnp.float32(draw())},
    }


def random_rows(seed: int, *shape: int, real: float = 0.6) -> tuple[jax.Array, jax.Array]:
    """Rows far from zero with garbage where they are not real, and which are."""
    rng = np.random.default_rng(seed)
    mask = rng.random(shape) < real
    x = rng.normal(3.0, 2.0, (*shape, CHANNELS))
    return jnp.float32(np.where(mask[..., None], x, 1e4)), jnp.array(mask)


def normalize(x, variables, mean, variance):
    scale, bias = (np.asarray(variables["params"][name], np.float64) for name in ("scale", "bias"))
    return (np.asarray(x, np.float64) - mean) / np.sqrt(variance + EPSILON) * scale + bias


def test_constants_are_the_released_ones():
    assert (EPSILON, MOMENTUM) == (1e-3, 0.99)


@pytest.mark.parametrize("shape", [(40,), (3, 4, 7)])
@pytest.mark.parametrize("masked", [True, False])
def test_training_norm_is_the_formula(shape, masked):
    x, mask = random_rows(0, *shape, real=0.6 if masked else 1.0)
    variables = random_variables(1)
    y, updated = MaskedBatchNorm().apply(variables, x, mask if masked else None, train=True, mutable=["batch_stats"])
    real = np.asarray(x, np.float64)[np.asarray(mask)]
    mean, variance = real.mean(0), real.var(0)
    np.testing.assert_allclose(np.asarray(y)[np.asarray(mask)], normalize(real, variables, mean, variance), atol=1e-5)
    for name, new in (("mean", mean), ("var", variance)):
        expected = 0.99 * np.asarray(variables["batch_stats"][name], np.float64) + 0.01 * new
        np.testing.assert_allclose(updated["batch_stats"][name], expected, rtol=1e-5)


def test_evaluation_norm_uses_the_running_statistics():
    x, mask = random_rows(0, 30)
    variables = random_variables(1)
    y, updated = MaskedBatchNorm().apply(variables, x, mask, mutable=["batch_stats"])
    stats = (np.asarray(variables["batch_stats"][name], np.float64) for name in ("mean", "var"))
    np.testing.assert_allclose(y, normalize(x, variables, *stats), rtol=1e-5, atol=1e-5)
    jax.tree.map(np.testing.assert_array_equal, updated["batch_stats"], variables["batch_stats"])


def test_what_is_not_real_is_not_read():
    x, mask = random_rows(0, 30)
    variables = random_variables(1)

    def run(x):
        y, updated = MaskedBatchNorm().apply(variables, x, mask, train=True, mutable=["batch_stats"])
        return jnp.where(mask[:, None], y, 0), updated

    other = jnp.where(mask[:, None], x, jnp.nan)
    jax.tree.map(np.testing.assert_array_equal, run(x), run(other))
    gradient = jax.grad(lambda x: jnp.sin(run(x)[0]).sum())(x)
    assert not gradient[~mask].any()
    assert gradient[mask].any()


def test_an_empty_batch_is_finite_and_changes_nothing():
    x, _ = random_rows(0, 20)
    variables, mask = random_variables(1), jnp.zeros(20, bool)

    def total(params, x):
        y, updated = MaskedBatchNorm().apply(
            {**variables, "params": params}, x, mask, train=True, mutable=["batch_stats"]
        )
        return jnp.sin(y).sum(), updated

    (value, updated), gradients = jax.value_and_grad(total, argnums=(0, 1), has_aux=True)(variables["params"], x)
    assert np.isfinite(value)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
    jax.tree.map(np.testing.assert_array_equal, updated["batch_stats"], variables["batch_stats"])


@pytest.mark.smoke
@pytest.mark.parametrize("second_device", [0.1, 0.0])
def test_two_devices_pool_their_entries(second_device):
    """Of unequal counts, one perhaps empty: value, running statistics and gradients of one device."""
    assert jax.device_count() >= 2
    halves = [random_rows(0, 32, real=0.9), random_rows(1, 32, real=second_device)]
    x, mask = (jnp.concatenate(parts) for parts in zip(*halves, strict=True))
    assert (mask[32:].sum() > 0) == (second_device > 0)
    variables = random_variables(2)
    stats = variables["batch_stats"]

    def one_device(params, x, mask, axis_name=None):
        y, updated = MaskedBatchNorm(axis_name).apply(
            {"params": params, "batch_stats": stats}, x, mask, train=True, mutable=["batch_stats"]
        )
        return jnp.where(mask[:, None], y, 0), updated

    rows, whole = PartitionSpec("devices"), PartitionSpec()
    two_devices = jax.shard_map(
        partial(one_device, axis_name="devices"),
        mesh=Mesh(jax.devices()[:2], ("devices",)),
        in_specs=(whole, rows, rows),
        out_specs=(rows, whole),
    )

    def run(norm):
        def total(params, x):
            y, updated = norm(params, x, mask)
            return (y * jnp.cos(jnp.arange(y.size, dtype=jnp.float32).reshape(y.shape))).sum(), (y, updated)

        gradients, outputs = jax.jit(jax.grad(total, argnums=(0, 1), has_aux=True))(variables["params"], x)
        return outputs, gradients

    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-5), run(two_devices), run(one_device))


def test_sparse_layer_leaves_padding_at_zero():
    """The bias of BatchNorm would fill it."""
    x, mask = random_rows(0, 12)
    layer = SparseConvNormRelu(CHANNELS, (1, 1, 1), jnp.dtype("float32"))

    def convolution(features, kernel):
        return features @ kernel[0]

    variables = layer.init(jax.random.key(0), x, convolution, mask, train=False)
    variables["params"]["norm"]["bias"] = jnp.full(CHANNELS, 7.0)
    for train in (False, True):
        y, _ = layer.apply(variables, x, convolution, mask, train=train, mutable=["batch_stats"])
        assert not y[~mask].any()
        assert y[mask].any()


@pytest.mark.parametrize(
    ("kernel_size", "stride", "size", "expected"),
    [(3, 1, (7, 5), (7, 5)), (3, 2, (8, 6), (4, 3)), (3, 2, (7, 5), (4, 3)), (1, 1, (7, 5), (7, 5))],
)
def test_convolution_shapes_and_padding(kernel_size, stride, size, expected):
    """As torch with padding (k - 1) / 2: the first window is centred on the first cell, also at stride 2."""
    layer = ConvNormRelu(4, kernel_size, jnp.dtype("float32"), stride=stride, relu=False)
    x = jnp.float32(np.random.default_rng(0).normal(size=(2, *size, 3)))
    y, variables = layer.init_with_output(jax.random.key(0), x, train=False)
    assert y.shape == (2, *expected, 4)
    kernel = np.asarray(variables["params"]["kernel"], np.float64)
    pad = (kernel_size - 1) // 2
    padded = np.pad(np.asarray(x, np.float64), ((0, 0), (pad, pad), (pad, pad), (0, 0)))
    for i, j in np.ndindex(*expected):
        window = padded[:, stride * i : stride * i + kernel_size, stride * j : stride * j + kernel_size]
        product = np.einsum("bhwc,hwco->bo", window, kernel)
        np.testing.assert_allclose(y[:, i, j], product / np.sqrt(1 + EPSILON), rtol=0, atol=1e-5)


def test_relu_is_where_it_is_asked_for():
    x = jnp.float32(np.random.default_rng(0).normal(size=(1, 6, 6, 3)))
    layer = partial(ConvNormRelu, 4, 3, jnp.dtype("float32"))
    linear, variables = layer(relu=False).init_with_output(jax.random.key(0), x, train=False)
    assert linear.min() < 0
    np.testing.assert_array_equal(layer().apply(variables, x, train=False), nn.relu(linear))


def test_upsampling_layer_doubles_and_rectifies():
    x = jnp.float32(np.random.default_rng(0).normal(size=(2, 3, 4, 5)))
    layer = UpsampleNormRelu(6, jnp.dtype("float32"))
    y, variables = layer.init_with_output(jax.random.key(0), x, train=False)
    expected = upsample_loop(np.asarray(x), np.asarray(variables["params"]["kernel"])) / np.sqrt(1 + EPSILON)
    np.testing.assert_allclose(y, np.maximum(expected, 0), rtol=0, atol=1e-5)
