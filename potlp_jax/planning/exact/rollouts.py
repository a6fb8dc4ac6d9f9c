"""Histories of one planning problem on the host: what is available, what it costs, what comes of it.

The rules are those of ``potlp_jax.planning.history``, in double precision and on Python tuples, for callers that look
at one history at a time or tabulate what can be known beforehand.

References:
  Bradley et al., Learning and Planning for Temporally Extended Tasks in Unknown Environments, ICRA 2021, section III.
  Dowling and Gallier, Linear-time algorithms for testing the satisfiability of propositional Horn formulae, Journal of
  Logic Programming 1984 (why unit propagation finds all that follows).
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.types import NO_CLASS


class SubgoalKnowledge(NamedTuple):
    """What is known about one subgoal: bit masks over conditions."""

    holds: int
    fails: int


class Position(NamedTuple):
    """A history without its pending cost. ``visited`` is a bit mask, bit ``location * Z + state``."""

    location: int
    state: int
    knowledge: tuple[SubgoalKnowledge, ...]
    visited: int


class Terms(NamedTuple):
    """P_S, R_S and R_F of an action given what is known at its subgoal; whether its condition is known to hold."""

    probability: float
    success_cost: float
    failure_cost: float
    certain: bool


class Rollouts:
    """The rules of one unbatched problem; its histories are ``Position``s.

    Attributes:
      subgoals, states: S and Z, padding included; ``real_subgoals`` are the indices of those that exist.
      edge_count: E, padding included; ``edges`` has (z', z'', condition) of each real edge by its index.
      finish_action: index of going to acceptance through known space, the last action.
      dead_end_cost: cost of a dead end.
      accepting: ``[Z]``, real accepting states.
      travel: ``[S + 1][Z][S][Z]``, finish: ``[S + 1][Z]``: path costs, inf where there is none.
      closure: what follows from the outcome of an attempt.
    """

    def __init__(self, problem: PlanningProblem) -> None:
        task = problem.task
        self.subgoals, self.states = problem.subgoal_count, task.state_mask.shape[0]
        self.finish_action = problem.action_count - 1
        self.dead_end_cost = float(problem.dead_end_cost)
        self.accepting = (np.asarray(task.accepting) & np.asarray(task.state_mask)).tolist()
        # Python floats in lists: looked up one at a time, numpy's scalars would be slower.
        self.travel = np.asarray(problem.travel, np.float64).tolist()
        self.finish = np.asarray(problem.finish, np.float64).tolist()
        self._estimates = [
            np.asarray(values, np.float64).tolist()
            for values in (problem.success_probability, problem.success_cost, problem.failure_cost)
        ]
        self._initial_state = int(problem.dfa_state)
        self.edge_count = problem.edge_count
        self.real_subgoals: list[int] = np.flatnonzero(problem.subgoal_mask).tolist()
        edges, conditions = np.asarray(task.edges), np.asarray(task.edge_condition)
        self.edges = {
            int(e): (int(edges[e, 0]), int(edges[e, 1]), int(conditions[e])) for e in np.flatnonzero(task.edge_mask)
        }
        self.closure = Closure(np.asarray(task.implies), np.asarray(task.condition_classes), task.class_mask.shape[0])
        self._classes = [[int(c) for c in row if c != NO_CLASS] for row in np.asarray(task.condition_classes)]
        self._terms: dict[tuple[int, int, SubgoalKnowledge], Terms] = {}

    def root(self) -> Position:
        """At the robot, nothing known."""
        # Location S is the robot's own cell, from which no attempt is made.
        knowledge = (SubgoalKnowledge(0, 0),) * self.subgoals
        visited = 1 << (self.subgoals * self.states + self._initial_state)
        return Position(self.subgoals, self._initial_state, knowledge, visited)

    def split(self, action: int) -> tuple[int, int, int, int]:
        """Subgoal, z', z'' and condition of an action other than finish."""
        return action // self.edge_count, *self.edges[action % self.edge_count]

    def terms(self, position: Position, action: int) -> Terms:
        """P_S, R_S, R_F given the history."""
        if action == self.finish_action:
            return Terms(1.0, 0.0, 0.0, False)
        subgoal, _, _, condition = self.split(action)
        known = position.knowledge[subgoal]
        # Few combinations occur, and each occurs in very many histories.
        key = (subgoal, condition, known)
        if key not in self._terms:
            self._terms[key] = self.combined(subgoal, condition, known)
        return self._terms[key]

    def stays_inside(self, position: Position, action: int) -> bool:
        """Whether the action goes on beyond the same subgoal in the same state, so that nothing is paid before it."""
        if action == self.finish_action:
            return False
        subgoal, source, _, _ = self.split(action)
        return subgoal == position.location and source == position.state

    def distance(self, position: Position, action: int) -> float:
        """D without the pending cost; inf where the action is out of reach."""
        if action == self.finish_action:
            return self.finish[position.location][position.state]
        if self.stays_inside(position, action):
            return 0.0
        subgoal, source, _, _ = self.split(action)
        return self.travel[position.location][position.state][subgoal][source]

    def available(self, position: Position) -> Iterator[int]:
        """Actions by increasing index."""
        if self.accepting[position.state]:
            return
        for subgoal in self.real_subgoals:
            for edge, (_, target, _) in self.edges.items():
                action = subgoal * self.edge_count + edge
                if math.isinf(self.distance(position, action)):
                    continue
                terms = self.terms(position, action)
                # A certain success teaches nothing; where it leads to a product state that this stretch without news
                # has visited, taking it would allow to go in circles (docs/model.md section 4).
                leads_back = terms.certain and position.visited >> (subgoal * self.states + target) & 1
                if terms.probability > 0 and not leads_back:
                    yield action
        if math.isfinite(self.finish[position.location][position.state]):
            yield self.finish_action

    def step(self, position: Position, action: int, success: bool) -> Position:
        """The history after an available action other than finish.

        Args:
          position: the history before.
          action: its index.
          success: the outcome of the attempt.

        Returns:
          The history after it, beyond the action's subgoal.
        """
        subgoal, source, target, condition = self.split(action)
        known = position.knowledge[subgoal]
        state = target if success else source
        # Whatever is learnt starts a new stretch, in which everything may be visited again.
        here = 1 << (subgoal * self.states + state)
        if known.holds >> condition & 1:
            return position._replace(location=subgoal, state=state, visited=position.visited | here)
        after = self.closure.add_outcome(known, condition, success)
        knowledge = (*position.knowledge[:subgoal], after, *position.knowledge[subgoal + 1 :])
        return Position(subgoal, state, knowledge, here)

    def combined(self, subgoal: int, condition: int, known: SubgoalKnowledge) -> Terms:
        """P_S, R_S, R_F of a condition from its cubes, tried in order of R_S (docs/model.md section 3).

        Args:
          subgoal: index of the subgoal.
          condition: index of the condition.
          known: what is known of the subgoal.

        Returns:
          What an attempt at the condition promises.
        """
        probabilities, success_costs, failure_costs = (values[subgoal] for values in self._estimates)
        classes = self._classes[condition]
        certain = bool(known.holds >> condition & 1)
        # The cheapest cube first: ``none_yet`` is the chance that no cube before has held.
        none_yet, weighted, possible = 1.0, 0.0, []
        for c in sorted(classes, key=lambda c: (success_costs[c], c)):
            failed, held = known.fails >> c & 1, known.holds >> c & 1
            chance = 1.0 if held else 0.0 if failed else probabilities[c]
            weighted += none_yet * chance * success_costs[c]
            none_yet *= 1.0 - chance
            possible += [] if failed else [success_costs[c]]
        # A success cost is wanted where the chance is 0 as well: knowledge may contradict the estimates.
        total = 1.0 - none_yet
        success_cost = weighted / total if total > 0 else min(possible, default=0.0)
        probability = 1.0 if certain else 0.0 if known.fails >> condition & 1 else total
        return Terms(probability, success_cost, max(failure_costs[c] for c in classes), certain)


class Closure:
    """What follows from the outcome of an attempt for what is known about its subgoal (docs/model.md section 4).

    The rules are clauses with at most one negative literal each: that a condition holds or fails is passed on along
    ``implies``, and a condition of several cubes holds only if one of its cubes does. Unit propagation over such
    clauses finds all that follows. Results are kept, since few outcomes differ and each occurs often.
    """

    def __init__(self, implies: np.ndarray, classes: np.ndarray, class_count: int) -> None:
        """Masks of the rules.

        Args:
          implies: ``[M, M]``, True where the row's condition implies the column's.
          classes: ``[M, K]``, cubes of each condition, then ``NO_CLASS``.
          class_count: C; conditions from here on have several cubes.
        """
        count = len(implies)
        self._forward = [_mask(implies[a]) for a in range(count)]
        self._backward = [_mask(implies[:, b]) for b in range(count)]
        self._compounds = [
            (m, sum(1 << int(c) for c in classes[m] if c != NO_CLASS))
            for m in range(class_count, count)
            if implies[m, m]  # padded conditions imply nothing, not even themselves
        ]
        self._known: dict[tuple[SubgoalKnowledge, int, bool], SubgoalKnowledge] = {}

    @property
    def has_compounds(self) -> bool:
        """Whether a condition has several cubes."""
        return bool(self._compounds)

    def add_outcome(self, known: SubgoalKnowledge, condition: int, success: bool) -> SubgoalKnowledge:
        """What is known once the condition has held or failed.

        Args:
          known: what was known before; it leaves the condition open.
          condition: of the attempt.
          success: its outcome.

        Returns:
          What is known then, with all that follows.
        """
        key = (known, condition, success)
        if key not in self._known:
            holds = known.holds | (self._forward[condition] if success else 0)
            fails = known.fails | (0 if success else self._backward[condition])
            if self._compounds:
                fails = self._propagate(fails)
                # Proof by refutation: x holds if its failing would make something fail that holds. Passing on what
                # holds along ``implies`` alone would miss a condition of which a single cube remains.
                refuting = (x for x, backward in enumerate(self._backward) if self._propagate(fails | backward) & holds)
                holds = sum(1 << x for x in refuting)
            self._known[key] = SubgoalKnowledge(holds, fails)
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


def _mask(flags: np.ndarray) -> int:
    """Flags as the bits of one integer."""
    return sum(1 << int(i) for i in np.flatnonzero(flags))
