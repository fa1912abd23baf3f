"""The file of an exported `predict`: a zip of `manifest.json`, `program.bin` and `golden.npz`, stored uncompressed.

The manifest describes inputs and outputs in the order of the call, and has the class names, the config, the platforms
and the versions. `golden.npz` holds an input as `inputs.NAME`, its output as `outputs.NAME`, and the `tolerance` of
outputs in floats.
"""

from __future__ import annotations

import io
import json
import platform
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from math import prod
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import export

from ciassd_jax.config import Config
from ciassd_jax.formats.errors import InputError, Pathlike, read_bytes
from ciassd_jax.formats.writing import replacing

FORMAT, VERSION = "ciassd_jax export", 1
INPUTS = ("points", "count", "frustum")
_MANIFEST, _PROGRAM, _GOLDEN = "manifest.json", "program.bin", "golden.npz"
AGAIN = "write it again with `ciassd export`"
_MEANINGS = {
    "points": "x, y, z in metres (x forward, z up), intensity up to config.input.intensity_scale",
    "count": "number of rows that are real",
    "frustum": "half-spaces a x + b y + c z + d > 0 that a box centre must lie in; rows of zeros do not limit",
    "boxes": "x, y, z of the centre, length, width, height in metres, yaw in [-pi, pi); best score first",
    "score": "confidence: the class probability times a power of the predicted IoU",
    "label": "index into class_names",
    "points_given": "points of the cloud",
    "points_in_range": "points inside the grid",
    "points_dropped": "points that are not finite, have an impossible intensity or lie in a dropped voxel",
    "voxels_kept": "voxels used",
    "voxels_dropped": "voxels over capacity",
    "sites_kept": "sites used by each stage of the backbone",
    "sites_dropped": "sites over capacity of each stage",
    "candidates_kept": "boxes above the score threshold before suppression",
    "candidates_dropped": "such boxes over capacity",
}


class Golden(NamedTuple):
    """An input, its output, and how much an output in floats may differ from it."""

    inputs: dict[str, np.ndarray]
    outputs: dict[str, np.ndarray]
    tolerance: float


class Artefact(NamedTuple):
    """The contents of a file."""

    manifest: dict[str, Any]
    program: export.Exported
    golden: Golden


def describe(program: export.Exported, config: Config) -> dict[str, Any]:
    """Return the manifest of a program of (points, count, frustum) that returns arrays by name."""
    outputs = jax.tree.unflatten(program.out_tree, program.out_avals)
    return {
        "format": FORMAT,
        "format_version": VERSION,
        "inputs": [_describe(name, aval) for name, aval in zip(INPUTS, program.in_avals, strict=True)],
        "outputs": [_describe(name, aval) for name, aval in outputs.items()],
        "class_names": list(config.class_names),
        "platforms": list(program.platforms),
        "calling_convention_version": program.calling_convention_version,
        "versions": {name: version(name) for name in ("jax", "ciassd_jax")} | {"python": platform.python_version()},
        "config": json.loads(config.to_json()),
    }


def config_of(manifest: Mapping[str, Any]) -> Config:
    """Return the config of a manifest; raises ValueError for another value."""
    return Config.from_json(json.dumps(manifest["config"]))


def _describe(name: str, aval: Any) -> dict[str, Any]:
    return {"name": name, "shape": list(aval.shape), "type": aval.dtype.name, "meaning": _MEANINGS[name]}


def write_artefact(path: Pathlike, artefact: Artefact) -> None:
    """Write an artefact, whole or not at all; raises InputError if it cannot be written."""
    manifest, program, golden = artefact
    arrays = {f"inputs.{name}": value for name, value in golden.inputs.items()}
    arrays |= {f"outputs.{name}": value for name, value in golden.outputs.items()}
    arrays["tolerance"] = np.array(golden.tolerance, np.float32)
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=False, **arrays)
    contents = (json.dumps(manifest, indent=1).encode(), bytes(program.serialize()), stream.getvalue())
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, content in zip((_MANIFEST, _PROGRAM, _GOLDEN), contents, strict=True):
            # Without a date, so that equal contents make equal files.
            archive.writestr(zipfile.ZipInfo(name), content)


