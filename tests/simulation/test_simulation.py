"""The LiDAR simulator: rays against known shapes, labels against occlusion, frames against their files."""

from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ciassd_jax import tiny
from ciassd_jax.data.folders import open_dataset
from ciassd_jax.data.scenes import pad_frame
from ciassd_jax.evaluation.dataset_check import check_dataset
from ciassd_jax.formats.errors import DroppedWarning, InputError
from ciassd_jax.formats.kitti_camera import read_calibration
from ciassd_jax.formats.kitti_rows import read_rows
from ciassd_jax.ops.footprints import points_in_boxes
from ciassd_jax.simulation import (
    Lidar,
    frame_key,
    make_frame,
    open_synthetic,
    simulate,
    split_synthetic,
    write_synthetic,
)
from ciassd_jax.simulation.casting import Rays
from ciassd_jax.simulation.ground import Ground, cast_ground, ground_height
from ciassd_jax.simulation.label_rows import label_rows
from ciassd_jax.simulation.layout import Objects, World, sample_world
from ciassd_jax.simulation.materials import material
from ciassd_jax.simulation.road_users import (
    CAR,
    CYCLIST,
    MACHINE,
    NUM_STYLES,
    PEDESTRIAN,
    TRUCK,
    VAN,
    machine,
    person,
    vehicle,
)
from ciassd_jax.simulation.sensor import Sight, scan
from ciassd_jax.simulation.solids import Solids, block, column, cross, ellipsoid, extent, place, stack
from ciassd_jax.simulation.streets import observe
from ciassd_jax.simulation.virtual_camera import virtual_camera
from ciassd_jax.types import Boxes

# The beams of the real sensor and few columns; every scan below has the shapes of `small_world` and runs one program.
SMALL = Lidar(columns=512, noise=0.0, lost=0.0)
WALL = material("wall")
# Another sensor, and fewer columns of it.
OTHER = Lidar.with_beams(32, columns=512, height=2.1, max_range=40.0)
build_person, build_vehicle, build_machine = jax.jit(person), jax.jit(vehicle), jax.jit(machine)
extent_of = jax.jit(extent)
hit_ground, height_of = jax.jit(cast_ground), jax.jit(ground_height)


@cache
def small_world(seed: int = 0) -> World:
    return jax.device_get(sample_world(jax.random.key(seed), SMALL.height))


def flat_ground(sensor_height: float = 1.73) -> Ground:
    zero, far = np.float32(0), np.float32(1e4)
    return Ground(
        sensor_height=np.float32(sensor_height),
        slope=np.zeros(2, np.float32),
        bend=zero,
        yaw=zero,
        middle=zero,
        half_width=far,
        crossing=far,
        crossing_half=zero,
        kerb=zero,
        pavement=zero,
        beyond=np.int32(material("paving")),
        shade=np.float32(1),
        roughness=zero,
    )


def world_of(solids: Solids, objects: Objects | None = None, ground: Ground | None = None) -> World:
    """A world of these solids and objects, filled up to the shapes of `small_world`."""

    def fill(some: Any, full: Any) -> Any:
        return jax.tree.map(
            lambda leaf, other: np.concatenate([leaf, np.zeros_like(other[len(leaf) :])]), jax.device_get(some), full
        )

    full = small_world()
    none = jax.tree.map(lambda leaf: leaf[:0], full.objects)
    return World(ground or flat_ground(), fill(solids, full.solids), fill(objects or none, full.objects))


def look_at(solids: Solids) -> Sight:
    """What is seen of solids alone, with the ground out of sight."""
    return jax.device_get(scan(jax.random.key(0), world_of(solids, ground=flat_ground(1e5)), SMALL)[1])


def distances(solids: Solids) -> np.ndarray:
    """The horizontal distance of every ray's hit; inf for none."""
    sight = look_at(solids)
    assert sight.dropped == 0
    distance = sight.range / np.sqrt(1 + np.asarray(SMALL.rays().tangent) ** 2)[:, None]
    return np.where(distance < 100, distance, np.inf)


