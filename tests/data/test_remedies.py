"""Every remedy in a message is true: what a command refuses, it takes after doing what the message says."""

import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from mini_folders import NAMES, full_cloud, write_custom, write_kitti, write_split
from small import IMAGE_SIZE

from ciassd_jax.cli import main
from ciassd_jax.config import InputConfig
from ciassd_jax.config.presets import tiny
from ciassd_jax.data.folders import open_dataset
from ciassd_jax.data.scenes import check_targets
from ciassd_jax.formats.errors import FormatWarning, InputError

SIZE = ("--image-size", *map(str, IMAGE_SIZE))


class Case(NamedTuple):
    """A fault of a data set, `data prepare` with these options, its message, and a remedy with further options."""

    write: Callable[[Path], Path]
    damage: Callable[[Path], object]
    options: tuple[str, ...]
    message: str
    remedy: Callable[[Path], object]
    more: tuple[str, ...] = ()


def nothing(root: Path) -> None:
    """The remedy is an option."""


def remove(*paths: str) -> Callable[[Path], None]:
    return lambda root: [(root / path).unlink() for path in paths]


def split(name: str, *frames: str) -> Callable[[Path], None]:
    return lambda root: write_split(root, name, *frames)


def write_list(root: Path) -> None:
    (root / "mine.txt").write_text("b\n")


def five_columns(root: Path) -> None:
    for name in "ab":
        points = np.concatenate([full_cloud(0)[:-1], np.zeros((979, 1), np.float32)], 1)
        points.tofile(root / f"points/{name}.bin")
        (root / f"points/{name}.npy").unlink()


