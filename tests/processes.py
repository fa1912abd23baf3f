"""One of several processes that train together; `test_distributed.py` starts them.

`python tests/processes.py update OUT [COORDINATOR COUNT INDEX]` makes one update of the small network in float64 and
writes gradients, parameters and metrics to OUT. `train STOP ARGUMENTS` runs `ciassd train` with the small network in
place of `tiny`, and sends itself SIGTERM before the step STOP (0: never).
"""

import os
import signal
import sys
from functools import partial
from pathlib import Path

from devices import CONFIG, gradient_of, scenes
from xla_flags import xla_flags

# After `devices`, which asks for eight. At level 0 one update in float64 takes longer than its compilation.
os.environ["XLA_FLAGS"] = xla_flags(devices=1, level=int(sys.argv[1] == "update"))

import jax
import numpy as np
from mini_training import mini_config
from small import random_variables, small_config

from ciassd_jax import create_train_state, train_step
from ciassd_jax.cli import main
from ciassd_jax.config.presets import PRESETS
from ciassd_jax.training import distributed


def update(out: Path) -> None:
    """Make one update of eight scenes, which the processes share."""
    jax.config.update("jax_enable_x64", True)
    batch, (index, count) = scenes("one empty"), distributed.shard()
    share = len(batch.frame) // count
    rows = jax.tree.map(lambda leaf: leaf[index * share : (index + 1) * share], batch)
    mesh = distributed.data_mesh(len(batch.frame))
    wide = partial(jax.tree.map, lambda leaf: np.asarray(leaf, np.float64))
    state = create_train_state(jax.random.key(0), CONFIG, variables=wide(random_variables(small_config())))
    step = distributed.shard_step(partial(train_step, config=CONFIG), mesh)
    after, metrics = step(distributed.replicate(state, mesh), distributed.shard_batch(rows, mesh))
    found = {"gradient": gradient_of(after), "params": after.params, "metrics": metrics}
    if distributed.is_process_0():
        leaves = jax.tree_util.tree_leaves_with_path(jax.device_get(found))
        np.savez(out, **{jax.tree_util.keystr(path): leaf for path, leaf in leaves})


def train(stop: int, arguments: list[str]) -> int:
    """Run `ciassd train`, with SIGTERM before the step `stop`."""
    PRESETS["tiny"] = mini_config
    original, calls = distributed.shard_batch, []

    def shard_batch(*given):
        calls.append(None)
        if len(calls) == stop:
            signal.raise_signal(signal.SIGTERM)
        return original(*given)

    distributed.shard_batch = shard_batch
    return main(["train", *arguments])


if __name__ == "__main__":
    what, first, *others = sys.argv[1:]
    if what == "train":
        sys.exit(train(int(first), others))
    if others:
        distributed.connect(others[0], int(others[1]), int(others[2]))
    update(Path(first))
