"""Overlap of rotated boxes against a general polygon clipper, golden values and the properties of an IoU."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import polygon_iou

from ciassd_jax.ops.iou import intersection_bev, iou_3d, iou_bev
from ciassd_jax.types import Boxes

# The golden README's tolerances.
FLOAT64, FLOAT32 = 1e-9, 1e-4

jitted = {name: jax.jit(function) for name, function in [("bev", iou_bev), ("3d", iou_3d)]}


def in_float32(a: np.ndarray, b: np.ndarray, kind: str = "bev") -> np.ndarray:
    """The jitted float32 result for boxes (N, 7) of x, y, z, length, width, height, yaw."""
    return np.asarray(jitted[kind](*(Boxes.from_array(jnp.asarray(boxes, jnp.float32)) for boxes in (a, b))))


def in_float64(a: np.ndarray, b: np.ndarray, function=iou_bev) -> np.ndarray:
    """The NumPy float64 result for boxes (N, 7)."""
    return function(*(Boxes.from_array(np.asarray(boxes, np.float64)) for boxes in (a, b)))


def single(*values: float) -> np.ndarray:
    """One box (1, 7) from x, y, length, width, yaw."""
    x, y, length, width, yaw = values
    return np.array([[x, y, 0.0, length, width, 1.0, yaw]])


def rounded(*arrays: np.ndarray) -> list[np.ndarray]:
    """Values that float32 represents, so that both precisions see the same boxes."""
    return [array.astype(np.float32).astype(np.float64) for array in arrays]


def random_pairs(rng: np.random.Generator, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs in KITTI's range, of sizes from a pedestrian's to a truck's; nearly all overlap."""
    a, b = np.zeros((2, number, 7))
    a[:, :2] = rng.uniform([0, -40], [70, 40], (number, 2))
    a[:, 2] = rng.uniform(-2, 1, number)
    a[:, 3:6] = np.exp(rng.uniform(np.log(0.3), np.log(12), (number, 3)))
    a[:, 6] = rng.uniform(-7, 7, number)
    b[:, :3] = a[:, :3] + rng.normal(0, 1, (number, 3)) * a[:, 3:6] * rng.choice([0.05, 0.4], (number, 1))
    b[:, 3:6] = a[:, 3:6] * np.exp(rng.normal(0, 0.4, (number, 3)))
    b[:, 6] = a[:, 6] + rng.choice([rng.uniform(-4, 4, number), rng.normal(0, 0.1, number)])
    return a, b


