"""PO-UCT over the histories of a planning problem (paper section III-C), many problems in lockstep.

Every row of a batch owns a tree of fixed capacity. One simulation of all rows is

1. a descent that only reads the trees, carries the history along, and records per level what its value depends on,
2. one expansion,
3. a backward pass over the recorded levels that writes.

All reads come before all writes, so that the compiler updates the trees in place and the cost of a simulation does
not depend on their size. ``jax.vmap`` of the unbatched functions is routed to this kernel, also nested.

What differs from PO-UCT as published: P_S is known, so backups are expectations over both outcomes instead of sample
means, and the value of a node is the minimum over its actions (Eq. 3 itself, with a guess at outcomes not yet
sampled). A fully expanded tree has the exact value.

References:
  Bradley et al., Learning and Planning for Temporally Extended Tasks in Unknown Environments, ICRA 2021, III-C.
  Silver and Veness, Monte-Carlo Planning in Large POMDPs, NIPS 2010.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, Key, PRNGKeyArray, Shaped, UInt32

from potlp_jax.planning.heuristic import Guess, guess_values
from potlp_jax.planning.history import (
    ActionRow,
    ActionTables,
    ActionTerms,
    History,
    action_tables,
    action_terms,
    distance_of,
    initial_history,
    knowledge_of,
    knowledge_terms,
    step,
    step_row,
    terms_of_all,
)
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.types import NO_ACTION, NO_STATE, NO_SUBGOAL, Status, status_if


@dataclasses.dataclass(frozen=True)
class SearchConfig:
    """Settings of the search.

    Attributes:
      simulations: descents per search; each adds at most one node.
      exploration: weight of the exploration term in units of the root's guessed value, so that the unit of cost does
        not matter: the descent takes the least ``Q - exploration * V_root * sqrt(log(n) / (1 + n_a))``.
      max_depth: actions per descent; one that gets there is cut, valued by what is known of its last node, and
        flagged.
      tree_capacity: nodes per tree, at least 1; None for one more than simulations. A full tree is flagged.
      guess_sweeps: attempts that the guess at untried outcomes looks ahead.
    """

    simulations: int = 1000
    exploration: float = 0.03
    max_depth: int = 32
    tree_capacity: int | None = None
    guess_sweeps: int = 16

    def __post_init__(self) -> None:
        for name in ("simulations", "max_depth", "tree_capacity", "guess_sweeps"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"SearchConfig.{name} is {value}, must be at least 1")
        if not self.exploration >= 0:
            raise ValueError(f"SearchConfig.exploration is {self.exploration}, must not be negative")

    @property
    def capacity(self) -> int:
        """Nodes per tree."""
        return self.simulations + 1 if self.tree_capacity is None else self.tree_capacity


@struct.dataclass(kw_only=True)
class Plan:
    """Answer to one planning problem.

    Attributes:
      action: ``s * E + e``, ``S * E`` for finish, or ``NO_ACTION`` (``status`` tells why).
      subgoal: the action's subgoal, ``NO_SUBGOAL`` for finish and for none.
      from_state: state z' in which to reach the subgoal, ``NO_STATE`` for finish and for none.
      to_state: state z'' to try for beyond it, ``NO_STATE`` for finish and for none.
      value: expected cost: the least Q; 0 where the task is satisfied, the dead-end cost at a dead end.
      q_values: expected cost of each action, inf where it is not available.
      visits: simulations that began with each action.
      status: bits of ``types.Status``.
    """

    action: Int32[Array, "*B"]
    subgoal: Int32[Array, "*B"]
    from_state: Int32[Array, "*B"]
    to_state: Int32[Array, "*B"]
    value: Float32[Array, "*B"]
    q_values: Float32[Array, "*B A"]
    visits: Int32[Array, "*B A"]
    status: UInt32[Array, "*B"]


@struct.dataclass(kw_only=True)
class Tree:
    """Search trees; node 0 is the root. A node is a history; histories are not stored but replayed (``tree_top``).

    Attributes:
      q_values: expected cost of each action at each node, inf where it is not available.
      visits: descents that took each action at each node.
      children: node reached by action ``a`` with outcome ``o`` (0 failure, 1 success) at index ``2 * a + o``, or
        ``UNVISITED``. Outcomes that satisfy the task have no node: their value is 0.
      values: least Q of each node, the dead-end cost where no action is available.
      size: nodes in use.
      status: bits of ``types.Status``.
    """

    q_values: Float32[Array, "*B N A"]
    visits: Int32[Array, "*B N A"]
    children: Int32[Array, "*B N 2*A"]
    values: Float32[Array, "*B N"]
    size: Int32[Array, "*B"]
    status: UInt32[Array, "*B"]

    ROOT = 0
    UNVISITED = -1


def plan_actions(problem: PlanningProblem, key: PRNGKeyArray, config: SearchConfig = SearchConfig()) -> Plan:
    """Search one problem for the action of least expected cost (paper section III-C).

    Pure; jit with ``config`` static. ``jax.vmap`` over ``problem``, ``key`` or both runs the rows in lockstep. The
    result depends on the problem, the key and the configuration alone, not on padding or on other rows of a batch.
    Ties go to the lowest index. A root without available action, or satisfied, is flagged in ``status``.
    """
    return search_tree(problem, key, config)[0]


def search_tree(
    problem: PlanningProblem, key: PRNGKeyArray, config: SearchConfig = SearchConfig()
) -> tuple[Plan, Tree]:
    """``plan_actions`` together with the searched tree."""
    leaves, structure = jax.tree.flatten(problem)
    arrays = _lockstep(structure, config)(_seed(key)[None], *[leaf[None] for leaf in leaves])
    return _as_result([array[0] for array in arrays])


def search(
    problems: PlanningProblem, keys: Key[Array, "B"], config: SearchConfig = SearchConfig()
) -> tuple[Plan, Tree]:
    """``search_tree`` for a batch: every leaf of ``problems``, and ``keys``, has the same leading axis B."""
    leaves, structure = jax.tree.flatten(problems)
    return _as_result(_lockstep(structure, config)(jax.vmap(_seed)(keys), *leaves))


_PerAction = TypeVar("_PerAction")
_PLAN_FIELDS = tuple(field.name for field in dataclasses.fields(Plan))
_TREE_FIELDS = tuple(field.name for field in dataclasses.fields(Tree))


def _as_result(arrays: Sequence[Array]) -> tuple[Plan, Tree]:
    plan, tree = arrays[: len(_PLAN_FIELDS)], arrays[len(_PLAN_FIELDS) :]
    return Plan(**dict(zip(_PLAN_FIELDS, plan, strict=True))), Tree(**dict(zip(_TREE_FIELDS, tree, strict=True)))


def _seed(key: PRNGKeyArray) -> UInt32[Array, "2"]:
    """What the search's own counter-based generator starts from."""
    return jax.random.bits(key, (2,), jnp.uint32)


