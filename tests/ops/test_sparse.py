"""Sparse convolution: gathered equals dense equals a loop equals the released code; and its properties."""

from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from oracles import sparse_convolution_loop

from ciassd_jax.ops import runs as run_ops
from ciassd_jax.ops import sites as site_ops
from ciassd_jax.ops import sparse, sparse_dense
from ciassd_jax.ops.sites import NO_SITE
from ciassd_jax.types import Sites


class Geometry(NamedTuple):
    kernel: tuple[int, int, int]
    stride: tuple[int, int, int]
    padding: tuple[int, int, int]

    def out_shape(self, shape):
        zipped = zip(shape, self.kernel, self.stride, self.padding, strict=True)
        return tuple((n + 2 * p - k) // s + 1 for n, k, s, p in zipped)


SUBMANIFOLD = Geometry((3, 3, 3), (1, 1, 1), (1, 1, 1))
DOWN = Geometry((3, 3, 3), (2, 2, 2), (1, 1, 1))
DOWN_NO_Z_PADDING = Geometry((3, 3, 3), (2, 2, 2), (0, 1, 1))
DOWN_Z = Geometry((3, 1, 1), (2, 1, 1), (0, 0, 0))
LAYERS = {"submanifold": SUBMANIFOLD, "down": DOWN, "down_no_z_padding": DOWN_NO_Z_PADDING, "down_z": DOWN_Z}

# The encoder in small: every type of layer that it has.
PLAN = (DOWN, SUBMANIFOLD, DOWN_NO_Z_PADDING, DOWN_Z)
CHANNELS = (3, 4, 5, 4, 3)


def random_coordinates(seed: int, shape, number: int) -> np.ndarray:
    """Distinct (z, y, x) by ascending key, borders included."""
    cells = np.random.default_rng(seed).choice(np.prod(shape), number, replace=False)
    return by_key(np.stack(np.unravel_index(cells, shape), -1))


def by_key(coordinates: np.ndarray) -> np.ndarray:
    """The same (z, y, x) with y slowest, then x, then z."""
    return coordinates[np.lexsort(coordinates[:, [0, 2, 1]].T)].astype(np.int32)


def sites_of(coordinates: np.ndarray, shape, capacity: int) -> Sites:
    keys = np.asarray(site_ops.linear_keys(jnp.array(coordinates), shape))
    padding = np.full(capacity - len(keys), NO_SITE, np.int32)
    return active_sites(jnp.concatenate([keys, padding]), shape=shape)


def coordinates_of(sites: Sites, shape) -> np.ndarray:
    return np.asarray(site_ops.coordinates_of(sites.keys, shape))[: int(sites.count)]


def random_features(seed: int, rows: int, channels: int = CHANNELS[0]) -> jax.Array:
    """One row for every slot, padding included: nothing may read that."""
    return jnp.array(np.random.default_rng(seed).normal(size=(rows, channels)), jnp.float32)


def random_kernels(seed: int, plan=PLAN) -> list[jax.Array]:
    """Kernels [K, C, O] that about keep the scale of the features."""
    rng = np.random.default_rng(seed)
    sizes = [(np.prod(g.kernel), c, o) for g, c, o in zip(plan, CHANNELS, CHANNELS[1:], strict=False)]
    return [jnp.array(rng.normal(size=size) / np.sqrt(size[0] * size[1]), jnp.float32) for size in sizes]


def gathered_layer(sites, features, kernel, shape, geometry, capacity, program="cpu"):
    """Sites after the layer, how many were dropped, and their features."""
    if geometry == SUBMANIFOLD:
        table = sparse.submanifold_table(sites, shape=shape, program=program)
        return sites, jnp.int32(0), sparse.convolve(features, table, kernel, program)
    where = {"shape": shape, "out_shape": geometry.out_shape(shape), **geometry._asdict()}
    out_sites, dropped = site_ops.strided_sites(sites, capacity=capacity, **where)
    table = sparse.strided_table(sites, out_sites, program=program, **where)
    return out_sites, dropped, sparse.convolve(features, table, kernel, program)


on_accelerator = partial(gathered_layer, program="accelerator")
FORMS = {"cpu": gathered_layer, "accelerator": on_accelerator}


def dense_layer(sites, features, kernel, shape, geometry, capacity):
    """The same by definition."""
    window, where = geometry._asdict(), {"shape": shape, "out_shape": geometry.out_shape(shape)}
    out_sites, dropped = sites, jnp.int32(0)
    if geometry != SUBMANIFOLD:
        out_sites, dropped = sparse_dense.strided_sites(sites, capacity=capacity, **where, **window)
    window["kernel_size"] = window.pop("kernel")
    return out_sites, dropped, sparse_dense.convolve(features, sites, out_sites, kernel, **where, **window)


def flat_layer(sites, features, kernel, shape, geometry, capacity):
    """The same for a batch [B, V], whose features [B * V, C] are the rows of all scenes."""
    if geometry == SUBMANIFOLD:
        tables = jax.vmap(partial(sparse.submanifold_table, shape=shape))(sites)
        return sites, jnp.zeros(1, jnp.int32), sparse.convolve(features, sparse.flatten_scenes(tables), kernel)
    where = {"shape": shape, "out_shape": geometry.out_shape(shape), **geometry._asdict()}
    out_sites, dropped = jax.vmap(partial(site_ops.strided_sites, capacity=capacity, **where))(sites)
    tables = jax.vmap(partial(sparse.strided_table, **where))(sites, out_sites)
    return out_sites, dropped, sparse.convolve(features, sparse.flatten_scenes(tables), kernel)


run_gathered = partial(jax.jit, static_argnames=("shape", "geometry", "capacity", "program"))(gathered_layer)
active_sites = partial(jax.jit, static_argnames="shape")(site_ops.active_sites)
submanifold_table = partial(jax.jit, static_argnames="shape")(sparse.submanifold_table)
run_dense = partial(jax.jit, static_argnames=("shape", "geometry", "capacity"))(dense_layer)
run_batch = partial(jax.jit, static_argnames=("shape", "geometry", "capacity"))(flat_layer)


def plan(layer, sites, features, kernels, *, shape, capacities):
    """Sites, dropped counts and features after every layer."""
    stages = []
    for geometry, kernel, capacity in zip(PLAN, kernels, capacities, strict=True):
        sites, dropped, features = layer(sites, features, kernel, shape, geometry, capacity)
        shape = geometry.out_shape(shape)
        stages.append((sites, dropped, features))
    return stages


run_plan = partial(jax.jit, static_argnames=("layer", "shape", "capacities"))(plan)


@partial(jax.jit, static_argnames=("layer", "shape", "capacities"))
def run_plan_with_gradients(layer, sites, features, kernels, *, shape, capacities):
    """And the gradients by features and kernels of a sum over all layers."""

    def total(features, kernels):
        stages = plan(layer, sites, features, kernels, shape=shape, capacities=capacities)
        return sum((f * jnp.cos(jnp.arange(f.size, dtype=f.dtype).reshape(f.shape))).sum() for *_, f in stages), stages

    gradients, stages = jax.grad(total, argnums=(0, 1), has_aux=True)(features, kernels)
    return stages, gradients


# Capacities that always suffice, and ones that overflow at every stage. A column of 42 takes two words of bits.
GRIDS = {
    "odd": ((13, 7, 9), (350, 350, 100, 60)),
    "even_and_tall": ((42, 8, 6), (500, 500, 100, 60)),
    "overflowed": ((13, 7, 9), (40, 40, 11, 2)),
}


@pytest.mark.parametrize("occupied", [0.0, 0.002, pytest.param(0.05, marks=pytest.mark.smoke), 0.4, 1.0])
@pytest.mark.parametrize(
    ("grid", "form"),
    [
        ("odd", "cpu"),
        pytest.param("odd", "accelerator", marks=pytest.mark.slow),
        ("even_and_tall", "cpu"),
        ("even_and_tall", "accelerator"),
        ("overflowed", "cpu"),
        ("overflowed", "accelerator"),
    ],
)
def test_gathered_equals_dense(grid, form, occupied):
    shape, capacities = GRIDS[grid]
    slots = np.prod(shape)
    sites = sites_of(random_coordinates(0, shape, round(occupied * slots)), shape, slots)
    arguments = sites, random_features(1, slots), random_kernels(2)
    gathered, gathered_gradients = run_plan_with_gradients(FORMS[form], *arguments, shape=shape, capacities=capacities)
    dense, dense_gradients = run_plan_with_gradients(dense_layer, *arguments, shape=shape, capacities=capacities)
    for (mine, dropped, features), (reference, expected_dropped, expected) in zip(gathered, dense, strict=True):
        np.testing.assert_array_equal(mine.keys, reference.keys)
        assert mine.count == reference.count == (np.asarray(mine.keys) != NO_SITE).sum()
        assert dropped == expected_dropped
        np.testing.assert_allclose(features, expected, rtol=0, atol=1e-5)
    overflows = [int(gathered[i][1]) > 0 for i in (0, 2, 3)]
    if grid != "overflowed":
        assert not any(overflows)
    elif occupied >= 0.05:
        assert all(overflows)
    assert (abs(gathered[0][2]).max() > 0.1) == (occupied > 0)
    for mine, reference in zip(jax.tree.leaves(gathered_gradients), jax.tree.leaves(dense_gradients), strict=True):
        scale = max(1, abs(reference).max())
        np.testing.assert_allclose(mine / scale, reference / scale, rtol=0, atol=1e-5)


@pytest.mark.parametrize("form", ["cpu", pytest.param("accelerator", marks=pytest.mark.slow)])
@pytest.mark.parametrize("capacities", [(80, 80, 20, 10), (30, 30, 6, 3)])
def test_gradients_in_float64(capacities, form):
    """Of all four kinds of layer, with and without overflow."""
    shape, slots = (13, 4, 5), 60
    with jax.enable_x64(True):
        sites = sites_of(random_coordinates(0, shape, 50), shape, slots)
        features, *kernels = (a.astype(jnp.float64) for a in (random_features(1, slots), *random_kernels(2)))

        @jax.jit
        def total(features, kernels):
            stages = plan(FORMS[form], sites, features, kernels, shape=shape, capacities=capacities)
            return [values for *_, values in stages]

        assert all(values.dtype == jnp.float64 for values in total(features, kernels))
        check_grads(total, (features, kernels), order=1, modes=["rev"])


@pytest.mark.parametrize("number", [0, 1, 60, 280])
@pytest.mark.parametrize(("name", "shape"), [*((name, (7, 5, 8)) for name in LAYERS), ("submanifold", (70, 2, 2))])
@pytest.mark.parametrize("program", FORMS)
def test_equals_the_loop(name, number, shape, program):
    geometry, capacity = LAYERS[name], 300
    coordinates = random_coordinates(number, shape, number)
    features, kernel = random_features(1, capacity), random_kernels(2, (geometry,))[0]
    sites = sites_of(coordinates, shape, capacity)
    out_sites, dropped, result = run_gathered(sites, features, kernel, shape, geometry, capacity, program)
    expected_coordinates, expected = sparse_convolution_loop(
        coordinates,
        np.asarray(features[:number]),
        np.asarray(kernel).reshape(*geometry.kernel, *kernel.shape[1:]),
        geometry.stride,
        geometry.padding,
        shape,
        geometry == SUBMANIFOLD,
    )
    found = coordinates_of(out_sites, geometry.out_shape(shape))
    order = np.lexsort(found.T[::-1])
    np.testing.assert_array_equal(found[order], expected_coordinates)
    np.testing.assert_allclose(result[: len(found)][order], expected, rtol=0, atol=1e-5)
    assert not result[len(found) :].any()
    assert dropped == 0


@pytest.mark.reference
@pytest.mark.parametrize("case", ["subm3", "down_s2_p1", "down_s2_p011", "zconv_s211"])
def test_equals_the_released_code(shared: Path, case):
    """Two scenes of shuffled sites, brought to our order and convolved as one batch."""
    with np.load(shared / "golden" / "sparse_tiny.npz") as file:
        reference = {key.removeprefix(f"{case}__"): file[key] for key in file if key.startswith(case)}
    shape, out_shape = (tuple(reference[key].tolist()) for key in ("in_shape", "out_shape"))
    weight, coordinates = reference["weight_dhwio"], reference["in_coords_bzyx"].astype(np.int32)
    geometry = Geometry(weight.shape[:3], *(tuple(reference[key].tolist()) for key in ("stride", "padding")))
    if reference["submanifold"]:
        geometry = geometry._replace(padding=(1, 1, 1))
    assert geometry.out_shape(shape) == out_shape
    capacity = 600
    order = np.lexsort(coordinates[:, [1, 3, 2, 0]].T)
    scenes = [order[coordinates[order, 0] == scene] for scene in (0, 1)]
    sites = jax.tree.map(
        lambda *leaves: jnp.stack(leaves), *(sites_of(coordinates[rows, 1:], shape, capacity) for rows in scenes)
    )
    features = np.stack([np.resize(reference["in_features"][rows], (capacity, weight.shape[3])) for rows in scenes])
    flat, kernel = jnp.array(features.reshape(2 * capacity, -1)), jnp.array(weight.reshape(-1, *weight.shape[3:]))
    out_sites, dropped, result = run_batch(sites, flat, kernel, shape, geometry, capacity)
    assert not dropped.any()
    found, values = [], []
    for scene in (0, 1):
        at = coordinates_of(jax.tree.map(lambda leaf, scene=scene: leaf[scene], out_sites), out_shape)
        found.append(np.insert(at, 0, scene, 1))
        values.append(result.reshape(2, capacity, -1)[scene, : len(at)])
    found, values = np.concatenate(found), np.concatenate(values)
    order = np.lexsort(found.T[::-1])
    np.testing.assert_array_equal(found[order], reference["out_coords_bzyx_sorted"])
    np.testing.assert_allclose(values[order], reference["out_features_sorted"], rtol=0, atol=1e-5)


@jax.jit
def convolve_with_gradients(features, table, kernel, cotangent):
    result, pull_back = jax.vjp(lambda f, k: sparse.convolve(f, table, k), features, kernel)
    return result, pull_back(cotangent.astype(result.dtype))


@pytest.mark.parametrize("number", [0, 3, 1000, 2400, 4500])
@pytest.mark.parametrize("geometry", [SUBMANIFOLD, DOWN])
def test_more_rows_than_one_block(geometry, number):
    """Blocks of rows, some of them empty, in value and in both gradients."""
    shape, capacity = (12, 20, 24), 4600
    sites, features = sites_of(random_coordinates(0, shape, number), shape, capacity), random_features(1, capacity)
    arguments = sites, features, random_kernels(2, (geometry,))[0]
    results = [run_layer_with_gradients(layer, *arguments, shape, geometry) for layer in (dense_layer, *FORMS.values())]
    reference, *forms = results
    for mine in forms:
        np.testing.assert_array_equal(mine[0], reference[0])
        for values, expected in zip(mine[1:], reference[1:], strict=True):
            scale = max(1, abs(expected).max())
            np.testing.assert_allclose(values / scale, expected / scale, rtol=0, atol=1e-5)


@partial(jax.jit, static_argnums=(0, 4, 5))
def run_layer_with_gradients(layer, sites, features, kernel, shape, geometry):
    """Keys and features after a layer, and the gradients of a sum of them by features and kernel."""

    def total(features, kernel):
        out_sites, _, values = layer(sites, features, kernel, shape, geometry, len(sites.keys))
        return (values * jnp.cos(jnp.arange(values.size).reshape(values.shape))).sum(), (out_sites.keys, values)

    gradients, (keys, values) = jax.grad(total, argnums=(0, 1), has_aux=True)(features, kernel)
    return keys, values, *gradients


def test_a_batch_is_its_scenes():
    """One flat table over scenes of 0, 40 and 200 sites gives what each scene gives alone; so does vmap."""
    shape, capacity, geometry = (6, 7, 8), 250, DOWN
    scenes = [sites_of(random_coordinates(n, shape, n), shape, capacity) for n in (0, 40, 200)]
    sites = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)
    features, kernel = random_features(1, 3 * capacity), random_kernels(2, (geometry,))[0]

    @partial(jax.jit, static_argnames="layer")
    def run(layer, sites, features):
        """Result and the gradient of a sum by the features."""

        def total(features):
            result = layer(sites, features, kernel, shape, geometry, capacity)[2]
            return jnp.sin(result).sum(), result

        gradient, result = jax.grad(total, has_aux=True)(features)
        return result, gradient

    by_scene = features.reshape(3, capacity, -1)
    flat = [a.reshape(3, capacity, -1) for a in run(flat_layer, sites, features)]
    vmapped = jax.vmap(partial(run, gathered_layer))(sites, by_scene)
    for i, scene in enumerate(scenes):
        alone = run(gathered_layer, scene, by_scene[i])
        assert bool(alone[0].any()) == (i > 0)
        for mine, in_batch, expected in zip(flat, vmapped, alone, strict=True):
            np.testing.assert_allclose(mine[i], expected, rtol=0, atol=1e-5)
            np.testing.assert_allclose(in_batch[i], expected, rtol=0, atol=1e-5)


