"""Synthetic frames: a random scene, its scan and its labels, from a seed and an index."""

from __future__ import annotations

import warnings
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from ciassd_jax.data.frames import Dataset, Frame
from ciassd_jax.data.kitti import crop_to_view, kitti_frame
from ciassd_jax.formats.errors import DroppedWarning
from ciassd_jax.simulation.casting import count_rays
from ciassd_jax.simulation.label_rows import label_rows
from ciassd_jax.simulation.layout import NUM_MACHINES, Objects, World, sample_world
from ciassd_jax.simulation.road_users import kind_names
from ciassd_jax.simulation.sensor import Lidar, scan
from ciassd_jax.simulation.solids import Solids, block
from ciassd_jax.simulation.virtual_camera import virtual_camera
from ciassd_jax.types import Array, PointCloud

# The capacity for pairs of an object ahead and a tile of rays.
_MAX_PAIRS = 1024


class Simulated(NamedTuple):
    """One revolution of the sensor in one scene.

    Of the rays `through` an object's box, the `arriving` ones are not stopped before it; both are 0 for objects behind
    the sensor. `dropped` counts pairs of a solid and a tile of rays over capacity: parts of far solids that are not
    seen.
    """

    cloud: PointCloud
    objects: Objects
    through: Int[Array, "*s O"]
    arriving: Int[Array, "*s O"]
    dropped: Int[Array, "*s"]


def frame_key(seed: int, index: int) -> jax.Array:
    """Return the random key of a frame."""
    return jax.random.fold_in(jax.random.key(seed), index)


def simulate(key: jax.Array, lidar: Lidar, *, machines: bool = False) -> Simulated:
    """Draw one scene, with or without `machines`, and scan it.

    Use `vmap` for a batch of keys; `frame_key` returns that of a frame.
    """
    for_world, for_scan = jax.random.split(key)
    return observe(for_scan, sample_world(for_world, lidar.height, NUM_MACHINES * machines), lidar)


def observe(key: jax.Array, world: World, lidar: Lidar) -> Simulated:
    """Scan a scene, and count the rays that reach its objects."""
    cloud, sight = scan(key, world, lidar)
    through, arriving, dropped = _count(world.objects, sight.range, lidar)
    return Simulated(cloud, world.objects, through, arriving, sight.dropped + dropped)


@partial(jax.jit, static_argnames="lidar")
def _count(objects: Objects, distance: Array, lidar: Lidar) -> tuple[Array, Array, Array]:
    """The rays through the boxes of objects ahead, those that reach them, and the pairs over capacity."""
    rays = lidar.rays()
    flat = distance / jnp.sqrt(1 + rays.tangent**2)[:, None]
    return count_rays(_box_solids(objects), rays, flat, _MAX_PAIRS)


def make_frame(seed: int, index: int, lidar: Lidar | None = None, own_class: str | None = None) -> tuple[Frame, int]:
    """Simulate frame `index` of `seed`, which depends on the arguments alone.

    With `own_class` there are machines too, labelled with this name. Returns the frame, with the full cloud of
    360 degrees and all label rows, and `Simulated.dropped`. Raises InputError for an `own_class` that is not one word.
    """
    lidar, names = lidar or Lidar(), kind_names(own_class)
    simulated = jax.device_get(simulate(frame_key(seed, index), lidar, machines=own_class is not None))
    present = simulated.objects.present
    boxes = jax.tree.map(lambda leaf: leaf[present].astype(np.float64), simulated.objects.boxes)
    counts = (simulated.objects.kind, simulated.through, simulated.arriving)
    kind, through, arriving = (values[present] for values in counts)
    camera = virtual_camera()
    rows = label_rows(boxes, kind, through, arriving, camera, names, lidar.label_range)
    points = simulated.cloud.points[: simulated.cloud.count]
    return kitti_frame(f"{index:06d}", points, tuple(rows), camera), int(simulated.dropped)


def open_synthetic(seed: int, frames: int, lidar: Lidar | None = None, own_class: str | None = None) -> Dataset:
    """Return a data set of `frames` synthetic frames, named 000000, 000001, ..., which are simulated as they are read.

    `lidar` is the sensor, by default an HDL-64E, and `own_class` the name of a class of machines, as in `make_frame`.
    Except for the rounding of the label's text, the frames are those that `write_synthetic` writes for the same
    arguments. Raises InputError for an `own_class` that is not one word.
    """
    kind_names(own_class)
    read = partial(read_synthetic_frame, seed=seed, lidar=lidar or Lidar(), own_class=own_class)
    return Dataset(split_synthetic(frames)["all"], read)


def split_synthetic(frames: int) -> dict[str, tuple[str, ...]]:
    """Return the names of synthetic frames by split: 3, 7, 11, ... are val, the others train, and both are trainval."""
    names = tuple(f"{index:06d}" for index in range(frames))
    training = tuple(name for index, name in enumerate(names) if index % 4 != 3)
    return {"train": training, "val": names[3::4], "trainval": names, "all": names}


def read_synthetic_frame(name: str, *, seed: int, lidar: Lidar, own_class: str | None = None) -> Frame:
    """Simulate the frame of that name, cropped to the camera's view; a DroppedWarning counts pairs over capacity."""
    frame, dropped = make_frame(seed, int(name), lidar, own_class)
    if dropped:
        text = f"Frame {name} of seed {seed} is incomplete: {dropped} pairs of a solid and a tile are over capacity."
        warnings.warn(text, DroppedWarning, stacklevel=2)
    return frame._replace(points=crop_to_view(frame.points, virtual_camera()))


def _box_solids(objects: Objects) -> Solids:
    """The boxes of the objects ahead of the sensor, as solids."""

    def build(center: Array, size: Array) -> Solids:
        return block((center[0], center[1], center[2]), (size[0], size[1], size[2]), 0)

    boxes = objects.boxes
    ahead = boxes.center[:, 0] > 0
    return jax.vmap(build)(boxes.center, boxes.size)._replace(yaw=boxes.yaw, present=objects.present & ahead)