def ahead(rays: Rays, elevation: float) -> tuple[int, int]:
    """Row and column of the ray that looks along x, nearest to an elevation in degrees."""
    assert rays.azimuth[rays.azimuth.size // 2] == 0
    return int(np.argmin(abs(np.asarray(rays.tangent) - np.tan(np.deg2rad(elevation))))), rays.azimuth.size // 2


def test_a_ray_meets_a_box_a_cylinder_and_an_ellipsoid_where_they_are() -> None:
    row, column_ = ahead(SMALL.rays(), 0.0)
    tangent = float(SMALL.rays().tangent[row])
    for solid, expected in (
        (block((12, 0.1, 0), (4, 2, 1.5), WALL), 10.0),
        (column((12, 0, -1), 0.5, 3.0, WALL), 11.5),
        (ellipsoid((12, 0, 12 * tangent), (0.8, 0.5, 0.5), WALL), 11.2),
    ):
        assert distances(stack([solid]))[row, column_] == pytest.approx(expected, abs=1e-3)


def test_faces_lean() -> None:
    row, column_ = ahead(SMALL.rays(), -3.0)
    screen = block((12, 0, 0), (4, 2, 4), WALL, lean=(0.0, -0.5, 0.0, 0.0))
    # The rear face is at x = 10 + 0.5 z.
    tangent = float(SMALL.rays().tangent[row])
    expected = 10 / (1 - 0.5 * tangent)
    assert distances(stack([screen]))[row, column_] == pytest.approx(expected, abs=1e-3)


def test_tiles_lose_nothing() -> None:
    """Testing every ray against every solid of a street finds the same hits as the pairs of tiles."""
    solids = jax.tree.map(lambda leaf: leaf[small_world().solids.present], small_world().solids)
    # Rays stop at the surface of a wall.
    solids = solids._replace(material=np.full_like(solids.material, WALL))
    rays = SMALL.rays()
    found = distances(solids)[:, ::8]

    @jax.jit
    def try_all(solids: Solids) -> jax.Array:
        grown = jax.tree.map(lambda leaf: leaf[:, None, None], solids)
        azimuth = rays.azimuth[None, None, ::8] - grown.yaw
        tangent = jnp.broadcast_to(rays.tangent[None, :, None], (1, rays.tangent.size, 1))
        enter, leave = cross(grown, (jnp.cos(azimuth), jnp.sin(azimuth), tangent))
        enter = jnp.maximum(enter, 0.3)
        return jnp.where(enter < leave, enter, jnp.inf).min(0)

    expected = np.asarray(try_all(solids))
    expected = np.where(expected < 100, expected, np.inf)
    same = np.isclose(found, expected, atol=2e-3) | (np.isinf(found) & np.isinf(expected))
    # Rays that graze an edge may go either way.
    assert same.mean() > 0.9995
    assert np.isfinite(expected).sum() > 500


def test_what_is_over_capacity_is_counted() -> None:
    near, far = block((10, 0, 0), (0.01, 30, 3), WALL), block((60, 0, 0), (0.2, 400, 6), WALL)
    origin = np.stack([10 + 0.02 * np.arange(200), np.zeros(200), np.zeros(200)], -1).astype(np.float32)
    walls = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (200, *leaf.shape)), jax.device_get(near))
    walls = walls._replace(origin=origin)
    both, many = stack([near, far]), jax.tree.map(lambda some, one: np.append(some, one[None], 0), walls, far)
    enough, few = (look_at(some._replace(owner=np.arange(len(some.yaw), dtype=np.int32))) for some in (both, many))
    # The far wall shows beside the near one, unless the walls between them take all pairs.
    assert (enough.dropped, set(np.unique(enough.owner))) == (0, {-1, 0, 1})
    assert few.dropped > 0
    assert set(np.unique(few.owner)) == {-1, 0}
    np.testing.assert_array_equal(few.owner == 0, enough.owner == 0)


def test_flat_ground_is_met_at_the_sensor_height_over_the_tangent() -> None:
    rays = SMALL.rays()
    flat = np.zeros((rays.tangent.size, rays.azimuth.size), np.float32)
    distance, cosine, _ = hit_ground(flat_ground(), rays.azimuth, rays.tangent, flat)
    distance, cosine = np.asarray(distance), np.asarray(cosine)
    down = np.asarray(rays.tangent) < 0
    expected = np.broadcast_to(-1.73 / np.asarray(rays.tangent)[down, None], distance[down].shape)
    np.testing.assert_allclose(distance[down], expected, rtol=1e-5)
    assert np.isinf(distance[~down]).all()
    np.testing.assert_allclose(cosine[down, 0], np.sin(-np.arctan(np.asarray(rays.tangent)[down])), atol=1e-6)


