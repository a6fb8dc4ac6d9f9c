"""What a search has found: the graph of histories, its new nodes, and how to find a history in it.

The pending cost never enters a node: an action either leaves the unknown region and pays it, or goes on inside and pays
nothing. A node keeps the least cost of both kinds, the pending cost left out, so histories that know the same at the
same location are one node, in whatever order they came to know it.
"""

import dataclasses
from collections.abc import Sequence
from enum import StrEnum
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, UInt32

from potlp_jax.planning.history import (
    ActionTables,
    History,
    action_tables,
    initial_history,
    terms_of_all,
)
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.arrays import least_of_each, mix, pack_rows
from potlp_jax.planning.search.guess import Rule, guess_outcomes, make_rule
from potlp_jax.task.relations import transitive_closure
from potlp_jax.types import NO_STATE

WINDOW: int = 8
"""Slots of the table of nodes that a history may be found in. Where all are taken the node is not entered: it is then
not shared between orders, which costs simulations but no correctness."""

OPTIMISM: float = 0.3
FEW_ACTIONS: int = 41
OPTIMISM_OF_FEW: float = 0.7
"""Optimism of a search that is not told (``SearchConfig.optimism``): of few actions, and of more. 41 are 8 subgoals
with 5 attempts each, and finish."""

NOWHERE: int = -1
"""Product state of actions that are not attempted beyond a subgoal: finish, and padding."""

UNTRIED: float = 1e18
"""Spread of an action that must be tried before others are tried again; finite, so that an action that is not
available (Q = inf) never becomes NaN."""


class SearchMode(StrEnum):
    """How the search values what it has seen.

    ``EXPECTATION`` uses what the model knows in closed form: values of new nodes from a guess, expectations over both
    outcomes, minima over actions, one node for all orders of the same events. ``AUTHORS_CODE`` is PO-UCT as in the
    code of Bradley et al.: a new node is worth nothing beyond the cost so far, Q is the mean of the sampled costs,
    each action is tried once before any is tried twice, the most visited one is chosen.
    """

    EXPECTATION = "expectation"
    AUTHORS_CODE = "authors_code"


@dataclasses.dataclass(frozen=True)
class SearchConfig:
    """Settings of the search.

    Attributes:
      simulations: descents per search; each adds at most one node. The search ends earlier where nothing is left to
        look at.
      optimism: fraction by which guesses may be too high: the descent takes the action that would be best if they all
        were. 1 looks at everything that the guesses cannot rule out, so that a search that ends by itself is exact.
        None: .7 in problems of up to 41 actions, where one wrong guess weighs more and there is less to look at, else
        .3 (docs/results/planner.md).
      max_depth: actions per descent; one that gets there is cut, valued by what is known of its last node, and
        flagged.
      tree_capacity: nodes per tree, at least 1; None for one more than simulations. A full tree is flagged.
      guess_failures: failures in a row that the guess at untried outcomes follows; a dead end counts after them.
      mode: how values are made, see ``SearchMode``.
      exploration: weight of the exploration term in the mode ``AUTHORS_CODE``, a cost: the descent takes the least
        ``Q - exploration * sqrt(log(n) / n_a)``; the authors use 50.
    """

    simulations: int = 300
    optimism: float | None = None
    max_depth: int = 32
    tree_capacity: int | None = None
    guess_failures: int = 24
    mode: SearchMode = SearchMode.EXPECTATION
    exploration: float = 50.0

    def __post_init__(self) -> None:
        for name in ("simulations", "max_depth", "tree_capacity", "guess_failures"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"SearchConfig.{name} is {value}, must be at least 1")
        if self.optimism is not None and not 0 <= self.optimism <= 1:
            raise ValueError(f"SearchConfig.optimism is {self.optimism}, must lie in [0, 1]")
        if not self.exploration >= 0:
            raise ValueError(f"SearchConfig.exploration is {self.exploration}, must not be negative")

    @property
    def capacity(self) -> int:
        """Nodes per tree."""
        return self.simulations + 1 if self.tree_capacity is None else self.tree_capacity

    @property
    def slots(self) -> int:
        """Places where a window of the table of nodes may begin: a power of two, at most half of them taken."""
        return 1 << max(self.capacity * 2 - 1, 1).bit_length()


