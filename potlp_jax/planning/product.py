"""Shortest distances and paths through the product of known space and the task automaton (MODEL.md section 2).

Product states are ``(cell, z)``. Grid moves are 8-connected, cost 1 and √2 times the resolution and never cut a corner:
a diagonal move needs both cells beside it free. Entering a cell in state ``z`` leads to ``transitions[cell, z]``.

Distances are solved by frontal sweeps, one state of the automaton after the other: each line of the grid is updated
from the previous one, in all four directions, until nothing changes; then the moves that leave the state are applied,
on the lines where there are any, and the states that they improve are swept again. At the common fixed point costs are
shortest because every move costs something. A table of costs between a few cells needs no sweep per state where few
cells carry letters that matter: see ``portals``.
"""

import functools
import math

import jax
import jax.numpy as jnp
from flax import struct
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Bool, Float32, Int32

from potlp_jax.planning.portals import find_active_cells, portals_pay, table_by_portals
from potlp_jax.task.task import TaskArrays
from potlp_jax.types import NO_STATE

DIAGONAL: float = math.sqrt(2.0)
"""Length of a diagonal move in cells."""

LANES: int = 8
"""Sources solved at a time: enough to fill vector units, few enough for a layer of costs to stay in cache."""

NEIGHBOURS: tuple[tuple[int, int], ...] = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))
"""The eight moves as (row, column) offsets; paths break ties in this order."""


@struct.dataclass(kw_only=True)
class Wildcard:
    """Cells whose letter is unknown and may be any: entering one from ``z`` may lead to every state in ``successors``.

    ``cells`` is True where the letter is free to choose; ``successors[z, z'']`` is True where the state may follow.
    """

    cells: Bool[Array, "*batch H W"]
    successors: Bool[Array, "*batch Z Z"]


def product_transitions(
    task: TaskArrays, letters: Int32[Array, "H W"], known_free: Bool[Array, "H W"]
) -> Int32[Array, "H W Z"]:
    """State of the automaton after entering each cell from each state.

    ``NO_STATE`` where the cell is not ``known_free`` (True = may be entered) or the letter leads to a trap state:
    such moves do not exist in the product (MODEL.md section 2).
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
    sweeper = _Sweeper(_layers_first(transitions), free, wildcard)
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
    sweeper = _Sweeper(_layers_first(transitions), free, None)
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
    sweeper = _Sweeper(jnp.where(neutral, 0, NO_STATE)[None, :, :, None], free, None)
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
    return _Sweeper(transitions, free, None).solve(source_cells, source_states) * resolution


def arrivals_by_lane(
    costs: Float32[Array, "Z H W Q"], free: Bool[Array, "H W"], resolution: Float32[Array, ""]
) -> Float32[Array, "Z H W Q"]:
    """Cost of arriving in each cell by one move from the best neighbour, per state there, letters ignored."""
    links = _Links(free)
    return jax.vmap(lambda layer: links.cheapest_arrival(layer / resolution) * resolution)(costs)


def grid_distances(
    free: Bool[Array, "H W"], cell: Int32[Array, "2"], resolution: Float32[Array, ""]
) -> Float32[Array, "H W"]:
    """Shortest cost from ``cell`` to every free cell, letters ignored; ``inf`` where unreachable."""
    transitions = jnp.where(free, 0, NO_STATE)[:, :, None]
    source = jnp.zeros((1,), jnp.int32)
    return product_distances(transitions, free, cell[None, :], source, resolution)[0, :, :, 0]


def _layers_first(transitions: Int32[Array, "H W Z"]) -> Int32[Array, "Z H W 1"]:
    return jnp.moveaxis(transitions, -1, 0)[..., None]


def _map_sources(solve, cells: Int32[Array, "Q 2"], states: Int32[Array, " Q"]) -> Array:
    """Apply ``solve`` to ``LANES`` sources at a time; results carry the sources in the last axis.

    Real sources are gathered in front, so that chunks of empty ones cost next to nothing.
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
    chunks = (cells.reshape(-1, lanes, 2), states.reshape(-1, lanes))
    solved = jnp.moveaxis(jax.lax.map(lambda chunk: solve(*chunk), chunks), 0, -2)
    return solved.reshape(*solved.shape[:-2], -1)[..., back]


