"""The search of ``potlp_jax.planning.pouct``: many planning problems in lockstep, in fixed memory.

Every row of a batch owns a graph of histories of fixed capacity. One simulation of all rows is

1. a descent that only reads, carries the history along, and records per level what its value depends on,
2. one expansion,
3. a backward pass over the recorded levels that writes.

All reads come before all writes, so that the compiler updates the arrays in place and the cost of a simulation does
not depend on their size.

The way back that is owed never enters a node: an action either leaves the unknown region, and pays what is owed
whatever it is, or goes on inside and pays nothing. A node keeps the least cost of both kinds apart from what is owed,
so histories that know the same at the same place are one node, in whatever order they came to know it.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from enum import StrEnum
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, Shaped, UInt32

from potlp_jax.planning.heuristic import Guess, guess_values
from potlp_jax.planning.history import (
    ActionTables,
    ActionTerms,
    History,
    action_tables,
    initial_history,
    step_row,
    terms_of_all,
)
from potlp_jax.types import NO_ACTION, NO_STATE, NO_SUBGOAL, Status, status_if

WINDOW: int = 8
"""Slots of the table of nodes that a history may be found in. Where all are taken the node is not entered: it is then
not shared between orders, which costs simulations but no correctness."""

UNTRIED: float = 1e18
"""Spread of an action that must be tried before others are tried again; finite, so that an action that is not
available (Q = inf) never becomes NaN."""

_PerAction = TypeVar("_PerAction")


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
      max_depth: actions per descent; one that gets there is cut, valued by what is known of its last node, and
        flagged.
      tree_capacity: nodes per tree, at least 1; None for one more than simulations. A full tree is flagged.
      guess_failures: failures per automaton state that the guess at untried outcomes tells apart.
      mode: how values are made, see ``SearchMode``.
      exploration: weight of the exploration term in the mode ``AUTHORS_CODE``, a cost: the descent takes the least
        ``Q - exploration * sqrt(log(n) / n_a)``; the authors use 50.
    """

    simulations: int = 300
    optimism: float = 0.3
    max_depth: int = 32
    tree_capacity: int | None = None
    guess_failures: int = 16
    mode: SearchMode = SearchMode.EXPECTATION
    exploration: float = 50.0

    def __post_init__(self) -> None:
        for name in ("simulations", "max_depth", "tree_capacity", "guess_failures"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"SearchConfig.{name} is {value}, must be at least 1")
        if not 0 <= self.optimism <= 1:
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

    A node is what is known at a place in a state, in whatever order it came to be known. What is owed there is left out
    of all its numbers.

    Attributes:
      q_values: expected cost of each action at each node, inf where it is not available.
      bounds: what the descent compares: the same with optimistic guesses. In the mode ``AUTHORS_CODE``
        ``1 / sqrt(n_a)``, n_a the descents that took the action.
      chances, success_costs: P_S and R_S of each action, given what is known at the node.
      lost, won: guessed values after each action's failure and success.
      children: node reached by each action after failure and after success, or ``UNVISITED``. Outcomes that satisfy
        the task have no node: their value is 0.
      values: per node the least Q of the actions that leave the unknown region, of those that stay inside, the least
        bound of both kinds, and the descents that went on from here.
      place, state, holds, fails, visited: the node's history, as in ``history.History``.
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
    lost: Float32[Array, "*B N A"]
    won: Float32[Array, "*B N A"]
    children: Int32[Array, "*B N A 2"]
    values: Float32[Array, "*B N 5"]
    place: Int32[Array, "*B N"]
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

    def history(self, node: Int32[Array, "*B"], owed: Float32[Array, "*B"]) -> History:
        """The history of one node of each row, with what is owed there."""
        at = (jnp.arange(self.size.shape[0], dtype=jnp.int32), node) if self.size.ndim else node
        return History(
            place=self.place[at],
            state=self.state[at],
            owed=owed,
            holds=self.holds[at],
            fails=self.fails[at],
            visited=self.visited[at],
        )


@struct.dataclass(kw_only=True)
class Context:
    """What stays the same during a search.

    ``hopeful`` marks the attempts that may succeed at the root; ``packed`` holds all of an action's row of the tables
    (``_pack_rows``); ``facts`` holds per action the number of the (subgoal, z') where it is attempted and whether its
    success satisfies the task; ``relevant`` masks per state the conditions that later choices can depend on.
    """

    tables: ActionTables
    guess: Guess
    hopeful: Bool[Array, "*B S E"]
    packed: UInt32[Array, "*B A n"]
    facts: Int32[Array, "*B A 2"]
    relevant: UInt32[Array, "*B Z W"]
    root: History
    dead_end_cost: Float32[Array, "*B"]
    seeds: UInt32[Array, "*B 2"]


