"""What is shown of a large or damaged cloud."""

import numpy as np
import pytest

from ciassd_jax.view.sampling import FARTHEST, choose_points, thin, usable_boxes


@pytest.mark.parametrize(("count", "most"), [(10, 3), (1000, 999), (7, 7), (10_000_000, 150_000)])
def test_thinning_takes_one_of_each_part(count: int, most: int) -> None:
    chosen = thin(count, most)
    borders = np.arange(most + 1) * count // most
    assert len(chosen) == most
    assert ((borders[:-1] <= chosen) & (chosen < borders[1:])).all()
    np.testing.assert_array_equal(chosen, thin(count, most))


def test_thinning_takes_all_rings_of_an_organised_cloud() -> None:
    """The ring changes from point to point: a stride of 64 would show 1 ring of 64."""
    rings = np.arange(64 * 2000) % 64
    assert np.bincount(rings[thin(len(rings), 2000)], minlength=64).min() > 10


def test_a_small_cloud_is_shown_whole() -> None:
    points = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)
    shown = choose_points(points, 50)
    np.testing.assert_array_equal(shown.points, points[:, :3])
    assert shown.notes == ()


def test_what_is_left_out_is_counted() -> None:
    points = np.ones((10, 4), np.float32)
    points[0, 2], points[1, 0], points[2, 1], points[3, 3] = np.nan, np.inf, FARTHEST + 1, np.nan
    shown = choose_points(points, 4)
    assert len(shown.points) == 4
    assert shown.notes == (
        "2 of 10 points are not finite and not shown.",
        "1 of 10 points lie farther than 300 m and are not shown.",
        "4 of 10 points are shown, chosen evenly.",
    )


def test_boxes_without_numbers_or_out_of_this_world_are_not_usable() -> None:
    boxes = np.ones((5, 7))
    boxes[1, 6], boxes[2, 3], boxes[3, 0], boxes[4, 0] = np.nan, np.inf, 1e9, -FARTHEST
    assert usable_boxes(boxes).tolist() == [True, False, False, False, True]
