"""Frames to view: what a detector gets of them, frames without labels, and what lies beside a cloud."""

from pathlib import Path

import numpy as np
import pytest
from mini_folders import NAMES, OBJECTS, full_cloud, write_custom, write_kitti

from ciassd_jax.data.folders import open_dataset
from ciassd_jax.formats.errors import FormatWarning
from ciassd_jax.formats.points import write_bin
from ciassd_jax.view.sources import detector_points, find_sources


def test_a_detector_gets_of_a_whole_cloud_what_evaluation_gives_it(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    expected = open_dataset(root, "all").read(0).points
    shown, cropped = (find_sources(path)[NAMES[0]].read() for path in (root / "training/velodyne", root))
    assert len(shown.points) == len(full_cloud(0)) > len(cropped.points)
    for frame in (shown, cropped):
        np.testing.assert_array_equal(detector_points(frame), expected)


def test_reduced_clouds_are_left_as_they_are(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    (root / "training/velodyne_reduced").mkdir()
    for name in NAMES:
        write_bin(root / f"training/velodyne_reduced/{name}.bin", full_cloud(0))
    for path in (root, root / "training/velodyne_reduced"):
        frame = find_sources(path)[NAMES[0]].read()
        assert frame.camera is not None
        np.testing.assert_array_equal(detector_points(frame), full_cloud(0))


def test_frames_without_labels_are_shown(tmp_path: Path) -> None:
    own, kitti = write_custom(tmp_path / "own"), write_kitti(tmp_path / "kitti")
    (own / "labels/a.txt").unlink()
    for path in (kitti / "training/label_2").iterdir():
        path.unlink()
    (kitti / "training/label_2").rmdir()
    for split in ("all", "train"):
        frames = {name: source.read() for name, source in find_sources(own, split).items()}
        assert [frames[name].truth_labels for name in "ab"] == [(), tuple(OBJECTS)]
    assert [len(source.read().truth) for source in find_sources(kitti).values()] == [0, 0, 0]


def test_labels_of_a_cloud_without_its_calibration_are_told_of(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    (root / "training/calib/000000.txt").unlink()
    with pytest.warns(FormatWarning, match=r"000000\.bin has no calibration, so its labels are not shown\.$"):
        frame = find_sources(root / "training/velodyne")["000000"].read()
    assert len(frame.truth) == 0
