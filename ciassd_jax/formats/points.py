"""Point clouds in `.bin` (KITTI), `.npy`, `.npz`, `.pcd` and `.ply` files.

Readers return the values of the file; what they are worth (NaN, `check_intensity`) is judged by the caller.
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32

from ciassd_jax.formats.errors import FormatWarning, InputError, Pathlike, read_bytes

POINT_SUFFIXES = (".bin", ".npy", ".npz", ".pcd", ".ply")

_INTENSITY_FIELDS = ("intensity", "reflectance", "i")
_PCD_KINDS = {"F": "f", "I": "i", "U": "u"}


# Arbitrary bytes read as floats need no warnings of NumPy's arithmetic.
@np.errstate(over="ignore", invalid="ignore")
def read_points(path: Pathlike, columns: int | Sequence[str] | None = None) -> Float32[np.ndarray, "N 4"]:
    """Read a point cloud as (x, y, z, intensity), coordinates in metres.

    - `.bin`: little-endian float32, `columns` (4 if None) numbers per point.
    - `.npy`, `.npz`: an array (N, 3 or more); in an archive the array `points`, or the only one.
    - `.pcd`: ascii or binary, fields x, y, z and one of intensity, reflectance, i.

    Columns after the fourth are ignored. A missing intensity becomes 0, with a FormatWarning. Raises InputError, one
    sentence with the remedy, for a file that is missing, empty or malformed.
    """
    width = columns if isinstance(columns, int) else 4 if columns is None else len(columns)
    if width < 3:
        raise InputError(f"{path}: {width} columns are too few; pass at least x,y,z as `columns`.")
    suffix = Path(path).suffix.lower()
    data = read_bytes(path)
    if suffix not in POINT_SUFFIXES:
        raise InputError(f"{path} has the unknown suffix '{suffix}'; convert it to one of {', '.join(POINT_SUFFIXES)}.")
    if not data:
        raise InputError(f"{path} is empty; copy or record it again.")
    if suffix == ".bin":
        array = _read_bin(data, path, width)
    elif suffix == ".pcd":
        array = _read_pcd(data, path)
    elif suffix == ".ply":
        raise InputError(f"{path} is not read yet; save it as .npy.")
    else:
        array = _read_numpy(data, path, archive=suffix == ".npz")
    return _as_points(array, path)


def parse_columns(text: str) -> int | tuple[str, ...]:
    """Parse "5" or "x,y,z,intensity,ring" into what `read_points` takes as `columns`."""
    text = text.strip()
    return int(text) if text.isdecimal() else tuple(name.strip() for name in text.split(","))


def check_intensity(
    points: Float32[np.ndarray, "N 4"], scale: float, source: Pathlike
) -> tuple[Float32[np.ndarray, "N 4"], int]:
    """Return points with intensities clipped to [0, scale], and how many were clipped.

    Raises InputError if more than 1 % lie outside. Intensities beyond 1000 times the scale are left for the
    voxelisation to drop and count.
    """
    intensity = points[:, 3]
    outside = (intensity < 0) | (intensity > scale)
    if outside.sum() > len(points) / 100:
        raise InputError(
            f"{source} has {outside.mean():.0%} of its intensities outside [0, {scale:g}], up to {intensity.max():g}; "
            f"pass {intensity.max():g} as `intensity_scale`."
        )
    clipped = outside & (np.abs(intensity) <= 1000 * scale)
    if not clipped.any():
        return points, 0
    points = points.copy()
    points[clipped, 3] = np.clip(points[clipped, 3], 0, scale)
    return points, int(clipped.sum())


def write_bin(path: Pathlike, points: Float[np.ndarray, "N 4"]) -> None:
    """Write (x, y, z, intensity) as little-endian float32, KITTI's `.bin`."""
    Path(path).write_bytes(points.astype("<f4").tobytes())


def scale_intensity(points: Float32[np.ndarray, "N 4"]) -> tuple[Float32[np.ndarray, "N 4"], float | None]:
    """Return points with intensity in [0, 1], and its largest value before if it had to be scaled, else None.

    Intensities are divided by 255 if they exceed 2.
    """
    intensity = points[:, 3]
    top = float(intensity.max(initial=0, where=np.isfinite(intensity)))
    if top <= 2:
        return points, None
    return np.concatenate([points[:, :3], points[:, 3:] / np.float32(255)], 1), top


def _as_points(array: np.ndarray, path: Pathlike) -> Float32[np.ndarray, "N 4"]:
    """Return the first four columns, or three and intensity 0."""
    if array.ndim != 2 or array.shape[1] < 3 or array.dtype.kind not in "fiu":
        raise InputError(
            f"{path} holds an array of shape {array.shape} and type {array.dtype}; "
            "save numbers of shape (N, 4): x, y, z, intensity."
        )
    points = np.zeros((len(array), 4), np.float32)
    columns = min(array.shape[1], 4)
    if columns == 3:
        warnings.warn(f"{path} has no intensity; 0 is used instead.", FormatWarning, stacklevel=4)
    points[:, :columns] = array[:, :columns]
    return points


def _read_bin(data: bytes, path: Pathlike, width: int) -> Float32[np.ndarray, "N width"]:
    if len(data) % (4 * width):
        raise InputError(
            f"{path} has {len(data)} bytes, not a multiple of {4 * width} ({width} float32 per point); "
            "copy it again, or pass the correct number as `columns`."
        )
    return np.frombuffer(data, "<f4").reshape(-1, width)


