"""KITTI's calibration files and image sizes."""

import re
import zlib

import numpy as np
import pytest
from kitti_samples import CALIBRATION, assert_refused

from ciassd_jax.formats.kitti_camera import image_size_for, read_calibration, read_image_size


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


@pytest.mark.parametrize("read", [read_calibration, read_image_size])
def test_no_file_and_a_directory(tmp_path, read):
    assert_refused(read, tmp_path / "no.txt", "does not exist; check the path")
    assert_refused(read, tmp_path, "is a directory; name a file inside it")


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
    assert read_image_size(tmp_path / "a.png") == (1242, 375)
    for data in (b"", png[:20], b"\xff\xd8" + png[2:]):
        (tmp_path / "a.png").write_bytes(data)
        assert_refused(read_image_size, tmp_path / "a.png", "is not a PNG or JPEG image; copy it again")


@pytest.mark.parametrize(
    "options", [{}, {"progressive": True}, {"exif": b"Exif" + bytes(60000), "icc_profile": bytes(150000)}]
)
def test_the_size_of_a_jpeg_is_pillow_s(tmp_path, options):
    """Also behind previews and profiles that are larger than what is read first, whatever the name of the file."""
    image = pytest.importorskip("PIL.Image").fromarray(np.zeros((37, 123, 3), np.uint8))
    image.save(tmp_path / "a.jpg", **options)
    assert read_image_size(tmp_path / "a.jpg") == (123, 37)
    (tmp_path / "a.png").write_bytes((tmp_path / "a.jpg").read_bytes())
    assert read_image_size(tmp_path / "a.png") == (123, 37)
    for end in (2, 3, 20, 100):
        (tmp_path / "a.jpg").write_bytes((tmp_path / "a.png").read_bytes()[:end])
        assert_refused(read_image_size, tmp_path / "a.jpg", "is not a PNG or JPEG image; copy it again")


@pytest.mark.reference
def test_png_sizes_agree_with_focal_lengths(shared):
    root = shared / "kitti_full/training"
    for path in sorted((root / "image_2").glob("*.png")):
        calibration = read_calibration(root / "calib" / f"{path.stem}.txt")
        assert read_image_size(path) == image_size_for(calibration)
