"""Reader of PyTorch weights files, without PyTorch and without running code from a file.

Both formats are read: the zip archive (`NAME/data.pkl` and a record `NAME/data/KEY` per storage), and the older
sequence of pickles followed by the raw storages. `_Recorder` unpickles into inert records: the names that a file may
mention (`_GLOBALS`) stand for strings or inert objects of this module, and any other name is an error. `_Resolver` then
checks the records and converts them to arrays.
"""

import io
import math
import pickle
import re
import struct
import zipfile
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from ciassd_jax.formats.errors import InputError, Pathlike, read_bytes

_OLD_MAGIC, _OLD_PROTOCOL = 0x1950A86A20F9469CFC6C, 1001
_AGAIN = "fetch the file again or save it again with `torch.save`."
_ALONE = "re-save the model's state_dict alone."
_BUSY = object()

_STORAGES = {
    "BFloat16Storage": "bfloat16",
    "BoolStorage": "bool",
    "ByteStorage": "uint8",
    "CharStorage": "int8",
    "DoubleStorage": "float64",
    "FloatStorage": "float32",
    "HalfStorage": "float16",
    "IntStorage": "int32",
    "LongStorage": "int64",
    "ShortStorage": "int16",
}
# A bfloat16 is read as its bits, which are the upper half of a float32.
_DTYPES = {name: np.dtype("uint16" if name == "bfloat16" else name).newbyteorder("<") for name in _STORAGES.values()}


def read_torch_file(path: Pathlike) -> dict[Any, Any]:
    """Return the content of a file written by `torch.save` as plain data.

    Containers, numbers, strings, bytes and None are returned unchanged, an `OrderedDict` as a `dict`, a NumPy scalar as
    a number, a torch dtype or device as its name, and a tensor as a read-only array of its type, bfloat16 as float32.
    Arrays that share a storage share memory.

    Raises InputError for a missing, foreign or damaged file, and for one that asks to run code.
    """
    raw = read_bytes(path)
    try:
        content = _read_zip(raw) if raw.startswith(b"PK\x03\x04") else _read_old(raw)
        if not isinstance(content, dict):
            raise InputError("does not hold a dictionary; save the model's state_dict with `torch.save`.")
        return content
    except InputError as error:
        raise InputError(f"{path} {error}") from None
    except Exception as error:
        # On malformed bytes pickle, zipfile, zlib, struct and NumPy raise a dozen types of error.
        raise InputError(f"{path} is damaged or not a PyTorch weights file; {_AGAIN}") from error


def _read_zip(raw: bytes) -> Any:
    with zipfile.ZipFile(io.BytesIO(raw)) as archive:
        names = archive.namelist()
        folders = [name.removesuffix("data.pkl") for name in names if name.endswith("/data.pkl")]
        if len(folders) != 1:
            raise InputError(f"is a zip file without the one `data.pkl` of a weights file; {_AGAIN}")
        folder = folders[0]
        if f"{folder}byteorder" in names and archive.read(f"{folder}byteorder") != b"little":
            raise InputError("was saved on a big-endian machine; save it again on a little-endian one.")
        recorder = _Recorder(io.BytesIO(archive.read(f"{folder}data.pkl")))
        content = recorder.load()
        storages = {key: archive.read(f"{folder}data/{key}") for key in recorder.storage_dtypes}
    return _Resolver(storages).plain(content)


def _read_old(raw: bytes) -> Any:
    if not raw:
        raise InputError(f"is empty; {_AGAIN}")
    file = io.BytesIO(raw)
    if _Recorder(file).load() != _OLD_MAGIC or _Recorder(file).load() != _OLD_PROTOCOL:
        raise InputError(f"is not a PyTorch weights file; {_AGAIN}")
    _Recorder(file).load()  # the writer's byte order and type sizes; storages are little-endian in any case
    recorder = _Recorder(file)
    content = recorder.load()
    storages = {}
    for key in _Recorder(file).load():
        (count,) = struct.unpack("<q", file.read(8))
        size = count * recorder.storage_dtypes[key].itemsize
        if not 0 <= size <= len(raw) - file.tell():
            raise InputError(f"ends before its last storage; {_AGAIN}")
        storages[key] = file.read(size)
    return _Resolver(storages).plain(content)


class _Inert:
    """Base of the stand-ins for PyTorch's and NumPy's objects; a file cannot set attributes on them."""

    __slots__ = ()

    def __setstate__(self, state: object) -> None:
        raise InputError(f"sets the inner state of an object, which weights files never do; {_AGAIN}")


