"""Best-first search on bounds over a graph of histories: the default search, of the family of AO*.

This is not the search of the paper, which is PO-UCT (``search.uct``). It is deterministic: nothing is sampled, and no
key is used. AO* grows a graph of choices (OR) and outcomes (AND) along the policy that looks best, and backs up
expectations and minima, as this does. Three things are different. The leaf to expand is found as in bounded real-time
dynamic programming and HSVI, by following the widest gap, but without their random outcomes. The estimates at leaves
are guesses, which may be too high: the search first discounts them by a fixed fraction, which is no bound but leads to
good choices soon, and then goes on with admissible bounds. What dead ends cost in a guess is not discounted: the
probability that all attempts fail hardly depends on their order, and where a dead end costs much, everything else would
be lost in its discount. And the search ends when it is spent, proven or not.

Values are those of Eq. 3 itself: expectations over both outcomes, minima over actions. Outcomes that have no node yet
have a guessed value (``search.guess``). Beside its value every node has a **bound**, its value if every guess, apart
from what dead ends cost in it, were too high by the fraction ``optimism``, and a **floor**, its value if every guess
were 0. One simulation of all rows of a batch is

1. **descend**: from the root, take the action of least bound (at the root itself not always: see "Tries"), and of its
   two outcomes the one that contributes more to the gap between value and bound, until an outcome without a node is
   reached. Where no gap between value and bound is left at the root, the descent does the same with floors in place of
   bounds: it **certifies**. Only reads.
2. **expand**: give that outcome a node, or find the one that another order of the same events led to.
3. **back up** values, bounds and floors along the descent. Only writes.

Once value and floor of the root are equal the search ends.

**Tries.** An action of the root whose guess is more than the discount too high is never descended into, however good it
is. So once a search has run ``SIMULATIONS_BEFORE_TRIES`` simulations for every action of the root, one simulation in
``TRY_EVERY`` begins with the action of least bound among those that no simulation has begun with, until there are none.

**A search that has ended is exact**, up to rounding, unless its status has an overflow. (1) Costs are not negative, so
that 0 is no more than what follows any outcome; Eq. 3 is monotone in these; so no floor exceeds the true cost, also a
floor computed earlier, from children that have grown since. (2) Let the root's value equal its floor. The action of
least value has a floor no greater than its value, and no less than the root's floor: both are equal. They were computed
together, by the same operations, from values and floors of its outcomes, which therefore were equal too where they have
a probability. A guess is never equal to its floor of 0 (``LEAST_GUESS``), so that these outcomes had nodes, satisfied
the task, or were dead ends; and so on down to the end of every history. So the value is the cost of a policy that rests
on no guess, and no less than the optimum. By (1) it is no more.

**Every search ends**, given simulations and memory. While value and floor (or bound) of the root differ, the action of
least floor has a gap, hence one of its outcomes, and so on: the descent meets an outcome without a node and links it to
one, or it meets stored numbers that are older than their children's and renews them. There are finitely many histories,
and fewer tries than actions.

All reads of a simulation come before its writes, so that XLA updates the arrays in place and the cost of a simulation
does not depend on their size.

References:
  Nilsson, Principles of Artificial Intelligence, 1980 (AO*).
  Martelli and Montanari, Additive AND/OR graphs, IJCAI 1973; Optimizing decision trees through heuristically guided
    search, CACM 1978.
  Hansen and Zilberstein, LAO*: a heuristic search algorithm that finds solutions with loops, AIJ 2001.
  Smith and Simmons, Heuristic search value iteration for POMDPs, UAI 2004 (HSVI): outcomes chosen by their gap.
  McMahan, Likhachev and Gordon, Bounded real-time dynamic programming, ICML 2005: the same for known states.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, UInt32

from potlp_jax.planning.history import ActionTables, History, terms_of_all
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.rounding import rounded_product
from potlp_jax.planning.search.arrays import first_of_least, least_of_each, status_of_rows
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.planning.search.graph import (
    VALUE_COLUMNS,
    Costs,
    NewNode,
    NodeValues,
    Tree,
    add_node,
    as_guess,
    dead_ends_in,
    find,
    guess_in,
    plant_tree,
)
from potlp_jax.planning.search.guess import Rule, guess_outcomes, make_rule, value_successes_anew
from potlp_jax.planning.search.lockstep import SearchKernel, SearchMethod
from potlp_jax.planning.search.model import FAILURE, SUCCESS, Model, make_model
from potlp_jax.planning.search.native import LIBRARY, fits_kernel, search_natively
from potlp_jax.planning.search.plan import Plan, plan_of_least_score
from potlp_jax.planning.sharding import vary_alike
from potlp_jax.task.relations import transitive_closure
from potlp_jax.types import Status

LEAST_GUESS: float = 1e-4
"""Guesses at outcomes that do not satisfy the task are at least this share of the dead-end cost, so that an outcome
without a node leaves a gap that 24 bits can hold: one that rounding hides changes the value by less than 0.06 %."""

SIMULATIONS_BEFORE_TRIES: int = 4
"""Simulations for every action of the root before the search tries those that it has not chosen by itself."""

TRY_EVERY: int = 4
"""One simulation in this many is a try, while there are untried actions (docs/results/planner.md, "Tries")."""

ALL_CONDITIONS = 0xFFFFFFFF
"""A word of a mask over conditions in which every bit is set."""


@struct.dataclass(kw_only=True)
class Context:
    """What stays the same during a search.

    Attributes:
      model: the problems.
      rule: guesses the value of outcomes without a node.
      relevant: per state of the automaton, mask over the conditions that later choices can depend on.
      optimism: ``BestFirstConfig.optimism``, of each problem.
    """

    model: Model
    rule: Rule
    relevant: UInt32[Array, "*B Z W"]
    optimism: Float32[Array, "*B"]


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


@struct.dataclass(kw_only=True)
class Leaf:
    """What a descent ended at, from which to back up.

    Attributes:
      child: node of the last action's outcome, ``Tree.UNVISITED`` where it has none.
      costs: expected cost after the descent's last outcome.
    """

    child: Int32[Array, "B"]
    costs: Costs


def prepare(problems: PlanningProblem, seeds: UInt32[Array, "B 2"], config: BestFirstConfig) -> Context:
    """Tables, guessing rule and optimism of a batch of problems.

    Args:
      problems: every leaf has the leading axis B.
      seeds: without effect: nothing is sampled, but every search has the same verbs.
      config: ``guess_failures`` and ``optimism`` matter.

    Returns:
      What the other verbs look up.
    """
    del seeds
    model = make_model(problems)
    # From travel and attempts alone: knowledge can only take actions away.
    reach = jax.vmap(_reachable_states)(model.tables)
    # The rule values successes with the chances of the root, where nothing is known.
    terms = jax.vmap(terms_of_all)(model.tables, model.root)
    rule = make_rule(
        model.tables,
        model.product_states,
        terms.success_probability,
        terms.success_cost,
        reach,
        problems.dead_end_cost,
        config.guess_failures,
    )
    return Context(
        model=model,
        rule=rule,
        relevant=jax.vmap(_relevant_conditions)(model.tables, reach),
        optimism=jnp.full(problems.dfa_state.shape, config.optimism, jnp.float32),
    )


def plant(context: Context, config: BestFirstConfig) -> Tree:
    """Graphs of the roots alone."""
    # The root is a node like any other: its values are guesses until it is searched.
    root = _new_node(context, context.model.root, config)
    return plant_tree(context.model, root, config)


def is_open(context: Context, tree: Tree) -> Bool[Array, "B"]:
    """Whether a gap between value and floor is left at the root, so that more simulations can change something."""
    root = _root_costs(context, tree)
    return root.value > root.floor


def simulate(context: Context, tree: Tree, active: Bool[Array, "B"], config: BestFirstConfig) -> Tree:
    """One descent of all rows that are active.

    Args:
      context: of the problems.
      tree: the graphs.
      active: rows that descend; only rows that are open (``is_open``).
      config: ``max_depth`` bounds the descent.

    Returns:
      The graphs with at most one more node each; rows that are not active are unchanged.
    """
    # Reads first, writes last: see the module.
    descent = _descend(context, tree, active, config)
    tree, leaf = _expand(context, tree, descent, config)
    return _count(_back_up(tree, descent, leaf), descent)


def choose(context: Context, tree: Tree) -> Plan:
    """The action of least Q at the root."""
    root = _root_costs(context, tree)
    # Q, not the bound: the bound says where to look, Q what is believed. At the root nothing is pending.
    q_values = tree.q_values[:, Tree.ROOT]
    return plan_of_least_score(context.model, q_values, q_values, tree.root_visits, root.bound, root.floor, tree.status)


BEST_FIRST = SearchMethod(
    tree=Tree,
    prepare=prepare,
    plant=plant,
    is_open=is_open,
    simulate=simulate,
    choose=choose,
    kernel=SearchKernel(library=LIBRARY, fits=fits_kernel, run=search_natively),
)


def _root_costs(context: Context, tree: Tree) -> Costs:
    """Value, bound and floor of the problems."""
    values = NodeValues.unpack(tree.values[:, Tree.ROOT])
    return values.on_arrival(context.model.root.pending_cost, context.model.dead_end_cost)


def _descend(context: Context, tree: Tree, active: Bool[Array, "B"], config: BestFirstConfig) -> Descent:
    """Follow the graph from the root to an outcome without a node, or to the rollout's end."""
    batch = tree.size.shape[0]
    root = _root_costs(context, tree)
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
    after_success = _outcome_costs(context, tree, success_child, attempt.success_cost, is_last)
    after_failure = _outcome_costs(context, tree, failure_child, attempt.failure_cost, is_last)
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


