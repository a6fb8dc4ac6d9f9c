"""Shortest paths through the product automaton, walked back from their targets along known distances."""

import functools

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32

from potlp_jax.errors import ProblemError
from potlp_jax.native import by_platform, target
from potlp_jax.planning.distances.bucket_search import wildcard_arrays
from potlp_jax.planning.distances.sweeping import Wildcard
from potlp_jax.planning.shapes import require_shapes
from potlp_jax.precision import whole_numbers
from potlp_jax.world.moves import LENGTHS, NEIGHBOURS, sides_free


@struct.dataclass(kw_only=True)
class KnownPath:
    """The beginning of a shortest path through known space.

    Attributes:
        cells, states: the product state after ``i`` moves, the source first; entries beyond ``length`` repeat the last
            one.
        length: moves held here, at most the horizon.
        cost: cost of the whole path to its target, ``inf`` (and ``length`` 0) where the target is out of reach.
    """

    cells: Int32[Array, "*batch horizon1 2"]
    states: Int32[Array, "*batch horizon1"]
    length: Int32[Array, "*batch"]
    cost: Float32[Array, "*batch"]


def shortest_path(
    distances: Float32[Array, "H W Z"],
    transitions: Int32[Array, "H W Z"],
    free: Bool[Array, "H W"],
    source_cell: Int32[Array, "2"],
    source_state: Int32[Array, ""],
    target_cell: Int32[Array, "2"],
    target_state: Int32[Array, ""],
    *,
    horizon: int,
    resolution: Float32[Array, ""],
    wildcard: Wildcard | None = None,
) -> KnownPath:
    """First moves of a shortest path, walked back from the target along known distances.

    Ties between predecessors break by the order of ``NEIGHBOURS``, then by the lowest state.

    Args:
        distances: costs from the source to every product state, as ``product_distances`` gives them.
        transitions: the product that they were solved in.
        free: True where there is no obstacle.
        source_cell, source_state: where the path begins.
        target_cell, target_state: where it ends.
        horizon: moves to keep, counted from the source; static.
        resolution: length of a cell's side in the unit of cost.
        wildcard: as in ``product_distances``.

    Returns:
        The path, padded to ``horizon + 1`` product states.

    Raises:
        ProblemError: an array has another shape, or cells or states are no whole numbers.
    """
    source_cell, target_cell = (
        whole_numbers(cell, name, ProblemError)
        for name, cell in (("source_cell", source_cell), ("target_cell", target_cell))
    )
    source_state, target_state = (
        whole_numbers(state, name, ProblemError)
        for name, state in (("source_state", source_state), ("target_state", target_state))
    )
    require_shapes(
        {
            "distances": (distances, transitions.shape),
            "free": (free, transitions.shape[:2]),
            "source_cell": (source_cell, (2,)),
            "source_state": (source_state, ()),
            "target_cell": (target_cell, (2,)),
            "target_state": (target_state, ()),
        },
        f"the product is {transitions.shape}",
    )
    # Not within the walk: a product that is added at once may be rounded only after the sum.
    steps = jnp.asarray(LENGTHS, jnp.float32) * resolution
    ends = (source_cell, source_state, target_cell, target_state)
    walks = (functools.partial(function, horizon=horizon) for function in (_walked_natively, _walked))
    return by_platform("paths", *walks, distances, transitions, free, *ends, steps, wildcard)


def _walked_natively(
    distances: Float32[Array, "H W Z"],
    transitions: Int32[Array, "H W Z"],
    free: Bool[Array, "H W"],
    source_cell: Int32[Array, "2"],
    source_state: Int32[Array, ""],
    target_cell: Int32[Array, "2"],
    target_state: Int32[Array, ""],
    steps: Float32[Array, "8"],
    wildcard: Wildcard | None,
    *,
    horizon: int,
) -> KnownPath:
    """In native code (``native/kernels/paths.cc``); ``steps`` are the lengths of moves in the unit of cost."""
    results = (
        jax.ShapeDtypeStruct((horizon + 1, 2), jnp.int32),
        jax.ShapeDtypeStruct((horizon + 1,), jnp.int32),
        jax.ShapeDtypeStruct((), jnp.int32),
        jax.ShapeDtypeStruct((), jnp.float32),
    )
    call = jax.ffi.ffi_call(target("shortest_path"), results, vmap_method="sequential")
    ends = (source_cell, source_state, target_cell, target_state)
    cells, states, length, cost = call(distances, transitions, free, *ends, steps, *wildcard_arrays(wildcard))
    return KnownPath(cells=cells, states=states, length=length, cost=cost)


