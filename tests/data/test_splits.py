"""The frames of a split: the official lists, split files, and frames that do not exist."""

import hashlib
from pathlib import Path

import pytest
from mini_folders import write_custom, write_kitti, write_split

from ciassd_jax.data.folders import open_dataset
from ciassd_jax.data.splits import official_split
from ciassd_jax.formats.errors import InputError

# Chen et al.'s split.
CHECKSUMS = {
    "train": "e85ce0142be11c7e4196fd7b79a8bc8c2cefdd6fe754ac61fef8d421e37aba5c",
    "val": "6e2394d97c866c3af1ffb049f828abdf3d5b707d9575d16885fd0de87b72b0c8",
}
SIZES = {"train": 3712, "val": 3769, "trainval": 7481, "test": 7518}


def official(split: str) -> tuple[str, ...]:
    names = official_split(split)
    assert names is not None
    return names


@pytest.mark.parametrize("split", CHECKSUMS)
def test_official_lists_have_their_checksums(split: str) -> None:
    text = "".join(f"{name}\n" for name in official(split))
    assert hashlib.sha256(text.encode()).hexdigest() == CHECKSUMS[split]


def test_official_lists_fit_together() -> None:
    assert {split: len(official(split)) for split in SIZES} == SIZES
    assert sorted(official("train") + official("val")) == list(official("trainval"))
    assert official("test")[0] == "000000"
    assert official("test")[-1] == "007517"
    assert official_split("mini") is None


@pytest.mark.reference
def test_train_is_the_list_of_the_reference_data(shared: Path) -> None:
    assert list(official("train")) == (shared / "kitti/official_splits/train.txt").read_text().split()


def test_a_split_file_wins_over_the_official_list(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    write_split(root, "train", "000004", "000001")
    write_split(root, "mine", "000000")
    assert open_dataset(root, "train").names == ("000004", "000001")
    assert open_dataset(root, "mine").names == ("000000",)
    assert open_dataset(root, "all").names == ("000000", "000001", "000004")


@pytest.mark.parametrize(
    ("split", "names", "message"),
    [
        ("train", ("000001", "000000", "000001"), r"train\.txt: frame 000001 is listed 2 times; list it once\."),
        ("train", (), r"train\.txt names no frame; check the path, or list them, one per line\."),
        (
            "mine",
            ("000001", "000002", "000003"),
            r"mine\.txt: 2 of 3 frames have no cloud \S+velodyne_reduced/NAME\.bin or \S+velodyne/NAME\.bin "
            r"\(000002, 000003\); copy them, or list only the 1 complete frames in \S+mine\.txt\.",
        ),
        (
            "val",
            None,
            r"The official list of val: 3767 of 3769 frames have no cloud .* \(000002, 000005, 000006, \.\.\.\)",
        ),
        ("other", None, r"other\.txt does not exist; write it, one frame per line, or choose the split 'all'\."),
    ],
)
def test_a_split_that_cannot_be_read_gets_one_sentence(
    tmp_path: Path, split: str, names: tuple[str, ...] | None, message: str
) -> None:
    root = write_kitti(tmp_path)
    if names is not None:
        write_split(root, split, *names)
    with pytest.raises(InputError, match=message):
        open_dataset(root, split)


@pytest.mark.parametrize(("folder", "kind"), [("velodyne", "cloud"), ("calib", "calibration"), ("label_2", "label")])
def test_a_frame_without_one_of_its_files_is_named(tmp_path: Path, folder: str, kind: str) -> None:
    root = write_kitti(tmp_path)
    next((root / "training" / folder).glob("000001.*")).unlink()
    with pytest.raises(InputError, match=rf"1 of 3 frames have no {kind} .*{folder}.* \(000001\); copy them"):
        open_dataset(root, "all")


def test_custom_data_have_no_official_list(tmp_path: Path) -> None:
    root = write_custom(tmp_path)
    assert open_dataset(root, "train").names == ("a", "b")
    assert open_dataset(root, "all").names == ("a", "b")
    with pytest.raises(InputError, match=r"val\.txt does not exist; write it"):
        open_dataset(root, "val")


def test_a_folder_of_neither_layout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"has no folder training or testing \(KITTI\) or points .*; check the path\."):
        open_dataset(tmp_path, "train")
    monkeypatch.delenv("KITTI_ROOT", raising=False)
    with pytest.raises(InputError, match=r"No data set is named; give its folder, or set KITTI_ROOT to it\."):
        open_dataset(None, "train")
    monkeypatch.setenv("KITTI_ROOT", str(write_kitti(tmp_path)))
    assert len(open_dataset(None, "all")) == 3