class _Sweeper:
    """Solves distances on one map. Costs are [Z, H, W, Q]: sources lie in the minor axis, in lanes.

    ``transitions`` may be shared by all lanes (last axis 1) or differ between them. Within a solution, grids have a
    margin of unreachable cells, which stands in for what lies outside.
    """

    def __init__(
        self, transitions: Int32[Array, "Z H W lanes"], free: Bool[Array, "H W"], wildcard: Wildcard | None
    ) -> None:
        own = jnp.arange(transitions.shape[0], dtype=jnp.int32)
        keeps = transitions == own[:, None, None, None]
        if wildcard is not None:
            keeps = keeps | wildcard.cells[None, :, :, None]
        self.transitions = transitions
        self.wildcard = wildcard
        self.enter = jnp.where(keeps, 0.0, jnp.inf).astype(jnp.float32)
        # States from which no move exists (accepting and trap states, where the caller cut them) need no sweep.
        self.leads_on = jnp.any((transitions != NO_STATE) | keeps, axis=(1, 2, 3))
        self.links = _Links(free)
        # [from state, to state, row]: lines of the grid where a move changes the state.
        self.changing_rows = jax.lax.map(lambda state: jnp.any(self._leads(state, own), axis=(2, 3)), own)

    def solve(self, cells: Int32[Array, "Q 2"], states: Int32[Array, " Q"]) -> Float32[Array, "Z H W Q"]:
        """Costs in cells from each source; all ``inf`` where its state is ``NO_STATE``."""
        return self._solve_padded(cells, states)[:, 1:-1, 1:-1]

    def _solve_padded(self, cells, states):
        """As ``solve``, with the margin.

        The lowest state whose costs have changed is swept first: states are numbered breadth-first from the initial
        one, so that in most automata each is swept once.
        """
        count, height, width, _ = self.transitions.shape
        lane = jnp.arange(cells.shape[0])
        at_source = jnp.where(states == NO_STATE, jnp.inf, 0.0).astype(jnp.float32)
        start = jnp.full((count, height + 2, width + 2, cells.shape[0]), jnp.inf, jnp.float32)
        start = start.at[states, cells[:, 0] + 1, cells[:, 1] + 1, lane].set(at_source)
        dirty = jnp.any(states[None, :] == jnp.arange(count)[:, None], axis=1) & self.leads_on

        def settle(carry):
            cost, dirty = carry
            state = jnp.argmax(dirty).astype(jnp.int32)
            layer = self._sweep_to_fixed_point(cost[state], self.enter[state])
            cost, improved = self._leave(cost.at[state].set(layer), layer, state)
            return cost, dirty.at[state].set(False) | (improved & self.leads_on)

        return jax.lax.while_loop(lambda carry: jnp.any(carry[1]), settle, (start, dirty))[0]

    def _sweep_to_fixed_point(
        self, cost: Float32[Array, "H2 W2 Q"], enter: Float32[Array, "H W lanes"]
    ) -> Float32[Array, "H2 W2 Q"]:
        """Apply the moves that keep one state of the automaton until they improve nothing."""
        rows = _Lines(enter, self.links.falling, self.links.rising)
        columns = _Lines(jnp.swapaxes(enter, 0, 1), self.links.falling.T, self.links.rising.T)

        def sweep_round(carry):
            before, _ = carry
            after = columns.sweep(jnp.swapaxes(rows.sweep(before), 0, 1))
            after = jnp.swapaxes(after, 0, 1)
            return after, jnp.any(after < before)

        return jax.lax.while_loop(lambda carry: carry[1], sweep_round, (cost, jnp.asarray(True)))[0]

    def _leads(
        self, state: Int32[Array, ""], to_state: Int32[Array, " to"], row: Int32[Array, ""] | None = None
    ) -> Bool[Array, "to *rows W lanes"]:
        """Where a move out of ``state`` leads to each of the states, on the whole grid or on one row; never itself."""
        following = self.transitions[state] if row is None else self.transitions[state, row]
        to_state = to_state.reshape(-1, *(1,) * following.ndim)
        leads = following[None] == to_state
        if self.wildcard is not None:
            cells = self.wildcard.cells if row is None else self.wildcard.cells[row]
            leads = leads | (cells[None, ..., None] & self.wildcard.successors[state][to_state])
        return leads & (to_state != state)

    def _leave(
        self, cost: Float32[Array, "Z H2 W2 Q"], layer: Float32[Array, "H2 W2 Q"], state: Int32[Array, ""]
    ) -> tuple[Float32[Array, "Z H2 W2 Q"], Bool[Array, " Z"]]:
        """Apply every move that leaves ``state``, whose costs are ``layer``, once; and which states that improved."""
        many = 2 * jnp.sum(self.changing_rows[state]) > self.changing_rows.shape[2]
        return jax.lax.cond(many, self._leave_everywhere, self._leave_by_line, cost, layer, state)

    def _leave_everywhere(self, cost, layer, state):
        """``_leave`` on the whole grid at once."""
        own = jnp.arange(cost.shape[0], dtype=jnp.int32)
        held = cost[:, 1:-1, 1:-1]
        arrival = self.links.cheapest_arrival(layer[1:-1, 1:-1])
        after = jnp.where(self._leads(state, own), _smaller(arrival[None], held), held)
        return cost.at[:, 1:-1, 1:-1].set(after), jnp.any(after < held, axis=(1, 2, 3))

    def _leave_by_line(self, cost, layer, state):
        """``_leave`` on the lines where such moves exist, one after the other: the faster way where they are few."""
        count, rows = self.changing_rows.shape[1:]
        width, lanes = layer.shape[1] - 2, layer.shape[2]
        (changing,) = jnp.nonzero(self.changing_rows[state].reshape(-1), size=count * rows, fill_value=0)
        changing = changing.astype(jnp.int32)

        def line(index):
            to_state, row = changing[index] // rows, changing[index] % rows
            leads = self._leads(state, to_state[None], row)[0]
            return to_state, row, jnp.where(leads, self.links.arrival_in_row(layer, row), jnp.inf)

        # Two passes, one that reads costs and one that writes them: XLA copies the costs where one does both.
        def look(index, improved):
            to_state, row, arrival = line(index)
            held = jax.lax.dynamic_slice(cost, (to_state, row + 1, 1, 0), (1, 1, width, lanes))[0, 0]
            return improved.at[to_state].set(improved[to_state] | jnp.any(arrival < held))

        def write(index, cost):
            to_state, row, arrival = line(index)
            held = jax.lax.dynamic_slice(cost, (to_state, row + 1, 1, 0), (1, 1, width, lanes))
            return jax.lax.dynamic_update_slice(cost, _smaller(arrival[None, None], held), (to_state, row + 1, 1, 0))

        lines = jnp.sum(self.changing_rows[state])
        improved = jax.lax.fori_loop(0, lines, look, jnp.zeros(count, bool))
        return jax.lax.fori_loop(0, lines, write, cost), improved