def _outcome_costs(
    context: Context,
    tree: Tree,
    child: Int32[Array, "B"],
    pending_cost: Float32[Array, "B"],
    is_last: Bool[Array, ""],
) -> Costs:
    """Costs after an outcome: those of its node, or by the guess where there is none."""
    # Index 0 where there is no child: read, and not used.
    node = tree.values_at(context.model.rows, jnp.maximum(child, 0))
    visited = node.on_arrival(pending_cost, context.model.dead_end_cost)
    visited = _closed_where(is_last, visited)
    guess = guess_in(child)
    unvisited = Costs(value=guess, bound=_discounted(child, context.optimism), floor=jnp.zeros_like(guess))
    return jax.tree.map(lambda new, old: jnp.where(child < 0, new, old), unvisited, visited)


def _discounted(child: Int32[Array, "*B"], optimism: Array) -> Float32[Array, "*B"]:
    """Guesses of which all but what dead ends cost in them is reduced by the optimism; never above the guesses."""
    guess = guess_in(child)
    return jnp.minimum(rounded_product(1.0 - optimism, guess) + rounded_product(optimism, dead_ends_in(child)), guess)


def _closed_where(cut: Bool[Array, "*B"], costs: Costs) -> Costs:
    """Without a gap where a descent is cut by ``max_depth``: it would lead to the same place again and again."""
    return jax.tree.map(lambda own: jnp.where(cut, costs.value, own), costs)


