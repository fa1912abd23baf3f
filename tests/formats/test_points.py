"""Point files: what is read, and the one sentence that every unusable file gets."""

import io
import re
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.points import POINT_SUFFIXES, read_points, write_bin

POINTS = np.array([[1.5, -2.0, 0.25, 0.5], [70.0, 39.5, -3.0, 1.0], [0.0, 1e-3, -0.1, 0.0]], np.float32)


def pcd(body: bytes, *, fields="x y z intensity", size="4 4 4 4", kind="F F F F", storage="ascii", **entries):
    header = {
        "VERSION": ".7",
        "FIELDS": fields,
        "SIZE": size,
        "TYPE": kind,
        "WIDTH": 3,
        "HEIGHT": 1,
        "POINTS": 3,
    }
    header |= {**entries, "DATA": storage}
    lines = [f"{key} {value}" for key, value in header.items() if value is not None]
    return "\n".join(["# .PCD v.7 - Point Cloud Data file format", *lines, ""]).encode() + body


def ascii_rows(array: np.ndarray) -> bytes:
    return "\n".join(" ".join(map(repr, row)) for row in array.tolist()).encode() + b"\n"


def saved(write, *arrays, **named) -> bytes:
    stream = io.BytesIO()
    write(stream, *arrays, **named)
    return stream.getvalue()


def binary_mixed() -> bytes:
    """Rows with an unread field first, doubles, padding that shares a name, and integer intensity."""
    rows = b"".join(struct.pack("<Hddd3BB", 9, *row[:3], 7, 7, 7, int(row[3] * 255)) for row in POINTS)
    return pcd(
        rows,
        fields="ring x y z _ i",
        size="2 8 8 8 1 1",
        kind="U F F F U U",
        COUNT="1 1 1 1 3 1",
        storage="binary",
    )


GOOD = {
    "a.bin": POINTS.astype("<f4").tobytes(),
    "A.BIN": POINTS.astype("<f4").tobytes(),
    "a.npy": saved(np.save, POINTS),
    "wide.npy": saved(np.save, np.pad(POINTS.astype(np.float64), ((0, 0), (0, 2)))),
    "fortran.npy": saved(np.save, np.asfortranarray(POINTS)),
    "one.npz": saved(np.savez, POINTS),
    "named.npz": saved(np.savez_compressed, other=np.zeros(3), points=POINTS),
    "ascii.pcd": pcd(ascii_rows(POINTS)),
    "order.pcd": pcd(ascii_rows(POINTS[:, [3, 2, 1, 0]]), fields="reflectance z y x"),
    "old.pcd": pcd(ascii_rows(POINTS), POINTS=None),
    "binary.pcd": pcd(POINTS.astype("<f4").tobytes(), storage="binary"),
    "newline.pcd": pcd(POINTS.astype("<f4").tobytes() + b"\n", storage="binary"),
}


@pytest.mark.parametrize("name", GOOD)
def test_every_format_gives_the_same_points(tmp_path, name):
    (tmp_path / name).write_bytes(GOOD[name])
    points = read_points(tmp_path / name)
    np.testing.assert_array_equal(points, POINTS)
    assert points.dtype == np.float32
    assert points.flags.writeable
    assert (tmp_path / name).suffix.lower() in POINT_SUFFIXES


def test_binary_pcd_of_mixed_types_and_repeated_fields(tmp_path):
    (tmp_path / "a.pcd").write_bytes(binary_mixed())
    np.testing.assert_allclose(read_points(tmp_path / "a.pcd"), POINTS * [1, 1, 1, 255], atol=0.5)


