"""The frames of a split: the official lists, split files, and frames that do not exist."""

import hashlib
from pathlib import Path

import pytest
from mini_folders import NAMES, write_custom, write_kitti, write_split
from small import IMAGE_SIZE

from ciassd_jax.data.clouds import find_clouds
from ciassd_jax.data.folders import open_dataset
from ciassd_jax.data.gt_sampling import database_path
from ciassd_jax.data.kitti import write_reduced
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
            r"\(000002, 000003\); copy them, or list only the complete frames \(1 of 3\) in \S+mine\.txt\.",
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


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_lists_are_read_as_windows_writes_them(tmp_path: Path, encoding: str) -> None:
    root = write_custom(tmp_path, names=("a", "scan 7", "12.5"))
    (root / "ImageSets/train.txt").write_bytes("\r\n12.5\r\n\r\n  scan 7 \r\na.npy\r\n\r\n".encode(encoding))
    assert open_dataset(root, "train").names == ("12.5", "scan 7", "a")


def test_a_split_may_be_the_path_of_a_list(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = write_kitti(tmp_path / "kitti")
    (tmp_path / "few.txt").write_text("000001\n")
    assert open_dataset(root, str(tmp_path / "few.txt")).names == ("000001",)
    monkeypatch.chdir(tmp_path)
    assert open_dataset(root, "few.txt").names == ("000001",)
    assert database_path(root, str(tmp_path / "few.txt")) == root / "objects_few.bin"
    assert database_path(root, "v1.0") == root / "objects_v1.0.bin"
    with pytest.raises(InputError, match=r"^none/few\.txt does not exist; write it, one frame per line, or choose"):
        open_dataset(root, "none/few.txt")


@pytest.mark.parametrize("content", [b"\xff" * 200, b"../../etc/passwd\n", b"a\0b\n", b"x" * 300, b".hidden\n"])
def test_a_list_of_other_things_than_names_gets_one_sentence(tmp_path: Path, content: bytes) -> None:
    root = write_custom(tmp_path)
    (root / "ImageSets/train.txt").write_bytes(content)
    with pytest.raises(InputError, match=r"train\.txt: .* does not name a frame; write the names of the frames' files"):
        open_dataset(root, "train")


def test_names_that_start_with_a_dot_are_no_data(tmp_path: Path) -> None:
    root = write_kitti(tmp_path / "kitti")
    for path in list((root / "training").rglob("000000.*")):
        path.with_name(f"._{path.name}").write_bytes(b"\0\5\x16\7")
    assert open_dataset(root, "all").names == NAMES
    assert [file.cloud.stem for file in find_clouds(root / "training/velodyne", image_size=IMAGE_SIZE)] == list(NAMES)
    assert write_reduced(root, None) == len(NAMES)


def test_frames_without_labels_open_only_where_none_are_needed(tmp_path: Path) -> None:
    own, kitti = write_custom(tmp_path / "own"), write_kitti(tmp_path / "kitti")
    (own / "labels/a.txt").unlink()
    (kitti / "training/label_2/000001.txt").unlink()
    for root, lacking in ((own, 0), (kitti, 1)):
        with pytest.raises(InputError, match="frames have no label"):
            open_dataset(root, "all")
        dataset = open_dataset(root, "all", need_labels=False)
        labelled = [dataset.read(index).rows is not None for index in range(len(dataset))]
        assert [index for index, has in enumerate(labelled) if not has] == [lacking]
        assert dataset.read(lacking).names == ()
        assert len(dataset.read(lacking).points) > 0
