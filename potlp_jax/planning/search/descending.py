"""The descents of best-first search: from the root, along the widest gap, to an outcome without a node.

At every node a descent takes the action of least bound, and of its two outcomes follows the one that contributes more
to the gap between value and bound. Where no gap between value and bound is left at the root, it does the same with
floors in place of bounds: it **certifies**. It ends where an outcome has no node, satisfies the task, or is a dead end,
and at the depth limit. It only reads; every level is recorded (``Path``), so that the backup needs no lookup
(``search.backing_up``).

**Tries.** An action of the root whose guess is more than the discount too high is never descended into, however good it
is. So once a search has run ``SIMULATIONS_BEFORE_TRIES`` simulations for every action of the root, one simulation in
``TRY_EVERY`` begins with the action of least bound among those that no simulation has begun with, until there are none.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32

from potlp_jax.planning.rounding import rounded_product
from potlp_jax.planning.search.arrays import first_of_least, least_of_each
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.planning.search.context import Context, outcome_costs, root_costs
from potlp_jax.planning.search.graph import VALUE_COLUMNS, Costs, Tree
from potlp_jax.planning.search.model import FAILURE, SUCCESS, Model
from potlp_jax.planning.sharding import vary_alike

SIMULATIONS_BEFORE_TRIES: int = 4
"""Simulations for every action of the root before the search tries those that it has not chosen by itself."""

TRY_EVERY: int = 4
"""One simulation in this many is a try, while there are untried actions (docs/results/planner.md, "Tries")."""


@struct.dataclass(kw_only=True)
class Path:
    """Records of a descent by level, for the backup. Levels that a row did not reach hold the spare node.

    The value of a node depends on the action taken there by ``Q = base + weight * v``, where ``v`` is the value of the
    outcome that was followed, and on the others by ``rival``; likewise its bound. So the backup needs no lookup.

    Attributes:
      nodes: node left at each level.
      actions: action taken there.
      inside: whether the action stays in the unknown region.
      values: packed ``NodeValues`` of the node before the descent.
      base: the part of Q, bound and floor that the followed outcome does not change.
      weight: probability of the followed outcome.
      rival: least Q, bound and floor of the node's other actions of the same kind (that stay inside, or that leave).
      pending_cost: at the node.
    """

    nodes: Int32[Array, "*D B"]
    actions: Int32[Array, "*D B"]
    inside: Bool[Array, "*D B"]
    values: Float32[Array, "*D B 7"]
    base: Costs
    weight: Float32[Array, "*D B"]
    rival: Costs
    pending_cost: Float32[Array, "*D B"]

    @staticmethod
    def empty(depth: int, spare: int, rows: Int32[Array, "B"]) -> "Path":
        """Nothing recorded, for ``depth`` levels of as many rows; ``spare`` is the index of the spare node."""
        # Their number may be a symbol: programs are exported for batches of any length.
        batch = rows.shape[0]
        # Separate arrays: stacked into one, XLA recomputed the step for each part (docs/results/dropped.md, "Search").
        floats = jnp.zeros((depth, batch), jnp.float32)
        costs = Costs(value=floats, bound=floats, floor=floats)
        return Path(
            nodes=jnp.full((depth, batch), spare, jnp.int32),
            actions=jnp.zeros((depth, batch), jnp.int32),
            inside=jnp.zeros((depth, batch), jnp.bool_),
            values=jnp.zeros((depth, batch, VALUE_COLUMNS), jnp.float32),
            base=costs,
            weight=floats,
            rival=costs,
            pending_cost=floats,
        )

    def record(self, level: Int32[Array, ""], **entries: Any) -> "Path":
        """With all fields of one level written."""
        return jax.tree.map(
            lambda array, entry: jax.lax.dynamic_update_index_in_dim(array, entry, level, 0), self, Path(**entries)
        )


@struct.dataclass(kw_only=True)
class Descent:
    """Where the descent of every row is.

    Attributes:
      level: actions taken by the rows that are still descending.
      active: True where a row is still descending.
      node: the node that the row is at, or from which it left the graph.
      pending_cost: at ``node``; where the row has left the graph, after its last outcome.
      action: last action taken.
      success: its outcome that was followed.
      expands: True where the row left the graph: the outcome has no node yet.
      accepted: True where the outcome satisfies the task.
      path: records for the backup.
    """

    level: Int32[Array, ""]
    active: Bool[Array, "B"]
    node: Int32[Array, "B"]
    pending_cost: Float32[Array, "B"]
    action: Int32[Array, "B"]
    success: Bool[Array, "B"]
    expands: Bool[Array, "B"]
    accepted: Bool[Array, "B"]
    path: Path


def descend(context: Context, tree: Tree, active: Bool[Array, "B"], config: BestFirstConfig) -> Descent:
    """Follow the graph from the root to an outcome without a node, or to the rollout's end.

    Args:
      context: of the problems.
      tree: the graphs.
      active: rows that descend.
      config: ``max_depth`` matters.

    Returns:
      Where each row is and what it recorded; rows that reached the depth limit are still active.
    """
    batch = tree.size.shape[0]
    root = root_costs(context, tree)
    # No gap is left between value and bound: what remains is to prove it, or to find that a guess was too high.
    certifies = root.value <= root.bound
    passed_over = _passed_over(tree, certifies)
    nowhere = jnp.zeros((batch,), jnp.bool_)
    start = Descent(
        level=jnp.int32(0),
        active=active,
        node=jnp.full((batch,), Tree.ROOT, jnp.int32),
        pending_cost=context.model.root.pending_cost,
        action=jnp.zeros((batch,), jnp.int32),
        success=nowhere,
        expands=nowhere,
        accepted=nowhere,
        # Two descents never need each other's records, so their memory is used again by every simulation.
        path=Path.empty(config.max_depth, tree.capacity, context.model.rows),
    )

    def goes_on(descent: Descent) -> Bool[Array, ""]:
        return jnp.any(descent.active) & (descent.level < config.max_depth)

    def take_action(descent: Descent) -> Descent:
        is_last = descent.level + 1 >= config.max_depth
        return _descend_once(context, tree, descent, certifies, passed_over & (descent.level == 0), is_last)

    return jax.lax.while_loop(goes_on, take_action, vary_alike(start))


def _passed_over(tree: Tree, certifies: Bool[Array, "B"]) -> Bool[Array, "B A"]:
    """The actions that the next descent does not begin with: none, or in rows that try, all that were tried before."""
    visits = tree.root_visits
    available = ~jnp.isinf(tree.bounds[:, Tree.ROOT])
    is_due = tree.simulations % TRY_EVERY == TRY_EVERY - 1
    is_late = tree.simulations >= SIMULATIONS_BEFORE_TRIES * jnp.sum(available, axis=1)
    tries = is_due & is_late & ~certifies & jnp.any(available & (visits == 0), axis=1)
    return tries[:, None] & (visits > 0)


def _descend_once(
    context: Context,
    tree: Tree,
    descent: Descent,
    certifies: Bool[Array, "B"],
    passed_over: Bool[Array, "B A"],
    is_last: Bool[Array, ""],
) -> Descent:
    """Take one action in every row that is still descending.

    Args:
      context: of the problems.
      tree: the graphs.
      descent: so far.
      certifies: True in rows that minimise floors instead of bounds.
      passed_over: True at actions that are not taken.
      is_last: True at the last level that ``max_depth`` allows.

    Returns:
      The descent, one level further.
    """
    model, node = context.model, descent.node
    rows = model.rows
    selection = _select_action(model, tree, descent, certifies, passed_over)
    action, moves = selection.action, selection.moves
    accepts = model.accepts[rows, action]
    step = _follow_gap(context, tree, _attempt_at(model, tree, descent, selection), accepts, certifies, is_last)
    # An outcome that satisfies the task has no node: the descent ends there.
    child = step.child
    accepted = moves & step.success & accepts
    expands = moves & ~accepted & (child < 0)
    deeper = moves & ~accepted & ~expands
    path = descent.path.record(
        descent.level,
        # Rows that have ended write to the spare node during the backup.
        nodes=jnp.where(moves, node, tree.capacity),
        actions=action,
        inside=selection.inside,
        values=selection.values,
        base=step.base,
        weight=step.weight,
        rival=selection.rival,
        pending_cost=descent.pending_cost,
    )
    return Descent(
        level=descent.level + 1,
        # A row without an action has arrived at a dead end, and ends at its node.
        active=deeper,
        node=jnp.where(deeper, child, node),
        pending_cost=jnp.where(deeper | expands, step.pending_cost, descent.pending_cost),
        action=jnp.where(moves, action, descent.action),
        success=jnp.where(moves, step.success, descent.success),
        expands=descent.expands | expands,
        accepted=descent.accepted | accepted,
        path=path,
    )


@struct.dataclass(kw_only=True)
class _Selection:
    """The action that a row takes next.

    Attributes:
      action: the action of least bound or floor, ties by lowest index; finish where none is available.
      moves: True where the row is descending and has an action.
      inside: whether the action stays in the unknown region.
      values: packed ``NodeValues`` of the row's node.
      rival: least Q, bound and floor of the node's other actions of the same kind.
    """

    action: Int32[Array, "B"]
    moves: Bool[Array, "B"]
    inside: Bool[Array, "B"]
    values: Float32[Array, "B 7"]
    rival: Costs


def _select_action(
    model: Model, tree: Tree, descent: Descent, certifies: Bool[Array, "B"], passed_over: Bool[Array, "B A"]
) -> _Selection:
    """The action of least bound at every row's node, or of least floor where the row certifies; of those not passed
    over."""
    rows, node = model.rows, descent.node
    # Without the barrier XLA would look every entry up again for each of the minima below.
    q_values, bounds, floors, values = jax.lax.optimization_barrier(
        (tree.q_values[rows, node], tree.bounds[rows, node], tree.floors[rows, node], tree.values[rows, node])
    )
    costs = Costs(value=q_values, bound=bounds, floor=floors)
    inside = model.stays_inside(tree.location[rows, node], tree.state[rows, node])
    # Only actions that leave the unknown region pay the pending cost.
    score = costs.low(certifies[:, None]) + jnp.where(inside, 0.0, descent.pending_cost[:, None])
    action, least = first_of_least(jnp.where(passed_over, jnp.inf, score))
    goes_inside = inside[rows, action]
    chosen = jnp.arange(score.shape[1], dtype=jnp.int32)[None, :] == action[:, None]
    # The backup changes the chosen action's Q. With the least of the others of its kind, the new minimum is known
    # without reading the row again.
    rivals = (inside == goes_inside[:, None]) & ~chosen
    rival = jax.tree.map(lambda own: least_of_each(jnp.where(rivals, own, jnp.inf), jnp.inf), costs)
    return _Selection(
        action=action,
        moves=descent.active & ~jnp.isinf(least),
        inside=goes_inside,
        values=values,
        rival=rival,
    )


@struct.dataclass(kw_only=True)
class _Attempt:
    """One action of each row, at the node where it is taken.

    Attributes:
      path_cost: cost of the path to it, 0 where it stays inside; D without the pending cost.
      chance: P_S.
      success_cost: R_S.
      failure_cost: R_F.
      children: of its outcomes, as in ``Tree``.
    """

    path_cost: Float32[Array, "B"]
    chance: Float32[Array, "B"]
    success_cost: Float32[Array, "B"]
    failure_cost: Float32[Array, "B"]
    children: Int32[Array, "B 2"]


def _attempt_at(model: Model, tree: Tree, descent: Descent, selection: _Selection) -> _Attempt:
    """Look the terms of the selected actions up."""
    rows, node, action = model.rows, descent.node, selection.action
    # The path costs of a node depend on its product state alone, so that nodes do not keep them.
    path_cost = model.tables.distance[rows, tree.location[rows, node], tree.state[rows, node], action]
    return _Attempt(
        path_cost=jnp.where(selection.inside, 0.0, path_cost),
        chance=tree.chances[rows, node, action],
        success_cost=tree.success_costs[rows, node, action],
        failure_cost=model.tables.actions.failure_cost[rows, action],
        children=tree.children[rows, node, action],
    )


@struct.dataclass(kw_only=True)
class _Step:
    """The outcome of an action that a descent follows.

    Attributes:
      success: which outcome.
      child: its entry of ``Tree.children``.
      pending_cost: after it.
      base: see ``Path``.
      weight: see ``Path``.
    """

    success: Bool[Array, "B"]
    child: Int32[Array, "B"]
    pending_cost: Float32[Array, "B"]
    base: Costs
    weight: Float32[Array, "B"]


def _follow_gap(
    context: Context,
    tree: Tree,
    attempt: _Attempt,
    accepts: Bool[Array, "B"],
    certifies: Bool[Array, "B"],
    is_last: Bool[Array, ""],
) -> _Step:
    """Follow the outcome that contributes more to the gap between the action's Q and its bound or floor.

    Args:
      context: of the problems.
      tree: the graphs.
      attempt: the action of each row.
      accepts: whether its success satisfies the task.
      certifies: True where the gap is that to the floor.
      is_last: True at the last level: what has a node is taken as it is, without a gap.

    Returns:
      The outcome that is followed.
    """
    chance, failure_child, success_child = attempt.chance, attempt.children[:, FAILURE], attempt.children[:, SUCCESS]
    after_success = outcome_costs(context, tree, success_child, attempt.success_cost, is_last)
    after_failure = outcome_costs(context, tree, failure_child, attempt.failure_cost, is_last)
    success_gap = after_success.value - after_success.low(certifies)
    failure_gap = after_failure.value - after_failure.low(certifies)
    success = chance * success_gap >= (1.0 - chance) * failure_gap
    # Nothing is to be learnt from satisfying the task, and a certain success cannot fail.
    success = (success & ~accepts) | (chance >= 1.0)
    # Eq. 3 without the part that the followed outcome contributes: that is added during the backup.
    known = attempt.path_cost + rounded_product(chance, attempt.success_cost)
    known += rounded_product(1.0 - chance, attempt.failure_cost)
    weight, rest = jnp.where(success, chance, 1.0 - chance), jnp.where(success, 1.0 - chance, chance)

    def without_followed(after_failure: Array, after_success: Array) -> Array:
        return known + rounded_product(rest, jnp.where(success, after_failure, after_success))

    return _Step(
        success=success,
        child=jnp.where(success, success_child, failure_child),
        pending_cost=jnp.where(success, attempt.success_cost, attempt.failure_cost),
        base=jax.tree.map(without_followed, after_failure, after_success),
        weight=weight,
    )
