"""The network with the reference weights equals the released code on real frames, stage by stage."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ciassd_jax.config import HeadConfig
from ciassd_jax.config.presets import car_released
from ciassd_jax.inference.postprocess import postprocess
from ciassd_jax.inference.predict import predict
from ciassd_jax.inference.weights import load_weights
from ciassd_jax.model.head import MultiTaskHead
from ciassd_jax.model.network import CIASSD, RawPredictions, voxelize_batch
from ciassd_jax.ops import boxes as box_ops
from ciassd_jax.ops import sites as site_ops
from ciassd_jax.ops.camera import frustum_planes
from ciassd_jax.ops.sites import NO_SITE, coordinates_of, linear_keys
from ciassd_jax.types import PointCloud

# Our names of the 14 sparse layers, in the order of the released code, and the resolution of each.
LAYERS = {
    "stage0_0": 0,
    "stage0_1": 0,
    "stage1_down": 1,
    "stage1_0": 1,
    "stage1_1": 1,
    "stage2_down": 2,
    "stage2_0": 2,
    "stage2_1": 2,
    "stage2_2": 2,
    "stage3_down": 3,
    "stage3_0": 3,
    "stage3_1": 3,
    "stage3_2": 3,
    "out": 4,
}
OUT_WINDOW = {"kernel": (3, 1, 1), "stride": (2, 1, 1), "padding": (0, 0, 0)}
FRAMES = ("000010", "000068", "000095")
pytestmark = pytest.mark.reference


@cache
def network(shared: Path):
    """Weights, and the compiled network that keeps what every layer gave."""
    weights = load_weights(shared / "golden" / "weights.pth")

    @jax.jit
    def run(variables, voxels):
        def keep(module, _):
            return module.path[:1] == ("backbone",) or module.path == ("neck",)

        return CIASSD(weights.config).apply(variables, voxels, capture_intermediates=keep, mutable=["intermediates"])

    return weights, run


@cache
def result(shared: Path, frame: str):
    """The frame's cloud, voxels, outputs and intermediate results."""
    weights, run = network(shared)
    points = np.load(shared / "golden" / f"voxel_{frame}.npz")["points"]
    padded = np.zeros((1, 20000, 4), np.float32)
    padded[0, : len(points)] = points
    cloud = PointCloud(padded, np.array([len(points)], np.int32))
    voxels = jax.jit(voxelize_batch)(cloud, weights.config)
    output, kept = run(weights.variables, voxels)
    return cloud, voxels, output, kept["intermediates"]


@jax.jit
def strided_sites(voxels):
    """Sites of the first scene at every resolution."""
    config = car_released()
    backbone, shapes = config.backbone, config.backbone.stage_shapes(config.grid.shape)
    keys = linear_keys(voxels.coordinates[0], shapes[0])
    keys = jnp.where(jnp.arange(keys.shape[0]) < voxels.count[0], keys, NO_SITE)
    sites = [site_ops.active_sites(keys, shape=shapes[0])]
    for i, stage in enumerate((*backbone.stages[1:], None)):
        window = {"kernel": (3, 3, 3), "stride": (2, 2, 2), "padding": (stage.z_padding, 1, 1)} if stage else OUT_WINDOW
        capacity = stage.capacity if stage else backbone.out_capacity
        sites.append(
            site_ops.strided_sites(sites[-1], shape=shapes[i], out_shape=shapes[i + 1], capacity=capacity, **window)[0]
        )
    return sites


@pytest.fixture(scope="module")
def golden(shared: Path) -> dict[str, np.ndarray]:
    return dict(np.load(shared / "golden" / "network.npz"))


@pytest.mark.parametrize("frame", FRAMES)
def test_active_sites(shared: Path, golden: dict, frame: str) -> None:
    _, voxels, (_, _, kept, dropped), _ = result(shared, frame)
    counts = golden[f"{frame}_stage_active_counts"]
    assert int(voxels.count[0]) == counts[0]
    np.testing.assert_array_equal(kept[0], counts[[2, 5, 9, 13]])
    assert int(dropped.sum()) == 0
    sites = strided_sites(voxels)
    np.testing.assert_array_equal([sites[resolution].count for resolution in LAYERS.values()], counts)
    z, y, x = np.asarray(coordinates_of(sites[-1].keys, (2, 200, 176)))[: counts[-1]].T
    active = np.zeros((2, 200, 176), bool)
    active[z, y, x] = True
    np.testing.assert_array_equal(np.packbits(active), golden[f"{frame}_bev_active_bits"])


@pytest.mark.parametrize("frame", FRAMES)
def test_bev_map(shared: Path, golden: dict, frame: str) -> None:
    bev = np.asarray(result(shared, frame)[3]["backbone"]["__call__"][0][0])[0].transpose(2, 0, 1)
    np.testing.assert_allclose(
        bev.reshape(-1)[golden[f"{frame}_bev_index"]], golden[f"{frame}_bev_value"], rtol=0, atol=1e-4
    )
    np.testing.assert_allclose(bev.sum((1, 2), dtype=float), golden[f"{frame}_bev_channel_sum"], rtol=1e-5, atol=1e-2)
    active = np.unpackbits(golden[f"{frame}_bev_active_bits"])[: 2 * 200 * 176].reshape(2, 200, 176).astype(bool)
    by_layer = bev.reshape(64, 2, 200, 176)
    assert not by_layer[:, ~active].any()


