"""Frontal sweeps: distances through the product automaton on one map.

A state of the automaton is a layer: a copy of the grid on which the moves that keep the state live. The layers are
solved one at a time, in two kinds of steps.

1. Within a layer, lines of the grid are updated from the line before, downwards, upwards, then the same along columns.
   A sweep in one direction completes every path that advances in that direction with each move, whatever its length, so
   a path needs one more sweep for every bend that turns it against the sweep. Four directions serve bends of all kinds.
   Rounds of four are repeated until one changes nothing: no bound on the number of bends is needed.
2. Then the moves that leave the state are applied once, on the lines where there are any, and the layers that they
   improve are swept again.

At the common fixed point no move improves any cost. Because every move costs something, such costs are the shortest
(Bellman's equations have one solution then). Costs are updated in place: a line uses what the line before has just got,
and the vector units work along the line and over several sources.

References:
    Zhao, A fast sweeping method for eikonal equations, Mathematics of Computation 2005 (alternating directions, in
    place, until nothing changes); here on the graph of grid moves, not on a differential equation.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32

from potlp_jax.types import NO_STATE
from potlp_jax.world.moves import DIAGONAL, NEIGHBOURS, cut_corners, shift


@struct.dataclass(kw_only=True)
class Wildcard:
    """Cells whose letter is unknown and may be any.

    Attributes:
        cells: True where the letter is free to choose.
        successors: ``[z, z'']`` is True where entering such a cell in state z may lead to z''.
    """

    cells: Bool[Array, "*batch H W"]
    successors: Bool[Array, "*batch Z Z"]


class Sweeper:
    """Solves distances on one map, from several sources side by side. Costs are [Z, H, W, Q].

    Sources lie in the minor axis: the same instruction updates a cell for all of them. Within a solution, grids have a
    margin of unreachable cells, which stands in for what lies outside (dimensions ``H2`` and ``W2``). Lines beyond the
    first and the last one that can be entered are not swept: maps are padded, and little is known of most.
    """

    def __init__(
        self, transitions: Int32[Array, "Z H W shared"], free: Bool[Array, "H W"], wildcard: Wildcard | None
    ) -> None:
        """Prepare what does not depend on the sources.

        Args:
            transitions: by state and cell, the state after entering the cell, ``NO_STATE`` where it may not be entered;
                the last axis has one entry for every source, or one that all share.
            free: True where there is no obstacle. It decides about cutting corners only.
            wildcard: cells whose letter may be any.
        """
        own = jnp.arange(transitions.shape[0], dtype=jnp.int32)
        keeps = transitions == own[:, None, None, None]
        if wildcard is not None:
            keeps = keeps | wildcard.cells[None, :, :, None]
        self.transitions = transitions
        self.wildcard = wildcard
        # Adding infinity forbids a move, which spares a select in the innermost loop.
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

    def _solve_padded(self, cells: Int32[Array, "Q 2"], states: Int32[Array, " Q"]) -> Float32[Array, "Z H2 W2 Q"]:
        """As ``solve``, with the margin.

        The lowest state whose costs have changed is swept first: states are numbered breadth-first from the initial
        one, so that in most automata each is swept once.
        """
        if self.transitions.shape[0] == 1:
            return self._solve_one_state(cells, states)
        count = self.transitions.shape[0]
        start = self._start(cells, states)
        dirty = jnp.any(states[None, :] == jnp.arange(count)[:, None], axis=1) & self.leads_on

        def solve_layer(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            cost, dirty = carry
            state = jnp.argmax(dirty).astype(jnp.int32)
            layer = self._sweep_to_fixed_point(cost[state], state)
            cost, improved = self._leave(cost.at[state].set(layer), layer, state)
            # In an automaton with cycles a later layer may improve this one again.
            return cost, dirty.at[state].set(False) | (improved & self.leads_on)

        return jax.lax.while_loop(lambda carry: jnp.any(carry[1]), solve_layer, (start, dirty))[0]

    def _solve_one_state(self, cells: Int32[Array, "Q 2"], states: Int32[Array, " Q"]) -> Float32[Array, "1 H2 W2 Q"]:
        """As ``_solve_padded`` where the automaton has one state, which no move leaves."""
        return self._sweep_to_fixed_point(self._start(cells, states)[0], jnp.int32(0))[None]

    def _start(self, cells: Int32[Array, "Q 2"], states: Int32[Array, " Q"]) -> Float32[Array, "Z H2 W2 Q"]:
        """Costs before the first sweep: 0 at each source."""
        # A source in ``NO_STATE`` (-1) writes infinity into the last layer, where there was infinity before.
        count, height, width, _ = self.transitions.shape
        source = jnp.arange(cells.shape[0])
        at_source = jnp.where(states == NO_STATE, jnp.inf, 0.0).astype(jnp.float32)
        start = jnp.full((count, height + 2, width + 2, cells.shape[0]), jnp.inf, jnp.float32)
        return start.at[states, cells[:, 0] + 1, cells[:, 1] + 1, source].set(at_source)

    def _sweep_to_fixed_point(
        self, cost: Float32[Array, "H2 W2 Q"], state: Int32[Array, ""]
    ) -> Float32[Array, "H2 W2 Q"]:
        """Apply the moves that keep one state of the automaton until they improve nothing."""
        enter, falling, rising = self.enter[state], self.links.falling, self.links.rising
        rows = _Lines(enter, falling, rising, self.rows[state])
        # Columns are the rows of the transposed grid. Both links keep their meaning when it is transposed: a square's
        # falling diagonal falls, its rising one rises.
        columns = _Lines(jnp.swapaxes(enter, 0, 1), falling.T, rising.T, self.columns[state])

        def sweep_round(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            before, _ = carry
            after = columns.sweep(jnp.swapaxes(rows.sweep(before), 0, 1))
            after = jnp.swapaxes(after, 0, 1)
            # An exact comparison: costs only fall, and sums of the same terms are the same in every round, so it ends.
            return after, jnp.any(after < before)

        return jax.lax.while_loop(lambda carry: carry[1], sweep_round, (cost, jnp.asarray(True)))[0]

    def _leads(
        self, state: Int32[Array, ""], to_state: Int32[Array, " to"], row: Int32[Array, ""] | None = None
    ) -> Bool[Array, "to *rows W shared"]:
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
        # Line by line takes a pass for each line and each state that it changes to; at once, one pass over everything.
        # Lines are taken up to half as many passes as the grid has lines.
        many = 2 * jnp.sum(self.changing_rows[state]) > self.changing_rows.shape[2]
        return jax.lax.cond(many, self._leave_everywhere, self._leave_by_line, cost, layer, state)

    def _leave_everywhere(
        self, cost: Float32[Array, "Z H2 W2 Q"], layer: Float32[Array, "H2 W2 Q"], state: Int32[Array, ""]
    ) -> tuple[Float32[Array, "Z H2 W2 Q"], Bool[Array, " Z"]]:
        """``_leave`` on the whole grid at once."""
        own = jnp.arange(cost.shape[0], dtype=jnp.int32)
        held = cost[:, 1:-1, 1:-1]
        arrival = self.links.cheapest_arrival(layer[1:-1, 1:-1])
        after = jnp.where(self._leads(state, own), _smaller(arrival[None], held), held)
        return cost.at[:, 1:-1, 1:-1].set(after), jnp.any(after < held, axis=(1, 2, 3))

    def _leave_by_line(
        self, cost: Float32[Array, "Z H2 W2 Q"], layer: Float32[Array, "H2 W2 Q"], state: Int32[Array, ""]
    ) -> tuple[Float32[Array, "Z H2 W2 Q"], Bool[Array, " Z"]]:
        """``_leave`` on the lines where such moves exist, one after the other: faster where they are few."""
        count, rows = self.changing_rows.shape[1:]
        width, sources = layer.shape[1] - 2, layer.shape[2]
        (changing,) = jnp.nonzero(self.changing_rows[state].reshape(-1), size=count * rows, fill_value=0)
        changing = changing.astype(jnp.int32)

        def line(index: Array) -> tuple[Array, Array, Array]:
            to_state, row = changing[index] // rows, changing[index] % rows
            leads = self._leads(state, to_state[None], row)[0]
            return to_state, row, jnp.where(leads, self.links.arrival_in_row(layer, row), jnp.inf)

        # Two passes, one that reads costs and one that writes them: XLA copies the costs where one does both.
        def compare(index: Array, improved: Array) -> Array:
            to_state, row, arrival = line(index)
            held = jax.lax.dynamic_slice(cost, (to_state, row + 1, 1, 0), (1, 1, width, sources))[0, 0]
            return improved.at[to_state].set(improved[to_state] | jnp.any(arrival < held))

        def write(index: Array, cost: Array) -> Array:
            to_state, row, arrival = line(index)
            held = jax.lax.dynamic_slice(cost, (to_state, row + 1, 1, 0), (1, 1, width, sources))
            return jax.lax.dynamic_update_slice(cost, _smaller(arrival[None, None], held), (to_state, row + 1, 1, 0))

        lines = jnp.sum(self.changing_rows[state])
        improved = jax.lax.fori_loop(0, lines, compare, jnp.zeros(count, bool))
        return jax.lax.fori_loop(0, lines, write, cost), improved


class Links:
    """The diagonal moves of a grid that cut no corner: their length, ``inf`` where there is none.

    ``falling[i, j]`` joins (i-1, j-1) and (i, j), ``rising[i, j]`` joins (i-1, j) and (i, j-1): each needs the two
    other cells of its 2x2 square free, so both are stored per square, at its lower right cell. A move and its reverse
    have one link.
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
        # The square between a cell and its neighbour has its lower right cell at the lower row and the right column.
        link = self.falling if rows == columns else self.rising
        return shift(link, -max(rows, 0), -max(columns, 0), jnp.inf)