def _walked(
    distances: Float32[Array, "H W Z"],
    transitions: Int32[Array, "H W Z"],
    free: Bool[Array, "H W"],
    source_cell: Int32[Array, "2"],
    source_state: Int32[Array, ""],
    target_cell: Int32[Array, "2"],
    target_state: Int32[Array, ""],
    steps: Float32[Array, "8"],
    wildcard: Wildcard | None,
    *,
    horizon: int,
) -> KnownPath:
    cost = distances[target_cell[0], target_cell[1], target_state]
    reachable = jnp.isfinite(cost)
    predecessor = _Predecessor(distances, transitions, free, steps, wildcard)
    ring = horizon + 1

    # Walking back begins at the far end, and how long the path is shows only at the source. A ring buffer of ``horizon
    # + 1`` entries keeps those written last, which are those nearest the source, in memory that the horizon bounds.
    def walk(carry):
        count, cell, state, cells, states = carry
        cell, state = predecessor(cell, state)
        count = count + 1
        entry = count % ring
        return count, cell, state, cells.at[entry].set(cell), states.at[entry].set(state)

    def unfinished(carry):
        _, cell, state, _, _ = carry
        return reachable & ~(jnp.all(cell == source_cell) & (state == source_state))

    cells = jnp.broadcast_to(jnp.where(reachable, target_cell, source_cell)[None, :], (ring, 2))
    states = jnp.broadcast_to(jnp.where(reachable, target_state, source_state)[None], (ring,))
    start = (jnp.int32(0), target_cell, target_state, cells, states)
    count, _, _, cells, states = jax.lax.while_loop(unfinished, walk, start)
    # The source was written last, at ``count``; the path's i-th product state i writes before it.
    length = jnp.minimum(count, horizon)
    order = (count - jnp.minimum(jnp.arange(ring, dtype=jnp.int32), length)) % ring
    return KnownPath(cells=cells[order], states=states[order], length=length, cost=cost)


class _Predecessor:
    """Finds the product state from which a shortest path enters a given one.

    It is the cheapest of all that lead there: costs are shortest, so no tolerance for rounding is needed, and the walk
    ends at the source because every step lowers the cost.
    """

    def __init__(
        self,
        distances: Float32[Array, "H W Z"],
        transitions: Int32[Array, "H W Z"],
        free: Bool[Array, "H W"],
        steps: Float32[Array, "8"],
        wildcard: Wildcard | None,
    ) -> None:
        margin = ((1, 1), (1, 1))
        self.distances = jnp.pad(distances, (*margin, (0, 0)), constant_values=jnp.inf)
        self.free = jnp.pad(free, margin, constant_values=False)
        self.transitions = transitions
        self.wildcard = wildcard
        self.offsets = jnp.asarray(NEIGHBOURS, jnp.int32)
        self.steps = steps

    def __call__(self, cell: Int32[Array, "2"], state: Int32[Array, ""]) -> tuple[Int32[Array, "2"], Int32[Array, ""]]:
        states = self.transitions.shape[2]
        # Entering the cell reads its letter, so the states before are those whose transition there is ``state``.
        leads = self.transitions[cell[0], cell[1]] == state
        if self.wildcard is not None:
            chosen = self.wildcard.successors[:, state] | (jnp.arange(states) == state)
            leads = leads | (self.wildcard.cells[cell[0], cell[1]] & chosen)
        neighbours = cell[None, :] + self.offsets + 1
        cost = self.distances[neighbours[:, 0], neighbours[:, 1]] + self.steps[:, None]
        cost = jnp.where(sides_free(self.free, cell)[:, None] & leads[None, :], cost, jnp.inf)
        # The first of equal minima: neighbours in their order, then states.
        best = jnp.argmin(cost.reshape(-1)).astype(jnp.int32)
        return neighbours[best // states] - 1, best % states
