"""Exact solution of Eq. 3 for problems that are small enough: the yardstick of the search.

Dynamic programming over (place, state, knowledge, visited), on the host. The way back that is owed never enters the
memo: an action either leaves the unknown region, and pays what is owed whatever it is, or goes on inside and pays
nothing, so the value of a history is ``min(owed + leave, stay)``.

Knowledge follows the rules of ``potlp_jax.planning.history``, here on Python integers as bit masks: the memo needs
hashable states, and one subgoal's transition is looked up instead of computed once it has occurred.

References:
  Bradley et al., Learning and Planning for Temporally Extended Tasks in Unknown Environments, ICRA 2021, Eq. 3.
"""

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.types import NO_ACTION, NO_CLASS, Status


class ProblemTooLarge(ValueError):  # noqa: N818 - named for what the caller can do about it
    """The problem has more states than the exact solver was allowed to look at."""


@dataclass(frozen=True)
class ExactSolution:
    """Optimum of Eq. 3.

    Attributes:
      value: expected cost of the best action; 0 where the task is satisfied, the dead-end cost at a dead end.
      q_values: expected cost of each action, inf where it is not available.
      action: index of the best action (ties: lowest index), or ``NO_ACTION``.
      states: entries of the memo.
      status: ``ACCEPTING_ROOT``, ``DEAD_END`` or ``OK``.
    """

    value: float
    q_values: Float64[np.ndarray, "A"]
    action: int
    states: int
    status: Status


class Settled(NamedTuple):
    """What is known about one subgoal: bit masks over conditions."""

    holds: int
    fails: int


class Position(NamedTuple):
    """A history without what it owes. ``visited`` is a bit mask, bit ``place * Z + state``."""

    place: int
    state: int
    knowledge: tuple[Settled, ...]
    visited: int


class Terms(NamedTuple):
    """P_S, R_S and R_F of an action given what is known at its subgoal; whether its condition is known to hold."""

    probability: float
    success_cost: float
    failure_cost: float
    certain: bool


class Continuation(NamedTuple):
    """Least cost of the actions that leave the unknown region, and of those that go on inside."""

    leave: float
    stay: float


def solve_exact(problem: PlanningProblem, *, max_states: int = 500_000) -> ExactSolution:
    """Solve one unbatched problem exactly, on the host, in double precision.

    Args:
      problem: the problem; ``problem.check()`` is called.
      max_states: entries of the memo after which to give up (1 to 2 kB each).

    Raises:
      ProblemError: the problem is not valid.
      ProblemTooLarge: more than ``max_states`` histories differ in what matters.
    """
    problem.check()
    rollouts = Rollouts(problem)
    solver = _Solver(rollouts, max_states)
    root = rollouts.root()
    q_values = np.full(problem.action_count, np.inf)
    if rollouts.accepting[root.state]:
        return ExactSolution(0.0, q_values, NO_ACTION, 0, Status.ACCEPTING_ROOT)
    with _deep_recursion():
        for action in rollouts.available(root):
            q_values[action] = rollouts.distance(root, action) + solver.attempt(root, action)
    best = int(np.argmin(q_values))
    if np.isinf(q_values[best]):
        return ExactSolution(rollouts.dead_end_cost, q_values, NO_ACTION, len(solver.memo), Status.DEAD_END)
    return ExactSolution(float(q_values[best]), q_values, best, len(solver.memo), Status.OK)


