"""The graph of histories that best-first search fills: its nodes, and how a history finds its node.

The pending cost never enters a node: an action either leaves the unknown region and pays it, or goes on inside and pays
nothing. A node keeps the least cost of both kinds of action apart, without the pending cost. So histories that know the
same at the same location are one node, in whatever order they came to know it.

References:
  Childs, Brodeur and Kocsis, Transpositions and Move Groups in Monte Carlo Tree Search, CIG 2008: orders of the same
    events share a node.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, UInt32

from potlp_jax.planning.history import History
from potlp_jax.planning.search.arrays import least_of_each, mix
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.planning.search.model import Model

PROBES: int = 8
"""Consecutive slots of the hash table in which a history may be found. Where all are taken the node is not entered: it
is then not shared between orders, which costs simulations but no correctness. At most half of the slots are taken, so
that eight in a row are rare. No experiment on the number is recorded."""

VALUE_COLUMNS: int = 7
"""Numbers in a row of ``Tree.values``."""

KEY_WORDS: int = 2
"""Words of a history's key in the hash table; the node's index follows them. Two of ten thousand histories of one tree
share all 64 bits with a probability below 3e-12."""

SHARES: int = 2048
"""A guess keeps the share of dead ends in it as a multiple of one in so many: a power of 2, less than 1."""


@struct.dataclass(kw_only=True)
class Costs:
    """Three estimates of one expected cost; ``floor <= bound <= value``.

    Attributes:
      value: with guesses as they are; what is believed.
      bound: with every guess reduced by the search's optimism, apart from what dead ends cost in it; where to look
        first.
      floor: with every guess replaced by 0. Costs are not negative, so that the true cost is no lower.
    """

    value: Float32[Array, "*B"]
    bound: Float32[Array, "*B"]
    floor: Float32[Array, "*B"]

    def low(self, certifies: Bool[Array, "..."]) -> Float32[Array, "..."]:
        """What a descent minimises: the floor where the row certifies, elsewhere the bound."""
        return jnp.where(certifies, self.floor, self.bound)


@struct.dataclass(kw_only=True)
class NodeValues:
    """What a node passes up, by kind of action: those that leave the unknown region, and those that stay inside.

    Stored packed, one row of seven numbers per node, so that a level of a descent reads them with one lookup.

    Attributes:
      leave: least Q, bound and floor of the actions that leave, without the pending cost; inf where there is none.
      stay: the same of the actions that stay inside.
      visits: descents that went on from the node.
    """

    leave: Costs
    stay: Costs
    visits: Float32[Array, "*B"]

    def pack(self) -> Float32[Array, "*B 7"]:
        """As a row of ``Tree.values``."""
        leave, stay = self.leave, self.stay
        columns = [leave.value, stay.value, leave.bound, stay.bound, leave.floor, stay.floor, self.visits]
        return jnp.stack(columns, axis=-1)

    @staticmethod
    def unpack(row: Float32[Array, "*B 7"]) -> "NodeValues":
        """From rows of ``Tree.values``."""
        # The one place that knows the order of the columns, with `pack`.
        leave, stay, leave_bound, stay_bound, leave_floor, stay_floor, visits = jnp.moveaxis(row, -1, 0)
        return NodeValues(
            leave=Costs(value=leave, bound=leave_bound, floor=leave_floor),
            stay=Costs(value=stay, bound=stay_bound, floor=stay_floor),
            visits=visits,
        )

    def on_arrival(self, pending_cost: Float32[Array, "*B"], dead_end_cost: Float32[Array, "*B"]) -> Costs:
        """Of a history that arrives at the node with this pending cost."""

        def least(leave: Array, stay: Array) -> Array:
            # Leaving pays the pending cost, staying inside does not. A node without any action is a dead end.
            best = jnp.minimum(pending_cost + leave, stay)
            return jnp.where(jnp.isinf(best), dead_end_cost, best)

        return jax.tree.map(least, self.leave, self.stay)


@struct.dataclass(kw_only=True)
class Tree:
    """Searched histories: a graph in arrays of fixed capacity N; node 0 is the root.

    A node is what is known at a location in a state of the automaton. The pending cost is left out of all its numbers.
    Behind the N nodes lies one spare node, to which rows write that have nothing to write.

    Attributes:
      q_values: expected cost of each action at each node, inf where it is not available.
      bounds: the same with optimistic guesses. Never above ``q_values``.
      floors: the same with guesses of 0: no policy costs less. Never above ``bounds``.
      chances: P_S of each action, given what is known at the node.
      success_costs: R_S of each action, given what is known at the node.
      children: each action's outcomes, ``FAILURE`` and ``SUCCESS`` (``search.model``): the index of the outcome's node;
        where it has none, a negative number that holds what is guessed of it (``as_guess``). Outcomes that satisfy the
        task never have a node: their value is 0.
      values: packed ``NodeValues`` of each node.
      location: of the node's history, as in ``history.History``.
      state: of the node's history.
      holds: of the node's history.
      fails: of the node's history.
      visited: of the node's history.
      table: hash table; per slot the key of a history (``KEY_WORDS``) and its node, ``UNVISITED`` where it is empty.
      root_visits: descents that began with each action.
      size: nodes in use.
      simulations: descents so far.
      steps: actions taken by all of them.
      status: bits of ``types.Status``.
    """

    q_values: Float32[Array, "*B N A"]
    bounds: Float32[Array, "*B N A"]
    floors: Float32[Array, "*B N A"]
    chances: Float32[Array, "*B N A"]
    success_costs: Float32[Array, "*B N A"]
    children: Int32[Array, "*B N A 2"]
    values: Float32[Array, "*B N 7"]
    location: Int32[Array, "*B N"]
    state: Int32[Array, "*B N"]
    holds: UInt32[Array, "*B N S W"]
    fails: UInt32[Array, "*B N S W"]
    visited: UInt32[Array, "*B N S1 V"]
    table: Int32[Array, "*B slots 3"]
    root_visits: Int32[Array, "*B A"]
    size: Int32[Array, "*B"]
    simulations: Int32[Array, "*B"]
    steps: Int32[Array, "*B"]
    status: UInt32[Array, "*B"]

    ROOT = 0
    UNVISITED = -1  # in the hash table; as a child, any negative number
    Q_INCLUDES_PENDING_COST = False

    @property
    def capacity(self) -> int:
        """N; index of the spare node."""
        return self.q_values.shape[-2] - 1

    @property
    def node_visits(self) -> Float32[Array, "*B N"]:
        """Descents that went on from each node."""
        return NodeValues.unpack(self.values).visits

    def values_at(self, rows: Int32[Array, "B"], node: Int32[Array, "B"]) -> NodeValues:
        """What one node of each row passes up."""
        return NodeValues.unpack(self.values[rows, node])

    def history(self, rows: Int32[Array, "B"], node: Int32[Array, "B"], pending_cost: Float32[Array, "B"]) -> History:
        """The history of one node of each row, arrived at with this pending cost.

        Args:
            rows: of the batch.
            node: by its number in its row's tree.
            pending_cost: paid by an action that leaves the unknown region.

        Returns:
            The history, leading dimension ``B``.
        """
        return History(
            location=self.location[rows, node],
            state=self.state[rows, node],
            pending_cost=pending_cost,
            holds=self.holds[rows, node],
            fails=self.fails[rows, node],
            visited=self.visited[rows, node],
        )


@struct.dataclass(kw_only=True)
class NewNode:
    """Numbers of a new node of each row by action, as in ``Tree``."""

    q_values: Float32[Array, "*B A"]
    bounds: Float32[Array, "*B A"]
    floors: Float32[Array, "*B A"]
    chances: Float32[Array, "*B A"]
    success_costs: Float32[Array, "*B A"]
    children: Int32[Array, "*B A 2"]


def as_guess(value: Float32[Array, "*N"], dead_ends: Float32[Array, "*N"]) -> Int32[Array, "*N"]:
    """A guess as an entry of ``Tree.children``: negative, so that it is no node's index.

    An outcome has a node or a guess, never both, so that one word holds either: the bits of the value, but the last of
    its mantissa make room for the share of dead ends in it. So the value is up to 0.02 % too low and the share up to
    0.05 %; and as the share stays below 1, every guess leaves a gap when it is discounted.

    Args:
      value: the guessed cost, not negative.
      dead_ends: what dead ends cost in it.

    Returns:
      What ``guess_in`` and ``dead_ends_in`` read.
    """
    share = jnp.where(dead_ends < value, jnp.floor(dead_ends / value * SHARES), SHARES - 1)
    bits = jax.lax.bitcast_convert_type(-jnp.abs(value), jnp.int32)
    return (bits & ~(SHARES - 1)) | share.astype(jnp.int32)


def guess_in(child: Int32[Array, "*N"]) -> Float32[Array, "*N"]:
    """The guessed value in an entry of ``Tree.children``; it means something only where the entry is negative."""
    return jnp.abs(jax.lax.bitcast_convert_type(child & ~(SHARES - 1), jnp.float32))


def dead_ends_in(child: Int32[Array, "*N"]) -> Float32[Array, "*N"]:
    """What dead ends cost in that value; likewise."""
    return guess_in(child) * ((child & (SHARES - 1)).astype(jnp.float32) / SHARES)


def plant_tree(model: Model, root: NewNode, config: BestFirstConfig) -> Tree:
    """Graphs of the roots alone.

    Args:
      model: the problems.
      root: numbers of the root of each row.
      config: ``capacity`` and ``slots`` give the sizes.

    Returns:
      One tree per row.
    """
    # Nodes beyond `size` are never read, but inf keeps the spare node from ever looking cheap.
    values = least_values(model, Costs(value=root.q_values, bound=root.bounds, floor=root.floors), model.root)
    batch, actions = root.q_values.shape

    def first(values: Array, fill: int | float = 0) -> Array:
        shape = (batch, config.capacity + 1, *values.shape[1:])
        return jnp.full(shape, fill, values.dtype).at[:, Tree.ROOT].set(values)

    return Tree(
        q_values=first(root.q_values, jnp.inf),
        bounds=first(root.bounds, jnp.inf),
        floors=first(root.floors, jnp.inf),
        chances=first(root.chances),
        success_costs=first(root.success_costs),
        children=first(root.children, Tree.UNVISITED),
        values=first(values.pack()),
        location=first(model.root.location),
        state=first(model.root.state),
        holds=first(model.root.holds),
        fails=first(model.root.fails),
        visited=first(model.root.visited),
        # A probe may begin at the last slot, so the table goes on behind it.
        table=jnp.full((batch, config.slots + PROBES, KEY_WORDS + 1), Tree.UNVISITED, jnp.int32),
        root_visits=jnp.zeros((batch, actions), jnp.int32),
        size=jnp.ones((batch,), jnp.int32),
        simulations=jnp.zeros((batch,), jnp.int32),
        steps=jnp.zeros((batch,), jnp.int32),
        status=jnp.zeros((batch,), jnp.uint32),
    )


def least_values(model: Model, costs: Costs, history: History) -> NodeValues:
    """What a node that nothing has been seen below passes up.

    Args:
      model: the problems.
      costs: of each action of the node of each row, ``[B, A]``, inf where an action is not available.
      history: of the node of each row; its location and state tell which actions stay inside.

    Returns:
      The node's values, with no visits.
    """
    inside = model.stays_inside(history.location, history.state)

    def least(kind: Bool[Array, "B A"]) -> Costs:
        return jax.tree.map(lambda values: least_of_each(jnp.where(kind, values, jnp.inf), jnp.inf), costs)

    return NodeValues(
        leave=least(~inside),
        stay=least(inside),
        visits=jnp.zeros(history.location.shape, jnp.float32),
    )


@struct.dataclass(kw_only=True)
class Lookup:
    """Where a history is, or would be, in the hash table of each row's graph.

    Attributes:
      node: its node, or ``Tree.UNVISITED``.
      entry_key: its key.
      slot: a free slot for it, beyond the table's end where there is none.
    """

    node: Int32[Array, "B"]
    entry_key: Int32[Array, "B 2"]
    slot: Int32[Array, "B"]


def find(tree: Tree, history: History, relevant: UInt32[Array, "B Z W"]) -> Lookup:
    """Look a history of each row up.

    Args:
      tree: the graphs.
      history: one per row.
      relevant: per state of the automaton, the conditions that later choices can depend on.

    Returns:
      Where it is in the table.
    """
    key = _key(history, relevant)
    # The number of slots is a power of two: the lowest bits of the key choose one.
    slots = tree.table.shape[1] - PROBES
    first = key[:, 0] & (slots - 1)
    # One slice per row instead of eight lookups.
    window = jax.vmap(lambda table, start: jax.lax.dynamic_slice(table, (start, 0), (PROBES, KEY_WORDS + 1)))(
        tree.table, first
    )
    keys, nodes = window[:, :, :KEY_WORDS], window[:, :, KEY_WORDS]
    # An empty slot holds -1 in its key too, which a history's key may equal: the node decides.
    same = jnp.all(keys == key[:, None, :], axis=2) & (nodes != Tree.UNVISITED)
    node = jnp.max(jnp.where(same, nodes, Tree.UNVISITED), axis=1)
    offsets = jnp.arange(PROBES, dtype=jnp.int32)[None, :]
    # Where no slot is free the index lies behind the table, and the write is dropped.
    empty = jnp.min(jnp.where(nodes == Tree.UNVISITED, offsets, slots + PROBES), axis=1)
    return Lookup(node=node, entry_key=key, slot=first + empty)


def _key(history: History, relevant: UInt32[Array, "B Z W"]) -> Int32[Array, "B 2"]:
    """64 bits that tell histories with different futures apart; the pending cost is not part of it.

    Every word of the history is mixed with a constant of its own before all are added, so that the sum does not depend
    on padding: words of padded subgoals are the same in all histories of a tree. The constants are odd fractions of
    2^32 (golden ratio, primes of xxHash), different for the two words.
    """
    rows = jnp.arange(history.location.shape[0], dtype=jnp.int32)
    # Conditions that no later choice depends on do not tell histories apart.
    usable = relevant[rows, history.state][:, None, :]
    holds, fails = history.holds & usable, history.fails & usable
    # Each word's position enters its hash: the same bits at another subgoal are other knowledge.
    number = jnp.arange(holds.shape[1] * holds.shape[2], dtype=jnp.uint32).reshape(1, *holds.shape[1:])
    where = jnp.arange(history.visited.shape[1] * history.visited.shape[2], dtype=jnp.uint32)
    visited = mix(history.visited ^ mix(where.reshape(1, *history.visited.shape[1:]) + jnp.uint32(0x51ED270B)))
    # A number for each pair of location and state. 64 is what the twin in native code multiplies by.
    states = max(64, relevant.shape[1])
    position = mix((history.location * states + history.state).astype(jnp.uint32) + jnp.uint32(0x2545F491))
    words = []
    # Two words from the same parts with different salts, so that both must collide.
    for salt in (0x9E3779B9, 0xC2B2AE3D):
        mixed = mix(mix(holds + number * jnp.uint32(salt)) ^ (fails * jnp.uint32(0x85EBCA77) + jnp.uint32(salt)))
        total = jnp.sum(mixed, axis=(1, 2), dtype=jnp.uint32) + jnp.sum(visited, axis=(1, 2), dtype=jnp.uint32)
        words.append(mix((total ^ position) * jnp.uint32(salt | 1) + position))
    return jax.lax.bitcast_convert_type(jnp.stack(words, axis=1), jnp.int32)


def add_node(
    tree: Tree,
    model: Model,
    node: NewNode,
    history: History,
    lookup: Lookup,
    is_new: Bool[Array, "B"],
) -> tuple[Tree, NodeValues, Bool[Array, "B"]]:
    """Write one new node per row, where the row has one and its graph has room.

    Args:
      tree: the graphs.
      model: the problems.
      node: numbers of the node.
      history: of the node.
      lookup: where the history belongs in the hash table.
      is_new: True where the row has a new node; elsewhere the spare node is written.

    Returns:
      The tree, what the node passes up (also where it had no room), and where it was added.
    """
    rows, added = model.rows, is_new & (tree.size < tree.capacity)
    # size == capacity is the spare node: a node without room goes there too.
    index = jnp.where(is_new, tree.size, tree.capacity)

    def write(array: Array, new: Array, index: Array = index) -> Array:
        return array.at[rows, index].set(new, mode="drop", unique_indices=True)

    entry = jnp.concatenate([lookup.entry_key, tree.size[:, None]], axis=1)
    tree = dataclasses.replace(
        tree,
        q_values=write(tree.q_values, node.q_values),
        bounds=write(tree.bounds, node.bounds),
        floors=write(tree.floors, node.floors),
        chances=write(tree.chances, node.chances),
        success_costs=write(tree.success_costs, node.success_costs),
        children=write(tree.children, node.children),
        location=write(tree.location, history.location),
        state=write(tree.state, history.state),
        holds=write(tree.holds, history.holds),
        fails=write(tree.fails, history.fails),
        visited=write(tree.visited, history.visited),
        # Entered in the table only where it was added; elsewhere the index lies behind the table.
        table=write(tree.table, entry, jnp.where(added, lookup.slot, tree.table.shape[1])),
        size=tree.size + added.astype(jnp.int32),
    )
    # Read back what was written: XLA would compute rows that are still to be written anew for each minimum over them,
    # which made the search up to ten times slower (docs/results/dropped.md, "Search").
    costs = Costs(value=tree.q_values[rows, index], bound=tree.bounds[rows, index], floor=tree.floors[rows, index])
    values = least_values(model, costs, history)
    return dataclasses.replace(tree, values=write(tree.values, values.pack())), values, added
