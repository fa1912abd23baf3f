"""Clouds that people really have: each is read, or refused with a remedy that works."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.points import check_intensity, read_points

# How each file is refused, if it is, and what its sentence advises.
FILES: dict[str, tuple[str | None, dict[str, Any]]] = {
    "binary_compressed.pcd": (None, {}),
    "capital_Intensity.pcd": (None, {}),
    "five_columns.bin": (r"makes no sense with 4 columns but does with 5; pass 5 as `columns`", {"columns": 5}),
    "intensity_one_bit.bin": (None, {}),
    "intensity_one_outlier.npy": (None, {}),
    "intensity_u16.npy": (r"outside \[0, 1\].*; pass 65535 as `intensity_scale`", {"scale": 65535.0}),
    "lower_type.pcd": (None, {}),
    "transposed_4xN.npy": (r"shape \(4, \d+\); transpose it", {}),
}


@pytest.mark.reference
@pytest.mark.parametrize("name", FILES)
def test_a_cloud_is_read_or_refused_with_the_remedy(shared: Path, name: str) -> None:
    path, (message, remedy) = shared / "hard_inputs/clouds" / name, FILES[name]
    if message is not None:
        with pytest.raises(InputError, match=message):
            check_intensity(read_points(path), 1.0, path)
    if message is None or remedy:
        # The intensities of the file with five columns are those of a byte.
        scale = remedy.get("scale", 255.0 if "columns" in remedy else 1.0)
        points, clipped = check_intensity(read_points(path, remedy.get("columns")), scale, path)
        assert clipped == (name == "intensity_one_outlier.npy")
        assert np.isfinite(points).all()
        assert 2 <= np.abs(points[:, 2]).max() < 10
