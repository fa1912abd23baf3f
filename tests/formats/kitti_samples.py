"""A frame's calibration and one of its labels, and the form of every refusal."""

import re

import numpy as np
import pytest

from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.kitti_camera import Calibration
from ciassd_jax.formats.kitti_rows import ObjectRow

CALIBRATION = Calibration(
    np.array([[721.5377, 0, 609.5593, 44.85728], [0, 721.5377, 172.854, 0.2163791], [0, 0, 1, 0.002745884]]),
    np.array(
        [
            [0.9999239, 0.00983776, -0.00744505],
            [-0.0098698, 0.9999421, -0.00427846],
            [0.00740253, 0.00435161, 0.9999631],
        ]
    ),
    np.array(
        [
            [7.533745e-3, -0.9999714, -6.16602e-4, -4.069766e-3],
            [1.480249e-2, 7.280733e-4, -0.9998902, -7.631618e-2],
            [0.9998621, 7.52379e-3, 1.480755e-2, -0.2717806],
        ]
    ),
)
ROW = ObjectRow("Car", 0.0, 0, -1.766845, (0, 0, 0, 0), (1.57, 1.73, 4.15), (1.84, 1.47, 8.41), -1.56, 0.5)


def assert_refused(read, path, message):
    with pytest.raises(InputError, match=message) as caught:
        read(path)
    assert str(caught.value).startswith(str(path))
    assert str(caught.value).endswith(".")
    assert not re.search(r"\. [A-Z]|\n", str(caught.value))
