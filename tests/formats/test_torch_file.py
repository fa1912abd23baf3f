"""PyTorch weights files, written by hand in both formats: what is read, what is refused, what never runs."""

import contextlib
import io
import os
import pickle
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.numpy import load_file

from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.torch_file import read_torch_file

STORAGE_NAMES = {
    "float16": "HalfStorage",
    "float32": "FloatStorage",
    "float64": "DoubleStorage",
    "int8": "CharStorage",
    "int16": "ShortStorage",
    "int32": "IntStorage",
    "int64": "LongStorage",
    "uint8": "ByteStorage",
    "bool": "BoolStorage",
}


# What the older format starts with: a magic number, the version, the machine.
HEADER = b"".join(pickle.dumps(part, 2) for part in (0x1950A86A20F9469CFC6C, 1001, {"little_endian": True}))


class Name(NamedTuple):
    """Pickled as the global `module.name`, which need not exist here."""

    module: str
    name: str


class Call(NamedTuple):
    """Pickled as a call of a global."""

    function: Any
    arguments: tuple[Any, ...]


class Build(NamedTuple):
    """Pickled as an object on which a state is set."""

    target: Any
    state: Any


class Storage(NamedTuple):
    """Pickled as a persistent id; `values` are what the file really holds."""

    key: str
    values: np.ndarray
    kind: Name | None = None
    count: int | None = None
    tail: tuple[Any, ...] = ()


class TorchPickler(pickle._Pickler):
    """Writes `Name`, `Call` and `Storage` as PyTorch would, without PyTorch."""

    def __init__(self, file: io.BytesIO, protocol: int = 2) -> None:
        super().__init__(file, protocol)
        self.storages: dict[str, Storage] = {}

    def save(self, obj: Any, save_persistent_id: bool = True) -> None:
        if isinstance(obj, Name):
            if self.proto >= 4:
                super().save(obj.module)
                super().save(obj.name)
                self.write(pickle.STACK_GLOBAL)
            else:
                self.write(pickle.GLOBAL + f"{obj.module}\n{obj.name}\n".encode())
        elif isinstance(obj, Call):
            self.save(obj.function)
            self.save(obj.arguments)
            self.write(pickle.REDUCE)
        elif isinstance(obj, Build):
            self.save(obj.target)
            self.save(obj.state)
            self.write(pickle.BUILD)
        elif isinstance(obj, Storage):
            self.storages[obj.key] = obj
            count = obj.values.size if obj.count is None else obj.count
            kind = obj.kind or Name("torch", STORAGE_NAMES[obj.values.dtype.name])
            self.save(("storage", kind, obj.key, "cuda:0", count, *obj.tail))
            self.write(pickle.BINPERSID)
        else:
            super().save(obj, save_persistent_id)


def write_zip(
    path: Path, content: Any, *, protocol: int = 2, folder: str = "archive", order: bytes = b"little"
) -> Path:
    pickled = io.BytesIO()
    pickler = TorchPickler(pickled, protocol)
    pickler.dump(content)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{folder}/data.pkl", pickled.getvalue())
        if order:
            archive.writestr(f"{folder}/byteorder", order)
        for key, storage in pickler.storages.items():
            archive.writestr(f"{folder}/data/{key}", storage.values.tobytes())
        archive.writestr(f"{folder}/version", b"3\n")
    return path


def write_old(path: Path, content: Any, *, protocol: int = 2) -> Path:
    file = io.BytesIO()
    file.write(HEADER)
    pickler = TorchPickler(file, protocol)
    pickler.dump(content)
    pickle.dump(sorted(pickler.storages), file, protocol)
    for _, storage in sorted(pickler.storages.items()):
        file.write(struct.pack("<q", storage.values.size) + storage.values.tobytes())
    path.write_bytes(file.getvalue())
    return path


WRITERS = {"zip": write_zip, "old": write_old}
Writer = Callable[..., Path]
REBUILD = Name("torch._utils", "_rebuild_tensor_v2")