CASES = {
    "missing list, write it": Case(
        write_custom, nothing, ("--split", "val"), r"ImageSets/val\.txt does not exist; write it", split("val", "a")
    ),
    "missing list, all": Case(
        write_custom, nothing, ("--split", "val"), r"or choose the split 'all'\.", nothing, ("--split", "all")
    ),
    "empty list": Case(
        write_custom, split("train"), (), r"train\.txt names no frame; .* list them", split("train", "a")
    ),
    "repeated name": Case(
        write_kitti,
        split("train", *NAMES, NAMES[0]),
        (),
        r"train\.txt: frame 000000 is listed 2 times; list it once",
        split("train", *NAMES),
    ),
    "hidden name": Case(
        write_custom,
        split("train", "a", "._b"),
        (),
        r"train\.txt: '\._b' does not name a frame; write the names .* none starts with a dot",
        split("train", "a", "b"),
    ),
    "name with its folder": Case(
        write_custom,
        split("train", "points/a.npy"),
        (),
        r"train\.txt: 'points/a\.npy' does not name a frame; write the names of the frames' files without folders",
        split("train", "a.npy"),
    ),
    "no label, an empty file": Case(
        write_custom,
        remove("labels/a.txt"),
        (),
        r"train\.txt: 1 of 2 frames have no label \S+labels/NAME\.txt \(a\); copy them \(empty files for frames witho",
        lambda root: (root / "labels/a.txt").touch(),
    ),
    "no label, another list": Case(
        write_custom,
        remove("labels/a.txt"),
        (),
        r"list only the complete frames \(1 of 2\) in \S+/ImageSets/train\.txt\.",
        split("train", "b"),
    ),
    "no label in the split all": Case(
        write_custom,
        remove("labels/a.txt"),
        ("--split", "all"),
        r"list only the complete frames \(1 of 2\) in a file and give its path as the split\.",
        write_list,
        ("--split", "ROOT/mine.txt"),
    ),
    "no labels at all": Case(
        write_kitti,
        lambda root: (root / "training/label_2").rename(root / "away"),
        ("--split", "all"),
        r"3 of 3 frames have no label \S+label_2/NAME\.txt .*; copy them \(empty files for frames without objects\)\.",
        lambda root: (root / "away").rename(root / "training/label_2"),
    ),
    "no calibration": Case(
        write_kitti,
        remove("training/calib/000001.txt"),
        ("--split", "all"),
        r"1 of 3 frames have no calibration \S+calib/NAME\.txt \(000001\); copy them",
        lambda root: (root / "training/calib/000001.txt").write_bytes(
            (root / "training/calib/000000.txt").read_bytes()
        ),
    ),
    "few frames of the official list": Case(
        write_kitti,
        nothing,
        (),
        r"The official list of train: 3711 of 3712 .* list only the complete frames \(1 of 3712\) in \S+/train\.txt\.",
        split("train", "000000"),
    ),
    "no image of an unknown camera": Case(
        write_kitti,
        remove("training/image_2/000001.png"),
        ("--split", "all"),
        r"calib/000001\.txt has a focal length of 300 pixels, .* give it with --image-size WIDTH HEIGHT\.",
        nothing,
        SIZE,
    ),
    "no image, copied as jpg": Case(
        write_kitti,
        remove("training/image_2/000001.png"),
        ("--split", "all"),
        "the size of the image is unknown",
        lambda root: (root / "training/image_2/000001.jpg").write_bytes(
            (root / "training/image_2/000000.png").read_bytes()
        ),
    ),
    "image that is none": Case(
        write_kitti,
        lambda root: (root / "training/image_2/000001.png").write_text("none"),
        ("--split", "all"),
        r"000001\.png is not a PNG or JPEG image; copy it again, or give its size with --image-size WIDTH HEIGHT\.",
        nothing,
        SIZE,
    ),
    "two clouds of a frame": Case(
        write_custom,
        lambda root: full_cloud(0).tofile(root / "points/a.bin"),
        (),
        r"points/a\.bin and \S+points/a\.npy are clouds of one frame; remove one of them\.",
        remove("points/a.bin"),
    ),
    "empty cloud": Case(
        write_kitti,
        lambda root: (root / "training/velodyne/000001.bin").write_bytes(b""),
        ("--split", "all"),
        r"000001\.bin is empty; copy or record it again\.",
        lambda root: full_cloud(1).tofile(root / "training/velodyne/000001.bin"),
    ),
    "other columns": Case(
        write_custom,
        five_columns,
        (),
        r"points/a\.bin .*with --columns",
        nothing,
        ("--columns", "x,y,z,intensity,ring"),
    ),
    "malformed label": Case(
        write_custom,
        lambda root: (root / "labels/a.txt").write_text("1 2 3 4 5 6 Car\n"),
        (),
        r"labels/a\.txt, line 1: 7 columns; a label has the 8 x y z dx dy dz heading class, so write it again\.",
        lambda root: (root / "labels/a.txt").write_text("1 2 3 4 5 6 7 Car\n"),
    ),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_a_remedy_works(case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = case.write(tmp_path / "data")
    case.damage(root)
    command = ["data", "prepare", str(root), "--out", str(tmp_path / "out"), *case.options]
    assert main(command) == 2
    *_, message = capsys.readouterr().err.splitlines()
    assert re.search(case.message, message), message
    assert not any((tmp_path / "out").glob("*"))
    case.remedy(root)
    more = [option.replace("ROOT", str(root)) for option in case.more]
    options = more if "--split" in more else [*case.options, *more]
    assert main([*command[:5], *options]) == 0, capsys.readouterr().err
    assert len(list((tmp_path / "out").glob("objects_*.bin"))) == 1


@pytest.mark.parametrize("similar", [True, False])
def test_labels_of_other_classes_are_refused_and_both_remedies_work(tmp_path: Path, similar: bool) -> None:
    root = write_custom(tmp_path)
    for path in (root / "labels").iterdir():
        path.write_text(path.read_text().replace("Car", "Forklift"))
    config, dataset = tiny(), open_dataset(root, "train")
    car = replace(config.classes[0], similar=())
    message = (
        r"None of 6 labelled objects in 2 frames is of a class that is learned \(Car\); the labels have "
        r"Forklift \(2\), Van \(2\), Pedestrian \(2\), so choose classes with `ciassd data suggest`, or list a type as "
        r"`similar` of a class\."
    )
    with pytest.raises(InputError, match=message):
        check_targets(dataset, replace(config, classes=(car,)))
    own = replace(car, similar=("FORKLIFT",)) if similar else replace(car, name="forklift")
    check_targets(dataset, replace(config, classes=(own,)))


def test_targets_out_of_range_are_told(tmp_path: Path) -> None:
    root = write_custom(tmp_path, names=("a",))
    (root / "labels/a.txt").write_text("8 1 -30 4 2 2 0 Car\n8 1 -1 4 2 2 0 Tram\n")
    outside = (
        r"All 1 objects of the classes that are learned \(Car\) lie outside the grid, x 0\.\.12\.8, y .* m; choose"
    )
    with pytest.warns(FormatWarning, match=outside):
        check_targets(open_dataset(root, "train"), tiny())
    (root / "labels/a.txt").write_text("")
    with pytest.raises(InputError, match=r"^None of 1 frames has a labelled object; check the labels, or"):
        check_targets(open_dataset(root, "train"), tiny())


def test_intensities_of_another_scale_are_refused_before_training(tmp_path: Path) -> None:
    root = write_custom(tmp_path)
    points = np.load(root / "points/a.npy")
    points[:, 3] *= 200
    np.save(root / "points/a.npy", points)
    dataset = open_dataset(root, "train")
    with pytest.raises(InputError, match=r"^Frame a has .* intensities outside \[0, 1\].* as `intensity_scale`"):
        check_targets(dataset, tiny())
    check_targets(dataset, replace(tiny(), input=InputConfig(intensity_scale=255.0)))


def test_data_with_a_target_are_read_up_to_it(tmp_path: Path) -> None:
    dataset = open_dataset(write_custom(tmp_path), "train")
    (tmp_path / "points/b.npy").unlink()
    check_targets(dataset, tiny())


def test_links_to_files_and_folders_are_followed(tmp_path: Path) -> None:
    real, root = write_kitti(tmp_path / "real"), tmp_path / "links/training"
    (root / "velodyne").mkdir(parents=True)
    for name in NAMES:
        (root / f"velodyne/{name}.bin").symlink_to(real / f"training/velodyne/{name}.bin")
    for folder in ("calib", "label_2", "image_2"):
        os.symlink(real / "training" / folder, root / folder)
    expected, found = open_dataset(real, "all"), open_dataset(root.parent, "all")
    assert found.names == expected.names
    for index in range(len(NAMES)):
        np.testing.assert_array_equal(found.read(index).points, expected.read(index).points)
        assert found.read(index).names == expected.read(index).names
