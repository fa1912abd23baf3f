"""Data in OpenPCDet's custom layout, without a camera."""

import re
from pathlib import Path

import numpy as np
import pytest
from mini_folders import OBJECTS, full_cloud, object_boxes, write_custom

from ciassd_jax.data.folders import open_dataset
from ciassd_jax.data.frames import difficulty_by_points
from ciassd_jax.data.gt_sampling import build_database, open_database
from ciassd_jax.formats.custom_rows import read_custom_rows
from ciassd_jax.formats.errors import FormatWarning, InputError


def test_a_frame_is_what_its_files_say(tmp_path: Path) -> None:
    dataset = open_dataset(write_custom(tmp_path), "train")
    frame = dataset.read(1)
    assert (frame.name, frame.names, frame.camera) == ("b", tuple(OBJECTS), None)
    np.testing.assert_array_equal(frame.points, full_cloud(1))
    np.testing.assert_array_equal(frame.boxes.to_array(), object_boxes().to_array())
    assert frame.boxes.center.dtype == np.float64
    # 60 points in each object, and perhaps a few of those around.
    assert frame.difficulty.tolist() == [1, 1, 1]
    assert [path.name for path in dataset.sources(1)] == ["b.npy", "b.txt"]


def test_a_frame_without_objects(tmp_path: Path) -> None:
    (write_custom(tmp_path) / "labels/a.txt").write_text("\n")
    frame = open_dataset(tmp_path, "train").read(0)
    assert (frame.names, frame.boxes.center.shape, frame.difficulty.shape) == ((), (0, 3), (0,))


def test_points_that_are_not_finite_are_left_out_with_a_warning(tmp_path: Path) -> None:
    root = write_custom(tmp_path)
    points = full_cloud(0)
    points[:3, :3] = [[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf]]
    np.save(root / "points/a.npy", points)
    with pytest.warns(FormatWarning, match=rf"a\.npy: 3 of {len(points)} points are not finite; they were left out\."):
        frame = open_dataset(root, "train").read(0)
    np.testing.assert_array_equal(frame.points, points[3:])


@pytest.mark.parametrize("suffix", [".bin", ".npz", ".NPY", ".pcd"])
def test_clouds_have_any_suffix(tmp_path: Path, suffix: str) -> None:
    root = write_custom(tmp_path)
    (root / "points/a.npy").unlink()
    path, points = root / f"points/a{suffix}", full_cloud(0)
    if suffix == ".bin":
        points.tofile(path)
    elif suffix == ".npz":
        np.savez(path, points=points)
    elif suffix == ".NPY":
        with open(path, "wb") as stream:
            np.save(stream, points)
    else:
        header = "FIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nWIDTH {0}\nHEIGHT 1\nPOINTS {0}\nDATA binary\n"
        path.write_bytes(header.format(len(points)).encode() + points.tobytes())
    dataset = open_dataset(root, "train")
    np.testing.assert_array_equal(dataset.read(0).points, points)
    assert [one.name for one in dataset.sources(0)] == [path.name, "a.txt"]


def test_columns_are_those_of_all_clouds_and_of_the_database(tmp_path: Path) -> None:
    root = write_custom(tmp_path)
    for name in "ab":
        points = full_cloud(0)
        np.save(root / f"points/{name}.npy", np.insert(points, 3, 7, axis=1))
    columns = ("x", "y", "z", "ring", "intensity")
    dataset = open_dataset(root, "train", columns=columns)
    np.testing.assert_array_equal(dataset.read(0).points, full_cloud(0))
    build_database(dataset, tmp_path / "objects.bin")
    assert open_database(tmp_path / "objects.bin", dataset).points[:, 3].max() <= 1
    with pytest.raises(InputError, match="stale or of another split"):
        open_database(tmp_path / "objects.bin", open_dataset(root, "train"))


def test_a_problem_of_many_frames_is_told_once(tmp_path: Path) -> None:
    root = write_custom(tmp_path, names=tuple("abc"))
    for path in (root / "points").iterdir():
        np.save(path, np.load(path)[:, :3])
    message = rf"^{root}/points/a\.npy has no intensity .* Other frames with this problem: 2\.$"
    with pytest.warns(FormatWarning, match=message) as caught:
        build_database(open_dataset(root, "train"), tmp_path / "objects.bin")
    assert len(caught) == 1


def test_difficulty_is_by_points() -> None:
    inside = np.array([0, 4, 5, 29, 30, 99, 100, 5000])
    assert difficulty_by_points(inside).tolist() == [-1, -1, 2, 2, 1, 1, 0, 0]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 2 3 4 5 6 7", r"line 2: 7 columns; a label has the 8 x y z dx dy dz heading class, so write it again"),
        ("1 2 3 4 5 6 7 Car 1", "line 2: 9 columns"),
        ("Car 1 2 3 4 5 6 7", r"line 2: could not convert string to float: 'Car'; write a number there"),
        ("1 2 3 4 inf 6 7 Car", r"line 2: a value is not finite; write a number there"),
    ],
)
def test_an_unusable_row_gets_one_sentence(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "a.txt"
    path.write_text(f"1 2 3 4 5 6 7 Car\n{line}\n")
    with pytest.raises(InputError, match=message) as caught:
        read_custom_rows(path)
    assert str(caught.value).startswith(f"{path}, ")
    assert not re.search(r"\. [A-Z]|\n", str(caught.value))
