"""One update of the small network on several forced host devices, in float64, beside that on one device.

`python tests/devices.py [--all]`: on 2 by pmap and 4 by a sharded batch, or both ways on 1, 2, 4 and 8 (minutes).

Prints one JSON line: whether a checkpoint of one device has the same bits on four and the other way round; and for
every case the largest difference of gradients (relative to the largest gradient of a leaf), parameters, batch
statistics and metrics (relative). Run by test_step.py in a process of its own.
"""

import json
import os
import sys
import tempfile

from xla_flags import xla_flags

# The programs run twice each: optimising them fully would take most of the time.
os.environ["XLA_FLAGS"] = xla_flags(devices=8, level=1)
os.environ["JAX_PLATFORMS"] = "cpu"

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec, Sharding
from small import random_scene, random_variables, small_config

from ciassd_jax import create_train_state, train_step
from ciassd_jax.data.loader import LoaderState
from ciassd_jax.training.checkpoint import Checkpoints
from ciassd_jax.types import Scene

SCENES = 8
FEW = (("pmap", 2), ("sharded", 4))
ALL = tuple((how, devices) for how in ("pmap", "sharded") for devices in (1, 2, 4, 8))
CONFIG = replace(small_config(), dtype="float64")


def scenes(kind: str) -> Scene:
    """Eight scenes with ever more points; of "one empty" the first has neither points nor boxes."""
    each = []
    for i in range(SCENES):
        scene = random_scene(small_config(), i)
        count = np.int32(scene.cloud.count * (i + 1) // SCENES)
        truth = scene.truth
        if kind == "one empty" and i == 0:
            count, truth = np.int32(0), truth._replace(count=np.int32(0), label=np.full_like(truth.label, -1))
        each.append(scene._replace(cloud=scene.cloud._replace(count=count), truth=truth))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *each)


def largest(mine, reference, *, relative: bool) -> float:
    def difference(a, b) -> float:
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        return float(np.abs(a - b).max() / (max(np.abs(b).max(), 1e-12) if relative else 1))

    return max(jax.tree.leaves(jax.tree.map(difference, mine, reference)))


def gradient_of(state):
    """Adam's first moment after one step: the clipped, averaged gradient but for a factor."""
    return state.optimizer[1].inner_state.mu


@cache
def mapped(devices: int):
    step = partial(train_step, config=CONFIG, axis_name="devices")
    return jax.pmap(step, "devices", devices=jax.devices()[:devices])


def on_pmap(state, batch: Scene, devices: int):
    split = jax.tree.map(lambda leaf: leaf.reshape(devices, -1, *leaf.shape[1:]), batch)
    copies = jax.tree.map(lambda leaf: jnp.stack([leaf] * devices), state)
    return jax.tree.map(lambda leaf: leaf[0], mapped(devices)(copies, split))


def on_mesh(state, batch: Scene, devices: int):
    mesh = Mesh(np.array(jax.devices()[:devices]), ("scenes",))
    split = jax.device_put(batch, NamedSharding(mesh, PartitionSpec("scenes")))
    whole = jax.device_put(state, NamedSharding(mesh, PartitionSpec()))
    return jax.jit(train_step, static_argnames="config")(whole, split, CONFIG)


def restores(state, saved: Sharding, restored: Sharding) -> bool:
    """Whether a state saved from some devices comes back to others, with the same bits and on all of them."""
    with tempfile.TemporaryDirectory() as folder, Checkpoints(folder, CONFIG) as checkpoints:
        checkpoints.save(jax.device_put(state, saved), LoaderState(0, 0, SCENES, 1, 0))
        checkpoints.wait()
        found = checkpoints.restore(jax.device_put(state, restored))
    assert found is not None
    same = jax.tree.map(lambda a, b: bool((np.asarray(a) == np.asarray(b)).all()), found.state, state)
    return jax.tree.all(same) and {leaf.sharding for leaf in jax.tree.leaves(found.state)} == {restored}


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    wide = partial(jax.tree.map, lambda leaf: np.asarray(leaf, np.float64))
    state = create_train_state(jax.random.key(0), CONFIG, variables=wide(random_variables(small_config())))
    one, four = (NamedSharding(Mesh(np.array(jax.devices()[:n]), ("scenes",)), PartitionSpec()) for n in (1, 4))
    found = {"restored": {"1 to 4": restores(state, one, four), "4 to 1": restores(state, four, one)}}
    alone = jax.jit(train_step, static_argnames="config")
    for kind in ("unequal", "one empty"):
        batch = scenes(kind)
        reference, expected = alone(state, batch, CONFIG)
        for how, devices in ALL if "--all" in sys.argv else FEW:
            after, metrics = {"pmap": on_pmap, "sharded": on_mesh}[how](state, batch, devices)
            found[f"{how} {devices} {kind}"] = {
                "gradient": largest(gradient_of(after), gradient_of(reference), relative=True),
                "params": largest(after.params, reference.params, relative=False),
                "batch_stats": largest(after.batch_stats, reference.batch_stats, relative=True),
                "metrics": largest(metrics, expected, relative=True),
            }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
