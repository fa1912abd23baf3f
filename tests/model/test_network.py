"""The whole network on the tiny preset, and what the car presets would compute, without computing it."""

from dataclasses import replace
from functools import cache, partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles_network import postprocess_by_loop, predict_by_loop

from ciassd_jax.config import Config, presets
from ciassd_jax.inference.postprocess import postprocess
from ciassd_jax.inference.predict import predict
from ciassd_jax.model.backbone import SPConvNet
from ciassd_jax.model.network import init_variables, predict_raw, voxelize_batch
from ciassd_jax.types import PointCloud, SparseVoxels

ROWS = 1024
TINY = presets.tiny()
# A quarter of its area, for training by the dense definition.
SMALL = replace(TINY, grid=replace(TINY.grid, minimum=(0.0, -3.2, -3.0), maximum=(6.4, 3.2, 1.0)))
run = jax.jit(predict_raw, static_argnames="config")
finish = jax.jit(postprocess, static_argnames="config")


@jax.jit
@partial(chex.assert_max_traces, n=1)
def run_one(variables, cloud):
    """The two halves of `predict` on one scene of ROWS points: all tests of this module share one compile."""
    raw = predict_raw(variables, cloud, TINY)
    return raw, postprocess(raw, TINY)


def dense(config: Config) -> Config:
    return replace(config, backbone=replace(config.backbone, backend="dense"))


@cache
def shapes_of(config: Config) -> dict:
    return jax.eval_shape(partial(init_variables, config=config), jax.random.key(0))


@pytest.fixture(scope="module")
def variables() -> dict:
    """Random ones, with BatchNorm statistics and biases that matter."""
    rng = np.random.default_rng(0)

    def draw(path, leaf):
        name = path[-1].key
        if name == "kernel":
            return rng.normal(size=leaf.shape) / np.sqrt(leaf.size / leaf.shape[-1] / 2)
        return rng.uniform(0.5, 1.5, leaf.shape) - (name in ("bias", "mean"))

    return jax.tree.map(jnp.float32, jax.tree_util.tree_map_with_path(draw, shapes_of(TINY)))