@pytest.fixture(params=sorted(WRITERS))
def write(request: pytest.FixtureRequest) -> Writer:
    return WRITERS[request.param]


def tensor(storage: Any, offset: Any, size: Any, stride: Any, *more: Any) -> Call:
    return Call(REBUILD, (storage, offset, size, stride, False, ordered({}), *more))


def whole(key: str, values: np.ndarray) -> Call:
    strides = tuple(step // values.itemsize for step in values.strides)
    return tensor(Storage(key, values.reshape(-1)), 0, values.shape, strides)


def ordered(entries: dict[Any, Any]) -> Call:
    return Call(Name("collections", "OrderedDict"), ([list(entry) for entry in entries.items()],))


def numpy_dtype(code: Any, order: Any = "<") -> Build:
    return Build(Call(Name("numpy", "dtype"), (code, False, True)), (3, order, None, None, None, -1, -1, 0))


def numpy_array(dtype: Any, shape: Any, raw: Any) -> Build:
    function = Name("numpy._core.multiarray", "_reconstruct")
    return Build(Call(function, (Name("numpy", "ndarray"), (0,), "b")), (1, shape, dtype, False, raw))


def latin(raw: bytes) -> Call:
    return Call(Name("_codecs", "encode"), (raw.decode("latin1"), "latin1"))


def is_plain(value: Any) -> bool:
    if isinstance(value, dict):
        return type(value) is dict and all(is_plain(key) and is_plain(entry) for key, entry in value.items())
    if isinstance(value, list | tuple):
        return type(value) in (list, tuple) and all(map(is_plain, value))
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "biufcSU"
    if isinstance(value, np.dtype):
        return value.kind in "biufcSU"
    return value is None or type(value) in (bool, int, float, complex, str, bytes)


def sample() -> dict[str, Any]:
    """A small checkpoint with every part that the real ones have."""
    loss = Call(Name("numpy.core.multiarray", "scalar"), (numpy_dtype("f8"), latin(np.float64(0.5).tobytes())))
    weights = {
        "a.weight": whole("0", np.arange(6, dtype=np.float32).reshape(2, 3)),
        "a.step": whole("1", np.int64([7])),
    }
    return {
        "meta": {"epoch": 60, "loss": loss, "ok": (True, None)},
        "state_dict": Build(ordered(weights), {"_metadata": ordered({"": {"version": 1}})}),
        "optimizer": {"state": {}, "param_groups": [{"lr": 0.5, "params": [0, 1]}]},
    }


# ---------------------------------------------------------------------------------------------- what is read


@pytest.mark.smoke
@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_a_checkpoint_becomes_plain_data(write: Writer, tmp_path: Path, protocol: int) -> None:
    content = read_torch_file(write(tmp_path / "w.pth", sample(), protocol=protocol))
    assert is_plain(content)
    assert content["meta"] == {"epoch": 60, "loss": 0.5, "ok": (True, None)}
    assert content["optimizer"] == {"state": {}, "param_groups": [{"lr": 0.5, "params": [0, 1]}]}
    assert list(content["state_dict"]) == ["a.weight", "a.step"]
    np.testing.assert_array_equal(content["state_dict"]["a.weight"], np.float32([[0, 1, 2], [3, 4, 5]]))


@pytest.mark.parametrize("dtype", sorted(STORAGE_NAMES))
def test_every_type(write: Writer, tmp_path: Path, dtype: str) -> None:
    values = np.array([[0, 1, 2], [100, 101, 102]]).astype(dtype)
    read = read_torch_file(write(tmp_path / "w.pth", {"w": whole("k", values)}))["w"]
    assert read.dtype == values.dtype
    assert read.dtype.isnative
    np.testing.assert_array_equal(read, values)


def test_bfloat16_becomes_float32(write: Writer, tmp_path: Path) -> None:
    values = np.float32([1, -2.5, 0.15625, np.inf, 2.0**-130, 3e38])
    bits = (values.view(np.uint32) >> 16).astype(np.uint16)
    storage = Storage("0", bits, Name("torch", "BFloat16Storage"))
    read = read_torch_file(write(tmp_path / "w.pth", {"w": tensor(storage, 1, (5,), (1,))}))["w"]
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, (bits.astype(np.uint32) << 16).view(np.float32)[1:])