def test_sloping_ground_with_kerbs_is_met_on_its_surface() -> None:
    ground, rays = small_world().ground, SMALL.rays()
    flat = np.zeros((rays.tangent.size, rays.azimuth.size), np.float32)
    distance = np.asarray(hit_ground(ground, rays.azimuth, rays.tangent, flat)[0])
    distance = np.where(distance < 60, distance, np.nan)
    x, y = distance * np.cos(rays.azimuth)[None], distance * np.sin(rays.azimuth)[None]
    above = distance * np.asarray(rays.tangent)[:, None] - np.asarray(height_of(ground, x, y))
    above = above[np.isfinite(above)]
    assert (abs(above) < 1e-3).mean() > 0.95
    assert abs(above).max() < ground.kerb + 1e-3


@pytest.mark.parametrize(
    ("kind", "size"),
    [
        (CAR, (4.0, 1.65, 1.5)),
        (VAN, (5.2, 1.9, 2.2)),
        (TRUCK, (10.0, 2.6, 3.4)),
        (PEDESTRIAN, (0.8, 0.6, 1.75)),
        (CYCLIST, (1.8, 0.6, 1.75)),
        (MACHINE, (2.6, 1.3, 2.1)),
    ],
)
def test_objects_fill_their_boxes(kind: int, size: tuple[float, float, float]) -> None:
    """For any style, the solids of an object stay inside its box and together reach its faces."""
    build = {PEDESTRIAN: build_person, CYCLIST: build_person, MACHINE: build_machine}.get(kind, build_vehicle)
    length, width, height = size
    for style in np.random.default_rng(0).uniform(size=(8, NUM_STYLES)).astype(np.float32):
        solids = jax.device_get(build(np.float32(size), np.int32(kind), style))
        front, rear, side, high, low = jax.device_get(extent_of(solids))
        x, y, z = np.moveaxis(solids.origin, -1, 0)
        edges = (x + front, -x + rear, abs(y) + side, z + high, -z + low)
        reach = [float(np.max(edge[solids.present])) for edge in edges]
        limits = (length / 2, length / 2, width / 2, height, 0.0)
        assert all(found < limit + 0.1 for found, limit in zip(reach, limits, strict=True)), reach
        assert all(found > limit - 0.16 for found, limit in zip(reach, limits, strict=True)), reach


def test_points_of_objects_lie_in_their_boxes() -> None:
    world = small_world()
    _, sight = scan(jax.random.key(1), world, SMALL)
    rays, owner = jax.device_get(SMALL.rays()), np.asarray(sight.owner)
    flat = np.asarray(sight.range) / np.sqrt(1 + rays.tangent**2)[:, None]
    flat = np.where(np.isfinite(flat), flat, 0)
    x, y = flat * np.cos(rays.azimuth)[None], flat * np.sin(rays.azimuth)[None]
    places = np.stack([x, y, flat * rays.tangent[:, None]], -1)
    seen = np.unique(owner[owner >= 0])
    assert len(seen) >= 3
    for index in seen:
        box = jax.tree.map(
            lambda leaf, index=index: np.asarray(leaf)[None, index].astype(np.float64), world.objects.boxes
        )
        inside = points_in_boxes(places[owner == index].astype(np.float64), box._replace(size=box.size + 0.1))
        assert inside.mean() > 0.99


def street_with(more: Solids) -> World:
    """A car 15 m ahead on flat ground, and one more solid."""
    size = np.float32([4.0, 1.7, 1.5])
    parts = build_vehicle(size, np.int32(CAR), np.full(NUM_STYLES, 0.5, np.float32))
    car = place(parts, np.float32([15.0, 0.0, -1.73]), jnp.float32(0))
    car = car._replace(owner=np.zeros_like(car.owner))
    boxes = Boxes(np.float32([[15.0, 0.0, -0.98]]), size[None], np.zeros(1, np.float32))
    solids = jax.tree.map(lambda some, one: np.append(some, one[None], 0), car, more)
    return world_of(solids, Objects(boxes, np.int32([CAR]), np.array([True])))


def labels_of(world: World) -> list:
    seen = jax.device_get(observe(jax.random.key(0), world, SMALL))
    real = seen.objects.present
    boxes = jax.tree.map(lambda leaf: leaf[real].astype(np.float64), seen.objects.boxes)
    return label_rows(boxes, seen.objects.kind[real], seen.through[real], seen.arriving[real], virtual_camera())


