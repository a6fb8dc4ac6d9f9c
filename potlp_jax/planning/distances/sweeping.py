"""Frontal sweeps: distances through the product automaton on one map.

Each line of the grid is updated from the previous one, in all four directions, until nothing changes; then the moves
that leave the state are applied, on the lines where there are any, and the states that they improve are swept again. At
the common fixed point costs are shortest because every move costs something.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32

from potlp_jax.types import NO_STATE
from potlp_jax.world.moves import DIAGONAL, NEIGHBOURS, cut_corners, shift


@struct.dataclass(kw_only=True)
class Wildcard:
    """Cells whose letter is unknown and may be any: entering one from ``z`` may lead to every state in ``successors``.

    ``cells`` is True where the letter is free to choose; ``successors[z, z'']`` is True where the state may follow.
    """

    cells: Bool[Array, "*batch H W"]
    successors: Bool[Array, "*batch Z Z"]


class Sweeper:
    """Solves distances on one map. Costs are [Z, H, W, Q]: sources lie in the minor axis, in lanes.

    ``transitions`` may be shared by all lanes (last axis 1) or differ between them. Within a solution, grids have a
    margin of unreachable cells, which stands in for what lies outside. Lines beyond the first and the last one that can
    be entered are not swept: maps are padded, and little is known of most.
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
        entered = jnp.any(keeps, axis=3)
        self.rows, self.columns = (_extent(jnp.any(entered, axis=across)) for across in (2, 1))
        # States from which no move exists (accepting and trap states, where the caller cut them) need no sweep.
        self.leads_on = jnp.any((transitions != NO_STATE) | keeps, axis=(1, 2, 3))
        self.links = Links(free)
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
        if self.transitions.shape[0] == 1:
            return self._solve_one_state(cells, states)
        count = self.transitions.shape[0]
        start = self._start(cells, states)
        dirty = jnp.any(states[None, :] == jnp.arange(count)[:, None], axis=1) & self.leads_on

        def settle(carry):
            cost, dirty = carry
            state = jnp.argmax(dirty).astype(jnp.int32)
            layer = self._sweep_to_fixed_point(cost[state], state)
            cost, improved = self._leave(cost.at[state].set(layer), layer, state)
            return cost, dirty.at[state].set(False) | (improved & self.leads_on)

        return jax.lax.while_loop(lambda carry: jnp.any(carry[1]), settle, (start, dirty))[0]

    def _solve_one_state(self, cells, states):
        """As ``_solve_padded`` where the automaton has one state, which no move leaves."""
        return self._sweep_to_fixed_point(self._start(cells, states)[0], jnp.int32(0))[None]

    def _start(self, cells, states):
        """Costs before the first sweep: 0 at each source."""
        count, height, width, _ = self.transitions.shape
        lane = jnp.arange(cells.shape[0])
        at_source = jnp.where(states == NO_STATE, jnp.inf, 0.0).astype(jnp.float32)
        start = jnp.full((count, height + 2, width + 2, cells.shape[0]), jnp.inf, jnp.float32)
        return start.at[states, cells[:, 0] + 1, cells[:, 1] + 1, lane].set(at_source)

    def _sweep_to_fixed_point(
        self, cost: Float32[Array, "H2 W2 Q"], state: Int32[Array, ""]
    ) -> Float32[Array, "H2 W2 Q"]:
        """Apply the moves that keep one state of the automaton until they improve nothing."""
        enter, falling, rising = self.enter[state], self.links.falling, self.links.rising
        rows = _Lines(enter, falling, rising, self.rows[state])
        columns = _Lines(jnp.swapaxes(enter, 0, 1), falling.T, rising.T, self.columns[state])

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