@pytest.mark.parametrize(
    ("offset", "size", "stride"),
    [
        (0, (), ()),
        (23, (1,), (1,)),
        (0, (4, 6), (1, 4)),
        (2, (2, 3, 2), (12, 2, 1)),
        (5, (3, 4), (0, 1)),
        (0, (0, 5), (5, 1)),
        (24, (0,), (1,)),
        (7, (1, 3), (10**6, 8)),
    ],
)
def test_offsets_and_strides(write: Writer, tmp_path: Path, offset: int, size: Any, stride: Any) -> None:
    values = np.arange(24, dtype=np.float32)
    content = {
        "v2": tensor(Storage("0", values), offset, size, stride),
        "v1": Call(Name("torch._utils", "_rebuild_tensor"), (Storage("0", values), offset, size, stride)),
    }
    read = read_torch_file(write(tmp_path / "w.pth", content))
    expected = np.empty(size, np.float32)
    for index in np.ndindex(size):
        expected[index] = values[offset + sum(i * s for i, s in zip(index, stride, strict=True))]
    for array in read.values():
        assert array.shape == size
        np.testing.assert_array_equal(array, expected)


def test_an_expanded_tensor_takes_no_memory(write: Writer, tmp_path: Path) -> None:
    content = {"w": tensor(Storage("0", np.float32([3])), 0, (10**6, 10**6), (0, 0))}
    assert read_torch_file(write(tmp_path / "w.pth", content))["w"][-1, -1] == 3


def test_shared_storages_stay_shared_and_read_only(write: Writer, tmp_path: Path) -> None:
    storage = Storage("0", np.arange(6, dtype=np.float32))
    content = {"all": tensor(storage, 0, (6,), (1,)), "tail": tensor(storage, 4, (2,), (1,)), "raw": storage}
    read = read_torch_file(write(tmp_path / "w.pth", content))
    assert np.shares_memory(read["all"], read["tail"])
    assert not read["all"].flags.writeable
    np.testing.assert_array_equal(read["tail"], [4, 5])
    np.testing.assert_array_equal(read["raw"], read["all"])


def test_parameters_sizes_devices_and_types(write: Writer, tmp_path: Path) -> None:
    data = whole("0", np.float32([1, 2]))
    content = {
        "parameter": Call(Name("torch._utils", "_rebuild_parameter"), (data, True, ordered({}))),
        "stateful": Call(Name("torch._utils", "_rebuild_parameter_with_state"), (data, True, ordered({}), {"a": 1})),
        "size": Call(Name("torch", "Size"), ((2, 3),)),
        "device": Call(Name("torch", "device"), ("cuda", 0)),
        "cpu": Call(Name("torch", "device"), ("cpu",)),
        "dtype": Name("torch", "float16"),
        "bytes": latin(b"\xff\x00"),
        "nothing": Call(Name("__builtin__", "bytes"), ()),
    }
    read = read_torch_file(write(tmp_path / "w.pth", content))
    np.testing.assert_array_equal(read.pop("parameter"), [1, 2])
    np.testing.assert_array_equal(read.pop("stateful"), [1, 2])
    assert read == {
        "size": (2, 3),
        "device": "cuda:0",
        "cpu": "cpu",
        "dtype": "float16",
        "bytes": b"\xff\x00",
        "nothing": b"",
    }


