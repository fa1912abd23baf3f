"""Vehicles, people and machines built of solids, relative to the bottom centre of their boxes, the front along +u.

Every function takes the size of the box (length, width, height) in metres and `style`, uniform numbers in [0, 1] that
vary the shape. The solids reach the faces of the box, as labelled objects do in KITTI.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.kitti_rows import DONT_CARE
from ciassd_jax.simulation.materials import material
from ciassd_jax.simulation.solids import Number, Solids, block, ellipsoid, solid, stack
from ciassd_jax.types import Array

NUM_STYLES = 8
KINDS = ("Car", "Van", "Truck", "Pedestrian", "Cyclist")
CAR, VAN, TRUCK, PEDESTRIAN, CYCLIST = range(len(KINDS))
# Machines, the kind that a user names.
MACHINE = len(KINDS)
# Mean and standard deviation of (length, width, height) in metres: of KITTI's labels (the 155 reference frames), and
# of machines.
SIZES = (
    ((3.92, 1.62, 1.53), (0.40, 0.10, 0.12)),
    ((5.05, 1.90, 2.20), (0.70, 0.14, 0.28)),
    ((10.5, 2.60, 3.35), (2.80, 0.14, 0.35)),
    ((0.84, 0.65, 1.75), (0.20, 0.12, 0.12)),
    ((1.78, 0.60, 1.74), (0.14, 0.10, 0.09)),
    ((2.60, 1.30, 2.10), (0.12, 0.06, 0.10)),
)
# Correlation of length, width and height in the labels of cars, used for every kind.
_CORRELATION = np.array([[1, 0.33, 0.19], [0.33, 1, 0.31], [0.19, 0.31, 1]])
_FACTOR = np.linalg.cholesky(_CORRELATION).astype(np.float32)
_MAX_DEVIATION = 2.2


def kind_names(own_class: str | None) -> tuple[str, ...]:
    """Return the name of every kind, with `own_class` as that of machines.

    Raises InputError if it is not one word, or the name of another kind.
    """
    if own_class is None:
        return KINDS
    if own_class.split() != [own_class] or not own_class.isprintable():
        raise InputError(f"The class {own_class!r} is not one word; write it without spaces, such as Forklift.")
    if own_class.lower() in map(str.lower, (*KINDS, DONT_CARE)):
        raise InputError(f"The class {own_class} is in every simulated scene; choose another name, such as Forklift.")
    return (*KINDS, own_class)


def draw_size(draws: Float[Array, " 3"], kind: Int[Array, ""]) -> Float[Array, " 3"]:
    """Return the size of an object from three standard normal draws, clipped at 2.2 standard deviations."""
    table = jnp.array(SIZES, jnp.float32)[kind]
    return table[0] + table[1] * jnp.clip(jnp.array(_FACTOR) @ draws, -_MAX_DEVIATION, _MAX_DEVIATION)


def vehicle(size: Float[Array, " 3"], kind: Int[Array, ""], style: Float[Array, " n"]) -> Solids:
    """Return the solids of a car, a van or a truck."""
    built = [build(size, style) for build in (_car, _van, _truck)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves)[kind], *built)


def person(size: Float[Array, " 3"], kind: Int[Array, ""], style: Float[Array, " n"]) -> Solids:
    """Return the solids of a pedestrian or a cyclist."""
    built = [build(size, style) for build in (_pedestrian, _cyclist)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves)[kind - PEDESTRIAN], *built)


def machine(size: Float[Array, " 3"], kind: Int[Array, ""], style: Float[Array, " n"]) -> Solids:
    """Return the solids of a machine: a low body, a mast as high as the box in front of it, and a roof behind the mast.

    There is one `kind`, so it is not read.
    """
    length, width, height = size
    front, mast, body = length / 2, 0.3 + 0.2 * style[0], height * (0.4 + 0.1 * style[1])
    shade = 0.5 + 0.5 * style[2]
    return stack(
        [
            solid((0, 0, 0), (front - mast, front, width / 2, body, -0.1), material("paint"), shade=shade),
            solid((0, 0, 0), (front, mast - front, 0.4 * width, height, -0.05), material("metal")),
            solid((0, 0, height), (front - mast, 0.25 * length, 0.45 * width, 0.0, 0.12), material("metal")),
        ]
    )


def _paint(style: Float[Array, " n"]) -> Array:
    """Reflectance of a vehicle's paint: dark for half of the vehicles, anything up to white for the others."""
    return jnp.where(style[6] < 0.5, 0.04 * style[7], 0.3 + 0.5 * style[7])


