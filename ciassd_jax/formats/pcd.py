"""PCD files of the Point Cloud Library: ascii, binary and binary_compressed."""

from __future__ import annotations

import io
import math
from typing import NamedTuple

import numpy as np

from ciassd_jax.formats.errors import InputError, Pathlike

_KINDS = {"F": "f", "I": "i", "U": "u"}


class _Field(NamedTuple):
    """A field: its name, its type, how many values a row has of it, and how many bytes and values stand before it."""

    name: str
    dtype: np.dtype
    width: int
    offset: int
    column: int


class _Header(NamedTuple):
    """The fields, the number of rows, the bytes and values of a row, and how the rows are stored."""

    fields: tuple[_Field, ...]
    rows: int
    stride: int
    columns: int
    storage: str


def read_pcd(data: bytes, path: Pathlike) -> list[tuple[str, np.ndarray]]:
    """Return the name and the values of each field, the first value of fields with several.

    Raises InputError, which names `path`, for malformed data.
    """
    header, body = _read_header(data, path)
    if header.storage == "ascii":
        return _read_ascii(body, header, path)
    if header.storage == "binary":
        # A few bytes after the last point are allowed, because some writers end the file with a newline.
        if len(body) // header.stride != header.rows:
            raise InputError(
                f"{path} announces {header.rows} points of {header.stride} bytes "
                f"but holds {len(body)} bytes; copy or save it again."
            )
        places = [(field.offset, header.stride) for field in header.fields]
    elif header.storage == "binary_compressed":
        body = _decompress(body, header.rows * header.stride, path)
        # Here the values of one field stand together.
        places = [(field.offset * header.rows, field.dtype.itemsize * field.width) for field in header.fields]
    else:
        raise InputError(
            f"{path} stores its points as '{header.storage}'; save it as ascii, binary or binary_compressed."
        )
    return [
        (field.name, np.ndarray(header.rows, field.dtype, body, offset if header.rows else 0, (step,)))
        for field, (offset, step) in zip(header.fields, places, strict=True)
    ]


def decompress_lzf(data: bytes, size: int) -> bytes:
    """Decompress LZF data to exactly `size` bytes; raises ValueError for data that is malformed or gives another size.

    A control byte below 32 starts a literal run, any other a copy of earlier output.
    """
    output, at = bytearray(), 0
    while at < len(data) and len(output) <= size:
        control, at = data[at], at + 1
        if control < 32:
            output += data[at : at + control + 1]
            at += control + 1
            continue
        length, distance = control >> 5, (control & 31) << 8
        if length == 7 and at < len(data):
            length, at = 7 + data[at], at + 1
        if at >= len(data) or (distance := distance + data[at] + 1) > len(output):
            raise ValueError("the compressed data points outside itself")
        at, length, start = at + 1, length + 2, len(output) - distance
        piece = output[start : start + length]
        # A copy may reach into its own output, which then repeats.
        output += piece if length <= distance else (piece * (length // distance + 1))[:length]
    if at != len(data) or len(output) != size:
        raise ValueError(f"the compressed data does not give {size} bytes")
    return bytes(output)


def _decompress(body: bytes, size: int, path: Pathlike) -> bytes:
    """Decompress the points, which are preceded by their sizes as two uint32."""
    packed, unpacked = np.frombuffer(body[:8].ljust(8, b"\0"), "<u4").tolist()
    if len(body) < 8 + packed:
        raise InputError(f"{path} is cut short; copy or save it again.")
    if unpacked != size:
        raise InputError(f"{path} announces {size} bytes but holds {unpacked}; copy or save it again.")
    try:
        return decompress_lzf(body[8 : 8 + packed], size)
    except ValueError as error:
        raise InputError(f"{path} is damaged: {error}; copy or save it again.") from error


def _read_ascii(body: bytes, header: _Header, path: Pathlike) -> list[tuple[str, np.ndarray]]:
    """Read the fields as float64, or as bytes where the header says so."""
    try:
        values = np.array(body.split(), np.float64)
    except ValueError as error:
        raise InputError(f"{path} has a point that is not a number; save it again.") from error
    if values.size != header.rows * header.columns:
        raise InputError(
            f"{path} announces {header.rows} points of {header.columns} numbers "
            f"but holds {values.size} numbers; copy or save it again."
        )
    fields = []
    for field in header.fields:
        column = values.reshape(-1, header.columns)[:, field.column]
        is_byte = field.dtype == np.uint8 and ((column >= 0) & (column <= 255)).all()
        fields.append((field.name, column.astype(np.uint8) if is_byte else column))
    return fields


def _read_header(data: bytes, path: Pathlike) -> tuple[_Header, bytes]:
    """Split a PCD file into its header and the bytes after it."""
    entries: dict[str, list[str]] = {}
    stream = io.BytesIO(data)
    for line in stream:
        key, *values = line.decode("latin-1").split() or ["#"]
        entries[key.upper()] = values
        if key.upper() == "DATA":
            break
    try:
        return _parse_header(entries), stream.read()
    except (LookupError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} has a malformed PCD header ({str(error)[:80]}); "
            "save it again with FIELDS, SIZE, TYPE, WIDTH, HEIGHT, POINTS and DATA."
        ) from error


def _parse_header(entries: dict[str, list[str]]) -> _Header:
    """Parse the entries; raises LookupError, TypeError or ValueError for a missing or invalid one."""
    names = entries["COLUMNS" if "COLUMNS" in entries else "FIELDS"]
    counts = [int(count) for count in entries.get("COUNT", ["1"] * len(names))]
    fields: list[_Field] = []
    stride = columns = 0
    for name, size, kind, count in zip(names, entries["SIZE"], entries["TYPE"], counts, strict=True):
        if int(size) < 1 or count < 1:
            raise ValueError(f"field {name} has size {size} and count {count}")
        dtype = np.dtype(f"<{_KINDS[kind.upper()]}{size}")
        fields.append(_Field(name, dtype, count, stride, columns))
        stride += dtype.itemsize * count
        columns += count
    sizes = ["POINTS"] if "POINTS" in entries else ["WIDTH", "HEIGHT"]
    rows = math.prod(int(entries[key][0]) for key in sizes)
    if rows < 0 or not 0 < stride < 2**31:
        raise ValueError(f"{rows} points of {stride} bytes")
    (storage,) = entries["DATA"]
    return _Header(tuple(fields), rows, stride, columns, storage.lower())