def test_results_repeat_bit_for_bit():
    shape, capacities = GRIDS["odd"]
    sites, features = sites_of(random_coordinates(0, shape, 300), shape, 819), random_features(1, 819)
    arguments = gathered_layer, sites, features, random_kernels(2)
    first, again = (run_plan_with_gradients(*arguments, shape=shape, capacities=capacities) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, first, again)


def test_jit_changes_nothing():
    shape, capacity = (7, 5, 8), 300
    sites, features = sites_of(random_coordinates(0, shape, 90), shape, capacity), random_features(1, capacity)
    kernel = random_kernels(2, (SUBMANIFOLD,))[0]
    table = submanifold_table(sites, shape=shape)
    jitted = run_gathered(sites, features, kernel, shape, SUBMANIFOLD, capacity)[2]
    np.testing.assert_allclose(sparse.convolve(features, table, kernel), jitted, rtol=0, atol=1e-6)


def test_padding_is_inert():
    """What stands in padding slots, and how many there are, changes neither values nor gradients."""
    shape, number = (7, 5, 8), 90
    coordinates, kernel = random_coordinates(0, shape, number), random_kernels(1, (DOWN,))[0]
    rows, results = random_features(2, number), []

    @jax.jit
    def run(sites, features):
        def total(features, kernel):
            result = gathered_layer(sites, features, kernel, shape, DOWN, 200)[2]
            return jnp.sin(result).sum(), result

        gradients, result = jax.grad(total, argnums=(0, 1), has_aux=True)(features, kernel)
        return result, *gradients

    for capacity, filling in ((number, 0), (1500, np.nan)):
        features = jnp.pad(rows, ((0, capacity - number), (0, 0)), constant_values=filling)
        result, to_features, to_kernel = run(sites_of(coordinates, shape, capacity), features)
        assert not to_features[number:].any()
        results.append((result, to_features[:number], to_kernel))
    assert abs(results[0][0]).max() > 0.1
    jax.tree.map(partial(np.testing.assert_allclose, rtol=0, atol=1e-5), *results)