def _car(size: Float[Array, " 3"], style: Float[Array, " n"]) -> Solids:
    """A hatchback, saloon, estate or off-roader: body with rounded corners, bonnet, glass cabin with a roof."""
    length, width, height = size
    front, side, paint = length / 2, width / 2, _paint(style)
    types = jnp.array([0.45, 0.65, 0.85])
    chosen = jnp.sum(style[2] > types)
    # By type: the slope of the rear window in metres per metre of height, and the length of the boot lid.
    recede = jnp.array([-0.45, -1.5, -0.25, -0.35])[chosen]
    lid = jnp.array([0.02, 0.14, 0.01, 0.02])[chosen] * length
    clearance, belt = 0.15 + 0.07 * style[0], height * (0.60 + 0.05 * style[1])
    bonnet, nose = length * (0.22 + 0.07 * style[3]), height * (0.43 + 0.06 * style[5])
    tilt = (nose - belt) / bonnet
    rounding = (1.1 * front, 1.2 * side, jnp.inf)
    glass = front - bonnet
    screens = (-1.0 - 0.5 * style[4], recede, -0.25, -0.03)
    roof = height - belt

    def cabin(low: Number, grow: float, name: str) -> Solids:
        limits = (glass + grow, front - lid + grow - 0.05, side - 0.04 + grow, roof - 0.01 + grow, low)
        return solid((0, 0, belt), limits, material(name), lean=screens, shade=paint if name == "paint" else 1.0)

    pillar = (0.1, 0.04, 0.03, roof - 0.06, 0.0)
    return stack(
        [
            solid(
                (0, 0, 0),
                (glass + 0.3, front + 0.1 * clearance, side + 0.03 * clearance, belt, -clearance),
                material("paint"),
                lean=(-0.3, -0.1, -0.03, 0.0),
                radii=rounding,
                shade=paint,
            ),
            solid(
                (0, 0, 0),
                (front + 0.12 * clearance, -glass, side + 0.03 * clearance, nose - tilt * front, -clearance),
                material("paint"),
                lean=(-0.12, 0.0, -0.03, tilt),
                radii=rounding,
                shade=paint,
            ),
            cabin(0.0, 0.0, "glass"),
            cabin(0.08 - roof, 0.01, "paint"),
            *(
                solid((-0.05 * length, sign * (side - 0.13), belt), pillar, material("paint"), shade=paint)
                for sign in (1, -1)
            ),
            *_wheels(front - 0.2 * length, 0.19 * length - front, side, 0.29 + 0.04 * style[0], 0.09),
            *_plates(front, jnp.where(chosen == 0, 0.8, 0.65)),
        ]
    )


def _van(size: Float[Array, " 3"], style: Float[Array, " n"]) -> Solids:
    """A body with a short bonnet, a box on top of it, and glass around the driver."""
    length, width, height = size
    front, side, paint = length / 2, width / 2, _paint(style)
    clearance, belt = 0.2, height * (0.48 + 0.06 * style[1])
    bonnet = length * (0.08 + 0.12 * style[3])
    nose = belt * 0.8
    tilt = (nose - belt) / bonnet
    lean = (-0.5 - 0.4 * style[4], -0.06, -0.07, 0.0)
    up = height - belt
    rounding = (1.4 * front, 1.1 * side, jnp.inf)
    full = (front + 0.1 * clearance, front + 0.05 * clearance, side, nose - tilt * front, -clearance)
    # Behind the bonnet the tilted top rises above the belt, inside the box.
    window = (front - bonnet + 0.02, 0.9 - front + bonnet, side + 0.01, up - 0.2, -0.05)
    hidden = _absent()
    return stack(
        [
            solid((0, 0, 0), (front - bonnet, front, side, belt, -clearance), material("paint"), shade=paint),
            solid(
                (0, 0, 0),
                (full[0], bonnet - front, *full[2:]),
                material("paint"),
                lean=(-0.1, 0.0, 0.0, tilt),
                radii=rounding,
                shade=paint,
            ),
            solid((0, 0, belt), (front - bonnet, front, side, up, 0.0), material("paint"), lean=lean, shade=paint),
            solid((0, 0, belt), window, material("glass"), lean=(lean[0], 0.0, lean[2], 0.0)),
            *_wheels(front - 0.18 * length, 0.2 * length - front, side, 0.33, 0.1),
            *_plates(front, 0.8),
            hidden,
            hidden,
        ]
    )


