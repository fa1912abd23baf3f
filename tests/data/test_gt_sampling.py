"""Ground-truth sampling: the content of the database, damaged files, and the objects drawn for a scene."""

import pickle
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from oracles_data import footprint, inside

from ciassd_jax.config import AugmentationConfig, ClassConfig
from ciassd_jax.config.presets import car, tiny
from ciassd_jax.data.augment import augment, scene_key
from ciassd_jax.data.folders import open_dataset
from ciassd_jax.data.frames import Dataset, Frame
from ciassd_jax.data.gt_sampling import (
    build_database,
    eligible_objects,
    find_database,
    fingerprint_of,
    no_objects,
    open_database,
    sample_objects,
)
from ciassd_jax.data.scenes import pad_frame
from ciassd_jax.formats.errors import InputError
from ciassd_jax.types import Boxes

NAMES = ("Car", "Car", "Van", "Cyclist")
CONFIG = replace(
    tiny(),
    classes=(ClassConfig(gt_sampling_up_to=4, similar=("Van",)), ClassConfig(name="Cyclist", gt_sampling_up_to=2)),
    data=replace(tiny().data, max_gt_sampling_points=512),
)


def make_frame(name: str) -> Frame:
    """Two cars, a van and a cyclist of 0 to 30 points each."""
    rng = np.random.default_rng(int(name))
    centers = np.stack([np.arange(5, 45, 10), rng.uniform(-5, 5, 4), rng.uniform(-1, 0, 4)], -1)
    boxes = np.concatenate([centers, rng.uniform(1, 4, (4, 3)), rng.uniform(-4, 4, (4, 1))], 1)
    around = [
        center + rng.uniform(-0.3, 0.3, (count, 3))
        for center, count in zip(centers, rng.integers(0, 31, 4), strict=True)
    ]
    points = np.concatenate([*around, rng.uniform(-50, -40, (20, 3))])
    points = np.concatenate([points, rng.random((len(points), 1))], 1).astype(np.float32)
    return Frame(name, rng.permutation(points), Boxes.from_array(boxes), NAMES, rng.integers(-1, 3, 4), None)


DATASET = Dataset(tuple(map(str, range(12))), make_frame)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    build_database(DATASET, tmp_path / "made" / "objects.bin")
    return tmp_path / "made" / "objects.bin"


@pytest.fixture
def database(path: Path):
    return open_database(path, DATASET)


def test_it_holds_every_object(database):
    assert len(database.objects) == 12 * 4
    assert isinstance(database.points, np.memmap)
    total = 0
    for record in database.objects:
        frame, row = make_frame(str(record["frame"])), record["row"]
        box = frame.boxes.to_array()[row]
        np.testing.assert_array_equal(record["box"], box)
        assert database.names[record["name"]] == frame.names[row]
        assert record["difficulty"] == frame.difficulty[row]
        expected = frame.points[inside(frame.points, box)].astype(np.float64) - [*box[:3], 0]
        points = database.points[record["first"] :][: record["count"]]
        np.testing.assert_array_equal(points, expected.astype(np.float32))
        total += len(points)
    assert total == len(database.points) > 300


def test_workers_map_the_file_themselves(database):
    text = pickle.dumps(database)
    copy = pickle.loads(text)
    assert len(text) < 1000
    assert isinstance(copy.points, np.memmap)
    np.testing.assert_array_equal(copy.objects, database.objects)
    np.testing.assert_array_equal(copy.points, database.points)


def test_unpickling_does_not_read_the_data_set(path):
    reads: list[str] = []

    def read(name: str) -> Frame:
        reads.append(name)
        return make_frame(name)

    text = pickle.dumps(open_database(path, replace(DATASET, read_frame=read)))
    reads.clear()
    assert len(pickle.loads(text).objects) == 12 * 4
    assert not reads