class _Global(_Inert):
    """A function or class that a file may name; calling it returns plain data or a record."""

    __slots__ = ("make",)

    def __init__(self, make: Callable[..., Any]) -> None:
        self.make = make

    def __call__(self, *arguments: object) -> Any:
        return self.make(*arguments)


class _Record(_Inert):
    """A call that a file asks for; `_Resolver` runs `build` once everything is read."""

    __slots__ = ("arguments", "build")

    def __init__(self, build: Callable[..., Any], *arguments: object) -> None:
        self.build, self.arguments = build, arguments


class _RecordWithState(_Record):
    """A record that appends the state, which a pickle sets after the call, to its arguments."""

    __slots__ = ()

    def __setstate__(self, state: object) -> None:
        self.arguments = (*self.arguments, state)


class _OrderedDict(dict[Any, Any]):
    """A dictionary that ignores the attributes a file sets, such as the `_metadata` of a state_dict."""

    def __setstate__(self, state: object) -> None:
        pass


class _Recorder(pickle._Unpickler):
    """Unpickler that imports and runs nothing; in Python, because C's allocates memory for the largest memo index."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, encoding="utf-8")
        self.storage_dtypes: dict[str, np.dtype] = {}

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _GLOBALS:
            wanted = ascii(f"{module}.{name}")[1:-1][:80]
            raise InputError(
                f"asks to run `{wanted}`, which a weights file has no need for; "
                "get the file from a source you trust or re-save its state_dict alone."
            )
        return _GLOBALS[module, name]

    def persistent_load(self, pid: Any) -> Any:
        match pid:
            case ("storage", str(dtype), str(key), _, int(count), *view) if dtype in _DTYPES:
                self.storage_dtypes.setdefault(key, _DTYPES[dtype])
                return _Record(_storage, key, dtype, count, *view)
        raise InputError(f"describes a storage in an unknown way; {_AGAIN}")


class _Resolver:
    """Converts the records of `_Recorder` to plain data; shared objects stay shared."""

    def __init__(self, storages: Mapping[str, bytes]) -> None:
        self.storages = storages
        self.vectors: dict[tuple[str, str], np.ndarray] = {}
        self.done: dict[int, Any] = {}

    def plain(self, value: Any) -> Any:
        if value is None or type(value) in (bool, int, float, str, bytes):
            return value
        if id(value) not in self.done:
            self.done[id(value)] = _BUSY
            self.done[id(value)] = self._convert(value)
        if self.done[id(value)] is _BUSY:
            raise InputError(f"holds a container that contains itself; {_ALONE}")
        return self.done[id(value)]

    def _convert(self, value: Any) -> Any:
        if isinstance(value, dict):
            return {self.plain(key): self.plain(entry) for key, entry in value.items()}
        if type(value) in (list, tuple):
            return type(value)(self.plain(entry) for entry in value)
        if isinstance(value, _Record):
            return value.build(self, *value.arguments)
        raise InputError(f"holds something other than tensors and plain data; {_ALONE}")

    def vector(self, key: str, dtype: str) -> np.ndarray:
        """Return all bytes of a storage as read-only numbers."""
        if (key, dtype) not in self.vectors:
            raw = self.storages[key]
            numbers = np.ndarray((len(raw) // _DTYPES[dtype].itemsize,), _DTYPES[dtype], raw).copy()
            if dtype == "bfloat16":
                numbers = (numbers.astype(np.uint32) << 16).view(np.float32)
            elif dtype == "bool":
                numbers = numbers.view(np.uint8) != 0
            numbers.flags.writeable = False
            self.vectors[key, dtype] = numbers
        return self.vectors[key, dtype]


def _check_inside(vector: np.ndarray, offset: Any, size: Any, stride: Any) -> None:
    """Raise InputError for a view that is malformed or reaches outside `vector`."""
    well_formed = all(isinstance(number, int) and number >= 0 for number in (offset, *size, *stride))
    if well_formed and len(size) == len(stride):
        last = offset + sum((count - 1) * step for count, step in zip(size, stride, strict=True))
        if 0 in size or last < len(vector):
            return
    raise InputError(f"holds a tensor that reaches outside its storage; {_AGAIN}")


def _storage(resolver: _Resolver, key: str, dtype: str, count: int, view: Any = None) -> np.ndarray:
    """Return a storage, or its part `view` = (name, offset, count), as a vector."""
    if len(resolver.storages[key]) != count * _DTYPES[dtype].itemsize:
        raise InputError(f"holds a storage whose size is not the announced one; {_AGAIN}")
    vector = resolver.vector(key, dtype)
    if view is None:
        return vector
    _, offset, size = view
    _check_inside(vector, offset, (size,), (1,))
    return vector[offset : offset + size]


def _tensor(resolver: _Resolver, storage: Any, offset: Any, size: Any, stride: Any, *rest: Any) -> np.ndarray:
    """Return a strided view of a storage; `rest` is a prefix of (requires_grad, hooks, metadata)."""
    if not isinstance(storage, _Record) or storage.build is not _storage:
        raise InputError(f"holds a tensor without a storage; {_AGAIN}")
    if len(rest) > 2 and rest[2]:
        raise InputError(f"holds a conjugated or negated tensor; {_ALONE}")
    vector = resolver.plain(storage)
    _check_inside(vector, offset, size, stride)
    if 0 in size:
        return np.empty(size, vector.dtype)
    width = vector.itemsize
    return np.ndarray(size, vector.dtype, vector, offset * width, [step * width for step in stride])


def _parameter(resolver: _Resolver, data: Any, *flags_and_hooks: Any) -> Any:
    return resolver.plain(data)


def _numpy_dtype(resolver: _Resolver, code: Any, align: Any, copy: Any, state: Any) -> np.dtype:
    """Return a type of numbers or characters; in one of objects NumPy would read any bytes as addresses."""
    if not re.fullmatch("[biufc][1248]|c16|[SU][1-9][0-9]{0,3}", code) or state[1] not in tuple("<>|="):
        raise InputError(f"holds a NumPy array of something other than numbers; {_ALONE}")
    return np.dtype(state[1] + code)


def _numpy_array(resolver: _Resolver, kind: Any, dummy_shape: Any, dummy_type: Any, state: Any) -> np.ndarray:
    _, shape, dtype, column_major, raw = state
    dtype = resolver.plain(dtype)
    if not isinstance(dtype, np.dtype) or len(raw) != math.prod(shape) * dtype.itemsize:
        raise InputError(f"holds a malformed NumPy array; {_AGAIN}")
    array = np.ndarray(shape, dtype, raw, order="F" if column_major else "C")
    return array.astype(dtype.newbyteorder("="))


def _numpy_scalar(resolver: _Resolver, dtype: Any, raw: Any) -> Any:
    return _numpy_array(resolver, None, None, None, (1, (), dtype, False, raw)).item()


def _device(kind: Any, *index: Any) -> str:
    return ":".join([kind, *(f"{number:d}" for number in index)])


def _encode(text: Any, encoding: Any) -> bytes:
    """Return bytes as pickles of protocol 2 write them."""
    if encoding != "latin1":
        raise InputError(f"holds bytes written in an unknown way; {_AGAIN}")
    return text.encode("latin1")


def _recorded(build: Callable[..., Any], kind: type[_Record] = _Record) -> _Global:
    return _Global(partial(kind, build))


_GLOBALS: dict[tuple[str, str], Any] = {
    ("__builtin__", "bytes"): _Global(lambda: b""),
    ("_codecs", "encode"): _Global(_encode),
    ("collections", "OrderedDict"): _Global(_OrderedDict),
    ("numpy", "dtype"): _recorded(_numpy_dtype, _RecordWithState),
    ("numpy", "ndarray"): "numpy.ndarray",
    ("torch", "Size"): _Global(tuple),
    ("torch", "device"): _Global(_device),
    ("torch.storage", "UntypedStorage"): "uint8",
    ("torch._utils", "_rebuild_parameter"): _recorded(_parameter),
    ("torch._utils", "_rebuild_parameter_with_state"): _recorded(_parameter),
    ("torch._utils", "_rebuild_tensor"): _recorded(_tensor),
    ("torch._utils", "_rebuild_tensor_v2"): _recorded(_tensor),
}
for _name, _dtype in _STORAGES.items():
    _GLOBALS["torch", _name] = _GLOBALS["torch.cuda", _name] = _GLOBALS["torch", _dtype] = _dtype
for _module in ("numpy.core.multiarray", "numpy._core.multiarray"):
    _GLOBALS[_module, "scalar"] = _recorded(_numpy_scalar)
    _GLOBALS[_module, "_reconstruct"] = _recorded(_numpy_array, _RecordWithState)