def test_bin_round_trip_and_other_widths(tmp_path):
    write_bin(tmp_path / "a.bin", POINTS)
    np.testing.assert_array_equal(read_points(str(tmp_path / "a.bin")), POINTS)
    (tmp_path / "five.bin").write_bytes(np.pad(POINTS, ((0, 0), (0, 1))).tobytes())
    np.testing.assert_array_equal(read_points(tmp_path / "five.bin", columns=5), POINTS)
    with pytest.raises(InputError, match="2 does not give x, y and z"):
        read_points(tmp_path / "a.bin", columns=2)


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.npy", saved(np.save, POINTS[:, :3])),
        ("a.pcd", pcd(ascii_rows(POINTS[:, :3]), fields="x y z", size="4 4 4", kind="F F F")),
    ],
)
def test_points_without_intensity_get_zero_and_a_warning(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    with pytest.warns(UserWarning, match="has no intensity among its columns x, y, z; 0 is used"):
        points = read_points(tmp_path / name)
    np.testing.assert_array_equal(points, POINTS * np.float32([1, 1, 1, 0]))


def test_no_points_are_points_where_a_header_says_so(tmp_path):
    (tmp_path / "a.npy").write_bytes(saved(np.save, POINTS[:0]))
    (tmp_path / "a.pcd").write_bytes(pcd(b"", POINTS=0))
    (tmp_path / "b.pcd").write_bytes(pcd(b"", POINTS=0, storage="binary"))
    for name in ("a.npy", "a.pcd", "b.pcd"):
        assert read_points(tmp_path / name).shape == (0, 4)


def test_values_are_not_cleaned(tmp_path):
    array = np.array([[np.nan, np.inf, 1e300, 255.0]])
    (tmp_path / "a.npy").write_bytes(saved(np.save, array))
    np.testing.assert_array_equal(read_points(tmp_path / "a.npy"), np.float32([[np.nan, np.inf, np.inf, 255]]))


BAD = {
    "empty.bin": (b"", "is empty; copy or record it again"),
    "short.bin": (
        bytes(40),
        r"has 40 bytes, not a multiple of 16 \(4 float32 per point\); copy it again, or pass",
    ),
    "scan.las": (bytes(16), "unknown suffix '.las'; convert it to one of .bin, .npy, .npz, .pcd, .ply"),
    "scan": (bytes(16), "unknown suffix ''; convert"),
    "flat.npy": (
        saved(np.save, POINTS.reshape(-1)),
        r"shape \(12,\) and type float32; save numbers of shape",
    ),
    "two.npy": (saved(np.save, POINTS[:, :2]), r"shape \(3, 2\)"),
    "text.npy": (saved(np.save, POINTS.astype(str)), "type <U"),
    "complex.npy": (saved(np.save, POINTS.astype(complex)), "type complex128"),
    "pickle.npy": (
        saved(np.save, POINTS.astype(object)),
        "not a .npy file of plain numbers; write it again with np.save",
    ),
    "cut.npy": (GOOD["a.npy"][:-1], "is cut short or not a .npy file"),
    "garbage.npy": (b"\x93NUMPY garbage", "is cut short or not a .npy file"),
    "archive.npy": (GOOD["one.npz"], "is cut short or not a .npy file"),
    "cut.npz": (GOOD["one.npz"][:-30], "not a .npz file of plain numbers; write it again with np.savez"),
    "array.npz": (GOOD["a.npy"], "is cut short or not a .npz file"),
    "text.npz": (b"x,y,z", "is cut short or not a .npz file"),
    "pickle.npz": (saved(np.savez, POINTS.astype(object)), "is cut short or not a .npz file"),
    "several.npz": (
        saved(np.savez, a=POINTS, b=POINTS),
        r"2 arrays \(a, b\) and none is named 'points'; write it again",
    ),
    "none.npz": (saved(np.savez), "0 arrays"),
    "garbage.pcd": (b"\x00\x01 nothing", r"malformed PCD header \('FIELDS'\); save it again with FIELDS"),
    "counts.pcd": (pcd(b"", size="4 4"), "malformed PCD header"),
    "type.pcd": (pcd(b"", kind="F F F X"), r"malformed PCD header \('X'\)"),
    "size.pcd": (pcd(b"", size="4 4 4 3"), "malformed PCD header"),
    "zero.pcd": (pcd(b"", size="4 4 4 0"), "field intensity has size 0 and count 1"),
    "number.pcd": (pcd(b"", POINTS="many"), "malformed PCD header"),
    "negative.pcd": (pcd(b"", POINTS=-1), "-1 points of 16 bytes"),
    "blank.pcd": (pcd(b"", POINTS=""), "malformed PCD header"),
    "nothing.pcd": (pcd(b"", fields="", size="", kind=""), "3 points of 0 bytes"),
    "rgb.pcd": (
        pcd(b"", fields="x y rgb w", POINTS=0),
        "has the columns x, y, rgb, w but not z; save it again with x, y, z",
    ),
    "rows.pcd": (
        pcd(ascii_rows(POINTS[:2])),
        "announces 3 points of 4 numbers but holds 8 numbers; copy or save",
    ),
    "more.pcd": (pcd(ascii_rows(POINTS), POINTS=2), "announces 2 points of 4 numbers but holds 12 numbers"),
    "word.pcd": (pcd(b"1 2 3 four\n"), "has a point that is not a number; save it again"),
    "cut.pcd": (
        GOOD["binary.pcd"][:-1],
        "announces 3 points of 16 bytes but holds 47 bytes; copy or save it again",
    ),
    "packed.pcd": (
        pcd(b"", storage="zip"),
        "stores its points as 'zip'; save it as ascii, binary or binary_compressed",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_an_unusable_file_gets_one_sentence(tmp_path, name):
    data, message = BAD[name]
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=message) as caught:
        read_points(tmp_path / name)
    assert_one_sentence(str(caught.value), tmp_path / name)


def test_no_file_and_a_directory(tmp_path):
    for path, message in [
        (tmp_path / "no.bin", "does not exist; check the path"),
        (tmp_path, "is a directory; name a file inside it"),
    ]:
        with pytest.raises(InputError, match=message) as caught:
            read_points(path)
        assert_one_sentence(str(caught.value), path)


def assert_one_sentence(message, path):
    assert message.startswith(str(path))
    assert message.endswith(".")
    assert not re.search(r"\. [A-Z]|\n", message)


@pytest.mark.filterwarnings("ignore:.*has no intensity")
@settings(max_examples=150, deadline=None)
@given(name=st.sampled_from(sorted(GOOD)), data=st.data())
def test_damaged_files_are_read_or_refused(tmp_path_factory, name, data):
    content = bytearray(GOOD[name])
    for place in data.draw(st.lists(st.integers(0, len(content) - 1), max_size=4)):
        content[place] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("damaged") / name
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    try:
        points = read_points(path)
    except InputError:
        return
    assert points.dtype == np.float32
    assert points.shape[1:] == (4,)


@pytest.mark.reference
def test_kitti_cloud(shared):
    points = read_points(shared / "kitti_full/training/velodyne/000000.bin")
    assert len(points) > 100_000
    assert points[:, 3].min() >= 0
    assert points[:, 3].max() <= 1