@struct.dataclass(kw_only=True)
class Tree:
    """Searched histories, a graph; node 0 is the root.

    A node is what is known at a location in a state, in whatever order it came to be known. The pending cost is left
    out of all its numbers.

    Attributes:
      q_values: expected cost of each action at each node, inf where it is not available.
      bounds: what the descent compares: the same with optimistic guesses. In the mode ``AUTHORS_CODE``
        ``1 / sqrt(n_a)``, n_a the descents that took the action.
      chances, success_costs: P_S and R_S of each action, given what is known at the node.
      failure_value, success_value: guessed values after each action's failure and success.
      children: node reached by each action after failure and after success, or ``UNVISITED``. Outcomes that satisfy
        the task have no node: their value is 0.
      values: per node the least Q of the actions that leave the unknown region, of those that stay inside, the least
        bound of both kinds, and the descents that went on from here.
      location, state, holds, fails, visited: the node's history, as in ``history.History``.
      table: per slot the key of a history and its node, -1 where the slot is empty.
      root_visits: descents that began with each action.
      size: nodes in use.
      simulations: descents so far.
      steps: actions taken by all of them.
      status: bits of ``types.Status``.
    """

    q_values: Float32[Array, "*B N A"]
    bounds: Float32[Array, "*B N A"]
    chances: Float32[Array, "*B N A"]
    success_costs: Float32[Array, "*B N A"]
    failure_value: Float32[Array, "*B N A"]
    success_value: Float32[Array, "*B N A"]
    children: Int32[Array, "*B N A 2"]
    values: Float32[Array, "*B N 5"]
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
    UNVISITED = -1

    def history(self, node: Int32[Array, "*B"], pending_cost: Float32[Array, "*B"]) -> History:
        """The history of one node of each row, with the pending cost there."""
        at = (jnp.arange(self.size.shape[0], dtype=jnp.int32), node) if self.size.ndim else node
        return History(
            location=self.location[at],
            state=self.state[at],
            pending_cost=pending_cost,
            holds=self.holds[at],
            fails=self.fails[at],
            visited=self.visited[at],
        )


@struct.dataclass(kw_only=True)
class Context:
    """What stays the same during a search.

    ``rule`` guesses; ``packed`` holds all of an action's row of the tables (``pack_rows``); ``facts`` holds per action
    the number of the (subgoal, z') where it is attempted and whether its success satisfies the task; ``relevant``
    masks per state the conditions that later choices can depend on; ``optimism`` is that of each problem.
    """

    tables: ActionTables
    rule: Rule
    packed: UInt32[Array, "*B A n"]
    facts: Int32[Array, "*B A 2"]
    relevant: UInt32[Array, "*B Z W"]
    root: History
    dead_end_cost: Float32[Array, "*B"]
    optimism: Float32[Array, "*B"]
    seeds: UInt32[Array, "*B 2"]


def new_search(
    structure: Any, leaves: Sequence[Array], seeds: UInt32[Array, "B 2"], config: SearchConfig
) -> tuple[Context, Tree]:
    """Tables of a batch of problems, and graphs of the roots alone."""
    context = prepare(structure, leaves, seeds, config)
    root = new_node(context, context.root, config)
    values = least_values(context, root.q_values, root.bounds, context.root.location, context.root.state)
    batch, actions = root.q_values.shape

    def first(values: Array, fill: float = 0) -> Array:
        shape = (batch, config.capacity + 1, *values.shape[1:])
        return jnp.full(shape, fill, values.dtype).at[:, Tree.ROOT].set(values)

    tree = Tree(
        q_values=first(root.q_values, jnp.inf),
        bounds=first(root.bounds, jnp.inf),
        chances=first(root.chances),
        success_costs=first(root.success_costs),
        failure_value=first(root.failure_value),
        success_value=first(root.success_value),
        children=jnp.full((batch, config.capacity + 1, actions, 2), Tree.UNVISITED, jnp.int32),
        values=first(values),
        location=first(context.root.location),
        state=first(context.root.state),
        holds=first(context.root.holds),
        fails=first(context.root.fails),
        visited=first(context.root.visited),
        table=jnp.full((batch, config.slots + WINDOW, 3), Tree.UNVISITED, jnp.int32),
        root_visits=jnp.zeros((batch, actions), jnp.int32),
        size=jnp.ones((batch,), jnp.int32),
        simulations=jnp.zeros((batch,), jnp.int32),
        steps=jnp.zeros((batch,), jnp.int32),
        status=jnp.zeros((batch,), jnp.uint32),
    )
    return context, tree


