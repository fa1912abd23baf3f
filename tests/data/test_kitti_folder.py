"""KITTI's folders: frames in the LiDAR frame, clouds cropped to the image, and files that cannot be used."""

import pickle
import re
from pathlib import Path

import numpy as np
import pytest
from mini_folders import NAMES, OBJECTS, full_cloud, object_boxes, object_points, png_header, write_kitti
from small import CALIBRATION, IMAGE_SIZE

from ciassd_jax.data.clouds import find_clouds, find_image, read_cloud
from ciassd_jax.data.folders import open_dataset
from ciassd_jax.data.frames import Frame, difficulty_by_points
from ciassd_jax.data.kitti import crop_to_view, read_seen_points, write_reduced
from ciassd_jax.evaluation.objects import labels_from_frame
from ciassd_jax.formats.errors import FormatWarning, InputError
from ciassd_jax.formats.kitti_boxes import boxes_to_rows, rows_to_boxes
from ciassd_jax.formats.kitti_camera import Camera, lidar_to_image, read_camera
from ciassd_jax.formats.kitti_rows import DONT_CARE, ObjectRow, read_labels
from ciassd_jax.formats.points import read_points, write_bin
from ciassd_jax.ops.footprints import points_in_boxes

# A focal length of KITTI's, whose image is 1242 x 375.
KITTI_CALIBRATION = CALIBRATION.replace("300", "721.5377")


def seen(points: np.ndarray, camera: Camera) -> np.ndarray:
    """KITTI's crop by projection: depth from 0.001 to 100 m and pixels strictly inside the image."""
    width, height = camera.image_size
    a, b, d = lidar_to_image(camera.calibration) @ np.vstack([points[:, :3].T.astype(np.float64), np.ones(len(points))])
    with np.errstate(divide="ignore"):
        return (d > 0.001) & (d < 100) & (a / d > 0) & (a / d < width) & (b / d > 0) & (b / d < height)


def read_first(root: Path, **options: object) -> Frame:
    return open_dataset(root, "all", **options).read(0)


def test_a_frame_in_the_lidar_frame(tmp_path: Path) -> None:
    frame = open_dataset(write_kitti(tmp_path), "all").read(1)
    assert frame.name == "000001"
    assert frame.names == tuple(OBJECTS)
    assert frame.boxes.center.dtype == np.float64
    np.testing.assert_allclose(frame.boxes.center, object_boxes().center, atol=1e-3)
    np.testing.assert_allclose(frame.boxes.size, object_boxes().size, atol=1e-3)
    turn = frame.boxes.yaw - object_boxes().yaw
    np.testing.assert_allclose((turn + np.pi) % (2 * np.pi) - np.pi, 0, atol=1e-3)
    assert frame.difficulty.tolist() == [0, 0, 0]
    assert frame.camera is not None
    assert frame.camera.image_size == IMAGE_SIZE
    cloud = full_cloud(1)
    expected = cloud[seen(cloud, frame.camera)]
    assert 180 <= len(expected) < len(cloud)
    np.testing.assert_array_equal(frame.points, expected)