@functools.lru_cache(maxsize=64)
def _lockstep(structure: Any, config: SearchConfig) -> Any:
    """The kernel on flat lists of arrays with a leading batch axis; vmap merges its own axis into that one."""

    @jax.custom_batching.custom_vmap
    def kernel(seeds, *leaves):
        plan, tree = _search_batch(structure, leaves, seeds, config)
        return [getattr(plan, name) for name in _PLAN_FIELDS] + [getattr(tree, name) for name in _TREE_FIELDS]

    @kernel.def_vmap
    def merge_axes(axis_size, in_batched, *arrays):
        full = [
            array if batched else jnp.broadcast_to(array[None], (axis_size, *array.shape))
            for array, batched in zip(arrays, in_batched, strict=True)
        ]
        rows = full[0].shape[0] * full[0].shape[1]
        results = kernel(*[array.reshape(rows, *array.shape[2:]) for array in full])
        split = [result.reshape(axis_size, rows // max(axis_size, 1), *result.shape[1:]) for result in results]
        return split, [True] * len(split)

    return kernel


@struct.dataclass(kw_only=True)
class _Descent:
    """One descent of all rows. ``history`` is that of ``node``, or of the leaf to be expanded below it at ``branch`` of
    ``parent`` (beyond the tree's capacity where none is). ``leaf_value`` is what the tree knows of ``node``.

    ``nodes``, ``actions``, ``base``, ``weight``, ``others`` are records per level: after the child's value ``v`` is
    known, ``Q(node, action) = base + weight * v`` and the node's value is the lesser of that and ``others``, the least
    Q of its other actions. Levels that a row did not reach hold a node beyond the tree's capacity.
    """

    level: Int32[Array, ""]
    active: Bool[Array, "B"]
    node: Int32[Array, "B"]
    history: History
    leaf_value: Float32[Array, "B"]
    parent: Int32[Array, "B"]
    branch: Int32[Array, "B"]
    nodes: Int32[Array, "D B"]
    actions: Int32[Array, "D B"]
    counts: Int32[Array, "D B"]
    base: Float32[Array, "D B"]
    weight: Float32[Array, "D B"]
    others: Float32[Array, "D B"]


@struct.dataclass(kw_only=True)
class _Context:
    """What stays the same during a search; ``scale`` is the weight of exploration in units of cost, ``packed`` holds
    what a descent needs to know of an action in one row (``_pack_rows``)."""

    tables: ActionTables
    guess: Guess
    packed: UInt32[Array, "*B A n"]
    root: History
    dead_end_cost: Float32[Array, "*B"]
    scale: Float32[Array, "*B"]
    seeds: UInt32[Array, "*B 2"]


@functools.partial(jax.jit, static_argnames=("structure", "config"))
def _search_batch(
    structure: Any, leaves: Sequence[Array], seeds: UInt32[Array, "B 2"], config: SearchConfig
) -> tuple[Plan, Tree]:
    """The search; ``leaves`` are those of a problem, with a leading batch axis."""
    prepare = jax.vmap(functools.partial(_prepare, structure, sweeps=config.guess_sweeps))
    context, q_values, values = prepare(leaves, seeds)
    context = dataclasses.replace(context, scale=jnp.float32(config.exploration) * values)

    def simulate(index, tree):
        descent = _descend(context, tree, index, config)
        tree, leaf_value = _expand(context, tree, descent)
        return _back_up(tree, descent, leaf_value)

    tree = _new_tree(q_values, values, config.capacity)
    tree = jax.lax.fori_loop(0, config.simulations, simulate, tree)
    return _plan(context, tree), tree


def _prepare(
    structure: Any, leaves: Sequence[Array], seed: UInt32[Array, "2"], sweeps: int
) -> tuple[_Context, Float32[Array, "A"], Float32[Array, ""]]:
    """Tables of one problem, and Q and value of its root by the guess."""
    problem = jax.tree.unflatten(structure, leaves)
    tables, root = action_tables(problem), initial_history(problem)
    terms = terms_of_all(tables, root)
    guess = guess_values(tables, terms.success_probability, terms.success_cost, problem.dead_end_cost, sweeps)
    context = _Context(
        tables=tables,
        guess=guess,
        packed=_pack_rows((tables.actions, guess)),
        root=root,
        dead_end_cost=problem.dead_end_cost,
        scale=problem.dead_end_cost,
        seeds=seed,
    )
    return context, *_first_values(context, terms, root)


def _new_tree(q_values: Float32[Array, "B A"], values: Float32[Array, "B"], capacity: int) -> Tree:
    """Trees of a root alone."""
    batch, actions = q_values.shape
    return Tree(
        q_values=jnp.full((batch, capacity, actions), jnp.inf, jnp.float32).at[:, Tree.ROOT].set(q_values),
        visits=jnp.zeros((batch, capacity, actions), jnp.int32),
        children=jnp.full((batch, capacity, 2 * actions), Tree.UNVISITED, jnp.int32),
        values=jnp.zeros((batch, capacity), jnp.float32).at[:, Tree.ROOT].set(values),
        size=jnp.ones((batch,), jnp.int32),
        status=jnp.zeros((batch,), jnp.uint32),
    )


def _first_values(
    context: _Context, terms: ActionTerms, history: History
) -> tuple[Float32[Array, "A"], Float32[Array, ""]]:
    """Q of every action of one new node by the guess, and the node's value."""
    everywhere = jnp.full(terms.available.shape, True)
    won = terms.success_cost + context.guess.value(everywhere, terms.success_cost)
    lost = terms.failure_cost + context.guess.value(~everywhere, terms.failure_cost)
    q_values = terms.distance + (terms.success_probability * won + (1.0 - terms.success_probability) * lost)
    q_values = jnp.where(terms.available, q_values, jnp.inf)
    best = jnp.min(q_values)
    accepted = context.tables.accepting[history.state]
    return q_values, jnp.where(accepted, 0.0, jnp.where(jnp.isinf(best), context.dead_end_cost, best))


def _descend(context: _Context, tree: Tree, simulation: Int32[Array, ""], config: SearchConfig) -> _Descent:
    """Follow the tree from the root to an outcome not yet expanded, or to the rollout's end. Reads only."""
    batch, capacity, actions = tree.q_values.shape
    rows = jnp.arange(batch, dtype=jnp.int32)
    action_index = jnp.arange(actions, dtype=jnp.int32)[None, :]
    tables, depth = context.tables, config.max_depth

    def goes_on(descent: _Descent) -> Bool[Array, ""]:
        return jnp.any(descent.active) & (descent.level < depth)

    def descend(descent: _Descent) -> _Descent:
        node, history = descent.node, descent.history
        q_values, visits = tree.q_values[rows, node], tree.visits[rows, node]
        total = jnp.sum(_combine(jnp.add, visits, 0), axis=1, dtype=jnp.int32) + 1
        width = context.scale * jnp.sqrt(jnp.log(total.astype(jnp.float32)))
        bound = q_values - width[:, None] * jax.lax.rsqrt((visits + 1).astype(jnp.float32))
        least = _least_of_each(bound, jnp.inf)
        # Minimum, then the first index that attains it: faster than argmin, and ties go to the lowest index.
        action = _least_of_each(jnp.where(bound <= least[:, None], action_index, actions - 1), actions - 1)
        moves = descent.active & ~jnp.isinf(least)
        others = _least_of_each(jnp.where(action_index == action[:, None], jnp.inf, q_values), jnp.inf)

        row, guess = _unpack_rows(context.packed[rows, action], (tables.actions, context.guess))
        probability, success_cost, distance = jax.vmap(_terms_of_one)(tables, row, history, action)
        success = _uniform(context.seeds, simulation, descent.level) < probability
        children = tree.children.reshape(batch, capacity, actions, 2)[rows, node, action]
        values = tree.values[rows[:, None], jnp.maximum(children, 0)]
        picked, other = success.astype(jnp.int32), 1 - success.astype(jnp.int32)
        child = children[rows, picked]
        guessed = guess.value(~success, jnp.where(success, row.failure_cost, success_cost))
        other_value = jnp.where(children[rows, other] == Tree.UNVISITED, guessed, values[rows, other])
        other_cost = jnp.where(success, row.failure_cost, success_cost) + other_value
        weight = jnp.where(success, probability, 1.0 - probability)
        cost = jnp.where(success, success_cost, row.failure_cost)
        base = distance + ((1.0 - weight) * other_cost + weight * cost)

        finished = moves & success & row.accepts
        expands = moves & ~finished & (child == Tree.UNVISITED)
        goes_deeper = moves & ~finished & ~expands
        advanced = jax.vmap(step_row)(tables, row, history, success)
        return _Descent(
            level=descent.level + 1,
            active=goes_deeper,
            node=jnp.where(goes_deeper, child, node),
            history=jax.tree.map(lambda new, old: jnp.where(_align(moves, new), new, old), advanced, history),
            leaf_value=jnp.where(finished, 0.0, jnp.where(goes_deeper, values[rows, picked], descent.leaf_value)),
            parent=jnp.where(expands, node, descent.parent),
            branch=jnp.where(expands, 2 * action + picked, descent.branch),
            nodes=descent.nodes.at[descent.level].set(jnp.where(moves, node, capacity)),
            actions=descent.actions.at[descent.level].set(action),
            counts=descent.counts.at[descent.level].set(jnp.take_along_axis(visits, action[:, None], axis=1)[:, 0]),
            base=descent.base.at[descent.level].set(base),
            weight=descent.weight.at[descent.level].set(weight),
            others=descent.others.at[descent.level].set(others),
        )

    floats, integers = jnp.zeros((depth, batch), jnp.float32), jnp.zeros((depth, batch), jnp.int32)
    start = _Descent(
        level=jnp.int32(0),
        active=jnp.full((batch,), True),
        node=jnp.full((batch,), Tree.ROOT, jnp.int32),
        history=context.root,
        leaf_value=tree.values[:, Tree.ROOT],
        parent=jnp.full((batch,), capacity, jnp.int32),
        branch=jnp.zeros((batch,), jnp.int32),
        nodes=jnp.full((depth, batch), capacity, jnp.int32),
        actions=integers,
        counts=integers,
        base=floats,
        weight=floats,
        others=floats,
    )
    return jax.lax.while_loop(goes_on, descend, start)


def _terms_of_one(
    tables: ActionTables, row: ActionRow, history: History, action: Int32[Array, ""]
) -> tuple[Float32[Array, ""], Float32[Array, ""], Float32[Array, ""]]:
    """P_S, R_S and D of one available action of one row."""
    holds, fails = knowledge_of(row.subgoal, history)
    probability, success_cost, _ = knowledge_terms(row, holds, fails)
    way = tables.distance[history.place, history.state, action]
    return probability, success_cost, distance_of(row, history, way)


def _expand(context: _Context, tree: Tree, descent: _Descent) -> tuple[Tree, Float32[Array, "B"]]:
    """Add the node that the descent reached, if any; returns the value from which to back up."""
    batch, capacity, _ = tree.q_values.shape
    rows = jnp.arange(batch, dtype=jnp.int32)
    terms = jax.vmap(terms_of_all)(context.tables, descent.history)
    q_values, values = jax.vmap(_first_values)(context, terms, descent.history)
    expands, cut = descent.parent < capacity, descent.active
    has_room = tree.size < capacity
    node = jnp.where(expands & has_room, tree.size, capacity)
    leaf_value = jnp.where(expands, values, descent.leaf_value)
    parent = jnp.where(has_room, descent.parent, capacity)
    tree = dataclasses.replace(
        tree,
        q_values=tree.q_values.at[rows, node].set(q_values, mode="drop", unique_indices=True),
        values=tree.values.at[rows, node].set(values, mode="drop", unique_indices=True),
        children=tree.children.at[rows, parent, descent.branch].set(tree.size, mode="drop", unique_indices=True),
        size=tree.size + (expands & has_room).astype(jnp.int32),
        status=tree.status
        | _status_of_rows(expands & ~has_room, Status.TREE_OVERFLOW)
        | _status_of_rows(cut, Status.DEPTH_OVERFLOW),
    )
    return tree, leaf_value


def _back_up(tree: Tree, descent: _Descent, leaf_value: Float32[Array, "B"]) -> Tree:
    """From the leaf to the root: Q of the actions taken by Eq. 3, values as their minimum. Writes only."""
    rows = jnp.arange(leaf_value.shape[0], dtype=jnp.int32)
    capacity = tree.values.shape[1]

    def ascend(carry):
        level, value, tree = carry
        node, action = descent.nodes[level], descent.actions[level]
        taken = node < capacity
        q_value = descent.base[level] + descent.weight[level] * value
        value = jnp.where(taken, jnp.minimum(descent.others[level], q_value), value)
        tree = dataclasses.replace(
            tree,
            q_values=tree.q_values.at[rows, node, action].set(q_value, mode="drop", unique_indices=True),
            visits=tree.visits.at[rows, node, action].set(descent.counts[level] + 1, mode="drop", unique_indices=True),
            values=tree.values.at[rows, node].set(value, mode="drop", unique_indices=True),
        )
        return level - 1, value, tree

    return jax.lax.while_loop(lambda carry: carry[0] >= 0, ascend, (descent.level - 1, leaf_value, tree))[2]


def _plan(context: _Context, tree: Tree) -> Plan:
    """The choice at the root."""
    q_values, finish = tree.q_values[:, Tree.ROOT], tree.q_values.shape[2] - 1
    index = jnp.arange(finish + 1, dtype=jnp.int32)[None, :]
    least = jnp.min(q_values, axis=1)
    available = jnp.isfinite(least)
    action = jnp.min(jnp.where(q_values <= least[:, None], index, finish), axis=1)
    attempts = available & (action != finish)
    batch = jnp.arange(action.shape[0], dtype=jnp.int32)
    row, _ = _unpack_rows(context.packed[batch, action], (context.tables.actions, context.guess))
    accepted = jnp.take_along_axis(context.tables.accepting, context.root.state[:, None], axis=1)[:, 0]
    return Plan(
        action=jnp.where(available, action, NO_ACTION),
        subgoal=jnp.where(attempts, row.subgoal, NO_SUBGOAL),
        from_state=jnp.where(attempts, row.from_state, NO_STATE),
        to_state=jnp.where(attempts, row.to_state, NO_STATE),
        value=tree.values[:, Tree.ROOT],
        q_values=q_values,
        visits=tree.visits[:, Tree.ROOT],
        status=tree.status
        | _status_of_rows(accepted, Status.ACCEPTING_ROOT)
        | _status_of_rows(~available & ~accepted, Status.DEAD_END),
    )


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


def _uniform(seeds: UInt32[Array, "B 2"], simulation: Int32[Array, ""], level: Int32[Array, ""]) -> Float32[Array, "B"]:
    """Uniform numbers in [0, 1) from a counter: 24 bits of a twice mixed hash of (seed, simulation, level)."""
    counter = simulation.astype(jnp.uint32) * jnp.uint32(0x9E3779B9) + level.astype(jnp.uint32) * jnp.uint32(0x85EBCA77)
    bits = _mix(_mix(seeds[:, 0] ^ counter) + seeds[:, 1])
    return (bits >> 8).astype(jnp.float32) * jnp.float32(2.0**-24)


def _mix(bits: UInt32[Array, "B"]) -> UInt32[Array, "B"]:
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


def tree_top(problem: PlanningProblem, tree: Tree, *, depth: int = 2, width: int = 4) -> dict[str, Any]:
    """The best of a searched tree as nested plain values, for pictures and JSON. Host only.

    Args:
      problem: the unbatched problem that was searched.
      tree: its tree, unbatched, from ``search_tree``.
      depth: actions per branch.
      width: actions per node: those of least Q, ties by index.

    Returns:
      A node: ``place`` (None at the robot), ``state``, ``value``, ``visits``, ``accepting``, ``dead_end`` and
      ``actions`` (empty at the last level). An action: ``index``, ``subgoal``, ``from_state``, ``to_state`` (all None
      for finish), ``q_value``, ``visits``, ``distance`` (D), ``success`` and ``failure``. An outcome (None where it
      cannot occur): ``probability``, ``cost`` (R_S or R_F), ``value`` and ``node``, both None where not searched.
    """
    return _TreeViewer(problem, tree, width).node(Tree.ROOT, initial_history(problem), depth)


class _TreeViewer:
    """Replays histories down a tree on the host."""

    def __init__(self, problem: PlanningProblem, tree: Tree, width: int) -> None:
        self._problem, self._width = problem, width
        self._q_values, self._visits = np.asarray(tree.q_values), np.asarray(tree.visits)
        self._children, self._values = np.asarray(tree.children), np.asarray(tree.values)
        self._accepting = np.asarray(problem.task.accepting)

    def node(self, index: int, history: History, depth: int) -> dict[str, Any]:
        """A node of the tree with the branches below it."""
        q_values, visits = self._q_values[index], self._visits[index]
        order = [int(a) for a in np.argsort(q_values, kind="stable")[: self._width] if np.isfinite(q_values[a])]
        terms = _action_terms(self._problem, history)
        actions = [self._action(index, action, terms, history, depth) for action in order] if depth > 0 else []
        accepting = bool(self._accepting[int(history.state)])
        return {
            **self._where(history),
            "value": float(self._values[index]),
            "visits": int(visits.sum()),
            "accepting": accepting,
            "dead_end": not accepting and bool(np.isinf(q_values).all()),
            "actions": actions,
        }

    def _where(self, history: History) -> dict[str, Any]:
        place = int(history.place)
        return {"place": None if place == self._problem.subgoal_count else place, "state": int(history.state)}

    def _action(self, index: int, action: int, terms: ActionTerms, history: History, depth: int) -> dict[str, Any]:
        finish = action == self._problem.action_count - 1
        subgoal, edge = divmod(action, max(self._problem.edge_count, 1))
        ends = [None, None] if finish else np.asarray(self._problem.task.edges)[edge].tolist()
        probability = float(terms.success_probability[action])
        costs = {True: float(terms.success_cost[action]), False: float(terms.failure_cost[action])}
        chances = {True: probability, False: 1.0 - probability}

        def outcome(success: bool) -> dict[str, Any] | None:
            if chances[success] == 0.0:
                return None
            found = self._outcome(index, action, success, history, depth)
            return {"probability": chances[success], "cost": costs[success], **found}

        return {
            "index": action,
            "subgoal": None if finish else subgoal,
            "from_state": ends[0],
            "to_state": ends[1],
            "q_value": float(self._q_values[index, action]),
            "visits": int(self._visits[index, action]),
            "distance": float(terms.distance[action]),
            "success": outcome(True),
            "failure": outcome(False),
        }

    def _outcome(self, index: int, action: int, success: bool, history: History, depth: int) -> dict[str, Any]:
        after = _step(self._problem, history, jnp.int32(action), jnp.asarray(success))
        if self._accepting[int(after.state)]:
            satisfied = {"value": 0.0, "visits": 0, "accepting": True, "dead_end": False, "actions": []}
            return {"value": 0.0, "node": {**self._where(after), **satisfied}}
        child = int(self._children[index, 2 * action + success])
        if child == Tree.UNVISITED:
            return {"value": None, "node": None}
        return {"value": float(self._values[child]), "node": self.node(child, after, depth - 1)}


_action_terms, _step = jax.jit(action_terms), jax.jit(step)
