"""KITTI's text files, and boxes between the LiDAR and the camera."""

import re
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.kitti import (
    Calibration,
    ObjectRow,
    boxes_to_rows,
    format_row,
    image_size_for,
    lidar_to_image,
    read_calibration,
    read_png_size,
    read_rows,
    rows_to_boxes,
    write_rows,
)
from ciassd_jax.types import Boxes

# SPEC A.2.
CALIBRATION = Calibration(
    np.array([[721.5377, 0, 609.5593, 44.85728], [0, 721.5377, 172.854, 0.2163791], [0, 0, 1, 0.002745884]]),
    np.array(
        [
            [0.9999239, 0.00983776, -0.00744505],
            [-0.0098698, 0.9999421, -0.00427846],
            [0.00740253, 0.00435161, 0.9999631],
        ]
    ),
    np.array(
        [
            [7.533745e-3, -0.9999714, -6.16602e-4, -4.069766e-3],
            [1.480249e-2, 7.280733e-4, -0.9998902, -7.631618e-2],
            [0.9998621, 7.52379e-3, 1.480755e-2, -0.2717806],
        ]
    ),
)
ROW = ObjectRow("Car", 0.0, 0, -1.766845, (0, 0, 0, 0), (1.57, 1.73, 4.15), (1.84, 1.47, 8.41), -1.56, 0.5)
EVERYTHING = (10**9, 10**9)


def write_calibration(path, names=("P2:", "R0_rect:", "Tr_velo_to_cam:"), calibration=CALIBRATION):
    lines = (
        " ".join([name, *map(repr, matrix.ravel().tolist())]) + "\n"
        for name, matrix in zip(names, calibration, strict=True)
    )
    path.write_text("P0: 1 2 3\n\n" + "".join(lines))


@pytest.mark.parametrize(
    "names",
    [
        ("P2:", "R0_rect:", "Tr_velo_to_cam:"),
        ("P2:", "R_rect", "Tr_velo_cam"),
    ],
)
def test_calibration_is_read_by_name(tmp_path, names):
    write_calibration(tmp_path / "a.txt", names)
    read = read_calibration(tmp_path / "a.txt")
    for given_matrix, matrix in zip(CALIBRATION, read, strict=True):
        np.testing.assert_array_equal(matrix, given_matrix)
        assert matrix.dtype == np.float64


def drop(text):
    return re.sub(r"(?m)^R0_rect.*\n", "", text)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (drop, "has no line R0_rect; use the calibration file that KITTI gives"),
        (lambda text: "", "has no line P2;"),
        (
            lambda text: text[:-20].rsplit(" ", 1)[0],
            "line Tr_velo_to_cam: not the 12 numbers of an invertible matrix; copy",
        ),
        (lambda text: text.replace("721.5377", "wide"), "line P2: not the 12 numbers"),
        (lambda text: text.replace("0.9999239", "nan"), "line R0_rect: not the 9 numbers"),
        (lambda text: drop(text) + "R0_rect: 0 0 0 0 0 0 0 0 0", "line R0_rect: not the 9 numbers"),
    ],
)
def test_an_unusable_calibration_gets_one_sentence(tmp_path, damage, message):
    path = tmp_path / "a.txt"
    write_calibration(path)
    path.write_text(damage(path.read_text()))
    assert_refused(read_calibration, path, message)


@pytest.mark.parametrize("read", [read_calibration, read_rows, read_png_size])
def test_no_file_and_a_directory(tmp_path, read):
    assert_refused(read, tmp_path / "no.txt", "does not exist; check the path")
    assert_refused(read, tmp_path, "is a directory; name a file inside it")


def assert_refused(read, path, message):
    with pytest.raises(InputError, match=message) as caught:
        read(path)
    assert str(caught.value).startswith(str(path))
    assert str(caught.value).endswith(".")
    assert not re.search(r"\. [A-Z]|\n", str(caught.value))


@pytest.mark.parametrize(
    ("focal_length", "size"),
    [
        (721.5377, (1242, 375)),
        (707.0493, (1224, 370)),
        (718.3351, (1238, 374)),
        (718.856, (1241, 376)),
        (1266.417, None),
    ],
)
def test_image_size_follows_from_the_focal_length(focal_length, size):
    projection = CALIBRATION.projection.copy()
    projection[0, 0] = focal_length
    assert image_size_for(CALIBRATION._replace(projection=projection)) == size