class Rollouts:
    """Histories of one problem as hashable tuples: what is available, what it costs, what comes of it.

    The rules are those of ``potlp_jax.planning.history``.
    """

    def __init__(self, problem: PlanningProblem) -> None:
        task = problem.task
        self.subgoals, self.states = problem.subgoal_count, task.state_mask.shape[0]
        self.finish_action = problem.action_count - 1
        self.dead_end_cost = float(problem.dead_end_cost)
        self.accepting = (np.asarray(task.accepting) & np.asarray(task.state_mask)).tolist()
        self.travel = np.asarray(problem.travel, np.float64).tolist()
        self.finish = np.asarray(problem.finish, np.float64).tolist()
        self._estimates = [
            np.asarray(values, np.float64).tolist()
            for values in (problem.success_probability, problem.success_cost, problem.failure_cost)
        ]
        self._initial_state = int(problem.dfa_state)
        self._edge_count = problem.edge_count
        self._real_subgoals = np.flatnonzero(problem.subgoal_mask).tolist()
        edges, conditions = np.asarray(task.edges), np.asarray(task.edge_condition)
        self._edges = {
            int(e): (int(edges[e, 0]), int(edges[e, 1]), int(conditions[e])) for e in np.flatnonzero(task.edge_mask)
        }
        self._closure = _Closure(np.asarray(task.implies), np.asarray(task.condition_classes), task.class_mask.shape[0])
        self._classes = [[int(c) for c in row if c != NO_CLASS] for row in np.asarray(task.condition_classes)]
        self._relevant = _relevant_conditions(np.asarray(problem.travel), list(self._edges.values()))
        self._terms: dict[tuple[int, int, Settled], Terms] = {}

    def root(self) -> Position:
        """At the robot, nothing known."""
        knowledge = (Settled(0, 0),) * self.subgoals
        visited = 1 << (self.subgoals * self.states + self._initial_state)
        return Position(self.subgoals, self._initial_state, knowledge, visited)

    def split(self, action: int) -> tuple[int, int, int, int]:
        """Subgoal, z', z'' and condition of an action other than finish."""
        return action // self._edge_count, *self._edges[action % self._edge_count]

    def terms(self, position: Position, action: int) -> Terms:
        """P_S, R_S, R_F given the history."""
        if action == self.finish_action:
            return Terms(1.0, 0.0, 0.0, False)
        subgoal, _, _, condition = self.split(action)
        settled = position.knowledge[subgoal]
        key = (subgoal, condition, settled)
        if key not in self._terms:
            self._terms[key] = self._combine(subgoal, condition, settled)
        return self._terms[key]

    def stays_inside(self, position: Position, action: int) -> bool:
        """Whether the action goes on beyond the same subgoal in the same state, so that nothing is paid before it."""
        if action == self.finish_action:
            return False
        subgoal, source, _, _ = self.split(action)
        return subgoal == position.place and source == position.state

    def distance(self, position: Position, action: int) -> float:
        """D without what is owed; inf where the action is out of reach."""
        if action == self.finish_action:
            return self.finish[position.place][position.state]
        if self.stays_inside(position, action):
            return 0.0
        subgoal, source, _, _ = self.split(action)
        return self.travel[position.place][position.state][subgoal][source]

    def available(self, position: Position) -> Iterator[int]:
        """Actions by increasing index."""
        if self.accepting[position.state]:
            return
        for subgoal in self._real_subgoals:
            for edge, (_, target, _) in self._edges.items():
                action = subgoal * self._edge_count + edge
                if math.isinf(self.distance(position, action)):
                    continue
                terms = self.terms(position, action)
                leads_back = terms.certain and position.visited >> (subgoal * self.states + target) & 1
                if terms.probability > 0 and not leads_back:
                    yield action
        if math.isfinite(self.finish[position.place][position.state]):
            yield self.finish_action

    def step(self, position: Position, action: int, success: bool) -> Position:
        """The history after an available action other than finish."""
        subgoal, source, target, condition = self.split(action)
        settled = position.knowledge[subgoal]
        state = target if success else source
        here = 1 << (subgoal * self.states + state)
        if settled.holds >> condition & 1:
            return position._replace(place=subgoal, state=state, visited=position.visited | here)
        after = self._closure.settle(settled, condition, success)
        knowledge = (*position.knowledge[:subgoal], after, *position.knowledge[subgoal + 1 :])
        return Position(subgoal, state, knowledge, here)

    def essence(self, position: Position) -> Position:
        """Equal for histories with equal futures: without knowledge about conditions that can matter no more, and
        without visits that no certain action could repeat."""
        relevant = self._relevant[position.state]
        knowledge = position.knowledge
        if not self._closure.has_compounds:
            # Without conditions of several cubes, what is known of one condition says nothing new about another.
            knowledge = tuple(Settled(k.holds & relevant, k.fails & relevant) for k in knowledge)
        repeatable = 0
        for subgoal in self._real_subgoals:
            holds = knowledge[subgoal].holds & relevant
            if holds:
                for _, target, condition in self._edges.values():
                    repeatable |= (holds >> condition & 1) << (subgoal * self.states + target)
        return Position(position.place, position.state, knowledge, position.visited & repeatable)

    def _combine(self, subgoal: int, condition: int, settled: Settled) -> Terms:
        """P_S, R_S, R_F of a condition from its cubes, tried in order of R_S (MODEL.md section 3)."""
        probabilities, success_costs, failure_costs = (values[subgoal] for values in self._estimates)
        classes = self._classes[condition]
        certain = bool(settled.holds >> condition & 1)
        none_yet, weighted, possible = 1.0, 0.0, []
        for c in sorted(classes, key=lambda c: (success_costs[c], c)):
            failed, held = settled.fails >> c & 1, settled.holds >> c & 1
            chance = 1.0 if held else 0.0 if failed else probabilities[c]
            weighted += none_yet * chance * success_costs[c]
            none_yet *= 1.0 - chance
            possible += [] if failed else [success_costs[c]]
        total = 1.0 - none_yet
        success_cost = weighted / total if total > 0 else min(possible, default=0.0)
        probability = 1.0 if certain else 0.0 if settled.fails >> condition & 1 else total
        return Terms(probability, success_cost, max(failure_costs[c] for c in classes), certain)


