"""Shortest distances and paths through the product of known space and the task automaton (docs/model.md section 2).

Product states are ``(cell, z)``. Grid moves are 8-connected, cost 1 and √2 times the resolution and never cut a corner:
a diagonal move needs both cells beside it free. Entering a cell in state ``z`` leads to ``transitions[cell, z]``.

Distances are solved by frontal ``sweeps``. A table of costs between a few cells needs no sweep per state where few
cells carry letters that matter: see ``portals``.
"""

import functools

import jax
import jax.numpy as jnp
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Bool, Float32, Int32

from potlp_jax.planning.distances.portals import find_active_cells, portals_pay, table_by_portals
from potlp_jax.planning.distances.sweeping import Links, Sweeper, Wildcard
from potlp_jax.task.relations import transitive_closure
from potlp_jax.task.task import TaskArrays
from potlp_jax.types import NO_STATE

LANES: int = 8
"""Sources solved at a time: enough to fill vector units, few enough for a layer of costs to stay in cache."""


def product_transitions(
    task: TaskArrays, letters: Int32[Array, "H W"], known_free: Bool[Array, "H W"]
) -> Int32[Array, "H W Z"]:
    """State of the automaton after entering each cell from each state.

    ``NO_STATE`` where the cell is not ``known_free`` (True = may be entered) or the letter leads to a trap state:
    such moves do not exist in the product (docs/model.md section 2).
    """
    following = jnp.moveaxis(task.transitions[:, letters], 0, -1)
    allowed = known_free[:, :, None] & ~task.trap[following] & task.state_mask[None, None, :]
    return jnp.where(allowed, following, NO_STATE)


def one_letter_successors(task: TaskArrays) -> Bool[Array, "Z Z"]:
    """Which states follow which by some letter, traps excluded; every live state also keeps itself."""
    states = task.transitions.shape[0]
    reached = jnp.any(task.transitions[:, :, None] == jnp.arange(states)[None, None, :], axis=1)
    live = task.state_mask & ~task.trap
    return (reached | jnp.eye(states, dtype=bool)) & live[None, :] & live[:, None]


def reachable_states(task: TaskArrays, state: Int32[Array, ""]) -> Bool[Array, " Z"]:
    """The states that some word leads to from ``state``, itself among them; traps excluded."""
    return transitive_closure(one_letter_successors(task))[state]


def product_distances(
    transitions: Int32[Array, "H W Z"],
    free: Bool[Array, "H W"],
    source_cells: Int32[Array, "Q 2"],
    source_states: Int32[Array, " Q"],
    resolution: Float32[Array, ""],
    wildcard: Wildcard | None = None,
) -> Float32[Array, "Q H W Z"]:
    """Shortest cost from each source ``(cell, state)`` to every cell in every state, ``inf`` where there is no path.

    The source's own letter counts as read. ``free`` (True = no obstacle) decides about cutting corners only; what may
    be entered is in ``transitions``. A source whose state is ``NO_STATE`` reaches nothing.
    """
    return _product_distances(transitions, free, source_cells, source_states, jnp.asarray(resolution), wildcard)


# Under vmap the maps are solved one after the other: a batched loop goes on until its slowest row is done, and works on
# arrays that no cache holds.
@sequential_vmap
def _product_distances(transitions, free, source_cells, source_states, resolution, wildcard):
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
    """Costs from each source to each target cell in each state, and to acceptance anywhere; ``inf`` unreachable.

    The same distances as ``product_distances``, up to rounding, without its grids. Where few cells carry letters that
    matter, they are found by way of those cells (``portals``), elsewhere by sweeps.
    """
    return _distance_table(
        transitions, free, accepting, source_cells, source_states, target_cells, jnp.asarray(resolution)
    )


@sequential_vmap
def _distance_table(transitions, free, accepting, source_cells, source_states, target_cells, resolution):
    active = find_active_cells(transitions)

    def by_portals():
        arrivals = functools.partial(_neutral_arrivals, active.neutral, free)
        return table_by_portals(transitions, accepting, active, source_cells, source_states, target_cells, arrivals)

    def by_sweeps():
        return _table_by_sweeps(transitions, free, accepting, source_cells, source_states, target_cells)

    pays = portals_pay(transitions, active, source_cells, source_states)
    travel, finish = jax.lax.cond(pays, by_portals, by_sweeps)
    return travel * resolution, finish * resolution


def _table_by_sweeps(transitions, free, accepting, source_cells, source_states, target_cells):
    """``distance_table`` in cells, from the grids of all sources."""
    sweeper = Sweeper(_layers_first(transitions), free, None)
    rows, columns = target_cells[:, 0], target_cells[:, 1]

    def solve(cells, states):
        cost = sweeper.solve(cells, states)
        finish = jnp.min(jnp.where(accepting[:, None, None, None], cost, jnp.inf), axis=(0, 1, 2))
        return jnp.concatenate([cost[:, rows, columns].reshape(-1, cells.shape[0]), finish[None]])

    table = _map_sources(solve, source_cells, source_states).T
    travel = table[:, :-1].reshape(-1, transitions.shape[2], target_cells.shape[0])
    return jnp.swapaxes(travel, 1, 2), table[:, -1]


