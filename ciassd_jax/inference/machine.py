"""What a machine is, as far as speed and memory depend on it."""

from __future__ import annotations

import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax


def describe_machine() -> dict[str, Any]:
    """Return processor, cores, memory in bytes (None if unknown), devices, system and versions."""
    devices = jax.devices()
    return {
        "processor": processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory": total_memory(),
        "platform": devices[0].platform,
        "devices": [device.device_kind for device in devices],
        "system": platform.platform(),
        "python": platform.python_version(),
        **{name: version(name) for name in ("jax", "jaxlib", "ciassd_jax")},
    }


def has_device() -> bool:
    """Return whether JAX can start a device."""
    try:
        return bool(jax.devices())
    except (RuntimeError, AssertionError):
        # JAX's assertion fails if JAX_PLATFORMS names a platform that it knows and the machine lacks.
        return False


def processor() -> str:
    """Return the name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())


def total_memory() -> int | None:
    """Return the bytes of main memory, or None if the system does not say."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return None


def free_memory() -> int | None:
    """Return the bytes of main memory that programs can still take, or None if the system does not say."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable")), None)
