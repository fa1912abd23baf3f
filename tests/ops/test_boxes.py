"""Box coding against golden numbers, and the conversions between yaw and the paper's angle r."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ciassd_jax.ops.boxes import (
    apply_direction,
    decode,
    encode,
    from_paper,
    inside_range,
    r_to_yaw,
    to_paper,
    wrap_angle,
    yaw_to_r,
)
from ciassd_jax.types import Boxes


def random_boxes(rng: np.random.Generator, number: int) -> np.ndarray:
    """Boxes (N, 7) of KITTI's range and sizes, yaw of several turns."""
    return np.concatenate(
        [
            rng.uniform([0, -40, -3], [70, 40, 1], (number, 3)),
            np.exp(rng.normal(np.log([3.9, 1.6, 1.56]), 0.5, (number, 3))),
            rng.uniform(-9, 9, (number, 1)),
        ],
        1,
    )


def test_decode_inverts_encode():
    rng = np.random.default_rng(0)
    boxes, anchors = random_boxes(rng, 1000), random_boxes(rng, 1000)
    residuals = rng.normal(0, 0.7, (1000, 7))
    # float32 rounds coordinates of 70 m to 4e-6 m.
    for wide, atol in ((True, 1e-12), (False, 3e-5)):
        with jax.enable_x64(wide):
            given, onto = Boxes.from_array(jnp.asarray(boxes)), Boxes.from_array(jnp.asarray(anchors))
            assert (given.yaw.dtype == jnp.float64) == wide
            there_and_back = decode(encode(given, onto), onto).to_array()
            np.testing.assert_allclose(there_and_back, boxes, rtol=1e-6 if not wide else 0, atol=atol)
            there_and_back = encode(decode(jnp.asarray(residuals), onto), onto)
            np.testing.assert_allclose(there_and_back, residuals, rtol=0, atol=atol)


def test_a_box_on_itself_has_zero_residuals():
    boxes = Boxes.from_array(jnp.asarray(random_boxes(np.random.default_rng(1), 50)))
    assert not np.asarray(encode(boxes, boxes)).any()
    np.testing.assert_allclose(decode(jnp.zeros((50, 7)), boxes).to_array(), boxes.to_array(), rtol=0, atol=2e-6)


def test_numbers_of_the_released_code():
    box = from_paper(jnp.array([10.5, 1.9, -0.8, 1.7, 4.2, 1.5, -1.4]))
    anchor = from_paper(jnp.array([10.2, 2.2, -1, 1.6, 3.9, 1.56, 1.57]))
    expected = [0.0711668, -0.0711668, 0.1282051, 0.0606246, 0.0741080, -0.0392207, -2.97]
    np.testing.assert_allclose(encode(box, anchor), expected, rtol=0, atol=1e-6)


@pytest.mark.reference
def test_golden_codes(shared):
    with np.load(shared / "golden" / "box_coder.npz") as data:
        golden = dict(data)
    for wide, suffix, atol in ((True, "", 1e-12), (False, "_f32", 1e-5)):
        with jax.enable_x64(wide):
            boxes, anchors = from_paper(jnp.asarray(golden["boxes"])), from_paper(jnp.asarray(golden["anchors"]))
            encoded = encode(boxes, anchors)
            assert (encoded.dtype == jnp.float64) == wide
            decoded = to_paper(decode(jnp.asarray(golden["codes"]), anchors))
            np.testing.assert_allclose(encoded, golden["encoded" + suffix], rtol=0, atol=atol)
            np.testing.assert_allclose(decoded, golden["decoded" + suffix], rtol=0, atol=atol)


def test_paper_order_and_angle():
    """Heading (-sin r, -cos r); width before length; r = -pi / 2 looks along +x."""
    array = jnp.array([[1, 2, 3, 1.6, 3.9, 1.5, -np.pi / 2], [1, 2, 3, 1.6, 3.9, 1.5, 0.3]], jnp.float32)
    boxes = from_paper(array)
    np.testing.assert_array_equal(boxes.center, array[:, :3])
    np.testing.assert_allclose(boxes.size, [[3.9, 1.6, 1.5]] * 2, rtol=1e-7)
    np.testing.assert_allclose(jnp.cos(boxes.yaw), [1, -np.sin(0.3)], atol=1e-6)
    np.testing.assert_allclose(jnp.sin(boxes.yaw), [0, -np.cos(0.3)], atol=1e-6)
    np.testing.assert_allclose(to_paper(boxes), array, rtol=1e-6, atol=1e-7)