def test_a_database_is_found_or_built(path, tmp_path):
    said: list[str] = []
    other = replace(DATASET, names=DATASET.names[:3])
    assert find_database(DATASET, [tmp_path / "none.bin", path], log=said.append).path == path
    assert not said
    assert find_database(other, [path, tmp_path / "built.bin"], log=said.append).path == tmp_path / "built.bin"
    assert len(open_database(tmp_path / "built.bin", other).objects) == 3 * 4
    assert len(said) == 1


def test_a_data_set_without_objects(tmp_path):
    def empty(name: str) -> Frame:
        none = Boxes.from_array(np.zeros((0, 7)))
        return Frame(name, np.zeros((3, 4), np.float32), none, (), np.zeros(0, np.int64), None)

    dataset = Dataset(("0",), empty)
    build_database(dataset, tmp_path / "objects.bin", track=lambda frames: frames)
    database = open_database(tmp_path / "objects.bin", dataset)
    assert (len(database.objects), len(database.points)) == (0, 0)
    drawn = sample_objects(database, (), seed=0, epoch=0, frame=0, config=CONFIG)
    assert not drawn.valid.any()
    np.testing.assert_array_equal(drawn.wanted, [4, 2])


def test_a_file_that_is_not_this_database_is_refused(path, tmp_path):
    content = path.read_bytes()
    bad = tmp_path / "bad.bin"
    for cut in (0, 5, 16, 20, 1000, len(content) - 8, len(content) - 1):
        bad.write_bytes(content[:cut])
        with pytest.raises(InputError, match=r"bad\.bin is (not a ground-truth|damaged).*ciassd data prepare`\.$"):
            open_database(bad, DATASET)
    foreign_footer = content[:16] + b"[1]" + (3).to_bytes(8, "little")
    more, less = content[:200] + bytes(16) + content[200:], content[:200] + content[216:]
    for foreign in (b"PK" + content[2:], content + b"x", foreign_footer, more, less):
        bad.write_bytes(foreign)
        with pytest.raises(InputError, match="build it again"):
            open_database(bad, DATASET)
    with pytest.raises(InputError, match="does not exist"):
        open_database(tmp_path / "none.bin", DATASET)
    with pytest.raises(InputError, match=r"objects\.bin is stale.*build it again"):
        open_database(path, replace(DATASET, names=DATASET.names[1:]))


def test_a_failed_build_leaves_the_old_file(path):
    def broken(name: str) -> Frame:
        if name == "3":
            raise InputError("frame 3 is broken.")
        return make_frame(name)

    before = path.read_bytes()
    with pytest.raises(InputError, match="frame 3"):
        build_database(replace(DATASET, read_frame=broken, find_files=lambda name: (path,)), path)
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


def write_custom(root: Path, name: str, label: str, points: int = 3) -> None:
    for folder in ("points", "labels"):
        (root / folder).mkdir(exist_ok=True)
    np.save(root / "points" / f"{name}.npy", np.zeros((points, 4), np.float32))
    (root / "labels" / f"{name}.txt").write_text(label)


def test_the_fingerprint_follows_labels_clouds_and_names(tmp_path):
    row = "1 2 3 4 2 1 0.5 Car\n"
    write_custom(tmp_path, "a", row)
    write_custom(tmp_path, "b", row)

    def fingerprint() -> str:
        return fingerprint_of(open_dataset(tmp_path, "all"))

    seen = [fingerprint()]
    assert fingerprint() == seen[0]
    write_custom(tmp_path, "a", row.replace("Car", "Van"))
    seen.append(fingerprint())
    write_custom(tmp_path, "b", row, points=4)
    seen.append(fingerprint())
    write_custom(tmp_path, "c", row)
    seen.append(fingerprint())
    assert len(set(seen)) == 4
    moved = tmp_path.rename(tmp_path.parent / "moved")
    assert fingerprint_of(open_dataset(moved, "all")) == seen[-1]
    moved.rename(tmp_path)


def names_of(database, objects) -> list[tuple[int, int]]:
    """Frame and row of the objects in the valid slots, found by their boxes."""
    table = database.objects["box"].astype(np.float32)
    found = [int(np.flatnonzero((table == box).all(1))[0]) for box in objects.boxes.to_array()[objects.valid]]
    return [(int(database.objects["frame"][i]), int(database.objects["row"][i])) for i in found]


