"""The programs that are compiled: `predict` and `train_step`, whole and by part, with shapes for arguments."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import ciassd_jax
from ciassd_jax import Boxes, Config, GroundTruth, PointCloud, Scene, create_train_state, init_variables
from ciassd_jax.inference.postprocess import postprocess
from ciassd_jax.model.anchors import make_anchors
from ciassd_jax.model.backbone import SPConvNet, fold_height, sites_of
from ciassd_jax.model.backends import make_backend
from ciassd_jax.model.head import MultiTaskHead
from ciassd_jax.model.neck import SSFA
from ciassd_jax.model.network import predict_raw, voxelize_batch
from ciassd_jax.ops.sites import Triple, Window
from ciassd_jax.training.losses import detection_loss
from ciassd_jax.training.optimizer import make_optimizer
from ciassd_jax.training.targets import assign_targets
from ciassd_jax.types import Sites, SparseVoxels

Program = tuple[str, Callable[..., Any], tuple[Any, ...]]


def shape(*sizes: int, dtype: Any = np.float32) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(sizes, dtype)


def scenes(config: Config, batch: int) -> Scene:
    """Shapes of a batch of labelled scenes."""
    points, boxes, whole = config.data.max_points, config.data.max_boxes, partial(shape, dtype=np.int32)
    return Scene(
        PointCloud(shape(batch, points, 4), whole(batch)),
        GroundTruth(
            Boxes(shape(batch, boxes, 3), shape(batch, boxes, 3), shape(batch, boxes)),
            whole(batch, boxes),
            whole(batch),
        ),
        *(whole(batch) for _ in range(4)),
    )


def predict(config: Config, batch: int) -> Program:
    """`predict` for a batch of clouds."""
    variables = jax.eval_shape(partial(init_variables, config=config), jax.random.key(0))
    return "predict", partial(ciassd_jax.predict, config=config), (variables, scenes(config, batch).cloud)


def train_step(config: Config, batch: int) -> Program:
    """`train_step` for a batch of scenes."""
    state = jax.eval_shape(partial(create_train_state, config=config), jax.random.key(0))
    return "train_step", partial(ciassd_jax.train_step, config=config), (state, scenes(config, batch))


def predict_parts(config: Config, batch: int) -> Iterator[Program]:
    """The parts of `predict`, from points to boxes."""
    how: dict[str, Any] = {"dtype": jnp.dtype(config.dtype), "program": config.program}
    cloud = scenes(config, batch).cloud
    variables = jax.eval_shape(partial(init_variables, config=config), jax.random.key(0))
    of = lambda part: {name: tree[part] for name, tree in variables.items() if part in tree}  # noqa: E731
    voxelizer = partial(voxelize_batch, config=config)
    yield "voxelize", voxelizer, (cloud,)
    yield from sparse_parts(config, jax.eval_shape(voxelizer, cloud))
    bev = shape(batch, *config.bev_shape, config.bev_channels, dtype=how["dtype"])
    yield "neck", partial(SSFA(config.neck, **how).apply, train=False), (of("neck"), bev)
    features = shape(batch, *config.bev_shape, config.neck.channels, dtype=how["dtype"])
    yield "head", MultiTaskHead(config.head, config.anchors_per_cell, **how).apply, (of("head"), features)
    raw = jax.eval_shape(partial(predict_raw, config=config), variables, cloud)
    yield "postprocess", partial(postprocess, config=config), (raw,)


def sparse_parts(config: Config, voxels: SparseVoxels) -> Iterator[Program]:
    """The backbone in evaluation, without BatchNorm: sites, tables and sparse convolutions of each stage, the fold."""
    net, dtype = config.backbone, jnp.dtype(config.dtype)
    shapes, capacities = net.stage_shapes(config.grid.shape), net.capacities(config.grid.max_voxels)
    first_sites = partial(sites_of, shape=shapes[0])
    yield "stage 0: sites", first_sites, (voxels,)
    sites, channels = jax.eval_shape(first_sites, voxels), voxels.features.shape[-1]

    def rows() -> jax.ShapeDtypeStruct:
        return shape(sites.keys.size, channels, dtype=dtype)

    for i, stage in enumerate((*net.stages, None)):
        if i > 0:
            window = Window(shapes[i - 1], shapes[i], (3, 1, 1), (2, 1, 1), (0, 0, 0))
            if stage is not None:
                window = Window(shapes[i - 1], shapes[i], (3, 3, 3), (2, 2, 2), (stage.z_padding, 1, 1))
            width = net.out_channels if stage is None else stage.channels
            down = partial(strided_layer, config=config, window=window, capacity=capacities[i])
            given = sites, rows(), shape(int(np.prod(window.kernel)), channels, width, dtype=dtype)
            yield f"{'out' if stage is None else f'stage {i}'}: sites, table, strided layer", down, given
            (sites, _), channels = jax.eval_shape(down, *given), width
        if stage is not None and stage.layers:
            widths = [channels, *[stage.channels] * stage.layers]
            kernels = [shape(27, *pair, dtype=dtype) for pair in pairwise(widths)]
            layers = partial(submanifold_layers, config=config, shape=shapes[i])
            name = f"stage {i}: table, {stage.layers} submanifold layer{'s' if stage.layers > 1 else ''}"
            yield name, layers, (sites, rows(), kernels)
            channels = stage.channels
    features = shape(*sites.keys.shape, channels, dtype=dtype)
    yield "fold to BEV", partial(fold_to_bev, config=config), (features, sites)


def strided_layer(sites: Sites, features: Any, kernel: Any, *, config: Config, window: Window, capacity: int) -> Any:
    out, convolution, _ = make_backend(config.backbone.backend, config.program).strided(sites, window, capacity)
    return out, jax.nn.relu(convolution(features, kernel))


def submanifold_layers(sites: Sites, features: Any, kernels: Any, *, config: Config, shape: Triple) -> Any:
    convolution = make_backend(config.backbone.backend, config.program).submanifold(sites, shape)
    for kernel in kernels:
        features = jax.nn.relu(convolution(features, kernel))
    return features


def fold_to_bev(features: Any, sites: Sites, *, config: Config) -> Any:
    shape = config.backbone.stage_shapes(config.grid.shape)[-1]
    grid = make_backend(config.backbone.backend, config.program).to_dense(features, sites, shape)
    return fold_height(grid)


def train_parts(config: Config, batch: int) -> Iterator[Program]:
    """The parts of `train_step`, each with its gradient."""
    batched, how = scenes(config, batch), {"dtype": jnp.dtype(config.dtype), "program": config.program}
    variables = jax.eval_shape(partial(init_variables, config=config), jax.random.key(0))
    voxelizer = partial(voxelize_batch, config=config)
    yield "voxelize", voxelizer, (batched.cloud,)
    voxels = jax.eval_shape(voxelizer, batched.cloud)
    bev = shape(batch, *config.bev_shape, config.bev_channels, dtype=how["dtype"])
    features = shape(batch, *config.bev_shape, config.neck.channels, dtype=how["dtype"])
    train = {"train": True, "mutable": ["batch_stats"]}
    backbone = partial(SPConvNet(config.backbone, config.grid.shape, **how).apply, **train)
    neck = partial(SSFA(config.neck, **how).apply, **train)
    head = MultiTaskHead(config.head, config.anchors_per_cell, **how).apply
    for name, apply, given, fixed in (
        ("backbone", backbone, voxels.features, voxels),
        ("neck", neck, bev, None),
        ("head", head, features, None),
    ):
        rest = {"batch_stats": variables["batch_stats"][name]} if name in variables["batch_stats"] else {}
        yield f"{name} with gradient", gradient_of(apply), (variables["params"][name], given, rest, fixed)
    anchors, labels = make_anchors(config)
    assign = jax.vmap(partial(assign_targets, anchors=anchors, anchor_labels=labels, classes=config.classes))
    yield "targets", assign, (batched.truth,)
    raw = jax.eval_shape(partial(predict_raw, config=config), variables, batched.cloud)

    def loss(predictions: Any, targets: Any) -> Any:
        return detection_loss(predictions, targets, anchors, config.loss).total

    yield "losses with gradient", jax.grad(loss), (raw.predictions, jax.eval_shape(assign, batched.truth))
    optimizer = make_optimizer(config.schedule)
    moments = jax.eval_shape(optimizer.init, variables["params"])
    yield "optimizer update", optimizer.update, (variables["params"], moments, variables["params"])


def gradient_of(apply: Callable[..., Any]) -> Callable[..., Any]:
    """Gradient of the sum of a module's first output, or of all of a record, in its parameters and its input."""

    def loss(params: Any, x: Any, rest: Any, fixed: Any) -> Any:
        output = apply({"params": params} | rest, x if fixed is None else fixed._replace(features=x))
        first = output[0] if rest else output
        first = first if fixed is None else first[0]
        return sum(leaf.astype(jnp.float32).sum() for leaf in jax.tree.leaves(first))

    return jax.grad(loss, argnums=(0, 1))