def _extent(entered: Bool[Array, "Z lines"]) -> Int32[Array, "Z 2"]:
    """Per state the first line that can be entered and the one after the last; 0 and 0 where there is none."""
    count = entered.shape[1]
    first, end = jnp.argmax(entered, axis=1), count - jnp.argmax(entered[:, ::-1], axis=1)
    return jnp.where(jnp.any(entered, axis=1)[:, None], jnp.stack([first, end], axis=1), 0).astype(jnp.int32)


def _link(blocked: Bool[Array, "H W"]) -> Float32[Array, "H W"]:
    """Lengths of diagonal moves; ``blocked`` is True where one would cut a corner."""
    return jnp.where(blocked, jnp.inf, DIAGONAL).astype(jnp.float32)


class _Lines:
    """The lines of one grid, to be swept in both directions: each line is updated from the one before it.

    ``enter`` is the extra cost of entering a cell, ``falling`` and ``rising`` are the diagonals of its squares,
    ``extent`` the first line that can be entered and the one after the last.
    """

    def __init__(
        self,
        enter: Float32[Array, "H W shared"],
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
        # Rows of ``cost`` are one more than lines because of the margin: the line before ``i``, seen downwards, is row
        # ``i``, and upwards row ``i + 2``.
        first, end = self.extent
        cost = jax.lax.fori_loop(first, end, lambda i, cost: self._update(cost, i, i, self.above), cost)
        last = first + end - 1
        return jax.lax.fori_loop(
            first, end, lambda i, cost: self._update(cost, last - i, last - i + 2, self.below), cost
        )

    def _update(
        self, cost: Float32[Array, "H2 W2 Q"], line: Array, previous: Array, links: tuple[Array, Array]
    ) -> Float32[Array, "H2 W2 Q"]:
        """Line ``line`` from row ``previous`` of the padded costs."""

        def row_of(array: Array, index: Array) -> Array:
            return jax.lax.dynamic_index_in_dim(array, index, 0, keepdims=False)

        # Moves along the line itself are left to the sweeps across it: within a line each cell would wait for the one
        # beside it, and the vector units with it.
        before, current = row_of(cost, previous), row_of(cost, line + 1)[1:-1]
        left, right = (row_of(link, line) for link in links)
        # A select compiles to faster code than a minimum, which must also handle NaN.
        diagonal = _smaller(before[:-2] + left, before[2:] + right)
        arrival = _smaller(before[1:-1] + 1.0, diagonal) + row_of(self.enter, line)
        updated = _smaller(arrival, current)[None]
        return jax.lax.dynamic_update_slice(cost, updated, (line + 1, 1, 0))


def _smaller(first: Array, second: Array) -> Array:
    """The smaller of two costs, which are never NaN."""
    return jnp.where(first < second, first, second)
