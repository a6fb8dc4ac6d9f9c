"""The search of ``potlp_jax.planning.search.api``: many planning problems in lockstep, in fixed memory.

Every row of a batch owns a graph of histories of fixed capacity. One simulation of all rows is

1. a descent that only reads, carries the history along, and records per level what its value depends on,
2. one expansion,
3. a backward pass over the recorded levels that writes.

All reads come before all writes, so that the compiler updates the arrays in place and the cost of a simulation does
not depend on their size.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, UInt32

from potlp_jax.planning.history import step_row
from potlp_jax.planning.search.arrays import least_of_each, status_of_rows, uniform, unpack_rows
from potlp_jax.planning.search.graph import (
    Context,
    SearchConfig,
    SearchMode,
    Tree,
    arrival,
    find,
    least_values,
    new_node,
)
from potlp_jax.types import NO_ACTION, NO_STATE, NO_SUBGOAL, Status


@struct.dataclass(kw_only=True)
class _Descent:
    """One descent of all rows: at ``node`` with ``pending_cost`` pending, or about to leave the graph by ``action``
    and ``success`` (``expands``), or at an outcome that satisfies the task (``accepted``).

    The rest are records per level: the node's ``values``; after the child's value ``v`` is known,
    ``Q = base + weight * v``, and likewise the bound from ``base_bound``; ``rival`` and ``low_rival`` are the least Q
    and bound of the node's other actions of the same kind (that leave the unknown region, or that stay inside);
    ``add`` is what to add on the way up: the pending cost at the node, in the mode ``AUTHORS_CODE`` the sampled cost of
    the step.
    Levels that a row did not reach hold a node beyond the tree's capacity.
    """

    level: Int32[Array, ""]
    active: Bool[Array, "B"]
    node: Int32[Array, "B"]
    pending_cost: Float32[Array, "B"]
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


def is_open(context: Context, tree: Tree, config: SearchConfig) -> Bool[Array, "B"]:
    """Whether more simulations can change anything."""
    if config.mode is SearchMode.AUTHORS_CODE:
        return jnp.any(jnp.isfinite(tree.q_values[:, Tree.ROOT]), axis=1)
    value, bound = arrival(tree.values[:, Tree.ROOT], context.root.pending_cost, context.dead_end_cost)
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
    row = unpack_rows(context.packed[batch, action], context.tables.actions)
    accepted = jnp.take_along_axis(context.tables.accepting, context.root.state[:, None], axis=1)[:, 0]
    value = jnp.where(available, q_values[batch, action], context.dead_end_cost)
    value = jnp.where(accepted, 0.0, value)
    _, bound = arrival(tree.values[:, Tree.ROOT], context.root.pending_cost, context.dead_end_cost)
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
        status=status_of_rows(accepted, Status.ACCEPTING_ROOT)
        | status_of_rows(~available & ~accepted, Status.DEAD_END),
    )


def _descend(context: Context, tree: Tree, config: SearchConfig) -> _Descent:
    """Follow the graph from the root to an outcome not yet expanded, or to the rollout's end. Reads only."""
    batch, slots, actions = tree.q_values.shape
    rows, capacity = jnp.arange(batch, dtype=jnp.int32), slots - 1
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
        inside = context.facts[:, :, 0] == (tree.location[rows, node] * states + tree.state[rows, node])[:, None]
        pending = jnp.where(inside, 0.0, descent.pending_cost[:, None])
        if authors:
            width = config.exploration * jnp.sqrt(jnp.log(jnp.maximum(values[:, 4] + 1.0, 2.0)))
            score = q_values + pending - width[:, None] * bounds
        else:
            score = bounds + pending
        least = least_of_each(score, jnp.inf)
        # Minimum, then the first index that attains it: faster than argmin, and ties go to the lowest index.
        action = least_of_each(jnp.where(score <= least[:, None], index, actions - 1), actions - 1)
        moves = descent.active & ~jnp.isinf(least)
        chosen = index == action[:, None]
        goes_inside = inside[rows, action]
        rivals = (inside == goes_inside[:, None]) & ~chosen
        others = [least_of_each(jnp.where(rivals, row, jnp.inf), jnp.inf) for row in (q_values, bounds)]
        accepts = context.facts[rows, action, 1] != 0
        children = tree.children[rows, node, action]
        path_cost = context.tables.distance[rows, tree.location[rows, node], tree.state[rows, node], action]
        odds = _Odds(
            path_cost=jnp.where(goes_inside, 0.0, path_cost),
            chance=tree.chances[rows, node, action],
            success_cost=tree.success_costs[rows, node, action],
            failure_cost=context.tables.actions.failure_cost[rows, action],
            failure_value=tree.failure_value[rows, node, action],
            success_value=tree.success_value[rows, node, action],
        )
        if authors:
            success = uniform(context.seeds, tree.simulations, level) < odds.chance
            step = _sampled_step(odds, success, q_values[rows, action], bounds[rows, action])
            step = dataclasses.replace(step, add=step.add + jnp.where(goes_inside, 0.0, descent.pending_cost))
        else:
            step = _expected_step(context, tree, odds, children, accepts)
            step = dataclasses.replace(step, add=descent.pending_cost)
        outcome = step.success.astype(jnp.int32)
        child = children[rows, outcome]
        finished = moves & step.success & accepts
        expands = moves & ~finished & (child == Tree.UNVISITED)
        goes_deeper = moves & ~finished & ~expands
        return _Descent(
            level=level + 1,
            active=goes_deeper,
            node=jnp.where(goes_deeper, child, node),
            pending_cost=jnp.where(goes_deeper | expands, step.pending_cost, descent.pending_cost),
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
        pending_cost=context.root.pending_cost,
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
    """One action of each row: D without the pending cost, P_S, R_S, R_F, and the guessed values after both outcomes."""

    path_cost: Float32[Array, "B"]
    chance: Float32[Array, "B"]
    success_cost: Float32[Array, "B"]
    failure_cost: Float32[Array, "B"]
    failure_value: Float32[Array, "B"]
    success_value: Float32[Array, "B"]


@struct.dataclass(kw_only=True)
class _Step:
    """An outcome to follow, the pending cost after it, and how the action depends on it (see ``_Descent``)."""

    success: Bool[Array, "B"]
    pending_cost: Float32[Array, "B"]
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
) -> _Step:
    """Follow the outcome that contributes more to the gap between its Q and its bound."""
    chance = odds.chance
    success_value, success_bound = _outcome(context, tree, children[:, 1], odds.success_value, odds.success_cost)
    failure_value, failure_bound = _outcome(context, tree, children[:, 0], odds.failure_value, odds.failure_cost)
    success = chance * (success_value - success_bound) >= (1.0 - chance) * (failure_value - failure_bound)
    # Nothing is to be learnt from satisfying the task, and a certain success cannot fail.
    success = (success & ~accepts) | (chance >= 1.0)
    known = odds.path_cost + chance * odds.success_cost + (1.0 - chance) * odds.failure_cost
    weight, rest = jnp.where(success, chance, 1.0 - chance), jnp.where(success, 1.0 - chance, chance)
    return _Step(
        success=success,
        pending_cost=jnp.where(success, odds.success_cost, odds.failure_cost),
        base=known + rest * jnp.where(success, failure_value, success_value),
        base_bound=known + rest * jnp.where(success, failure_bound, success_bound),
        weight=weight,
        add=jnp.zeros_like(weight),
    )


