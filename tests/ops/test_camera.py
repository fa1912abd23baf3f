"""The frustum against the projected test that defines it, and against real crops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ciassd_jax.formats.kitti_camera import image_size_for, lidar_to_image, read_calibration
from ciassd_jax.formats.points import read_points
from ciassd_jax.ops.camera import clip_to_depth, frustum_planes, inside_planes, project

# A camera at the LiDAR that looks along x: u = 600 - 700 y / x, v = 180 - 700 z / x.
PROJECTION = np.array([[600.0, -700.0, 0.0, 45.0], [180.0, 0.0, -700.0, 0.2], [1.0, 0.0, 0.0, 0.003]])
SIZE = {"width": 1242, "height": 375}


def random_points(number: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.uniform([-30, -40, -8], [130, 40, 5], (number, 3))


def inside_by_projection(points: np.ndarray, projection: np.ndarray, width: int, height: int) -> np.ndarray:
    """Projection with KITTI's matrices, then the image's bounds."""
    a, b, d = projection @ np.vstack([points.T, np.ones(len(points))])
    return (d > 0.001) & (d < 100) & (a / d > 0) & (a / d < width) & (b / d > 0) & (b / d < height)


def test_frustum_is_the_projected_test():
    points = random_points(20_000)
    planes = frustum_planes(PROJECTION, **SIZE)
    assert planes.dtype == np.float64
    expected = inside_by_projection(points, PROJECTION, **SIZE)
    assert 0.05 < expected.mean() < 0.5
    np.testing.assert_array_equal(inside_planes(points, planes), expected)


def test_frustum_bounds_are_strict_and_garbage_is_outside():
    projection = np.eye(3, 4)
    planes = frustum_planes(projection, width=4, height=2)
    inside = [[2.0, 1.0, 1.0], [0.001, 0.001, 1.0], [3.999, 1.999, 1.0], [200, 100, 99.9]]
    on = [
        [0.0, 1.0, 1.0],
        [4.0, 1.0, 1.0],
        [2.0, 0.0, 1.0],
        [2.0, 2.0, 1.0],
        [200, 100, 100.0],
        [0.001, 0.001, 0.001],
    ]
    garbage = [[-2.0, -1.0, -1.0], [np.nan, 1.0, 1.0], [2.0, 1.0, np.nan]]
    assert inside_planes(np.array(inside), planes).all()
    assert not inside_planes(np.array(on + garbage), planes).any()
    assert not inside_planes(jnp.array([[jnp.inf, 1.0, 1.0], [1.0, 1.0, jnp.inf]]), planes).any()


def test_near_and_far_are_depths():
    planes = frustum_planes(PROJECTION, **SIZE, near=10.0, far=20.0)
    points = np.array([[x, 0.0, 0.0] for x in (5.0, 15.0, 25.0)])
    assert inside_planes(points, planes).tolist() == [False, True, False]


def test_jax_agrees_under_jit_and_for_any_leading_axes():
    points = random_points(512)
    planes = frustum_planes(PROJECTION, **SIZE)
    expected = inside_planes(points, planes)
    arrays = jnp.asarray(points, jnp.float32), jnp.asarray(planes, jnp.float32)
    np.testing.assert_array_equal(jax.jit(inside_planes)(*arrays), expected)
    np.testing.assert_array_equal(inside_planes(arrays[0], planes), expected)
    np.testing.assert_array_equal(inside_planes(arrays[0].reshape(2, 256, 3), arrays[1]), expected.reshape(2, 256))
    batched = jax.vmap(inside_planes)(arrays[0].reshape(2, 256, 3), jnp.stack([arrays[1]] * 2))
    np.testing.assert_array_equal(batched, expected.reshape(2, 256))
    assert inside_planes(points[0], planes).shape == ()
    assert inside_planes(np.zeros((0, 3)), planes).shape == (0,)


def test_project():
    points = np.array([[10.0, 1.0, -1.0], [-10.0, 1.0, -1.0]])
    pixels, depth = project(points, PROJECTION)
    np.testing.assert_allclose(depth, [10.003, -9.997])
    np.testing.assert_allclose(pixels[0], [5345 / 10.003, 2500.2 / 10.003])
    assert np.isnan(pixels[1]).all()
    assert pixels.dtype == np.float64
    in_jax = jax.jit(project)(jnp.asarray(points, jnp.float32), jnp.asarray(PROJECTION, jnp.float32))
    np.testing.assert_allclose(in_jax[0], pixels, rtol=1e-5)
    np.testing.assert_allclose(in_jax[1], depth, rtol=1e-5)


@pytest.mark.reference
def test_frustum_crop_of_the_full_cloud_is_the_reduced_cloud(shared):
    paths = sorted((shared / "kitti_full/training/velodyne").glob("*.bin"))
    assert paths
    for path in paths:
        calibration = read_calibration(shared / "kitti_full/training/calib" / f"{path.stem}.txt")
        width, height = image_size_for(calibration)
        planes = frustum_planes(lidar_to_image(calibration), width=width, height=height)
        points = read_points(path)
        reduced = read_points(shared / "kitti/training/velodyne_reduced" / path.name)
        np.testing.assert_array_equal(points[inside_planes(points[:, :3], planes)], reduced)


def test_points_that_are_too_near_move_to_the_nearest_depth():
    points = np.array([[1.0, 2.0, -1.0], [1.0, 2.0, 3.0], [1.0, 2.0, -1.0], [np.nan] * 3])
    ends = np.array([[5.0, 2.0, 3.0], [1.0, 2.0, -1.0], [1.0, 2.0, 0.5], [1.0, 2.0, 3.0]])
    clipped = clip_to_depth(points, ends, nearest=1.0)
    np.testing.assert_allclose(clipped[:2], [[3.0, 2.0, 1.0], points[1]])
    assert np.isnan(clipped[2:]).all()