def draw(database, names=("Car", "Van", "Tram"), config=CONFIG, **numbers):
    return sample_objects(database, names, **{"seed": 0, "epoch": 0, "frame": 0} | numbers, config=config)


def test_drawn_objects_have_their_class_and_points(database):
    objects = draw(database)
    # The scene has one car, and the van does not count: three of the four slots per round are drawn.
    np.testing.assert_array_equal(objects.wanted, [3, 2])
    np.testing.assert_array_equal(objects.label, [0] * 8 + [1] * 4)
    np.testing.assert_array_equal(objects.valid, [1, 1, 1, 0, 1, 1, 1, 0, 1, 1, 1, 1])
    assert not objects.boxes.to_array()[~objects.valid].any()
    places = names_of(database, objects)
    assert len(set(places)) == 10
    for slot, (frame, row) in zip(np.flatnonzero(objects.valid), places, strict=True):
        source = make_frame(str(frame))
        assert source.names[row] == ("Car", "Cyclist")[objects.label[slot]]
        assert source.difficulty[row] >= 0
        expected = source.points[inside(source.points, source.boxes.to_array()[row])]
        assert len(expected) >= 5
        np.testing.assert_allclose(objects.points[objects.owner == slot], expected, rtol=0, atol=4e-6)
    assert not objects.points[objects.owner == 12].any()
    assert (np.diff(objects.owner) >= 0).all()
    assert objects.cut == 0


def test_the_draw_follows_from_its_numbers_alone(database):
    first = draw(database)
    seen = {
        tuple(names_of(database, draw(database, **numbers))) for numbers in ({"seed": 1}, {"epoch": 1}, {"frame": 1})
    }
    assert len(seen | {tuple(names_of(database, first))}) == 4
    jax.tree.map(np.testing.assert_array_equal, first, draw(pickle.loads(pickle.dumps(database))))


def test_all_objects_are_drawn_as_often(database):
    eligible = eligible_objects(database, CONFIG.classes[0], difficulty_filter=True)
    counts: dict[tuple, int] = {}
    for frame in range(400):
        for place in names_of(database, draw(database, ("Car", "Car", "Car", "Cyclist", "Cyclist"), frame=frame)):
            counts[place] = counts.get(place, 0) + 1
    assert len(counts) == len(eligible)
    assert sum(counts.values()) == 2 * 400
    expected = 800 / len(eligible)
    assert all(expected / 2 < count < expected * 2 for count in counts.values())


def test_filters(database):
    table, car_class = database.objects, CONFIG.classes[0]
    is_car = table["name"] == database.names.index("Car")
    for least, filtered in ((1, False), (5, True), (20, False)):
        expected = np.flatnonzero(is_car & (table["count"] >= least) & ((table["difficulty"] >= 0) | (not filtered)))
        found = eligible_objects(database, replace(car_class, gt_sampling_min_points=least), difficulty_filter=filtered)
        np.testing.assert_array_equal(found, expected)
    assert len(eligible_objects(database, replace(car_class, name="Tram"), difficulty_filter=True)) == 0


def test_case_does_not_matter(database, tmp_path):
    def read(name: str) -> Frame:
        frame = make_frame(name)
        return frame._replace(names=("car", "CAR", "Van", "cyclist"))

    dataset = replace(DATASET, read_frame=read)
    build_database(dataset, tmp_path / "objects.bin")
    other = open_database(tmp_path / "objects.bin", dataset)
    assert set(other.names) == {"car", "CAR", "Van", "cyclist"}
    for one in CONFIG.classes:
        expected = eligible_objects(database, one, difficulty_filter=True)
        np.testing.assert_array_equal(eligible_objects(other, one, difficulty_filter=True), expected)
    numbers = {"seed": 1, "epoch": 0, "frame": 0, "config": CONFIG}
    drawn = sample_objects(database, ["Car", "Car", "Van"], **numbers)
    jax.tree.map(np.testing.assert_array_equal, drawn, sample_objects(other, ["CAR", "car", "VAN"], **numbers))
    assert drawn.wanted.tolist() == [2, 2]


