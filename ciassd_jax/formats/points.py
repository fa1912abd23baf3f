"""Point clouds in `.bin` (KITTI), `.npy`, `.npz`, `.pcd` and `.ply` files.

`read_points` returns the values of the file; values that are not finite are left to the caller, and intensities to
`check_intensity`.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from ciassd_jax.formats.errors import InputError, Pathlike, read_bytes, warn_of_file
from ciassd_jax.formats.layout import guess_columns, looks_like_float64
from ciassd_jax.formats.pcd import read_pcd
from ciassd_jax.formats.ply import read_ply

POINT_SUFFIXES = (".bin", ".npy", ".npz", ".pcd", ".ply")

_COLUMNS = ("x", "y", "z", "intensity")
# The first of these that a file has is its intensity.
_INTENSITIES = ("intensity", "reflectivity", "reflectance", "i")
# Fewer points with more columns than this are points in columns.
_MAX_COLUMNS = 12
# No file has more.
_MOST_COLUMNS = 1000
# Largest intensities of common sensors and files.
_SCALES = (1.0, 100.0, 255.0, 4095.0, 65535.0)

NamedColumns = Sequence[tuple[str, np.ndarray]]


# Arbitrary bytes read as floats need no warnings of NumPy's arithmetic.
@np.errstate(over="ignore", invalid="ignore")
def read_points(path: Pathlike, columns: int | Sequence[str] | None = None) -> Float32[np.ndarray, "N 4"]:
    """Read a point cloud as (x, y, z, intensity), coordinates in metres.

    - `.bin`: little-endian float32.
    - `.npy`, `.npz`: numbers (N, 3 or more), or a structured array; in an archive the array `points`, or the only one.
    - `.pcd`: ascii, binary or binary_compressed.
    - `.ply`: the vertices, ascii or binary.

    `columns` describes the points of files that do not name their columns: how many numbers a point has, of which the
    first are x, y, z, intensity, or the names of all. It defaults to 4 for `.bin` and to what an array has. Of named
    columns, x, y, z and the first of intensity, reflectivity, reflectance, i are read, in any case and with or
    without CloudCompare's prefix `scalar_`. An intensity that is stored as a byte is divided by 255, its largest value.
    Without an intensity it is 0, with a FormatWarning.

    Raises InputError, one sentence with the remedy, for a file that is missing, empty or malformed, and for a `.bin`
    whose numbers make sense only with another number of columns.
    """
    suffix = Path(path).suffix.lower()
    width, names = (None, _COLUMNS) if columns is None else _column_names(columns)
    data = read_bytes(path)
    if suffix not in POINT_SUFFIXES:
        raise InputError(f"{path} has the unknown suffix '{suffix}'; convert it to one of {', '.join(POINT_SUFFIXES)}.")
    if not data:
        raise InputError(f"{path} is empty; copy or record it again.")
    if suffix == ".bin":
        return _pick_columns(_read_bin(data, path, width or 4, names), path)
    if suffix == ".pcd":
        return _pick_columns(read_pcd(data, path), path)
    if suffix == ".ply":
        return _pick_columns(read_ply(data, path), path)
    return _pick_columns(_name_columns(_read_numpy(data, path, archive=suffix == ".npz"), path, width, names), path)


def parse_columns(text: str) -> int | tuple[str, ...]:
    """Return what `read_points` takes as `columns` from a text such as "5" or "x,y,z,intensity,ring"."""
    words = tuple(word.strip() for word in text.split(","))
    return int(words[0]) if len(words) == 1 and words[0].isdecimal() else words


def write_bin(path: Pathlike, points: Float[np.ndarray, "N 4"]) -> None:
    """Write (x, y, z, intensity) as little-endian float32, KITTI's `.bin`."""
    Path(path).write_bytes(points.astype("<f4").tobytes())


def check_intensity(
    points: Float32[np.ndarray, "N 4"], scale: float, source: Pathlike
) -> tuple[Float32[np.ndarray, "N 4"], int]:
    """Return the points with intensities clipped to [0, scale], and how many were clipped.

    Intensities that are not finite or beyond 1000 times the scale are left: voxelisation drops and counts such points.
    Raises InputError if more than one point, and more than 1 % of them, have a finite intensity outside [0, scale].
    """
    intensity = points[:, 3]
    outside = ((intensity < 0) | (intensity > scale)) & np.isfinite(intensity)
    if not outside.any():
        return points, 0
    if outside.sum() > max(1, 0.01 * len(points)):
        fault = _intensity_fault(intensity[np.isfinite(intensity)], scale)
        raise InputError(f"{source} has {100 * outside.mean():.3g} % of its intensities {fault}")
    clipped = outside & (np.abs(intensity) <= 1000 * scale)
    points = points.copy()
    points[clipped, 3] = np.clip(points[clipped, 3], 0, scale)
    return points, int(clipped.sum())


def fitting_scale(largest: float) -> float:
    """Return the scale of intensities that reach `largest`: a usual one of at most three times that, or itself."""
    return next((scale for scale in _SCALES if largest <= scale <= 3 * largest), largest)


