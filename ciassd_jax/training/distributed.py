"""Data parallelism over the devices of one or several processes: the mesh, the placement of arrays, agreement.

The scenes of a batch are sharded over one axis of all devices, and the state is replicated. On a single device nothing
here changes the program.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from ciassd_jax.types import Scene

Value = TypeVar("Value")
Tree = TypeVar("Tree")
AXIS = "scenes"
# The code of a process that failed; smaller than the number of any signal that is handled.
FAILED = 1


class ParallelError(RuntimeError):
    """Processes and devices do not fit together, or another process failed; the message is one sentence."""


def connect(coordinator: str | None, num_processes: int | None, process_index: int | None) -> None:
    """Connect to the other processes; call this before anything that initialises JAX's devices.

    Without arguments, a SLURM step or TPU pod of several processes is joined and any other process runs alone. With
    the coordinator "auto", JAX finds all three in its cluster environment. Raises ParallelError if only some of the
    arguments are given, if the index is out of range, and if the other processes cannot be reached.
    """
    given = (coordinator, num_processes, process_index)
    automatic = given == ("auto", None, None) or (given == (None, None, None) and _is_cluster(os.environ))
    if given == (None, None, None) and not automatic:
        return
    if not automatic and (coordinator is None or num_processes is None or process_index is None):
        raise ParallelError("Coordinator, number of processes and process index go together; give all three.")
    if not automatic and not 0 <= process_index < num_processes:  # type: ignore[operator]
        raise ParallelError(
            f"There is no process {process_index} of {num_processes}; number the processes from 0 to "
            f"{num_processes - 1}."  # type: ignore[operator]
        )
    # JAX's preemption service would handle SIGTERM itself.
    jax.config.update("jax_enable_preemption_service", False)
    where = (None, None, None) if automatic else given
    try:
        jax.distributed.initialize(*where, shutdown_timeout_seconds=60)
    except (RuntimeError, ValueError) as error:
        reason = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
        raise ParallelError(
            f"The other processes cannot be reached ({reason[:200]}); check the coordinator's address and that every "
            "process was started."
        ) from error


def _is_cluster(environment: Mapping[str, str]) -> bool:
    """Whether this is one of several processes of a SLURM step or a TPU pod."""
    tasks, workers = environment.get("SLURM_STEP_NUM_TASKS", "1"), environment.get("TPU_WORKER_HOSTNAMES", "")
    return (tasks != "1" and "SLURM_PROCID" in environment) or "," in workers


def is_process_0() -> bool:
    """Whether this is process 0, which alone writes and logs."""
    return jax.process_index() == 0


def shard() -> tuple[int, int]:
    """Return (process index, number of processes), the `shard` of `make_batches`."""
    return jax.process_index(), jax.process_count()


def data_mesh(batch_size: int) -> Mesh:
    """Return a mesh with one axis over all devices; in a single process, over as many as divide the batch size.

    Raises ParallelError if the devices of several processes do not divide the batch size.
    """
    devices = sorted(jax.devices(), key=lambda device: (device.process_index, device.id))
    count = len(devices)
    if jax.process_count() == 1:
        count = next(n for n in range(count, 0, -1) if batch_size % n == 0)
    elif batch_size % count:
        raise ParallelError(
            f"{batch_size} scenes cannot be shared by the {count} devices of {jax.process_count()} processes; choose a "
            f"batch size that is a multiple of {count}."
        )
    return Mesh(np.array(devices[:count]), (AXIS,))


def describe(mesh: Mesh) -> str:
    """Describe the devices of a mesh, and why some are unused."""
    platform, available, processes = mesh.devices.flat[0].platform, len(jax.devices()), jax.process_count()
    if available == 1:
        return platform
    if mesh.size < available:
        return f"{mesh.size} of {available} {platform} devices (no larger number divides the batch size)"
    return f"{available} {platform} devices" + (f" of {processes} processes" if processes > 1 else "")


def replicated(mesh: Mesh) -> NamedSharding:
    """Return the sharding that places a whole array on every device."""
    return NamedSharding(mesh, PartitionSpec())


def replicate(tree: Tree, mesh: Mesh) -> Tree:
    """Copy a tree, equal in all processes, to every device; its leaves share no memory, so that they can be donated."""

    def on_host(leaf: Any) -> Any:
        # NumPy has no keys of random numbers, which the states of noisy optimizers hold.
        return leaf if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key) else np.array(leaf)

    return jax.device_put(jax.tree.map(on_host, tree), replicated(mesh), may_alias=False)


def shard_batch(batch: Scene, mesh: Mesh) -> Scene:
    """Return the global batch, sharded over the devices, from the rows of each process."""
    rows = NamedSharding(mesh, PartitionSpec(AXIS))
    if jax.process_count() == 1:
        return jax.device_put(batch, rows)
    return jax.tree.map(lambda leaf: jax.make_array_from_process_local_data(rows, np.asarray(leaf)), batch)


def shard_step(step: Callable[..., Any], mesh: Mesh) -> Callable[[Any, Scene], Any]:
    """Return `step(state, batch, axis_name=None)` jitted for a replicated state, which is donated, and a sharded batch.

    Each device runs the step on its own scenes and pools over the axis. Under automatic partitioning, every layer would
    gather the features of all scenes on all devices.
    """
    if mesh.size > 1:
        everywhere, rows = PartitionSpec(), PartitionSpec(AXIS)
        step = jax.shard_map(
            partial(step, axis_name=AXIS),
            mesh=mesh,
            in_specs=(everywhere, rows),
            out_specs=everywhere,
            # JAX cannot infer that the outputs are equal on all devices; the step pools them itself.
            check_vma=False,
        )
    return jax.jit(step, donate_argnums=0)


def max_over_processes(code: int) -> int:
    """Return the largest code of all processes; blocks until every process has called it."""
    if jax.process_count() == 1:
        return code
    return int(multihost_utils.process_allgather(np.int32(code)).max())


def on_process_0(work: Callable[[], Value]) -> Value | None:
    """Return `work()` on process 0; the others wait for it and return None.

    If `work` raises, process 0 raises the same error and the others raise ParallelError.
    """
    if not is_process_0():
        if max_over_processes(0):
            raise ParallelError("Process 0 failed and reports why; resume with the same command.")
        return None
    try:
        value = work()
    except BaseException:
        max_over_processes(FAILED)
        raise
    max_over_processes(0)
    return value


def broadcast_from_process_0(number: float | None) -> float | None:
    """Return process 0's number on all processes, rounded to float32 if there are several."""
    if jax.process_count() == 1:
        return number
    known: Any = multihost_utils.broadcast_one_to_all(np.float32(math.nan if number is None else number))
    return None if math.isnan(known) else float(known)