class _Links:
    """The diagonal moves of a grid that cut no corner: ``inf`` where there is none, else their length.

    ``falling[i, j]`` joins (i-1, j-1) and (i, j), ``rising[i, j]`` joins (i-1, j) and (i, j-1): each needs the two
    other cells of its 2x2 square free, so both are stored per square, at its lower right cell.
    """

    def __init__(self, free: Bool[Array, "H W"]) -> None:
        blocked = ~free
        self.falling = _link(_shift(blocked, 1, 0, True) | _shift(blocked, 0, 1, True))
        self.rising = _link(_shift(blocked, 1, 1, True) | blocked)
        # Lengths of the moves into each cell from its neighbours, in their order.
        self.steps = jnp.stack([self._step(*offset) for offset in NEIGHBOURS])

    def cheapest_arrival(self, layer: Float32[Array, "H W Q"]) -> Float32[Array, "H W Q"]:
        """Cost of standing on each cell's best neighbour plus the move into the cell, in cells."""
        best = jnp.full(layer.shape, jnp.inf, jnp.float32)
        for step, (rows, columns) in zip(self.steps, NEIGHBOURS, strict=True):
            best = _smaller(_shift(layer, -rows, -columns, jnp.inf) + step[:, :, None], best)
        return best

    def arrival_in_row(self, layer: Float32[Array, "H2 W2 Q"], row: Int32[Array, ""]) -> Float32[Array, "W Q"]:
        """As ``cheapest_arrival`` for one row of the grid; ``layer`` has a margin."""
        around = jax.lax.dynamic_slice_in_dim(layer, row, 3)
        width = layer.shape[1] - 2
        best = jnp.full((width, layer.shape[2]), jnp.inf, jnp.float32)
        for step, (rows, columns) in zip(self.steps, NEIGHBOURS, strict=True):
            best = _smaller(around[1 + rows, 1 + columns : 1 + columns + width] + step[row][:, None], best)
        return best

    def arrival_at(self, layer: Float32[Array, "H W Q"], cells: Int32[Array, "N 2"]) -> Float32[Array, "N Q"]:
        """As ``cheapest_arrival`` for some cells."""
        height, width, lanes = layer.shape
        best = jnp.full((cells.shape[0], lanes), jnp.inf, jnp.float32)
        for step, offset in zip(self.steps, NEIGHBOURS, strict=True):
            beside = cells + jnp.asarray(offset, jnp.int32)[None, :]
            # Off the grid there is nothing; a negative index would wrap round.
            beside = jnp.where(beside < 0, max(height, width), beside)
            from_there = layer.at[beside[:, 0], beside[:, 1]].get(mode="fill", fill_value=jnp.inf)
            best = _smaller(from_there + step[cells[:, 0], cells[:, 1]][:, None], best)
        return best

    def _step(self, rows: int, columns: int) -> Float32[Array, "H W"]:
        """Length of the move into each cell from its neighbour at the offset (rows, columns)."""
        if rows == 0 or columns == 0:
            return jnp.ones(self.falling.shape, jnp.float32)
        link = self.falling if rows == columns else self.rising
        return _shift(link, -max(rows, 0), -max(columns, 0), jnp.inf)


