"""Product distances between a few cells through the cells whose letters matter.

Most cells of a map carry a letter that changes no state. Distances over those cells alone do not depend on the state
of the automaton, so that one grid per key cell serves all states: keys are the sources and the **active** cells, whose
letter changes some state or forbids entering. What remains is a shortest path among active cells in the product, with
the grid distances as lengths. It pays where active cells are few; the number is limited by ``CAPACITY``.

Any shortest path of the product splits at the active cells that it enters: between two of them it runs over neutral
cells, in one state, so its length there is the grid distance. Hence the result is exact, not an approximation.

Dimensions: ``active`` are the active cells, ``keys`` the distinct sources and active cells from which grids are solved,
``ends`` the active cells followed by the targets.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32

from potlp_jax.task.relations import transitive_closure
from potlp_jax.types import NO_STATE

# Labels as points make 8 to 12 active cells, areas hundreds to thousands (docs/results/planner.md), so any limit
# between them separates the two; it bounds the arrays of this module.
CAPACITY: int = 64
"""Active cells at most; with more, sweeping the product is faster."""


@struct.dataclass(kw_only=True)
class ActiveCells:
    """Cells at which the state of the automaton can change, or which some states may not enter.

    Attributes:
        neutral: True on cells that keep every state that has moves at all.
        cells: the active cells in row-major order, then (0, 0).
        count: number of active cells; it may exceed the length of ``cells``, and then portals cannot be used.
    """

    neutral: Bool[Array, "H W"]
    cells: Int32[Array, "active 2"]
    count: Int32[Array, ""]


def find_active_cells(transitions: Int32[Array, "H W Z"]) -> ActiveCells:
    """The active cells of a product (``NO_STATE`` = no move)."""
    height, width, states = transitions.shape
    own = jnp.arange(states, dtype=jnp.int32)
    exists = transitions != NO_STATE
    # States without any move (accepting states, where the caller cut them; traps) have no say in what is neutral.
    moving = jnp.any(exists, axis=(0, 1))
    neutral = jnp.all((transitions == own[None, None, :]) | ~moving[None, None, :], axis=2) & jnp.any(moving)
    # Cells that no state may enter are obstacles to all and need no key.
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
    """Whether portals need fewer grids than sweeps: one per key, against one per source and state it can come to.

    Args:
        transitions: the product.
        active: its active cells.
        source_cells, source_states: the sources; those in ``NO_STATE`` do not count.

    Returns:
        True where ``table_by_portals`` may be used and is the cheaper method.
    """
    states = transitions.shape[2]
    own = jnp.arange(states, dtype=jnp.int32)
    # Which states follow on this map, by the letters that are there; one state at a time, so that no array is of size
    # height x width x states squared.
    follows = jax.lax.map(lambda state: jnp.any(transitions == state, axis=(0, 1)), own).T
    reached = transitive_closure(follows | jnp.eye(states, dtype=bool))
    # A state that nothing leaves needs no sweep of its own (see ``Sweeper.leads_on``).
    moving = jnp.any(follows, axis=1)
    grids_of_state = jnp.sum(reached & moving[None, :], axis=1)
    real = source_states != NO_STATE
    by_sweeps = jnp.sum(jnp.where(real, grids_of_state[source_states], 0))
    _, _, distinct = distinct_cells(source_cells, real, transitions.shape[1])
    return (active.count <= active.cells.shape[0]) & (active.count + distinct <= by_sweeps)


def distinct_cells(
    cells: Int32[Array, "Q 2"], real: Bool[Array, " Q"], width: int
) -> tuple[Int32[Array, "Q 2"], Int32[Array, " Q"], Int32[Array, ""]]:
    """The cells without repetitions.

    Args:
        cells: rows and columns.
        real: True on cells that count.
        width: columns of the grid.

    Returns:
        The real cells once each, in row-major order, in front; the index of each real cell among them, 0 for others;
        and their number.
    """
    # Cells that do not count sort behind all others and are dropped.
    key = jnp.where(real, cells[:, 0] * width + cells[:, 1], jnp.iinfo(jnp.int32).max)
    ordered = jnp.sort(key)
    first = jnp.concatenate([jnp.ones(1, bool), ordered[1:] != ordered[:-1]]) & (ordered != jnp.iinfo(jnp.int32).max)
    rank = jnp.cumsum(first, dtype=jnp.int32) - 1
    kept = jnp.zeros_like(key).at[jnp.where(first, rank, key.shape[0])].set(ordered, mode="drop")
    index = jnp.where(real, rank[jnp.searchsorted(ordered, key)], 0)
    return jnp.stack([kept // width, kept % width], axis=1), index, jnp.sum(first, dtype=jnp.int32)


def table_by_portals(
    transitions: Int32[Array, "H W Z"],
    accepting: Bool[Array, " Z"],
    active: ActiveCells,
    source_cells: Int32[Array, "Q 2"],
    source_states: Int32[Array, " Q"],
    target_cells: Int32[Array, "T 2"],
    arrivals: Callable[[Int32[Array, "keys 2"], Int32[Array, ""], Int32[Array, "ends 2"]], Float32[Array, "keys ends"]],
) -> tuple[Float32[Array, "Q T Z"], Float32[Array, " Q"]]:
    """Costs in cells as ``product.distance_table`` gives them, through the active cells.

    Args:
        transitions: the product.
        accepting: True on states in which the task is satisfied.
        active: the product's active cells; all of them must fit (``portals_pay``).
        source_cells, source_states: the sources; those in ``NO_STATE`` reach nothing.
        target_cells: rows and columns of the targets.
        arrivals: from keys, their number and ends, the costs of entering each end from each of the first keys over
            neutral cells; ``inf`` for other keys.

    Returns:
        Costs in cells by source, target and state; by source the cost of acceptance; ``inf`` where there is no path.
    """
    states, capacity = transitions.shape[2], active.cells.shape[0]
    real = source_states != NO_STATE
    starts, start_of, distinct = distinct_cells(source_cells, real, transitions.shape[1])
    ends = jnp.concatenate([active.cells, target_cells])
    exists = jnp.arange(capacity) < active.count
    # The active cells follow the distinct sources without a gap: grids are solved for several keys side by side.
    keys = jax.lax.dynamic_update_slice(jnp.pad(starts, ((0, capacity), (0, 0))), active.cells, (distinct, 0))
    lengths = arrivals(keys, distinct + active.count, ends)
    from_active = jax.lax.dynamic_slice_in_dim(lengths, distinct, capacity)
    # Entries of ``cells`` beyond their number are (0, 0), a cell like any other: nothing may begin or end there.
    usable = jnp.concatenate([exists, jnp.ones(target_cells.shape[0], bool)])
    from_active = jnp.where(exists[:, None] & usable[None, :], from_active, jnp.inf)
    entering = transitions[ends[:, 0], ends[:, 1]]
    # Real sources first: the loop runs over these alone.
    order = jnp.argsort(~real, stable=True)

    def solve(number: Array, table: tuple[Array, Array]) -> tuple[Array, Array]:
        source = order[number]
        from_start = jnp.where(usable, lengths[start_of[source]], jnp.inf)
        costs, finish = _costs_of_source(from_start, source_states[source], from_active, entering, accepting)
        # Arrivals are costs of entering, and a source that is its own target need not leave and come back.
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
    from_start: Float32[Array, " ends"],
    state: Int32[Array, ""],
    from_active: Float32[Array, "active ends"],
    entering: Int32[Array, "ends Z"],
    accepting: Bool[Array, " Z"],
) -> tuple[Float32[Array, "T Z"], Float32[Array, ""]]:
    """Costs from one source in ``state`` to the targets, which follow the active cells among the ends; to acceptance.

    ``from_start`` and ``from_active`` are the costs of entering each end over neutral cells.
    """
    capacity, states = from_active.shape[0], accepting.shape[0]
    own = jnp.arange(states, dtype=jnp.int32)
    # Until the first active cell is entered the state is that of the source.
    first = jnp.where(own[:, None] == state, from_start[None, :], jnp.inf)

    # Bellman and Ford on (state, active cell): as many rounds as the longest shortest path has active cells, on arrays
    # of at most Z x 64 x 64. It ends because lengths are positive.
    def relax(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        best, _ = carry
        arrived = jnp.min(best[:, :, None] + from_active[None, :, :capacity], axis=1)
        better = jnp.minimum(best, _enter(jnp.minimum(arrived, first[:, :capacity]), entering[:capacity]))
        return better, jnp.any(better < best)

    best = _enter(first[:, :capacity], entering[:capacity])
    best, _ = jax.lax.while_loop(lambda carry: carry[1], relax, (best, jnp.any(jnp.isfinite(best))))
    arrived = jnp.min(best[:, :, None] + from_active[None, :, capacity:], axis=1)
    travel = _enter(jnp.minimum(arrived, first[:, capacity:]), entering[capacity:])
    at_source = jnp.where(own == state, 0.0, jnp.inf)
    # A state changes at active cells only, so the first accepting product state of a path is the source or one of them.
    finish = jnp.min(jnp.where(accepting, jnp.minimum(jnp.min(best, axis=1), at_source), jnp.inf))
    return travel.T, finish


def _enter(arrived: Float32[Array, "Z ends"], entering: Int32[Array, "ends Z"]) -> Float32[Array, "Z ends"]:
    """Costs by state before entering become costs by state after; ``entering[n, z]`` is the state that follows."""
    # A loop over the few states instead of a scatter: on a CPU scatters are sequential.
    states = entering.shape[1]
    return jnp.stack([jnp.min(jnp.where(state == entering.T, arrived, jnp.inf), axis=0) for state in range(states)])