def _expand(context: Context, tree: Tree, descent: Descent, config: BestFirstConfig) -> tuple[Tree, Leaf]:
    """Add the node that the descent reached, unless another order of the same events has led there before."""
    model = context.model
    # Rows that do not expand compute a history too; nothing of it is kept.
    parent = tree.history(model.rows, descent.node, descent.pending_cost)
    history = model.step(parent, descent.action, descent.success)
    # Computed for all rows in lockstep, also for those that find an existing node.
    node = _new_node(context, history, config)
    lookup = find(tree, history, context.relevant)
    is_new = descent.expands & (lookup.node == Tree.UNVISITED)
    # Where a row ends without a new node: the node that it found, or the last one of a descent that was cut.
    end = jnp.where(descent.expands, jnp.maximum(lookup.node, 0), descent.node)
    # Read before the new node is written: all reads come before all writes.
    existing = tree.values[model.rows, end]
    tree, values, added = add_node(tree, model, node, history, lookup, is_new)
    values = NodeValues.unpack(jnp.where(is_new[:, None], values.pack(), existing))
    costs = _closed_where(descent.active, values.on_arrival(descent.pending_cost, model.dead_end_cost))
    child = jnp.where(added, tree.size - 1, jnp.where(descent.expands, lookup.node, Tree.UNVISITED))
    overflow = status_of_rows(is_new & ~added, Status.TREE_OVERFLOW)
    # Rows that are still active when the descent is over have reached the depth limit.
    overflow |= status_of_rows(descent.active, Status.DEPTH_OVERFLOW)
    leaf = Leaf(child=child, costs=jax.tree.map(lambda own: jnp.where(descent.accepted, 0.0, own), costs))
    return dataclasses.replace(tree, status=tree.status | overflow), leaf