def read_artefact(path: Pathlike) -> Artefact:
    """Read an artefact; raises InputError, with the remedy, for a file that `write_artefact` does not write."""
    read_bytes(path, 0)
    with _refusing(path, "is no exported detector"), zipfile.ZipFile(path) as archive:
        contents = [_read_member(archive, name) for name in (_MANIFEST, _PROGRAM, _GOLDEN)]
    with _refusing(path, f"has a damaged {_MANIFEST}"):
        manifest = json.loads(contents[0])
        _check_version(manifest, path)
        config = config_of(manifest)
    with _refusing(path, f"has a {_PROGRAM} that JAX {jax.__version__} cannot read"):
        program = export.deserialize(bytearray(contents[1]))
        actual = describe(program, config)
    with _refusing(path, f"has a {_MANIFEST} that does not describe its program"):
        _check_manifest(manifest, actual)
    with _refusing(path, f"has a damaged {_GOLDEN}"):
        return Artefact(manifest, program, _read_golden(contents[2], actual))


def misfit(found: Mapping[str, Any], golden: Golden) -> str | None:
    """Return which output differs most from the golden one and by how much, or None if all are within the tolerance.

    Integers must be equal. Angles differ modulo 2 pi.
    """
    wrong = []
    for name, expected in golden.outputs.items():
        change = np.abs(np.asarray(found[name], np.float64) - expected)
        if name == "boxes":
            change[..., 6] = np.minimum(change[..., 6], 2 * np.pi - change[..., 6])
        allowed = golden.tolerance if expected.dtype.kind == "f" else 0
        # Not `>`, so that NaN differs too.
        if not (change <= allowed).all():
            wrong.append((float(np.nan_to_num(change, nan=np.inf).max()), name, allowed))
    if not wrong:
        return None
    largest, name, allowed = max(wrong)
    return f"{name} differs by up to {largest:.3g} where {allowed:g} is allowed"


@contextmanager
def _refusing(path: Pathlike, problem: str) -> Iterator[None]:
    """Raise InputError for whatever goes wrong: a damaged file may raise anything in zipfile, NumPy or JAX."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = str(error.args[0] if error.args else type(error).__name__).partition("\n")[0].rstrip(".")
        raise InputError(f"{path} {problem} ({reason}); {AGAIN}.") from error


def _read_member(archive: zipfile.ZipFile, name: str) -> bytes:
    info = archive.getinfo(name)
    # What is stored is no larger than the file.
    if info.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"{name} is compressed")
    return archive.read(info)


def _check_version(manifest: Any, path: Pathlike) -> None:
    if manifest["format"] != FORMAT:
        raise ValueError(f"its format is {manifest['format']!r}")
    if manifest["format_version"] != VERSION:
        raise InputError(
            f"{path} has version {manifest['format_version']} of the format, and ciassd_jax {version('ciassd_jax')} "
            f"reads version {VERSION}; {AGAIN}."
        )


def _check_manifest(manifest: dict[str, Any], actual: dict[str, Any]) -> None:
    """Raise ValueError for a manifest that says other than the program and the config do."""
    for name in ("inputs", "outputs"):
        given, own = ([(one["name"], one["shape"], one["type"]) for one in side[name]] for side in (manifest, actual))
        if given != own:
            raise ValueError(f"{name} differ")
    for name in ("class_names", "platforms"):
        if manifest[name] != actual[name]:
            raise ValueError(f"{name} differ")


def _read_golden(content: bytes, manifest: dict[str, Any]) -> Golden:
    """Read arrays of the shapes in the manifest, and nothing larger."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:

        def read(group: str) -> dict[str, np.ndarray]:
            return {
                one["name"]: _read_array(archive, f"{group}.{one['name']}.npy", tuple(one["shape"]), one["type"])
                for one in manifest[group]
            }

        tolerance = _read_array(archive, "tolerance.npy", (), "float32")
        return Golden(read("inputs"), read("outputs"), float(tolerance))


def _read_array(archive: zipfile.ZipFile, name: str, shape: tuple[int, ...], kind: str) -> np.ndarray:
    dtype = np.dtype(kind)
    with archive.open(name) as stream:
        np.lib.format.read_magic(stream)
        given = np.lib.format.read_array_header_1_0(stream)
        if given != (shape, False, dtype):
            raise ValueError(f"{name} has the shape {given[0]} and type {given[2]} instead of {shape} and {dtype}")
        return np.frombuffer(stream.read(prod(shape) * dtype.itemsize), dtype).reshape(shape)
