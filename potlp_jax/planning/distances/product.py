"""Shortest distances and paths through the product of known space and the task automaton (docs/model.md section 2).

Product states are ``(cell, z)``. Grid moves are 8-connected, cost 1 and √2 times the resolution and never cut a corner:
a diagonal move needs both cells beside it free. Entering a cell in state ``z`` leads to ``transitions[cell, z]``.

On a CPU whole grids of distances are solved by a search in native code (``bucket_search``), elsewhere, and where there
is no compiler, by frontal sweeps (``sweeping``); both give the same bits. A table of costs between a few cells needs no
grid per state where few cells carry letters that matter (``portals``). What all this costs beside Dijkstra's algorithm
is in docs/results/planner.md.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Bool, Float32, Int32

from potlp_jax.errors import ProblemError
from potlp_jax.native import by_platform
from potlp_jax.planning.distances.bucket_search import searched_distances, searched_table
from potlp_jax.planning.distances.portals import find_active_cells, portals_pay, table_by_portals
from potlp_jax.planning.distances.sweeping import Links, Sweeper, Wildcard
from potlp_jax.planning.shapes import require_shapes
from potlp_jax.precision import in_32_bits, whole_numbers
from potlp_jax.task.relations import transitive_closure
from potlp_jax.task.task import TaskArrays
from potlp_jax.types import NO_STATE

SOURCES_AT_ONCE: int = 8
"""Sources solved side by side: enough to fill vector units, few enough for a layer of costs to stay in cache."""


@in_32_bits
def product_transitions(
    task: TaskArrays, letters: Int32[Array, "H W"], known_free: Bool[Array, "H W"]
) -> Int32[Array, "H W Z"]:
    """State of the automaton after entering each cell from each state.

    Args:
        task: arrays of one task.
        letters: the letter of each cell.
        known_free: True on cells that may be entered.

    Returns:
        The next state; ``NO_STATE`` where the cell may not be entered or its letter leads to a trap: such moves do not
        exist in the product (docs/model.md section 2).
    """
    following = jnp.moveaxis(task.transitions[:, letters], 0, -1)
    allowed = known_free[:, :, None] & ~task.trap[following] & task.state_mask[None, None, :]
    return jnp.where(allowed, following, NO_STATE)


def one_letter_successors(task: TaskArrays) -> Bool[Array, "Z Z"]:
    """Which states follow which by some letter, traps excluded; every live state also keeps itself."""
    states = task.transitions.shape[0]
    # Every letter counts, also one that no cell of this map has: the optimistic policy lets unknown cells hold any.
    reached = jnp.any(task.transitions[:, :, None] == jnp.arange(states)[None, None, :], axis=1)
    live = task.state_mask & ~task.trap
    return (reached | jnp.eye(states, dtype=bool)) & live[None, :] & live[:, None]


def reachable_states(task: TaskArrays, state: Int32[Array, ""]) -> Bool[Array, " Z"]:
    """The states that some word leads to from ``state``, itself among them; traps excluded."""
    return transitive_closure(one_letter_successors(task))[state]


@in_32_bits
def product_distances(
    transitions: Int32[Array, "H W Z"],
    free: Bool[Array, "H W"],
    source_cells: Int32[Array, "Q 2"],
    source_states: Int32[Array, " Q"],
    resolution: Float32[Array, ""],
    wildcard: Wildcard | None = None,
) -> Float32[Array, "Q H W Z"]:
    """Shortest cost from each source to every cell in every state.

    Args:
        transitions: state after entering each cell from each state, as ``product_transitions`` gives it.
        free: True where there is no obstacle. It decides about cutting corners only.
        source_cells: rows and columns of the sources.
        source_states: states at the sources, their cells' letters read; a source in ``NO_STATE`` reaches nothing.
        resolution: length of a cell's side in the unit of cost.
        wildcard: cells whose letter may be any (the optimistic policy's unknown cells); default: none.

    Returns:
        Costs by source, cell and state; ``inf`` where there is no path.

    Raises:
        ProblemError: an array has another shape, or cells or states are no whole numbers.
    """
    source_cells, source_states = _checked_sources(source_cells, source_states)
    _require_map(free, transitions.shape[:2])
    if wildcard is not None:
        _require_wildcard(wildcard, transitions.shape)
    # As plain arrays: vmap puts marks in their place, which are none.
    letters = None if wildcard is None else (wildcard.cells, wildcard.successors)
    return _product_distances(transitions, free, source_cells, source_states, jnp.asarray(resolution), letters)


# Under vmap the maps are solved one after the other: a batched loop goes on until its slowest row is done, and works on
# arrays that no cache holds.
@sequential_vmap
def _product_distances(
    transitions: Int32[Array, "H W Z"],
    free: Bool[Array, "H W"],
    source_cells: Int32[Array, "Q 2"],
    source_states: Int32[Array, " Q"],
    resolution: Float32[Array, ""],
    letters: tuple[Bool[Array, "H W"], Bool[Array, "Z Z"]] | None,
) -> Float32[Array, "Q H W Z"]:
    wildcard = None if letters is None else Wildcard(cells=letters[0], successors=letters[1])
    arrays = (transitions, free, source_cells, source_states, resolution, wildcard)
    return by_platform("distances", searched_distances, _swept_distances, *arrays)


def _swept_distances(
    transitions: Int32[Array, "H W Z"],
    free: Bool[Array, "H W"],
    source_cells: Int32[Array, "Q 2"],
    source_states: Int32[Array, " Q"],
    resolution: Float32[Array, ""],
    wildcard: Wildcard | None,
) -> Float32[Array, "Q H W Z"]:
    sweeper = Sweeper(_layers_first(transitions), free, wildcard)
    solved = _map_sources(sweeper.solve, source_cells, source_states)
    return jnp.transpose(solved, (3, 1, 2, 0)) * resolution


def distance_table(
    transitions: Int32[Array, "H W Z"],
    free: Bool[Array, "H W"],
    accepting: Bool[Array, " Z"],
    source_cells: Int32[Array, "Q 2"],
    source_states: Int32[Array, " Q"],
    target_cells: Int32[Array, "T 2"],
    resolution: Float32[Array, ""],
) -> tuple[Float32[Array, "Q T Z"], Float32[Array, " Q"]]:
    """Costs from each source to each target, and to acceptance anywhere.

    The same distances as ``product_distances``, up to rounding, without its grids. Where few cells carry letters that
    matter, they are found through those cells (``portals``), elsewhere by sweeps.

    Args:
        transitions: state after entering each cell from each state, as ``product_transitions`` gives it.
        free: True where there is no obstacle. It decides about cutting corners only.
        accepting: True on states in which the task is satisfied.
        source_cells: rows and columns of the sources.
        source_states: states at the sources, their cells' letters read; a source in ``NO_STATE`` reaches nothing.
        target_cells: rows and columns of the targets.
        resolution: length of a cell's side in the unit of cost.

    Returns:
        Costs by source, target and state at the target, and by source the cost of the nearest accepting product state;
        ``inf`` where there is no path.

    Raises:
        ProblemError: an array has another shape, or cells or states are no whole numbers.
    """
    source_cells, source_states = _checked_sources(source_cells, source_states)
    target_cells = whole_numbers(target_cells, "target_cells", ProblemError)
    states = transitions.shape[2]
    _require_map(free, transitions.shape[:2])
    require_shapes({"target_cells": (target_cells, (*target_cells.shape[:1], 2)), "accepting": (accepting, (states,))})
    return _distance_table(
        transitions, free, accepting, source_cells, source_states, target_cells, jnp.asarray(resolution)
    )


@sequential_vmap
def _distance_table(
    transitions: Int32[Array, "H W Z"],
    free: Bool[Array, "H W"],
    accepting: Bool[Array, " Z"],
    source_cells: Int32[Array, "Q 2"],
    source_states: Int32[Array, " Q"],
    target_cells: Int32[Array, "T 2"],
    resolution: Float32[Array, ""],
) -> tuple[Float32[Array, "Q T Z"], Float32[Array, " Q"]]:
    arrays = (transitions, free, accepting, source_cells, source_states, target_cells, resolution)
    return by_platform("distances", searched_table, _swept_table, *arrays)


def _swept_table(
    transitions: Int32[Array, "H W Z"],
    free: Bool[Array, "H W"],
    accepting: Bool[Array, " Z"],
    source_cells: Int32[Array, "Q 2"],
    source_states: Int32[Array, " Q"],
    target_cells: Int32[Array, "T 2"],
    resolution: Float32[Array, ""],
) -> tuple[Float32[Array, "Q T Z"], Float32[Array, " Q"]]:
    active = find_active_cells(transitions)

    def by_portals():
        arrivals = functools.partial(_neutral_arrivals, active.neutral, free)
        return table_by_portals(transitions, accepting, active, source_cells, source_states, target_cells, arrivals)

    def by_sweeps():
        return _table_by_sweeps(transitions, free, accepting, source_cells, source_states, target_cells)

    # Decided on the device, because which cells are active depends on what has been observed. Outside of vmap ``cond``
    # runs one branch only, and ``sequential_vmap`` keeps it so.
    pays = portals_pay(transitions, active, source_cells, source_states)
    travel, finish = jax.lax.cond(pays, by_portals, by_sweeps)
    return travel * resolution, finish * resolution


def _table_by_sweeps(
    transitions: Int32[Array, "H W Z"],
    free: Bool[Array, "H W"],
    accepting: Bool[Array, " Z"],
    source_cells: Int32[Array, "Q 2"],
    source_states: Int32[Array, " Q"],
    target_cells: Int32[Array, "T 2"],
) -> tuple[Float32[Array, "Q T Z"], Float32[Array, " Q"]]:
    """``distance_table`` in cells, from the grids of all sources."""
    sweeper = Sweeper(_layers_first(transitions), free, None)
    rows, columns = target_cells[:, 0], target_cells[:, 1]

    # Each group of sources is reduced to its entries of the table at once: the grids of all would not fit the cache.
    def solve(cells: Int32[Array, "Q 2"], states: Int32[Array, " Q"]) -> Float32[Array, "N Q"]:
        cost = sweeper.solve(cells, states)
        finish = jnp.min(jnp.where(accepting[:, None, None, None], cost, jnp.inf), axis=(0, 1, 2))
        return jnp.concatenate([cost[:, rows, columns].reshape(-1, cells.shape[0]), finish[None]])

    table = _map_sources(solve, source_cells, source_states).T
    travel = table[:, :-1].reshape(-1, transitions.shape[2], target_cells.shape[0])
    return jnp.swapaxes(travel, 1, 2), table[:, -1]


def _neutral_arrivals(
    neutral: Bool[Array, "H W"],
    free: Bool[Array, "H W"],
    keys: Int32[Array, "keys 2"],
    count: Int32[Array, ""],
    ends: Int32[Array, "ends 2"],
) -> Float32[Array, "keys ends"]:
    """Cost in cells of entering each end from each of the first ``count`` keys over neutral cells; others ``inf``."""
    # Neutral cells keep every state, so one automaton state stands for all.
    sweeper = Sweeper(jnp.where(neutral, 0, NO_STATE)[None, :, :, None], free, None)
    size = min(SOURCES_AT_ONCE, keys.shape[0])
    padded = jnp.pad(keys, ((0, -keys.shape[0] % size), (0, 0)))
    states = jnp.where(jnp.arange(padded.shape[0]) < count, 0, NO_STATE).astype(jnp.int32)

    def solve_chunk(chunk: Array, arrivals: Array) -> Array:
        first = chunk * size
        cells = jax.lax.dynamic_slice_in_dim(padded, first, size)
        grid = sweeper.solve(cells, jax.lax.dynamic_slice_in_dim(states, first, size))[0]
        # An end need not be neutral itself: what is wanted is the cost of standing beside it and moving in.
        return jax.lax.dynamic_update_slice(arrivals, sweeper.links.arrival_at(grid, ends).T, (first, 0))

    start = jnp.full((padded.shape[0], ends.shape[0]), jnp.inf, jnp.float32)
    return jax.lax.fori_loop(0, -(-count // size), solve_chunk, start)[: keys.shape[0]]


def distances_per_source(
    transitions: Int32[Array, "Z H W Q"],
    free: Bool[Array, "H W"],
    source_cells: Int32[Array, "Q 2"],
    source_states: Int32[Array, " Q"],
    resolution: Float32[Array, ""],
) -> Float32[Array, "Z H W Q"]:
    """As ``product_distances``, with transitions of its own for every source and the sources in the minor axis.

    Args:
        transitions: by state, cell and source, the state after entering the cell.
        free: True where there is no obstacle. It decides about cutting corners only.
        source_cells: rows and columns of the sources.
        source_states: states at the sources; a source in ``NO_STATE`` reaches nothing.
        resolution: length of a cell's side in the unit of cost.

    Returns:
        Costs by state, cell and source; ``inf`` where there is no path.

    Raises:
        ProblemError: an array has another shape, or cells or states are no whole numbers.
    """
    source_cells, source_states = _checked_sources(source_cells, source_states)
    _require_map(free, transitions.shape[1:3])
    return _distances_per_source(transitions, free, source_cells, source_states, jnp.asarray(resolution))


@sequential_vmap
def _distances_per_source(
    transitions: Int32[Array, "Z H W Q"],
    free: Bool[Array, "H W"],
    source_cells: Int32[Array, "Q 2"],
    source_states: Int32[Array, " Q"],
    resolution: Float32[Array, ""],
) -> Float32[Array, "Z H W Q"]:
    return Sweeper(transitions, free, None).solve(source_cells, source_states) * resolution


def arrivals_per_source(
    costs: Float32[Array, "Z H W Q"], free: Bool[Array, "H W"], resolution: Float32[Array, ""]
) -> Float32[Array, "Z H W Q"]:
    """Cost of arriving in each cell by one move from the best neighbour, per state there, letters ignored.

    Args:
        costs: costs by state, cell and source, as ``distances_per_source`` gives them.
        free: True where there is no obstacle.
        resolution: length of a cell's side in the unit of cost.

    Returns:
        Costs of the same shape; ``inf`` where no neighbour has been reached.
    """
    links = Links(free)
    return jax.vmap(lambda layer: links.cheapest_arrival(layer / resolution) * resolution)(costs)


def grid_distances(
    free: Bool[Array, "H W"], cell: Int32[Array, "2"], resolution: Float32[Array, ""]
) -> Float32[Array, "H W"]:
    """Shortest cost from a cell to every free cell, letters ignored.

    Args:
        free: True on cells that may be entered.
        cell: row and column of the source.
        resolution: length of a cell's side in the unit of cost.

    Returns:
        Costs; ``inf`` where unreachable.

    Raises:
        ProblemError: the cell is none.
    """
    require_shapes({"cell": (cell, (2,))})
    # A product with one state that every free cell keeps.
    transitions = jnp.where(free, 0, NO_STATE)[:, :, None]
    source = jnp.zeros((1,), jnp.int32)
    return product_distances(transitions, free, cell[None, :], source, resolution)[0, :, :, 0]


def reachable_cells(
    free: Bool[Array, "H W"], cell: Int32[Array, "2"], within: Bool[Array, "H W"]
) -> Bool[Array, "H W"]:
    """Free cells that can be reached from a cell, letters ignored.

    Where no move leads out of ``within``, as where no letter forbids entering a cell, nothing is solved.

    Args:
        free: True on cells that may be entered.
        cell: row and column of the source.
        within: True on cells that are known to be reachable, such as those with a finite product distance.

    Returns:
        True on the cells that can be reached, the source among them.

    Raises:
        ProblemError: an array has another shape.
    """
    require_shapes({"cell": (cell, (2,)), "within": (within, free.shape)})
    within = within.at[cell[0], cell[1]].set(True)
    costs = jnp.where(within, 0.0, jnp.inf).astype(jnp.float32)[:, :, None]
    leads_out = free & ~within & jnp.isfinite(Links(free).cheapest_arrival(costs)[:, :, 0])
    return jax.lax.cond(
        jnp.any(leads_out), lambda: jnp.isfinite(grid_distances(free, cell, jnp.float32(1.0))), lambda: within
    )


def _checked_sources(cells: Array, states: Array) -> tuple[Int32[Array, "Q 2"], Int32[Array, " Q"]]:
    """Sources as the kernels take them: they read as many cells as there are states."""
    cells = whole_numbers(cells, "source_cells", ProblemError)
    states = whole_numbers(states, "source_states", ProblemError)
    require_shapes({"source_states": (states, (states.size,)), "source_cells": (cells, (states.size, 2))})
    return cells, states


def _require_wildcard(wildcard: Wildcard, shape: tuple[int, ...]) -> None:
    expected = {
        "wildcard.cells": (wildcard.cells, shape[:2]),
        "wildcard.successors": (wildcard.successors, (shape[2], shape[2])),
    }
    require_shapes(expected, f"the product is {shape}")


def _require_map(free: Array, shape: tuple[int, ...]) -> None:
    require_shapes({"free": (free, shape)}, f"the transitions are of a map of {shape} cells")


def _layers_first(transitions: Int32[Array, "H W Z"]) -> Int32[Array, "Z H W 1"]:
    """The layout of the sweeps: one layer per state, shared by all sources."""
    return jnp.moveaxis(transitions, -1, 0)[..., None]


def _map_sources(
    solve: Callable[[Int32[Array, "Q 2"], Int32[Array, " Q"]], Array],
    cells: Int32[Array, "Q 2"],
    states: Int32[Array, " Q"],
) -> Array:
    """Apply ``solve`` to ``SOURCES_AT_ONCE`` sources at a time; results carry the sources in the last axis.

    Real sources are gathered in front, so that empty ones cost nothing: they reach nothing, ``inf``.
    """
    count = cells.shape[0]
    size = min(SOURCES_AT_ONCE, count)
    if count == size:
        return solve(cells, states)
    missing = -count % size
    # Stable, and undone at the end by its inverse: results are in the order of the sources.
    order = jnp.argsort(states == NO_STATE, stable=True)
    back = jnp.argsort(order)
    cells = jnp.pad(cells[order], ((0, missing), (0, 0)))
    states = jnp.pad(states[order], (0, missing), constant_values=NO_STATE)
    real = jnp.sum(states != NO_STATE, dtype=jnp.int32)

    def solve_chunk(chunk: Array, solved: Array) -> Array:
        first = chunk * size
        part = solve(
            jax.lax.dynamic_slice_in_dim(cells, first, size), jax.lax.dynamic_slice_in_dim(states, first, size)
        )
        return jax.lax.dynamic_update_slice_in_dim(solved, part, first, axis=solved.ndim - 1)

    # Chunks without a real source are not solved; their part of the result stays as it was filled.
    one = jax.eval_shape(solve, cells[:size], states[:size])
    unreached = jnp.full((*one.shape[:-1], count + missing), jnp.inf, jnp.float32)
    return jax.lax.fori_loop(0, -(-real // size), solve_chunk, unreached)[..., back]
