"""Runs: the active sites in a window of three z of one column, read from the maps of `sites.py`.

The sites of a run lie in consecutive slots. So a run is its first slot and a mask of three bits, and one lookup serves
three offsets of a kernel. Packed into one integer it is 8 * slot + mask; without a site the mask is 0.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Int, UInt32

from ciassd_jax.ops.platform import Program, by_platform
from ciassd_jax.ops.rows import rows_ahead
from ciassd_jax.ops.sites import NO_SITE, lower_bits
from ciassd_jax.types import Array, Sites

DEPTH = 3
# Numbers in a row of an accelerator's vector registers; a TPU pads the last axis of every array to as many.
_LANES = 128


def runs_at(
    sites: Sites,
    z: Int[Array, " V"],
    y: Int[Array, " V"],
    x: Int[Array, " V"],
    *,
    size: tuple[int, int],
    program: Program,
) -> tuple[Int[jax.Array, "KY KX V"], Int[jax.Array, "KY KX V"]]:
    """Return the first slot and the mask of the runs that begin at z, in the `size` columns from (y, x) on.

    Columns may lie outside of the grid. The slot of a run without sites means nothing.
    """
    assert sites.masks is not None, "sites of the dense backend have no maps"
    maps = (*lax.bitcast_convert_type(sites.masks, jnp.int32), sites.starts)
    cells, lines = partial(_read_cells, size=size), partial(_read_lines, size=size)
    # One array of all maps: apart, a CPU would read them again for each of their uses.
    *words, start = by_platform(program, maps, y, x, cpu=cells, gpu=cells, accelerator=lines)
    slot, mask = start, jnp.zeros_like(start)
    for i, word in enumerate(words):
        bits, shift = lax.bitcast_convert_type(word, jnp.uint32), (z - 32 * i)[None, None]
        slot += lax.population_count(bits & lower_bits(shift)).astype(jnp.int32)
        mask |= _from_bit(bits, shift)
    return slot, mask


def _from_bit(bits: UInt32[Array, "*n"], shift: Int[Array, "*m"]) -> Int[jax.Array, "*n"]:
    """The three bits of a word from bit `shift` on, which may lie below or above the word."""
    down = jnp.where((shift >= 0) & (shift < 32), bits >> shift.clip(0, 31).astype(jnp.uint32), 0)
    up = jnp.where((shift < 0) & (shift > -DEPTH), bits << (-shift).clip(0, DEPTH).astype(jnp.uint32), 0)
    return ((down | up) & np.uint32(7)).astype(jnp.int32)


def _within(index: Int[Array, "*n"], size: int) -> Bool[Array, "*n"]:
    return (index >= 0) & (index < size)


def _read_cells(
    maps: tuple[Array, ...], y: Int[Array, " V"], x: Int[Array, " V"], size: tuple[int, int]
) -> Int[Array, "M KY KX V"]:
    """Read every column of every map [Y, X] for itself; 0 outside of the maps."""
    height, width = maps[0].shape
    rows, columns = (n[None] + jnp.arange(k, dtype=jnp.int32)[:, None] for n, k in zip((y, x), size, strict=True))
    inside = _within(rows, height)[:, None] & _within(columns, width)[None]
    place = jnp.where(inside, rows[:, None] * width + columns[None], 0)
    read = (jnp.asarray(one).reshape(-1).at[place].get(mode="promise_in_bounds") for one in maps)
    return jnp.stack([jnp.where(inside, values, 0) for values in read])


def _read_lines(
    maps: tuple[Array, ...], y: Int[Array, " V"], x: Int[Array, " V"], size: tuple[int, int]
) -> Int[Array, "M KY KX V"]:
    """Read a row of columns of all maps at once: on a TPU the number of reads counts, not their width.

    A line holds the same stretch of x of every map, side by side. Lines overlap, so that one of them holds the whole
    window.
    """
    count, (height, width) = len(maps), maps[0].shape
    more = size[1] - 1
    # At least so many that the overlap comes from the next stretch alone.
    cells = max(_LANES // count, size[1], 2 * more)
    step = cells - more
    lines = -(-(width + more) // step)
    stretches = []
    for one in maps:
        padded = jnp.pad(one, ((0, 0), (more, (lines + 1) * step - more - width))).reshape(height, lines + 1, step)
        stretches += [padded[:, :-1], padded[:, 1:, :more]]
    table = jnp.concatenate(stretches, -1).reshape(height * lines, -1)
    rows = (y[None] + jnp.arange(size[0], dtype=jnp.int32)[:, None]).reshape(-1)
    # Windows beside the grid read the first line, and their columns count as empty.
    first = jnp.tile(x + more, size[0])
    inside = _within(rows, height) & _within(first, width + more)
    first = jnp.where(inside, first, 0)
    line = lax.div(first, np.int32(step))
    read = table.at[jnp.where(inside, rows, 0) * lines + line].get(mode="promise_in_bounds")
    lane = jnp.arange(table.shape[1], dtype=jnp.int32)[None]
    offset = (first - line * step)[:, None]

    def cell(number: int, column: int) -> Array:
        value = jnp.where(lane == offset + (number * cells + column), read, 0).sum(1, dtype=jnp.int32)
        return jnp.where(inside, value, 0).reshape(size[0], -1)

    return jnp.stack([jnp.stack([cell(number, column) for column in range(size[1])], 1) for number in range(count)])


def followers(sites: Sites, *, depth: int, step: int = 1) -> Int[jax.Array, " V"]:
    """The mask of the run that begins with each site; with a `step` of 2 the site at z + 1 is the third of it."""
    keys = jnp.asarray(sites.keys)
    real = keys != NO_SITE
    z = lax.rem(keys, np.int32(depth))
    ahead = [rows_ahead(keys, k, NO_SITE) - keys for k in (1, 2)]
    next_one = real & (ahead[0] == 1) & (z + 1 < depth)
    next_but_one = real & ((ahead[0] == 2) | (ahead[1] == 2)) & (z + 2 < depth)
    if step == 2:
        return real + 4 * next_one
    return real + 2 * next_one + 4 * next_but_one


def pack(slot: Int[Array, "KY KX V"], mask: Int[Array, "KY KX V"]) -> Int[Array, "J V"]:
    """Runs as one integer each, the columns of a window as rows."""
    return (8 * slot + mask).reshape(-1, slot.shape[-1])


def first_rows(runs: Int[Array, "J N"], rows: int) -> Int[Array, "J N"]:
    """Where each run lies in `windows` of so many rows."""
    slot, mask = runs >> 3, runs & 7
    offset = jnp.where(mask & 1 != 0, 0, jnp.where(mask & 2 != 0, 1, 2))
    return jnp.where(mask == 0, 3 * rows, offset * rows + slot)


def windows(rows: Float[Array, "N C"], following: Int[Array, " N"]) -> Float[jax.Array, "N3 2 D"]:
    """Every run that begins with a site, by first offset, then slot; the last is zero.

    A run is three offsets of C channels, in two halves. That way a TPU reads the 2 x 128 numbers of one run; of rows in
    a matrix it would read eight, the height of its tiles. `following` are the `followers` of the rows.
    """
    second, third = following & 2 != 0, following & 4 != 0
    ahead = [rows_ahead(rows, k, 0) for k in (1, 2)]
    own = jnp.where((following & 1 != 0)[:, None], rows, 0)
    next_one = jnp.where(second[:, None], ahead[0], 0)
    next_but_one = jnp.where(third[:, None], jnp.where(second[:, None], ahead[1], ahead[0]), 0)
    zero = jnp.zeros_like(own)
    by_offset = ((own, next_one, next_but_one), (zero, own, next_one), (zero, zero, own))
    every = jnp.concatenate([jnp.concatenate(window, 1) for window in by_offset])
    return in_halves(jnp.pad(every, ((0, 1), (0, 0))), 1)


def in_halves(values: Float[Array, "*n"], axis: int) -> Float[jax.Array, "*m"]:
    """The axis as two of half the size, an odd one after one more zero."""
    size = values.shape[axis]
    padding = [(0, 0)] * values.ndim
    padding[axis] = (0, size % 2)
    return jnp.pad(values, padding).reshape(*values.shape[:axis], 2, -(-size // 2), *values.shape[axis + 1 :])


def slots(runs: Int[Array, "J N"], absent: int) -> Int[Array, "N K"]:
    """The slot of each site of the runs, z slowest then column; `absent` where there is none."""
    slot, mask = runs >> 3, runs & 7
    below, each = jnp.zeros_like(slot), []
    for bit in range(DEPTH):
        here = (mask >> bit) & 1
        each.append(jnp.where(here != 0, slot + below, absent))
        below += here
    return jnp.concatenate(each).T
