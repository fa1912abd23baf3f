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
from ciassd_jax.model.network import init_variables, variable_shapes
from ciassd_jax.types import Variables

FORMAT = "ciassd_jax weights 1"
BUNDLED = Path(__file__).parents[1] / "bundled"


class TensorReport(NamedTuple):
    """The name of a tensor in the file and here, its shape in both (None where it is absent), and its status.

    The status is "mapped" (used as it is), "transposed" or "counter" (not needed); in a partial load also "fresh: not
    in the file", "fresh: other shape" or "left: not in the config".
    """

    source: str
    target: str
    shape: tuple[int, ...] | None
    expected: tuple[int, ...] | None
    status: str


class Weights(NamedTuple):
    """Variables, their config, and a report on each tensor of the file and of the config."""

    variables: Variables
    config: Config
    report: list[TensorReport]

    def __repr__(self) -> str:
        numbers = sum(np.size(leaf) for leaf in jax.tree.leaves(self.variables))
        classes = ", ".join(self.config.class_names)
        return f"Weights(variables={{{numbers:,} numbers}}, config={{{classes}}}, report=[{len(self.report)} tensors])"


class _File(NamedTuple):
    """The tensors of a file, their names here, and the config that it was written for."""

    tensors: Tensors
    rules: Rules
    config: Config


def load_weights(
    path: str | os.PathLike[str], config: Config | None = None, partial: bool = False, key: jax.Array | None = None
) -> Weights:
    """Read a `.safetensors` file of this package, a released `.pth`, or bundled weights by name, such as "car_lite".

    The tensors must be exactly those of `config`, by default the file's own. With `partial`, those whose name and shape
    fit are taken, and the others are drawn from `key` (by default `jax.random.key(0)`) as by `init_variables`; the
    report says which.

    Raises InputError for a file that cannot be read, tensors that do not fit, and values that are not finite.
    """
    if partial and config is None:
        raise ValueError("`partial` loads the tensors that fit a `config`; give both.")
    path = find_weights(path)
    return _assemble(_read(path), path, config, partial, key)


def read_config(path: str | os.PathLike[str]) -> Config:
    """Read the config of weights, as for `load_weights`, or a JSON file of `Config.to_json`.

    Raises InputError for a file without a valid config.
    """
    path = find_weights(path)
    suffix = path.suffix
    if suffix == ".json":
        try:
            return Config.from_json(read_text(path))
        except InputError:
            raise
        except ValueError as error:
            raise InputError(f"{path} is not a config: {error}") from error
    if suffix != ".safetensors":
        return _read(path).config
    return _config_in(_read_safetensors(path)[1], path)


def load_released_weights(path: str | os.PathLike[str]) -> Weights:
    """Read a released model from a `.pth`, or from a `.safetensors` with the released names.

    Raises InputError for any other file.
    """
    if Path(path).suffix != ".safetensors":
        return _assemble(_read(path), path)
    tensors, metadata = _read_safetensors(path)
    if "config" in metadata:
        raise InputError(f"{path} is already a weights file of this package; use it as it is.")
    return _assemble(_released(tensors, path), path)


def save_weights(
    path: str | os.PathLike[str], variables: Variables, config: Config, *, half_kernels: bool = False
) -> None:
    """Write a weights file, whole or not at all: the variables, and the config and class names as metadata.

    Tensors are float32. `half_kernels` stores the kernels as float16, which halves the file. Raises InputError for a
    kernel that exceeds float16, and for a file that cannot be written.
    """
    flat = {name: np.asarray(leaf) for name, leaf in _flat(variables).items()}
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


def _read(path: str | os.PathLike[str]) -> _File:
    if Path(path).suffix != ".safetensors":
        return _released(read_torch_file(path), path)
    tensors, metadata = _read_safetensors(path)
    return _File(tensors, {name: (name, ()) for name in tensors}, _config_in(metadata, path))


def _released(content: Mapping[str, Any], path: str | os.PathLike[str]) -> _File:
    tensors = released_tensors(content, path)
    return _File(tensors, released_rules(tensors, path), released_config(tensors))


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


def _assemble(
    file: _File,
    path: str | os.PathLike[str],
    config: Config | None = None,
    partial: bool = False,
    key: jax.Array | None = None,
) -> Weights:
    """Rename, transpose and nest the tensors that fit; refuse any other unless `partial`."""
    chosen = config or file.config
    shapes = {name: leaf.shape for name, leaf in _flat(variable_shapes(chosen.for_inference())).items()}
    report, found = _match(file, shapes)
    if bad := [row.source for row in report if row.status == "not finite"]:
        raise InputError(f"{path} has values that are not finite in {_some(bad)}; give other weights.")
    misfits = [row for row in report if row.status.startswith(("fresh", "left"))]
    some = _some([_describe(row) for row in misfits])
    if misfits and not partial:
        misfit = f"{len(misfits)} of {len(report)} tensors: {some}"
        if config is None:
            raise InputError(f"{path} does not fit its model in {misfit}; give the complete file.")
        raise InputError(
            f"{path} does not fit the config in {misfit}; use the config of the file, or `partial` to take what fits."
        )
    if not found:
        raise InputError(f"No tensor of {path} fits the config: {some}; use the config of the file, or other weights.")
    if misfits:
        found = _flat(init_variables(jax.random.key(0) if key is None else key, chosen)) | found
    return Weights(_nest({name: np.ascontiguousarray(found[name], np.float32) for name in shapes}), chosen, report)


def _match(file: _File, shapes: Mapping[str, tuple[int, ...]]) -> tuple[list[TensorReport], dict[str, np.ndarray]]:
    """Report on each tensor of the file and of the config, and return those that fit under their names here."""
    report, found = [], {}
    for source, value in file.tensors.items():
        target, axes = file.rules.get(source, (source, ()))
        moved = axes != tuple(range(len(axes))) and value.ndim == len(axes)
        array = value.transpose(axes) if moved else value
        expected = shapes.get(target) if source in file.rules else None
        if not target:
            status = "counter"
        elif not _is_finite(value):
            status = "not finite"
        elif expected is None:
            status = "left: not in the config"
        elif array.shape != expected:
            status = "fresh: other shape"
        else:
            status, found[target] = "transposed" if moved else "mapped", array
        report.append(TensorReport(source, target, value.shape, expected, status))
    reported = {row.target for row in report if row.expected is not None}
    absent = [name for name in shapes if name not in reported]
    return report + [TensorReport("", name, None, shapes[name], "fresh: not in the file") for name in absent], found


@np.errstate(over="ignore")
def _is_finite(value: np.ndarray) -> bool:
    """Whether the values are finite in float32, which they are used in."""
    return bool(np.isfinite(value.astype(np.float32, copy=False)).all())


def _describe(row: TensorReport) -> str:
    here, there = ("absent" if shape is None else shape for shape in (row.expected, row.shape))
    return f"{row.source or row.target} is {there} in the file and {here} in the config"


def _some(texts: list[str]) -> str:
    """The first three texts."""
    return ", ".join(texts[:3]) + (", ..." if len(texts) > 3 else "")


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


def _flat(tree: Variables) -> dict[str, Any]:
    """Return the leaves by names like `params/head/box/kernel`."""
    return {"/".join(key.key for key in keys): leaf for keys, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]}