def test_every_sparse_layer(shared: Path, golden: dict) -> None:
    """At sampled sites, before and behind the ReLU, and summed over all sites."""
    _, voxels, _, kept = result(shared, "000010")
    variables, config = network(shared)[0][:2]
    sites, shapes = strided_sites(voxels), config.backbone.stage_shapes(config.grid.shape)
    for number, (layer, resolution) in enumerate(LAYERS.items()):
        name = f"000010_stage{3 * number:02d}"
        wanted = linear_keys(jnp.asarray(golden[f"{name}_coords"], jnp.int32), shapes[resolution])
        rows = np.searchsorted(sites[resolution].keys, wanted)
        np.testing.assert_array_equal(sites[resolution].keys[rows], wanted)
        norm, statistics = (variables[kind]["backbone"][layer]["norm"] for kind in ("params", "batch_stats"))
        factor = norm["scale"] / np.sqrt(statistics["var"] + 1e-3)
        normalized = (golden[f"{name}_conv"] - statistics["mean"]) * factor + norm["bias"]
        ours = kept["backbone"][layer]
        np.testing.assert_allclose(ours["norm"]["__call__"][0][rows], normalized, rtol=0, atol=1e-4, err_msg=layer)
        activated = np.asarray(ours["__call__"][0])
        np.testing.assert_allclose(activated[rows], golden[f"{name}_act"], rtol=0, atol=1e-4, err_msg=layer)
        np.testing.assert_allclose(
            activated.sum(0, dtype=float), golden[f"{name}_act_channel_sum"], rtol=1e-5, atol=1e-2, err_msg=layer
        )


@pytest.mark.parametrize("frame", FRAMES)
def test_neck(shared: Path, golden: dict, frame: str) -> None:
    ssfa = np.asarray(result(shared, frame)[3]["neck"]["__call__"][0])[0].transpose(2, 0, 1)
    difference = np.abs(ssfa.reshape(-1)[golden[f"{frame}_ssfa_index"]] - golden[f"{frame}_ssfa_value"])
    assert difference.max() <= 5e-3
    assert difference.mean() <= 1e-5


@pytest.mark.parametrize("frame", FRAMES)
def test_heads(shared: Path, golden: dict, frame: str) -> None:
    predictions = result(shared, frame)[2][0]
    for mine, name, tolerance in (
        (predictions.box, "box_preds", 5e-4),
        (predictions.class_logit, "cls_preds", 5e-3),
        (predictions.direction, "dir_cls_preds", 1e-3),
        (predictions.iou, "iou_preds", 2e-4),
    ):
        np.testing.assert_allclose(
            np.asarray(mine).reshape(-1), golden[f"{frame}_{name}"].reshape(-1), rtol=0, atol=tolerance
        )


@pytest.mark.parametrize("frame", FRAMES)
def test_the_other_iou_head(shared: Path, golden: dict, frame: str) -> None:
    weights, _ = network(shared)
    head = replace(weights.config.head, iou_kernel=1, iou_bias=True)
    assert isinstance(head, HeadConfig)
    iou = {
        "kernel": golden["alt_conv_iou_weight"].transpose(2, 3, 1, 0),
        "bias": golden["alt_conv_iou_bias"],
    }
    params = {"params": weights.variables["params"]["head"] | {"iou": iou}}
    features = result(shared, frame)[3]["neck"]["__call__"][0]
    predictions = jax.jit(MultiTaskHead(head, 2, jnp.dtype("float32")).apply)(params, features)
    expected = golden[f"{frame}_alt_iou_preds"].reshape(-1)
    np.testing.assert_allclose(np.asarray(predictions.iou)[0], expected, rtol=0, atol=2e-4)


@pytest.mark.parametrize("frame", FRAMES)
def test_final_boxes(shared: Path, golden: dict, frame: str) -> None:
    weights, _ = network(shared)
    _, voxels, (predictions, _, kept, dropped), _ = result(shared, frame)
    height, width = golden[f"{frame}_image_shape"]
    projection = golden[f"{frame}_P2"][:3] @ golden[f"{frame}_R0_rect"] @ golden[f"{frame}_Tr_velo_to_cam"]
    planes = frustum_planes(projection, width=int(width), height=int(height))[None].astype(np.float32)
    raw = RawPredictions(predictions, voxels, kept, dropped)
    detections = jax.jit(postprocess, static_argnames="config")(raw, weights.config, frustum=planes)
    expected = golden[f"{frame}_final_boxes"]
    count = int(detections.count[0])
    assert count == len(expected)
    difference = np.asarray(box_ops.to_paper(detections.boxes))[0, :count] - expected
    difference[:, 6] = (difference[:, 6] + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(difference).max() <= 5e-3
    np.testing.assert_allclose(detections.score[0, :count], golden[f"{frame}_final_scores"], rtol=0, atol=1e-3)


@pytest.mark.slow
def test_a_batch_of_four_is_four_singles(shared: Path) -> None:
    """At the real size, voxels on the borders of cells included: one frame three times would not show those."""
    weights, _ = network(shared)
    clouds = [result(shared, frame)[0] for frame in FRAMES]
    empty = clouds[0]._replace(count=np.zeros(1, np.int32))
    scenes = [clouds[0], clouds[1], empty, clouds[2]]
    run = jax.jit(predict, static_argnames="config")
    together = run(weights.variables, jax.tree.map(lambda *leaves: np.concatenate(leaves), *scenes), weights.config)
    alone = [run(weights.variables, scene, weights.config) for scene in scenes]
    alone = jax.tree.map(lambda *leaves: np.concatenate(leaves), *alone)
    np.testing.assert_array_equal(together.count, alone.count)
    assert (np.asarray(together.count) > 0).tolist() == [True, True, False, True]
    chex.assert_trees_all_close(together, alone, rtol=0, atol=1e-5)