def test_old_storage_views(tmp_path: Path) -> None:
    storage = Storage("0", np.arange(10, dtype=np.int32), tail=(("view", 4, 3),))
    read = read_torch_file(write_old(tmp_path / "w.pth", {"w": tensor(storage, 1, (2,), (1,))}))
    np.testing.assert_array_equal(read["w"], [5, 6])
    for view in [("view", 8, 3), ("view", -1, 3), ("view", 0, -1), ("view", 0, 1), (1, 2)]:
        outside = Storage("0", np.arange(10, dtype=np.int32), tail=(view,))
        with pytest.raises(InputError):
            read_torch_file(write_old(tmp_path / "w.pth", {"w": tensor(outside, 1, (2,), (1,))}))


def test_untyped_and_cuda_storages(write: Writer, tmp_path: Path) -> None:
    content = {
        "bytes": Storage("0", np.uint8([1, 2, 3]), Name("torch.storage", "UntypedStorage")),
        "cuda": tensor(Storage("1", np.float32([4]), Name("torch.cuda", "FloatStorage")), 0, (1,), (1,)),
    }
    read = read_torch_file(write(tmp_path / "w.pth", content))
    np.testing.assert_array_equal(read["bytes"], np.uint8([1, 2, 3]))
    np.testing.assert_array_equal(read["cuda"], np.float32([4]))


@pytest.mark.parametrize("protocol", [2, 4])
def test_numpy_values(write: Writer, tmp_path: Path, protocol: int) -> None:
    values = {
        "matrix": np.arange(6, dtype=np.int16).reshape(2, 3),
        "columns": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "big": np.arange(3, dtype=">f4"),
        "empty": np.zeros((0, 3)),
        "names": np.array(["a", "bcd"]),
        "bool": np.array([True, False]),
        "scalar": np.float32(1.5),
        "count": np.int64(-3),
        "complex": np.complex128(1 + 2j),
        "type": np.dtype("float32"),
    }
    read = read_torch_file(write(tmp_path / "w.pth", values, protocol=protocol))
    for name in ("scalar", "count", "complex", "type"):
        assert read.pop(name) == values[name]
    for name, array in read.items():
        assert array.dtype.isnative
        np.testing.assert_array_equal(array, values[name])


def test_any_folder_name_and_no_byte_order(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "w.pth", sample(), folder="epoch 60.v2", order=b"")
    assert read_torch_file(str(path))["meta"]["epoch"] == 60


def test_shared_containers_take_linear_time(write: Writer, tmp_path: Path) -> None:
    """Each list holds the one before twice: 2**100 leaves if the sharing were lost."""
    content: Any = [1]
    for _ in range(100):
        content = [content, content]
    read = read_torch_file(write(tmp_path / "w.pth", {"w": content}))["w"]
    assert read[0] is read[1]


# ------------------------------------------------------------------------------------------ what is refused


def refused(path: Path, *words: str) -> str:
    with pytest.raises(InputError) as caught:
        read_torch_file(path)
    message = str(caught.value)
    assert message.startswith(str(path)), message
    assert message.endswith("."), message
    assert "\n" not in message, message
    for word in words:
        assert word in message, message
    return message


@pytest.mark.parametrize("protocol", [2, 4])
@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("os", "system"),
        ("posix", "system"),
        ("builtins", "eval"),
        ("builtins", "getattr"),
        ("__builtin__", "getattr"),
        ("__builtin__", "eval"),
        ("collections", "OrderedDict.__init__"),
        ("collections.OrderedDict", "fromkeys"),
        ("collections", "OrderedDict.fromkeys.__self__"),
        ("torch._utils", "_rebuild_tensor_v2.__globals__"),
        ("torch", "load"),
        ("torch", ""),
        ("numpy", "load"),
        ("numpy.core.multiarray", "fromfile"),
        ("ciassd_jax.formats.torch_file", "_read_old"),
        ("subprocess", "Popen"),
        ("det3d.models", "VoxelNet"),
    ],
)
def test_other_names_are_refused_and_never_run(
    write: Writer, tmp_path: Path, module: str, name: str, protocol: int
) -> None:
    marker = tmp_path / "marker"
    command = f"open({str(marker)!r}, 'w')" if name == "eval" else f"touch {marker}"
    path = write(tmp_path / "w.pth", {"w": Call(Name(module, name), (command,))}, protocol=protocol)
    refused(path, f"`{module}.{name}`", "re-save its state_dict alone")
    assert not marker.exists()