def test_shifted_sites_give_shifted_results():
    """By 4 voxels along y and x, one cell after two strides; the features stay."""
    shape, slots, capacities = (13, 24, 28), 200, (600, 600, 400, 200)
    coordinates = random_coordinates(0, (13, 10, 12), 150) + np.array([0, 4, 4], np.int32)
    features, kernels = random_features(1, slots), random_kernels(2)
    results = []
    for shift in (np.array([0, 0, 0], np.int32), np.array([0, 4, 0], np.int32), np.array([0, 4, 8], np.int32)):
        sites = sites_of(coordinates + shift, shape, slots)
        stages = run_plan(gathered_layer, sites, features, kernels, shape=shape, capacities=capacities)
        assert not any(int(dropped) for _, dropped, _ in stages)
        out_shape = shape
        for geometry in PLAN:
            out_shape = geometry.out_shape(out_shape)
        results.append((coordinates_of(stages[-1][0], out_shape) - shift // 4, stages[-1][2]))
    assert len(results[0][0]) > 10
    for found, values in results[1:]:
        np.testing.assert_array_equal(found, results[0][0])
        np.testing.assert_allclose(values, results[0][1], rtol=0, atol=1e-6)


def test_bfloat16_rounds_once():
    """Products add up in float32: the result is off by half a unit in the last of bfloat16's 8 bits."""
    shape, capacity = (7, 5, 8), 150
    sites = sites_of(random_coordinates(0, shape, 140), shape, capacity)
    table = submanifold_table(sites, shape=shape)
    rounded = [random_features(1, capacity), random_kernels(2, (SUBMANIFOLD,))[0], random_features(3, capacity, 4)]
    rounded = [a.astype(jnp.bfloat16) for a in rounded]

    def run(dtype):
        features, kernel, cotangent = (a.astype(dtype) for a in rounded)
        result, gradients = convolve_with_gradients(features, table, kernel, cotangent)
        assert result.dtype == gradients[0].dtype == gradients[1].dtype == dtype
        return [np.asarray(leaf, np.float32) for leaf in (result, *gradients)]

    for half, full in zip(run(jnp.bfloat16), run(jnp.float32), strict=True):
        np.testing.assert_allclose(half, full, rtol=2**-8, atol=1e-5)


@pytest.mark.parametrize("shape", [(3, 4, 5), (1, 7, 2), (41, 1600, 1408)])
def test_keys_and_coordinates_are_inverse(shape):
    """And keys ascend with y slowest, then x, then z."""
    number = min(np.prod(shape), 1000)
    coordinates = random_coordinates(0, shape, number)
    coordinates[[0, -1]] = [0, 0, 0], np.array(shape) - 1
    keys = site_ops.linear_keys(jnp.array(coordinates), shape)
    assert keys.dtype == jnp.int32
    assert (np.diff(keys) > 0).all()
    assert keys[-1] == np.prod(shape) - 1
    np.testing.assert_array_equal(site_ops.coordinates_of(keys, shape), coordinates)


@pytest.mark.parametrize("capacity", [1, 5, 12, 300])
@pytest.mark.parametrize("shape", [(13, 7, 9), (70, 3, 4)])
def test_the_map_of_strided_sites_is_that_of_their_list(shape, capacity):
    """Dropped sites are in neither, even where a column loses only some of its own."""
    where = {"shape": shape, "out_shape": DOWN.out_shape(shape), **DOWN._asdict()}
    find = jax.jit(partial(site_ops.strided_sites, capacity=capacity, **where))
    for number in (0, 1, 30, 200):
        sites, _ = find(sites_of(random_coordinates(number, shape, number), shape, 250))
        listed = active_sites(sites.keys, shape=where["out_shape"])
        occupied = np.asarray(listed.masks).any(0)
        np.testing.assert_array_equal(sites.masks, listed.masks)
        np.testing.assert_array_equal(np.asarray(sites.starts)[occupied], np.asarray(listed.starts)[occupied])
        assert sites.count == listed.count


@pytest.mark.parametrize("shape", [(3, 4, 5), (37, 3, 2)])
def test_to_dense_puts_each_site_in_its_place(shape):
    """And its gradient is that of a scatter; what stands in padding slots does not matter."""
    number, slots = 17, 30
    coordinates, features = random_coordinates(0, shape, number), random_features(1, slots)
    sites = sites_of(coordinates, shape, slots)
    gather, scatter = (partial(module.to_dense, sites=sites, shape=shape) for module in (site_ops, sparse_dense))
    grid, pull_back = jax.vjp(gather, features.at[number:].set(jnp.nan))
    scattered, pull_back_scattered = jax.vjp(scatter, features)
    expected = np.zeros((*shape, features.shape[1]), np.float32)
    expected[tuple(coordinates.T)] = features[:number]
    np.testing.assert_array_equal(grid.transpose(2, 0, 1, 3), expected)
    np.testing.assert_array_equal(scattered, expected)
    cotangent = random_features(2, grid.size // features.shape[1]).reshape(grid.shape)
    (gradient,), (reference,) = pull_back(cotangent), pull_back_scattered(cotangent.transpose(2, 0, 1, 3))
    np.testing.assert_array_equal(gradient, reference)


@pytest.mark.parametrize(
    ("shape", "sizes"),
    [
        ((41, 7, 100), ((1, 1), (2, 2), (3, 3))),
        ((70, 3, 3), ((3, 3),)),
        ((3, 2, 300), ((2, 2), (3, 3))),
        pytest.param((1100, 2, 5), ((3, 3),), marks=pytest.mark.slow),
    ],
)
def test_lines_read_what_cells_read(shape, sizes):
    """Windows of every size and place, some of them beside the grid; so many words that a line holds few cells."""
    number = np.prod(shape) // 3
    sites = sites_of(random_coordinates(0, shape, number), shape, number)
    rng = np.random.default_rng(0)
    z, y, x = (jnp.array(rng.integers(-4, n + 3, 2000), jnp.int32) for n in shape)
    read = jax.jit(run_ops.runs_at, static_argnames=("size", "program"))
    for size in sizes:
        (slot, mask), (line_slot, line_mask) = (
            read(sites, z, y, x, size=size, program=program) for program in ("cpu", "accelerator")
        )
        np.testing.assert_array_equal(line_mask, mask)
        np.testing.assert_array_equal(np.where(mask != 0, line_slot, 0), np.where(mask != 0, slot, 0))
        assert (mask != 0).sum() > 20


def test_runs_name_the_sites_of_a_window():
    """Slots and offsets, against a search of the list of sites."""
    shape, number = (40, 3, 4), 200
    coordinates = random_coordinates(0, shape, number)
    sites = sites_of(coordinates, shape, number)
    slot_of = {tuple(place): slot for slot, place in enumerate(coordinates.tolist())}
    z, y, x = (jnp.array(axis) for axis in np.mgrid[-2:42, 0:3, 0:4].reshape(3, -1).astype(np.int32))
    runs = run_ops.pack(*run_ops.runs_at(sites, z, y, x, size=(1, 1), program="cpu"))
    slots = np.asarray(run_ops.slots(runs, absent=number))
    expected = [
        [slot_of.get((a + k, b, c), number) for k in range(3)]
        for a, b, c in zip(*(a.tolist() for a in (z, y, x)), strict=True)
    ]
    np.testing.assert_array_equal(slots, np.array(expected))
