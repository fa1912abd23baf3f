"""The findings of the check of a data set, and none in sound data."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mini_folders import NAMES, OBJECTS, full_cloud, object_points, write_custom, write_kitti, write_split

from ciassd_jax import Config, car, tiny
from ciassd_jax.config import ClassConfig, InputConfig
from ciassd_jax.evaluation.dataset_check import Report, check_dataset
from ciassd_jax.evaluation.frame_check import Finding
from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.kitti_rows import read_rows, write_rows
from ciassd_jax.formats.points import write_bin

Damage = Callable[[Path], object]


def edit(file: str, old: str, new: str) -> Damage:
    """Replace text in a file of the training folder."""

    def damage(root: Path) -> None:
        path = root / file
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new))

    return damage


def edit_rows(**changes: object) -> Damage:
    """Change the first row of the first label file."""

    def damage(root: Path) -> None:
        path = root / "training/label_2/000000.txt"
        first, *others = read_rows(path)
        write_rows(path, [first._replace(**changes), *others])

    return damage


def edit_points(change: Callable[[np.ndarray], object]) -> Damage:
    """Change the first cloud in place."""

    def damage(root: Path) -> None:
        points = object_points(0)
        change(points)
        write_bin(root / "training/velodyne_reduced/000000.bin", points)

    return damage


def only(report: Report) -> Finding:
    assert len(report.findings) == 1, report.findings
    return report.findings[0]


def test_sound_data_give_no_finding(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    write_split(root, "train", *NAMES[:2])
    write_split(root, "val", *NAMES[2:])
    report = check_dataset(root, config=tiny())
    assert report.findings == ()
    assert [one.frame.name for one in report.frames] == list(NAMES)
    assert {name: row.objects for name, row in report.types.items()} == dict.fromkeys(OBJECTS, 3)
    car_row = report.types["Car"]
    np.testing.assert_allclose((*car_row.size, car_row.center_z), (3.9, 1.6, 1.5, -1.0), atol=1e-3)
    assert (car_row.out_of_range, car_row.without_points) == (0, 0)
    assert all(frame.inside.min() >= 60 and frame.voxels > 100 for frame in report.frames)


def test_sound_custom_data_give_no_finding(tmp_path: Path) -> None:
    report = check_dataset(write_custom(tmp_path), config=tiny())
    assert report.findings == ()
    assert [frame.points for frame in report.frames] == [len(full_cloud(0))] * 2
    assert {one.frame.camera for one in report.frames} == {None}


LABEL, CALIB = r"label_2/000000\.txt, line", r"calib/000000\.txt"


@pytest.mark.parametrize(
    ("damage", "serious", "message"),
    [
        (edit("training/label_2/000000.txt", "Car 0.0000", "Car"), True, rf"{LABEL} 1: 14 columns; a label has 15"),
        (
            edit("training/label_2/000000.txt", "Car 0.0000", "Car 0 0 0.0000"),
            True,
            rf"{LABEL} 1: 17 columns; a label has 15",
        ),
        (edit("training/label_2/000000.txt", "Car 0.0000", "Car nan"), True, rf"{LABEL} 1: a value is not finite"),
        (
            edit("training/label_2/000000.txt", "Car 0.0000", "car 0.0000"),
            False,
            rf"{LABEL} 1: the type car \(1 objects\) is learned as the class Car, because case does not matter\.",
        ),
        (edit("training/calib/000000.txt", "P2:", "P9:"), True, rf"{CALIB} has no line P2; use"),
        (edit_rows(rotation_y=90.0), True, rf"{LABEL} 1: the heading 90 is outside \[-pi, pi\]; wrap it, in radians"),
        (edit_rows(bbox=(5, 9, 5, 20)), True, rf"{LABEL} 1: the image box is empty; write"),
        (edit_rows(truncated=-1.0), True, rf"{LABEL} 1: truncation must lie in 0\.\.1 and occlusion"),
        (edit_rows(occluded=4), True, rf"{LABEL} 1: truncation must lie in 0\.\.1 and occlusion"),
        (edit_rows(score=0.5), False, rf"{LABEL} 1: a label has no score; remove"),
        (edit_rows(location=(-4, 1, 11)), False, rf"{LABEL} 1: no point lies inside this Car; check its box"),
        (
            edit_points(lambda points: points.__setitem__((3, 0), np.nan)),
            False,
            r"1 of 180 points are not finite; they were left out",
        ),
        (
            edit_points(lambda points: points.__imul__(np.float32([1, 1, 1, 255]))),
            True,
            r"000000\.bin has .* % of its intensities outside \[0, 1\].*; pass 255 as `intensity_scale`",
        ),
        (
            edit_points(lambda points: points.__setitem__((3, 3), 4.0)),
            False,
            r"1 points in 1 of 3 frames, the first 000000, have an intensity outside \[0, 1\]; training clips it",
        ),
    ],
)
def test_damage_is_found_with_file_and_remedy(tmp_path: Path, damage: Damage, serious: bool, message: str) -> None:
    root = write_kitti(tmp_path, clouds="velodyne_reduced")
    damage(root)
    finding = only(check_dataset(root, config=tiny()))
    assert finding.serious == serious
    assert re.search(message, finding.text)
    assert finding.text.endswith(".")


def test_every_bad_line_is_named(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    path = root / "training/label_2/000000.txt"
    path.write_text(path.read_text() + "Car 1 2\nVan\n")
    texts = [finding.text for finding in check_dataset(root, config=tiny()).findings]
    assert [text.split(": ")[0].removeprefix(f"{path}, ") for text in texts] == ["line 5", "line 6"]


def test_labels_without_any_image_box_are_one_finding(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    for path in (root / "training/label_2").iterdir():
        write_rows(path, [row._replace(bbox=(0, 0, 0, 0)) for row in read_rows(path)])
    report = check_dataset(root, config=tiny())
    found = only(report)
    assert found == Finding(
        "image box",
        False,
        "None of the 9 objects has an image box; their difficulty is by the number of points instead.",
    )
    points = [n for one in report.frames for n, name in zip(one.inside, one.frame.names, strict=True) if name == "Car"]
    levels = tuple(sum(n >= least for n in points) for least in (100, 30, 5))
    assert levels[0] < levels[2]
    assert {score.objects for score in report.scores} == {levels}


def test_a_repeated_label_names_both_lines(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    path = root / "training/label_2/000001.txt"
    path.write_text(path.read_text() + path.read_text().splitlines()[0] + "\n")
    finding = only(check_dataset(root, config=tiny()))
    assert finding.text == f"{path}, line 5: the same object as in {path}, line 1; remove one of the two lines."


def test_files_that_are_missing_or_truncated(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    (root / "training/velodyne/000000.bin").unlink()
    (root / "training/label_2/000001.txt").unlink()
    cloud = root / "training/velodyne/000004.bin"
    cloud.write_bytes(cloud.read_bytes()[:-1])
    report = check_dataset(root, config=tiny())
    first, second, third = (finding.text for finding in report.findings if finding.serious)
    assert "1 of 3 frames have no cloud" in first
    assert "(000000); copy them" in first
    assert "1 of 3 frames have no label" in second
    assert third.startswith(f"{cloud} has ")
    assert [one.frame.name for one in report.frames] == ["000001"]


def test_labels_of_another_calibration(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    edit("training/calib/000000.txt", "300 0 320", "300 0 500")(root)
    finding = only(check_dataset(root, config=tiny()))
    assert not finding.serious
    assert finding.text.startswith(
        f"{root}/training/label_2/000000.txt, line 1 and others: the boxes project elsewhere"
    )
    assert finding.text.endswith("check that label and calibration belong together.")


def test_boxes_that_mostly_hold_no_point(tmp_path: Path) -> None:
    root = write_custom(tmp_path)
    for path in (root / "labels").iterdir():
        path.write_text("".join(f"{box[0]} {-box[1]} -1 .1 .1 .1 0 {kind}\n" for kind, box in OBJECTS.items()))
    serious = [finding for finding in check_dataset(root, config=tiny()).findings if finding.serious]
    assert [finding.text for finding in serious] == [
        "6 of 6 boxes hold no point; check that labels, calibration and clouds belong together, and the axes of the "
        "boxes."
    ]


def test_a_frame_without_calibration_is_missing_once(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    (root / "training/calib/000001.txt").unlink()
    report = check_dataset(root, config=tiny())
    assert "1 of 3 frames have no calibration" in only(report).text
    assert len(report.frames) == 2


def test_points_that_are_not_finite_are_found_before_cropping(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    points = full_cloud(0)
    points[:7, 1] = np.inf
    write_bin(root / "training/velodyne/000000.bin", points)
    text = only(check_dataset(root, config=tiny())).text
    assert text.endswith(f"velodyne/000000.bin: 7 of {len(points)} points are not finite; they were left out.")


def test_split_files(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    write_split(root, "train", "000000", "000001", "000001", "000002")
    write_split(root, "val", "000001", "000004")
    texts = [finding.text for finding in check_dataset(root, config=tiny()).findings]
    assert texts[0] == f"{root}/ImageSets/train.txt: frame 000001 is listed 2 times; list it once."
    assert texts[1].startswith(f"{root}/ImageSets/train.txt: 1 of 4 frames have no cloud ")
    assert texts[2] == (
        f"{root}/ImageSets: train.txt and val.txt share 1 frames, the first 000001; remove them from one of the two."
    )
    report = check_dataset(root, "train", config=tiny())
    assert [one.frame.name for one in report.frames] == ["000000", "000001"]
    assert [finding.kind for finding in report.findings] == ["split"] + ["missing file"] * 3


def test_a_frame_that_no_split_lists_may_lack_its_labels(tmp_path: Path) -> None:
    root = write_custom(tmp_path)
    (root / "labels/b.txt").unlink()
    report = check_dataset(root, config=tiny())
    assert only(report).serious
    assert "(b); copy them, or list only the other frames in ImageSets" in only(report).text
    write_split(root, "train", "a")
    write_split(root, "test", "b")
    report = check_dataset(root, config=tiny())
    assert not only(report).serious
    assert "1 of 1 frames have no label" in only(report).text
    assert report.verdict.startswith("ready to train: ")


def test_the_official_list_where_frames_are_missing(tmp_path: Path) -> None:
    report = check_dataset(write_kitti(tmp_path), "train", config=tiny())
    assert "The official list of train: 3711 of 3712 frames have no cloud" in report.findings[0].text
    with pytest.raises(InputError, match=r"names no frame that exists; check the path"):
        check_dataset(tmp_path, "test")


def swap(root: Path, count: int) -> None:
    """Swap length and width of the cars of the first `count` frames."""
    for name in NAMES[:count]:
        path = root / f"training/label_2/{name}.txt"
        rows = read_rows(path)
        cars = [row._replace(location=(x, 1, 20)) for x in (-6, -2, 2, 6) for row in rows if row.type == "Car"]
        swapped = [row._replace(dimensions=(row.dimensions[0], *row.dimensions[:0:-1])) for row in cars]
        write_rows(path, [*rows, *swapped])


def test_length_and_width_swapped(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    swap(root, 3)
    findings = [finding for finding in check_dataset(root, config=car()).findings if finding.kind == "swapped"]
    assert len(findings) == 1
    assert findings[0].serious
    assert "12 of 15 objects of type Car are wider than long; swap their length and width." in findings[0].text


def test_one_swapped_among_many(tmp_path: Path) -> None:
    root = write_custom(tmp_path)
    rows = [f"{5 + 5 * i} 0 -1 4 1.6 1.5 0 Car" for i in range(8)]
    (root / "labels/a.txt").write_text("\n".join([*rows, "60 0 -1 1.6 4 1.5 0 Car"]))
    findings = [finding for finding in check_dataset(root, config=car()).findings if finding.kind == "swapped"]
    assert [(finding.serious, finding.text.split("labels/")[1]) for finding in findings] == [
        (False, "a.txt, line 9: this Car is 1.6 m long and 4 m wide; swap the two.")
    ]


@pytest.mark.parametrize(
    ("z", "serious", "message"),
    [
        (-0.1, False, "objects of class Car are typically centred at z = -0.10, its anchors at -1; check that z is"),
        (2.0, True, "6 of 6 objects of class Car (100%) lie outside the range x 0..70.4, y -40..40, z -3..1 m, the"),
    ],
)
def test_boxes_above_the_ground(tmp_path: Path, z: float, serious: bool, message: str) -> None:
    root = write_custom(tmp_path)
    (root / "labels/a.txt").write_text("".join(f"{5 + 5 * i} 0 {z} 4 1.6 1.5 0 Car\n" for i in range(6)))
    (root / "labels/b.txt").write_text("")
    (finding,) = [one for one in check_dataset(root, config=car()).findings if message in one.text]
    assert finding.serious == serious


def test_sizes_of_custom_labels(tmp_path: Path) -> None:
    root = write_custom(tmp_path)
    (root / "labels/a.txt").write_text("5 0 -1 4 0 1.5 90 Car\n")
    texts = {f.kind: f.text.split("a.txt, ")[1] for f in check_dataset(root, config=tiny()).findings if f.serious}
    assert texts == {
        "size": "line 1: the size 4 x 0 x 1.5 is not positive; correct or remove the line.",
        "heading": "line 1: the heading 90 is beyond two turns; convert degrees to radians.",
    }


def test_headings_of_custom_labels_may_wind(tmp_path: Path) -> None:
    root = write_custom(tmp_path)
    turns = {kind: (*box[:6], box[6] - 2 * np.pi) for kind, box in OBJECTS.items()}
    (root / "labels/a.txt").write_text("".join(f"{' '.join(map(str, box))} {kind}\n" for kind, box in turns.items()))
    assert check_dataset(root, config=tiny()).findings == ()


def rename(root: Path, **names: str) -> Path:
    """Rename types in the labels of the custom layout."""
    for path in (root / "labels").iterdir():
        text = path.read_text()
        for old, new in names.items():
            text = text.replace(old, new)
        path.write_text(text)
    return root


def learn(name: str, **changes: object) -> Config:
    return replace(tiny(), classes=(replace(ClassConfig(name=name), **changes),))


def test_no_object_of_a_class_that_is_learned(tmp_path: Path) -> None:
    report = check_dataset(rename(write_custom(tmp_path), Car="Vehicle", Van="Truck"), config=tiny())
    text = (
        "No object is of a class that is learned (Car), but Vehicle (2), Truck (2), Pedestrian (2); write a config for "
        "them with `ciassd data suggest`."
    )
    assert only(report) == Finding("class", True, text)
    assert report.verdict == f"not ready: 1 error; first: {text}"
    report = check_dataset(tmp_path, config=learn("vehicle"))
    assert only(report).kind == "case"
    assert report.verdict == "ready to train: 2 vehicle objects in range in 2 frames; findings worth a look: 1."
    assert {(score.name, score.metric) for score in report.scores} == {("vehicle", "bev"), ("vehicle", "3d")}


def test_labels_without_an_object(tmp_path: Path) -> None:
    root = write_custom(tmp_path)
    for path in (root / "labels").iterdir():
        path.write_text("")
    assert only(check_dataset(root, config=car())).text == "No frame has a labelled object; check the labels."


def test_anchors_of_another_size(tmp_path: Path) -> None:
    root = write_custom(tmp_path, names=tuple("abcde"))
    assert check_dataset(root, config=learn("Car")).findings == ()
    finding = only(check_dataset(root, config=learn("Car", length=5.2)))
    assert "objects of class Car are typically 3.90 x 1.60 m large, but its anchors 5.2 x 1.6 m" in finding.text


def test_the_share_of_a_class_outside_the_range(tmp_path: Path) -> None:
    root = write_custom(tmp_path)
    (root / "labels/a.txt").write_text("".join(f"{2 + 3 * i} 0 -1 3.9 1.6 1.5 0 Car\n" for i in range(7)))
    (finding,) = [one for one in check_dataset(root, config=learn("Car")).findings if one.kind == "range"]
    start = (
        f"3 of 8 objects of class Car (38%) lie outside the range x 0..12.8, y -6.4..6.4, z -3..1 m, the first {root}"
    )
    assert finding.text.startswith(f"{start}/labels/a.txt, line 5; check them")


def test_intensities_of_another_scale_are_one_error(tmp_path: Path) -> None:
    root = write_custom(tmp_path)
    for path in (root / "points").iterdir():
        np.save(path, np.load(path) * np.float32([1, 1, 1, 255]))
    finding = only(check_dataset(root, config=tiny()))
    assert finding.serious
    assert finding.text.endswith("pass 255 as `intensity_scale`. Other frames with this problem: 1.")
    assert check_dataset(root, config=replace(tiny(), input=InputConfig(intensity_scale=255.0))).findings == ()


def test_the_input_shifts_the_range_and_the_anchors(tmp_path: Path) -> None:
    root = write_custom(tmp_path, names=tuple("abcde"))
    for path in (root / "points").iterdir():
        np.save(path, np.load(path) + np.float32([0, 0, 5, 0]))
    for path in (root / "labels").iterdir():
        rows = [line.split() for line in path.read_text().splitlines()]
        path.write_text("".join(" ".join([*row[:2], str(float(row[2]) + 5), *row[3:]]) + "\n" for row in rows))
    assert any(finding.serious for finding in check_dataset(root, config=tiny()).findings)
    assert check_dataset(root, config=replace(tiny(), input=InputConfig(z_shift=-5.0))).findings == ()


@pytest.mark.parametrize(
    ("box", "reason"),
    [
        ("-20 0 -1 4 1.6 1.5 0", "outside the sector that the cloud covers"),
        ("90 0 -1 4 1.6 1.5 0", "beyond the farthest point"),
        ("1.5 0 -1.2 1 1 1 0", "in the sensor's blind zone"),
    ],
)
def test_boxes_that_cannot_hold_a_point(tmp_path: Path, box: str, reason: str) -> None:
    root = write_custom(tmp_path)
    for path in (root / "points").iterdir():
        points = np.load(path)
        np.save(path, points[(points[:, 0] > 4) & (points[:, 2] > -0.4 * points[:, 0])])
    with (root / "labels/a.txt").open("a") as file:
        file.write(f"{box} Car\n")
    (finding,) = [one for one in check_dataset(root, config=tiny()).findings if one.kind == "hidden"]
    assert (
        f"1 of 7 boxes hold no point because they lie {reason}, the first {root}/labels/a.txt, line 4;" in finding.text
    )


def test_boxes_outside_of_the_cameras_view(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    edit_rows(location=(-1, 1, -8))(root)
    (finding,) = [one for one in check_dataset(root, config=tiny()).findings if one.kind == "hidden"]
    assert "they lie outside the camera's view, to which clouds are cropped, the first" in finding.text


def test_two_clouds_of_one_frame(tmp_path: Path) -> None:
    root = write_custom(tmp_path)
    write_bin(root / "points/a.bin", full_cloud(0))
    assert only(check_dataset(root, config=tiny())).text.endswith("are clouds of one frame; remove one.")


def test_amounts_beyond_a_capacity_and_a_sparse_cloud(tmp_path: Path) -> None:
    root = write_kitti(tmp_path, clouds="velodyne_reduced")
    write_bin(root / "training/velodyne_reduced/000004.bin", object_points(2)[::20])
    config = tiny()
    config = replace(config, data=replace(config.data, max_points=100, max_boxes=2))
    texts = [finding.text for finding in check_dataset(root, config=config).findings]
    assert texts == [
        "Frame 000004: 9 points where 180 are usual; check its cloud.",
        "2 of 3 frames have more than 100 points, up to 180; the rest is cut and counted, so raise data.max_points to "
        "keep it.",
        "3 of 3 frames have more than 2 objects, up to 3; the rest is cut and counted, so raise data.max_boxes to "
        "keep it.",
    ]


def test_images_that_are_not_there_where_clouds_are_cropped(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    for name in NAMES:
        edit(f"training/calib/{name}.txt", "300", "721.5377")(root)
    (root / "training/image_2/000000.png").unlink()
    findings = [finding for finding in check_dataset(root, config=tiny()).findings if finding.kind == "image size"]
    assert [finding.serious for finding in findings] == [False]
    assert "missing for 1 of 3 frames whose clouds are cropped" in findings[0].text


@pytest.mark.reference
@pytest.mark.parametrize(
    ("folder", "frames", "kinds"), [("kitti", 155, ["hidden"] + ["no point"] * 10), ("kitti_full", 6, [])]
)
def test_real_data_have_a_few_boxes_without_points(shared: Path, folder: str, frames: int, kinds: list[str]) -> None:
    report = check_dataset(shared / folder)
    assert len(report.frames) == frames
    assert [finding.kind for finding in report.findings] == kinds
    assert not any(finding.serious for finding in report.findings)
    if folder == "kitti":
        voxels = [frame.voxels for frame in report.frames]
        assert (round(float(np.median(voxels)), -2), max(voxels)) == (15300, 17664)
