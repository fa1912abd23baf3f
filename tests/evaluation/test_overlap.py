"""Overlap in the three geometries against shapely, in float64."""

import numpy as np
import pytest
from plain_ap import shared
from scenes import found, label, random_frames

from ciassd_jax.evaluation.objects import detections_from_rows, flatten, labels_from_rows
from ciassd_jax.evaluation.overlap import Intersections, intersect
from ciassd_jax.formats.kitti_rows import ObjectRow


def one_pair(first: ObjectRow, second: ObjectRow, geometry: str) -> Intersections:
    labels, detections = flatten([labels_from_rows([first])]), flatten([detections_from_rows([second])])
    return intersect(labels, detections)[geometry]


def overlap_of(first: ObjectRow, second: ObjectRow, geometry: str) -> float:
    """Their overlap, which is not nothing."""
    return one_pair(first, second, geometry).overlap.item()


@pytest.mark.parametrize("geometry", ["bbox", "bev", "3d"])
def test_agrees_with_a_polygon_clipper(geometry: str) -> None:
    frames = random_frames(np.random.default_rng(0), 60)
    labels = flatten([labels_from_rows(rows) for rows, _ in frames])
    detections = flatten([detections_from_rows(rows) for _, rows in frames])
    ours = intersect(labels, detections)[geometry]
    truths = [row for rows, _ in frames for row in rows]
    results = [row for _, rows in frames for row in rows]
    pairs = {}
    for i, first in enumerate(truths):
        for j in np.flatnonzero(detections.frame == labels.frame[i]):
            values = shared(first, results[j], geometry)
            if values[0] > 1e-12 and first.type != "DontCare":
                pairs[i, int(j)] = values
    kept = labels.types[ours.first] != "dontcare"
    found_pairs = zip(ours.first[kept].tolist(), ours.second[kept].tolist(), strict=True)
    assert list(found_pairs) == list(pairs)
    assert len(pairs) > 300
    both, one, other = np.array(list(pairs.values())).T
    np.testing.assert_allclose(ours.overlap[kept], both / (one + other - both), rtol=0, atol=1e-11)
    np.testing.assert_allclose(ours.coverage[kept], both / other, rtol=0, atol=1e-11)


@pytest.mark.parametrize("geometry", ["bbox", "bev", "3d"])
def test_identical_objects_overlap_entirely(geometry: str) -> None:
    row = label(3, rotation_y=2.2)
    assert overlap_of(row, found(row, 1.0), geometry) == pytest.approx(1, abs=1e-13)
    assert one_pair(row, found(row, 1.0), geometry).coverage.item() == pytest.approx(1, abs=1e-13)


def test_turned_by_half_a_turn_or_with_its_sides_exchanged() -> None:
    row = label()
    _, width, length = row.dimensions
    for changes in (
        {"rotation_y": row.rotation_y + np.pi},
        {"rotation_y": row.rotation_y - np.pi / 2, "dimensions": (1.5, length, width)},
    ):
        assert overlap_of(row, found(row, 1.0, **changes), "3d") == pytest.approx(1, abs=1e-12)


def test_one_above_the_other() -> None:
    row = label()
    half = found(row, 1.0, location=(0.0, 1.7 - 0.75, 20.0))
    assert overlap_of(row, half, "3d") == pytest.approx(1 / 3, abs=1e-12)
    assert len(one_pair(row, found(row, 1.0, location=(0.0, 0.2, 20.0)), "3d").first) == 0
    assert overlap_of(row, half, "bev") == pytest.approx(1, abs=1e-12)


def test_what_is_not_given_shares_nothing() -> None:
    row = label()
    flat = found(row, 1.0, dimensions=(-1, -1, -1), location=(-1000, -1000, -1000), rotation_y=-10)
    assert len(one_pair(row, flat, "bev").first) == len(one_pair(row, flat, "3d").first) == 0
    assert len(one_pair(row, flat, "bbox").first) == 1
    thin = label(dimensions=(1.5, -1.6, 4.0))
    assert overlap_of(thin, found(row, 1.0), "bev") == pytest.approx(1, abs=1e-12)
    assert overlap_of(row, found(thin, 1.0), "bev") == pytest.approx(1, abs=1e-12)
    # A negative size is a size in the plane only, as in the official program.
    huge = label(name="DontCare", dimensions=(-1000, -1000, -1000), location=(-10, -1, -1), rotation_y=-1)
    assert one_pair(huge, found(row, 1.0), "bev").coverage.item() == pytest.approx(1)
    assert len(one_pair(huge, found(row, 1.0), "3d").first) == 0
