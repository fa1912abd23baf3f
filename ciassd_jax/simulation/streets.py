"""From a seed to a frame: world, scan, labels."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float32, Int

from ciassd_jax.data.frames import Dataset, Frame
from ciassd_jax.data.kitti import crop_to_view
from ciassd_jax.formats.kitti_boxes import rows_to_boxes
from ciassd_jax.formats.kitti_camera import Camera
from ciassd_jax.formats.kitti_rows import DONT_CARE, ObjectRow, difficulty_of
from ciassd_jax.simulation.casting import count_rays
from ciassd_jax.simulation.label_rows import label_rows
from ciassd_jax.simulation.layout import Objects, World, sample_world
from ciassd_jax.simulation.sensor import Lidar, scan
from ciassd_jax.simulation.solids import Solids, block
from ciassd_jax.simulation.virtual_camera import virtual_camera
from ciassd_jax.types import Array, PointCloud

# Pairs of an object ahead and a tile of rays.
_MAX_PAIRS = 1024


class Simulated(NamedTuple):
    """A turn of the sensor through one scene.

    Of the rays that go `through` an object's box, `arriving` are not stopped before it; objects behind the sensor have
    none. `dropped` counts pairs of a solid and a tile of rays over capacity: parts of far solids that were not seen.
    """

    cloud: PointCloud
    objects: Objects
    through: Int[Array, "*s O"]
    arriving: Int[Array, "*s O"]
    dropped: Int[Array, "*s"]


class SyntheticFrame(NamedTuple):
    """A frame as files would hold it: the full cloud, and the rows of the label."""

    points: Float32[np.ndarray, "P 4"]
    rows: list[ObjectRow]
    camera: Camera
    dropped: int


def frame_key(seed: int, index: int) -> jax.Array:
    """The key of a frame, which depends on nothing else."""
    return jax.random.fold_in(jax.random.key(seed), index)


def simulate(key: jax.Array, lidar: Lidar) -> Simulated:
    """Draw one scene and scan it; `vmap` over keys for several, or take `frame_key` of any."""
    for_world, for_scan = jax.random.split(key)
    return observe(for_scan, sample_world(for_world), lidar)


def observe(key: jax.Array, world: World, lidar: Lidar) -> Simulated:
    """Scan a scene, and count the rays that get to its objects."""
    cloud, sight = scan(key, world, lidar)
    through, arriving, dropped = _count(world.objects, sight.range, lidar)
    return Simulated(cloud, world.objects, through, arriving, sight.dropped + dropped)


@partial(jax.jit, static_argnames="lidar")
def _count(objects: Objects, distance: Array, lidar: Lidar) -> tuple[Array, Array, Array]:
    """Rays through the boxes of objects ahead, those that get there, and pairs over capacity."""
    rays = lidar.rays()
    flat = distance / jnp.sqrt(1 + rays.tangent**2)[:, None]
    return count_rays(_box_solids(objects), rays, flat, _MAX_PAIRS)


def make_frame(seed: int, index: int, lidar: Lidar | None = None) -> SyntheticFrame:
    """Simulate frame `index` of `seed` with its labels."""
    simulated = jax.device_get(simulate(frame_key(seed, index), lidar or Lidar()))
    present = simulated.objects.present
    boxes = jax.tree.map(lambda leaf: leaf[present].astype(np.float64), simulated.objects.boxes)
    counts = (simulated.objects.kind, simulated.through, simulated.arriving)
    kind, through, arriving = (values[present] for values in counts)
    camera = virtual_camera()
    rows = label_rows(boxes, kind, through, arriving, camera)
    points = simulated.cloud.points[: simulated.cloud.count]
    return SyntheticFrame(points, rows, camera, int(simulated.dropped))


def open_synthetic(seed: int, frames: int, lidar: Lidar | None = None) -> Dataset:
    """`frames` synthetic frames named 000000, 000001, ...: a data set without files, simulated as it is read.

    What `read` gives is what `data synth` with the same seed writes, but for the rounding of the labels' text.
    """
    names = tuple(f"{index:06d}" for index in range(frames))
    return Dataset(names, partial(read_synthetic_frame, seed=seed, lidar=lidar or Lidar()))


def read_synthetic_frame(name: str, *, seed: int, lidar: Lidar) -> Frame:
    """Simulate the frame of that name, cropped to the camera's view as KITTI's frames are."""
    frame = make_frame(seed, int(name), lidar)
    rows = [row for row in frame.rows if row.type != DONT_CARE]
    difficulty = np.array([difficulty_of(row) for row in rows], np.int64)
    boxes = rows_to_boxes(rows, frame.camera.calibration)
    points = crop_to_view(frame.points, frame.camera)
    return Frame(name, points, boxes, tuple(row.type for row in rows), difficulty, frame.camera)


def _box_solids(objects: Objects) -> Solids:
    """The boxes of the objects ahead."""

    def build(center: Array, size: Array) -> Solids:
        return block((center[0], center[1], center[2]), (size[0], size[1], size[2]), 0)

    boxes = objects.boxes
    ahead = boxes.center[:, 0] > 0
    return jax.vmap(build)(boxes.center, boxes.size)._replace(yaw=boxes.yaw, present=objects.present & ahead)
