"""PO-UCT as the paper's authors run it, in Numba: one tree, one thread, no JAX.

One simulation walks from the root to acceptance, to a dead end or to a history that the tree does not hold yet; that
history becomes a node, and its value is the cost so far: nothing is added for what lies beyond it, except the dead-end
cost where nothing can be done there. Outcomes are drawn with P_S, backups are means, an action is taken by the least

    mean cost - C * sqrt(log(visits of the node) / visits of the action),    C = 50,

untried actions first, by index. The answer is the action tried most often.

What is available, what it costs and what follows from an outcome is that of ``potlp_jax.planning.history``, conditions
of several cubes included. A node keeps its history as bit masks, and lists its actions - availability, P_S and costs
worked out once - when it is visited for the second time, since most leaves never are. Arrays are few and passed one by
one: reaching into tuples of arrays costs Numba several times what the search itself does.

References:
  Bradley et al., Learning and Planning for Temporally Extended Tasks in Unknown Environments, ICRA 2021, III-C.
  Silver and Veness, Monte-Carlo Planning in Large POMDPs, NIPS 2010.
"""

import importlib
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.types import NO_ACTION, NO_CLASS

numba: Any = importlib.import_module("numba")
"""By name: an optional package."""

MASK_BITS = 64
"""Conditions, and states, must fit in one machine word."""

UNVISITED = -1
"""In place of a child: the outcome has not been drawn yet. In place of a list of actions: not made yet."""

ACCEPTED = -2
"""In place of a child: the outcome satisfies the task."""

FINISH = -1
"""Condition of the finish action."""

# Columns of Model.options.
SUBGOAL, SOURCE, TARGET, CONDITION, INDEX, ACCEPTS = range(6)
# Columns of Tree.where.
LOCATION, STATE, VISITS, FIRST, COUNT = range(5)
# Columns of Tree.links; children are at FAILED + outcome.
OPTION, TRIED, FAILED, SUCCEEDED = range(4)
# Columns of Tree.terms.
TOTAL, PROBABILITY, DISTANCE, FAILURE_COST, SUCCESS_COST = range(5)


class Model(NamedTuple):
    """A planning problem as plain arrays.

    Options are its real actions, finish last: columns ``SUBGOAL``, ``SOURCE``, ``TARGET``, ``CONDITION``, ``INDEX``
    (the library's index of the action) and ``ACCEPTS`` (success satisfies the task).

    Attributes:
      options: ``[n, 6]``.
      candidates: options that can be reached from a location and state, those of one pair side by side.
      path_costs: their D without the pending cost; -1 where the robot is inside already, so that nothing is paid.
      ranges: ``[S+1, Z, 2]``, the first candidate of a location and state, and their number; none in accepting states.
      cubes: ``[n, K]``, classes of the option's condition in order of R_S, then ``NO_CLASS``.
      cube_terms: ``[n, K, 2]``, their P_S and R_S.
      failure_cost: ``[n]``, R_F.
      forward: ``[M]``, bit mask of the conditions that a condition implies.
      backward: ``[M]``, bit mask of those that imply it.
      compounds: ``[Q]``, the conditions of several cubes.
      compound_cubes: ``[Q]``, bit mask of the cubes of each.
    """

    options: np.ndarray
    candidates: np.ndarray
    path_costs: np.ndarray
    ranges: np.ndarray
    cubes: np.ndarray
    cube_terms: np.ndarray
    failure_cost: np.ndarray
    forward: np.ndarray
    backward: np.ndarray
    compounds: np.ndarray
    compound_cubes: np.ndarray


class Tree(NamedTuple):
    """Nodes and the actions they have listed; those of one node side by side.

    Attributes:
      where: ``[N, 5]``, columns ``LOCATION``, ``STATE``, ``VISITS``, ``FIRST`` (of its actions), ``COUNT``.
      pending_cost: ``[N]``, paid by the next action that leaves the unknown region.
      masks: ``[N, 3S+1]``, what holds and what fails at each subgoal, and the states visited at each node.
      links: ``[P, 4]``, columns ``OPTION``, ``TRIED`` (visits), ``FAILED``, ``SUCCEEDED`` (children).
      terms: ``[P, 5]``, columns ``TOTAL`` (sum of sampled costs), ``PROBABILITY``, ``DISTANCE``, ``FAILURE_COST``,
        ``SUCCESS_COST``.
      means: ``[P]``, mean cost, -inf where untried.
      widths: ``[P]``, 1 / sqrt(visits).
    """

    where: np.ndarray
    pending_cost: np.ndarray
    masks: np.ndarray
    links: np.ndarray
    terms: np.ndarray
    means: np.ndarray
    widths: np.ndarray