def prepare(structure: Any, leaves: Sequence[Array], seeds: UInt32[Array, "B 2"], config: SearchConfig) -> Context:
    """What a search of a batch of problems needs to know beside its graph; ``leaves`` are those of a problem."""
    problems = jax.tree.unflatten(structure, leaves)
    tables, root = jax.vmap(action_tables)(problems), jax.vmap(initial_history)(problems)
    rows, states = tables.actions, tables.accepting.shape[1]
    # Finish is attempted nowhere; S * Z + NO_STATE would be the last subgoal in the last state.
    where = jnp.where(rows.from_state == NO_STATE, NOWHERE, rows.subgoal * states + rows.from_state)
    reach = jax.vmap(_reachable)(tables)
    terms = jax.vmap(terms_of_all)(tables, root)
    rule = make_rule(
        tables,
        where,
        terms.success_probability,
        terms.success_cost,
        reach,
        problems.dead_end_cost,
        config.guess_failures,
        solve=config.mode is not SearchMode.AUTHORS_CODE,
    )
    return Context(
        tables=tables,
        rule=rule,
        packed=jax.vmap(pack_rows)(rows),
        facts=jnp.stack([where, rows.accepts.astype(jnp.int32)], axis=-1),
        relevant=jax.vmap(_relevant_conditions)(tables, reach),
        root=root,
        dead_end_cost=problems.dead_end_cost,
        optimism=_optimism(problems, config),
        seeds=seeds,
    )


def _optimism(problems: PlanningProblem, config: SearchConfig) -> Float32[Array, "B"]:
    """``SearchConfig.optimism`` of each problem."""
    subgoals = jnp.sum(problems.subgoal_mask, axis=1, dtype=jnp.int32)
    if config.optimism is not None:
        return jnp.full(subgoals.shape, config.optimism, jnp.float32)
    actions = subgoals * jnp.sum(problems.task.edge_mask, axis=1, dtype=jnp.int32) + 1
    return jnp.where(actions <= FEW_ACTIONS, OPTIMISM_OF_FEW, OPTIMISM).astype(jnp.float32)


def _reachable(tables: ActionTables) -> Bool[Array, "Z Z"]:
    """``[z, z']``: ways and attempts can lead from z to z'."""
    rows, states = tables.actions, tables.accepting.shape[0]
    own = jnp.arange(states, dtype=jnp.int32)
    attempts = rows.from_state[:, None] == own[None, :]
    travels = jnp.any(jnp.any(jnp.isfinite(tables.distance), axis=0)[:, :, None] & attempts[None, :, :], axis=1)
    succeeds = jnp.any(attempts[:, :, None] & (rows.to_state[:, None] == own[None, :])[:, None, :], axis=0)
    return transitive_closure(travels | succeeds | (own[:, None] == own[None, :]))


def _relevant_conditions(tables: ActionTables, reach: Bool[Array, "Z Z"]) -> UInt32[Array, "Z W"]:
    """Per state, the conditions of actions that can still be attempted.

    All of them where conditions of several cubes exist: what is known of one may then settle another.
    """
    rows = tables.actions
    attempts = rows.from_state[:, None] == jnp.arange(reach.shape[0], dtype=jnp.int32)[None, :]
    useful = jnp.any(reach[:, None, :] & attempts[None, :, :], axis=2)
    bits = jnp.where(useful[:, :, None], rows.condition_bits[None], jnp.uint32(0))
    combined = jax.lax.reduce(bits, jnp.uint32(0), jax.lax.bitwise_or, (1,))
    return jnp.where(jnp.any(tables.compound_mask), jnp.uint32(0xFFFFFFFF), combined)


@struct.dataclass(kw_only=True)
class Node:
    """Numbers of a new node, as in ``Tree``."""

    q_values: Float32[Array, "*B A"]
    bounds: Float32[Array, "*B A"]
    chances: Float32[Array, "*B A"]
    success_costs: Float32[Array, "*B A"]
    failure_value: Float32[Array, "*B A"]
    success_value: Float32[Array, "*B A"]


def new_node(context: Context, history: History, config: SearchConfig) -> Node:
    """The numbers of one node per row when nothing below it has been seen."""
    inner = dataclasses.replace(history, pending_cost=jnp.zeros_like(history.pending_cost))
    terms = jax.vmap(terms_of_all)(context.tables, inner)
    chance, available = terms.success_probability, terms.available
    if config.mode is SearchMode.AUTHORS_CODE:
        failure_value = success_value = jnp.zeros_like(chance)
        q_values = jnp.where(available, 0.0, jnp.inf).astype(jnp.float32)
        bounds = jnp.where(available, UNTRIED, 1.0).astype(jnp.float32)
    else:
        product_state = history.location * context.tables.accepting.shape[1] + history.state
        failure_value, success_value = guess_outcomes(
            context.rule,
            product_state,
            history.pending_cost,
            available,
            chance,
            terms.success_cost,
            config.guess_failures,
        )
        known = terms.distance + chance * terms.success_cost + (1.0 - chance) * terms.failure_cost
        guessed = chance * success_value + (1.0 - chance) * failure_value
        q_values = jnp.where(available, known + guessed, jnp.inf)
        bounds = jnp.where(available, known + (1.0 - context.optimism[:, None]) * guessed, jnp.inf)
    return Node(
        q_values=q_values,
        bounds=bounds,
        chances=chance,
        success_costs=terms.success_cost,
        failure_value=failure_value,
        success_value=success_value,
    )


