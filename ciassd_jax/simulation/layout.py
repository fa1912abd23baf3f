"""The layout of a random street scene, as solids and labelled objects.

Positions are drawn along the road (u) and across it (v). An object that would collide with an earlier one is removed.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ciassd_jax.simulation.clutter import NUM_CLUTTER, NUM_CLUTTER_KINDS, clutter_solids, draw_clutter
from ciassd_jax.simulation.ground import Ground, ground_height, road_to_lidar
from ciassd_jax.simulation.materials import material
from ciassd_jax.simulation.road_users import (
    CAR,
    CYCLIST,
    MACHINE,
    NUM_STYLES,
    PEDESTRIAN,
    TRUCK,
    VAN,
    draw_size,
    machine,
    person,
    vehicle,
)
from ciassd_jax.simulation.slots import Chance, Slots, deal, join, keep_apart
from ciassd_jax.simulation.solids import Solids, place, solid, stack
from ciassd_jax.types import Array, Boxes

# Slots of one lane and of all lanes, then of parked cars, yards, the crossing street and people, half on each side.
_LANE, _TRAFFIC, _PARKED, _YARDS, _CROSSING, _PEOPLE = 8, 48, 52, 16, 6, 16
_OBJECTS = _TRAFFIC + _PARKED + _YARDS + _CROSSING + _PEOPLE
# Slots of machines, if there are any; they come before all others.
NUM_MACHINES = 12
_SIDES = (1, -1)
_LANE_WIDTH = 3.3
_START, _END = -60.0, 78.0
# The position of the crossing street in a scene without one, in metres.
_NOWHERE = 1e4


class Objects(NamedTuple):
    """Objects that may get a label, if they are `present`."""

    boxes: Boxes
    kind: Int[Array, "*s O"]
    present: Bool[Array, "*s O"]


class World(NamedTuple):
    """A scene before it is scanned."""

    ground: Ground
    solids: Solids
    objects: Objects


class Street(NamedTuple):
    """The parameters of a street; `sides` are left and right.

    `lanes` counts those of one direction. `parked` is the fraction of parking spaces that are taken, `across` whether
    cars park perpendicular to the road, and `strip` the width of the parking spaces in metres. `traffic`, `people` and
    `yards` are the fractions of these slots that are taken.
    """

    lanes: Int[Array, ""]
    parked: Float[Array, " sides"]
    across: Bool[Array, " sides"]
    strip: Float[Array, " sides"]
    traffic: Float[Array, ""]
    people: Float[Array, ""]
    yards: Float[Array, ""]


@partial(jax.jit, static_argnames=("height", "machines"))
def sample_world(key: jax.Array, height: float, machines: int = 0) -> World:
    """Draw a random scene for a sensor that is mounted at `height` (metres), with slots for a number of `machines`."""
    groups = (machines, _TRAFFIC, _PARKED, _YARDS, _CROSSING, _PEOPLE)
    for_street, for_ground, *for_slots, chance, clutter_chance, of_kinds = deal(
        key, 1, 1, *groups, machines + _OBJECTS, NUM_CLUTTER, NUM_CLUTTER_KINDS
    )
    street = _draw_street(for_street)
    ground = _draw_ground(for_ground, street, height)
    draws = (_draw_machines, _draw_traffic, _draw_parked, _draw_yards, _draw_crossing, _draw_people)
    slots = join(*(draw(some, street, ground) for draw, some in zip(draws, for_slots, strict=True)))
    size = jax.vmap(draw_size)(jnp.stack([chance.normal() for _ in range(3)], -1), slots.kind)
    style = jnp.stack([chance.uniform() for _ in range(NUM_STYLES)], -1)
    objects, clutter = _settle(slots, size, draw_clutter(clutter_chance, of_kinds, ground), ground)
    people = len(slots.u) - _PEOPLE
    solids = [
        _build(machine, objects, style, slice(0, machines)),
        _build(vehicle, objects, style, slice(machines, people)),
        _build(person, objects, style, slice(people, None)),
        clutter_solids(clutter, ground),
        _ego(),
    ]
    return World(ground, jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *solids), objects)


def _draw_street(chance: Chance) -> Street:
    wide = chance.flip(0.25)
    parked = jnp.stack([jnp.maximum(chance.uniform(-0.35, 0.85), 0) for _ in _SIDES]) * ~wide
    across = jnp.stack([chance.flip(0.15) for _ in _SIDES])
    return Street(
        lanes=1 + wide * jnp.where(chance.flip(0.5), 1, 2),
        parked=parked,
        across=across,
        strip=jnp.where(parked > 0, jnp.where(across, 5.2, 2.2), 0.4),
        traffic=chance.uniform(0.05, 0.5),
        people=chance.uniform(0.0, 0.3),
        yards=chance.uniform(0.0, 0.35) * ~wide,
    )


def _draw_ground(chance: Chance, street: Street, height: float) -> Ground:
    half = street.lanes * _LANE_WIDTH
    # The sensor drives on the right, in any of the lanes, so the middle of the road is to its left.
    lane = jnp.floor(chance.uniform() * street.lanes)
    middle = half - _LANE_WIDTH * (lane + chance.uniform(0.4, 0.6))
    return Ground(
        sensor_height=height + 0.03 * chance.normal(),
        slope=jnp.stack([0.006 + 0.006 * chance.normal(), 0.008 * chance.normal()]),
        bend=1.0e-4 * chance.normal(),
        yaw=jnp.where(chance.flip(0.2), 0.3, 0.05) * chance.normal(),
        middle=middle + (street.strip[0] - street.strip[1]) / 2,
        half_width=half + street.strip.mean(),
        crossing=jnp.where(chance.flip(0.4), chance.uniform(6.0, 55.0), _NOWHERE),
        crossing_half=chance.uniform(3.0, 6.0),
        kerb=chance.uniform(0.03, 0.16),
        pavement=chance.uniform(1.2, 4.0),
        beyond=jnp.where(chance.flip(0.6), material("grass"), jnp.int32(material("paving"))),
        shade=chance.uniform(0.75, 1.3),
        roughness=chance.uniform(0.01, 0.045),
    )


def _draw_machines(chance: Chance, street: Street, ground: Ground) -> Slots:
    """Machines in parking spaces, on pavements and in yards, in any direction."""
    side, place = jnp.where(chance.flip(0.5), 1, -1), chance.uniform()
    yard = ground.pavement + chance.uniform(1.5, 12.0)
    away = jnp.where(place < 0.3, -_of(side, street.strip) / 2, jnp.where(place < 0.6, ground.pavement / 2, yard))
    return Slots(
        u=chance.uniform(-5.0, 50.0),
        v=ground.middle + side * (ground.half_width + away),
        yaw=chance.uniform(-np.pi, np.pi),
        kind=jnp.full_like(side, MACHINE),
        present=chance.flip(0.5),
    )


def _draw_traffic(chance: Chance, street: Street, ground: Ground) -> Slots:
    """Vehicles in the lanes; those on the left half of the road are oncoming."""
    side, lane = np.repeat(_SIDES, _TRAFFIC // 2), np.tile(np.arange(_TRAFFIC // 2) // _LANE, 2)
    step = (_END - _START) / _LANE
    kerb = ground.middle + side * (ground.half_width - _of(side, street.strip))
    return Slots(
        u=_START + step * (np.arange(_TRAFFIC) % _LANE + chance.uniform()),
        v=kerb - side * _LANE_WIDTH * (lane + 0.5) + 0.25 * chance.normal(),
        yaw=jnp.pi * (side > 0) + 0.03 * chance.normal(),
        kind=_vehicle_kind(chance, vans=0.12, trucks=0.08),
        present=chance.flip(street.traffic) & (lane < street.lanes),
    )


def _draw_parked(chance: Chance, street: Street, ground: Ground) -> Slots:
    """Cars parked along the kerbs, or perpendicular to them."""
    side, place = np.repeat(_SIDES, _PARKED // 2), np.tile(np.arange(_PARKED // 2), 2)
    across, strip = _of(side, street.across), _of(side, street.strip)
    first = _of(side, chance.uniform()[:2])
    u = jnp.where(across, -15.0 + 2.8 * (place + first), _START + 5.9 * (place + first))
    turned = chance.flip(jnp.where(across, 0.5, 0.12)) ^ (side > 0)
    return Slots(
        u=u + jnp.where(across, 0.3, 0.9) * chance.uniform(-0.5, 0.5),
        v=ground.middle + side * (ground.half_width - strip / 2) + 0.12 * chance.normal(),
        yaw=jnp.pi * turned + across * jnp.pi / 2 + 0.03 * chance.normal(),
        kind=_vehicle_kind(chance, vans=0.08, trucks=0.01),
        present=chance.flip(_of(side, street.parked)),
    )


def _draw_yards(chance: Chance, street: Street, ground: Ground) -> Slots:
    """Cars in drives and car parks beyond the pavements, most of them nearly parallel or perpendicular to the road."""
    side = np.repeat(_SIDES, _YARDS // 2)
    away = ground.half_width + ground.pavement + chance.uniform(2.5, 18.0)
    quarter = jnp.floor(chance.uniform(0.0, 4.0)) * (jnp.pi / 2)
    return Slots(
        u=chance.uniform(-20.0, 70.0),
        v=ground.middle + side * away,
        yaw=quarter + jnp.where(chance.flip(0.4), 0.6, 0.05) * chance.normal(),
        kind=_vehicle_kind(chance, vans=0.1, trucks=0.03),
        present=chance.flip(street.yards),
    )


def _draw_crossing(chance: Chance, _: Street, ground: Ground) -> Slots:
    """Vehicles on the crossing street."""
    side = np.repeat(_SIDES, _CROSSING // 2)
    return Slots(
        u=ground.crossing + side * ground.crossing_half / 2,
        v=ground.middle + chance.uniform(-30.0, 30.0),
        yaw=side * jnp.pi / 2 + 0.3 * chance.normal(),
        kind=_vehicle_kind(chance, vans=0.1, trucks=0.03),
        present=chance.flip(0.35) & (ground.crossing < _NOWHERE),
    )


def _vehicle_kind(chance: Chance, *, vans: float, trucks: float) -> Int[Array, " n"]:
    draw = chance.uniform()
    return jnp.where(draw < trucks, TRUCK, jnp.where(draw < trucks + vans, VAN, jnp.int32(CAR)))


def _draw_people(chance: Chance, street: Street, ground: Ground) -> Slots:
    """Pedestrians on the pavements and cyclists at the edges of the road."""
    side, rides = np.repeat(_SIDES, _PEOPLE // 2), chance.flip(0.3)
    walk = ground.half_width + ground.pavement * chance.uniform(0.1, 0.95)
    ride = ground.half_width - _of(side, street.strip) - 0.4
    return Slots(
        u=chance.uniform(-20.0, 55.0),
        v=ground.middle + side * jnp.where(rides, ride, walk),
        yaw=jnp.pi * chance.flip(0.5) + jnp.where(rides, 0.1, 0.5) * chance.normal(),
        kind=jnp.where(rides, CYCLIST, PEDESTRIAN),
        present=chance.flip(street.people),
    )


def _of(side: np.ndarray | Array, values: Array) -> Array:
    """The left or the right value for each slot."""
    return jnp.where(side > 0, values[0], values[1])


def _settle(slots: Slots, size: Float[Array, "O 3"], clutter: Slots, ground: Ground) -> tuple[Objects, Slots]:
    """Place objects and clutter on the ground, and remove those that collide with an earlier one."""
    u = jnp.concatenate([slots.u, clutter.u])
    v = jnp.concatenate([slots.v, clutter.v])
    x, y = road_to_lidar(ground, u, v)
    yaw = jnp.concatenate([slots.yaw, clutter.yaw]) + ground.yaw
    assert clutter.size is not None
    size = jnp.concatenate([jnp.asarray(size), clutter.size])
    height = ground_height(ground, x, y) + size[:, 2] / 2
    boxes = Boxes(jnp.stack([x, y, height], -1), size, yaw)
    # Machines, parked cars and clutter keep the crossing street free; traffic keeps a larger distance.
    index = np.arange(len(u)) - (len(slots.u) - _OBJECTS)
    moving, parked = (index >= 0) & (index < _TRAFFIC), _TRAFFIC + _PARKED + _YARDS
    standing = ((index < parked) & ~moving) | (index >= _OBJECTS)
    reach = (jnp.abs(jnp.cos(yaw)) * size[:, 0] + jnp.abs(jnp.sin(yaw)) * size[:, 1]) / 2
    in_street = standing & (jnp.abs(u - ground.crossing) < ground.crossing_half + reach + 0.5)
    wanted = jnp.concatenate([slots.present, clutter.present]) & ~in_street
    present = keep_apart(boxes, wanted, margin=0.3, moving=moving)
    number = len(slots.u)
    objects = Objects(jax.tree.map(lambda leaf: leaf[:number], boxes), slots.kind, present[:number])
    return objects, clutter._replace(present=present[number:])


def _build(shape, objects: Objects, style: Float[Array, "O n"], which: slice) -> Solids:  # type: ignore[no-untyped-def]
    """The solids of the objects `which`, along one axis."""
    boxes, kind, style = jax.tree.map(lambda leaf: leaf[which], (objects.boxes, objects.kind, style))
    parts = jax.vmap(shape)(boxes.size, kind, style)
    bottom = boxes.center - boxes.size * jnp.array([[0.0, 0.0, 0.5]])
    parts = jax.vmap(place)(parts, bottom, boxes.yaw)
    owner = jnp.arange(len(objects.kind), dtype=jnp.int32)[which]
    present = objects.present[which]
    parts = parts._replace(
        owner=jnp.broadcast_to(owner[:, None], parts.owner.shape), present=parts.present & present[:, None]
    )
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), parts)


def _ego() -> Solids:
    """The roof of the car that carries the sensor, which stops rays and reflects none."""
    roof = (1.05, 1.3, 0.55, 0.0, 1.0)
    return stack([solid((0.0, 0.0, -0.39), roof, material("ego"), radii=(1.9, 0.75, jnp.inf))])
