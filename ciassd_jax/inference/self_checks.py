"""Checks of a machine and an installation: can they run the package?"""

from __future__ import annotations

import math
import platform
import re
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from functools import partial
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from ciassd_jax.config.presets import tiny
from ciassd_jax.data.frames import Dataset, Frame
from ciassd_jax.data.loader import Rows, Stream, host_batches
from ciassd_jax.inference.machine import describe_machine, free_memory, has_device, total_memory
from ciassd_jax.inference.programs import compile_program, for_this_backend
from ciassd_jax.model.network import RawPredictions, predict_raw, variable_shapes
from ciassd_jax.types import Boxes, PointCloud, Variables

# The oldest and the newest version that the tests ran with.
_TESTED = {
    "python": ("3.11", "3.13"),
    "jax": ("0.10.2", "0.12.0"),
    "jaxlib": ("0.10.2", "0.12.0"),
    "flax": ("0.12.8", "0.12.12"),
    "optax": ("0.2.8", "0.2.8"),
    "orbax-checkpoint": ("0.12.8", "0.12.8"),
    "numpy": ("2.4", "2.5"),
    "grain": ("0.2.18", "0.2.18"),
}
# Bytes of memory and of disk that the smallest useful run needs.
_ENOUGH = 1e9
# Seconds for a worker to start; one core needs about 5.
_PATIENCE = 60.0
# What `_forward` computes: the occupied voxels, and the mean absolute value of each output.
_VOXELS = 453
_MEANS = {"box": 3.20800e-3, "class_logit": 2.88910e-3, "direction": 2.97946e-3, "iou": 4.29304e-3}
# Relative. In float32 the forms of the program for CPUs and for accelerators differ by 1e-6.
_TOLERANCE = 1e-3


class Finding(NamedTuple):
    """What a check found. A "note" is no failure; it and a "FAIL" end with what to do."""

    state: Literal["ok", "note", "FAIL"]
    text: str


class Check(NamedTuple):
    """A check; if it raises, what is wrong then, and what to do."""

    find: Callable[[], Iterator[Finding]]
    broken: str
    remedy: str


def run_check(check: Check) -> list[Finding]:
    """Run a check; whatever it raises is a failure."""
    try:
        return list(check.find())
    except Exception as error:
        # JAX's assertions have no text.
        reason = f" ({text})" if (text := str(error).partition("\n")[0].rstrip(".")) else ""
        return [Finding("FAIL", f"{check.broken}{reason}; {check.remedy}.")]


def _versions() -> Iterator[Finding]:
    """Are the packages new enough, and did the tests run with them?"""
    needed = {name: least for name, least, extra in _requirements() if not extra}
    found = {"python": platform.python_version()} | {name: version(name) for name in ("ciassd_jax", "jaxlib", *needed)}
    yield Finding("ok", ", ".join(f"{name} {found[name]}" for name in ("ciassd_jax", *_TESTED) if name in found))
    for name, least in needed.items():
        if _number(found[name]) < _number(least):
            remedy = f"pip install -U '{name}>={least}'"
            yield Finding("FAIL", f"{name} {found[name]} is older than {least}, the oldest that works; {remedy}.")
    for name, (oldest, newest) in _TESTED.items():
        mine = _number(found[name])
        if mine < _number(oldest) or mine[: newest.count(".") + 1] > _number(newest):
            yield Finding(
                "note", f"{name} {found[name]} was not tested; if something fails, install {oldest} to {newest}."
            )


def _requirements() -> list[tuple[str, str, str]]:
    """Name, oldest version and extra (or "") of each package that the installation names."""
    pattern = re.compile(r'([\w-]+)>=([\d.]+)(?:; extra == "(\w+)")?')
    found = [pattern.fullmatch(one) for one in requires("ciassd_jax") or ()]
    return [(one[1], one[2], one[3] or "") for one in found if one]


def _number(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", text.partition("+")[0])[:3])


def _devices() -> Iterator[Finding]:
    machine = describe_machine()
    kinds = machine["devices"]
    yield Finding(
        "ok", f"{machine['platform']}: {len(kinds)} x {kinds[0]}; {machine['processor']}, {machine['cores']} cores"
    )
    for device in jax.local_devices():
        if stats := device.memory_stats():
            yield Finding("ok", f"{device.device_kind} has {_gb(stats['bytes_limit'])} of memory for JAX")
    if machine["platform"] == "cpu" and Path("/dev/nvidia0").exists():
        remedy = "pip install 'ciassd_jax[cuda]', and unset JAX_PLATFORMS"
        yield Finding("note", f"This machine has an NVIDIA GPU, and JAX does not use it; {remedy}.")


def _memory() -> Iterator[Finding]:
    total, free = total_memory(), free_memory()
    sizes = [f"{_gb(size)} {what}" for size, what in ((free, "free"), (total, "in all")) if size is not None]
    yield Finding("ok", ", ".join(sizes) or "this system does not tell")
    if free is not None and free < _ENOUGH:
        yield Finding("FAIL", f"Detection needs {_gb(_ENOUGH)}; close other programs.")


def _disk() -> Iterator[Finding]:
    folders = {"here": Path.cwd()} | ({} if (cache := _cache_folder()) is None else {"compilation cache": cache})
    for name, folder in folders.items():
        existing = next(path for path in (folder, *folder.parents) if path.exists())
        free = shutil.disk_usage(existing).free
        yield Finding("ok", f"{_gb(free)} free {name} ({folder})")
        if free < _ENOUGH:
            yield Finding("FAIL", f"Programs and weights need {_gb(_ENOUGH)}; free some space in {existing}.")


def _cache() -> Iterator[Finding]:
    """Can compiled programs be kept?"""
    if not jax.config.jax_enable_compilation_cache:  # type: ignore[attr-defined]
        yield Finding("note", "Off, so every process compiles anew; unset JAX_ENABLE_COMPILATION_CACHE.")
        return
    folder = _cache_folder()
    if folder is None:
        raise ValueError("~/.cache cannot be written")
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder):
        files = [path.stat().st_size for path in folder.iterdir() if path.is_file()]
    yield Finding("ok", f"{folder} is writable and holds {sum(files) / 1e6:.0f} MB in {len(files)} files")