class _Solver:
    """Memoised recursion over the histories that differ in what matters."""

    def __init__(self, rollouts: Rollouts, max_states: int) -> None:
        self.memo: dict[Position, Continuation] = {}
        self._rollouts, self._max_states = rollouts, max_states

    def attempt(self, position: Position, action: int) -> float:
        """Expected cost of an action from its subgoal on."""
        rollouts = self._rollouts
        if action == rollouts.finish_action:
            return 0.0
        terms = rollouts.terms(position, action)
        success = rollouts.step(position, action, True)
        cost = terms.probability * (terms.success_cost + self._value(success, terms.success_cost))
        if terms.probability < 1.0:
            failure = rollouts.step(position, action, False)
            cost += (1.0 - terms.probability) * (terms.failure_cost + self._value(failure, terms.failure_cost))
        return cost

    def _value(self, position: Position, owed: float) -> float:
        if self._rollouts.accepting[position.state]:
            return 0.0
        continuation = self._continue(position)
        best = min(owed + continuation.leave, continuation.stay)
        return self._rollouts.dead_end_cost if math.isinf(best) else best

    def _continue(self, position: Position) -> Continuation:
        key = self._rollouts.essence(position)
        if key in self.memo:
            return self.memo[key]
        leave = stay = math.inf
        for action in self._rollouts.available(position):
            cost = self._rollouts.distance(position, action) + self.attempt(position, action)
            if self._rollouts.stays_inside(position, action):
                stay = min(stay, cost)
            else:
                leave = min(leave, cost)
        if len(self.memo) >= self._max_states:
            raise ProblemTooLarge(
                f"more than {self._max_states} states with {self._rollouts.subgoals} subgoals: raise max_states, or "
                "use plan_actions"
            )
        self.memo[key] = Continuation(leave, stay)
        return self.memo[key]


class _Closure:
    """Transitions of what is known about one subgoal, looked up once they have occurred."""

    def __init__(self, implies: np.ndarray, classes: np.ndarray, class_count: int) -> None:
        count = len(implies)
        self._forward = [_mask(implies[a]) for a in range(count)]
        self._backward = [_mask(implies[:, b]) for b in range(count)]
        self._compounds = [
            (m, sum(1 << int(c) for c in classes[m] if c != NO_CLASS))
            for m in range(class_count, count)
            if implies[m, m]
        ]
        self._known: dict[tuple[Settled, int, bool], Settled] = {}

    @property
    def has_compounds(self) -> bool:
        """Whether a condition has several cubes."""
        return bool(self._compounds)

    def settle(self, settled: Settled, condition: int, success: bool) -> Settled:
        """What is known once the condition has held or failed."""
        key = (settled, condition, success)
        if key not in self._known:
            holds = settled.holds | (self._forward[condition] if success else 0)
            fails = settled.fails | (0 if success else self._backward[condition])
            if self._compounds:
                fails = self._propagate(fails)
                refuting = (x for x, backward in enumerate(self._backward) if self._propagate(fails | backward) & holds)
                holds = sum(1 << x for x in refuting)
            self._known[key] = Settled(holds, fails)
        return self._known[key]

    def _propagate(self, fails: int) -> int:
        """All cubes of a condition fail, so it fails, and so does what implies it."""
        before = -1
        while before != fails:
            before = fails
            for condition, cubes in self._compounds:
                if not cubes & ~fails:
                    fails |= self._backward[condition]
        return fails


def _relevant_conditions(travel: np.ndarray, edges: list[tuple[int, int, int]]) -> list[int]:
    """Per state, the conditions of edges that can still be attempted, as a mask."""
    count = travel.shape[1]
    reach = np.eye(count, dtype=bool) | np.isfinite(travel).any(axis=(0, 2))
    for source, target, _ in edges:
        reach[source, target] = True
    for via in range(count):
        reach |= reach[:, [via]] & reach[[via]]
    relevant = [0] * count
    for state in range(count):
        for source, _, condition in edges:
            if reach[state, source]:
                relevant[state] |= 1 << condition
    return relevant


def _mask(flags: np.ndarray) -> int:
    return sum(1 << int(i) for i in np.flatnonzero(flags))


@contextmanager
def _deep_recursion(limit: int = 100_000) -> Iterator[None]:
    """A rollout may be thousands of actions long; from Python 3.11 on such calls take no C stack."""
    before = sys.getrecursionlimit()
    sys.setrecursionlimit(max(before, limit))
    try:
        yield
    finally:
        sys.setrecursionlimit(before)