class Links:
    """The diagonal moves of a grid that cut no corner: ``inf`` where there is none, else their length.

    ``falling[i, j]`` joins (i-1, j-1) and (i, j), ``rising[i, j]`` joins (i-1, j) and (i, j-1): each needs the two
    other cells of its 2x2 square free, so both are stored per square, at its lower right cell.
    """

    def __init__(self, free: Bool[Array, "H W"]) -> None:
        self.falling, self.rising = (_link(cut) for cut in cut_corners(free))
        # Lengths of the moves into each cell from its neighbours, in their order.
        self.steps = jnp.stack([self._step(*offset) for offset in NEIGHBOURS])

    def cheapest_arrival(self, layer: Float32[Array, "H W Q"]) -> Float32[Array, "H W Q"]:
        """Cost of standing on each cell's best neighbour plus the move into the cell, in cells."""
        best = jnp.full(layer.shape, jnp.inf, jnp.float32)
        for step, (rows, columns) in zip(self.steps, NEIGHBOURS, strict=True):
            best = _smaller(shift(layer, -rows, -columns, jnp.inf) + step[:, :, None], best)
        return best

    def arrival_in_row(self, layer: Float32[Array, "H2 W2 Q"], row: Int32[Array, ""]) -> Float32[Array, "W Q"]:
        """As ``cheapest_arrival`` for one row of the grid; ``layer`` has a margin."""
        around = jax.lax.dynamic_slice_in_dim(layer, row, 3)
        width = layer.shape[1] - 2
        beside = jnp.stack([around[1 + rows, 1 + columns : 1 + columns + width] for rows, columns in NEIGHBOURS])
        return jnp.min(beside + self.steps[:, row, :, None], axis=0)

    def arrival_at(self, layer: Float32[Array, "H W Q"], cells: Int32[Array, "N 2"]) -> Float32[Array, "N Q"]:
        """As ``cheapest_arrival`` for some cells."""
        beside = cells[None] + jnp.asarray(NEIGHBOURS, jnp.int32)[:, None]
        # Off the grid there is nothing; a negative index would wrap round.
        beside = jnp.where(beside < 0, max(layer.shape[:2]), beside)
        from_there = layer.at[beside[:, :, 0], beside[:, :, 1]].get(mode="fill", fill_value=jnp.inf)
        return jnp.min(from_there + self.steps[:, cells[:, 0], cells[:, 1], None], axis=0)

    def _step(self, rows: int, columns: int) -> Float32[Array, "H W"]:
        """Length of the move into each cell from its neighbour at the offset (rows, columns)."""
        if rows == 0 or columns == 0:
            return jnp.ones(self.falling.shape, jnp.float32)
        link = self.falling if rows == columns else self.rising
        return shift(link, -max(rows, 0), -max(columns, 0), jnp.inf)


def _extent(entered: Bool[Array, "Z lines"]) -> Int32[Array, "Z 2"]:
    """Per state the first line that can be entered and the one after the last; 0 and 0 where there is none."""
    count = entered.shape[1]
    first, end = jnp.argmax(entered, axis=1), count - jnp.argmax(entered[:, ::-1], axis=1)
    return jnp.where(jnp.any(entered, axis=1)[:, None], jnp.stack([first, end], axis=1), 0).astype(jnp.int32)


def _link(blocked: Bool[Array, "H W"]) -> Float32[Array, "H W"]:
    return jnp.where(blocked, jnp.inf, DIAGONAL).astype(jnp.float32)


class _Lines:
    """The lines of one grid, to be swept in both directions: each line is updated from the one before it.

    ``enter`` is the extra cost of entering a cell, ``falling`` and ``rising`` are the diagonals of its squares,
    ``extent`` the first line that can be entered and the one after the last.
    """

    def __init__(
        self,
        enter: Float32[Array, "H W lanes"],
        falling: Float32[Array, "H W"],
        rising: Float32[Array, "H W"],
        extent: Int32[Array, "2"],
    ) -> None:
        self.enter = enter
        self.extent = extent
        # Diagonals into a line from the line above it, seen from the left and from the right; and from the line below,
        # where the same links belong to the squares of that line.
        self.above = (falling[:, :, None], shift(rising, 0, -1, jnp.inf)[:, :, None])
        self.below = (shift(rising, -1, 0, jnp.inf)[:, :, None], shift(falling, -1, -1, jnp.inf)[:, :, None])

    def sweep(self, cost: Float32[Array, "H2 W2 Q"]) -> Float32[Array, "H2 W2 Q"]:
        """Once downwards, once upwards, in place; ``cost`` has a margin of one cell."""
        first, end = self.extent
        cost = jax.lax.fori_loop(first, end, lambda i, cost: self._update(cost, i, i, self.above), cost)
        last = first + end - 1
        return jax.lax.fori_loop(
            first, end, lambda i, cost: self._update(cost, last - i, last - i + 2, self.below), cost
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