def _cache_folder() -> Path | None:
    """The folder of the compilation cache; None if `keep_programs` found none that can be written."""
    folder = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    return None if folder is None else Path(folder).absolute()


def _worker() -> Iterator[Finding]:
    """Does a worker process of the loader start and return a scene?"""
    start = time.perf_counter()
    stream = Stream(Dataset(("000000",), _frame), tiny(), seed=0, augmented=False)
    batches = host_batches(Rows(stream, batch_size=1), workers=1)
    done: Future[Any] = Future()

    def take() -> None:
        try:
            done.set_result(next(batches))
        except BaseException as error:
            done.set_exception(error)

    try:
        # A daemon, so that a worker that never answers does not keep the program.
        threading.Thread(target=take, daemon=True).start()
        given = int(done.result(_PATIENCE).scene.cloud.count[0])
    finally:
        batches.close()
    if given != len(_points()):
        raise ValueError(f"the worker returned {given} of {len(_points())} points")
    yield Finding("ok", f"a worker process started and returned a scene in {time.perf_counter() - start:.1f} s")


def _frame(name: str) -> Frame:
    none = Boxes(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    return Frame(name, _points(), none, (), np.zeros(0, np.int64), None)


def _points() -> np.ndarray:
    """Points within the range of `tiny()`."""
    k = np.arange(500)
    columns = (6 + 4 * np.sin(k), 4 * np.cos(2.3 * k), np.sin(0.7 * k) - 1, 0.5 + 0.5 * np.cos(k))
    return np.stack(columns, -1).astype(np.float32)


def _weights() -> Variables:
    """Weights that no random generator draws, so that every version of every library has the same."""
    shapes = jax.tree_util.tree_flatten_with_path(variable_shapes(tiny().for_inference()))
    leaves = []
    for number, (keys, leaf) in enumerate(shapes[0]):
        if keys[-1].key == "kernel":
            values = np.cos(np.arange(leaf.size) ** 2 % 1009 + number) * math.sqrt(4 / math.prod(leaf.shape[:-1]))
        else:
            values = np.full(leaf.size, keys[-1].key in ("scale", "var"))
        leaves.append(values.reshape(leaf.shape).astype(np.float32))
    return jax.tree.unflatten(shapes[1], leaves)


def forward() -> tuple[int, dict[str, float]]:
    """Run the network of `tiny()`; return the occupied voxels and the mean absolute value of each output."""
    config = for_this_backend(tiny().for_inference())
    cloud = PointCloud(_points()[None], np.array([len(_points())], np.int32))
    program = compile_program(jax.jit(partial(predict_raw, config=config)), _weights(), cloud, what="a tiny network")
    raw: RawPredictions = jax.device_get(program(_weights(), cloud))
    return int(raw.voxels.count[0]), {name: float(np.abs(x).mean()) for name, x in raw.predictions._asdict().items()}


def _forward() -> Iterator[Finding]:
    """Does a forward pass give the stored result?"""
    if not has_device():
        yield Finding("note", "Not run, because there is no device; see devices.")
        return
    start = time.perf_counter()
    voxels, means = forward()
    worst = float(np.max([abs(means[name] / mean - 1) for name, mean in _MEANS.items()]))
    if voxels != _VOXELS or not worst <= _TOLERANCE:
        raise ValueError(f"{voxels} voxels instead of {_VOXELS}, and outputs that are off by {worst:.1e}")
    seconds = time.perf_counter() - start
    yield Finding("ok", f"a tiny network gives the stored result to {worst:.0e}; {seconds:.1f} s with compilation")


def _extras() -> Iterator[Finding]:
    for extra, use in (("viz", "pictures and 3D pages"), ("tb", "TensorBoard events")):
        missing = [name for name, _, of in _requirements() if of == extra and not _installed(name)]
        if missing:
            remedy = f"pip install 'ciassd_jax[{extra}]'"
            yield Finding("note", f"Without {', '.join(missing)} there are no {use}; {remedy}.")
        else:
            yield Finding("ok", f"{extra} for {use}")


def _installed(name: str) -> bool:
    try:
        return bool(version(name))
    except PackageNotFoundError:
        return False


def _gb(size: float) -> str:
    return f"{size / 1e9:.1f} GB"


CHECKS = {
    "versions": Check(_versions, "A package is missing", "install ciassd_jax again, as its README says"),
    "devices": Check(
        _devices,
        "JAX finds no device",
        "set JAX_PLATFORMS=cpu, or install the driver and pip install 'ciassd_jax[cuda]'",
    ),
    "memory": Check(_memory, "The memory cannot be read", "compare with what your system says"),
    "disk": Check(_disk, "The disk cannot be read", "run in a folder that exists"),
    "cache": Check(
        _cache, "Compiled programs cannot be kept", "set JAX_COMPILATION_CACHE_DIR to a folder that can be written"
    ),
    "workers": Check(_worker, "No worker process answers", "train with --workers 0, which reads in a thread"),
    "forward": Check(
        _forward,
        "A tiny network does not give the stored result",
        "install other versions of jax and jaxlib, or set JAX_PLATFORMS=cpu",
    ),
    "extras": Check(_extras, "The extras cannot be read", "install ciassd_jax again, as its README says"),
}