_jit: Any = numba.njit(cache=True, nogil=True)
_jit_inline: Any = numba.njit(cache=True, nogil=True, inline="always")
_jit_call: Any = numba.njit(cache=True, nogil=True, forceinline=True)
_jit_fast: Any = numba.njit(cache=True, nogil=True, fastmath={"nnan", "nsz", "contract", "reassoc"})


def model_of(problem: PlanningProblem) -> Model:
    """The arrays of one unbatched problem.

    Raises:
      ValueError: more than 64 conditions or states.
    """
    task = problem.task
    classes = np.asarray(task.condition_classes)
    if max(len(classes), task.state_mask.shape[0]) > MASK_BITS:
        raise ValueError(
            f"the task has {len(classes)} conditions and {task.state_mask.shape[0]} states: this search takes "
            f"{MASK_BITS} of each at most"
        )
    options = _options(problem)
    candidates, path_costs, ranges = _candidates(problem, options)
    cubes, cube_terms, failure_cost = _estimates(problem, options)
    implies = np.asarray(task.implies)
    compounds = np.flatnonzero(((classes != NO_CLASS).sum(axis=1) > 1) & np.asarray(task.condition_mask))
    return Model(
        options=options,
        candidates=candidates,
        path_costs=path_costs,
        ranges=ranges,
        cubes=cubes,
        cube_terms=cube_terms,
        failure_cost=failure_cost,
        forward=_words([np.flatnonzero(row) for row in implies]),
        backward=_words([np.flatnonzero(row) for row in implies.T]),
        compounds=compounds,
        compound_cubes=_words([classes[m][classes[m] != NO_CLASS] for m in compounds]),
    )


def _options(problem: PlanningProblem) -> np.ndarray:
    task, robot = problem.task, problem.subgoal_count
    accepting = np.asarray(task.accepting) & np.asarray(task.state_mask)
    edges, conditions = np.asarray(task.edges), np.asarray(task.edge_condition)
    rows = [
        (s, edges[e, 0], edges[e, 1], conditions[e], s * problem.edge_count + e, accepting[edges[e, 1]])
        for s in np.flatnonzero(problem.subgoal_mask)
        for e in np.flatnonzero(task.edge_mask)
    ]
    return np.array([*rows, (robot, -1, -1, FINISH, robot * problem.edge_count, 1)], np.int32)


