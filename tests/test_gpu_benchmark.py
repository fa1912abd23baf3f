"""`benchmarks/gpu.py`: what it concludes from made-up results, and all of it at toy size on the CPU."""

import gzip
import importlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from mini_folders import write_kitti
from xla_flags import xla_flags

from ciassd_jax.types import Boxes, Counts, Detections

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
# Missing on some machines with a GPU.
ABSENT = ("grain", "orbax", "tyro", "tqdm", "array_record")


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("gpu")


@pytest.fixture
def gpu_parts(gpu: ModuleType) -> ModuleType:
    return importlib.import_module("gpu_parts")


def event(name: str, line: tuple[int, int], duration: float, **details: str) -> dict[str, Any]:
    return {"ph": "X", "name": name, "pid": line[0], "tid": line[1], "ts": 0.0, "dur": duration, "args": details}


def label(kind: str, name: str, pid: int, **thread: int) -> dict[str, Any]:
    return {"ph": "M", "name": f"{kind}_name", "pid": pid, "args": {"name": name}} | thread


def test_kernels_are_those_of_the_streams_by_time_per_run(gpu_parts: ModuleType, tmp_path: Path) -> None:
    stream, copies, scopes, host = (1, 10), (1, 11), (1, 12), (2, 10)
    events = [
        label("process", "/device:GPU:0 (pid 1)", 1),
        label("process", "/host:CPU", 2),
        {"ph": "M", "name": "process_sort_index", "pid": 1, "args": {"sort_index": 1}},
        label("thread", "Stream #13(Compute)", 1, tid=10),
        label("thread", "Stream #14(MemcpyD2D)", 1, tid=11),
        label("thread", "Framework Name Scope", 1, tid=12),
        label("thread", "Stream of the host", 2, tid=10),
        event("fusion", stream, 3.0, tf_op="neck"),
        event("fusion", stream, 5.0, tf_op="neck"),
        event("gemm", stream, 20.0),
        event("copy", copies, 1.0),
        event("neck", scopes, 28.0),
        event("wait", host, 99.0),
        {},
    ]
    (tmp_path / "trace").write_bytes(gzip.compress(json.dumps({"traceEvents": events}).encode()))
    assert gpu_parts.read_kernels(tmp_path / "trace", runs=2) == [
        {"us": 10.0, "calls": 0.5, "kernel": "gemm", "source": ""},
        {"us": 4.0, "calls": 1.0, "kernel": "fusion", "source": "neck"},
        {"us": 0.5, "calls": 0.5, "kernel": "copy", "source": ""},
    ]


def detections(boxes: list[list[float]], points: int = 100) -> Detections:
    """Detections of one scene in four slots, all of score 0.5."""
    slots = np.zeros((1, 4, 7), np.float32)
    slots[0, : len(boxes)] = np.reshape(boxes, (-1, 7))
    counts = Counts(*(np.full((1, 2) if name.startswith("sites") else 1, points) for name in Counts._fields))
    one = np.array([len(boxes)], np.int32)
    return Detections(
        Boxes.from_array(slots), np.full((1, 4), 0.5, np.float32), np.zeros((1, 4), np.int32), one, counts
    )


def test_boxes_are_compared_with_the_nearest_in_any_order(gpu_parts: ModuleType) -> None:
    first, second = [10, 0, -1, 4, 2, 1.5, np.pi - 0.01], [20, 5, -1, 4, 2, 1.5, 0.5]
    turned = [10.03, 0, -1, 4, 2.2, 1.5, 0.02 - np.pi]
    found = gpu_parts.compare(detections([second, turned]), detections([first, second]))
    assert [found[name] for name in ("boxes", "cpu_boxes", "alone", "other_counts")] == [2, 2, 0, 0]
    np.testing.assert_allclose([found["center_m"], found["yaw_rad"], found["size"]], [0.03, 0.03, 0.1], atol=1e-5)


def test_boxes_without_a_pair_and_other_counts_are_counted(gpu_parts: ModuleType) -> None:
    first, second, lost = [10, 0, -1, 4, 2, 1.5, 0.0], [20, 5, -1, 4, 2, 1.5, 0.5], [np.nan] * 7
    assert gpu_parts.compare(detections([first]), detections([second]))["alone"] == 2
    assert gpu_parts.compare(detections([]), detections([first, second]))["alone"] == 2
    assert gpu_parts.compare(detections([lost]), detections([lost]))["alone"] == 2
    assert gpu_parts.compare(detections([]), detections([]))["alone"] == 0
    assert gpu_parts.compare(detections([first]), detections([first], points=99))["other_counts"] == 1


def test_a_part_that_fails_or_does_not_fit_leaves_a_row(
    gpu: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def works() -> Iterator[dict[str, Any]]:
        yield {"ms": 1.0}

    def fails() -> Iterator[dict[str, Any]]:
        yield {"ms": 2.0}
        raise MemoryError("no room\nfor this")

    def parts(*_: Any) -> list[tuple[str, str, Any]]:
        return [("predict", "a", fails), ("predict", "b", works), ("train_step", "c", works), ("peer", "d", works)]

    monkeypatch.setattr(gpu, "parts", parts)
    out, soon = tmp_path / "out.jsonl", time.monotonic() + gpu.GUESS + 5
    assert not gpu.run(gpu.SMOKE, ("predict", "peer"), out, soon)
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [(row["part"], row["what"]) for row in rows] == [
        ("predict", "a"),
        ("predict", "a"),
        ("predict", "b"),
        ("peer", "d"),
    ]
    assert rows[1]["error"] == "MemoryError: no room"
    assert gpu.run(gpu.SMOKE, ("train_step",), out, time.monotonic() + gpu.GUESS - 5)
    assert "skipped" in json.loads(out.read_text().splitlines()[-1])


@pytest.mark.slow
def test_every_part_runs_at_toy_size_without_the_packages_of_training(tmp_path: Path) -> None:
    write_kitti(tmp_path / "kitti", clouds="velodyne_reduced")
    out = tmp_path / "rows.jsonl"
    hide = f"sys.modules.update(dict.fromkeys({ABSENT}))"
    code = f"import runpy, sys; {hide}; runpy.run_path(sys.argv[0], run_name='__main__')"
    arguments = ["--smoke", "--frames", str(tmp_path / "kitti"), "--weights", "none", "--out", str(out)]
    start = f"import sys; sys.argv = {[str(BENCHMARKS / 'gpu.py'), *arguments]}; sys.path[0] = {str(BENCHMARKS)!r}; "
    environment = os.environ | {"XLA_FLAGS": xla_flags(devices=1, level=0)}
    subprocess.run([sys.executable, "-c", start + code], check=True, env=environment)
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert {row["part"] for row in rows} == {
        "machine",
        "agreement",
        "predict",
        "stages",
        "train_step",
        "kernels",
        "peer",
    }
    assert not any(row.keys() & {"error", "skipped"} for row in rows)
    (agreement,) = (row for row in rows if row["part"] == "agreement")
    assert agreement["alone"] == agreement["other_counts"] == 0
    assert all(row["median_ms"] > 0 for row in rows if row["part"] in ("predict", "stages", "train_step"))