def _sampled_step(
    odds: _Odds, success: Bool[Array, "B"], q_value: Float32[Array, "B"], spread: Float32[Array, "B"]
) -> _Step:
    """The sampled outcome; Q is the mean of the sampled costs."""
    pending_cost = jnp.where(success, odds.success_cost, odds.failure_cost)
    cost = odds.path_cost + pending_cost
    count = jnp.round(1.0 / (spread * spread)) + 1.0
    return _Step(
        success=success,
        pending_cost=pending_cost,
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
    pending_cost: Float32[Array, "B"],
) -> tuple[Float32[Array, "B"], Float32[Array, "B"]]:
    """Value and bound of an outcome: those of its node, or by the guess where there is none."""
    rows = jnp.arange(child.shape[0], dtype=jnp.int32)
    value, bound = arrival(tree.values[rows, jnp.maximum(child, 0)], pending_cost, context.dead_end_cost)
    new = child == Tree.UNVISITED
    return jnp.where(new, guessed, value), jnp.where(new, (1.0 - context.optimism) * guessed, bound)


def _expand(
    context: Context, tree: Tree, descent: _Descent, config: SearchConfig
) -> tuple[Tree, Int32[Array, "B"], Float32[Array, "B"], Float32[Array, "B"]]:
    """Add the node that the descent reached, unless another order of the same events has led there before.

    Returns the tree, the last action's child (``UNVISITED`` where it has none), and the value and bound from which to
    back up.
    """
    rows = jnp.arange(tree.size.shape[0], dtype=jnp.int32)
    capacity = tree.q_values.shape[1] - 1
    row = unpack_rows(context.packed[rows, descent.action], context.tables.actions)
    parent = tree.history(descent.node, descent.pending_cost)
    history = jax.vmap(step_row)(context.tables, row, parent, descent.success)
    node = new_node(context, history, config)
    known, key, slot = find(context, tree, history)
    if config.mode is SearchMode.AUTHORS_CODE:
        known = jnp.full_like(known, Tree.UNVISITED)
    has_room = tree.size < capacity
    is_new = descent.expands & (known == Tree.UNVISITED)
    added = is_new & has_room
    arrived = tree.values[rows, jnp.where(descent.expands, jnp.maximum(known, 0), descent.node)]
    entry = jnp.concatenate([key, tree.size[:, None]], axis=1)
    # A node that is not added goes to the spare slot behind the others.
    index = jnp.where(is_new, tree.size, capacity)

    def write(array: Array, new: Array, index: Array = index) -> Array:
        return array.at[rows, index].set(new, mode="drop", unique_indices=True)

    tree = dataclasses.replace(
        tree,
        q_values=write(tree.q_values, node.q_values),
        bounds=write(tree.bounds, node.bounds),
        chances=write(tree.chances, node.chances),
        success_costs=write(tree.success_costs, node.success_costs),
        failure_value=write(tree.failure_value, node.failure_value),
        success_value=write(tree.success_value, node.success_value),
        location=write(tree.location, history.location),
        state=write(tree.state, history.state),
        holds=write(tree.holds, history.holds),
        fails=write(tree.fails, history.fails),
        visited=write(tree.visited, history.visited),
        table=write(tree.table, entry, jnp.where(added, slot, tree.table.shape[1])),
        size=tree.size + added.astype(jnp.int32),
        status=tree.status
        | status_of_rows(is_new & ~has_room, Status.TREE_OVERFLOW)
        | status_of_rows(descent.active, Status.DEPTH_OVERFLOW),
    )
    # Read back what was written: minima over rows still to be computed would compute them again and again.
    values = least_values(
        context, tree.q_values[rows, index], tree.bounds[rows, index], history.location, history.state
    )
    tree = dataclasses.replace(tree, values=write(tree.values, values))
    values = jnp.where(is_new[:, None], values, arrived)
    value, bound = arrival(values, descent.pending_cost, context.dead_end_cost)
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
    batch, slots, actions = tree.q_values.shape
    rows, capacity = jnp.arange(batch, dtype=jnp.int32), slots - 1
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
