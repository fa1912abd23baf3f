"""The two backends of the sparse convolutions: "gather" computes active sites only, "dense" is the definition."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from ciassd_jax.model.layers import Convolution
from ciassd_jax.ops import sites as site_ops
from ciassd_jax.ops import sparse, sparse_dense
from ciassd_jax.ops.platform import Program
from ciassd_jax.ops.sites import Triple, Window
from ciassd_jax.types import NeighbourTable, Sites


class Backend(NamedTuple):
    """Three functions of the sites of a batch of scenes.

    `submanifold(sites, shape)` gives the 3 x 3 x 3 convolution whose output sites are its input sites.
    `strided(sites, window, capacity)` gives the output sites, the convolution onto them, and the number of sites over
    capacity of each scene. `to_dense(features [B, V, C], sites, shape)` gives features on the grid [B, Y, X, Z, C].
    """

    submanifold: Callable[[Sites, Triple], Convolution]
    strided: Callable[[Sites, Window, int], tuple[Sites, Convolution, Int[Array, " B"]]]
    to_dense: Callable[[Array, Sites, Triple], Array]


def _gather_submanifold(sites: Sites, shape: Triple, *, program: Program) -> Convolution:
    return _through(jax.vmap(partial(sparse.submanifold_table, shape=shape, program=program))(sites), program)


def _gather_strided(
    sites: Sites, window: Window, capacity: int, *, program: Program
) -> tuple[Sites, Convolution, Int[Array, " B"]]:
    geometry: dict[str, Any] = window._asdict()
    out_sites, dropped = jax.vmap(lambda one: site_ops.strided_sites(one, capacity=capacity, **geometry))(sites)
    tables = jax.vmap(lambda one, out: sparse.strided_table(one, out, program=program, **geometry))(sites, out_sites)
    return out_sites, _through(tables, program), jnp.asarray(dropped)


def _through(tables: NeighbourTable, program: Program) -> Convolution:
    """The convolution through the tables of a batch."""
    table = sparse.flatten_scenes(tables)
    return lambda features, kernel: jnp.asarray(sparse.convolve(features, table, kernel, program))


def _gather_to_dense(features: Array, sites: Sites, shape: Triple) -> Array:
    return jnp.asarray(jax.vmap(partial(site_ops.to_dense, shape=shape))(features, sites))


def _dense_submanifold(sites: Sites, shape: Triple) -> Convolution:
    return _on_grids(sites, sites, Window(shape, shape, (3, 3, 3), (1, 1, 1), (1, 1, 1)))


def _dense_strided(sites: Sites, window: Window, capacity: int) -> tuple[Sites, Convolution, Int[Array, " B"]]:
    geometry: dict[str, Any] = window._asdict()
    out_sites, dropped = jax.vmap(lambda one: sparse_dense.strided_sites(one, capacity=capacity, **geometry))(sites)
    return out_sites, _on_grids(sites, out_sites, window), jnp.asarray(dropped)


def _on_grids(sites: Sites, out_sites: Sites, window: Window) -> Convolution:
    """The convolution of each scene's dense grid."""

    def convolution(features: Array, kernel: Array) -> Array:
        def one(features: Array, sites: Sites, out_sites: Sites) -> Array:
            return jnp.asarray(
                sparse_dense.convolve(
                    features,
                    sites,
                    out_sites,
                    kernel,
                    shape=window.shape,
                    out_shape=window.out_shape,
                    kernel_size=window.kernel,
                    stride=window.stride,
                    padding=window.padding,
                )
            )

        scenes = features.reshape(*sites.keys.shape, -1)
        return jax.vmap(one)(scenes, sites, out_sites).reshape(-1, kernel.shape[-1])

    return convolution


def _dense_to_dense(features: Array, sites: Sites, shape: Triple) -> Array:
    grid = jnp.asarray(jax.vmap(partial(sparse_dense.to_dense, shape=shape))(features, sites))
    return grid.transpose(0, 2, 3, 1, 4)


def make_backend(kind: Literal["gather", "dense"], program: Program = "auto") -> Backend:
    """Return the backend of `config.backbone.backend`, in the form of `config.program`."""
    if kind == "dense":
        return Backend(_dense_submanifold, _dense_strided, _dense_to_dense)
    strided, submanifold = partial(_gather_strided, program=program), partial(_gather_submanifold, program=program)
    return Backend(submanifold, strided, _gather_to_dense)