def _intensity_fault(intensity: Float32[np.ndarray, " N"], scale: float) -> str:
    """Say how finite intensities lie outside [0, scale], and the remedy."""
    fault = f"outside [0, {scale:g}], from {intensity.min():g} to {intensity.max():g}"
    if (intensity < 0).mean() > 0.005:
        return f"{fault}; save them without negative numbers, or name their column as `columns`."
    fit = fitting_scale(float(np.quantile(intensity, 0.999, method="higher")))
    values, counts = np.unique(intensity, return_counts=True)
    if len(values) <= 128 and values[-1] < 256 and (values % 1 == 0).all() and counts.max() < 3 * counts.mean():
        rings = "if they are ring numbers, pass names such as x,y,z,ring,intensity as `columns`"
        return f"{fault}; {rings}, else {fit:g} as `intensity_scale`."
    return f"{fault}; pass {fit:g} as `intensity_scale`."


def _column_names(columns: int | Sequence[str]) -> tuple[int, tuple[str, ...]]:
    """Return the number of columns and the names of all or the first four; raises InputError without x, y and z."""
    width, names = (columns, _COLUMNS[: max(columns, 0)]) if isinstance(columns, int) else (len(columns), columns)
    lower = [name.lower() for name in names]
    if width > _MOST_COLUMNS or any(lower.count(name) != 1 for name in "xyz"):
        text = columns if isinstance(columns, int) else ",".join(columns)
        raise InputError(
            f"{text} does not give x, y and z one column each; "
            f"pass a number from 3 to {_MOST_COLUMNS}, or names such as x,y,z,intensity,ring, as `columns`."
        )
    return width, tuple(names)


def _pick_columns(columns: NamedColumns, path: Pathlike) -> Float32[np.ndarray, "N 4"]:
    """Return x, y, z and the intensity, or 0 and a FormatWarning."""
    named: dict[str, np.ndarray] = {}
    for name, values in columns:
        named.setdefault(name.lower().removeprefix("scalar_"), values)
    found = _listed([name for name, _ in columns])
    if missing := [name for name in "xyz" if name not in named]:
        raise InputError(f"{path} has the columns {found} but not {', '.join(missing)}; save it again with x, y, z.")
    picked = [*"xyz", *[name for name in _INTENSITIES if name in named][:1]]
    points = np.zeros((len(named["x"]), 4), np.float32)
    for index, name in enumerate(picked):
        points[:, index] = named[name]
    if len(picked) == 4 and named[picked[3]].dtype == np.uint8:
        points[:, 3] /= 255
    if len(picked) == 3:
        text = f"{path} has no intensity among its columns {found}; 0 is used instead."
        warn_of_file(text, path, stacklevel=5)
    return points


def _listed(names: Sequence[str]) -> str:
    """Return names of a file on one line."""
    return ", ".join(ascii(name)[1:-1] for name in names)


def _read_bin(data: bytes, path: Pathlike, width: int, names: tuple[str, ...]) -> NamedColumns:
    if looks_like_float64(data):
        raise InputError(f"{path} holds float64 numbers, and a .bin is read as float32; save it as .npy.")
    numbers = np.frombuffer(data[: len(data) // 4 * 4], "<f4")
    guess = guess_columns(numbers, width)
    if guess != width and len(data) % (4 * guess) == 0:
        raise InputError(
            f"{path} makes no sense with {width} columns but does with {guess}; "
            f"pass {guess} as `columns`, or save it as .npy."
        )
    if len(data) % (4 * width):
        raise InputError(
            f"{path} has {len(data)} bytes, not a multiple of {4 * width} ({width} float32 per point); "
            "copy it again, or pass the correct number as `columns`."
        )
    return list(zip(names, numbers.reshape(-1, width).T, strict=False))


def _name_columns(array: np.ndarray, path: Pathlike, width: int | None, names: tuple[str, ...]) -> NamedColumns:
    """Return the columns of an array of numbers, or the fields of a structured one."""
    fields = [name for name in array.dtype.names or () if array.dtype[name].kind in "fiu"]
    if fields:
        return [(name, array[name].ravel()) for name in fields]
    if array.ndim != 2 or array.shape[1] < 3 or array.dtype.kind not in "fiu":
        raise InputError(
            f"{path} holds an array of shape {array.shape} and type {array.dtype}; "
            "save numbers of shape (N, 4): x, y, z, intensity."
        )
    rows, found = array.shape
    if rows < found > _MAX_COLUMNS and width != found:
        raise InputError(f"{path} holds an array of shape {array.shape}; transpose it to {(found, rows)}.")
    if width not in (None, found):
        raise InputError(f"{path} has {found} columns, not {width}; pass {found}, or as many names, as `columns`.")
    return list(zip(names, array.T, strict=False))


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
        f"{path} holds {len(names)} arrays ({_listed(names)}) and none is named 'points'; "
        "write it again with np.savez(path, points=points)."
    )
