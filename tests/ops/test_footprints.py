"""Footprints against polygons by shapely, and the points inside boxes against their definition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from oracles_data import footprint, inside

from ciassd_jax.ops.footprints import box_corners, footprint_corners, footprints_collide, points_in_boxes
from ciassd_jax.types import Boxes


def random_boxes(rng: np.random.Generator, number: int, reach: float = 5.0) -> np.ndarray:
    """Boxes (N, 7) of all sizes, crowded around (40, -20), with values that float32 holds."""
    center = np.array([40, -20, -1]) + rng.uniform(-reach, reach, (number, 3)) * [1, 1, 0.1]
    size = np.exp(rng.uniform(np.log(0.3), np.log(12), (number, 3)))
    boxes = np.concatenate([center, size, rng.uniform(-7, 7, (number, 1))], 1)
    return boxes.astype(np.float32).astype(np.float64)


def narrow(boxes: np.ndarray) -> Boxes:
    return Boxes.from_array(jnp.asarray(boxes, jnp.float32))


def collisions(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """In float64 by NumPy and in float32 under jit."""
    wide = footprints_collide(Boxes.from_array(a), Boxes.from_array(b))
    assert isinstance(wide, np.ndarray)
    return wide, np.asarray(jax.jit(footprints_collide)(narrow(a), narrow(b)))


def test_collisions_are_shared_area():
    rng = np.random.default_rng(0)
    a, b = random_boxes(rng, 4000), random_boxes(rng, 4000)
    first, second = ([footprint(box) for box in boxes] for boxes in (a, b))
    area = shapely.area(shapely.intersection(first, second))
    gap = shapely.distance(first, second)
    clear = (area > 1e-4) | (gap > 1e-4)
    assert 0.1 < (area > 0).mean() < 0.9
    assert clear.mean() > 0.99
    wide, single = collisions(a, b)
    np.testing.assert_array_equal(wide, area > 0)
    np.testing.assert_array_equal(single[clear], area[clear] > 0)
    np.testing.assert_array_equal(collisions(b, a)[0], wide)


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2])
@pytest.mark.parametrize(("along", "across"), [(1, 0), (0, 1), (-1, 0), (1, 1), (0.5, -1)])
def test_touching_is_no_collision(yaw, along, across):
    """The shift is along x and y; at a quarter turn, two squares."""
    size = [4.0, 2.0, 1.0] if yaw == 0 else [2.0, 2.0, 1.0]
    a = np.array([[20, 5, 0, *size, 0.0]])
    b = a + np.array([along * size[0], across * size[1], 0, 0, 0, 0, yaw])
    nearer = b - np.array([along * 1e-3, across * 1e-3, 0, 0, 0, 0, 0])
    # A quarter turn has a cosine of 6e-17 (float32: 4e-8) only.
    slack = np.array([[0, 0, 0, 1e-5, 1e-5, 0, 0]]) if yaw else 0
    assert not any(result.any() for result in collisions(a - slack, b))
    assert all(result.all() for result in collisions(a, nearer))


def test_a_box_inside_another_and_its_own_copy_collide():
    outer, inner = np.array([[9, 2, 0, 8, 4, 2, 0.4]]), np.array([[9.5, 2, 0, 1, 1, 1, 2.0]])
    for a, b in ((outer, inner), (inner, outer), (outer, outer)):
        assert all(result.all() for result in collisions(a, b))


def test_a_footprint_without_area_and_nan_collide_with_nothing():
    whole = np.array([[0, 0, 0, 4, 2, 1, 0.0]])
    for size in ((0, 0), (4, 0), (0, 2)):
        empty = np.array([[0, 0, 0, *size, 1, 0.0]])
        assert not any(result.any() for result in (*collisions(whole, empty), *collisions(empty, whole)))
    assert not any(result.any() for result in collisions(whole, np.full((1, 7), np.nan)))


def test_leading_axes_broadcast():
    boxes = random_boxes(np.random.default_rng(1), 9)
    table = footprints_collide(Boxes.from_array(boxes[:, None]), Boxes.from_array(boxes[None]))
    np.testing.assert_array_equal(table, table.T)
    assert table.shape == (9, 9)
    assert np.diag(table).all()


def test_corners_go_round_from_the_front_left():
    boxes = random_boxes(np.random.default_rng(2), 50)
    expected = np.array([shapely.get_coordinates(footprint(box))[:4] for box in boxes])
    np.testing.assert_allclose(footprint_corners(Boxes.from_array(boxes)), expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(jax.jit(footprint_corners)(narrow(boxes)), expected, rtol=0, atol=2e-5)


@pytest.mark.parametrize("xp", [np, jnp])
def test_corners_of_a_box_stand_on_those_of_its_footprint(xp):
    rows = random_boxes(np.random.default_rng(1), 6)
    boxes = Boxes.from_array(xp.asarray(rows))
    corners = np.asarray(box_corners(boxes))
    around = np.asarray(footprint_corners(boxes))
    half = rows[:, None, 5] / 2
    np.testing.assert_array_equal(corners[..., :2], np.concatenate([around, around], 1))
    np.testing.assert_allclose(corners[:, :4, 2], np.tile(rows[:, None, 2] - half, (1, 4)), rtol=1e-6)
    np.testing.assert_allclose(corners[:, 4:, 2], np.tile(rows[:, None, 2] + half, (1, 4)), rtol=1e-6)


def test_points_strictly_inside():
    rng = np.random.default_rng(3)
    boxes = random_boxes(rng, 20)
    points = np.concatenate([[40, -20, -1] + rng.uniform(-8, 8, (5000, 3)) * [1, 1, 0.2], rng.random((5000, 1))], 1)
    points = points.astype(np.float32)
    expected = np.stack([inside(points, box) for box in boxes])
    assert 0.01 < expected.mean() < 0.5
    held = points_in_boxes(points, Boxes.from_array(boxes))
    assert isinstance(held, np.ndarray)
    np.testing.assert_array_equal(held, expected)
    single = np.asarray(jax.jit(points_in_boxes)(points, narrow(boxes)))
    assert (single != expected).sum() <= 2


def test_faces_and_nan_are_outside():
    box = Boxes.from_array(np.array([[1.0, 2.0, 3.0, 4.0, 2.0, 1.0, 0.0], [0.0] * 7]))
    points = np.array([[1, 2, 3], [3, 2, 3], [1, 1, 3], [1, 2, 3.5], [2.999, 2.999, 3.499], [np.nan, 2, 3], [0, 0, 0]])
    expected = [[True, False, False, False, True, False, False], [False] * 7]
    np.testing.assert_array_equal(points_in_boxes(points, box), expected)
    np.testing.assert_array_equal(points_in_boxes(jnp.asarray(points), jax.tree.map(jnp.asarray, box)), expected)


def test_a_damaged_point_is_outside_without_a_warning():
    points = np.array([[3e38, -3e38, 3e38], [0, 0, 0]], np.float32)
    box = narrow(np.array([[0.0, 0.0, 0.0, 4.0, 2.0, 1.0, 0.3]]))
    held = points_in_boxes(points, Boxes(*(np.asarray(leaf) for leaf in box)))
    np.testing.assert_array_equal(held, [[False, True]])


def test_a_mix_of_numpy_and_jax_gives_jax():
    rows = random_boxes(np.random.default_rng(4), 3)
    wide, single = Boxes.from_array(rows), narrow(rows)
    assert isinstance(footprints_collide(wide, single), jax.Array)
    assert isinstance(points_in_boxes(rows.astype(np.float32), single), jax.Array)
