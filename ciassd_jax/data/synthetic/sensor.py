"""The sensor: what a Velodyne HDL-64E records of a world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ciassd_jax.data.synthetic.casting import TILE, Rays, cast
from ciassd_jax.data.synthetic.ground import cast_ground
from ciassd_jax.data.synthetic.layout import World
from ciassd_jax.data.synthetic.materials import MATERIALS, material
from ciassd_jax.types import Array, PointCloud


@dataclass(frozen=True)
class Lidar:
    """The sensor's numbers: those of the HDL-64E as its full KITTI frames show them.

    Two blocks of beams between two elevations in degrees each; columns are azimuths, evenly spaced round the circle.
    `noise` is the standard deviation of a range in metres, `max_range` the farthest return.
    """

    upper: tuple[float, float, int] = (2.4, -7.85, 32)
    lower: tuple[float, float, int] = (-8.4, -23.7, 32)
    columns: int = 2048
    noise: float = 0.02
    lost: float = 0.03
    max_range: float = 80.0
    # Pairs of a solid and a tile of 16 x 16 rays (`casting`).
    max_pairs: int = 4096

    def __post_init__(self) -> None:
        if (self.upper[2] + self.lower[2]) % TILE or self.columns % TILE or self.columns < TILE:
            raise ValueError(f"lidar: the numbers of beams and of columns must be multiples of {TILE}.")

    def rays(self) -> Rays:
        """Its directions; the first column looks back."""
        elevation = np.deg2rad(np.concatenate([np.linspace(*self.upper), np.linspace(*self.lower)]))
        azimuth = (np.arange(self.columns) / self.columns * 2 - 1) * np.pi
        return Rays(jnp.asarray(azimuth, jnp.float32), jnp.asarray(np.tan(elevation), jnp.float32))


class Scan(NamedTuple):
    """What the sensor records, beam by beam.

    `range` is the true distance in metres to what a ray meets first, whether it returns or not, inf for nothing; `owner`
    the object it is part of, -1 for none. `dropped` counts pairs over capacity (`casting.Hits`).
    """

    cloud: PointCloud
    range: Float[Array, "*s rows columns"]
    owner: Int[Array, "*s rows columns"]
    dropped: Int[Array, "*s"]


def scan(key: jax.Array, world: World, lidar: Lidar) -> Scan:
    """One turn of the sensor."""
    rays = lidar.rays()
    shape = (rays.tangent.size, rays.azimuth.size)
    keys = jax.random.split(key, 4)
    table = jnp.array(MATERIALS)
    stray, rough = jax.random.exponential(keys[0], shape), jax.random.normal(keys[1], shape)
    hits = cast(world.solids, table[world.solids.material, 3], rays, stray, lidar.max_pairs)
    below, below_cosine, below_material = cast_ground(world.ground, rays.azimuth, rays.tangent, rough)
    solid = jnp.where(hits.distance < below, hits.solid, -1)
    on_solid = solid >= 0
    stretch = jnp.sqrt(1 + rays.tangent**2)[:, None]
    distance = jnp.minimum(hits.distance, below) * stretch
    cosine = jnp.where(on_solid, hits.cosine, below_cosine)
    surface = table[jnp.where(on_solid, world.solids.material[solid], below_material)]
    shade = jnp.where(on_solid, world.solids.shade[solid], 1.0)
    signal = _signal(keys[2], surface, shade, cosine)
    returned = _returns(keys[3], surface, signal, cosine, distance, lidar)
    noisy = distance + lidar.noise * rough
    owner = jnp.where(on_solid, world.solids.owner[solid], -1)
    cloud = _compact((*_positions(rays, noisy / stretch), signal), returned)
    return Scan(cloud, distance, owner, hits.dropped)


def _signal(key: jax.Array, surface: Array, shade: Array, cosine: Array) -> Array:
    """Intensity in hundredths, as KITTI's: reflectance by material and shade, less at flat angles."""
    spread = surface[..., 1] * jax.random.normal(key, cosine.shape)
    glossy = surface[..., 0] >= 1
    level = surface[..., 0] * shade * jnp.where(glossy, 0.7 * cosine**2, 0.75 + 0.25 * cosine)
    return jnp.round(100 * jnp.clip(level + spread * jnp.sqrt(shade), 0.0, 0.99)) / 100


def _returns(key: jax.Array, surface: Array, signal: Array, cosine: Array, distance: Array, lidar: Lidar) -> Array:
    """Whether a ray returns: not from too far, seldom from flat angles, dark surfaces and windows."""
    energy = (0.08 + signal) * (0.03 + jnp.maximum(cosine, 0)) * (30.0 / distance) ** 2
    likely = (1 - surface[..., 2]) * (1 - lidar.lost) * (1 - jnp.exp(-60 * energy))
    return (jax.random.uniform(key, distance.shape) < likely) & (distance < lidar.max_range)


def _positions(rays: Rays, distance: Array) -> tuple[Array, Array, Array]:
    """x, y, z of points at horizontal distances; nothing at the sensor for no hit."""
    distance = jnp.where(jnp.isfinite(distance), distance, 0.0)
    x, y = jnp.cos(rays.azimuth)[None], jnp.sin(rays.azimuth)[None]
    return distance * x, distance * y, distance * rays.tangent[:, None]


def _compact(columns: tuple[Array, ...], kept: Array) -> PointCloud:
    """The points that are kept, beam by beam, then zeros."""
    kept = kept.reshape(-1)
    place = jnp.where(kept, jnp.cumsum(kept) - 1, kept.size)
    # Column by column: in one scatter XLA would compute every point once for each of its four columns.
    packed = [jnp.zeros(kept.size).at[place].set(values.reshape(-1), mode="drop") for values in columns]
    return PointCloud(jnp.stack(packed, -1), kept.sum(dtype=jnp.int32))