def test_png_size(tmp_path):
    header = b"IHDR" + (1242).to_bytes(4, "big") + (375).to_bytes(4, "big") + bytes([8, 2, 0, 0, 0])
    png = b"\x89PNG\r\n\x1a\n" + (13).to_bytes(4, "big") + header + zlib.crc32(header).to_bytes(4, "big")
    (tmp_path / "a.png").write_bytes(png)
    assert read_png_size(tmp_path / "a.png") == (1242, 375)
    for data in (b"", png[:20], b"\xff\xd8" + png[2:]):
        (tmp_path / "a.png").write_bytes(data)
        assert_refused(read_png_size, tmp_path / "a.png", "is no PNG image; give")


def test_rows_are_read_and_written(tmp_path):
    path = tmp_path / "a.txt"
    label = "Cyclist 0.50 3 -1.5 1 2 3 4 1.6 0.5 1.7 -5 1.6 15.25 0.1"
    path.write_bytes(f"{label}\r\n\n{label} 0.25".encode())
    row = ObjectRow("Cyclist", 0.5, 3, -1.5, (1, 2, 3, 4), (1.6, 0.5, 1.7), (-5, 1.6, 15.25), 0.1)
    assert read_rows(path) == [row, row._replace(score=0.25)]
    assert format_row(row) == (
        "Cyclist 0.5000 3 -1.5000 1.0000 2.0000 3.0000 4.0000 1.6000 0.5000 1.7000 -5.0000 1.6000 15.2500 0.1000"
    )
    assert format_row(row._replace(score=0.25)) == format_row(row) + " 0.2500"
    write_rows(path, [row, row._replace(score=0.25)])
    assert read_rows(path) == [row, row._replace(score=0.25)]
    write_rows(path, [])
    assert path.read_bytes() == b""
    assert read_rows(path) == []


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("Car 0 0 0", "line 2: 4 columns; a label has 15 and a result 16, so write it again"),
        ("Car" + " 0" * 16, "line 2: 17 columns"),
        ("Car 0 0 x" + " 0" * 11, "line 2: could not convert string to float: 'x'; write a number there"),
        ("Car 0 0.5" + " 0" * 12, "line 2: invalid literal .* '0.5'; .* for the occlusion a whole one"),
        ("Car 0 0 nan" + " 0" * 11, "line 2: a value is not finite; write a number there"),
        ("\x00\xff\x93", "line 2: 1 columns"),
    ],
)
def test_an_unusable_row_gets_one_sentence(tmp_path, line, message):
    (tmp_path / "a.txt").write_bytes(f"{format_row(ROW)}\n{line}\n".encode("latin-1"))
    assert_refused(read_rows, tmp_path / "a.txt", message)


def test_golden_label_to_lidar_to_image():
    boxes = rows_to_boxes([ROW], CALIBRATION)
    np.testing.assert_allclose(boxes.center, [[8.698237, -1.825290, -0.688665]], atol=1e-6)
    np.testing.assert_array_equal(boxes.size, [[4.15, 1.73, 1.57]])
    np.testing.assert_allclose(boxes.yaw, 1.56 - np.pi / 2)
    (row,), kept = boxes_to_rows(boxes, np.array([0.5]), ["Car"], CALIBRATION, EVERYTHING)
    assert kept.tolist() == [0]
    np.testing.assert_allclose(row.bbox, (682.235839, 161.411841, 922.229593, 340.413049), atol=1e-6)
    np.testing.assert_allclose(row.alpha, -1.766845, atol=1e-6)
    assert_same_object(row, ROW)