def test_plain_pickle_of_a_call_is_refused(tmp_path: Path) -> None:
    marker = tmp_path / "marker"

    class Trap:
        def __reduce__(self) -> tuple[Any, ...]:
            return os.system, (f"touch {marker}",)

    for protocol in range(6):
        path = tmp_path / f"{protocol}.pth"
        path.write_bytes(pickle.dumps({"w": Trap()}, protocol))
        refused(path, ".system`")
        assert not marker.exists()


def test_opcodes_that_make_instances_are_refused(write: Writer, tmp_path: Path) -> None:
    """INST, OBJ and NEWOBJ name a class in other ways than REDUCE."""
    marker = tmp_path / "marker"
    touch = b"X" + struct.pack("<I", len(f"touch {marker}")) + f"touch {marker}".encode()
    for body in [
        b"(" + touch + b"ios\nsystem\n.",
        b"(cos\nsystem\n" + touch + b"o.",
        b"cos\nsystem\n(" + touch + b"t\x81.",
        b"ctorch\nSize\n)\x81.",
        b"ctorch._utils\n_rebuild_tensor\n)}\x92.",
        b"\x82\x01.",
        b"Pos.system\n.",
    ]:
        path = tmp_path / "w.pth"
        path.write_bytes(HEADER + body + pickle.dumps([], 2))
        refused(path)
        assert not marker.exists()


def test_escape_sequences_of_a_name_do_not_reach_the_terminal(tmp_path: Path) -> None:
    message = refused(write_zip(tmp_path / "w.pth", {"w": Name("\x1b[2Jos", "a\nb" * 99)}, protocol=4))
    assert message.isprintable()
    assert len(message) < 400


@pytest.mark.parametrize("state", [{"make": 1}, (None, {"make": 1, "build": 1, "__defaults__": 1})])
@pytest.mark.parametrize(
    "target",
    [
        REBUILD,
        Name("torch", "Size"),
        Name("collections", "OrderedDict"),
        Name("torch", "FloatStorage"),
        tensor(Storage("0", np.zeros(1, np.float32)), 0, (1,), (1,)),
        Call(Name("torch", "Size"), ((1,),)),
    ],
)
def test_state_cannot_be_set(write: Writer, tmp_path: Path, target: Any, state: Any) -> None:
    refused(write(tmp_path / "w.pth", {"w": Build(target, state)}))
    content = read_torch_file(write(tmp_path / "w.pth", sample()))
    assert content["state_dict"]["a.weight"].shape == (2, 3)


@pytest.mark.parametrize(
    ("offset", "size", "stride"),
    [
        (0, (7,), (1,)),
        (6, (1,), (1,)),
        (6, (), ()),
        (1, (2, 3), (3, 1)),
        (0, (2, 3), (4, 1)),
        (0, (2,), (2**62,)),
        (0, (2**62, 2**62), (1, 1)),
        (0, (2**62,), (4,)),
        (0, (2**63, 2), (0, 0)),
        (0, (2**40, 2**40), (0, 0)),
        (-1, (2,), (1,)),
        (0, (-1,), (1,)),
        (0, (-2, -3), (3, 1)),
        (5, (2,), (-1,)),
        (0, (2, 3), (1,)),
        (0, (2,), (3, 1)),
        (0, (2.0,), (1,)),
        (None, (2,), (1,)),
        ("0", (2,), (1,)),
        (0, 6, 1),
        (0, (1,) * 99, (1,) * 99),
        (0, ((2,),), ((1,),)),
    ],
)
def test_tensors_outside_their_storage(write: Writer, tmp_path: Path, offset: Any, size: Any, stride: Any) -> None:
    storage = Storage("0", np.arange(6, dtype=np.float32))
    refused(write(tmp_path / "w.pth", {"w": tensor(storage, offset, size, stride)}))