def _truck(size: Float[Array, " 3"], style: Float[Array, " n"]) -> Solids:
    """A cab, a frame and a box behind a gap."""
    length, width, height = size
    front, side, paint = length / 2, width / 2, _paint(style)
    cab, high = 2.0 + 0.4 * style[3], height * (0.75 + 0.25 * style[1])
    floor = 0.9 + 0.3 * style[4]
    window = (front + 0.01, 0.8 - front, side - 0.03, high - 0.4, -0.6 * high)
    load = (front - cab - 0.4 * style[5], front, side, height, -floor)
    return stack(
        [
            solid((0, 0, 0), (front, cab - front, side - 0.05, high, -0.4), material("paint"), shade=paint),
            solid((0, 0, 0), window, material("glass")),
            solid((0, 0, 0), load, material("paint"), lean=(0, 0, 0, 0), shade=0.2 + 0.5 * style[0]),
            block((0, 0, 0.75), (length - 0.6, 0.9, 0.5), material("trim")),
            *_wheels(front - 1.4, 1.9 - front, side, 0.5, 0.15),
            *_plates(front, 0.9),
            _absent(),
            _absent(),
        ]
    )


def _wheels(ahead: Array, behind: Array, side: Array, radius: Number, half_width: float) -> list[Solids]:
    """Four wheels, flush with the sides of the vehicle."""
    limits = (radius, radius, half_width, radius, radius)
    radii = (radius, jnp.inf, radius)
    return [
        solid((along, sign * (side - half_width), radius), limits, material("tyre"), radii=radii)
        for along in (ahead, behind)
        for sign in (1, -1)
    ]


def _plates(front: Array, rear_height: Number) -> list[Solids]:
    """Two licence plates, which are retroreflective."""
    size = (0.04, 0.5, 0.11)
    return [
        block((front - 0.025, 0, 0.42), size, material("plate")),
        block((0.035 - front, 0, rear_height), size, material("plate")),
    ]


def _absent() -> Solids:
    return block((0, 0, 0), (0, 0, 0), 0)._replace(present=jnp.array(False))


def _pedestrian(size: Float[Array, " 3"], style: Float[Array, " n"]) -> Solids:
    """Legs in mid-stride, trunk, arms and head."""
    length, width, height = size
    step, shade = length / 2 - 0.09, 0.3 + 1.4 * style[0]
    cloth = material("cloth")
    parts = [
        ellipsoid((sign * step * 0.7, sign * 0.09, 0.24 * height), (0.11, 0.08, 0.26 * height), cloth, shade=style[1])
        for sign in (1, -1)
    ]
    parts += [
        ellipsoid((-sign * step * 0.5, sign * (width / 2 - 0.06), 0.6 * height), (0.12, 0.06, 0.18 * height), cloth)
        for sign in (1, -1)
    ]
    trunk = ellipsoid((0, 0, 0.65 * height), (0.15, width / 2 - 0.06, 0.24 * height), cloth, shade=shade)
    return stack([*parts, trunk, ellipsoid((0.02, 0, height - 0.12), (0.1, 0.09, 0.12), cloth)])


def _cyclist(size: Float[Array, " 3"], style: Float[Array, " n"]) -> Solids:
    """Two wheels, a frame, and a rider bent forward."""
    length, width, height = size
    radius, cloth, shade = 0.33, material("cloth"), 0.3 + 1.4 * style[0]
    wheel = (radius, radius, 0.025, radius, radius)
    return stack(
        [
            solid((sign * (length / 2 - radius), 0, radius), wheel, material("spokes"), radii=(radius, jnp.inf, radius))
            for sign in (1, -1)
        ]
        + [
            block((0, 0, 0.6), (0.8, 0.06, 0.4), material("spokes")),
            ellipsoid((0.05, 0, 0.7), (0.2, 0.15, 0.38), cloth, shade=style[1]),
            ellipsoid((0.0, 0, 0.68 * height), (0.28, width / 2 - 0.02, 0.22 * height), cloth, shade=shade),
            ellipsoid((0.18, 0, height - 0.12), (0.11, 0.09, 0.12), cloth),
        ]
    )
