"""Training on several devices of several processes: their mesh, what lies where, and how the processes agree.

The scenes of a batch are spread over one axis of all devices, and the state is on each of them. With one process on one
device nothing here changes anything.
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
# What a process says to the others that cannot go on; the number of a signal is larger.
FAILED = 1


class ParallelError(RuntimeError):
    """Processes and devices do not fit together, or one of them cannot go on; the message is one sentence."""


def connect(coordinator: str | None, num_processes: int | None, process_index: int | None) -> None:
    """Join the other processes, before anything else that asks JAX for a device.

    Without arguments the environment decides: a step of SLURM or a TPU pod of several processes is joined, anything
    else runs alone. The coordinator "auto" takes all three numbers from whatever cluster JAX finds. Raises
    ParallelError for arguments that do not fit together and where the others cannot be reached.
    """
    given = (coordinator, num_processes, process_index)
    automatic = given == ("auto", None, None) or (given == (None, None, None) and _is_cluster(os.environ))
    if given == (None, None, None) and not automatic:
        return
    if not automatic and (coordinator is None or num_processes is None or process_index is None):
        raise ParallelError("A coordinator, the number of processes and this one's index go together; give all three.")
    if not automatic and not 0 <= process_index < num_processes:  # type: ignore[operator]
        raise ParallelError(
            f"There is no process {process_index} of {num_processes}; number them from 0 to their number less one."
        )
    # It would take SIGTERM for itself.
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
    """Whether SLURM's srun, or a TPU pod, started several processes and this is one of them."""
    tasks, workers = environment.get("SLURM_STEP_NUM_TASKS", "1"), environment.get("TPU_WORKER_HOSTNAMES", "")
    return (tasks != "1" and "SLURM_PROCID" in environment) or "," in workers


def is_first() -> bool:
    """Whether this is the process that writes and speaks for all."""
    return jax.process_index() == 0


def shard() -> tuple[int, int]:
    """This process's index and their number, as `make_batches` takes them."""
    return jax.process_index(), jax.process_count()


def data_mesh(batch_size: int) -> Mesh:
    """All devices of all processes in one axis; of a single process as many as divide the batch.

    Raises ParallelError for a batch that several processes cannot share evenly.
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
    """The devices in words, and why some are left out."""
    platform, there, processes = mesh.devices.flat[0].platform, len(jax.devices()), jax.process_count()
    if there == 1:
        return platform
    if mesh.size < there:
        return f"{mesh.size} of {there} {platform} devices (no more divide the batch)"
    return f"{there} {platform} devices" + (f" of {processes} processes" if processes > 1 else "")


def replicated(mesh: Mesh) -> NamedSharding:
    """Everything on every device."""
    return NamedSharding(mesh, PartitionSpec())


def replicate(tree: Tree, mesh: Mesh) -> Tree:
    """A copy of a tree, the same in all processes, on every device; its leaves can be donated, as none share memory."""
    return jax.device_put(jax.tree.map(np.array, tree), replicated(mesh), may_alias=False)


def shard_batch(batch: Scene, mesh: Mesh) -> Scene:
    """The whole batch, spread over the devices, from the rows that each process has."""
    rows = NamedSharding(mesh, PartitionSpec(AXIS))
    if jax.process_count() == 1:
        return jax.device_put(batch, rows)
    return jax.tree.map(lambda leaf: jax.make_array_from_process_local_data(rows, np.asarray(leaf)), batch)


def shard_step(step: Callable[..., Any], mesh: Mesh) -> Callable[[Any, Scene], Any]:
    """A step (state, batch, axis_name=None) on a state and a batch that are spread so, jitted; the state is given up.

    Each device runs the step on its own scenes and pools what must be pooled over the axis. Left to the compiler, a
    sharded batch would have the features of all scenes gathered on all devices in every layer.
    """
    if mesh.size > 1:
        everywhere, rows = PartitionSpec(), PartitionSpec(AXIS)
        step = jax.shard_map(
            partial(step, axis_name=AXIS),
            mesh=mesh,
            in_specs=(everywhere, rows),
            out_specs=everywhere,
            # That the outputs are equal is the step's promise, as under pmap.
            check_vma=False,
        )
    return jax.jit(step, donate_argnums=0)


def agreed(code: int) -> int:
    """The largest of what the processes say, once each has said something; all must call it equally often."""
    if jax.process_count() == 1:
        return code
    return int(multihost_utils.process_allgather(np.int32(code)).max())


def on_first(work: Callable[[], Value]) -> Value | None:
    """What `work` returns on the first process; the others wait for it and get None.

    An error of it is raised there, and ParallelError on the others.
    """
    if not is_first():
        if agreed(0):
            raise ParallelError("The first process cannot go on, and says why; the same command goes on once it can.")
        return None
    try:
        value = work()
    except BaseException:
        agreed(FAILED)
        raise
    agreed(0)
    return value


def from_first(number: float | None) -> float | None:
    """The first process's number on all of them, in single precision where there are several."""
    if jax.process_count() == 1:
        return number
    known: Any = multihost_utils.broadcast_one_to_all(np.float32(math.nan if number is None else number))
    return None if math.isnan(known) else float(known)
