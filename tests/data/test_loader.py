"""The loader: the content of batches, their dependence on (seed, position) alone, and failures."""

import multiprocessing
import os
import re
import subprocess
import sys
from dataclasses import replace
from itertools import islice
from pathlib import Path

import chex
import jax
import numpy as np
import pytest
from mini_folders import NAMES, write_custom, write_kitti, write_split

from ciassd_jax import Config, Scene, car_lite, make_batches, open_dataset, tiny
from ciassd_jax.config import AugmentationConfig, DataConfig
from ciassd_jax.data.augment import augment, keep_targets, scene_key
from ciassd_jax.data.frames import Dataset
from ciassd_jax.data.gt_sampling import (
    ObjectDatabase,
    build_database,
    no_objects,
    open_database,
    sample_objects,
)
from ciassd_jax.data.loader import Batches, LoaderState, Rows, Stream, epoch_order, finish_scenes
from ciassd_jax.data.scenes import pad_frame
from ciassd_jax.data.workers import WorkerError
from ciassd_jax.formats.errors import FormatWarning, InputError

CONFIG = replace(tiny(), data=replace(tiny().data, max_points=1024, max_gt_sampling_points=512))
# With three frames, batches start at the beginning and in the middle of an epoch.
BATCH = 2


def open_mini(root: Path) -> tuple[Dataset, ObjectDatabase]:
    write_split(write_kitti(root), "mine", *NAMES)
    dataset = open_dataset(root, "mine")
    build_database(dataset, root / "objects.bin")
    return dataset, open_database(root / "objects.bin", dataset)


@pytest.fixture(scope="module")
def mini(tmp_path_factory: pytest.TempPathFactory) -> tuple[Dataset, ObjectDatabase]:
    """Three frames and their database."""
    return open_mini(tmp_path_factory.mktemp("mini"))


def make(mini: tuple[Dataset, ObjectDatabase], **changes: object) -> Batches:
    numbers = {"seed": 3, "batch_size": BATCH, "database": mini[1], **changes}
    return make_batches(mini[0], CONFIG, **numbers)


def take(batches: Batches, number: int) -> list[Scene]:
    with batches:
        return list(islice(batches, number))


def assert_same_bits(some: list[Scene], others: list[Scene]) -> None:
    jax.tree.map(np.testing.assert_array_equal, some, others)


@pytest.fixture(scope="module")
def expected(mini: tuple[Dataset, ObjectDatabase]) -> list[Scene]:
    return take(make(mini), 6)


def test_every_epoch_has_every_frame_once_in_its_own_order(expected: list[Scene]) -> None:
    frames = np.concatenate([batch.frame for batch in expected]).reshape(-1, 3)
    assert [sorted(epoch) for epoch in frames.tolist()] == [[0, 1, 2]] * 4
    np.testing.assert_array_equal(frames, [epoch_order(3, epoch, 3) for epoch in range(4)])
    orders = [tuple(epoch_order(seed, epoch, 50)) for seed in range(3) for epoch in range(3)]
    assert len(set(orders)) == 9


def test_a_row_is_its_frame_augmented_by_seed_epoch_and_frame(mini, expected: list[Scene]) -> None:
    dataset, database = mini
    run = jax.jit(augment, static_argnames="config")
    for position in range(5):
        epoch, index = position // 3, int(expected[position // 2].frame[position % 2])
        frame = dataset.read(index)
        objects = sample_objects(database, frame.names, seed=3, epoch=epoch, frame=index, config=CONFIG)
        scene = run(scene_key(3, epoch, index), pad_frame(frame, index, CONFIG), objects, CONFIG)
        row = jax.tree.map(lambda leaf, position=position: leaf[position % 2], expected[position // 2])
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=2e-5), row, scene)


def test_the_batch_size_is_the_schedule_s(mini) -> None:
    assert make(mini, batch_size=None).state.batch_size == CONFIG.schedule.batch_size


def test_batches_are_on_the_device_in_fixed_shapes(expected: list[Scene]) -> None:
    chex.assert_trees_all_equal_shapes_and_dtypes(*expected)
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(expected))
    assert expected[0].cloud.points.shape == (BATCH, CONFIG.data.max_points, 4)
    assert expected[0].truth.label.shape == (BATCH, CONFIG.data.max_boxes)


def test_frames_of_any_size_share_one_program(mini) -> None:
    before = finish_scenes._cache_size()
    take(make(mini, start=3), 4)
    take(make(mini, seed=8), 2)
    assert finish_scenes._cache_size() - before <= 1


def test_without_augmentation_frames_only_lose_what_is_no_target(mini) -> None:
    dataset, _ = mini
    limits = {"minimum": CONFIG.grid.minimum, "maximum": CONFIG.grid.maximum}
    for batch in take(make(mini, augmented=False), 2):
        for row, index in enumerate(batch.frame.tolist()):
            scene = keep_targets(pad_frame(dataset.read(index), index, CONFIG), **limits)
            jax.tree.map(lambda a, b, row=row: np.testing.assert_array_equal(a[row], b), batch, scene)