@struct.dataclass(kw_only=True)
class _Node:
    """Numbers of a new node, as in ``Tree``."""

    q_values: Float32[Array, "*B A"]
    bounds: Float32[Array, "*B A"]
    chances: Float32[Array, "*B A"]
    success_costs: Float32[Array, "*B A"]
    lost: Float32[Array, "*B A"]
    won: Float32[Array, "*B A"]


@struct.dataclass(kw_only=True)
class _Descent:
    """One descent of all rows, at ``node`` with ``owed`` owed there, or about to leave the graph by ``action`` and
    ``success`` (``expands``), or at an outcome that satisfies the task (``accepted``).

    The rest are records per level: the node's ``values``; after the child's value ``v`` is known,
    ``Q = base + weight * v``, and likewise the bound from ``base_bound``; ``rival`` and ``low_rival`` are the least Q
    and bound of the node's other actions of the same kind (that leave the unknown region, or that stay inside);
    ``add`` is what to add on the way up: what is owed at the node, in the mode ``AUTHORS_CODE`` the sampled cost of
    the step.
    Levels that a row did not reach hold a node beyond the tree's capacity.
    """

    level: Int32[Array, ""]
    active: Bool[Array, "B"]
    node: Int32[Array, "B"]
    owed: Float32[Array, "B"]
    action: Int32[Array, "B"]
    success: Bool[Array, "B"]
    expands: Bool[Array, "B"]
    accepted: Bool[Array, "B"]
    nodes: Int32[Array, "D B"]
    actions: Int32[Array, "D B"]
    outcomes: Int32[Array, "D B"]
    inside: Bool[Array, "D B"]
    values: Float32[Array, "D B 5"]
    base: Float32[Array, "D B"]
    base_bound: Float32[Array, "D B"]
    weight: Float32[Array, "D B"]
    rival: Float32[Array, "D B"]
    low_rival: Float32[Array, "D B"]
    add: Float32[Array, "D B"]