def random_points(seed: int, number: int, grid: presets.GridConfig = TINY.grid) -> np.ndarray:
    rng = np.random.default_rng(seed)
    low, high = grid.minimum, grid.maximum
    points = rng.uniform([*low, 0], [*high, 1], (number, 4))
    # Every other point near the one before it, so that voxels hold several.
    points[1::2, :3] = points[: number - number % 2 : 2, :3] + rng.uniform(0, 0.05, (number // 2, 3))
    return points.astype(np.float32)


def batch_of(*scenes: np.ndarray, padding: np.ndarray | None = None) -> PointCloud:
    """Padded with points that would count, were they not padding."""
    padding = random_points(99, ROWS) if padding is None else padding
    padded = [np.concatenate([points, padding])[:ROWS] for points in scenes]
    return PointCloud(np.stack(padded), np.array([len(points) for points in scenes], np.int32))


SCENES = [random_points(seed, number) for seed, number in enumerate((300, 0, 1, ROWS))]


def assert_close(mine, reference, tolerance: float = 1e-5) -> None:
    jax.tree.map(partial(np.testing.assert_allclose, rtol=0, atol=tolerance), mine, reference)


def test_parameter_counts():
    def count(config):
        return sum(leaf.size for leaf in jax.tree.leaves(shapes_of(config)["params"]))

    assert count(presets.car_released()) == 3_813_720
    # Two 3 x 3 attention convolutions for 1 x 1 ones; the IoU branch 1 x 1 with bias for 3 x 3 without.
    assert count(presets.car()) == 3_813_720 + 2 * 8 * 128 - 8 * 128 * 2 + 2


def test_parameter_shapes_of_the_car():
    params = shapes_of(presets.car())["params"]
    assert params["neck"]["spatial_attention"]["kernel"].shape == (3, 3, 128, 1)
    assert params["neck"]["semantic_attention"]["kernel"].shape == (3, 3, 128, 1)
    assert jax.tree.map(jnp.shape, params["head"]["iou"]) == {"kernel": (1, 1, 128, 2), "bias": (2,)}
    released = shapes_of(presets.car_released())["params"]
    assert released["neck"]["spatial_attention"]["kernel"].shape == (1, 1, 128, 1)
    assert jax.tree.map(jnp.shape, released["head"]["iou"]) == {"kernel": (3, 3, 128, 2)}


@pytest.mark.smoke
@pytest.mark.parametrize("seed", [0, 1])
def test_predictions_are_those_of_the_definition(variables, seed):
    """Voxels, sparse convolutions, neck and head of made-up points, computed by loops in float64."""
    points = random_points(seed, 300)
    raw, _ = run_one(variables, batch_of(points))
    assert not raw.sites_dropped.any()
    assert_close(jax.tree.map(lambda leaf: leaf[0], raw.predictions), predict_by_loop(variables, points, TINY))


@pytest.mark.parametrize("nms", ["paper", "released"])
@pytest.mark.parametrize("seed", [0, 1])
def test_detections_are_those_of_the_definition(variables, seed, nms):
    """From the network's predictions on: rectification, DI-NMS, direction and range by loops in float64."""
    config = replace(
        TINY,
        classes=(replace(TINY.classes[0], support_threshold=1.0),),
        detection=replace(TINY.detection, nms=nms, clamp_iou=nms == "paper"),
    )
    cloud = batch_of(random_points(seed, 300))
    raw, _ = run_one(variables, cloud)
    found = finish(raw, config)
    expected = postprocess_by_loop(jax.tree.map(lambda leaf: leaf[0], raw.predictions), config)
    assert expected.margin > 1e-5
    count = int(found.count[0])
    assert count == len(expected.boxes) > 5
    difference = np.asarray(found.boxes.to_array())[0, :count] - expected.boxes
    difference[:, 6] = (difference[:, 6] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(difference, 0, rtol=0, atol=1e-5)
    np.testing.assert_allclose(found.score[0, :count], expected.score, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(found.label[0, :count], expected.label)


def test_one_compile_serves_0_1_and_all_points(variables):
    for number in (0, 1, ROWS):
        raw, detections = run_one(variables, batch_of(random_points(5, number)))
        assert detections.counts.points_given.tolist() == [number]
        assert (detections.counts.voxels_kept > 0).tolist() == [number > 0]
        chex.assert_tree_all_finite((raw, detections))


def test_a_scene_ignores_its_batch_mates(variables):
    """A batch of four equals four singles, and changing the others changes nothing."""
    together = run(variables, batch_of(*SCENES), TINY)
    for i, points in enumerate(SCENES):
        alone, _ = run_one(variables, batch_of(points))
        assert_close(jax.tree.map(lambda leaf, i=i: leaf[i], together), jax.tree.map(lambda leaf: leaf[0], alone))
    others = run(variables, batch_of(SCENES[0], SCENES[3], SCENES[3], SCENES[1]), TINY)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[0], b[0]), together, others)
    assert abs(together.predictions.box[0] - together.predictions.box[1]).max() > 0.01
    assert together.sites_dropped[3].any()


def test_an_empty_batch_is_finite(variables):
    raw = run(variables, batch_of(*[SCENES[1]] * 4), TINY)
    assert not raw.voxels.count.any()
    assert not raw.sites_kept.any()
    chex.assert_tree_all_finite(raw)


def test_order_of_points_is_irrelevant(variables):
    shuffled = np.random.default_rng(0).permutation(SCENES[0])
    (first, _), (second, _) = (run_one(variables, batch_of(points)) for points in (SCENES[0], shuffled))
    assert 1 < first.voxels.num_points.max() < TINY.grid.max_points_per_voxel
    assert_close(second.predictions, first.predictions)


def test_what_stands_in_padding_is_inert(variables):
    results = [
        run_one(variables, batch_of(SCENES[0], padding=padding))
        for padding in (random_points(7, ROWS), np.full((ROWS, 4), np.nan, np.float32))
    ]
    jax.tree.map(np.testing.assert_array_equal, *results)


@partial(jax.jit, static_argnames="config")
def train_backbone(variables, voxels, config):
    """Outputs and new statistics in training mode, and the gradient of a sum of the BEV map by the parameters."""
    backbone = SPConvNet(config.backbone, config.grid.shape, jnp.dtype("float32"))

    def total(params):
        outputs, updated = backbone.apply(
            {"params": params, "batch_stats": variables["batch_stats"]["backbone"]},
            voxels,
            train=True,
            mutable=["batch_stats"],
        )
        weight = jnp.cos(jnp.arange(outputs[0].size, dtype=jnp.float32)).reshape(outputs[0].shape)
        return (outputs[0] * weight).sum(), (outputs, updated)

    gradients, (outputs, updated) = jax.grad(total, has_aux=True)(variables["params"]["backbone"])
    return outputs, updated, gradients


def small_voxels(*numbers: int) -> SparseVoxels:
    scenes = [random_points(seed, number, SMALL.grid) for seed, number in enumerate(numbers)]
    return jax.tree.map(np.asarray, voxelize_batch(batch_of(*scenes), SMALL))


def test_backends_agree(variables):
    cloud = batch_of(*SCENES)
    assert_close(run(variables, cloud, TINY), run(variables, cloud, dense(TINY)))


@pytest.mark.slow
def test_backends_agree_in_training(variables):
    """Of the backbone, where alone they differ: the map, the statistics and the gradients by all parameters."""
    voxels = small_voxels(300, ROWS)
    *outputs, gradients = train_backbone(variables, voxels, SMALL)
    *dense_outputs, dense_gradients = train_backbone(variables, voxels, dense(SMALL))
    assert_close(outputs, dense_outputs)

    def assert_close_to_scale(path, mine, reference):
        scale = abs(reference).max()
        assert scale > 0, path
        np.testing.assert_allclose(mine / scale, reference / scale, rtol=0, atol=1e-5, err_msg=str(path))

    jax.tree_util.tree_map_with_path(assert_close_to_scale, gradients, dense_gradients)


@pytest.mark.slow
def test_training_on_an_empty_batch_is_finite(variables):
    outputs, updated, gradients = train_backbone(variables, small_voxels(0, 0), SMALL)
    chex.assert_tree_all_finite((outputs, gradients))
    jax.tree.map(np.testing.assert_array_equal, updated["batch_stats"], variables["batch_stats"]["backbone"])


def test_shifted_voxels_shift_the_bev_map(variables):
    """By one cell (the backbone's stride) along x and two along y; the features stay."""
    stride, voxels = SMALL.backbone.stride, small_voxels(300, ROWS)
    _, rows, columns = SMALL.grid.shape
    # The voxels of the middle, moved together to be a scene of their own.
    middle = np.array([0, rows // 4, columns // 4])
    coordinates = middle + voxels.coordinates // np.array([1, 2, 2])
    scenes = [np.unique(c[:n], axis=0) for c, n in zip(coordinates, voxels.count, strict=True)]
    scenes = [c[np.lexsort(c[:, [0, 2, 1]].T)] for c in scenes]
    counts = np.array([len(c) for c in scenes], np.int32)
    padded = np.stack([np.pad(c, ((0, voxels.coordinates.shape[1] - len(c)), (0, 0))) for c in scenes])
    real = (np.arange(padded.shape[1])[None] < counts[:, None])[..., None]
    maps = []
    for shift in (0, stride):
        moved = np.where(real, padded + shift * np.array([0, 2, 1]), 0).astype(np.int32)
        (bev, *_), *_ = train_backbone(variables, voxels._replace(coordinates=moved, count=counts), SMALL)
        maps.append(np.asarray(bev))
    assert maps[0].shape == (2, *SMALL.bev_shape, SMALL.bev_channels)
    assert maps[0].any(-1).sum() > 50
    assert_close(maps[1][:, 2:, 1:], maps[0][:, :-2, :-1])


def equations(jaxpr):
    """All equations of a jaxpr, those of loops, branches and calls included."""
    for equation in jaxpr.eqns:
        yield equation
        for parameter in equation.params.values():
            for inner in parameter if isinstance(parameter, tuple | list) else (parameter,):
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from equations(inner)


@pytest.fixture(scope="module")
def car_equations() -> list:
    """Everything that `predict` computes for the car, in any branch for any platform."""
    config = presets.car()
    cloud = PointCloud(jax.ShapeDtypeStruct((1, 32768, 4), np.float32), jax.ShapeDtypeStruct((1,), np.int32))
    found = list(equations(jax.make_jaxpr(partial(predict, config=config))(shapes_of(config), cloud).jaxpr))
    # The walk reaches the products inside of the loops over blocks.
    assert {"while", "dot_general", "conv_general_dilated"} <= {equation.primitive.name for equation in found}
    return found


def test_the_car_never_holds_a_dense_grid(car_equations):
    """No array is as large as a 3D grid of any stage but the BEV map's, whatever its channels."""
    config = presets.car()
    sizes = {np.prod(variable.aval.shape, dtype=int) for equation in car_equations for variable in equation.outvars}
    assert max(sizes) < 64 * 2**20
    for grid in config.backbone.stage_shapes(config.grid.shape)[:-1]:
        cells = np.prod(grid, dtype=int)
        assert not sizes & {cells * channels for channels in (1, 3, 4, 16, 27, 32, 64)}, grid


@pytest.mark.smoke
def test_every_product_asks_for_full_precision(car_equations):
    """Accelerators would otherwise use TF32 or bfloat16."""
    products = [e for e in car_equations if e.primitive.name in ("dot_general", "conv_general_dilated")]
    for equation in products:
        assert equation.params["precision"] == (jax.lax.Precision.HIGHEST,) * 2, equation
