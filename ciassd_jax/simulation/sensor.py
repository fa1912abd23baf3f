"""The sensor, by default a Velodyne HDL-64E: what it records of a scene."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ciassd_jax.simulation.casting import TILE, Rays, cast
from ciassd_jax.simulation.ground import cast_ground
from ciassd_jax.simulation.layout import World
from ciassd_jax.simulation.materials import MATERIALS
from ciassd_jax.types import Array, PointCloud

# What can be simulated: numbers of beams, heights above the ground and ranges in metres.
_BEAMS, _HEIGHTS, _RANGES = range(TILE, 129, TILE), (0.5, 10.0), (5.0, 130.0)


@dataclass(frozen=True)
class Lidar:
    """The parameters of the sensor; the defaults are those of the HDL-64E, estimated from full KITTI frames.

    `upper` and `lower` are blocks of beams: first and last elevation in degrees, and number. `columns` is the number of
    azimuths, evenly spaced over the full circle. `noise` is the standard deviation of the range and `max_range` the
    largest range, in metres; `lost` is the fraction of rays that never return. `height` is the mean height above the
    ground in metres. Raises ValueError for numbers that cannot be simulated.
    """

    upper: tuple[float, float, int] = (2.4, -7.85, 32)
    lower: tuple[float, float, int] = (-8.4, -23.7, 32)
    columns: int = 2176
    noise: float = 0.02
    lost: float = 0.01
    max_range: float = 80.0
    height: float = 1.73
    # The capacity for pairs of a solid and a tile of rays (`casting.cast`).
    max_pairs: int = 4096

    def __post_init__(self) -> None:
        if (self.upper[2] + self.lower[2]) % TILE or self.columns % TILE or self.columns < TILE:
            raise ValueError(f"Lidar: the numbers of beams and of columns must be multiples of {TILE}.")
        _check("height", self.height, _HEIGHTS)
        _check("range", self.max_range, _RANGES)

    @classmethod
    def with_beams(cls, beams: int, **more: float | int) -> Lidar:
        """Return a sensor whose `beams` cover the default elevations; `more` are other parameters.

        Raises ValueError unless `beams` is a multiple of 16 from 16 to 128.
        """
        if beams not in _BEAMS:
            near = sorted(sorted(_BEAMS, key=lambda number: abs(number - beams))[:2])
            choice = f"choose a multiple of {TILE} up to {_BEAMS[-1]}, such as {near[0]} or {near[1]}"
            raise ValueError(f"A sensor with {beams} beams cannot be simulated; {choice}.")
        blocks = {"upper": (*cls.upper[:2], beams // 2), "lower": (*cls.lower[:2], beams // 2)}
        return cls(**blocks, max_pairs=max(cls.max_pairs, 64 * beams), **more)  # type: ignore[arg-type]

    @property
    def label_range(self) -> float:
        """The distance in metres from which objects are DontCare; none for the default range or more, as in KITTI."""
        return self.max_range if self.max_range < Lidar.max_range else np.inf

    def rays(self) -> Rays:
        """Return the directions of the rays; the first column points backwards."""
        elevation = np.deg2rad(np.concatenate([np.linspace(*self.upper), np.linspace(*self.lower)]))
        azimuth = (np.arange(self.columns) / self.columns * 2 - 1) * np.pi
        return Rays(jnp.asarray(azimuth, jnp.float32), jnp.asarray(np.tan(elevation), jnp.float32))


def _check(what: str, value: float, limits: tuple[float, float]) -> None:
    if not limits[0] <= value <= limits[1]:
        raise ValueError(f"A sensor's {what} cannot be {value:g} m; choose {limits[0]:g} to {limits[1]:g} m.")


class Draws(NamedTuple):
    """The random numbers of every ray.

    `error` of the range and `spread` of the intensity are standard normal. `fate` is uniform and decides whether the
    ray returns; `stray` is exponential and scales how far it enters leaves and cabins.
    """

    error: Float[Array, "*s rows columns"]
    spread: Float[Array, "*s rows columns"]
    fate: Float[Array, "*s rows columns"]
    stray: Float[Array, "*s rows columns"]


class Sight(NamedTuple):
    """The first hit of every ray, whether it returns or not.

    `range` is in metres, inf without a hit; `cosine` is that of incidence; `owner` is the index of the object, -1 for
    none. `dropped` counts pairs over capacity (`casting.Hits`).
    """

    range: Float[Array, "*s rows columns"]
    cosine: Float[Array, "*s rows columns"]
    material: Int[Array, "*s rows columns"]
    shade: Float[Array, "*s rows columns"]
    owner: Int[Array, "*s rows columns"]
    dropped: Int[Array, "*s"]


def scan(key: jax.Array, world: World, lidar: Lidar) -> tuple[PointCloud, Sight]:
    """Return the points of one revolution, beam by beam, and the first hit of every ray."""
    draws = _draw(key, lidar)
    sight = _look(world, draws, lidar)
    return _record(sight, draws, lidar), sight


# Each step is a separate program: in one program XLA fuses across the steps and repeats much of the computation.
@partial(jax.jit, static_argnames="lidar")
def _draw(key: jax.Array, lidar: Lidar) -> Draws:
    shape = (lidar.upper[2] + lidar.lower[2], lidar.columns)
    bits = jax.random.bits(key, (4, *shape))
    # Less than 1, so that the logarithm is finite.
    uniform = (bits[2:] >> 8).astype(jnp.float32) * 2.0**-24
    return Draws(_bell(bits[0]), _bell(bits[1]), uniform[0], -jnp.log1p(-uniform[1]))


def _bell(bits: Array) -> Array:
    """Approximately standard normal numbers from random bits: the scaled sum of four bytes, within 3.5 deviations."""
    total = sum((bits >> shift & 255).astype(jnp.float32) for shift in (0, 8, 16, 24))
    return (total - 510.0) / np.sqrt(4 * (256**2 - 1) / 12).astype(np.float32)


@partial(jax.jit, static_argnames="lidar")
def _look(world: World, draws: Draws, lidar: Lidar) -> Sight:
    """Cast the rays on the solids and the ground."""
    rays, depth = lidar.rays(), jnp.array(MATERIALS)[world.solids.material, 3]
    hits = cast(world.solids, depth, rays, draws.stray, lidar.max_pairs)
    ground = cast_ground(world.ground, rays.azimuth, rays.tangent, _waves(draws.error))
    solid = jnp.where(hits.distance < ground[0], hits.solid, -1)
    found = solid >= 0
    return Sight(
        range=jnp.minimum(hits.distance, ground[0]) * jnp.sqrt(1 + rays.tangent**2)[:, None],
        cosine=jnp.where(found, hits.cosine, ground[1]),
        material=jnp.where(found, world.solids.material[solid], ground[2]),
        shade=jnp.where(found, world.solids.shade[solid], world.ground.shade),
        owner=jnp.where(found, world.solids.owner[solid], -1),
        dropped=hits.dropped,
    )


@partial(jax.jit, static_argnames="lidar")
def _record(sight: Sight, draws: Draws, lidar: Lidar) -> PointCloud:
    """Turn the rays that return into points."""
    rays, surface = lidar.rays(), jnp.array(MATERIALS)[sight.material]
    signal = _signal(surface, sight, draws.spread)
    returned = (draws.fate < _likelihood(surface, signal, sight, lidar)) & (sight.range < lidar.max_range)
    noisy = jnp.where(returned, sight.range, 0.0) + lidar.noise * draws.error
    flat = noisy / jnp.sqrt(1 + rays.tangent**2)[:, None]
    x, y = jnp.cos(rays.azimuth)[None], jnp.sin(rays.azimuth)[None]
    return _compact((flat * x, flat * y, flat * rays.tangent[:, None], signal), returned)


def _waves(noise: Float[Array, "rows columns"]) -> Array:
    """Standard normal numbers correlated over 16 columns, for bumps of the ground, from independent ones."""
    for shift in (1, 2, 4, 8):
        noise = (noise + jnp.roll(noise, shift, 1)) * 0.5**0.5
    return noise


def _signal(surface: Float[Array, "rows columns 4"], sight: Sight, spread: Float[Array, "rows columns"]) -> Array:
    """Intensity, rounded to hundredths as in KITTI: reflectance by material and shade, lower at grazing incidence."""
    glossy = surface[..., 0] >= 1
    angle = jnp.where(glossy, 0.15 + 0.55 * sight.cosine**2, 0.75 + 0.25 * sight.cosine)
    level = surface[..., 0] * sight.shade * angle + surface[..., 1] * spread * jnp.sqrt(sight.shade)
    return jnp.round(100 * jnp.clip(level, 0.0, 0.99)) / 100


def _likelihood(
    surface: Float[Array, "rows columns 4"], signal: Float[Array, "rows columns"], sight: Sight, lidar: Lidar
) -> Array:
    """Probability of a return: low for long ranges, grazing incidence, dark surfaces and windows."""
    energy = (0.035 + signal) * (0.05 + jnp.maximum(sight.cosine, 0)) * (30.0 / sight.range) ** 2
    return (1 - surface[..., 2]) * (1 - lidar.lost) * (1 - jnp.exp(-60 * energy))


def _compact(columns: tuple[Array, ...], kept: Array) -> PointCloud:
    """Move the points that are kept to the front, in order, and fill up with zeros."""
    kept = kept.reshape(-1)
    place = jnp.where(kept, jnp.cumsum(kept) - 1, kept.size)
    # One scatter per column: in a single scatter XLA would compute every point four times.
    packed = [jnp.zeros(kept.size).at[place].set(values.reshape(-1), mode="drop") for values in columns]
    return PointCloud(jnp.stack(packed, -1), kept.sum(dtype=jnp.int32))