def _read_numpy(data: bytes, path: Pathlike, *, archive: bool) -> np.ndarray:
    """Read an array, or the array `points` or only array of an archive, without unpickling anything."""
    try:
        if not archive:
            return np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            names = arrays.files
            if "points" in names or len(names) == 1:
                return np.asarray(arrays["points" if "points" in names else names[0]])
    except Exception as error:  # on malformed bytes NumPy and zipfile raise half a dozen types of error
        raise InputError(
            f"{path} is cut short or not a {'.npz' if archive else '.npy'} file of plain numbers; "
            f"write it again with np.{'savez' if archive else 'save'}."
        ) from error
    raise InputError(
        f"{path} holds {len(names)} arrays ({', '.join(names)}) and none is named 'points'; "
        "write it again with np.savez(path, points=points)."
    )


class _PcdField(NamedTuple):
    """The position of a field in a row, by byte and by column, and its type."""

    offset: int
    column: int
    dtype: np.dtype


class _PcdHeader(NamedTuple):
    """Fields by name, bytes and columns per row, number of rows, and how the rows are stored."""

    fields: dict[str, _PcdField]
    stride: int
    columns: int
    num_points: int
    storage: str


def _read_pcd(data: bytes, path: Pathlike) -> Float[np.ndarray, "N columns"]:
    header, body = _read_pcd_header(data, path)
    missing = [name for name in "xyz" if name not in header.fields]
    if missing:
        raise InputError(
            f"{path} has the fields {', '.join(header.fields)} but not {', '.join(missing)}; "
            "save it again with x, y, z and intensity."
        )
    intensity = [name for name in _INTENSITY_FIELDS if name in header.fields][:1]
    fields = [header.fields[name] for name in ("x", "y", "z", *intensity)]
    if header.storage == "ascii":
        return _read_pcd_ascii(body, path, header, fields)
    if header.storage == "binary":
        return _read_pcd_binary(body, path, header, fields)
    raise InputError(
        f"{path} stores its points as '{header.storage}', which is not read; "
        f"convert it with `pcl_convert_pcd_ascii_binary {path} out.pcd 1`."
    )


def _read_pcd_ascii(
    body: bytes, path: Pathlike, header: _PcdHeader, fields: list[_PcdField]
) -> Float[np.ndarray, "N columns"]:
    try:
        values = np.array(body.split(), np.float64)
    except ValueError as error:
        raise InputError(f"{path} has a point that is not a number; save it again.") from error
    if values.size != header.num_points * header.columns:
        raise InputError(
            f"{path} announces {header.num_points} points of {header.columns} numbers "
            f"but holds {values.size} numbers; copy or save it again."
        )
    return values.reshape(-1, header.columns)[:, [field.column for field in fields]]


def _read_pcd_binary(
    body: bytes, path: Pathlike, header: _PcdHeader, fields: list[_PcdField]
) -> Float[np.ndarray, "N columns"]:
    # A few bytes after the last point are allowed, because some writers end the file with a newline.
    if len(body) // header.stride != header.num_points:
        raise InputError(
            f"{path} announces {header.num_points} points of {header.stride} bytes "
            f"but holds {len(body)} bytes; copy or save it again."
        )
    names = [str(field.column) for field in fields]
    formats, offsets = [field.dtype for field in fields], [field.offset for field in fields]
    row = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": header.stride})
    rows = np.frombuffer(body, row, count=header.num_points)
    return np.stack([rows[name].astype(np.float64) for name in names], -1)


def _read_pcd_header(data: bytes, path: Pathlike) -> tuple[_PcdHeader, bytes]:
    """Split a PCD file into its header and the bytes after it."""
    entries: dict[str, list[str]] = {}
    stream = io.BytesIO(data)
    for line in stream:
        key, *values = line.decode("latin-1").split() or ["#"]
        entries[key] = values
        if key == "DATA":
            break
    try:
        return _parse_pcd_header(entries), stream.read()
    except (LookupError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} has a malformed PCD header ({str(error)[:80]}); "
            "save it again with FIELDS, SIZE, TYPE, WIDTH, HEIGHT, POINTS and DATA."
        ) from error


def _parse_pcd_header(entries: dict[str, list[str]]) -> _PcdHeader:
    """Parse the entries; raises LookupError, TypeError or ValueError for a missing or invalid one."""
    names = entries["FIELDS"]
    counts = [int(count) for count in entries.get("COUNT", ["1"] * len(names))]
    fields: dict[str, _PcdField] = {}
    stride = columns = 0
    for name, size, kind, count in zip(names, entries["SIZE"], entries["TYPE"], counts, strict=True):
        if int(size) < 1 or count < 1:
            raise ValueError(f"field {name} has size {size} and count {count}")
        fields.setdefault(name, _PcdField(stride, columns, np.dtype(f"<{_PCD_KINDS[kind]}{size}")))
        stride += int(size) * count
        columns += count
    sizes = ["POINTS"] if "POINTS" in entries else ["WIDTH", "HEIGHT"]
    rows = math.prod(int(entries[key][0]) for key in sizes)
    if rows < 0 or not 0 < stride < 2**31:
        raise ValueError(f"{rows} points of {stride} bytes")
    (storage,) = entries["DATA"]
    return _PcdHeader(fields, stride, columns, rows, storage)