def _new_node(context: Context, history: History, config: BestFirstConfig) -> NewNode:
    """The numbers of one node per row when nothing below it has been seen."""
    # The pending cost is left out of a node's numbers; the guess needs it, to know what the next action pays.
    free = dataclasses.replace(history, pending_cost=jnp.zeros_like(history.pending_cost))
    terms = jax.vmap(terms_of_all)(context.model.tables, free)
    chance, available = terms.success_probability, terms.available
    rule = value_successes_anew(context.rule, context.model.tables, chance, terms.success_cost, config.guess_failures)
    failure, success = guess_outcomes(
        rule,
        context.model.product_state(history.location, history.state),
        history.pending_cost,
        available,
        chance,
        terms.success_cost,
        config.guess_failures,
    )
    least = LEAST_GUESS * context.model.dead_end_cost[:, None]
    after_failure = jnp.maximum(failure.cost, least)
    after_success = jnp.where(context.model.accepts, 0.0, jnp.maximum(success.cost, least))
    dead_ends = jnp.stack([failure.dead_end, success.dead_end], axis=-1) * context.model.dead_end_cost[:, None, None]
    children = as_guess(jnp.stack([after_failure, after_success], axis=-1), dead_ends)
    # Eq. 3 with guessed values, the same with the guesses reduced by the optimism, and without them.
    known = terms.distance + rounded_product(chance, terms.success_cost)
    known += rounded_product(1.0 - chance, terms.failure_cost)

    def expected(after: Float32[Array, "B A 2"]) -> Float32[Array, "B A"]:
        guessed = rounded_product(chance, after[..., SUCCESS]) + rounded_product(1.0 - chance, after[..., FAILURE])
        return jnp.where(available, known + guessed, jnp.inf)

    return NewNode(
        q_values=expected(guess_in(children)),
        bounds=expected(_discounted(children, context.optimism[:, None, None])),
        floors=jnp.where(available, known, jnp.inf),
        chances=chance,
        success_costs=terms.success_cost,
        children=children,
    )


def _back_up(tree: Tree, descent: Descent, leaf: Leaf) -> Tree:
    """From the leaf to the root: Q and bound of the actions taken, and what their nodes pass up."""
    rows = jnp.arange(tree.size.shape[0], dtype=jnp.int32)

    def ascend(carry):
        level, after, tree = carry
        step = jax.tree.map(lambda records: records[level], descent.path)
        # Rows with a shorter descent wait at their leaf until the level of their last action.
        taken = step.nodes < tree.capacity
        action = jax.tree.map(lambda base, after: base + rounded_product(step.weight, after), step.base, after)
        values = _with_action(step, action)

        def arrive(after: Array, leave: Array, stay: Array) -> Array:
            return jnp.where(taken, jnp.minimum(step.pending_cost + leave, stay), after)

        after = jax.tree.map(arrive, after, values.leave, values.stay)

        # One node per row, so that no index occurs twice.
        def write(array: Array, new: Array, *index: Array) -> Array:
            return array.at[rows, step.nodes, *index].set(new, mode="drop", unique_indices=True)

        tree = dataclasses.replace(
            tree,
            q_values=write(tree.q_values, action.value, step.actions),
            bounds=write(tree.bounds, action.bound, step.actions),
            floors=write(tree.floors, action.floor, step.actions),
            values=write(tree.values, values.pack()),
        )
        return level - 1, after, tree

    start = (descent.level - 1, leaf.costs, tree)
    tree = jax.lax.while_loop(lambda carry: carry[0] >= 0, ascend, vary_alike(start))[2]
    # Link the child last, to the node that the descent left the graph from.
    parent = jnp.where(leaf.child == Tree.UNVISITED, tree.capacity, descent.node)
    at = (rows, parent, descent.action, descent.success.astype(jnp.int32))
    return dataclasses.replace(tree, children=tree.children.at[at].set(leaf.child, mode="drop", unique_indices=True))


