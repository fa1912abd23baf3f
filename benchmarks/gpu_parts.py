"""The measurements of `gpu.py`, each of which yields rows."""

from __future__ import annotations

import gzip
import json
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from itertools import cycle, islice
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from real_frames import SHARED

from ciassd_jax import Config, Scene, create_train_state, init_variables, load_weights, predict, train_step
from ciassd_jax.config.presets import PRESETS
from ciassd_jax.data.augment import keep_targets
from ciassd_jax.data.folders import is_custom, is_kitti, open_dataset
from ciassd_jax.data.scenes import pad_frame
from ciassd_jax.inference.postprocess import postprocess
from ciassd_jax.inference.weights import find_weights
from ciassd_jax.model.backbone import SPConvNet
from ciassd_jax.model.head import MultiTaskHead
from ciassd_jax.model.neck import SSFA
from ciassd_jax.model.network import RawPredictions, voxelize_batch
from ciassd_jax.simulation import open_synthetic

Row = dict[str, Any]
Rows = Iterator[Row]
SAME_BOX = 0.1  # metres between the centres of two boxes that are one
SUMS, WORST = ("boxes", "cpu_boxes", "alone", "other_counts"), ("center_m", "size", "yaw_rad", "score")
SHOWN = 20  # kernels


class Plan(NamedTuple):
    """What is measured. Stages, training and kernels are those of the first preset, stages of the first batches."""

    presets: tuple[str, ...]
    dtypes: tuple[str, ...]
    batches: tuple[int, ...]
    train_batches: tuple[int, ...]
    frames: int
    repeats: int
    folder: Path = SHARED / "kitti"
    weights: Path = SHARED / "golden/weights.pth"


class Ready(NamedTuple):
    """A compiled program that takes one of `inputs` a call, and what making it took."""

    call: Callable[[Any], Any]
    inputs: list[Any]
    made: Row