def test_a_car_in_the_open_is_labelled_as_visible() -> None:
    (row,) = labels_of(street_with(block((7, 9, -0.5), (0.2, 6, 3), WALL)))
    assert (row.type, row.occluded, row.truncated) == ("Car", 0, 0)
    x1, _, x2, _ = row.bbox
    assert 550 < (x1 + x2) / 2 < 650
    assert row.rotation_y == pytest.approx(-np.pi / 2)


@pytest.mark.parametrize(("edge", "occlusion"), [(0.1, 1), (-0.2, 2)])
def test_a_wall_hides_part_of_a_car(edge: float, occlusion: int) -> None:
    """From the left up to y = edge at 7 m, where the car is seen from -0.46 to 0.46: 39 % and 72 % of it."""
    (row,) = labels_of(street_with(block((7, edge + 3, -0.5), (0.2, 6, 3), WALL)))
    assert row.occluded == occlusion


def test_a_wall_hides_a_car_and_its_label() -> None:
    assert labels_of(street_with(block((7, 0, -0.5), (0.2, 8, 3), WALL))) == []


def test_labels_at_the_edge_of_the_image_are_truncated() -> None:
    box = Boxes(np.array([[10.0, 8.0, -1.0]]), np.array([[4.0, 1.7, 1.5]]), np.zeros(1))
    (row,) = label_rows(box, np.array([CAR]), np.array([100]), np.array([100]), virtual_camera())
    assert row.bbox[0] == 0
    assert 0.1 < row.truncated < 0.9


def test_few_rays_make_no_label_but_a_region_not_to_care_about() -> None:
    box = Boxes(np.array([[60.0, 0.0, -1.0]]), np.array([[4.0, 1.7, 1.5]]), np.zeros(1))
    (row,) = label_rows(box, np.array([CAR]), np.array([2]), np.array([2]), virtual_camera())
    assert (row.type, row.truncated, row.occluded, row.location) == ("DontCare", -1, -1, (-1000, -1000, -1000))
    assert row.bbox[2] > row.bbox[0]


def test_objects_out_of_range_are_regions_not_to_care_about() -> None:
    boxes = Boxes(np.array([[30.0, 0, -1], [45.0, 4, -1]]), np.array([[4.0, 1.7, 1.5]] * 2), np.zeros(2))
    rays, kinds = np.array([100, 100]), np.array([CAR, CAR])
    rows = label_rows(boxes, kinds, rays, rays, virtual_camera(), max_range=OTHER.label_range)
    assert [row.type for row in rows] == ["Car", "DontCare"]


def test_objects_stand_apart_on_the_ground() -> None:
    for seed in range(3):
        world = small_world(seed)
        boxes = jax.tree.map(lambda leaf, present=world.objects.present: leaf[present], world.objects.boxes)
        center, bottom = boxes.center, boxes.center[:, 2] - boxes.size[:, 2] / 2
        height = jax.vmap(ground_height, (None, 0, 0))(world.ground, center[:, 0], center[:, 1])
        np.testing.assert_allclose(bottom, height, atol=1e-4)
        grown = boxes._replace(size=boxes.size * np.array([[1, 1, 99]], np.float32))
        inside = points_in_boxes(np.asarray(center), grown)
        assert (inside.sum(1) == 1).all()
        assert not points_in_boxes(np.zeros((1, 3), np.float32), grown).any()


@pytest.mark.smoke
def test_a_frame_depends_on_its_seed_and_index_alone() -> None:
    first, again, other = (make_frame(3, index, SMALL)[0] for index in (5, 5, 6))
    np.testing.assert_array_equal(first.points, again.points)
    assert first.rows == again.rows
    assert len(first.points) != len(other.points)


def test_a_cloud_is_what_a_lidar_gives() -> None:
    points = make_frame(0, 0, SMALL)[0].points
    rays = 64 * SMALL.columns
    assert 0.5 * rays < len(points) < rays
    assert np.isfinite(points).all()
    assert points[:, 3].min() >= 0
    assert points[:, 3].max() <= 1
    distance = np.linalg.norm(points[:, :3], axis=1)
    assert distance.max() < SMALL.max_range + 0.1
    # The roof of the car that carries the sensor hides the ground close to it.
    flat = np.hypot(points[:, 0], points[:, 1])
    assert flat[(points[:, 0] > 0) & (abs(points[:, 1]) < 0.3)].min() > 4.4