def _with_action(step: Path, action: Costs) -> NodeValues:
    """What a node passes up once the action taken there costs this; ``step`` is one level of a path."""
    # The other kind of action is as it was; a descent touches one action of a node.
    before = NodeValues.unpack(step.values)
    least = jax.tree.map(jnp.minimum, step.rival, action)

    def of_kind(taken: Bool[Array, "B"], before: Costs) -> Costs:
        return jax.tree.map(lambda new, old: jnp.where(taken, new, old), least, before)

    return NodeValues(
        leave=of_kind(~step.inside, before.leave),
        stay=of_kind(step.inside, before.stay),
        visits=before.visits + 1.0,
    )


def _count(tree: Tree, descent: Descent) -> Tree:
    """Count the descent and its actions, in the rows that took one."""
    rows, first = jnp.arange(tree.size.shape[0], dtype=jnp.int32), descent.path.nodes[0]
    moved = first < tree.capacity
    # An index behind the last action: the write is dropped.
    action = jnp.where(moved, descent.path.actions[0], tree.root_visits.shape[1])
    return dataclasses.replace(
        tree,
        root_visits=tree.root_visits.at[rows, action].add(1, mode="drop", unique_indices=True),
        simulations=tree.simulations + moved.astype(jnp.int32),
        steps=tree.steps + jnp.sum(descent.path.nodes < tree.capacity, axis=0, dtype=jnp.int32),
    )


def _reachable_states(tables: ActionTables) -> Bool[Array, "Z Z"]:
    """``[z, z']``: travel and attempts can lead from z to z'."""
    rows, states = tables.actions, tables.accepting.shape[0]
    own = jnp.arange(states, dtype=jnp.int32)
    attempts = rows.from_state[:, None] == own[None, :]
    # A path that ends where an action is attempted in z' leads from z to z', from whichever node it starts.
    travels = jnp.any(jnp.any(jnp.isfinite(tables.distance), axis=0)[:, :, None] & attempts[None, :, :], axis=1)
    succeeds = jnp.any(attempts[:, :, None] & (rows.to_state[:, None] == own[None, :])[:, None, :], axis=0)
    return transitive_closure(travels | succeeds | (own[:, None] == own[None, :]))


def _relevant_conditions(tables: ActionTables, reach: Bool[Array, "Z Z"]) -> UInt32[Array, "Z W"]:
    """Per state, the conditions of actions that can still be attempted.

    All of them where conditions of several cubes exist: what is known of one may then close another.
    """
    rows = tables.actions
    attempts = rows.from_state[:, None] == jnp.arange(reach.shape[0], dtype=jnp.int32)[None, :]
    # A condition matters in a state if an action that tries it can still be reached from there.
    useful = jnp.any(reach[:, None, :] & attempts[None, :, :], axis=2)
    bits = jnp.where(useful[:, :, None], rows.condition_bits[None], jnp.uint32(0))
    combined = jax.lax.reduce(bits, jnp.uint32(0), jax.lax.bitwise_or, (1,))
    return jnp.where(jnp.any(tables.compound_mask), jnp.uint32(ALL_CONDITIONS), combined)
