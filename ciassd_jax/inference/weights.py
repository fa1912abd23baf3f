"""Weights files: safetensors of this package, read and written, and the authors' published checkpoints, read.

A file of this package holds the variables as `params/...` and `batch_stats/...`, and the config and class names as
metadata: all that `predict` needs.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import safetensors
import safetensors.numpy

from ciassd_jax.config import Config
from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.lines import read_text
from ciassd_jax.formats.torch_file import read_torch_file
from ciassd_jax.formats.writing import replacing
from ciassd_jax.inference.released_weights import (
    Rules,
    Tensors,
    released_config,
    released_rules,
    released_tensors,
)
from ciassd_jax.model.network import variable_shapes
from ciassd_jax.types import Variables

FORMAT = "ciassd_jax weights 1"
BUNDLED = Path(__file__).parents[1] / "bundled"


class TensorReport(NamedTuple):
    """The name of a tensor in the file and here, its shape in the file, and its status.

    The status is "mapped" (used as it is), "transposed" or "counter" (not needed). A file with any other is refused.
    """

    source: str
    target: str
    shape: tuple[int, ...]
    status: str


class Weights(NamedTuple):
    """Variables, their config, and a report on each tensor of the file."""

    variables: Variables
    config: Config
    report: list[TensorReport]


def load_weights(path: str | os.PathLike[str]) -> Weights:
    """Read a `.safetensors` file of this package, or a released `.pth`.

    Raises InputError if the file lacks a tensor or has another one, and for a wrong shape or a value that is not
    finite.
    """
    if Path(path).suffix != ".safetensors":
        return _load_released(read_torch_file(path), path)
    tensors, metadata = _read_safetensors(path)
    return _assemble(tensors, {name: (name, ()) for name in tensors}, _config_in(metadata, path), path)


def read_config(path: str | os.PathLike[str]) -> Config:
    """Read the config of a weights file, or a JSON file of `Config.to_json`.

    Raises InputError for a file without a valid config.
    """
    suffix = Path(path).suffix
    if suffix == ".json":
        try:
            return Config.from_json(read_text(path))
        except InputError:
            raise
        except ValueError as error:
            raise InputError(f"{path} is not a config: {error}") from error
    if suffix != ".safetensors":
        return load_weights(path).config
    return _config_in(_read_safetensors(path)[1], path)


def load_released_weights(path: str | os.PathLike[str]) -> Weights:
    """Read a released model from a `.pth`, or from a `.safetensors` with the released names.

    Raises InputError for any other file.
    """
    if Path(path).suffix != ".safetensors":
        return _load_released(read_torch_file(path), path)
    tensors, metadata = _read_safetensors(path)
    if "config" in metadata:
        raise InputError(f"{path} is already a weights file of this package; use it as it is.")
    return _load_released(tensors, path)


def save_weights(
    path: str | os.PathLike[str], variables: Variables, config: Config, *, half_kernels: bool = False
) -> None:
    """Write a weights file, whole or not at all: the variables, and the config and class names as metadata.

    Tensors are float32. `half_kernels` stores the kernels as float16, which halves the file. Raises InputError for a
    kernel that exceeds float16, and for a file that cannot be written.
    """
    flat = {_name(keys): np.asarray(leaf) for keys, leaf in _leaves(variables)}
    if half_kernels:
        largest = float(np.finfo(np.float16).max)
        for name in [name for name in flat if name.endswith("/kernel")]:
            if not np.abs(flat[name]).max() <= largest:
                raise InputError(f"{name} exceeds {largest:.0f}, the largest float16; write the file in float32.")
            flat[name] = flat[name].astype(np.float16)
    metadata = {"format": FORMAT, "config": config.to_json(), "class_names": json.dumps(config.class_names)}
    with replacing(path) as temporary:
        temporary.write_bytes(safetensors.numpy.save(flat, metadata=metadata))


def find_weights(path_or_name: str | os.PathLike[str]) -> Path:
    """Return the file of bundled weights for a name without suffix or folder, and a path unchanged."""
    path = Path(path_or_name)
    if path.suffix or len(path.parts) > 1:
        return path
    bundled = sorted(p.stem for p in BUNDLED.glob("*.safetensors"))
    if path.name not in bundled:
        raise InputError(
            f"No bundled weights are named {path.name!r} (available: {', '.join(bundled) or 'none'}); give another "
            "name, or the path of a weights file."
        )
    return BUNDLED / f"{path.name}.safetensors"


def check_fits(weights: Weights, config: Config, path: str | os.PathLike[str]) -> None:
    """Raise InputError unless the weights have exactly the parameters of `config`."""
    given = {_name(keys): np.shape(leaf) for keys, leaf in _leaves(weights.variables)}
    expected = _expected_shapes(config)
    wrong = sorted(name for name in given.keys() | expected.keys() if given.get(name) != expected.get(name))
    if wrong:
        name = wrong[0]
        raise InputError(
            f"{path} holds weights for another config: {name} is {given.get(name, 'absent')} in the file and "
            f"{expected.get(name, 'absent')} in the config ({len(wrong)} tensors differ); use the config of the file, "
            "or other weights."
        )


def _read_safetensors(path: str | os.PathLike[str]) -> tuple[Tensors, dict[str, str]]:
    if not Path(path).is_file():
        raise InputError(f"{path} is not a file; check the path.")
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118
    except (safetensors.SafetensorError, OSError) as error:
        raise InputError(f"{path} is not a complete safetensors file ({error}); download or write it again.") from error


def _config_in(metadata: Mapping[str, str], path: str | os.PathLike[str]) -> Config:
    if "config" not in metadata:
        raise InputError(
            f"{path} has no config in its metadata; convert it with `ciassd convert {path} OUT.safetensors` and use "
            "the new file."
        )
    try:
        return Config.from_json(metadata["config"])
    except ValueError as error:
        raise InputError(f"{path} was written for another version of the package: {error}") from error


def _load_released(content: Mapping[str, Any], path: str | os.PathLike[str]) -> Weights:
    tensors = released_tensors(content, path)
    return _assemble(tensors, released_rules(tensors, path), released_config(tensors), path)


def _assemble(tensors: Tensors, rules: Rules, config: Config, path: str | os.PathLike[str]) -> Weights:
    """Rename, transpose and nest the tensors; raise InputError unless they are exactly those of the config."""
    expected = _expected_shapes(config)
    found: dict[str, np.ndarray] = {}
    report = []
    for source, value in tensors.items():
        target, axes = rules.get(source, (source, ()))
        moved = axes != tuple(range(len(axes))) and value.ndim == len(axes)
        found[target] = value.transpose(axes) if moved else value
        if not target:
            status = "counter"
        elif source not in rules or target not in expected:
            status = "unexpected"
        elif found[target].shape != expected[target]:
            status = f"shape differs, expected {expected[target]}"
        elif not np.isfinite(value).all():
            status = "not finite"
        else:
            status = "transposed" if moved else "mapped"
        report.append(TensorReport(source, target, value.shape, status))
    report += [TensorReport("", name, shape, "missing") for name, shape in expected.items() if name not in found]
    wrong = [row for row in report if row.status not in ("mapped", "transposed", "counter")]
    if wrong:
        shown = "; ".join(f"{row.source or row.target} {row.shape}: {row.status}" for row in wrong[:3])
        raise InputError(
            f"{path} does not fit its model in {len(wrong)} of {len(report)} tensors ({shown}); "
            "give the complete file that belongs to this config."
        )
    return Weights(_nest({name: np.ascontiguousarray(found[name], np.float32) for name in expected}), config, report)


def _nest(flat: dict[str, np.ndarray]) -> Variables:
    """Return nested dictionaries from names like `params/head/box/kernel`."""
    nested: dict[str, Any] = {}
    for name, array in flat.items():
        *parents, leaf = name.split("/")
        place = nested
        for parent in parents:
            place = place.setdefault(parent, {})
        place[leaf] = array
    return nested


def _expected_shapes(config: Config) -> dict[str, tuple[int, ...]]:
    return {_name(keys): leaf.shape for keys, leaf in _leaves(variable_shapes(config.for_inference()))}


def _leaves(tree: Variables) -> list[tuple[tuple, Any]]:
    return jax.tree_util.tree_flatten_with_path(tree)[0]


def _name(keys: tuple) -> str:
    return "/".join(key.key for key in keys)