def test_a_warning_counts_pairs_over_capacity(monkeypatch: pytest.MonkeyPatch) -> None:
    frame, _ = make_frame(0, 7, SMALL)
    monkeypatch.setattr("ciassd_jax.simulation.streets.make_frame", lambda *_: (frame, 3))
    with pytest.warns(DroppedWarning, match="000007.* 3 pairs"):
        open_synthetic(0, 8, SMALL).read(7)


def test_scenes_can_be_batched() -> None:
    keys = jnp.stack([frame_key(0, index) for index in range(2)])
    batch = jax.eval_shape(jax.vmap(lambda key: simulate(key, SMALL)), keys)
    assert batch.cloud.points.shape == (2, 64 * SMALL.columns, 4)
    assert batch.dropped.shape == (2,)


def test_a_folder_gives_back_the_frames(tmp_path: Path) -> None:
    assert write_synthetic(tmp_path / "five", frames=5, seed=1, lidar=SMALL) == 0
    files, direct = open_dataset(tmp_path / "five", "trainval"), open_synthetic(1, 5, SMALL)
    assert files.names == direct.names == ("000000", "000001", "000002", "000003", "000004")
    assert open_dataset(tmp_path / "five", "val").names == ("000003",)
    assert open_dataset(tmp_path / "five", "train").names == ("000000", "000001", "000002", "000004")
    splits = {split: open_dataset(tmp_path / "five", split).names for split in ("train", "val", "trainval", "all")}
    assert splits == split_synthetic(5)
    for index in range(5):
        read, made = files.read(index), direct.read(index)
        np.testing.assert_array_equal(read.points, made.points)
        assert (read.names, read.difficulty.tolist()) == (made.names, made.difficulty.tolist())
        np.testing.assert_allclose(read.boxes.to_array(), made.boxes.to_array(), atol=1e-3)
        assert read.rows is not None
        assert made.rows is not None
        assert [(row.type, row.occluded) for row in read.rows] == [(row.type, row.occluded) for row in made.rows]
        np.testing.assert_allclose([row.bbox for row in read.rows], [row.bbox for row in made.rows], atol=1e-4)
    assert pad_frame(direct.read(0), 0, tiny()).truth.count == len(direct.read(0).names)
    report = check_dataset(tmp_path / "five")
    assert [finding.text for finding in report.findings if finding.serious] == []
    assert len(report.frames) == 5
    # A shorter folder holds the same frames.
    write_synthetic(tmp_path / "two", frames=2, seed=1, lidar=SMALL)
    for file in ("velodyne/000001.bin", "label_2/000001.txt", "image_2/000001.png", "calib/000001.txt"):
        assert (tmp_path / "two/training" / file).read_bytes() == (tmp_path / "five/training" / file).read_bytes()


def test_labels_give_back_the_boxes_of_the_world() -> None:
    """The box that the reader finds is the one that the rays hit, in place and heading."""
    seen = jax.device_get(simulate(frame_key(1, 0), SMALL))
    frame = open_synthetic(1, 1, SMALL).read(0)
    centers = seen.objects.boxes.center[seen.objects.present]
    yaws = seen.objects.boxes.yaw[seen.objects.present]
    assert len(frame.names) > 0
    for center, yaw in zip(frame.boxes.center, frame.boxes.yaw, strict=True):
        nearest = np.argmin(np.linalg.norm(centers - center, axis=1))
        np.testing.assert_allclose(center, centers[nearest], atol=1e-3)
        assert np.cos(yaw - yaws[nearest]) > 1 - 1e-6