def _link(blocked: Bool[Array, "H W"]) -> Float32[Array, "H W"]:
    return jnp.where(blocked, jnp.inf, DIAGONAL).astype(jnp.float32)


def _shift(array: Array, rows: int, columns: int, fill: float | bool) -> Array:
    """``result[i, j] = array[i - rows, j - columns]``, ``fill`` where that lies outside; |rows|, |columns| <= 1."""
    height, width = array.shape[:2]
    margins = ((1, 1), (1, 1)) + ((0, 0),) * (array.ndim - 2)
    padded = jnp.pad(array, margins, constant_values=fill)
    return padded[1 - rows : 1 - rows + height, 1 - columns : 1 - columns + width]


class _Lines:
    """The lines of one grid, to be swept in both directions: each line is updated from the one before it.

    ``enter`` is the extra cost of entering a cell, ``falling`` and ``rising`` are the diagonals of its squares.
    """

    def __init__(
        self, enter: Float32[Array, "H W lanes"], falling: Float32[Array, "H W"], rising: Float32[Array, "H W"]
    ) -> None:
        self.enter = enter
        # Diagonals into a line from the line above it, seen from the left and from the right; and from the line below,
        # where the same links belong to the squares of that line.
        self.above = (falling[:, :, None], _shift(rising, 0, -1, jnp.inf)[:, :, None])
        self.below = (_shift(rising, -1, 0, jnp.inf)[:, :, None], _shift(falling, -1, -1, jnp.inf)[:, :, None])

    def sweep(self, cost: Float32[Array, "H2 W2 Q"]) -> Float32[Array, "H2 W2 Q"]:
        """Once downwards, once upwards, in place; ``cost`` has a margin of one cell."""
        count = cost.shape[0] - 2
        cost = jax.lax.fori_loop(0, count, lambda i, cost: self._update(cost, i, i, self.above), cost)
        return jax.lax.fori_loop(
            0, count, lambda i, cost: self._update(cost, count - 1 - i, count + 1 - i, self.below), cost
        )

    def _update(self, cost, line, previous, links):
        """Line ``line`` from row ``previous`` of the padded costs."""

        def row_of(array, index):
            return jax.lax.dynamic_index_in_dim(array, index, 0, keepdims=False)

        before, current = row_of(cost, previous), row_of(cost, line + 1)[1:-1]
        left, right = (row_of(link, line) for link in links)
        # A select compiles to faster code than a minimum, which must also handle NaN.
        diagonal = _smaller(before[:-2] + left, before[2:] + right)
        arrival = _smaller(before[1:-1] + 1.0, diagonal) + row_of(self.enter, line)
        updated = _smaller(arrival, current)[None]
        return jax.lax.dynamic_update_slice(cost, updated, (line + 1, 1, 0))


