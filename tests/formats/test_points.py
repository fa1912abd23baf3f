"""Point files: what is read, and the one sentence that every unusable file gets."""

import re
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from point_samples import FACES, GOOD, LITTLE, POINTS, ascii_rows, compressed, pcd, ply, saved, structured

from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.points import POINT_SUFFIXES, parse_columns, read_points, write_bin


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
    np.testing.assert_allclose(read_points(tmp_path / "a.pcd"), POINTS, atol=0.5 / 255)


@pytest.mark.parametrize(("type_of_intensity", "expected"), [("U 1", 0.4), ("F 4", 102), ("U 2", 102)])
def test_an_intensity_that_is_a_byte_is_a_fraction_of_255(tmp_path, type_of_intensity, expected):
    kind, size = type_of_intensity.split()
    header = pcd(b"1 2 3 102\n", POINTS=1, size=f"4 4 4 {size}", kind=f"F F F {kind}", storage="ascii")
    (tmp_path / "a.pcd").write_bytes(header)
    np.testing.assert_allclose(read_points(tmp_path / "a.pcd")[0, 3], expected, rtol=1e-6)


@pytest.mark.parametrize("storage", ["binary", "binary_compressed"])
def test_fields_of_several_values_and_no_points(tmp_path, storage):
    body = bytes(8) if storage == "binary_compressed" else b""
    (tmp_path / "a.pcd").write_bytes(pcd(body, POINTS=0, COUNT="1 1 2 1", storage=storage))
    assert read_points(tmp_path / "a.pcd").shape == (0, 4)


def test_compressed_fields_stand_one_after_the_other(tmp_path):
    doubles = POINTS.astype("<f8")
    parts = [np.arange(6, dtype="<u2"), *doubles[:, :3].T, np.uint8([128, 255, 0])]
    body = compressed(b"".join(part.tobytes() for part in parts))
    names = {"fields": "ring x y z i", "size": "2 8 8 8 1", "kind": "U F F F U", "COUNT": "2 1 1 1 1"}
    (tmp_path / "a.pcd").write_bytes(pcd(body, storage="binary_compressed", **names))
    np.testing.assert_allclose(read_points(tmp_path / "a.pcd"), np.c_[POINTS[:, :3], np.array([128, 255, 0]) / 255])


def test_bin_round_trip(tmp_path):
    write_bin(tmp_path / "a.bin", POINTS)
    np.testing.assert_array_equal(read_points(str(tmp_path / "a.bin")), POINTS)


@pytest.mark.parametrize(
    ("columns", "order"),
    [
        (6, [0, 1, 2, 3, 4, 5]),
        (("x", "y", "z", "intensity", "ring", "time"), [0, 1, 2, 3, 4, 5]),
        (("Ring", "Z", "Reflectivity", "time", "X", "Y"), [4, 2, 3, 5, 0, 1]),
        (("t", "i", "x", "ring", "y", "z"), [5, 3, 0, 4, 1, 2]),
    ],
)
def test_columns_by_number_and_by_name(tmp_path, columns, order):
    array = np.c_[POINTS, [7, 8, 9], [0.1, 0.2, 0.3]].astype("<f4")[:, order]
    (tmp_path / "a.bin").write_bytes(array.tobytes())
    np.save(tmp_path / "a.npy", array)
    for name in ("a.bin", "a.npy"):
        np.testing.assert_array_equal(read_points(tmp_path / name, columns), POINTS)


def test_columns_are_parsed():
    assert parse_columns(" 5") == 5
    assert parse_columns("x, y,z,intensity") == ("x", "y", "z", "intensity")


@pytest.mark.parametrize("columns", [2, -1, (), ("x", "y", "i"), ("x", "x", "y", "z"), ("five",), 10**20])
def test_columns_need_x_y_and_z(tmp_path, columns):
    write_bin(tmp_path / "a.bin", POINTS)
    with pytest.raises(InputError, match=r"does not give x, y and z one column each; pass .* as `columns`\."):
        read_points(tmp_path / "a.bin", columns)


def test_columns_of_an_array_are_its_own(tmp_path):
    np.save(tmp_path / "a.npy", POINTS)
    with pytest.raises(InputError, match="has 4 columns, not 5; pass 4, or as many names, as `columns`"):
        read_points(tmp_path / "a.npy", 5)
    np.testing.assert_array_equal(read_points(tmp_path / "a.npy", 4), POINTS)