def test_intensities_are_clipped_to_the_scale(database):
    config = replace(CONFIG, input=replace(CONFIG.input, intensity_scale=0.5))
    numbers = {"seed": 1, "epoch": 0, "frame": 0}
    before = sample_objects(database, [], **numbers, config=CONFIG).points
    after = sample_objects(database, [], **numbers, config=config).points
    assert before[:, 3].max() > 0.5
    np.testing.assert_array_equal(after, np.minimum(before, [np.inf, np.inf, np.inf, 0.5]).astype(np.float32))


def test_enough_objects_or_no_sampling_draw_nothing(database):
    many = draw(database, ("Car",) * 5 + ("Cyclist",) * 2)
    off = replace(CONFIG, data=replace(CONFIG.data, augmentation=AugmentationConfig(gt_sampling=False)))
    for objects in (many, draw(database, config=off), no_objects(CONFIG)):
        assert not objects.valid.any()
        assert not objects.points.any()
        assert (objects.owner == 12).all()
        np.testing.assert_array_equal(objects.wanted, [0, 0])
    assert draw(database, config=replace(CONFIG, classes=(ClassConfig(),))).label.shape == (0,)


def test_a_small_database_is_drawn_whole(database):
    wide = replace(CONFIG, classes=(ClassConfig(gt_sampling_up_to=40, gt_sampling_min_points=1),))
    objects = draw(database, (), replace(wide, data=replace(wide.data, max_gt_sampling_points=4096)))
    eligible = eligible_objects(database, wide.classes[0], difficulty_filter=True)
    assert objects.valid[: len(eligible)].all()
    assert objects.valid.sum() == len(set(names_of(database, objects))) == len(eligible)


def test_objects_whose_points_do_not_fit_are_counted(database):
    narrow = replace(CONFIG, data=replace(CONFIG.data, max_gt_sampling_points=60))
    objects, whole = draw(database, config=narrow), draw(database)
    assert objects.cut == whole.valid.sum() - objects.valid.sum() > 0
    for slot in np.flatnonzero(objects.valid):
        np.testing.assert_array_equal(objects.points[objects.owner == slot], whole.points[whole.owner == slot])


@pytest.mark.reference
def test_real_frames(shared, tmp_path):
    """Objects of twelve KITTI frames added to them: no collision, and every added box still has its points."""
    dataset = open_dataset(shared / "kitti", "train")
    dataset = replace(dataset, names=dataset.names[:12])
    build_database(dataset, tmp_path / "objects.bin")
    database = open_database(tmp_path / "objects.bin", dataset)
    config = replace(car(), data=replace(car().data, augmentation=AugmentationConfig(object_noise=False)))
    run = jax.jit(augment, static_argnames="config")
    added = 0
    for index in range(12):
        frame = dataset.read(index)
        scene = pad_frame(frame, index, config)
        objects = sample_objects(database, frame.names, seed=0, epoch=0, frame=index, config=config)
        result = run(scene_key(0, 0, index), scene, objects, config)
        assert (objects.cut, result.points_cut, result.boxes_cut) == (0, 0, 0)
        count = int(result.truth.count)
        boxes = np.asarray(result.truth.boxes.to_array())[:count]
        points = np.asarray(result.cloud.points)[: int(result.cloud.count)]
        targets = sum(name in ("Car", "Van") for name in frame.names)
        added += count - targets
        assert count >= 10 or objects.wanted[0] > objects.valid[:15].sum()
        polygons = [footprint(box) for box in boxes]
        for slot in range(targets, count):
            assert all(polygons[slot].intersection(polygons[other]).area < 1e-4 for other in range(slot))
            assert inside(points, boxes[slot]).sum() >= 4
    assert added > 60