def _smaller(first: Array, second: Array) -> Array:
    return jnp.where(first < second, first, second)


@struct.dataclass(kw_only=True)
class KnownPath:
    """The beginning of a shortest path through known space.

    ``cells[i]`` and ``states[i]`` for ``i <= length`` are the product states after ``i`` moves, the source included;
    later entries repeat the last one. ``length`` counts the moves held here, at most K; ``cost`` is that of the whole
    path to its target, ``inf`` (and ``length`` 0) where the target is out of reach.
    """

    cells: Int32[Array, "*batch K1 2"]
    states: Int32[Array, "*batch K1"]
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
    """First ``horizon`` moves of a shortest path, walked back from the target along ``distances`` from the source.

    Ties between predecessors break by the order of ``NEIGHBOURS``, then by the lowest state.
    """
    cost = distances[target_cell[0], target_cell[1], target_state]
    reachable = jnp.isfinite(cost)
    predecessor = _Predecessor(distances, transitions, free, resolution, wildcard)
    ring = horizon + 1

    # The ring keeps the last entries written, which are those nearest the source.
    def walk(carry):
        count, cell, state, cells, states = carry
        cell, state = predecessor(cell, state)
        count = count + 1
        slot = count % ring
        return count, cell, state, cells.at[slot].set(cell), states.at[slot].set(state)

    def unfinished(carry):
        _, cell, state, _, _ = carry
        return reachable & ~(jnp.all(cell == source_cell) & (state == source_state))

    cells = jnp.broadcast_to(jnp.where(reachable, target_cell, source_cell)[None, :], (ring, 2))
    states = jnp.broadcast_to(jnp.where(reachable, target_state, source_state)[None], (ring,))
    start = (jnp.int32(0), target_cell, target_state, cells, states)
    count, _, _, cells, states = jax.lax.while_loop(unfinished, walk, start)
    length = jnp.minimum(count, horizon)
    order = (count - jnp.minimum(jnp.arange(ring, dtype=jnp.int32), length)) % ring
    return KnownPath(cells=cells[order], states=states[order], length=length, cost=cost)


class _Predecessor:
    """Finds the product state from which a shortest path enters a given one."""

    def __init__(
        self,
        distances: Float32[Array, "H W Z"],
        transitions: Int32[Array, "H W Z"],
        free: Bool[Array, "H W"],
        resolution: Float32[Array, ""],
        wildcard: Wildcard | None,
    ) -> None:
        margin = ((1, 1), (1, 1))
        self.distances = jnp.pad(distances, (*margin, (0, 0)), constant_values=jnp.inf)
        self.free = jnp.pad(free, margin, constant_values=False)
        self.transitions = transitions
        self.wildcard = wildcard
        self.offsets = jnp.asarray(NEIGHBOURS, jnp.int32)
        lengths = [1.0 if 0 in offset else DIAGONAL for offset in NEIGHBOURS]
        self.steps = jnp.asarray(lengths, jnp.float32) * resolution

    def __call__(self, cell: Int32[Array, "2"], state: Int32[Array, ""]) -> tuple[Int32[Array, "2"], Int32[Array, ""]]:
        states = self.transitions.shape[2]
        leads = self.transitions[cell[0], cell[1]] == state
        if self.wildcard is not None:
            chosen = self.wildcard.successors[:, state] | (jnp.arange(states) == state)
            leads = leads | (self.wildcard.cells[cell[0], cell[1]] & chosen)
        neighbours = cell[None, :] + self.offsets + 1
        beside = (
            self.free[neighbours[:, 0], cell[1] + 1] & self.free[cell[0] + 1, neighbours[:, 1]]
        )  # for a straight move one of the two is the neighbour, the other the cell itself
        cost = self.distances[neighbours[:, 0], neighbours[:, 1]] + self.steps[:, None]
        cost = jnp.where(beside[:, None] & leads[None, :], cost, jnp.inf)
        best = jnp.argmin(cost.reshape(-1)).astype(jnp.int32)
        return neighbours[best // states] - 1, best % states