def test_without_a_database_no_object_is_added(mini) -> None:
    rows = Rows(Stream(mini[0], CONFIG, 0, True), 1)
    chex.assert_trees_all_equal(rows[0].objects, no_objects(CONFIG))
    (batch,) = take(make(mini, database=None), 1)
    assert batch.truth.count.max() <= 2


def test_everything_cut_is_counted(mini) -> None:
    dataset, database = mini
    only_sampling = AugmentationConfig(object_noise=False, global_transform=False)
    narrow = replace(CONFIG, data=DataConfig(300, 2, max_gt_sampling_points=100, augmentation=only_sampling))
    frame = dataset.read(0)
    objects = sample_objects(database, frame.names, seed=0, epoch=0, frame=0, config=narrow)
    with make_batches(replace(dataset, names=NAMES[:1]), narrow, seed=0, batch_size=1, database=database) as batches:
        batch = next(batches)
    assert objects.cut > 0
    assert batch.objects_cut == objects.cut
    assert batch.points_cut >= len(frame.points) - 300 > 0
    assert batch.boxes_cut >= len(frame.names) - 2 > 0


def test_state_goes_on_with_the_same_bits(mini, expected: list[Scene]) -> None:
    with make(mini) as batches:
        next(batches)
        next(batches)
        state = batches.state
    assert state == LoaderState(2, 3, BATCH, 3, state.checksum)
    again = make(mini)
    again.set_state(LoaderState(*map(np.int64, state)))
    assert_same_bits(take(again, 3), expected[2:5])
    assert again.state.batch == 5
    again.set_state(state)
    assert_same_bits(take(again, 1), expected[2:3])
    assert_same_bits(take(make(mini, start=4), 2), expected[4:])


@pytest.mark.smoke
def test_workers_change_nothing_and_resume_each_other(mini, expected: list[Scene]) -> None:
    """None to two in the middle of an epoch, and back."""
    with make(mini) as batches:
        first = [next(batches)]
        state = batches.state
    with make(mini, workers=2) as batches:
        batches.set_state(state)
        second = [next(batches), next(batches), next(batches)]
        state = batches.state
    assert not multiprocessing.active_children()
    last = make(mini)
    last.set_state(state)
    assert_same_bits([*first, *second, *take(last, 2)], expected)


@pytest.mark.parametrize("change", [{"seed": 4}, {"batch_size": 3}, {"database": None}])
def test_a_state_of_another_stream_is_refused(mini, change: dict) -> None:
    message = r"^The loader's state is of another stream \(\w+ \d+ instead of \d+\); resume"
    with pytest.raises(ValueError, match=message):
        make(mini, **change).set_state(make(mini).state)
    fewer = replace(mini[0], names=NAMES[:2])
    with pytest.raises(ValueError, match=r"frames 3 instead of 2, checksum \d+ instead"):
        make((fewer, mini[1])).set_state(make(mini).state)
    with pytest.raises(ValueError, match=r"another stream \(batch -1\)"):
        make(mini).set_state(make(mini).state._replace(batch=-1))


def test_processes_share_the_same_batches(mini) -> None:
    """The shares of the processes, concatenated, are the rows of the whole batch."""
    stream = Stream(*mini[:1], CONFIG, 3, True, mini[1])
    whole, shares = Rows(stream, 4), [Rows(stream, 4, (index, 2)) for index in range(2)]
    for batch in range(3):
        rows = [share[2 * batch + row] for share in shares for row in range(2)]
        chex.assert_trees_all_equal(rows, [whole[4 * batch + row] for row in range(4)])
    assert make(mini, shard=(1, 2)).state == make(mini).state


