"""Product distances by a search in native code (``native/kernels/distances.cc``), for ``product``, which has the twins.

Costs are what the twins give, bit for bit: the smallest float32 sums of moves, in the order of the path. Which sum is
smallest does not depend on how it was found, because adding a move and rounding keeps the order of two costs. What is
known early in a trial is a small part of the map, and a search touches nothing else.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float32, Int32

from potlp_jax.native import target
from potlp_jax.planning.distances.portals import CAPACITY
from potlp_jax.planning.distances.sweeping import Wildcard


def searched_distances(
    transitions: Int32[Array, "H W Z"],
    free: Bool[Array, "H W"],
    source_cells: Int32[Array, "Q 2"],
    source_states: Int32[Array, " Q"],
    resolution: Float32[Array, ""],
    wildcard: Wildcard | None,
) -> Float32[Array, "Q H W Z"]:
    """As ``product.product_distances``."""
    height, width, states = transitions.shape
    result = jax.ShapeDtypeStruct((source_states.shape[0], height, width, states), jnp.float32)
    call = jax.ffi.ffi_call(target("product_distances"), result, vmap_method="sequential")
    return call(transitions, free, source_cells, source_states, resolution, *wildcard_arrays(wildcard))


def wildcard_arrays(wildcard: Wildcard | None) -> tuple[Bool[Array, "H W"], Bool[Array, "Z Z"]]:
    """What kernels are given of a wildcard: its cells and successors, empty arrays where there is none."""
    if wildcard is None:
        nothing = jnp.zeros((0, 0), bool)
        return nothing, nothing
    return wildcard.cells, wildcard.successors


def searched_table(
    transitions: Int32[Array, "H W Z"],
    free: Bool[Array, "H W"],
    accepting: Bool[Array, " Z"],
    source_cells: Int32[Array, "Q 2"],
    source_states: Int32[Array, " Q"],
    target_cells: Int32[Array, "T 2"],
    resolution: Float32[Array, ""],
) -> tuple[Float32[Array, "Q T Z"], Float32[Array, " Q"]]:
    """As ``product.distance_table``."""
    sources, targets, states = source_states.shape[0], target_cells.shape[0], transitions.shape[2]
    results = (
        jax.ShapeDtypeStruct((sources, targets, states), jnp.float32),
        jax.ShapeDtypeStruct((sources,), jnp.float32),
    )
    call = jax.ffi.ffi_call(target("distance_table"), results, vmap_method="sequential")
    arrays = (transitions, free, accepting, source_cells, source_states, target_cells, resolution)
    travel, finish = call(*arrays, capacity=np.int64(CAPACITY))
    return travel, finish