def assert_same_object(row, other):
    assert (row.type, row.score) == (other.type, other.score)
    np.testing.assert_allclose(row.dimensions, other.dimensions, atol=1e-6)
    np.testing.assert_allclose(row.location, other.location, atol=1e-6)
    turn = (row.rotation_y - other.rotation_y + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(turn, 0, atol=1e-6)


def between(low, high):
    return st.floats(low, high, width=32)


@settings(deadline=None)
@given(
    st.lists(
        st.builds(
            lambda location, dimensions, rotation_y, score: ROW._replace(
                location=location, dimensions=dimensions, rotation_y=rotation_y, score=score
            ),
            st.tuples(between(-20, 20), between(-3, 3), between(30, 80)),
            st.tuples(between(0.5, 3), between(0.5, 3), between(0.5, 8)),
            between(-4, 4),
            between(0, 1),
        ),
        max_size=4,
    )
)
def test_rows_to_boxes_to_rows_is_the_identity(rows):
    boxes = rows_to_boxes(rows, CALIBRATION)
    scores = np.array([row.score for row in rows])
    again, kept = boxes_to_rows(boxes, scores, [row.type for row in rows], CALIBRATION, (1242, 375))
    assert kept.tolist() == list(range(len(rows)))
    for row, other in zip(again, rows, strict=True):
        assert_same_object(row, other)
        assert -np.pi <= row.rotation_y <= np.pi
        x1, y1, x2, y2 = row.bbox
        assert 0 <= x1 <= x2 <= 1242
        assert 0 <= y1 <= y2 <= 375


def test_boxes_outside_the_image_are_left_out_and_indices_say_which():
    centers = [[20, 0, -1], [20, 60, -1], [-20, 0, -1], [20, 0, 40], [30, 2, -1], [np.nan, 0, 0]]
    boxes = Boxes(np.array(centers), np.full((6, 3), 2.0), np.zeros(6))
    names = ["Car", "Van", "Car", "Car", "Cyclist", "Car"]
    rows, kept = boxes_to_rows(boxes, np.arange(6) / 10, names, CALIBRATION, (1242, 375))
    assert kept.tolist() == [0, 4]
    assert [(row.type, row.score) for row in rows] == [("Car", 0.0), ("Cyclist", 0.4)]


def test_a_box_around_the_camera_plane_covers_what_its_visible_part_covers():
    """A bus beside the camera has the image box of its part in front, sampled densely."""
    boxes = Boxes(np.array([[0.0, 4.0, -0.5]]), np.array([[12.0, 2.5, 3.0]]), np.array([0.2]))
    (row,), _ = boxes_to_rows(boxes, np.zeros(1), ["Bus"], CALIBRATION, (1242, 375))

    along, across, up = np.meshgrid(*[np.linspace(-0.5, 0.5, 121)] * 3, indexing="ij")
    local = np.stack([along, across, up], -1).reshape(-1, 3) * boxes.size[0]
    cos, sin = np.cos(0.2), np.sin(0.2)
    turned = local @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    a, b, depth = lidar_to_image(CALIBRATION) @ np.vstack([(turned + boxes.center[0]).T, np.ones(len(local))])
    front = depth > 0.001
    u, v = a[front] / depth[front], b[front] / depth[front]
    sampled = np.clip([u.min(), v.min(), u.max(), v.max()], 0, [1242, 375, 1242, 375])
    np.testing.assert_allclose(row.bbox, sampled, atol=8)
    assert row.bbox[0] == 0
    assert row.bbox[2] < 500


def test_every_order_of_depth_is_finite():
    depths = np.linspace(-4, 4, 161)
    boxes = Boxes(np.stack([depths, 0.3 * depths, -0.7 + 0 * depths], -1), np.full((161, 3), 2.0), depths)
    rows, kept = boxes_to_rows(boxes, depths, ["Car"] * 161, CALIBRATION, (1242, 375))
    assert 80 <= len(kept) < 161
    assert kept.tolist() == list(range(kept[0], 161))
    assert np.isfinite([row.bbox for row in rows]).all()


@pytest.mark.reference
def test_labels_project_onto_their_image_boxes(shared):
    """Labels have two decimals and their image boxes are not projections: agreement is to a few pixels."""
    errors = []
    for path in sorted((shared / "kitti/training/label_2").glob("*.txt")):
        calibration = read_calibration(shared / "kitti/training/calib" / path.name)
        size = image_size_for(calibration)
        assert size is not None
        labels = [row for row in read_rows(path) if row.type == "Car" and row.truncated == 0]
        boxes = rows_to_boxes(labels, calibration)
        scores = np.zeros(len(labels))
        rows, kept = boxes_to_rows(boxes, scores, ["Car"] * len(labels), calibration, size)
        assert len(kept) == len(labels)
        for row, label in zip(rows, labels, strict=True):
            assert_same_object(row._replace(score=None), label)
            errors.append(np.abs(np.subtract(row.bbox, label.bbox)))
    errors = np.array(errors)
    assert len(errors) == 517
    assert errors.max() < 5
    assert np.quantile(errors, 0.99) < 2


@pytest.mark.reference
def test_png_sizes_agree_with_focal_lengths(shared):
    root = shared / "kitti_full/training"
    for path in sorted((root / "image_2").glob("*.png")):
        calibration = read_calibration(root / "calib" / f"{path.stem}.txt")
        assert read_png_size(path) == image_size_for(calibration)