@given(
    offset=st.integers(-2, 9),
    size=st.lists(st.integers(-1, 4), max_size=3),
    stride=st.lists(st.integers(-1, 4), max_size=3),
    kind=st.sampled_from(sorted(WRITERS)),
)
@settings(deadline=None, max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_view_is_read_exactly_if_it_lies_inside(
    tmp_path: Path, offset: int, size: list[int], stride: list[int], kind: str
) -> None:
    values = np.arange(8, dtype=np.int64)
    valid = len(size) == len(stride) and min([offset, *size, *stride]) >= 0
    if valid and 0 not in size:
        places = [offset + sum(i * s for i, s in zip(index, stride, strict=True)) for index in np.ndindex(*size)]
        valid = max(places) < 8
    path = WRITERS[kind](tmp_path / "w.pth", {"w": tensor(Storage("0", values), offset, tuple(size), tuple(stride))})
    if not valid:
        refused(path)
    elif 0 in size:
        assert read_torch_file(path)["w"].shape == tuple(size)
    else:
        np.testing.assert_array_equal(read_torch_file(path)["w"].ravel(), values[places])


EIGHT = latin(b"12345678")


@pytest.mark.parametrize(
    "value",
    [
        numpy_array(numpy_dtype("O8", "|"), (1,), EIGHT),
        numpy_array(numpy_dtype("f8", "O,"), (1,), EIGHT),
        numpy_array(numpy_dtype("f4,O"), (1,), EIGHT),
        numpy_array(numpy_dtype("V8"), (1,), EIGHT),
        numpy_array(numpy_dtype("M8"), (1,), EIGHT),
        numpy_array("O", (1,), EIGHT),
        numpy_array("<f8", (1,), EIGHT),
        numpy_array(numpy_dtype("f8"), (2,), EIGHT),
        numpy_array(numpy_dtype("f4"), (1,), EIGHT),
        numpy_array(numpy_dtype("f4"), (-1, -2), EIGHT),
        numpy_array(numpy_dtype("f8"), (1,), "12345678"),
        numpy_array(numpy_dtype("f8"), (1,), [1, 2, 3, 4, 5, 6, 7, 8]),
        numpy_array(numpy_dtype(8), (1,), EIGHT),
        Call(Name("numpy", "dtype"), ("f8", False, True)),
        Build(numpy_dtype("f8"), (3, "<")),
        Call(Name("numpy.core.multiarray", "scalar"), (numpy_dtype("O8", "|"), EIGHT)),
        Call(Name("numpy.core.multiarray", "scalar"), (numpy_dtype("f4"), EIGHT)),
        Call(Name("_codecs", "encode"), ("import os", "rot13")),
        Call(Name("__builtin__", "bytes"), (10**12,)),
        Call(Name("torch", "device"), ([1],)),
        Call(Name("torch", "Size"), (3,)),
        Call("not a function", ()),
        Call(REBUILD, ()),
        tensor([1.0, 2.0], 0, (1,), (1,)),
        tensor(whole("0", np.float32([1])), 0, (1,), (1,)),
        tensor(numpy_array(numpy_dtype("f8"), (1,), EIGHT), 0, (1,), (1,)),
        tensor(Storage("0", np.float32([1])), 0, (1,), (1,), {"neg": True}),
        Storage("0", np.float32([1]), count=2),
        Storage("0", np.float32([1]), count=-1),
        Storage("0", np.float32([1]), Name("torch", "DoubleStorage")),
        Storage("0", np.float32([1]), Name("torch", "Size")),
        Storage("0", np.float32([1]), Name("torch", "ComplexFloatStorage")),
        Storage("0", np.float32([1]), tail=(None, None)),
        REBUILD,
        {1, 2},
        bytearray(b"1"),
    ],
)
def test_malformed_content(write: Writer, tmp_path: Path, value: Any) -> None:
    refused(write(tmp_path / "w.pth", {"w": value}, protocol=5 if isinstance(value, set | bytearray) else 2))


def test_containers_that_hold_themselves(write: Writer, tmp_path: Path) -> None:
    loop: list[Any] = []
    loop.append(loop)
    refused(write(tmp_path / "w.pth", {"w": loop}), "contains itself")
    (tmp_path / "deep.pth").write_bytes(HEADER + b"\x80\x02" + b"]" * 5000 + b"a" * 4999 + b".\x80\x02].")
    refused(tmp_path / "deep.pth")


def test_a_huge_memo_number_takes_no_memory(tmp_path: Path) -> None:
    body = b"\x80\x02}r\xff\xff\xff\xff."
    (tmp_path / "w.pth").write_bytes(HEADER + body + pickle.dumps([], 2))
    assert read_torch_file(tmp_path / "w.pth") == {}


def test_files_of_other_kinds(tmp_path: Path) -> None:
    path = tmp_path / "w.pth"
    refused(tmp_path / "missing.pth", "does not exist")
    refused(tmp_path, "directory")
    for raw, word in [
        (b"", "empty"),
        (b"hello world", "not a PyTorch weights file"),
        (b"\x00" * 100, "not a PyTorch weights file"),
        (b"PK\x03\x04", "damaged"),
        (pickle.dumps({"a": 1}), "not a PyTorch weights file"),
        (pickle.dumps(0x1950A86A20F9469CFC6C, 2) + pickle.dumps(1002, 2), "not a PyTorch weights file"),
        (b"\x93NUMPY\x01\x00", "not a PyTorch weights file"),
    ]:
        path.write_bytes(raw)
        refused(path, word)
    refused(write_zip(path, sample(), order=b"big"), "big-endian")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("hello.txt", "hello")
    refused(path, "data.pkl")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a/data.pkl", pickle.dumps({}, 2))
        archive.writestr("b/data.pkl", pickle.dumps({}, 2))
    refused(path, "data.pkl")


def test_content_other_than_a_dictionary(write: Writer, tmp_path: Path) -> None:
    refused(write(tmp_path / "w.pth", [1, 2]), "dictionary")
    refused(write(tmp_path / "w.pth", whole("0", np.float32([1]))), "dictionary")


def test_missing_and_foreign_storages(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "w.pth", {"w": whole("0", np.float32([1]))})
    with zipfile.ZipFile(path) as archive, zipfile.ZipFile(tmp_path / "cut.pth", "w") as cut:
        for name in archive.namelist():
            if "data/" not in name:
                cut.writestr(name, archive.read(name))
    refused(tmp_path / "cut.pth")
    old = write_old(tmp_path / "w.pth", {"w": whole("0", np.float32([1]))}).read_bytes()
    size = struct.pack("<q", 1)
    for count in (-1, -(2**63), 0, 2, 2**62):
        (tmp_path / "w.pth").write_bytes(old.replace(size, struct.pack("<q", count)))
        refused(tmp_path / "w.pth")


# ------------------------------------------------------------------------------------------ damaged files


def test_every_truncated_file_is_refused(write: Writer, tmp_path: Path) -> None:
    raw = write(tmp_path / "w.pth", sample()).read_bytes()
    for cut in range(0, len(raw), 3):
        (tmp_path / "cut.pth").write_bytes(raw[:cut])
        refused(tmp_path / "cut.pth")


@given(data=st.data(), kind=st.sampled_from(sorted(WRITERS)))
@settings(deadline=None, max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_truncated_file_is_refused(tmp_path: Path, data: st.DataObject, kind: str) -> None:
    raw = WRITERS[kind](tmp_path / "w.pth", sample()).read_bytes()
    (tmp_path / "cut.pth").write_bytes(raw[: data.draw(st.integers(0, len(raw) - 1))])
    refused(tmp_path / "cut.pth")


@given(data=st.data(), kind=st.sampled_from(sorted(WRITERS)), protocol=st.sampled_from([2, 4]))
@settings(deadline=None, max_examples=500, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_changed_bytes_are_refused_or_give_plain_data(
    tmp_path: Path, data: st.DataObject, kind: str, protocol: int
) -> None:
    raw = bytearray(WRITERS[kind](tmp_path / "w.pth", sample(), protocol=protocol).read_bytes())
    for place, byte in data.draw(
        st.lists(st.tuples(st.integers(0, len(raw) - 1), st.integers(0, 255)), min_size=1, max_size=4)
    ):
        raw[place] = byte
    (tmp_path / "bad.pth").write_bytes(raw)
    with contextlib.suppress(InputError):
        assert is_plain(read_torch_file(tmp_path / "bad.pth"))


# ------------------------------------------------------------------------------------- PyTorch's own files


@pytest.mark.reference
def test_reference_weights(shared: Path) -> None:
    content = read_torch_file(shared / "golden" / "weights.pth")
    expected = load_file(shared / "golden" / "weights.safetensors")
    assert content["meta"] == {"epoch": 60, "iter": 55680}
    assert content["state_dict"].keys() == expected.keys()
    for name, values in expected.items():
        read = content["state_dict"][name]
        assert read.dtype == (np.float32 if values.dtype == np.float16 else values.dtype)
        assert read.shape == values.shape
        np.testing.assert_array_equal(read, values, err_msg=name)


@pytest.mark.reference
def test_reference_weights_of_the_old_format(shared: Path) -> None:
    content = read_torch_file(shared / "golden" / "weights_legacy_format_sample.pth")
    expected = load_file(shared / "golden" / "weights.safetensors")
    assert len(content["state_dict"]) == 13
    for name, read in content["state_dict"].items():
        assert read.shape == expected[name].shape
        np.testing.assert_array_equal(read, expected[name], err_msg=name)
    assert content["optimizer"] == {"state": {}, "param_groups": []}


@pytest.mark.parametrize("zipped", [True, False])
def test_what_pytorch_writes(tmp_path: Path, zipped: bool) -> None:
    torch = pytest.importorskip("torch")
    model = torch.nn.Sequential(torch.nn.Conv2d(2, 3, 3), torch.nn.BatchNorm2d(3))
    optimizer = torch.optim.Adam(model.parameters())
    model(torch.ones(2, 2, 5, 5)).square().sum().backward()
    optimizer.step()
    values = torch.arange(24).reshape(4, 6)
    types = ["float16", "bfloat16", "float32", "float64", "int8", "int16", "int32", "int64", "uint8", "bool"]
    content = {
        "state_dict": model.state_dict(),
        "parameters": dict(model.named_parameters()),
        "optimizer": optimizer.state_dict(),
        "types": [values.to(getattr(torch, name))[1:, ::2].T for name in types],
        "expanded": torch.ones(3, 1).expand(3, 4),
        "empty": torch.zeros(0, 3),
        "size": values.shape,
        "numpy": [np.float64(0.25), np.arange(3), np.zeros(0)],
    }
    torch.save(content, tmp_path / "w.pth", _use_new_zipfile_serialization=zipped)

    def check(read: Any, written: Any) -> None:
        if isinstance(written, dict):
            assert list(read) == list(written)
            for key in written:
                check(read[key], written[key])
        elif isinstance(written, list | tuple):
            assert len(read) == len(written)
            for pair in zip(read, written, strict=True):
                check(*pair)
        elif isinstance(written, torch.Tensor):
            written = written.detach()
            wide = written.float() if written.dtype == torch.bfloat16 else written
            assert read.dtype == wide.numpy().dtype
            assert read.shape == wide.shape
            np.testing.assert_array_equal(read, wide.numpy())
        else:
            np.testing.assert_array_equal(read, written)

    check(read_torch_file(tmp_path / "w.pth"), content)
