"""PLY files (Stanford polygons): the vertices of ascii and binary files of either byte order."""

from __future__ import annotations

import io
from typing import NamedTuple

import numpy as np

from ciassd_jax.formats.errors import InputError, Pathlike

_FORMATS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}


class _Element(NamedTuple):
    """An element: its name, its number of rows, and the name and type of each property, None for a list."""

    name: str
    rows: int
    properties: list[tuple[str, str | None]]

    def row_type(self, order: str) -> np.dtype:
        """The type of a row without lists, its fields named "0", "1", ..."""
        return np.dtype([(str(index), f"{order}{kind}") for index, (_, kind) in enumerate(self.properties)])


def read_ply(data: bytes, path: Pathlike) -> list[tuple[str, np.ndarray]]:
    """Return the name and the values of each property of the vertices.

    Raises InputError, which names `path`, for malformed data and for vertices that have lists or follow some.
    """
    storage, elements, body = _read_header(data, path)
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise InputError(f"{path} has no element 'vertex'; save its points again as vertices.")
    before, vertex = elements[: names.index("vertex")], elements[names.index("vertex")]
    if any(kind is None for element in [*before, vertex] for _, kind in element.properties):
        raise InputError(f"{path} has a list in or before its vertices; save its points alone, without lists.")
    last = vertex is elements[-1]
    if storage == "ascii":
        rows = _read_ascii(body, before, vertex, path, last=last)
        return [(name, _as_stored(rows[:, index], kind)) for index, (name, kind) in enumerate(vertex.properties)]
    order = _FORMATS[storage]
    row = vertex.row_type(order)
    start = sum(element.rows * element.row_type(order).itemsize for element in before)
    held = max(len(body) - start, 0) // max(row.itemsize, 1)
    _check_rows(vertex.rows, held, path, last=last)
    rows = np.frombuffer(body, row, vertex.rows, start) if vertex.rows else np.empty(0, row)
    return [(name, rows[str(index)]) for index, (name, _) in enumerate(vertex.properties)]


def _read_ascii(body: bytes, before: list[_Element], vertex: _Element, path: Pathlike, *, last: bool) -> np.ndarray:
    """Read the vertices as rows of float64."""
    width = len(vertex.properties)
    start = sum(element.rows * len(element.properties) for element in before)
    words = body.split()[start:]
    _check_rows(vertex.rows, len(words) // max(width, 1), path, last=last)
    try:
        return np.array(words[: vertex.rows * width], np.float64).reshape(vertex.rows, width)
    except ValueError as error:
        raise InputError(f"{path} has a vertex that is not made of numbers; save it again.") from error


def _as_stored(values: np.ndarray, kind: str | None) -> np.ndarray:
    """Return the values as bytes if the header says so."""
    is_byte = kind == "u1" and ((values >= 0) & (values <= 255)).all()
    return values.astype(np.uint8) if is_byte else values


def _check_rows(announced: int, held: int, path: Pathlike, *, last: bool) -> None:
    """Raise InputError for too few vertices, or too many if nothing follows them."""
    if held < announced or (last and held > announced):
        raise InputError(f"{path} announces {announced} vertices but holds {held}; copy or save it again.")


def _read_header(data: bytes, path: Pathlike) -> tuple[str, list[_Element], bytes]:
    """Return the format, the elements, and the bytes after the header."""
    stream = io.BytesIO(data)
    try:
        storage, elements = _parse_header(stream)
    except (LookupError, ValueError) as error:
        raise InputError(
            f"{path} has a malformed PLY header ({str(error)[:80]}); save it again as ascii or binary PLY."
        ) from error
    return storage, elements, stream.read()


def _parse_header(stream: io.BytesIO) -> tuple[str, list[_Element]]:
    """Read up to `end_header`; raises LookupError or ValueError for what is missing or invalid."""
    if stream.readline().strip() != b"ply":
        raise ValueError("it does not begin with 'ply'")
    storage, elements = "", list[_Element]()
    for line in stream:
        words = line.decode("latin-1").split()
        match words:
            case ["end_header"]:
                break
            case ["format", storage, _] if storage in _FORMATS:
                pass
            case ["element", name, rows] if int(rows) >= 0:
                elements.append(_Element(name, int(rows), []))
            case ["property", "list", _, _, name]:
                elements[-1].properties.append((name, None))
            case ["property", kind, name]:
                elements[-1].properties.append((name, _TYPES[kind]))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(" ".join(words))
    else:
        raise ValueError("it has no end_header")
    if not storage:
        raise ValueError("it has no format")
    return storage, elements