def least_values(
    context: Context,
    q_values: Float32[Array, "B A"],
    bounds: Float32[Array, "B A"],
    location: Int32[Array, "B"],
    state: Int32[Array, "B"],
) -> Float32[Array, "B 5"]:
    """``Tree.values`` of new nodes."""
    inside = context.facts[:, :, 0] == (location * context.tables.accepting.shape[1] + state)[:, None]
    least = [
        least_of_each(jnp.where(kind, row, jnp.inf), jnp.inf)
        for row in (q_values, bounds)
        for kind in (~inside, inside)
    ]
    return jnp.stack([*least, jnp.zeros(location.shape, jnp.float32)], axis=-1)


def arrival(
    values: Float32[Array, "*B 5"], pending_cost: Float32[Array, "*B"], dead_end_cost: Float32[Array, "*B"]
) -> tuple[Float32[Array, "*B"], Float32[Array, "*B"]]:
    """Value and bound of a node at which ``pending_cost`` is pending."""

    def least(leave: Array, stay: Array) -> Array:
        best = jnp.minimum(pending_cost + leave, stay)
        return jnp.where(jnp.isinf(best), dead_end_cost, best)

    return least(values[..., 0], values[..., 1]), least(values[..., 2], values[..., 3])


def find(
    context: Context, tree: Tree, history: History
) -> tuple[Int32[Array, "B"], Int32[Array, "B 2"], Int32[Array, "B"]]:
    """Node of a history or ``UNVISITED``, its key, and a free slot of the table (beyond its end where none is)."""
    key = _key(context, history)
    slots = tree.table.shape[1] - WINDOW
    first = key[:, 0] & (slots - 1)
    window = jax.vmap(lambda table, start: jax.lax.dynamic_slice(table, (start, 0), (WINDOW, 3)))(tree.table, first)
    nodes, keys = window[:, :, 2], window[:, :, :2]
    same = jnp.all(keys == key[:, None, :], axis=2) & (nodes != Tree.UNVISITED)
    node = jnp.max(jnp.where(same, nodes, Tree.UNVISITED), axis=1)
    offsets = jnp.arange(WINDOW, dtype=jnp.int32)[None, :]
    empty = jnp.min(jnp.where(nodes == Tree.UNVISITED, offsets, slots + WINDOW), axis=1)
    return node, key, first + empty


def _key(context: Context, history: History) -> Int32[Array, "B 2"]:
    """64 bits that tell histories with different futures apart; the pending cost is not part of it."""
    rows = jnp.arange(history.location.shape[0], dtype=jnp.int32)
    relevant = context.relevant[rows, history.state][:, None, :]
    holds, fails = history.holds & relevant, history.fails & relevant
    number = jnp.arange(holds.shape[1] * holds.shape[2], dtype=jnp.uint32).reshape(1, *holds.shape[1:])
    where = jnp.arange(history.visited.shape[1] * history.visited.shape[2], dtype=jnp.uint32)
    visited = mix(history.visited ^ mix(where.reshape(1, *history.visited.shape[1:]) + jnp.uint32(0x51ED270B)))
    location = mix((history.location * 64 + history.state).astype(jnp.uint32) + jnp.uint32(0x2545F491))
    words = []
    for salt in (0x9E3779B9, 0xC2B2AE3D):
        mixed = mix(mix(holds + number * jnp.uint32(salt)) ^ (fails * jnp.uint32(0x85EBCA77) + jnp.uint32(salt)))
        total = jnp.sum(mixed, axis=(1, 2), dtype=jnp.uint32) + jnp.sum(visited, axis=(1, 2), dtype=jnp.uint32)
        words.append(mix((total ^ location) * jnp.uint32(salt | 1) + location))
    return jax.lax.bitcast_convert_type(jnp.stack(words, axis=1), jnp.int32)