def nearly_parallel_pairs(rng: np.random.Generator, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Copies turned by a multiple of pi / 2 and 1e-12 to 1e-3 rad, shifted by 1e-8 to 1 m or by whole sizes.

    Edges nearly coincide, cross at grazing angles or nearly touch: the hard case for float32.
    """
    a = np.zeros((number, 7))
    a[:, :2] = rng.uniform(-70, 70, (number, 2))
    a[:, 3:6] = np.exp(rng.uniform(np.log(0.3), np.log(12), (number, 3)))
    a[:, 6] = np.where(rng.random(number) < 0.5, rng.uniform(-4, 4, number), rng.integers(-4, 5, number) * np.pi / 2)
    b = a.copy()
    kind = rng.integers(0, 4, (number, 1))
    b[:, 3:6] *= np.where(kind == 1, rng.uniform(0.5, 2, (number, 3)), 1)
    shift = rng.normal(0, 1, (number, 2)) * 10 ** rng.uniform(-8, 0, (number, 1))
    b[:, :2] += np.where(kind >= 2, shift, 0)
    b[:, 6] += rng.choice([-1, 1], number) * 10 ** rng.uniform(-12, -3, number)
    b[:, 6] += rng.integers(-4, 5, number) * np.pi / 2 * rng.integers(0, 2, number)
    along, across = (rng.integers(-1, 2, (number, 2)) * a[:, 3:5]).T
    cosine, sine = np.cos(a[:, 6]), np.sin(a[:, 6])
    slide = np.stack([cosine * along - sine * across, sine * along + cosine * across], 1)
    b[:, :2] += np.where(rng.random((number, 1)) < 0.3, slide, 0)
    return a, b


def moved(boxes: np.ndarray, angle: float, shift: tuple[float, float]) -> np.ndarray:
    """Boxes after a rotation about the origin and a translation."""
    result = boxes.copy()
    cosine, sine = np.cos(angle), np.sin(angle)
    result[:, :2] = boxes[:, :2] @ np.array([[cosine, sine], [-sine, cosine]]) + np.array([shift])
    result[:, 6] += angle
    return result


@pytest.mark.parametrize("pairs", [random_pairs, nearly_parallel_pairs])
def test_agrees_with_a_polygon_clipper(pairs):
    a, b = rounded(*pairs(np.random.default_rng(0), 6000))
    expected = polygon_iou(a, b)
    assert (expected > 0.02).mean() > 0.6
    np.testing.assert_allclose(in_float64(a, b), expected, rtol=0, atol=FLOAT64)
    np.testing.assert_allclose(in_float32(a, b), expected, rtol=0, atol=FLOAT32)


def test_nearly_parallel_edges_close_in_float32():
    """At grazing angles a crossing moves by metres per rounding: the polygon must close all the same.

    Held against the float64 path, which the clipper confirms above. Worst error seen: 5e-6.
    """
    a, b = rounded(*nearly_parallel_pairs(np.random.default_rng(1), 100_000))
    np.testing.assert_allclose(in_float32(a, b), in_float64(a, b), rtol=0, atol=2e-5)


@pytest.mark.parametrize("exponent", range(-12, -2))
def test_a_copy_turned_a_little_has_nearly_the_same_footprint(exponent):
    """Turning an l x w box by a small t about its centre cuts off thin triangles of order t only."""
    angle = 10.0**exponent
    for base in (0.0, np.pi / 2, 1.1):
        a, b = rounded(single(31, -17, 4.2, 1.7, base), single(31, -17, 4.2, 1.7, base + angle))
        expected = polygon_iou(a, b)
        assert expected[0] > 1 - 2e-3
        np.testing.assert_allclose(in_float64(a, b), expected, rtol=0, atol=FLOAT64)
        np.testing.assert_allclose(in_float32(a, b), expected, rtol=0, atol=5e-6)


@pytest.mark.parametrize("pairs", [random_pairs, nearly_parallel_pairs])
def test_symmetric_and_between_zero_and_one(pairs):
    a, b = rounded(*pairs(np.random.default_rng(2), 20_000))
    for evaluate, slack in ((in_float64, 1e-12), (in_float32, 1e-5)):
        iou = evaluate(a, b)
        np.testing.assert_allclose(iou, evaluate(b, a), rtol=0, atol=slack)
        assert iou.min() >= 0
        assert iou.max() <= 1 + min(slack, 1e-6)


@given(
    seed=st.integers(0, 2**32 - 1),
    angle=st.floats(-10, 10),
    shift=st.tuples(st.floats(-50, 50), st.floats(-50, 50)),
)
@settings(max_examples=25, deadline=None)
def test_a_common_rigid_motion_changes_nothing(seed, angle, shift):
    a, b = random_pairs(np.random.default_rng(seed), 500)
    after = moved(a, angle, shift), moved(b, angle, shift)
    np.testing.assert_allclose(in_float64(*after), in_float64(a, b), rtol=0, atol=FLOAT64)
    # Rounding 100 m to float32 moves a thin box by more than the tolerance: compare what is left after it.
    after = rounded(*after)
    np.testing.assert_allclose(in_float32(*after), in_float64(*after), rtol=0, atol=FLOAT32)


def test_the_same_rectangle_written_differently_has_overlap_one():
    a, _ = rounded(*random_pairs(np.random.default_rng(3), 5000))
    turned, swapped = a.copy(), a.copy()
    turned[:, 6] += np.pi
    swapped[:, [3, 4]] = a[:, [4, 3]]
    swapped[:, 6] += np.pi / 2
    for same in (a, turned, swapped):
        np.testing.assert_allclose(in_float64(a, same), 1, rtol=0, atol=1e-12)
        np.testing.assert_allclose(in_float64(a, same, iou_3d), 1, rtol=0, atol=1e-12)
    np.testing.assert_allclose(in_float32(a, a), 1, rtol=0, atol=1e-6)
    # Rounding the yaw of 7 + pi to float32 turns a box of 12 x 0.3 m by up to 5e-7 rad.
    for same in (turned, swapped):
        np.testing.assert_allclose(in_float32(a, same), 1, rtol=0, atol=2e-5)


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, np.pi, 0.7, -2.3])
@pytest.mark.parametrize(("along", "across"), [(1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (-1, 1), (0.5, -1)])
def test_touching_boxes_share_nothing(yaw, along, across):
    length, width = 4.0, 1.75
    cosine, sine = np.cos(yaw), np.sin(yaw)
    u, v = along * length, across * width
    a = single(20, 5, length, width, yaw)
    b = single(20 + cosine * u - sine * v, 5 + sine * u + cosine * v, length, width, yaw)
    np.testing.assert_allclose(in_float64(a, b), 0, atol=1e-12)
    np.testing.assert_allclose(in_float32(a, b), 0, atol=5e-6)


@pytest.mark.parametrize("yaw", [0.0, 0.5, 3.0])
@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.4, -0.2), (1.0, 0.5)])
def test_a_box_inside_another_shares_its_own_area(yaw, offset):
    """The last offset lays two edges of the inner box on edges of the outer one."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    u, v = offset
    outer = single(10, -3, 4, 2, yaw)
    inner = single(10 + cosine * u - sine * v, -3 + sine * u + cosine * v, 2, 1, yaw)
    for a, b in ((outer, inner), (inner, outer)):
        np.testing.assert_allclose(in_float64(a, b), 2 / 8, rtol=0, atol=1e-12)
        np.testing.assert_allclose(in_float32(a, b), 2 / 8, rtol=0, atol=2e-6)


def test_boxes_whose_circumscribed_circles_are_apart_share_exactly_nothing():
    rng = np.random.default_rng(4)
    a, b = random_pairs(rng, 5000)
    reach = np.hypot(a[:, 3], a[:, 4]) / 2 + np.hypot(b[:, 3], b[:, 4]) / 2
    direction, distance = rng.uniform(-np.pi, np.pi, 5000), reach * rng.uniform(1.01, 20, 5000)
    b[:, :2] = a[:, :2] + distance[:, None] * np.stack([np.cos(direction), np.sin(direction)], 1)
    a, b = rounded(a, b)
    assert not in_float64(a, b).any()
    assert not in_float32(a, b).any()


def test_boxes_without_area_share_nothing_and_stay_finite():
    sizes = [(0.0, 0.0), (0.0, 2.0), (3.0, 0.0), (3.0, 2.0)]
    yaws = [0.0, 0.3, np.pi / 2, np.pi / 2 + 0.3]
    boxes = np.array([[5.0, 1.0, 0.0, l, w, h, t] for l, w in sizes for t in yaws for h in (0.0, 1.5)])  # noqa: E741
    a, b = (np.repeat(boxes, len(boxes), 0), np.tile(boxes, (len(boxes), 1)))
    area = np.minimum(a[:, 3] * a[:, 4], b[:, 3] * b[:, 4])
    volume = np.minimum(a[:, 3:6].prod(1), b[:, 3:6].prod(1))
    for kind, function, content in (("bev", iou_bev, area), ("3d", iou_3d, volume)):
        for iou, slack in ((in_float64(a, b, function), 1e-12), (in_float32(a, b, kind), 1e-6)):
            assert np.isfinite(iou).all()
            np.testing.assert_allclose(iou[content == 0], 0, atol=slack)
            assert (iou[content > 0] > 0.4).all()


def test_leading_axes_broadcast():
    a, b = random_pairs(np.random.default_rng(5), 7)
    table = in_float64(a[:, None], b[None])
    assert table.shape == (7, 7)
    np.testing.assert_array_equal(np.diag(table), in_float64(a, b))
    np.testing.assert_allclose(in_float32(a[:, None], b[None, :3]), table[:, :3], rtol=0, atol=FLOAT32)


def test_volume_overlap_is_area_times_height():
    a, b = random_pairs(np.random.default_rng(6), 4000)
    footprint = a[:, 3] * a[:, 4] + b[:, 3] * b[:, 4]
    iou = polygon_iou(a, b)
    area = iou * footprint / (1 + iou)
    top = np.minimum(a[:, 2] + a[:, 5] / 2, b[:, 2] + b[:, 5] / 2)
    bottom = np.maximum(a[:, 2] - a[:, 5] / 2, b[:, 2] - b[:, 5] / 2)
    shared = area * np.maximum(top - bottom, 0)
    expected = shared / (a[:, 3:6].prod(1) + b[:, 3:6].prod(1) - shared)
    assert (top < bottom).any()
    assert (expected > 0.02).mean() > 0.5
    np.testing.assert_allclose(in_float64(a, b, iou_3d), expected, rtol=0, atol=FLOAT64)
    np.testing.assert_allclose(in_float32(a, b, "3d"), expected, rtol=0, atol=FLOAT32)


@pytest.mark.parametrize(("lift", "expected"), [(0.0, 1.0), (0.5, 1 / 3), (1.0, 0.0), (1.5, 0.0), (-1.0, 0.0)])
def test_volume_overlap_above_one_another(lift, expected):
    a, b = single(3, 4, 4, 2, 0.25), single(3, 4, 4, 2, 0.25)
    b[:, 2] = lift
    np.testing.assert_allclose(in_float64(a, b, iou_3d), expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(in_float32(a, b, "3d"), expected, rtol=0, atol=1e-6)


def test_numbers_of_the_released_code():
    """In the paper's angle: yaw = -r - pi / 2."""
    a = np.array([[0, 0, -1.0, 3.9, 1.6, 1.5, -np.pi / 2]])
    b = np.array([[0.3, 0.5, -0.9, 4.1, 1.7, 1.6, -0.25 - np.pi / 2]])
    np.testing.assert_allclose(in_float64(a, b, intersection_bev), 4.8238386, rtol=0, atol=1e-7)
    np.testing.assert_allclose(in_float64(a, b), 0.5752141, rtol=0, atol=1e-7)
    np.testing.assert_allclose(in_float64(a, b, iou_3d), 0.5174478, rtol=0, atol=1e-7)


@pytest.mark.reference
def test_golden_pairs(shared):
    with np.load(shared / "golden" / "rotated_iou.npz") as data:
        a, b = (
            np.concatenate([p[:, :3], p[:, [4, 3, 5]], -p[:, 6:] - np.pi / 2], 1)
            for p in (data["boxes_a"], data["boxes_b"])
        )
        overlap, expected = data["overlap_bev"], {"bev": data["iou_bev"], "3d": data["iou_3d"]}
    np.testing.assert_allclose(in_float64(a, b, intersection_bev), overlap, rtol=0, atol=FLOAT64)
    np.testing.assert_allclose(polygon_iou(a, b), expected["bev"], rtol=0, atol=FLOAT64)
    for kind, function in (("bev", iou_bev), ("3d", iou_3d)):
        np.testing.assert_allclose(in_float64(a, b, function), expected[kind], rtol=0, atol=FLOAT64)
        np.testing.assert_allclose(in_float32(a, b, kind), expected[kind], rtol=0, atol=FLOAT32)
        with jax.enable_x64(True):
            boxes = [Boxes.from_array(jnp.asarray(array)) for array in (a, b)]
            wide = jax.jit(function)(*boxes)
            assert wide.dtype == jnp.float64
            np.testing.assert_allclose(wide, expected[kind], rtol=0, atol=FLOAT64)