def test_the_virtual_camera_is_that_of_its_file(tmp_path: Path) -> None:
    write_synthetic(tmp_path, frames=1, seed=0, lidar=SMALL)
    read = read_calibration(tmp_path / "training/calib/000000.txt")
    for mine, theirs in zip(virtual_camera().calibration, read, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    for row in read_rows(tmp_path / "training/label_2/000000.txt"):
        assert row.type == "DontCare" or (abs(row.rotation_y) <= np.pi and abs(row.alpha) <= np.pi)


def test_a_folder_that_is_not_its_own_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(InputError, match=r"not empty.*overwrite"):
        write_synthetic(tmp_path, frames=1, seed=0, lidar=SMALL)
    with pytest.raises(InputError, match="was not written by"):
        write_synthetic(tmp_path, frames=1, seed=0, lidar=SMALL, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_overwriting_leaves_no_old_frame(tmp_path: Path) -> None:
    write_synthetic(tmp_path, frames=3, seed=0, lidar=SMALL)
    write_synthetic(tmp_path, frames=1, seed=0, lidar=SMALL, overwrite=True)
    assert open_dataset(tmp_path, "all").names == ("000000",)


def test_pillow_is_asked_for_before_anything_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "PIL.Image", None)
    with pytest.raises(InputError, match=r"pip install 'ciassd_jax\[viz\]'"):
        write_synthetic(tmp_path / "out", frames=1, seed=0, lidar=SMALL)
    assert not (tmp_path / "out").exists()


def test_numbers_of_rays_that_are_no_whole_tiles_are_refused() -> None:
    with pytest.raises(ValueError, match="multiples of 16"):
        Lidar(columns=100)


def test_beams_cover_the_same_elevations() -> None:
    assert Lidar.with_beams(64) == Lidar()
    full = Lidar().rays().tangent
    for beams in (16, 32, 48, 128):
        tangent = Lidar.with_beams(beams).rays().tangent
        assert len(tangent) == beams
        np.testing.assert_array_equal(tangent[jnp.array([0, -1])], full[jnp.array([0, -1])])
        assert (jnp.diff(tangent) < 0).all()


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"beams": 40}, "40 beams .* a multiple of 16 up to 128, such as 32 or 48"),
        ({"beams": 0}, "0 beams .* such as 16 or 32"),
        ({"beams": 200}, "200 beams .* such as 112 or 128"),
        ({"beams": 32, "height": 0.0}, "height cannot be 0 m; choose 0.5 to 10 m"),
        ({"beams": 32, "height": np.nan}, "height cannot be nan m"),
        ({"beams": 32, "max_range": 500.0}, "range cannot be 500 m; choose 5 to 130 m"),
    ],
)
def test_sensors_that_cannot_be_simulated_are_refused(numbers: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Lidar.with_beams(**numbers)


def test_a_higher_sensor_sees_the_same_street_from_above() -> None:
    low, high = small_world(), jax.device_get(sample_world(jax.random.key(0), OTHER.height))
    present, lower = low.objects.present, SMALL.height - OTHER.height
    assert low.ground.sensor_height - high.ground.sensor_height == pytest.approx(lower, abs=1e-6)
    np.testing.assert_array_equal(high.objects.present, present)
    moved = (high.objects.boxes.center - low.objects.boxes.center)[present]
    np.testing.assert_allclose(moved, np.broadcast_to([0, 0, lower], moved.shape), atol=1e-5)


@pytest.mark.slow
def test_an_own_class_stands_among_cars_and_people() -> None:
    frames = [open_synthetic(0, 12, OTHER, "Forklift").read(index) for index in range(12)]
    names = [name for frame in frames for name in frame.names]
    assert names.count("Forklift") >= 12
    assert {"Car", "Pedestrian"} < set(names)
    turns = []
    for frame in frames:
        own = np.array([name == "Forklift" for name in frame.names], bool)
        boxes = jax.tree.map(lambda leaf, own=own: leaf[own], frame.boxes)
        assert np.linalg.norm(boxes.center, axis=-1).max(initial=0) < OTHER.max_range
        assert np.linalg.norm(frame.points[:, :3], axis=-1).max() < OTHER.max_range + 0.1
        grown = boxes._replace(size=boxes.size + 0.1)
        assert (points_in_boxes(frame.points[:, :3].astype(np.float64), grown).sum(1) > 0).all()
        turns.extend(boxes.yaw)
    # Four quarters of the circle.
    assert len(np.unique(np.floor(np.array(turns) / (np.pi / 2)) % 4)) == 4


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Fork lift", "'Fork lift' is not one word"),
        ("", "'' is not one word"),
        ("Fork\x00lift", "is not one word"),
        ("car", "car is in every simulated scene"),
        ("DONTCARE", "DONTCARE is in every simulated scene"),
    ],
)
def test_names_that_no_own_class_can_have_are_refused(tmp_path: Path, name: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        open_synthetic(0, 1, SMALL, name)
    with pytest.raises(InputError, match=message):
        write_synthetic(tmp_path / "out", frames=1, seed=0, lidar=SMALL, own_class=name)
    assert not (tmp_path / "out").exists()