@pytest.mark.parametrize("workers", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_bad_file_is_named_and_can_be_repaired(tmp_path: Path, workers: int) -> None:
    mini = open_mini(tmp_path)
    bad = tmp_path / "training/velodyne/000001.bin"
    content = bad.read_bytes()
    bad.write_bytes(content[:1001])
    batches = make(mini, workers=workers)
    with pytest.raises(InputError, match=rf"^{bad} has 1001 bytes, not a multiple of 16"):
        next(batches)
    assert not multiprocessing.active_children()
    bad.write_bytes(content)
    assert_same_bits(take(batches, 1), take(make(mini), 1))


def test_a_box_that_is_none_is_named(tmp_path: Path) -> None:
    mini = open_mini(tmp_path)
    label = tmp_path / "training/label_2/000000.txt"
    columns = label.read_text().split()
    columns[8] = "-1.5"
    label.write_text(" ".join(columns[:15]) + "\n")
    with pytest.raises(InputError, match=r"^Frame 000000: object 0 \(Car\) has the size"):
        take(make(mini), 2)


def test_a_dead_worker_is_one_sentence(mini, expected: list[Scene]) -> None:
    with make(mini, workers=2) as batches:
        next(batches)
        os.kill(multiprocessing.active_children()[0].pid, 9)
        with pytest.raises(WorkerError, match=r"^A worker of the loader died \(exit code -9\): .*checkpoint\.$"):
            take_until_dead(batches)
    assert not multiprocessing.active_children()


def take_until_dead(batches: Batches) -> None:
    """More than workers can have ready."""
    for _ in range(100):
        next(batches)


SCRIPT = """
import sys, time
from ciassd_jax import make_batches, open_dataset, tiny
if __name__ == "__main__":
    batches = make_batches(open_dataset(sys.argv[1], "mine"), tiny(), seed=0, batch_size=1, augmented=False, workers=1)
    next(batches)
    if sys.argv[2] == "wait":
        print("started", flush=True)
        time.sleep(60)
"""


@pytest.mark.parametrize("what", ["leave", "wait"])
@pytest.mark.slow
def test_workers_end_with_their_parent_however_it_ends(mini, tmp_path: Path, what: str) -> None:
    """Silently if the loader was not closed; after a SIGKILL too, as the end of the shared output shows."""
    (tmp_path / "script.py").write_text(SCRIPT)
    command = [sys.executable, tmp_path / "script.py", mini[1].path.parent, what]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as parent:
        first = parent.stdout.readline()
        if what == "wait":
            parent.kill()
        rest, _ = parent.communicate(timeout=60)
    assert (first, parent.returncode) == (("started\n", -9) if what == "wait" else ("", 0))
    assert what == "wait" or not rest


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": -1}, "The loader's seed is -1; choose one from 0"),
        ({"seed": 2**31}, "The loader's seed is 2147483648;"),
        ({"shard": (2, 2)}, "Process 2 of 2 has no share of 2 scenes;"),
        ({"shard": (0, 3)}, "Process 0 of 3 has no share of 2 scenes;"),
        ({"batch_size": 0}, "The loader cannot give batches of 0 from batch 0 with 0 workers;"),
        ({"workers": -1}, "with -1 workers;"),
    ],
)
def test_numbers_that_fit_no_stream_are_refused(mini, change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(mini, **change)


def test_an_empty_data_set_is_refused(mini) -> None:
    with pytest.raises(ValueError, match="has no frames"):
        make_batches(replace(mini[0], names=()), CONFIG, seed=0)


@pytest.mark.reference
def test_real_frames_fit(shared: Path) -> None:
    """No frame of the reference data exceeds the capacities of the CPU's preset."""
    config: Config = car_lite()
    dataset = open_dataset(shared / "kitti", "val")
    scenes = [pad_frame(dataset.read(index), index, config) for index in range(len(dataset))]
    cut = [np.sum([scene.points_cut, scene.boxes_cut, scene.objects_cut]) for scene in scenes]
    assert not np.any(cut)


@pytest.mark.parametrize("workers", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_each_kind_of_problem_is_told_once(tmp_path: Path, workers: int) -> None:
    """By the program that takes the batches, whoever reads the frames."""
    root = write_custom(tmp_path, names=tuple("abcd"))
    for path in (root / "points").iterdir():
        np.save(path, np.load(path)[:, :3])
    for path in (root / "labels").iterdir():
        path.write_text(path.read_text().replace("Car", "car"))
    points = np.load(root / "points/c.npy")
    points[0] = np.nan
    np.save(root / "points/c.npy", points)
    with pytest.warns(FormatWarning) as caught:
        take(make_batches(open_dataset(root, "train"), CONFIG, seed=0, batch_size=2, workers=workers), 6)
    *texts, case = sorted((str(one.message) for one in caught), key=lambda text: text.startswith("Labels"))
    assert case == "Labels of type car count as Car, because case does not matter."
    lacking, broken = sorted(texts, key=lambda text: "not finite" in text)
    assert re.fullmatch(rf"{root}/points/.\.npy has no intensity .* 0 is used instead\.", lacking)
    assert broken == f"{root}/points/c.npy: 1 of 980 points are not finite; they were left out."


def test_a_few_intensities_out_of_scale_are_clipped_with_a_warning_and_many_are_refused(tmp_path: Path) -> None:
    root = write_custom(tmp_path, names=("a",))
    points = np.load(root / "points/a.npy")
    points[:3, 3] = (4, -1, 2)
    np.save(root / "points/a.npy", points)
    message = r"Frame a: 3 intensities outside \[0, 1\] were clipped\."
    with (
        pytest.warns(FormatWarning, match=message),
        make_batches(open_dataset(root, "train"), CONFIG, seed=0, batch_size=1, augmented=False) as batches,
    ):
        intensity = np.asarray(next(batches).cloud.points[0, :3, 3])
    np.testing.assert_array_equal(intensity, [1, 0, 1])
    np.save(root / "points/a.npy", points * [1, 1, 1, 255])
    with (
        pytest.raises(InputError, match="`intensity_scale`"),
        make_batches(open_dataset(root, "train"), CONFIG, seed=0, batch_size=1) as batches,
    ):
        next(batches)