@cache
def frames_of(plan: Plan) -> tuple[list[Any], str]:
    """Return frames evenly spaced over the data set, or simulated ones without it, and which they are."""
    real = is_kitti(plan.folder) or is_custom(plan.folder)
    dataset = open_dataset(plan.folder, "all") if real else open_synthetic(seed=0, frames=plan.frames)
    frames = [dataset.read(i * len(dataset) // plan.frames) for i in range(plan.frames)]
    return frames, "real" if real else f"simulated, as {plan.folder} is no data set"


@cache
def scenes_of(plan: Plan, config: Config, batch: int) -> list[Scene]:
    """Return batches of padded frames on the device."""
    padded = [pad_frame(frame, index, config) for index, frame in enumerate(frames_of(plan)[0])]
    minimum, maximum = config.range
    keep = jax.jit(jax.vmap(partial(keep_targets, minimum=minimum, maximum=maximum)))
    groups = [padded[i : i + batch] for i in range(0, len(padded) - batch + 1, batch)]
    return [keep(jax.tree.map(lambda *leaves: np.stack(leaves), *group)) for group in groups]


@cache
def model_of(preset: str, weights: Path | None = None) -> tuple[Config, Any, str]:
    """Return config, variables and their origin: bundled for `car_lite`, else of the file if it exists, else random."""
    path = find_weights(preset) if preset == "car_lite" else weights
    if path is not None and path.is_file():
        loaded = load_weights(path)
        return loaded.config, loaded.variables, path.name
    config = PRESETS[preset]()
    with jax.default_device(jax.devices("cpu")[0]):
        return config, jax.device_get(init_variables(jax.random.key(0), config)), "random"


def compiled(function: Callable[..., Any], *arguments: Any, donate: tuple[int, ...] = ()) -> tuple[Any, Row]:
    """Return the program for such arguments on their device, and its compile seconds and temporary memory."""
    start = time.perf_counter()
    program = jax.jit(function, donate_argnums=donate).lower(*arguments).compile()
    seconds = time.perf_counter() - start
    return program, {"compile_s": seconds, "temporary_mb": program.memory_analysis().temp_size_in_bytes / 1e6}


def latency(ready: Ready, repeats: int) -> Row:
    """Time calls that are each waited for, and a queue of calls of which only the last is."""
    for given in ready.inputs[:3]:
        jax.block_until_ready(ready.call(given))
    seconds = []
    for given in islice(cycle(ready.inputs), repeats):
        start = time.perf_counter()
        jax.block_until_ready(ready.call(given))
        seconds.append(1e3 * (time.perf_counter() - start))
    start = time.perf_counter()
    for given in islice(cycle(ready.inputs), repeats):
        result = ready.call(given)
    jax.block_until_ready(result)
    queued = 1e3 * (time.perf_counter() - start) / repeats
    median = statistics.median(seconds)
    return {"median_ms": median, "min_ms": min(seconds), "max_ms": max(seconds), "queued_ms": queued}


def agreement(plan: Plan, preset: str) -> Rows:
    """Compare the boxes of the device's program with those of the CPU's, frame by frame; any difference is an error.

    Where the device is a CPU, it runs the accelerators' form.
    """
    config, variables, origin = model_of(preset, plan.weights if preset == "car" else None)
    found = []
    first = jax.devices()[0]
    form = "accelerator" if first.platform == "cpu" else "auto"
    for name, device in ((form, first), ("cpu", jax.devices("cpu")[0])):
        clouds = [jax.device_put(scene.cloud, device) for scene in scenes_of(plan, config, 1)]
        placed = jax.device_put(variables, device)
        program, _ = compiled(partial(predict, config=replace(config, program=name)), placed, clouds[0])
        found.append([jax.device_get(program(placed, cloud)) for cloud in clouds])
    frames = [compare(here, there) for here, there in zip(*found, strict=True)]
    sums = {name: sum(frame[name] for frame in frames) for name in SUMS}
    worst = {name: max(frame[name] for frame in frames) for name in WORST}
    row: Row = {"dtype": config.dtype, "weights": origin, "frames": len(frames)} | sums | worst
    if origin != "random" and not sums["boxes"]:
        row["error"] = "no boxes were found, so none was compared"
    elif sums["alone"] or sums["other_counts"]:
        row["error"] = f"{sums['alone']} boxes without a pair, {sums['other_counts']} frames with other counts"
    yield row


def compare(found: Any, expected: Any) -> Row:
    """Pair each box of a scene with the nearest expected one; without a pair it is `alone`. Sizes differ relatively."""
    a, b = (np.c_[each.boxes.to_array()[0], each.score[0]][: each.count[0]] for each in (found, expected))
    distance = np.linalg.norm(a[:, None, :3] - b[None, :, :3], axis=-1)
    paired = distance.min(1, initial=np.inf) < SAME_BOX
    alone = (~paired).sum() + (~(distance.min(0, initial=np.inf) < SAME_BOX)).sum()
    nearest = b[distance[paired].argmin(1)] if paired.any() else b[:0]
    change = np.abs(a[paired] - nearest)
    change[:, 3:6] /= nearest[:, 3:6]
    change[:, 6] = np.minimum(change[:, 6], 2 * np.pi - change[:, 6])
    worst = zip(WORST, (change[:, :3], change[:, 3:6], change[:, 6], change[:, 7]), strict=True)
    other = any(np.any(x != y) for x, y in zip(found.counts, expected.counts, strict=True))
    sums = dict(zip(SUMS, (len(a), len(b), int(alone), int(other)), strict=True))
    return sums | {name: float(each.max(initial=0)) for name, each in worst}


@cache
def predictor(plan: Plan, preset: str, dtype: str, batch: int) -> Ready:
    """Return the compiled `predict`, with the weights on the device."""
    config, variables, origin = model_of(preset)
    clouds, variables = [scene.cloud for scene in scenes_of(plan, config, batch)], jax.device_put(variables)
    program, made = compiled(partial(predict, config=replace(config, dtype=dtype)), variables, clouds[0])
    return Ready(partial(program, variables), clouds, {"weights": origin} | made)


@cache
def trainer(plan: Plan, preset: str, batch: int) -> Ready:
    """Return the compiled `train_step`, which holds the state and donates it to the next call."""
    config, variables, _ = model_of(preset)
    state, scenes = create_train_state(jax.random.key(0), config, variables=variables), scenes_of(plan, config, batch)
    program, made = compiled(partial(train_step, config=config), state, scenes[0], donate=(0,))

    def step(scene: Scene) -> dict[str, jax.Array]:
        nonlocal state
        state, metrics = program(state, scene)
        return metrics

    return Ready(step, scenes, made)


def whole(plan: Plan, make: Callable[[], Ready], batch: int) -> Rows:
    """Time a whole program; the peak of memory is that of the process so far."""
    ready = make()
    row = latency(ready, plan.repeats)
    stats = jax.devices()[0].memory_stats()
    peak = stats["peak_bytes_in_use"] / 1e6 if stats else "not available"
    yield row | {"frames_per_s": 1e3 * batch / row["queued_ms"]} | ready.made | {"peak_mb": peak}


def stages(plan: Plan, preset: str, dtype: str, batch: int) -> Rows:
    """Time each stage of `predict`, compiled alone."""
    config, variables, _ = model_of(preset)
    cloud, variables = scenes_of(plan, config, batch)[0].cloud, jax.device_put(variables)
    config, how = replace(config, dtype=dtype), {"dtype": jnp.dtype(dtype), "program": config.program}
    of = {part: {kind: tree[part] for kind, tree in variables.items() if part in tree} for part in variables["params"]}
    backbone = SPConvNet(config.backbone, config.grid.shape, **how)
    neck, head = SSFA(config.neck, **how), MultiTaskHead(config.head, config.anchors_per_cell, **how)

    def neck_and_head(of: Any, bev: Any) -> Any:
        return head.apply(of["head"], neck.apply(of["neck"], bev, train=False))

    def stage(name: str, function: Callable[..., Any], *given: Any) -> tuple[Any, Row]:
        program, made = compiled(function, *given)
        ready = Ready(lambda given: program(*given), [given], made)
        return program(*given), {"stage": name} | latency(ready, plan.repeats) | made

    voxels, row = stage("voxelize", partial(voxelize_batch, config=config), cloud)
    yield row
    (bev, *sites), row = stage("backbone", partial(backbone.apply, train=False), of["backbone"], voxels)
    yield row
    predictions, row = stage("neck and head", neck_and_head, of, bev)
    yield row
    raw = RawPredictions(predictions, voxels, *sites)
    yield stage("post-processing", partial(postprocess, config=config), raw)[1]


def kernels(plan: Plan, make: Callable[[], Ready]) -> Rows:
    """Profile a few calls: a row for all kernels of one call, then one for each of the most expensive."""
    ready, runs = make(), min(10, plan.repeats)
    jax.block_until_ready(ready.call(ready.inputs[0]))
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            for _ in range(runs):
                jax.block_until_ready(ready.call(ready.inputs[0]))
        found = [row for path in Path(folder).rglob("*.trace.json.gz") for row in read_kernels(path, runs)]
    if not found:
        yield {"kernels": "no device events"}
        return
    total = sum(row["us"] for row in found)
    yield {"kernels": sum(row["calls"] for row in found), "different": len(found), "device_ms": total / 1e3}
    yield from ({"share": row["us"] / total} | row for row in found[:SHOWN])


def read_kernels(path: Path, runs: int) -> list[Row]:
    """Sum the events on the device's streams by name, per run and the most expensive first."""
    events = [event for event in json.loads(gzip.decompress(path.read_bytes()))["traceEvents"] if "ph" in event]
    labels = [event for event in events if event["ph"] == "M" and "name" in event["args"]]
    devices = {each["pid"] for each in labels if each["args"]["name"].startswith(("/device:GPU", "/device:TPU"))}
    # A GPU has one line for each stream; its other lines repeat these events by scope and by module.
    streams = {
        (each["pid"], each["tid"])
        for each in labels
        if each["pid"] in devices
        and each["name"] == "thread_name"
        and each["args"]["name"].startswith(("Stream", "XLA Ops"))
    }
    rows: dict[str, Row] = {}
    for event in events:
        if event["ph"] == "X" and (event["pid"], event["tid"]) in streams:
            details = event.get("args", {})
            source = details.get("tf_op") or details.get("name") or details.get("hlo_op", "")
            row = rows.setdefault(event["name"], {"us": 0.0, "calls": 0.0, "kernel": event["name"], "source": source})
            row["us"] += event["dur"] / runs
            row["calls"] += 1 / runs
    return sorted(rows.values(), key=lambda row: -row["us"])