def test_yaw_and_r_are_each_others_inverse():
    angle = jnp.linspace(-9, 9, 1001)
    np.testing.assert_allclose(r_to_yaw(yaw_to_r(angle)), angle, rtol=0, atol=2e-6)
    np.testing.assert_allclose(yaw_to_r(r_to_yaw(angle)), angle, rtol=0, atol=2e-6)
    np.testing.assert_allclose(r_to_yaw(angle), yaw_to_r(angle), rtol=0, atol=2e-6)


def floats_around(value: float, number: int) -> np.ndarray:
    """The float32 numbers next to `value`, so many on either side."""
    bits = np.float32(value).view(np.int32) + np.arange(-number, number + 1, dtype=np.int32)
    return bits.view(np.float32)


@pytest.mark.parametrize("compiled", [False, True])
def test_wrapped_angles_lie_in_one_turn(compiled):
    """In [-pi, pi) up to the rounding of the angle given, with the same sine and cosine."""
    wrap = jax.jit(wrap_angle) if compiled else wrap_angle
    angle = np.concatenate(
        [
            np.linspace(-50, 50, 20_001, dtype=np.float32),
            *(floats_around(turns * np.pi, 500) for turns in range(-9, 10) if turns),
            np.zeros(1, np.float32),
        ]
    )
    wrapped = np.asarray(wrap(jnp.asarray(angle)))
    rounding = 2e-7 * np.maximum(abs(angle), np.pi)
    assert (wrapped < np.float32(np.pi)).all()
    assert (wrapped >= -np.float32(np.pi) - rounding).all()
    wide = angle.astype(np.float64)
    np.testing.assert_array_less(abs(np.sin(wrapped) - np.sin(wide)), 2 * rounding)
    np.testing.assert_array_less(abs(np.cos(wrapped) - np.cos(wide)), 2 * rounding)
    inside = abs(angle) < 3.14
    np.testing.assert_array_equal(wrapped[inside], angle[inside])


def test_half_a_turn_wraps_to_its_lower_end():
    half = np.float32(np.pi)
    np.testing.assert_array_equal(wrap_angle(jnp.array([half, -half])), [-half, -half])


def test_direction_turns_a_box_when_its_sign_disagrees():
    """(r > 0) xor (class 1); the comparison is strict, so r = 0 counts as class 0."""
    r = jnp.array([0.4, 0.4, -0.4, -0.4, 0.0, 0.0, 3.5, -3.5])
    direction = jnp.array([1, 0, 1, 0, 1, 0, 0, 1])
    expected = jnp.array([0.4, 0.4 + np.pi, -0.4 + np.pi, -0.4, np.pi, 0.0, 3.5 + np.pi, -3.5 + np.pi])
    boxes = Boxes(jnp.ones((8, 3)), jnp.full((8, 3), 2.0), r_to_yaw(r))
    turned = apply_direction(boxes, direction)
    np.testing.assert_allclose(yaw_to_r(turned.yaw), expected, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(turned.center, boxes.center)
    np.testing.assert_array_equal(turned.size, boxes.size)


def test_direction_boundary_is_strict():
    """r is exactly 0 for float32's -pi / 2; beside it, the next float on either side."""
    yaw = np.sort(floats_around(-np.pi / 2, 1))
    r = np.asarray(yaw_to_r(jnp.asarray(yaw)))
    assert r[0] > 0
    assert r[1] == 0
    assert r[2] < 0
    boxes = Boxes(jnp.zeros((3, 3)), jnp.ones((3, 3)), jnp.asarray(yaw))
    for direction in (0, 1):
        turned = apply_direction(boxes, jnp.full(3, direction)).yaw != boxes.yaw
        np.testing.assert_array_equal(turned, (r > 0) != bool(direction))


def test_range_is_closed_and_refuses_nan():
    low, high = (0.0, -40.0, -5.0), (70.4, 40.0, 5.0)
    above = np.nextafter(np.float32(70.4), np.float32(99))
    center = jnp.array(
        [[0, -40, -5], [70.4, 40, 5], [35, 0, 0], [above, 0, 0], [35, -40.001, 0], [35, 0, 5.001], [np.nan, 0, 0]]
    )
    boxes = Boxes(center, jnp.ones((7, 3)), jnp.zeros(7))
    expected = [True, True, True, False, False, False, False]
    np.testing.assert_array_equal(inside_range(boxes, low, high), expected)
    one = jax.tree.map(lambda leaf: leaf[1], boxes)
    assert bool(inside_range(one, low, high))
