"""How long do the programs take to compile? Trace, lowering and compilation seconds, whole and by part.

    python benchmarks/bench_compile.py                          # tiny, car_lite, car
    python benchmarks/bench_compile.py --presets tiny --parts   # and the parts of each program

Nothing is read from or written to the compilation cache. Seconds are of the wall clock, `cpu` those of all threads,
which other jobs on the machine disturb less. With `--json` one object per program is printed instead of a table.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import ciassd_jax
from ciassd_jax import Boxes, Config, GroundTruth, PointCloud, Scene, create_train_state, init_variables, predict

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


def whole_programs(config: Config, batch: int) -> Iterator[Program]:
    """`predict` for one cloud and `train_step` for a batch."""
    one = PointCloud(shape(1, config.data.max_points, 4), shape(1, dtype=np.int32))
    state = jax.eval_shape(lambda key: create_train_state(key, config), jax.random.key(0))
    yield "predict", lambda state, cloud: predict(state, cloud, config), (state, one)
    yield "train_step", lambda state, scene: ciassd_jax.train_step(state, scene, config), (state, scenes(config, batch))


def parts(config: Config, batch: int) -> Iterator[Program]:
    """The parts of both programs, each compiled alone."""
    from ciassd_jax.inference.postprocess import postprocess
    from ciassd_jax.model.anchors import make_anchors
    from ciassd_jax.model.backbone import SPConvNet
    from ciassd_jax.model.head import MultiTaskHead
    from ciassd_jax.model.neck import SSFA
    from ciassd_jax.model.network import predict_raw, voxelize_batch
    from ciassd_jax.training.losses import detection_loss
    from ciassd_jax.training.optimizer import make_optimizer
    from ciassd_jax.training.targets import assign_targets

    batched, dtype = scenes(config, batch), jnp.dtype(config.dtype)
    variables = jax.eval_shape(partial(init_variables, config=config), jax.random.key(0))
    of = lambda part: {name: tree[part] for name, tree in variables.items() if part in tree}  # noqa: E731
    voxelizer = partial(voxelize_batch, grid=config.grid)
    yield "voxelize", voxelizer, (batched.cloud,)

    def gradient(module: Any) -> Callable[..., Any]:
        """Gradient of the sum of a module's first output, in its parameters and its input."""

        def loss(params: Any, x: Any, rest: Any, fixed: Any) -> Any:
            output, _ = module.apply({"params": params} | rest, join(x, fixed), train=True, mutable=["batch_stats"])
            return jax.tree.leaves(output)[0].astype(jnp.float32).sum()

        return jax.grad(loss, argnums=(0, 1))

    def join(x: Any, fixed: Any) -> Any:
        return x if fixed is None else fixed._replace(features=x)

    voxels = jax.eval_shape(voxelizer, batched.cloud)
    bev = shape(batch, *config.bev_shape, config.bev_channels)
    features = shape(batch, *config.bev_shape, config.neck.channels)
    backbone = SPConvNet(config.backbone, config.grid.shape, dtype)
    neck, head = SSFA(config.neck, dtype), MultiTaskHead(config.head, config.anchors_per_cell, dtype)
    for name, module, x, fixed in (("backbone", backbone, voxels.features, voxels), ("neck", neck, bev, None)):
        tree = of(name)
        given = x if fixed is None else fixed
        yield name, partial(module.apply, train=False), (tree, given)
        yield f"{name} + gradient", gradient(module), (tree["params"], x, {"batch_stats": tree["batch_stats"]}, fixed)
    yield "head", head.apply, (of("head"), features)
    raw = jax.eval_shape(partial(predict_raw, config=config), variables, batched.cloud)
    yield "postprocess", partial(postprocess, config=config), (raw,)
    anchors, labels = make_anchors(config)
    assign = partial(assign_targets, anchors=anchors, anchor_labels=labels, classes=config.classes)
    yield "targets", jax.vmap(assign), (batched.truth,)
    targets = jax.eval_shape(jax.vmap(assign), batched.truth)

    def loss(predictions: Any, targets: Any) -> Any:
        return detection_loss(predictions, targets, anchors, config.loss).total

    yield "losses + gradient", jax.grad(loss), (raw.predictions, targets)
    optimizer = make_optimizer(config.schedule)
    moments = jax.eval_shape(optimizer.init, variables["params"])
    yield "optimizer update", optimizer.update, (variables["params"], moments, variables["params"])


def measure(function: Callable[..., Any], arguments: tuple[Any, ...]) -> dict[str, float]:
    """Seconds of each stage, and the size of the program."""
    jax.clear_caches()
    moments, cpu = [time.perf_counter()], time.process_time()
    stage: Any = jax.jit(function)
    stage = stage.trace(*arguments)
    moments.append(time.perf_counter())
    stage = stage.lower()
    moments.append(time.perf_counter())
    lines = stage.as_text().count("\n")
    start = time.perf_counter()
    stage.compile()
    trace, lower = moments[1] - moments[0], moments[2] - moments[1]
    compiled = time.perf_counter() - start
    return {"trace": trace, "lower": lower, "compile": compiled, "cpu": time.process_time() - cpu, "lines": lines}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", nargs="+", default=["tiny", "car_lite", "car"])
    parser.add_argument("--batch", type=int, default=1, help="scenes of the training step")
    parser.add_argument("--parts", action="store_true", help="also each part alone")
    parser.add_argument("--only", help="programs and parts whose name contains this text")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    jax.config.update("jax_enable_compilation_cache", False)
    if not options.json:
        print(f"{'preset':<10} {'program':<20} {'trace':>7} {'lower':>7} {'compile':>8} {'cpu':>7} {'lines':>7}")
    for preset in options.presets:
        config = getattr(ciassd_jax, preset)()
        programs = list(whole_programs(config, options.batch))
        programs += list(parts(config, options.batch)) if options.parts else []
        for name, function, arguments in programs:
            if options.only and options.only not in name:
                continue
            found = measure(function, arguments)
            if options.json:
                print(json.dumps({"preset": preset, "program": name, **found}), flush=True)
                continue
            seconds = f"{found['trace']:>7.2f} {found['lower']:>7.2f} {found['compile']:>8.2f} {found['cpu']:>7.2f}"
            print(f"{preset:<10} {name:<20} {seconds} {found['lines']:>7.0f}", flush=True)


if __name__ == "__main__":
    main()
