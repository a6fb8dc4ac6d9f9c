"""PO-UCT, the search of the paper: sampled outcomes, mean costs, upper confidence bounds, the most visited action.

``search: uct`` in settings. It is a choice beside the default, best-first search (``search.best_first``), and differs
from that in every step: here nothing is guessed, so that a new node costs nothing beyond the rollout so far; Q is the
mean cost of the rollouts that took an action; every history has a node of its own, in whatever order its events came.
One simulation of all rows of a batch is

1. **descend**: from the root, take an action that was never taken, otherwise the one of least
   ``Q - exploration * sqrt(log(n) / n_a)``; sample its outcome with P_S; until an outcome without a node is reached.
2. **expand**: give that outcome a node (the tree grows by one node per simulation).
3. **back up** the sampled cost: visits and means of the actions taken.

From the paper (III-C): nodes are histories of actions and outcomes; at each iteration an action of A(b_h) and its
outcome, with P_S given the history, are sampled, and D and R_S or R_F accrue as in Eq. 3. The paper leaves open how an
action is selected, how it is valued at a new node, and which is taken in the end. These follow the authors' code: UCB1
with a constant of 50, untried actions first; no rollout beyond a new node; the most visited action. The last two differ
from PO-UCT of Silver and Veness, which plays random actions from a new node and takes the action of best mean. What the
paper does not have: a dead end has a cost, what a rollout knows is closed under what follows from it (docs/model.md,
sections 4 and 5), and the limits on depth and nodes, which set a bit of ``status`` where they are met.

The random numbers are a function of the caller's key, the simulation and the level, so that rows of a batch do not
depend on each other, and a search that goes on with its tree equals one search of all simulations.

References:
  Bradley et al., Learning and Planning for Temporally Extended Tasks in Unknown Environments, ICRA 2021, III-C.
  Silver and Veness, Monte-Carlo planning in large POMDPs, NIPS 2010 (PO-UCT).
  Kocsis and Szepesvári, Bandit based Monte-Carlo planning, ECML 2006.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, UInt32

from potlp_jax.planning.history import ActionTerms, History, terms_of_all
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.rounding import rounded_product
from potlp_jax.planning.search.arrays import first_of_least, status_of_rows, uniform
from potlp_jax.planning.search.config import UctConfig
from potlp_jax.planning.search.lockstep import SearchMethod
from potlp_jax.planning.search.model import Model, make_model
from potlp_jax.planning.search.plan import Plan, plan_of_least_score
from potlp_jax.planning.sharding import vary_alike
from potlp_jax.types import Status


@struct.dataclass(kw_only=True)
class UctTree:
    """Sampled histories: a tree in arrays of fixed capacity N; node 0 is the root.

    Behind the N nodes lies one spare node, to which rows write that have nothing to write.

    Attributes:
      q_values: mean cost of the rollouts that took each action at each node, the pending cost included; 0 where there
        are none, inf where the action is not available.
      visits: rollouts that took each action.
      node_visits: rollouts that took any.
      dead_end: True where a node has no action.
      distances: D of each action, the pending cost included.
      chances: P_S of each action.
      success_costs: R_S of each action.
      children: node reached by each action after ``FAILURE`` and after ``SUCCESS`` (``search.model``), or
        ``UNVISITED``. Outcomes that satisfy the task have no node: they cost nothing more.
      location: of the node's history, as in ``history.History``.
      state: of the node's history.
      pending_cost: of the node's history.
      holds: of the node's history.
      fails: of the node's history.
      visited: of the node's history.
      size: nodes in use.
      simulations: rollouts so far.
      steps: actions taken by all of them.
      status: bits of ``types.Status``.
    """

    q_values: Float32[Array, "*B N A"]
    visits: Int32[Array, "*B N A"]
    node_visits: Int32[Array, "*B N"]
    dead_end: Bool[Array, "*B N"]
    distances: Float32[Array, "*B N A"]
    chances: Float32[Array, "*B N A"]
    success_costs: Float32[Array, "*B N A"]
    children: Int32[Array, "*B N A 2"]
    location: Int32[Array, "*B N"]
    state: Int32[Array, "*B N"]
    pending_cost: Float32[Array, "*B N"]
    holds: UInt32[Array, "*B N S W"]
    fails: UInt32[Array, "*B N S W"]
    visited: UInt32[Array, "*B N S1 V"]
    size: Int32[Array, "*B"]
    simulations: Int32[Array, "*B"]
    steps: Int32[Array, "*B"]
    status: UInt32[Array, "*B"]

    ROOT = 0
    UNVISITED = -1
    Q_INCLUDES_PENDING_COST = True

    @property
    def capacity(self) -> int:
        """N; index of the spare node."""
        return self.q_values.shape[-2] - 1

    @property
    def root_visits(self) -> Int32[Array, "*B A"]:
        """Rollouts that began with each action."""
        return self.visits[..., UctTree.ROOT, :]

    def history(self, rows: Int32[Array, "B"], node: Int32[Array, "B"]) -> History:
        """The history of one node of each row."""
        return History(**{name: getattr(self, name)[rows, node] for name in _HISTORY_FIELDS})


_HISTORY_FIELDS = tuple(field.name for field in dataclasses.fields(History))


@struct.dataclass(kw_only=True)
class Context:
    """What stays the same during a search.

    Attributes:
      model: the problems.
      seeds: two random words per row, from which all samples of the row are made.
    """

    model: Model
    seeds: UInt32[Array, "*B 2"]


@struct.dataclass(kw_only=True)
class Rollout:
    """Where the sampled rollout of every row is.

    Attributes:
      level: actions taken by the rows that are still going.
      active: True where a row is still going.
      node: the node that the row is at, or from which it left the tree.
      action: last action taken.
      success: its sampled outcome.
      expands: True where the row left the tree: the outcome has no node yet.
      accepted: True where the outcome satisfies the task.
      nodes: node left at each level; the spare node where the row had ended.
      actions: action taken at each level.
      costs: sampled cost of each action, ``D + R_S`` or ``D + R_F``.
      means: Q of each action before the rollout. Recorded on the way down, so that the backup only writes: XLA then
        updates the tree in place.
      visits: rollouts that had taken each action before.
    """

    level: Int32[Array, ""]
    active: Bool[Array, "B"]
    node: Int32[Array, "B"]
    action: Int32[Array, "B"]
    success: Bool[Array, "B"]
    expands: Bool[Array, "B"]
    accepted: Bool[Array, "B"]
    nodes: Int32[Array, "D B"]
    actions: Int32[Array, "D B"]
    costs: Float32[Array, "D B"]
    means: Float32[Array, "D B"]
    visits: Int32[Array, "D B"]


@struct.dataclass(kw_only=True)
class Leaf:
    """What a rollout ended at.

    Attributes:
      child: node of the last outcome, ``UctTree.UNVISITED`` where it has none.
      value: what is added to the rollout's cost: the dead-end cost at a dead end, otherwise 0.
    """

    child: Int32[Array, "B"]
    value: Float32[Array, "B"]


def prepare(problems: PlanningProblem, seeds: UInt32[Array, "B 2"], config: UctConfig) -> Context:
    """Tables of a batch of problems.

    Args:
      problems: every leaf has the leading axis B.
      seeds: two random words per row.
      config: not used.

    Returns:
      What the other verbs look up.
    """
    del config
    return Context(model=make_model(problems), seeds=seeds)


def plant(context: Context, config: UctConfig) -> UctTree:
    """Trees of the roots alone."""
    model = context.model
    # P_S and R_S depend on what is known, so every node keeps its own.
    terms = jax.vmap(terms_of_all)(model.tables, model.root)
    batch, actions = terms.distance.shape

    def first(values: Array, fill: float = 0) -> Array:
        shape = (batch, config.capacity + 1, *values.shape[1:])
        return jnp.full(shape, fill, values.dtype).at[:, UctTree.ROOT].set(values)

    return UctTree(
        q_values=first(_new_q_values(terms), jnp.inf),
        visits=jnp.zeros((batch, config.capacity + 1, actions), jnp.int32),
        node_visits=jnp.zeros((batch, config.capacity + 1), jnp.int32),
        dead_end=first(~jnp.any(terms.available, axis=1)),
        distances=first(terms.distance),
        chances=first(terms.success_probability),
        success_costs=first(terms.success_cost),
        children=jnp.full((batch, config.capacity + 1, actions, 2), UctTree.UNVISITED, jnp.int32),
        size=jnp.ones((batch,), jnp.int32),
        simulations=jnp.zeros((batch,), jnp.int32),
        steps=jnp.zeros((batch,), jnp.int32),
        status=jnp.zeros((batch,), jnp.uint32),
        **{name: first(getattr(model.root, name)) for name in _HISTORY_FIELDS},
    )


def is_open(context: Context, tree: UctTree) -> Bool[Array, "B"]:
    """Whether the root has an action: PO-UCT never knows that it has seen enough."""
    del context
    return jnp.any(jnp.isfinite(tree.q_values[:, UctTree.ROOT]), axis=1)


def simulate(context: Context, tree: UctTree, active: Bool[Array, "B"], config: UctConfig) -> UctTree:
    """One sampled rollout of all rows that are active.

    Args:
      context: of the problems.
      tree: the trees.
      active: rows that are rolled out; only rows that are open (``is_open``).
      config: ``max_depth`` and ``exploration`` matter.

    Returns:
      The trees with at most one more node each; rows that are not active are unchanged.
    """
    rollout = _descend(context, tree, active, config)
    tree, leaf = _expand(context, tree, rollout)
    return _back_up(tree, rollout, leaf)


def choose(context: Context, tree: UctTree) -> Plan:
    """The most visited action at the root."""
    # An action that was never taken has no mean; where there are more actions than rollouts some are not.
    q_values = jnp.where(tree.root_visits > 0, tree.q_values[:, UctTree.ROOT], jnp.inf)
    # The most visited one, not the one of least mean: a mean over few rollouts may be low by chance.
    score = jnp.where(jnp.isinf(q_values), jnp.inf, -tree.root_visits.astype(jnp.float32))
    no_bound = jnp.full(score.shape[:1], -jnp.inf, jnp.float32)
    return plan_of_least_score(context.model, score, q_values, tree.root_visits, no_bound, no_bound, tree.status)


UCT = SearchMethod(tree=UctTree, prepare=prepare, plant=plant, is_open=is_open, simulate=simulate, choose=choose)


def _new_q_values(terms: ActionTerms) -> Float32[Array, "B A"]:
    """Q of a new node: nothing beyond the cost so far."""
    return jnp.where(terms.available, 0.0, jnp.inf).astype(jnp.float32)


def _descend(context: Context, tree: UctTree, active: Bool[Array, "B"], config: UctConfig) -> Rollout:
    """Sample a rollout from the root to an outcome without a node, or to its end."""
    batch, depth = tree.size.shape[0], config.max_depth
    nowhere = jnp.zeros((batch,), jnp.bool_)
    integers, floats = jnp.zeros((depth, batch), jnp.int32), jnp.zeros((depth, batch), jnp.float32)
    start = Rollout(
        level=jnp.int32(0),
        active=active,
        node=jnp.full((batch,), UctTree.ROOT, jnp.int32),
        action=jnp.zeros((batch,), jnp.int32),
        success=nowhere,
        expands=nowhere,
        accepted=nowhere,
        nodes=jnp.full((depth, batch), tree.capacity, jnp.int32),
        actions=integers,
        costs=floats,
        means=floats,
        visits=integers,
    )

    def goes_on(rollout: Rollout) -> Bool[Array, ""]:
        return jnp.any(rollout.active) & (rollout.level < depth)

    return jax.lax.while_loop(goes_on, lambda rollout: _descend_once(context, tree, rollout, config), vary_alike(start))


def _descend_once(context: Context, tree: UctTree, rollout: Rollout, config: UctConfig) -> Rollout:
    """Take one action in every row that is still going, and sample its outcome."""
    model, node, level = context.model, rollout.node, rollout.level
    rows = model.rows
    action, available = _select_action(model, tree, node, config.exploration)
    moves = rollout.active & available
    # The simulation's number is the row's own: rows of a batch that end at different times do not share samples.
    success = uniform(context.seeds, tree.simulations, level) < tree.chances[rows, node, action]
    # What is sampled is the cost of Eq. 3: D, then R_S or R_F.
    costs = tree.success_costs[rows, node, action], model.tables.actions.failure_cost[rows, action]
    cost = tree.distances[rows, node, action] + jnp.where(success, *costs)
    # An outcome that satisfies the task has no node: the rollout ends there.
    child = tree.children[rows, node, action, success.astype(jnp.int32)]
    accepted = moves & success & model.accepts[rows, action]
    expands = moves & ~accepted & (child == UctTree.UNVISITED)
    deeper = moves & ~accepted & ~expands

    def record(array: Array, new: Array) -> Array:
        return jax.lax.dynamic_update_index_in_dim(array, new, level, 0)

    return Rollout(
        level=level + 1,
        # A row without an action has arrived at a dead end, and ends at its node.
        active=deeper,
        node=jnp.where(deeper, child, node),
        action=jnp.where(moves, action, rollout.action),
        success=jnp.where(moves, success, rollout.success),
        expands=rollout.expands | expands,
        accepted=rollout.accepted | accepted,
        nodes=record(rollout.nodes, jnp.where(moves, node, tree.capacity)),
        actions=record(rollout.actions, action),
        costs=record(rollout.costs, cost),
        means=record(rollout.means, tree.q_values[rows, node, action]),
        visits=record(rollout.visits, tree.visits[rows, node, action]),
    )


def _select_action(
    model: Model, tree: UctTree, node: Int32[Array, "B"], exploration: float
) -> tuple[Int32[Array, "B"], Bool[Array, "B"]]:
    """UCB1 on costs: the action of least lower confidence bound, and whether there is one."""
    rows = model.rows
    # Two rows and a number per level: as in the default search, the cost does not depend on the tree's size.
    q_values, visits, total = tree.q_values[rows, node], tree.visits[rows, node], tree.node_visits[rows, node]
    # log(n) with n >= 2: at the first visit every action is untried, and the width does not matter.
    log = jnp.log(jnp.maximum(total.astype(jnp.float32) + 1.0, 2.0))
    # A root of the quotient, which every program rounds alike; a reciprocal root may be an approximation.
    root = jnp.sqrt(log[:, None] / jnp.maximum(visits, 1).astype(jnp.float32))
    width = rounded_product(jnp.float32(exploration), root)
    # Each action is tried once before any is tried twice. inf stays inf where an action is not available.
    score = jnp.where(jnp.isinf(q_values), jnp.inf, jnp.where(visits == 0, -jnp.inf, q_values - width))
    action, least = first_of_least(score)
    return action, least < jnp.inf


def _expand(context: Context, tree: UctTree, rollout: Rollout) -> tuple[UctTree, Leaf]:
    """Add the node of the outcome that has none."""
    model = context.model
    history = model.step(tree.history(model.rows, rollout.node), rollout.action, rollout.success)
    terms = jax.vmap(terms_of_all)(model.tables, history)
    # A rollout that did not leave the tree ends at its last node: a dead end, or the depth limit.
    # Kept per node: reading a row of Q values here, before they are written, would make XLA copy them all.
    is_dead = ~jnp.any(terms.available, axis=1)
    dead = jnp.where(rollout.expands, is_dead, tree.dead_end[model.rows, rollout.node]) & ~rollout.accepted
    # A full tree: the rollout still counts, but its last outcome gets no node.
    added = rollout.expands & (tree.size < tree.capacity)
    index = jnp.where(added, tree.size, tree.capacity)

    # Rows without a new node write to the spare one.
    def write(array: Array, new: Array) -> Array:
        return array.at[model.rows, index].set(new, mode="drop", unique_indices=True)

    overflow = status_of_rows(rollout.expands & ~added, Status.TREE_OVERFLOW)
    # Rows that are still active when the descent is over have reached the depth limit.
    overflow |= status_of_rows(rollout.active, Status.DEPTH_OVERFLOW)
    leaf = Leaf(
        child=jnp.where(added, tree.size, UctTree.UNVISITED),
        value=jnp.where(dead, model.dead_end_cost, 0.0),
    )
    tree = dataclasses.replace(
        tree,
        q_values=write(tree.q_values, _new_q_values(terms)),
        distances=write(tree.distances, terms.distance),
        chances=write(tree.chances, terms.success_probability),
        success_costs=write(tree.success_costs, terms.success_cost),
        dead_end=write(tree.dead_end, is_dead),
        size=tree.size + added.astype(jnp.int32),
        status=tree.status | overflow,
        **{name: write(getattr(tree, name), getattr(history, name)) for name in _HISTORY_FIELDS},
    )
    return tree, leaf


def _back_up(tree: UctTree, rollout: Rollout, leaf: Leaf) -> UctTree:
    """From the leaf to the root: the rollout's cost from each action on enters that action's mean."""
    rows = jnp.arange(tree.size.shape[0], dtype=jnp.int32)

    def ascend(carry):
        level, cost, tree = carry
        at = rows, rollout.nodes[level], rollout.actions[level]
        taken = rollout.nodes[level] < tree.capacity
        # From the leaf on, what remained to be paid after each action.
        cost = jnp.where(taken, cost + rollout.costs[level], cost)
        visits, mean = rollout.visits[level] + 1, rollout.means[level]
        # Rows that had ended write to the spare node. Its mean is inf, which must not become NaN.
        mean = jnp.where(taken, mean + (cost - mean) / visits.astype(jnp.float32), mean)
        tree = dataclasses.replace(
            tree,
            q_values=tree.q_values.at[at].set(mean, mode="drop", unique_indices=True),
            visits=tree.visits.at[at].set(visits, mode="drop", unique_indices=True),
            node_visits=tree.node_visits.at[at[:2]].add(1, mode="drop", unique_indices=True),
        )
        return level - 1, cost, tree

    # Beyond the leaf the rollout costs nothing, or a dead end.
    start = (rollout.level - 1, leaf.value, tree)
    tree = jax.lax.while_loop(lambda carry: carry[0] >= 0, ascend, vary_alike(start))[2]
    moved = rollout.nodes[0] < tree.capacity
    # The link of a node that was not added goes to the spare node.
    parent = jnp.where(leaf.child == UctTree.UNVISITED, tree.capacity, rollout.node)
    link = (rows, parent, rollout.action, rollout.success.astype(jnp.int32))
    return dataclasses.replace(
        tree,
        children=tree.children.at[link].set(leaf.child, mode="drop", unique_indices=True),
        simulations=tree.simulations + moved.astype(jnp.int32),
        steps=tree.steps + jnp.sum(rollout.nodes < tree.capacity, axis=0, dtype=jnp.int32),
    )
