"""Sparse 3D convolution by its definition: a dense grid and a mask.

The oracle of `sites.py` and `sparse.py`, and a backend for small grids.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int

from ciassd_jax.ops.sites import NO_SITE, Triple, linear_keys
from ciassd_jax.types import Array, Sites


def strided_sites(
    sites: Sites,
    *,
    shape: Triple,
    out_shape: Triple,
    kernel: Triple,
    stride: Triple,
    padding: Triple,
    capacity: int,
) -> tuple[Sites, Int[Array, ""]]:
    """Return the sites of a strided convolution, every output whose window holds an active input, and the overflow."""
    mask = to_dense((sites.keys != NO_SITE).astype(jnp.float32)[:, None], sites, shape=shape)[..., 0]
    pads = [(p, p) for p in padding]
    active = lax.reduce_window(mask, np.float32(0), lax.max, kernel, stride, pads) > 0
    # Ascending keys: y slowest, then x, then z.
    y, x, z = jnp.nonzero(active.transpose(1, 2, 0), size=capacity, fill_value=-1)
    keys = linear_keys(jnp.stack([z, y, x], -1).astype(jnp.int32), out_shape)
    found = active.sum(dtype=jnp.int32)
    return Sites(jnp.where(y < 0, NO_SITE, keys), jnp.minimum(found, capacity)), jnp.maximum(found - capacity, 0)


def convolve(
    features: Float[Array, "U C"],
    sites: Sites,
    out_sites: Sites,
    kernel: Float[Array, "K C O"],
    *,
    shape: Triple,
    out_shape: Triple,
    kernel_size: Triple,
    stride: Triple,
    padding: Triple,
) -> Float[Array, "V O"]:
    """Dense cross-correlation of the scattered features, read at the output sites; padding rows are zero."""
    real = (sites.keys != NO_SITE)[:, None]
    grid = to_dense(jnp.where(real, features, 0), sites, shape=shape)
    dense = lax.conv_general_dilated(
        jnp.asarray(grid)[None],
        jnp.asarray(kernel).reshape(*kernel_size, *kernel.shape[1:]),
        stride,
        [(p, p) for p in padding],
        dimension_numbers=("NDHWC", "DHWIO", "NDHWC"),
        precision=lax.Precision.HIGHEST,
    )[0]
    by_key = dense.transpose(1, 2, 0, 3).reshape(-1, dense.shape[-1])
    real = out_sites.keys != NO_SITE
    return jnp.where(real[:, None], by_key[jnp.where(real, out_sites.keys, 0)], 0)


def to_dense(features: Float[Array, "V C"], sites: Sites, *, shape: Triple) -> Float[Array, "Z Y X C"]:
    """Scatter the sites' features to the whole grid (z, y, x), zero where no site is active."""
    depth, height, width = shape
    cells = depth * height * width
    # Padding slots write to distinct places out of bounds and are dropped.
    place = jnp.where(sites.keys == NO_SITE, cells + jnp.arange(sites.keys.shape[0], dtype=jnp.int32), sites.keys)
    flat = jnp.zeros((cells, features.shape[-1]), features.dtype)
    flat = flat.at[place].set(features, mode="drop", unique_indices=True, indices_are_sorted=True)
    return flat.reshape(height, width, depth, -1).transpose(2, 0, 1, 3)
