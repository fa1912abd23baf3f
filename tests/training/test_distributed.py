"""Several devices and processes: the same update, a common stop, and checkpoints that any number of them resumes."""

import json
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
import pytest
from jax.sharding import PartitionSpec
from mini_training import write_data
from small import small_config

from ciassd_jax.model.network import variable_shapes
from ciassd_jax.training import distributed
from ciassd_jax.training.distributed import ParallelError, connect, data_mesh, describe

PROGRAM = [sys.executable, str(Path(__file__).parents[1] / "processes.py")]


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("localhost", 0))
        return one.getsockname()[1]


def run_together(*commands: Sequence[object]) -> list[tuple[int, str, str]]:
    """Exit code, output and errors of `processes.py`, started with each of these at once."""
    started = [
        subprocess.Popen([*PROGRAM, *map(str, command)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for command in commands
    ]
    try:
        ended = [process.communicate(timeout=400) for process in started]
    finally:
        for process in started:
            process.kill()
    return [(process.returncode, *texts) for process, texts in zip(started, ended, strict=True)]


@pytest.mark.slow
def test_two_processes_make_the_same_update(tmp_path: Path) -> None:
    """Gradients to 1e-6 relative and parameters to 1e-5, in float64."""
    address = f"localhost:{free_port()}"
    for ended in (
        run_together(*(("update", tmp_path / "two.npz", address, 2, index) for index in range(2))),
        run_together(("update", tmp_path / "one.npz")),
    ):
        assert [code for code, _, _ in ended] == [0] * len(ended), ended
    one, two = np.load(tmp_path / "one.npz"), np.load(tmp_path / "two.npz")
    assert set(one) == set(two)
    for name in one:
        difference, largest = np.abs(two[name] - one[name]).max(), np.abs(one[name]).max()
        limit = 1e-5 if "params" in name else 1e-6 * max(largest, 1e-12)
        assert difference <= limit, name


@pytest.mark.slow
def test_two_processes_stop_together_and_one_resumes(tmp_path: Path) -> None:
    data, workdir = write_data(tmp_path / "data"), tmp_path / "run"
    options = ("--preset", "tiny", "--data", data, "--workdir", workdir, "--batch-size", 2, "--steps", 6)
    options += ("--log-every", 1, "--evaluate-every", 2)
    together = ("--coordinator", f"localhost:{free_port()}", "--num-processes", 2, "--process-index")
    # Only the second process gets the signal.
    first, second = run_together(*(("train", 5 * index, *options, *together, index) for index in range(2)))
    assert (first[0], second[0]) == (143, 143), (first, second)
    assert "Compiled the step of 2 scenes for 2 cpu devices of 2 processes in " in first[1]
    assert "Stopped by SIGTERM after step 4, which is saved" in first[1]
    assert "step" not in second[1]
    assert "Traceback" not in first[2] + second[2]

    ((code, logged, errors),) = run_together(("train", 0, *options))
    assert code == 0, errors
    assert "Resuming from step 4 in " in logged
    lines = [json.loads(line) for line in (workdir / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines if "loss" in line] == [1, 2, 3, 4, 5, 6]
    assert [line["step"] for line in lines if "score" in line] == [3, 6]


def test_shapes_that_a_sharded_step_asks_for_have_no_mesh() -> None:
    variable_shapes.cache_clear()
    found = []

    def step(scene: jax.Array) -> jax.Array:
        found.append(variable_shapes(small_config()))
        return scene

    rows = PartitionSpec(distributed.AXIS)
    jax.eval_shape(jax.shard_map(step, mesh=data_mesh(2), in_specs=rows, out_specs=rows), np.zeros(2))
    assert {leaf.sharding for leaf in jax.tree.leaves(found[0])} == {None}


def test_a_single_process_uses_as_many_devices_as_divide_the_batch() -> None:
    assert len(jax.devices()) == 2
    for batch_size, devices, words in (
        (4, 2, "2 cpu devices"),
        (3, 1, "1 of 2 cpu devices (no larger number divides the batch size)"),
    ):
        mesh = data_mesh(batch_size)
        assert (mesh.size, describe(mesh)) == (devices, words)


def test_several_processes_must_share_a_batch_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    assert data_mesh(4).size == 2
    with pytest.raises(ParallelError, match=r"^3 scenes cannot be shared by the 2 devices of 2 processes; .*of 2\.$"):
        data_mesh(3)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("localhost:1", None, None), "go together; give all three"),
        ((None, 2, 0), "go together; give all three"),
        (("localhost:1", 2, 2), "no process 2 of 2"),
        (("auto", None, None), "cannot be reached"),
    ],
)
def test_an_unusable_coordinator_is_one_sentence(given: tuple, words: str) -> None:
    with pytest.raises(ParallelError, match=words):
        connect(*given)


@pytest.mark.parametrize(
    ("environment", "several"),
    [
        ({}, False),
        ({"SLURM_STEP_NUM_TASKS": "1", "SLURM_PROCID": "0"}, False),
        ({"SLURM_STEP_NUM_TASKS": "4", "SLURM_PROCID": "3"}, True),
        ({"TPU_WORKER_HOSTNAMES": "localhost"}, False),
        ({"TPU_WORKER_HOSTNAMES": "one,two"}, True),
    ],
)
def test_a_cluster_is_recognised_by_its_environment(environment: dict[str, str], several: bool) -> None:
    assert distributed._is_cluster(environment) is several