@pytest.mark.filterwarnings("ignore:.*has no intensity")
@pytest.mark.parametrize("rows", [3, 4, 5])
@pytest.mark.parametrize("count", [13, 500])
def test_an_array_of_columns_is_to_be_transposed(tmp_path, rows, count):
    np.save(tmp_path / "a.npy", np.ones((rows, count)))
    for columns in (None, 4):
        with pytest.raises(InputError, match=rf"of shape \({rows}, {count}\); transpose it to \({count}, {rows}\)"):
            read_points(tmp_path / "a.npy", columns)
    assert read_points(tmp_path / "a.npy", count).shape == (rows, 4)
    np.save(tmp_path / "a.npy", np.ones((count, rows)))
    assert len(read_points(tmp_path / "a.npy", rows)) == count


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.npy", saved(np.save, POINTS[:, :3])),
        ("b.npy", saved(np.save, structured(POINTS[:, :3], "x y z"))),
        ("a.ply", ply(ascii_rows(POINTS[:, :3]), properties="float x,float y,float z")),
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
    (tmp_path / "a.ply").write_bytes(ply(b"").replace(b"vertex 3", b"vertex 0"))
    for name in ("a.npy", "a.pcd", "a.ply"):
        assert read_points(tmp_path / name).shape == (0, 4)


def test_a_file_without_intensity_lists_what_it_has(tmp_path):
    (tmp_path / "a.pcd").write_bytes(pcd(ascii_rows(POINTS), fields="x y z Signal"))
    with pytest.warns(UserWarning, match="no intensity among its columns x, y, z, Signal; 0 is used"):
        read_points(tmp_path / "a.pcd")


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
    "zip.pcd": (pcd(b"", storage="zip"), "stores its points as 'zip'; save it as ascii, binary or binary_compressed"),
    "sizes.pcd": (
        pcd(compressed(bytes(44)), storage="binary_compressed"),
        "announces 48 bytes but holds 44; copy or save it again",
    ),
    "cut_packed.pcd": (GOOD["packed.pcd"][:-1], "is cut short; copy or save it again"),
    "outside.pcd": (
        pcd(struct.pack("<II", 2, 48) + b"\x20\x00", storage="binary_compressed"),
        "is damaged: the compressed data points outside itself; copy",
    ),
    "bomb.pcd": (
        pcd(struct.pack("<II", 1000, 48) + b"\0a" + b"\xe0\xff\0" * 332 + b"\0\0", storage="binary_compressed"),
        "is damaged: the compressed data does not give 48 bytes; copy",
    ),
    "garbage.ply": (b"\0\1 nothing", "malformed PLY header .it does not begin with 'ply'.; save it again as"),
    "endless.ply": (b"ply\nformat ascii 1.0\n", "it has no end_header"),
    "unnamed.ply": (ply(b"").replace(b"format", b"comment"), "it has no format"),
    "format.ply": (ply(b"", storage="zip"), r"malformed PLY header \(format zip 1.0\)"),
    "type.ply": (ply(b"", properties="half x"), r"malformed PLY header \('half'\)"),
    "property.ply": (b"ply\nproperty int x\n", "malformed PLY header"),
    "number.ply": (ply(b"").replace(b"vertex 3", b"vertex many"), "malformed PLY header"),
    "negative.ply": (ply(b"").replace(b"vertex 3", b"vertex -3"), r"\(element vertex -3\)"),
    "points.ply": (ply(b"").replace(b"vertex", b"point"), "has no element 'vertex'; save its points again as vertices"),
    "list.ply": (ply(b"", properties="float x,list uchar int y"), "has a list in or before its vertices; save its"),
    "faces.ply": (ply(b"", before=FACES), "has a list in or before its vertices"),
    "cut.ply": (ply(LITTLE[:-1], storage="binary_little_endian"), "announces 3 vertices but holds 2; copy or save"),
    "more.ply": (ply(ascii_rows(POINTS) * 2), "announces 3 vertices but holds 6"),
    "word.ply": (ply(b"1 2 3 four\n" * 3), "has a vertex that is not made of numbers; save it again"),
    "bare.ply": (ply(b"", properties=""), "announces 3 vertices but holds 0"),
    "flat.ply": (ply(bytes(24), properties="float x,float y", storage="binary_big_endian"), "but not z; save it again"),
    "nothing.npy": (saved(np.save, np.zeros(3, [("a", "U3")])), "save numbers of shape"),
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
    except InputError as error:
        assert_one_sentence(str(error), path)
        return
    assert points.dtype == np.float32
    assert points.shape[1:] == (4,)


@pytest.mark.reference
def test_kitti_cloud(shared):
    points = read_points(shared / "kitti_full/training/velodyne/000000.bin")
    assert len(points) > 100_000
    assert points[:, 3].min() >= 0
    assert points[:, 3].max() <= 1


@pytest.mark.parametrize("storage", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_bytes_of_a_ply_are_fractions_of_255(tmp_path, storage):
    order = ">" if "big" in storage else "<"
    rows = np.array([(1, 2, 3, 0), (4, 5, 6, 51), (7, 8, 9, 255)], f"{order}f4,{order}f4,{order}f4,u1")
    body = ascii_rows(np.array(rows.tolist(), int)) if storage == "ascii" else rows.tobytes()
    path = tmp_path / "a.ply"
    path.write_bytes(ply(body, properties="float x,float y,float z,uchar intensity", storage=storage))
    np.testing.assert_allclose(read_points(path)[:, 3], [0, 0.2, 1])