def _candidates(problem: PlanningProblem, options: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    travel, finish = np.asarray(problem.travel, np.float64), np.asarray(problem.finish, np.float64)
    accepting = np.asarray(problem.task.accepting) & np.asarray(problem.task.state_mask)
    candidates, path_costs, ranges = [], [], np.zeros((*finish.shape, 2), np.int32)
    for location, state in np.ndindex(*finish.shape):
        path_cost = np.append(
            travel[location, state, options[:-1, SUBGOAL], options[:-1, SOURCE]], finish[location, state]
        )
        path_cost[(options[:, SUBGOAL] == location) & (options[:, SOURCE] == state)] = -1.0
        own = np.flatnonzero(np.isfinite(path_cost)) if not accepting[state] else np.zeros(0, np.int64)
        ranges[location, state] = len(candidates), len(own)
        candidates.extend(own)
        path_costs.extend(path_cost[own])
    return np.array(candidates, np.int32), np.array(path_costs, np.float64), ranges


def _estimates(problem: PlanningProblem, options: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    classes = np.asarray(problem.task.condition_classes)
    probability, success, failure = (
        np.asarray(values, np.float64)
        for values in (problem.success_probability, problem.success_cost, problem.failure_cost)
    )
    cubes = np.full((len(options), max(classes.shape[1], 1)), NO_CLASS, np.int32)
    terms, failure_cost = np.zeros((*cubes.shape, 2)), np.zeros(len(options))
    for row, (s, _, _, condition, *_) in enumerate(options[:-1]):
        own = sorted((c for c in classes[condition] if c != NO_CLASS), key=lambda c, s=s: (success[s, c], c))
        cubes[row, : len(own)] = own
        terms[row, : len(own)] = np.stack([probability[s, own], success[s, own]], axis=-1)
        failure_cost[row] = failure[s, own].max()
    return cubes, terms, failure_cost


def _words(sets: list[np.ndarray]) -> np.ndarray:
    return np.array([sum(1 << int(member) for member in members) for members in sets], np.uint64)


@_jit_inline
def _bit(index: int) -> Any:
    return np.uint64(1) << np.uint64(index)


@_jit_inline
def _chances(option: int, cubes: np.ndarray, cube_terms: np.ndarray, holds: Any, fails: Any) -> tuple[float, float]:
    """P_S and R_S of an option's cubes, tried in order of R_S, from what is known at its subgoal."""
    none_yet, weighted, least = 1.0, 0.0, math.inf
    for k in range(cubes.shape[1]):
        if cubes[option, k] >= 0:
            cube = _bit(cubes[option, k])
            if fails & cube == 0:
                chance = 1.0 if holds & cube != 0 else cube_terms[option, k, 0]
                least = min(least, cube_terms[option, k, 1])
                weighted += none_yet * chance * cube_terms[option, k, 1]
                none_yet *= 1.0 - chance
    total = 1.0 - none_yet
    return total, (weighted / total if total > 0.0 else (least if least < math.inf else 0.0))


@_jit
def _propagate(fails: Any, backward: np.ndarray, compounds: np.ndarray, compound_cubes: np.ndarray) -> Any:
    """All cubes of a condition fail, so it fails, and so does what implies it."""
    before = ~fails
    while before != fails:
        before = fails
        for q in range(len(compounds)):
            if compound_cubes[q] & ~fails == 0:
                fails |= backward[compounds[q]]
    return fails


@_jit
def _close(
    holds: Any, fails: Any, backward: np.ndarray, compounds: np.ndarray, compound_cubes: np.ndarray
) -> tuple[Any, Any]:
    """What follows where conditions have several cubes: one holds if its failure would refute what is known to hold."""
    fails = _propagate(fails, backward, compounds, compound_cubes)
    found = np.uint64(0)
    for m in range(len(backward)):
        if _propagate(fails | backward[m], backward, compounds, compound_cubes) & holds != 0:
            found |= _bit(m)
    return found, fails


@_jit_call
def list_actions(
    node: int,
    first: int,
    most: int,
    options: np.ndarray,
    candidates: np.ndarray,
    path_costs: np.ndarray,
    ranges: np.ndarray,
    cubes: np.ndarray,
    cube_terms: np.ndarray,
    failure_cost: np.ndarray,
    where: np.ndarray,
    pending_cost: np.ndarray,
    masks: np.ndarray,
    links: np.ndarray,
    terms: np.ndarray,
    means: np.ndarray,
    widths: np.ndarray,
) -> int:
    """Write the available actions of a node from ``first`` on, at most ``most``; returns their number.

    ``most = 1`` asks whether there is any, and leaves one behind that is to be overwritten.
    """
    location, state = where[node, LOCATION], where[node, STATE]
    subgoals = ranges.shape[0] - 1
    begin = ranges[location, state, 0]
    count = 0
    for i in range(begin, begin + ranges[location, state, 1]):
        option = candidates[i]
        condition = options[option, CONDITION]
        probability, success_cost = 1.0, 0.0
        if condition != FINISH:
            s = options[option, SUBGOAL]
            holds, fails = masks[node, s], masks[node, subgoals + s]
            probability, success_cost = _chances(option, cubes, cube_terms, holds, fails)
            if holds & _bit(condition) != 0:
                probability = 1.0
                if masks[node, 2 * subgoals + s] & _bit(options[option, TARGET]) != 0:
                    continue
            elif fails & _bit(condition) != 0 or probability == 0.0:
                continue
        at = first + count
        links[at, OPTION] = option
        links[at, TRIED] = 0
        links[at, FAILED] = UNVISITED
        links[at, SUCCEEDED] = ACCEPTED if options[option, ACCEPTS] else UNVISITED
        terms[at, TOTAL] = 0.0
        terms[at, PROBABILITY] = probability
        terms[at, DISTANCE] = 0.0 if path_costs[i] < 0.0 else path_costs[i] + pending_cost[node]
        terms[at, FAILURE_COST] = failure_cost[option]
        terms[at, SUCCESS_COST] = success_cost
        means[at] = -math.inf
        widths[at] = 0.0
        count += 1
        if count == most:
            break
    return count


@_jit_call
def add_node(
    node: int,
    parent: int,
    at: int,
    success: bool,
    options: np.ndarray,
    forward: np.ndarray,
    backward: np.ndarray,
    compounds: np.ndarray,
    compound_cubes: np.ndarray,
    where: np.ndarray,
    pending_cost: np.ndarray,
    masks: np.ndarray,
    links: np.ndarray,
    terms: np.ndarray,
) -> None:
    """Write as ``node`` the history that follows ``parent`` after its action ``at`` with the given outcome."""
    option = links[at, OPTION]
    s, condition = options[option, SUBGOAL], options[option, CONDITION]
    state = options[option, TARGET] if success else options[option, SOURCE]
    subgoals = (masks.shape[1] - 1) // 3
    certain = masks[parent, s] & _bit(condition) != 0
    for i in range(masks.shape[1]):
        masks[node, i] = masks[parent, i]
    if not certain:
        holds, fails = masks[parent, s], masks[parent, subgoals + s]
        if success:
            holds |= forward[condition]
        else:
            fails |= backward[condition]
        if len(compounds) > 0:
            holds, fails = _close(holds, fails, backward, compounds, compound_cubes)
        masks[node, s], masks[node, subgoals + s] = holds, fails
        for i in range(2 * subgoals, masks.shape[1]):
            masks[node, i] = 0
    masks[node, 2 * subgoals + s] |= _bit(state)
    where[node, LOCATION], where[node, STATE] = s, state
    where[node, VISITS], where[node, FIRST], where[node, COUNT] = 0, UNVISITED, 0
    pending_cost[node] = terms[at, SUCCESS_COST] if success else terms[at, FAILURE_COST]


@_jit_fast
def _choose(means: np.ndarray, widths: np.ndarray, first: int, count: int, weight: float) -> int:
    """The action of least ``mean - weight * width``, ties by index: a minimum, then where it is attained."""
    scale, least = np.float32(weight), np.float32(math.inf)
    for i in range(first, first + count):
        least = min(least, means[i] - scale * widths[i])
    for i in range(first, first + count):
        if means[i] - scale * widths[i] <= least:
            return i
    return first


@_jit_inline
def _uniform(random_state: np.ndarray) -> float:
    """Uniform in [0, 1): SplitMix64 (Steele et al. 2014)."""
    random_state[0] += np.uint64(0x9E3779B97F4A7C15)
    bits = random_state[0]
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    bits = bits ^ (bits >> np.uint64(31))
    return float(bits >> np.uint64(11)) * 2.0**-53


@_jit
def _simulate_many(
    simulations: int,
    dead_end_cost: float,
    model: Model,
    tree: Tree,
    counters: np.ndarray,
    random_state: np.ndarray,
    root_log: np.ndarray,
    inverse_root: np.ndarray,
    path: np.ndarray,
    paid: np.ndarray,
) -> int:
    """Run simulations until their number or the memory is used up; returns how many were run.

    ``counters``: nodes in use, actions in use, levels descended. ``root_log[n] = C * sqrt(log n)``,
    ``inverse_root[n] = 1 / sqrt(n)``. ``path`` and ``paid`` keep a simulation's nodes and actions, and what had been
    paid before each. A simulation adds at most one node, lists the actions of at most one and looks at another.
    """
    options, candidates, path_costs, ranges, cubes, cube_terms, failure_cost = model[:7]
    forward, backward, compounds, compound_cubes = model[7:]
    where, pending_cost, masks, links, terms, means, widths = tree
    most = len(options)
    for simulation in range(simulations):
        if counters[0] == len(pending_cost) or counters[1] + 2 * most > len(means):
            return simulation
        node, depth, cost = 0, 0, 0.0
        while True:
            if where[node, FIRST] == UNVISITED:
                count = list_actions(
                    node, counters[1], most, options, candidates, path_costs, ranges, cubes, cube_terms, failure_cost,
                    where, pending_cost, masks, links, terms, means, widths,
                )  # fmt: skip
                where[node, FIRST], where[node, COUNT] = counters[1], count
                counters[1] += count
            if where[node, COUNT] == 0:
                cost += dead_end_cost
                break
            at = _choose(means, widths, where[node, FIRST], where[node, COUNT], root_log[where[node, VISITS]])
            path[depth, 0], path[depth, 1], paid[depth] = node, at, cost
            depth += 1
            success = _uniform(random_state) < terms[at, PROBABILITY]
            outcome = 1 if success else 0
            cost += terms[at, DISTANCE] + terms[at, FAILURE_COST + outcome]
            child = links[at, FAILED + outcome]
            if child == ACCEPTED:
                break
            if child == UNVISITED:
                child = counters[0]
                counters[0] += 1
                links[at, FAILED + outcome] = child
                add_node(
                    child, node, at, success, options, forward, backward, compounds, compound_cubes,
                    where, pending_cost, masks, links, terms,
                )  # fmt: skip
                count = list_actions(
                    child, counters[1], 1, options, candidates, path_costs, ranges, cubes, cube_terms, failure_cost,
                    where, pending_cost, masks, links, terms, means, widths,
                )  # fmt: skip
                if count == 0:
                    cost += dead_end_cost
                break
            node = child
        counters[2] += depth
        for level in range(depth):
            at = path[level, 1]
            links[at, TRIED] += 1
            terms[at, TOTAL] += cost - paid[level]
            means[at] = terms[at, TOTAL] / links[at, TRIED]
            widths[at] = inverse_root[links[at, TRIED]]
            where[path[level, 0], VISITS] += 1
    return simulations


@dataclass(frozen=True)
class RootStatistics:
    """What a search says of its root.

    Attributes:
      most_visited: the published choice (ties: lowest index), or ``NO_ACTION`` where there is no action.
      least_mean: the action of least mean cost among those tried, or ``NO_ACTION``.
      visits: simulations that began with each action ``[A]``.
      means: their mean cost ``[A]``, inf where untried.
      simulations: simulations run so far.
      mean_depth: actions per simulation.
      nodes: nodes of the tree.
    """

    most_visited: int
    least_mean: int
    visits: np.ndarray
    means: np.ndarray
    simulations: int
    mean_depth: float
    nodes: int


class Histories:
    """Histories of one problem, made on demand: node 0 is the robot's, every node lists its actions once.

    Attributes:
      model: the problem.
      tree: the nodes; rows beyond those in use hold anything.
    """

    def __init__(self, problem: PlanningProblem) -> None:
        self.model = model_of(problem)
        self.tree = _new_tree(problem, len(self.model.options))
        self._counters = np.array([1, 0, 0], np.int64)

    @property
    def size(self) -> int:
        """Nodes in use."""
        return int(self._counters[0])

    def listed(self, node: int) -> range:
        """Rows of the node's available actions in ``tree.links`` and ``tree.terms``."""
        if self.tree.where[node, FIRST] == UNVISITED:
            first, most = int(self._counters[1]), len(self.model.options)
            self._reserve(0, most)
            self.tree.where[node, FIRST] = first
            self.tree.where[node, COUNT] = list_actions(node, first, most, *self.model[:7], *self.tree)
            self._counters[1] += self.tree.where[node, COUNT]
        first, count = self.tree.where[node, FIRST : COUNT + 1].tolist()
        return range(first, first + count)

    def follow(self, node: int, at: int, success: bool) -> int:
        """The node after the action in row ``at``, or ``ACCEPTED``."""
        if self.tree.links[at, FAILED + success] == UNVISITED:
            child = int(self._counters[0])
            self._reserve(1, 0)
            self.tree.links[at, FAILED + success] = child
            add_node(child, node, at, success, self.model.options, *self.model[7:], *self.tree[:5])
            self._counters[0] += 1
        return int(self.tree.links[at, FAILED + success])

    def _reserve(self, nodes: int, actions: int) -> None:
        """Room for more nodes and actions: twice as much as before where there is not enough."""
        have_nodes, have_actions = len(self.tree.pending_cost), len(self.tree.means)
        nodes, actions = int(self._counters[0]) + nodes, int(self._counters[1]) + actions
        if nodes > have_nodes or actions > have_actions:
            nodes = have_nodes if nodes <= have_nodes else 2 * nodes
            self.tree = _grown(self.tree, nodes, have_actions if actions <= have_actions else 2 * actions)


class NumbaSearch(Histories):
    """A search of one problem that can be continued."""

    def __init__(self, problem: PlanningProblem, *, seed: int = 0, exploration: float = 50.0) -> None:
        """Prepare the search.

        Args:
          problem: the unbatched problem.
          seed: of the outcomes drawn.
          exploration: C, in the unit of cost.
        """
        super().__init__(problem)
        self._action_count, self._dead_end_cost = problem.action_count, float(problem.dead_end_cost)
        self._exploration = exploration
        self._random_state = np.array([seed], np.uint64)
        self._simulations = 0

    def run(self, simulations: int) -> None:
        """Add simulations."""
        counts = np.maximum(np.arange(self._simulations + simulations + 1), 1.0)
        tables = self._exploration * np.sqrt(np.log(counts)), (1.0 / np.sqrt(counts)).astype(np.float32)
        path, paid = np.empty((len(counts), 2), np.int32), np.empty(len(counts))
        self._reserve(simulations, len(self.model.options) * min(simulations + 2, 4096))
        left = simulations
        while left > 0:
            state = self._counters, self._random_state
            left -= _simulate_many(left, self._dead_end_cost, self.model, self.tree, *state, *tables, path, paid)
            if left > 0:
                self.tree = _grown(self.tree, len(self.tree.pending_cost), 2 * len(self.tree.means))
        self._simulations += simulations

    def statistics(self) -> RootStatistics:
        """What the root knows now."""
        first = int(self.tree.where[0, FIRST])
        here = slice(first, first + int(self.tree.where[0, COUNT])) if first >= 0 else slice(0, 0)
        index = self.model.options[self.tree.links[here, OPTION], INDEX]
        visits, means = np.zeros(self._action_count, np.int64), np.full(self._action_count, np.inf)
        visits[index] = self.tree.links[here, TRIED]
        means[index] = np.where(visits[index] > 0, self.tree.means[here], np.inf)
        return RootStatistics(
            most_visited=int(np.argmax(visits)) if visits.any() else NO_ACTION,
            least_mean=int(np.argmin(means)) if visits.any() else NO_ACTION,
            visits=visits,
            means=means,
            simulations=self._simulations,
            mean_depth=float(self._counters[2]) / max(self._simulations, 1),
            nodes=self.size,
        )


def _new_tree(problem: PlanningProblem, most: int) -> Tree:
    """The root: at the robot, nothing known, nothing pending."""
    robot, state = problem.subgoal_count, int(problem.dfa_state)
    masks = np.zeros((1, 3 * robot + 1), np.uint64)
    masks[0, 3 * robot] = 1 << state
    return Tree(
        where=np.array([[robot, state, 0, UNVISITED, 0]], np.int32),
        pending_cost=np.zeros(1),
        masks=masks,
        links=np.zeros((2 * most, 4), np.int32),
        terms=np.zeros((2 * most, 5)),
        means=np.zeros(2 * most, np.float32),
        widths=np.zeros(2 * most, np.float32),
    )


_NODE_FIELDS = ("where", "pending_cost", "masks")


def _grown(tree: Tree, nodes: int, actions: int) -> Tree:
    """The tree with more room; the new rows hold anything."""
    arrays = {}
    for name, old in tree._asdict().items():
        arrays[name] = np.empty((nodes if name in _NODE_FIELDS else actions, *old.shape[1:]), old.dtype)
        arrays[name][: len(old)] = old
    return Tree(**arrays)