def new_search(
    structure: Any, leaves: Sequence[Array], seeds: UInt32[Array, "B 2"], config: SearchConfig
) -> tuple[Context, Tree]:
    """Tables of a batch of problems, and graphs of the roots alone."""
    context = prepare(structure, leaves, seeds, config)
    root = jax.vmap(functools.partial(_new_node, config=config))(context, context.root)
    values = _least_values(context, root.q_values, root.bounds, context.root.place, context.root.state)
    batch, actions = root.q_values.shape

    def first(values: Array, fill: float = 0) -> Array:
        shape = (batch, config.capacity + 1, *values.shape[1:])
        return jnp.full(shape, fill, values.dtype).at[:, Tree.ROOT].set(values)

    tree = Tree(
        q_values=first(root.q_values, jnp.inf),
        bounds=first(root.bounds, jnp.inf),
        chances=first(root.chances),
        success_costs=first(root.success_costs),
        lost=first(root.lost),
        won=first(root.won),
        children=jnp.full((batch, config.capacity + 1, actions, 2), Tree.UNVISITED, jnp.int32),
        values=first(values),
        place=first(context.root.place),
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
    return jax.vmap(functools.partial(_prepare_one, structure, failures=config.guess_failures))(leaves, seeds)


def is_open(context: Context, tree: Tree, config: SearchConfig) -> Bool[Array, "B"]:
    """Whether more simulations can change anything."""
    if config.mode is SearchMode.AUTHORS_CODE:
        return jnp.any(jnp.isfinite(tree.q_values[:, Tree.ROOT]), axis=1)
    value, bound = _arrival(tree.values[:, Tree.ROOT], context.root.owed, context.dead_end_cost)
    return value > bound


def simulate(context: Context, tree: Tree, config: SearchConfig) -> Tree:
    """One descent of all rows that are open."""
    descent = _descend(context, tree, config)
    tree, child, value, bound = _expand(context, tree, descent, config)
    return _back_up(tree, descent, child, value, bound, config)


@struct.dataclass(kw_only=True)
class Choice:
    """What to do at the root, as in ``pouct.Plan``."""

    action: Int32[Array, "*B"]
    subgoal: Int32[Array, "*B"]
    from_state: Int32[Array, "*B"]
    to_state: Int32[Array, "*B"]
    value: Float32[Array, "*B"]
    gap: Float32[Array, "*B"]
    status: UInt32[Array, "*B"]


def choose(context: Context, tree: Tree, config: SearchConfig) -> Choice:
    """The action of least Q at the root, the most visited one in the mode ``AUTHORS_CODE``; ties by lowest index."""
    q_values, finish = tree.q_values[:, Tree.ROOT], tree.q_values.shape[2] - 1
    index = jnp.arange(finish + 1, dtype=jnp.int32)[None, :]
    score = q_values
    if config.mode is SearchMode.AUTHORS_CODE:
        score = jnp.where(jnp.isinf(q_values), jnp.inf, -tree.root_visits.astype(jnp.float32))
    least = jnp.min(score, axis=1)
    available = jnp.any(jnp.isfinite(q_values), axis=1)
    action = jnp.min(jnp.where(score <= least[:, None], index, finish), axis=1)
    attempts = available & (action != finish)
    batch = jnp.arange(action.shape[0], dtype=jnp.int32)
    row = _unpack_rows(context.packed[batch, action], context.tables.actions)
    accepted = jnp.take_along_axis(context.tables.accepting, context.root.state[:, None], axis=1)[:, 0]
    value = jnp.where(available, q_values[batch, action], context.dead_end_cost)
    value = jnp.where(accepted, 0.0, value)
    _, bound = _arrival(tree.values[:, Tree.ROOT], context.root.owed, context.dead_end_cost)
    if config.mode is SearchMode.AUTHORS_CODE:
        bound = jnp.full_like(value, -jnp.inf)
    gap = (value - bound) / jnp.where(value > 0, value, 1.0)
    return Choice(
        action=jnp.where(available, action, NO_ACTION),
        subgoal=jnp.where(attempts, row.subgoal, NO_SUBGOAL),
        from_state=jnp.where(attempts, row.from_state, NO_STATE),
        to_state=jnp.where(attempts, row.to_state, NO_STATE),
        value=value,
        gap=jnp.where(available, gap, 0.0),
        status=_status_of_rows(accepted, Status.ACCEPTING_ROOT)
        | _status_of_rows(~available & ~accepted, Status.DEAD_END),
    )


def _prepare_one(structure: Any, leaves: Sequence[Array], seed: UInt32[Array, "2"], failures: int) -> Context:
    problem = jax.tree.unflatten(structure, leaves)
    tables, root = action_tables(problem), initial_history(problem)
    terms = terms_of_all(tables, root)
    guess = guess_values(problem, tables, terms.success_probability, terms.success_cost, failures)
    rows, states = tables.actions, tables.accepting.shape[0]
    where = rows.subgoal * states + rows.from_state
    return Context(
        tables=tables,
        guess=guess,
        hopeful=_by_subgoal(terms.success_probability, problem.subgoal_count) > 0,
        packed=_pack_rows(rows),
        facts=jnp.stack([where, rows.accepts.astype(jnp.int32)], axis=-1),
        relevant=_relevant_conditions(tables),
        root=root,
        dead_end_cost=problem.dead_end_cost,
        seeds=seed,
    )


def _by_subgoal(values: Float32[Array, "A"], subgoals: int) -> Float32[Array, "S E"]:
    """Values of all actions but finish, by subgoal and edge."""
    return values[:-1].reshape(subgoals, (values.shape[0] - 1) // max(subgoals, 1))


def _relevant_conditions(tables: ActionTables) -> UInt32[Array, "Z W"]:
    """Per state, the conditions of actions that can still be attempted.

    All of them where conditions of several cubes exist: what is known of one may then settle another.
    """
    rows, states = tables.actions, tables.accepting.shape[0]
    own = jnp.arange(states, dtype=jnp.int32)
    attempts = rows.from_state[:, None] == own[None, :]
    travels = jnp.any(jnp.any(jnp.isfinite(tables.distance), axis=0)[:, :, None] & attempts[None, :, :], axis=1)
    succeeds = jnp.any(attempts[:, :, None] & (rows.to_state[:, None] == own[None, :])[:, None, :], axis=0)
    reach = travels | succeeds | (own[:, None] == own[None, :])
    for _ in range(max(states - 1, 1).bit_length()):
        reach = jnp.any(reach[:, :, None] & reach[None, :, :], axis=1)
    useful = jnp.any(reach[:, None, :] & attempts[None, :, :], axis=2)
    bits = jnp.where(useful[:, :, None], rows.condition_bits[None], jnp.uint32(0))
    combined = jax.lax.reduce(bits, jnp.uint32(0), jax.lax.bitwise_or, (1,))
    return jnp.where(jnp.any(tables.compound_mask), jnp.uint32(0xFFFFFFFF), combined)


def _new_node(context: Context, history: History, config: SearchConfig) -> _Node:
    """The numbers of one node when nothing below it has been seen."""
    terms = terms_of_all(context.tables, dataclasses.replace(history, owed=jnp.float32(0.0)))
    chance, available = terms.success_probability, terms.available
    lost, won = _guesses(context, terms)
    if config.mode is SearchMode.AUTHORS_CODE:
        q_values = jnp.where(available, 0.0, jnp.inf).astype(jnp.float32)
        bounds = jnp.where(available, UNTRIED, 1.0).astype(jnp.float32)
    else:
        known = terms.distance + chance * terms.success_cost + (1.0 - chance) * terms.failure_cost
        guessed = chance * won + (1.0 - chance) * lost
        q_values = jnp.where(available, known + guessed, jnp.inf)
        bounds = jnp.where(available, known + (1.0 - config.optimism) * guessed, jnp.inf)
    return _Node(q_values=q_values, bounds=bounds, chances=chance, success_costs=terms.success_cost, lost=lost, won=won)


def _least_values(
    context: Context,
    q_values: Float32[Array, "B A"],
    bounds: Float32[Array, "B A"],
    place: Int32[Array, "B"],
    state: Int32[Array, "B"],
) -> Float32[Array, "B 5"]:
    """``Tree.values`` of new nodes."""
    inside = context.facts[:, :, 0] == (place * context.tables.accepting.shape[1] + state)[:, None]
    least = [
        _least_of_each(jnp.where(kind, row, jnp.inf), jnp.inf)
        for row in (q_values, bounds)
        for kind in (~inside, inside)
    ]
    return jnp.stack([*least, jnp.zeros(place.shape, jnp.float32)], axis=-1)


def _guesses(context: Context, terms: ActionTerms) -> tuple[Float32[Array, "A"], Float32[Array, "A"]]:
    """Guessed values after failure and after success of every action of one node; 0 after finish."""
    subgoals = context.hopeful.shape[0]

    def by_subgoal(values: Array) -> Array:
        return _by_subgoal(values, subgoals)

    def by_action(values: Float32[Array, "S E"]) -> Float32[Array, "A"]:
        return jnp.append(values.reshape(-1), jnp.float32(0.0))

    failed = context.hopeful & (by_subgoal(terms.success_probability) == 0)
    failures = context.guess.count_by_state(jnp.sum(failed, axis=0, dtype=jnp.int32))
    lost = context.guess.after_failure(failures, by_subgoal(terms.failure_cost))
    won = context.guess.after_success(failures, by_subgoal(terms.success_cost))
    return by_action(lost), by_action(won)


def _arrival(
    values: Float32[Array, "*B 5"], owed: Float32[Array, "*B"], dead_end_cost: Float32[Array, "*B"]
) -> tuple[Float32[Array, "*B"], Float32[Array, "*B"]]:
    """Value and bound of a node at which ``owed`` is owed."""

    def least(leave: Array, stay: Array) -> Array:
        best = jnp.minimum(owed + leave, stay)
        return jnp.where(jnp.isinf(best), dead_end_cost, best)

    return least(values[..., 0], values[..., 1]), least(values[..., 2], values[..., 3])


def _descend(context: Context, tree: Tree, config: SearchConfig) -> _Descent:
    """Follow the graph from the root to an outcome not yet expanded, or to the rollout's end. Reads only."""
    batch, places, actions = tree.q_values.shape
    rows, capacity = jnp.arange(batch, dtype=jnp.int32), places - 1
    index = jnp.arange(actions, dtype=jnp.int32)[None, :]
    states, depth = context.tables.accepting.shape[1], config.max_depth
    authors = config.mode is SearchMode.AUTHORS_CODE

    def goes_on(descent: _Descent) -> Bool[Array, ""]:
        return jnp.any(descent.active) & (descent.level < depth)

    def descend(descent: _Descent) -> _Descent:
        def record(array: Array, new: Array) -> Array:
            return jax.lax.dynamic_update_index_in_dim(array, new, descent.level, 0)

        node, level = descent.node, descent.level
        # Without the barrier the compiler would look every entry up again for each of the minima below.
        q_values, bounds, values = jax.lax.optimization_barrier(
            (tree.q_values[rows, node], tree.bounds[rows, node], tree.values[rows, node])
        )
        inside = context.facts[:, :, 0] == (tree.place[rows, node] * states + tree.state[rows, node])[:, None]
        debt = jnp.where(inside, 0.0, descent.owed[:, None])
        if authors:
            width = config.exploration * jnp.sqrt(jnp.log(jnp.maximum(values[:, 4] + 1.0, 2.0)))
            score = q_values + debt - width[:, None] * bounds
        else:
            score = bounds + debt
        least = _least_of_each(score, jnp.inf)
        # Minimum, then the first index that attains it: faster than argmin, and ties go to the lowest index.
        action = _least_of_each(jnp.where(score <= least[:, None], index, actions - 1), actions - 1)
        moves = descent.active & ~jnp.isinf(least)
        chosen = index == action[:, None]
        goes_inside = inside[rows, action]
        rivals = (inside == goes_inside[:, None]) & ~chosen
        others = [_least_of_each(jnp.where(rivals, row, jnp.inf), jnp.inf) for row in (q_values, bounds)]
        accepts = context.facts[rows, action, 1] != 0
        children = tree.children[rows, node, action]
        way = context.tables.distance[rows, tree.place[rows, node], tree.state[rows, node], action]
        odds = _Odds(
            way=jnp.where(goes_inside, 0.0, way),
            chance=tree.chances[rows, node, action],
            success_cost=tree.success_costs[rows, node, action],
            failure_cost=context.tables.actions.failure_cost[rows, action],
            lost=tree.lost[rows, node, action],
            won=tree.won[rows, node, action],
        )
        if authors:
            success = _uniform(context.seeds, tree.simulations, level) < odds.chance
            step = _sampled_step(odds, success, q_values[rows, action], bounds[rows, action])
            step = dataclasses.replace(step, add=step.add + jnp.where(goes_inside, 0.0, descent.owed))
        else:
            step = _expected_step(context, tree, odds, children, accepts, config)
            step = dataclasses.replace(step, add=descent.owed)
        outcome = step.success.astype(jnp.int32)
        child = children[rows, outcome]
        finished = moves & step.success & accepts
        expands = moves & ~finished & (child == Tree.UNVISITED)
        goes_deeper = moves & ~finished & ~expands
        return _Descent(
            level=level + 1,
            active=goes_deeper,
            node=jnp.where(goes_deeper, child, node),
            owed=jnp.where(goes_deeper | expands, step.owed, descent.owed),
            action=jnp.where(moves, action, descent.action),
            success=jnp.where(moves, step.success, descent.success),
            expands=descent.expands | expands,
            accepted=descent.accepted | finished,
            nodes=record(descent.nodes, jnp.where(moves, node, capacity)),
            actions=record(descent.actions, action),
            outcomes=record(descent.outcomes, outcome),
            inside=record(descent.inside, goes_inside),
            values=record(descent.values, values),
            base=record(descent.base, step.base),
            base_bound=record(descent.base_bound, step.base_bound),
            weight=record(descent.weight, step.weight),
            rival=record(descent.rival, others[0]),
            low_rival=record(descent.low_rival, others[1]),
            add=record(descent.add, step.add),
        )

    integers, floats = jnp.zeros((depth, batch), jnp.int32), jnp.zeros((depth, batch), jnp.float32)
    nowhere = jnp.zeros((batch,), jnp.bool_)
    start = _Descent(
        level=jnp.int32(0),
        active=is_open(context, tree, config),
        node=jnp.full((batch,), Tree.ROOT, jnp.int32),
        owed=context.root.owed,
        action=jnp.zeros((batch,), jnp.int32),
        success=nowhere,
        expands=nowhere,
        accepted=nowhere,
        nodes=jnp.full((depth, batch), capacity, jnp.int32),
        actions=integers,
        outcomes=integers,
        inside=jnp.zeros((depth, batch), jnp.bool_),
        values=jnp.zeros((depth, batch, 5), jnp.float32),
        base=floats,
        base_bound=floats,
        weight=floats,
        rival=floats,
        low_rival=floats,
        add=floats,
    )
    return jax.lax.while_loop(goes_on, descend, start)


@struct.dataclass(kw_only=True)
class _Odds:
    """One action of each row: D without what is owed, P_S, R_S, R_F, and the guessed values after both outcomes."""

    way: Float32[Array, "B"]
    chance: Float32[Array, "B"]
    success_cost: Float32[Array, "B"]
    failure_cost: Float32[Array, "B"]
    lost: Float32[Array, "B"]
    won: Float32[Array, "B"]


@struct.dataclass(kw_only=True)
class _Step:
    """An outcome to follow, what is owed after it, and how the action depends on it (see ``_Descent``)."""

    success: Bool[Array, "B"]
    owed: Float32[Array, "B"]
    base: Float32[Array, "B"]
    base_bound: Float32[Array, "B"]
    weight: Float32[Array, "B"]
    add: Float32[Array, "B"]


def _expected_step(
    context: Context,
    tree: Tree,
    odds: _Odds,
    children: Int32[Array, "B 2"],
    accepts: Bool[Array, "B"],
    config: SearchConfig,
) -> _Step:
    """Follow the outcome to which the action owes more of the gap between its Q and its bound."""
    chance = odds.chance
    won, won_bound = _outcome(context, tree, children[:, 1], odds.won, odds.success_cost, config)
    lost, lost_bound = _outcome(context, tree, children[:, 0], odds.lost, odds.failure_cost, config)
    success = chance * (won - won_bound) >= (1.0 - chance) * (lost - lost_bound)
    # Nothing is to be learnt from satisfying the task, and a certain success cannot fail.
    success = (success & ~accepts) | (chance >= 1.0)
    known = odds.way + chance * odds.success_cost + (1.0 - chance) * odds.failure_cost
    weight, rest = jnp.where(success, chance, 1.0 - chance), jnp.where(success, 1.0 - chance, chance)
    return _Step(
        success=success,
        owed=jnp.where(success, odds.success_cost, odds.failure_cost),
        base=known + rest * jnp.where(success, lost, won),
        base_bound=known + rest * jnp.where(success, lost_bound, won_bound),
        weight=weight,
        add=jnp.zeros_like(weight),
    )


def _sampled_step(
    odds: _Odds, success: Bool[Array, "B"], q_value: Float32[Array, "B"], spread: Float32[Array, "B"]
) -> _Step:
    """The sampled outcome; Q is the mean of the sampled costs."""
    owed = jnp.where(success, odds.success_cost, odds.failure_cost)
    cost = odds.way + owed
    count = jnp.round(1.0 / (spread * spread)) + 1.0
    return _Step(
        success=success,
        owed=owed,
        base=q_value + (cost - q_value) / count,
        base_bound=jax.lax.rsqrt(count),
        weight=1.0 / count,
        add=cost,
    )


def _outcome(
    context: Context,
    tree: Tree,
    child: Int32[Array, "B"],
    guessed: Float32[Array, "B"],
    owed: Float32[Array, "B"],
    config: SearchConfig,
) -> tuple[Float32[Array, "B"], Float32[Array, "B"]]:
    """Value and bound of an outcome: those of its node, or by the guess where there is none."""
    rows = jnp.arange(child.shape[0], dtype=jnp.int32)
    value, bound = _arrival(tree.values[rows, jnp.maximum(child, 0)], owed, context.dead_end_cost)
    new = child == Tree.UNVISITED
    return jnp.where(new, guessed, value), jnp.where(new, (1.0 - config.optimism) * guessed, bound)


def _expand(
    context: Context, tree: Tree, descent: _Descent, config: SearchConfig
) -> tuple[Tree, Int32[Array, "B"], Float32[Array, "B"], Float32[Array, "B"]]:
    """Add the node that the descent reached, unless another order of the same events has led there before.

    Returns the tree, the last action's child (``UNVISITED`` where it has none), and the value and bound from which to
    back up.
    """
    rows = jnp.arange(tree.size.shape[0], dtype=jnp.int32)
    capacity = tree.q_values.shape[1] - 1
    row = _unpack_rows(context.packed[rows, descent.action], context.tables.actions)
    parent = tree.history(descent.node, descent.owed)
    history = jax.vmap(step_row)(context.tables, row, parent, descent.success)
    node = jax.vmap(functools.partial(_new_node, config=config))(context, history)
    known, key, slot = _find(context, tree, history)
    if config.mode is SearchMode.AUTHORS_CODE:
        known = jnp.full_like(known, Tree.UNVISITED)
    has_room = tree.size < capacity
    is_new = descent.expands & (known == Tree.UNVISITED)
    added = is_new & has_room
    arrived = tree.values[rows, jnp.where(descent.expands, jnp.maximum(known, 0), descent.node)]
    entry = jnp.concatenate([key, tree.size[:, None]], axis=1)
    # A node that is not added goes to the spare place behind the others.
    index = jnp.where(is_new, tree.size, capacity)

    def write(array: Array, new: Array, index: Array = index) -> Array:
        return array.at[rows, index].set(new, mode="drop", unique_indices=True)

    tree = dataclasses.replace(
        tree,
        q_values=write(tree.q_values, node.q_values),
        bounds=write(tree.bounds, node.bounds),
        chances=write(tree.chances, node.chances),
        success_costs=write(tree.success_costs, node.success_costs),
        lost=write(tree.lost, node.lost),
        won=write(tree.won, node.won),
        place=write(tree.place, history.place),
        state=write(tree.state, history.state),
        holds=write(tree.holds, history.holds),
        fails=write(tree.fails, history.fails),
        visited=write(tree.visited, history.visited),
        table=write(tree.table, entry, jnp.where(added, slot, tree.table.shape[1])),
        size=tree.size + added.astype(jnp.int32),
        status=tree.status
        | _status_of_rows(is_new & ~has_room, Status.TREE_OVERFLOW)
        | _status_of_rows(descent.active, Status.DEPTH_OVERFLOW),
    )
    # Read back what was written: minima over rows still to be computed would compute them again and again.
    values = _least_values(context, tree.q_values[rows, index], tree.bounds[rows, index], history.place, history.state)
    tree = dataclasses.replace(tree, values=write(tree.values, values))
    values = jnp.where(is_new[:, None], values, arrived)
    value, bound = _arrival(values, descent.owed, context.dead_end_cost)
    if config.mode is SearchMode.AUTHORS_CODE:
        dead = jnp.isinf(jnp.minimum(values[:, 0], values[:, 1]))
        value = jnp.where(dead, context.dead_end_cost, 0.0)
    value, bound = (jnp.where(descent.accepted, 0.0, number) for number in (value, bound))
    child = jnp.where(added, tree.size - 1, jnp.where(descent.expands, known, Tree.UNVISITED))
    return tree, child, value, bound


def _back_up(
    tree: Tree,
    descent: _Descent,
    child: Int32[Array, "B"],
    value: Float32[Array, "B"],
    bound: Float32[Array, "B"],
    config: SearchConfig,
) -> Tree:
    """From the leaf to the root: Q of the actions taken, and the values of their nodes. Writes only."""
    batch, places, actions = tree.q_values.shape
    rows, capacity = jnp.arange(batch, dtype=jnp.int32), places - 1
    authors = config.mode is SearchMode.AUTHORS_CODE

    def ascend(carry):
        level, value, bound, tree = carry
        node, action, inside = descent.nodes[level], descent.actions[level], descent.inside[level]
        leave, stay, low_leave, low_stay, count = descent.values[level].T
        weight, add = descent.weight[level], descent.add[level]
        taken = node < capacity
        q_value = descent.base[level] + weight * value
        low = descent.base_bound[level] + (0.0 if authors else weight * bound)
        least, low_least = jnp.minimum(descent.rival[level], q_value), jnp.minimum(descent.low_rival[level], low)
        leave, low_leave = jnp.where(inside, leave, least), jnp.where(inside, low_leave, low_least)
        stay, low_stay = jnp.where(inside, least, stay), jnp.where(inside, low_least, low_stay)
        up = value + add if authors else jnp.minimum(add + leave, stay)
        value = jnp.where(taken, up, value)
        bound = jnp.where(taken, jnp.minimum(add + low_leave, low_stay), bound)
        numbers = jnp.stack([leave, stay, low_leave, low_stay, count + 1.0], axis=-1)

        def write(array: Array, new: Array, *index: Array) -> Array:
            return array.at[rows, node, *index].set(new, mode="drop", unique_indices=True)

        tree = dataclasses.replace(
            tree,
            q_values=write(tree.q_values, q_value, action),
            bounds=write(tree.bounds, low, action),
            values=write(tree.values, numbers),
        )
        return level - 1, value, bound, tree

    tree = jax.lax.while_loop(lambda carry: carry[0] >= 0, ascend, (descent.level - 1, value, bound, tree))[3]
    moved = descent.nodes[0] < capacity
    parent = jnp.where(child == Tree.UNVISITED, capacity, descent.node)
    outcome = descent.success.astype(jnp.int32)
    first = jnp.where(moved, descent.actions[0], actions)
    return dataclasses.replace(
        tree,
        children=tree.children.at[rows, parent, descent.action, outcome].set(child, mode="drop", unique_indices=True),
        root_visits=tree.root_visits.at[rows, first].add(1, mode="drop", unique_indices=True),
        simulations=tree.simulations + moved.astype(jnp.int32),
        steps=tree.steps + jnp.sum(descent.nodes < capacity, axis=0, dtype=jnp.int32),
    )


def _find(
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
    """64 bits that tell histories with different futures apart; what is owed is not part of it."""
    rows = jnp.arange(history.place.shape[0], dtype=jnp.int32)
    relevant = context.relevant[rows, history.state][:, None, :]
    holds, fails = history.holds & relevant, history.fails & relevant
    number = jnp.arange(holds.shape[1] * holds.shape[2], dtype=jnp.uint32).reshape(1, *holds.shape[1:])
    where = jnp.arange(history.visited.shape[1] * history.visited.shape[2], dtype=jnp.uint32)
    visited = _mix(history.visited ^ _mix(where.reshape(1, *history.visited.shape[1:]) + jnp.uint32(0x51ED270B)))
    place = _mix((history.place * 64 + history.state).astype(jnp.uint32) + jnp.uint32(0x2545F491))
    words = []
    for salt in (0x9E3779B9, 0xC2B2AE3D):
        mixed = _mix(_mix(holds + number * jnp.uint32(salt)) ^ (fails * jnp.uint32(0x85EBCA77) + jnp.uint32(salt)))
        total = jnp.sum(mixed, axis=(1, 2), dtype=jnp.uint32) + jnp.sum(visited, axis=(1, 2), dtype=jnp.uint32)
        words.append(_mix((total ^ place) * jnp.uint32(salt | 1) + place))
    return jax.lax.bitcast_convert_type(jnp.stack(words, axis=1), jnp.int32)


def _pack_rows(rows: Any) -> UInt32[Array, "A n"]:
    """All that a pytree of per-action arrays says of an action, as one row of bits: one lookup instead of many."""
    columns = []
    for leaf in jax.tree.leaves(rows):
        values = leaf.astype(jnp.uint32) if leaf.dtype == jnp.bool_ else leaf
        columns.append(jax.lax.bitcast_convert_type(values, jnp.uint32).reshape(leaf.shape[0], -1))
    return jnp.concatenate(columns, axis=1)


def _unpack_rows(packed: UInt32[Array, "B n"], like: _PerAction) -> _PerAction:
    """Inverse of ``_pack_rows`` for one action per batch entry; ``like`` is the batch of what was packed."""
    leaves, structure = jax.tree.flatten(like)
    rows, start = [], 0
    for leaf in leaves:
        shape = leaf.shape[2:]
        size = math.prod(shape)
        bits = packed[:, start : start + size].reshape(-1, *shape)
        rows.append(bits != 0 if leaf.dtype == jnp.bool_ else jax.lax.bitcast_convert_type(bits, leaf.dtype))
        start += size
    return jax.tree.unflatten(structure, rows)


def _uniform(
    seeds: UInt32[Array, "B 2"], simulation: Int32[Array, "B"], level: Int32[Array, ""]
) -> Float32[Array, "B"]:
    """Uniform numbers in [0, 1) from a counter: 24 bits of a twice mixed hash of (seed, simulation, level)."""
    counter = simulation.astype(jnp.uint32) * jnp.uint32(0x9E3779B9) + level.astype(jnp.uint32) * jnp.uint32(0x85EBCA77)
    bits = _mix(_mix(seeds[:, 0] ^ counter) + seeds[:, 1])
    return (bits >> 8).astype(jnp.float32) * jnp.float32(2.0**-24)


def _mix(bits: UInt32[Array, "*N"]) -> UInt32[Array, "*N"]:
    """Finaliser of MurmurHash3: every input bit affects every output bit."""
    bits = (bits ^ (bits >> 16)) * jnp.uint32(0x85EBCA6B)
    bits = (bits ^ (bits >> 13)) * jnp.uint32(0xC2B2AE35)
    return bits ^ (bits >> 16)


def _status_of_rows(flags: Bool[Array, "B"], status: Status) -> UInt32[Array, "B"]:
    return jax.vmap(lambda flag: status_if(flag, status))(flags)


def _least_of_each(values: Shaped[Array, "B A"], worst: int | float) -> Shaped[Array, "B"]:
    """Minimum over actions; ``worst`` is not less than any value."""
    return jnp.min(_combine(jnp.minimum, values, worst), axis=1)


def _combine(
    operation: Callable[[Array, Array], Array], values: Shaped[Array, "B A"], neutral: int | float
) -> Shaped[Array, "B w"]:
    """Reduce over actions up to a few columns, slice by slice: on CPU XLA vectorises that, but not whole rows."""
    width = 8 * max(1, -(-values.shape[1] // 128))
    count = -(-values.shape[1] // width)
    padded = jnp.pad(values, ((0, 0), (0, count * width - values.shape[1])), constant_values=neutral)
    return functools.reduce(operation, [padded[:, i * width : (i + 1) * width] for i in range(count)])


def _align(flags: Bool[Array, "B"], like: Array) -> Bool[Array, "B ..."]:
    """Give flags the rank of ``like``."""
    return flags.reshape(flags.shape + (1,) * (like.ndim - 1))