def _neutral_arrivals(
    neutral: Bool[Array, "H W"],
    free: Bool[Array, "H W"],
    keys: Int32[Array, "K 2"],
    count: Int32[Array, ""],
    ends: Int32[Array, "N 2"],
) -> Float32[Array, "K N"]:
    """Cost in cells of entering each end from each of the first ``count`` keys over ``neutral`` cells, else ``inf``."""
    sweeper = Sweeper(jnp.where(neutral, 0, NO_STATE)[None, :, :, None], free, None)
    lanes = min(LANES, keys.shape[0])
    padded = jnp.pad(keys, ((0, -keys.shape[0] % lanes), (0, 0)))
    states = jnp.where(jnp.arange(padded.shape[0]) < count, 0, NO_STATE).astype(jnp.int32)

    def solve(chunk, arrivals):
        first = chunk * lanes
        cells = jax.lax.dynamic_slice_in_dim(padded, first, lanes)
        grid = sweeper.solve(cells, jax.lax.dynamic_slice_in_dim(states, first, lanes))[0]
        return jax.lax.dynamic_update_slice(arrivals, sweeper.links.arrival_at(grid, ends).T, (first, 0))

    start = jnp.full((padded.shape[0], ends.shape[0]), jnp.inf, jnp.float32)
    return jax.lax.fori_loop(0, -(-count // lanes), solve, start)[: keys.shape[0]]


def distances_by_lane(
    transitions: Int32[Array, "Z H W Q"],
    free: Bool[Array, "H W"],
    source_cells: Int32[Array, "Q 2"],
    source_states: Int32[Array, " Q"],
    resolution: Float32[Array, ""],
) -> Float32[Array, "Z H W Q"]:
    """As ``product_distances``, with transitions of its own for every source and the sources in the minor axis."""
    return _distances_by_lane(transitions, free, source_cells, source_states, jnp.asarray(resolution))


@sequential_vmap
def _distances_by_lane(transitions, free, source_cells, source_states, resolution):
    return Sweeper(transitions, free, None).solve(source_cells, source_states) * resolution


def arrivals_by_lane(
    costs: Float32[Array, "Z H W Q"], free: Bool[Array, "H W"], resolution: Float32[Array, ""]
) -> Float32[Array, "Z H W Q"]:
    """Cost of arriving in each cell by one move from the best neighbour, per state there, letters ignored."""
    links = Links(free)
    return jax.vmap(lambda layer: links.cheapest_arrival(layer / resolution) * resolution)(costs)


def grid_distances(
    free: Bool[Array, "H W"], cell: Int32[Array, "2"], resolution: Float32[Array, ""]
) -> Float32[Array, "H W"]:
    """Shortest cost from ``cell`` to every free cell, letters ignored; ``inf`` where unreachable."""
    transitions = jnp.where(free, 0, NO_STATE)[:, :, None]
    source = jnp.zeros((1,), jnp.int32)
    return product_distances(transitions, free, cell[None, :], source, resolution)[0, :, :, 0]


def reachable_cells(
    free: Bool[Array, "H W"], cell: Int32[Array, "2"], within: Bool[Array, "H W"]
) -> Bool[Array, "H W"]:
    """Free cells that can be reached from ``cell``, letters ignored; ``within`` are cells known to be among them.

    Where no move leads out of ``within``, as where no letter forbids a way, nothing is solved.
    """
    within = within.at[cell[0], cell[1]].set(True)
    costs = jnp.where(within, 0.0, jnp.inf).astype(jnp.float32)[:, :, None]
    leads_out = free & ~within & jnp.isfinite(Links(free).cheapest_arrival(costs)[:, :, 0])
    return jax.lax.cond(
        jnp.any(leads_out), lambda: jnp.isfinite(grid_distances(free, cell, jnp.float32(1.0))), lambda: within
    )


def _layers_first(transitions: Int32[Array, "H W Z"]) -> Int32[Array, "Z H W 1"]:
    return jnp.moveaxis(transitions, -1, 0)[..., None]


def _map_sources(solve, cells: Int32[Array, "Q 2"], states: Int32[Array, " Q"]) -> Array:
    """Apply ``solve`` to ``LANES`` sources at a time; results carry the sources in the last axis.

    Real sources are gathered in front, so that empty ones cost nothing: they reach nothing, ``inf``.
    """
    count = cells.shape[0]
    lanes = min(LANES, count)
    if count == lanes:
        return solve(cells, states)
    missing = -count % lanes
    order = jnp.argsort(states == NO_STATE, stable=True)
    back = jnp.argsort(order)
    cells = jnp.pad(cells[order], ((0, missing), (0, 0)))
    states = jnp.pad(states[order], (0, missing), constant_values=NO_STATE)
    real = jnp.sum(states != NO_STATE, dtype=jnp.int32)

    def solve_chunk(chunk, solved):
        first = chunk * lanes
        part = solve(
            jax.lax.dynamic_slice_in_dim(cells, first, lanes), jax.lax.dynamic_slice_in_dim(states, first, lanes)
        )
        return jax.lax.dynamic_update_slice_in_dim(solved, part, first, axis=solved.ndim - 1)

    one = jax.eval_shape(solve, cells[:lanes], states[:lanes])
    unreached = jnp.full((*one.shape[:-1], count + missing), jnp.inf, jnp.float32)
    return jax.lax.fori_loop(0, -(-real // lanes), solve_chunk, unreached)[..., back]
