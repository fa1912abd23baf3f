"""Synthetic street scenes as a LiDAR sees them, with KITTI's labels.

`open_synthetic` returns a data set that is simulated as it is read, and `write_synthetic` writes a folder in KITTI's
layout. Both call `simulate`, the pure function from a random key to a cloud and its objects.
"""

from ciassd_jax.simulation.sensor import Lidar
from ciassd_jax.simulation.street_folder import make_frames, write_synthetic
from ciassd_jax.simulation.streets import frame_key, make_frame, open_synthetic, simulate, split_synthetic

__all__ = [
    "Lidar",
    "frame_key",
    "make_frame",
    "make_frames",
    "open_synthetic",
    "simulate",
    "split_synthetic",
    "write_synthetic",
]
