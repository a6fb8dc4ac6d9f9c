"""Product distances between a few cells by way of the cells whose letters matter.

Most cells of a map carry a letter that changes no state. Distances over those cells alone do not depend on the state
of the automaton, so that one grid per key cell serves all states: keys are the sources and the **active** cells, whose
letter changes some state or forbids entering. What remains is a shortest path among active cells in the product, with
the grid distances as lengths. It pays where active cells are few; the number is limited by ``CAPACITY``.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32

from potlp_jax.task.relations import transitive_closure
from potlp_jax.types import NO_STATE

CAPACITY: int = 64
"""Active cells at most; with more, sweeping the product is faster."""


@struct.dataclass(kw_only=True)
class ActiveCells:
    """Cells at which the state of the automaton can change, or which some states may not enter.

    ``neutral`` cells keep every state that has moves at all. The first ``count`` entries of ``cells`` are the active
    ones, in row-major order, and the others are (0, 0); ``count`` may exceed their number A: then portals cannot be
    used.
    """

    neutral: Bool[Array, "H W"]
    cells: Int32[Array, "A 2"]
    count: Int32[Array, ""]


def find_active_cells(transitions: Int32[Array, "H W Z"]) -> ActiveCells:
    """The active cells of a product (``NO_STATE`` = no move)."""
    height, width, states = transitions.shape
    own = jnp.arange(states, dtype=jnp.int32)
    exists = transitions != NO_STATE
    moving = jnp.any(exists, axis=(0, 1))
    neutral = jnp.all((transitions == own[None, None, :]) | ~moving[None, None, :], axis=2) & jnp.any(moving)
    active = ~neutral & jnp.any(exists, axis=2)
    (index,) = jnp.nonzero(active.reshape(-1), size=min(CAPACITY, height * width), fill_value=0)
    index = index.astype(jnp.int32)
    cells = jnp.stack([index // width, index % width], axis=1)
    return ActiveCells(neutral=neutral, cells=cells, count=jnp.sum(active, dtype=jnp.int32))


def portals_pay(
    transitions: Int32[Array, "H W Z"],
    active: ActiveCells,
    source_cells: Int32[Array, "Q 2"],
    source_states: Int32[Array, " Q"],
) -> Bool[Array, ""]:
    """Whether portals need fewer grids than sweeps: one per key, against one per source and state it can come to."""
    states = transitions.shape[2]
    own = jnp.arange(states, dtype=jnp.int32)
    follows = jax.lax.map(lambda state: jnp.any(transitions == state, axis=(0, 1)), own).T
    reached = transitive_closure(follows | jnp.eye(states, dtype=bool))
    moving = jnp.any(follows, axis=1)
    grids_of_state = jnp.sum(reached & moving[None, :], axis=1)
    real = source_states != NO_STATE
    by_sweeps = jnp.sum(jnp.where(real, grids_of_state[source_states], 0))
    _, _, distinct = distinct_cells(source_cells, real, transitions.shape[1])
    return (active.count <= active.cells.shape[0]) & (active.count + distinct <= by_sweeps)


def distinct_cells(
    cells: Int32[Array, "Q 2"], real: Bool[Array, " Q"], width: int
) -> tuple[Int32[Array, "Q 2"], Int32[Array, " Q"], Int32[Array, ""]]:
    """The real cells without repetitions, in front; where each real cell is among them; and their number."""
    key = jnp.where(real, cells[:, 0] * width + cells[:, 1], jnp.iinfo(jnp.int32).max)
    ordered = jnp.sort(key)
    first = jnp.concatenate([jnp.ones(1, bool), ordered[1:] != ordered[:-1]]) & (ordered != jnp.iinfo(jnp.int32).max)
    rank = jnp.cumsum(first, dtype=jnp.int32) - 1
    kept = jnp.zeros_like(key).at[jnp.where(first, rank, key.shape[0])].set(ordered, mode="drop")
    place = jnp.where(real, rank[jnp.searchsorted(ordered, key)], 0)
    return jnp.stack([kept // width, kept % width], axis=1), place, jnp.sum(first, dtype=jnp.int32)


def table_by_portals(
    transitions: Int32[Array, "H W Z"],
    accepting: Bool[Array, " Z"],
    active: ActiveCells,
    source_cells: Int32[Array, "Q 2"],
    source_states: Int32[Array, " Q"],
    target_cells: Int32[Array, "T 2"],
    arrivals: Callable[[Int32[Array, "K 2"], Int32[Array, ""], Int32[Array, "N 2"]], Float32[Array, "K N"]],
) -> tuple[Float32[Array, "Q T Z"], Float32[Array, " Q"]]:
    """Costs in cells as ``product.distance_table`` gives them, by way of the active cells.

    ``arrivals(keys, count, ends)`` gives for the first ``count`` keys the costs of entering each end, over neutral
    cells, and ``inf`` for the others.
    """
    states, capacity = transitions.shape[2], active.cells.shape[0]
    real = source_states != NO_STATE
    starts, place, distinct = distinct_cells(source_cells, real, transitions.shape[1])
    ends = jnp.concatenate([active.cells, target_cells])
    exists = jnp.arange(capacity) < active.count
    # The active cells follow the distinct sources at once, so that no lane of the sweeps stays empty between them.
    keys = jax.lax.dynamic_update_slice(jnp.pad(starts, ((0, capacity), (0, 0))), active.cells, (distinct, 0))
    lengths = arrivals(keys, distinct + active.count, ends)
    from_active = jax.lax.dynamic_slice_in_dim(lengths, distinct, capacity)
    usable = jnp.concatenate([exists, jnp.ones(target_cells.shape[0], bool)])
    from_active = jnp.where(exists[:, None] & usable[None, :], from_active, jnp.inf)
    entering = transitions[ends[:, 0], ends[:, 1]]
    order = jnp.argsort(~real, stable=True)

    def solve(number, table):
        source = order[number]
        from_start = jnp.where(usable, lengths[place[source]], jnp.inf)
        costs, finish = _costs_of_source(from_start, source_states[source], from_active, entering, accepting)
        here = jnp.all(target_cells == source_cells[source][None, :], axis=1)
        at_source = jnp.where(jnp.arange(states) == source_states[source], 0.0, jnp.inf)
        costs = jnp.where(here[:, None], jnp.minimum(costs, at_source[None, :]), costs)
        return table[0].at[source].set(costs), table[1].at[source].set(finish)

    nothing = (
        jnp.full((source_states.shape[0], target_cells.shape[0], states), jnp.inf, jnp.float32),
        jnp.full(source_states.shape, jnp.inf, jnp.float32),
    )
    return jax.lax.fori_loop(0, jnp.sum(real, dtype=jnp.int32), solve, nothing)


def _costs_of_source(
    from_start: Float32[Array, " N"],
    state: Int32[Array, ""],
    from_active: Float32[Array, "A N"],
    entering: Int32[Array, "N Z"],
    accepting: Bool[Array, " Z"],
) -> tuple[Float32[Array, "T Z"], Float32[Array, ""]]:
    """Costs from one source in ``state`` to the targets, which follow the active cells among the ends; to acceptance.

    ``from_start`` and ``from_active`` are the costs of entering each end over neutral cells.
    """
    capacity, states = from_active.shape[0], accepting.shape[0]
    own = jnp.arange(states, dtype=jnp.int32)
    first = jnp.where(own[:, None] == state, from_start[None, :], jnp.inf)

    def relax(carry):
        best, _ = carry
        arrived = jnp.min(best[:, :, None] + from_active[None, :, :capacity], axis=1)
        better = jnp.minimum(best, _enter(jnp.minimum(arrived, first[:, :capacity]), entering[:capacity]))
        return better, jnp.any(better < best)

    best = _enter(first[:, :capacity], entering[:capacity])
    best, _ = jax.lax.while_loop(lambda carry: carry[1], relax, (best, jnp.any(jnp.isfinite(best))))
    arrived = jnp.min(best[:, :, None] + from_active[None, :, capacity:], axis=1)
    travel = _enter(jnp.minimum(arrived, first[:, capacity:]), entering[capacity:])
    at_source = jnp.where(own == state, 0.0, jnp.inf)
    finish = jnp.min(jnp.where(accepting, jnp.minimum(jnp.min(best, axis=1), at_source), jnp.inf))
    return travel.T, finish


def _enter(arrived: Float32[Array, "Z N"], entering: Int32[Array, "N Z"]) -> Float32[Array, "Z N"]:
    """Costs by state before entering become costs by state after; ``entering[n, z]`` is the state that follows."""
    states = entering.shape[1]
    return jnp.stack([jnp.min(jnp.where(state == entering.T, arrived, jnp.inf), axis=0) for state in range(states)])