def test_reduced_clouds_are_taken_as_they_are(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    reduced = root / "training" / "velodyne_reduced"
    reduced.mkdir()
    write_bin(reduced / "000000.bin", full_cloud(7))
    dataset = open_dataset(root, "all")
    np.testing.assert_array_equal(dataset.read(0).points, full_cloud(7))
    assert len(dataset.read(1).points) < len(full_cloud(1))
    assert [path.parent.name for path in dataset.sources(0)] == ["velodyne_reduced", "calib", "label_2"]


def test_reduced_clouds_are_written_once(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    before = [open_dataset(root, "all").read(index).points for index in range(3)]
    assert write_reduced(root, None) == 3
    assert write_reduced(root, None) == 0
    for name, points in zip(NAMES, before, strict=True):
        np.testing.assert_array_equal(read_points(root / f"training/velodyne_reduced/{name}.bin"), points)


def test_test_frames_have_no_labels(tmp_path: Path) -> None:
    root = write_kitti(tmp_path, part="testing", clouds="velodyne_reduced")
    (root / "ImageSets").mkdir()
    (root / "ImageSets/test.txt").write_text("000004\n")
    frame = open_dataset(root, "test").read(0)
    assert (frame.name, frame.names, len(frame.boxes.yaw), len(frame.difficulty)) == ("000004", (), 0, 0)
    np.testing.assert_array_equal(frame.points, object_points(2))


def test_an_empty_label_file_is_a_frame_without_objects(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    (root / "training/label_2/000000.txt").write_text("")
    frame = read_first(root)
    assert (frame.names, frame.boxes.center.shape, frame.difficulty.shape) == ((), (0, 3), (0,))


def test_workers_can_pickle_a_data_set(tmp_path: Path) -> None:
    dataset = pickle.loads(pickle.dumps(open_dataset(write_kitti(tmp_path), "all")))
    assert dataset.read(2).name == "000004"


def test_the_image_size_is_given_or_the_png_s_or_the_usual(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    (root / "training/image_2/000000.png").write_bytes(png_header(320, 200))
    for options, size in (({}, (320, 200)), ({"image_size": (100, 90)}, (100, 90))):
        frame = read_first(root, **options)
        assert frame.camera is not None
        assert frame.camera.image_size == size
        np.testing.assert_array_equal(frame.points, full_cloud(0)[seen(full_cloud(0), frame.camera)])


@pytest.mark.parametrize("suffix", [".jpg", ".JPG", ".jpeg"])
def test_images_may_be_jpegs(tmp_path: Path, suffix: str) -> None:
    image = pytest.importorskip("PIL.Image").fromarray(np.zeros((200, 320, 3), np.uint8))
    root = write_kitti(tmp_path)
    for path in (root / "training/image_2").iterdir():
        path.unlink()
        image.save(path.with_suffix(suffix), "JPEG")
    camera = read_first(root).camera
    assert camera is not None
    assert camera.image_size == (320, 200)
    cloud = root / "training/velodyne/000000.bin"
    (file,) = find_clouds(cloud)
    assert file.camera is not None
    assert file.camera.image_size == (320, 200)
    assert find_image(cloud) == root / f"training/image_2/000000{suffix}"


def test_a_cloud_is_cropped_as_in_evaluation_unless_it_is_reduced(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    (file,) = find_clouds(root / "training/velodyne/000000.bin")
    points, outside = read_cloud(file)
    np.testing.assert_array_equal(points, read_first(root).points)
    assert outside == len(full_cloud(0)) - len(points) > 0
    assert read_cloud(file._replace(camera=None))[1] == 0
    folder = root / "training/velodyne_reduced"
    folder.mkdir()
    write_bin(folder / "000000.bin", full_cloud(0))
    (file,) = find_clouds(folder)
    assert file.camera is not None
    np.testing.assert_array_equal(read_cloud(file)[0], full_cloud(0))


def test_own_types_and_areas_in_any_case(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    path = root / "training/label_2/000000.txt"
    path.write_text(path.read_text().replace("DontCare", "dontcare").replace("Van", "Forklift"))
    frame = read_first(root)
    assert frame.names == ("Car", "Forklift", "Pedestrian")
    assert [row.type for row in frame.objects] == ["Car", "Forklift", "Pedestrian"]
    assert frame.rows is not None
    assert len(frame.rows) == 4


def test_without_image_boxes_points_give_the_difficulty(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    path = root / "training/label_2/000000.txt"
    usual = read_first(root)
    rows = [line.split() for line in path.read_text().splitlines()]
    path.write_text("".join(" ".join([*row[:4], "0", "0", "0", "0", *row[8:]]) + "\n" for row in rows))
    frame = read_first(root)
    inside = np.asarray(points_in_boxes(frame.points, frame.boxes)).sum(-1)
    np.testing.assert_array_equal(frame.difficulty, difficulty_by_points(inside))
    assert (frame.difficulty >= 0).all()
    np.testing.assert_allclose(frame.boxes.to_array(), usual.boxes.to_array())
    labels = labels_from_frame(frame)
    assert sorted(labels.types) == sorted([*OBJECTS, "DontCare"])


def test_a_missing_image_is_warned_of_once_where_clouds_are_cropped(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    for name in NAMES[:2]:
        (root / f"training/image_2/{name}.png").unlink()
        (root / f"training/calib/{name}.txt").write_text(KITTI_CALIBRATION)
    message = (
        r"NAME\.png or \.jpg or \.jpeg is missing for 2 of 3 frames whose clouds are cropped to the image; "
        r"give its size as `image_size` \(width, height\), or the usual one"
    )
    with pytest.warns(FormatWarning, match=message):
        dataset = open_dataset(root, "all")
    camera = dataset.read(0).camera
    assert camera is not None
    assert camera.image_size == (1242, 375)


def test_no_warning_of_images_where_nothing_is_cropped(tmp_path: Path) -> None:
    root = write_kitti(tmp_path, clouds="velodyne_reduced")
    (root / "training/image_2/000000.png").unlink()
    (root / "training/calib/000000.txt").write_text(KITTI_CALIBRATION)
    assert read_first(root).camera is not None


def test_an_unknown_camera_without_its_image_is_refused(tmp_path: Path) -> None:
    root = write_kitti(tmp_path, clouds="velodyne_reduced")
    (root / "training/image_2/000000.png").unlink()
    with pytest.raises(InputError, match=r"calib/000000\.txt has a focal length of 300 pixels, .* `image_size`"):
        read_first(root)


@pytest.mark.parametrize(
    ("file", "damage", "message"),
    [
        ("velodyne/000000.bin", lambda data: data[:-3], r"000000\.bin has \d+ bytes, not a multiple of 16"),
        ("velodyne/000000.bin", lambda data: b"", r"000000\.bin is empty; copy or record it again"),
        ("calib/000000.txt", lambda data: data.split(b"\n", 1)[1], r"calib/000000\.txt has no line P2; use"),
        (
            "label_2/000000.txt",
            lambda data: data + b"Car 0 0 0\n",
            r"label_2/000000\.txt, line 5: 4 columns; a label has 15",
        ),
        (
            "label_2/000000.txt",
            lambda data: data.replace(b"Car", b"Car 0 0"),
            r"000000\.txt, line 1: 17 columns; a label",
        ),
        (
            "label_2/000000.txt",
            lambda data: data.replace(b"Car 0.0000", b"Car nan"),
            r"line 1: a value is not finite; write",
        ),
        (
            "image_2/000000.png",
            lambda data: data[:9],
            r"image_2/000000\.png is not a PNG or JPEG image; copy it again, or give its size as `image_size`",
        ),
    ],
)
def test_a_file_that_cannot_be_used_gets_one_sentence(tmp_path: Path, file: str, damage, message: str) -> None:
    path = write_kitti(tmp_path) / "training" / file
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(InputError, match=message) as caught:
        read_first(tmp_path)
    assert not re.search(r"\. [A-Z]|\n", str(caught.value))


@pytest.mark.reference
def test_cropping_gives_the_reduced_clouds_point_for_point(shared: Path) -> None:
    full, reduced = open_dataset(shared / "kitti_full", "all"), open_dataset(shared / "kitti", "all")
    assert len(full) == 6
    for index, name in enumerate(full.names):
        np.testing.assert_array_equal(full.read(index).points, reduced.read(reduced.names.index(name)).points)


@pytest.mark.reference
def test_the_crop_is_the_projected_test(shared: Path) -> None:
    for path in sorted((shared / "kitti_full/training/velodyne").glob("*.bin")):
        points = read_points(path)
        camera = read_camera(path.parents[1] / f"calib/{path.stem}.txt", path.parents[1] / f"image_2/{path.stem}.png")
        np.testing.assert_array_equal(crop_to_view(points, camera), points[seen(points, camera)])


@pytest.mark.reference
def test_labels_return_from_the_lidar_frame_to_the_image(shared: Path) -> None:
    """Within 1e-3: place, size and rotation of every label, and the projection of its corners."""
    folder, count = shared / "kitti/training", 0
    for path in sorted((folder / "label_2").glob("*.txt")):
        camera = read_camera(folder / "calib" / path.name)
        rows = [row for row in read_labels(path) if row.type != DONT_CARE]
        boxes = rows_to_boxes(rows, camera.calibration)
        again, kept = boxes_to_rows(boxes, np.zeros(len(rows)), [row.type for row in rows], *camera)
        assert kept.tolist() == list(range(len(rows)))
        for row, other in zip(rows, again, strict=True):
            np.testing.assert_allclose(other.location, row.location, atol=1e-3)
            np.testing.assert_allclose(other.dimensions, row.dimensions, atol=1e-3)
            turn = other.rotation_y - row.rotation_y
            np.testing.assert_allclose((turn + np.pi) % (2 * np.pi) - np.pi, 0, atol=1e-3)
            corners = camera_corners(row)
            if corners[:, 2].min() > 0.1:
                pixels = corners @ camera.calibration.projection[:, :3].T + camera.calibration.projection[:, 3]
                pixels = np.clip(pixels[:, :2] / pixels[:, 2:], 0, camera.image_size)
                np.testing.assert_allclose(other.bbox, [*pixels.min(0), *pixels.max(0)], atol=1e-3)
                count += 1
    assert count > 800


def camera_corners(row: ObjectRow) -> np.ndarray:
    """Corners of a row's box in the camera frame."""
    height, width, length = row.dimensions
    cos, sin = np.cos(row.rotation_y), np.sin(row.rotation_y)
    corners = [
        (x * cos + z * sin, y, z * cos - x * sin)
        for x in (-length / 2, length / 2)
        for y in (-height, 0)
        for z in (-width / 2, width / 2)
    ]
    return np.array(corners) + row.location


@pytest.mark.reference
def test_every_frame_of_the_reference_data_reads(shared: Path) -> None:
    dataset = open_dataset(shared / "kitti", "all")
    frames = [dataset.read(index) for index in range(len(dataset))]
    assert len(frames) == 155
    counts = {
        kind: sum(frame.names.count(kind) for frame in frames) for kind in ("Car", "Van", "Pedestrian", "Cyclist")
    }
    assert counts == {"Car": 592, "Van": 53, "Pedestrian": 89, "Cyclist": 37}
    assert len(open_dataset(shared / "kitti", "train")) == 110
    assert len(open_dataset(shared / "kitti", "val")) == 45


def test_a_cloud_that_vanishes_after_opening_is_named(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    camera = read_camera(root / "training/calib/000000.txt", image_size=IMAGE_SIZE)
    with pytest.raises(InputError, match=r"velodyne/000009\.bin does not exist; copy it, or remove the frame from"):
        read_seen_points(root / "training", "000009", camera)
