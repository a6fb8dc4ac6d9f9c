"""Exact solution of Eq. 3, or certified bounds on it: the yardstick of the search. Host only, double precision.

A graph of (state of the automaton, knowledge of every subgoal) is explored from the root as AO* does it, many nodes at
a time: open nodes have a lower bound from a relaxation; those that the policy which looks best from below is likely to
meet are expanded first. Where that policy meets no open node from any of the root's actions, the bounds are the
optimum.

The parts: ``rollouts`` (the rules), ``knowledge`` (what can be known of one subgoal), ``relaxation`` (bounds of open
nodes), ``graph`` (nodes), ``bounds`` (backing up), ``exploration`` (what to expand next).

References:
  Bradley et al., Learning and Planning for Temporally Extended Tasks in Unknown Environments, ICRA 2021, Eq. 3.
  Martelli and Montanari, Optimizing decision trees through heuristically guided search, CACM 1978 (AO*).
"""

import time
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from potlp_jax.errors import ProblemTooLargeError
from potlp_jax.planning.exact.bounds import GraphBounds
from potlp_jax.planning.exact.exploration import Exploration
from potlp_jax.planning.exact.graph import Graph
from potlp_jax.planning.exact.knowledge import Knowledge
from potlp_jax.planning.exact.rollouts import Rollouts
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.types import NO_ACTION, Status

__all__ = ["Bounds", "ExactSolution", "ProblemTooLargeError", "bound_exact", "solve_exact"]


@dataclass(frozen=True)
class ExactSolution:
    """Optimum of Eq. 3.

    Attributes:
      value: expected cost of the best action; 0 where the task is satisfied, the dead-end cost at a dead end.
      q_values: expected cost of each action, inf where it is not available.
      action: index of the best action (ties: lowest index), or ``NO_ACTION``.
      states: nodes of the graph that were explored.
      status: ``ACCEPTING_ROOT``, ``DEAD_END`` or ``OK``.
      dead_end_part: what the cost of dead ends contributes to ``value`` under the best policy found.
    """

    value: float
    q_values: Float64[np.ndarray, "A"]
    action: int
    states: int
    status: Status
    dead_end_part: float


@dataclass(frozen=True)
class Bounds:
    """What is certain about the optimum of Eq. 3: it lies between ``lower`` and ``upper``.

    Attributes:
      lower, upper: bounds on the value; equal up to rounding where ``exact``.
      q_lower, q_upper: bounds on the expected cost of each action, inf where it is not available.
      action: the action of least upper bound (ties: lowest index), or ``NO_ACTION``.
      states: nodes of the graph that were explored.
      status: ``ACCEPTING_ROOT``, ``DEAD_END`` or ``OK``.
      exact: whether ``lower`` and ``upper`` are the optimum; bounds of other actions may still be loose.
      dead_end_part: what the cost of dead ends contributes under the policy that is best by the lower bounds, as far as
        it was followed: exact where ``exact``, otherwise from below.
    """

    lower: float
    upper: float
    q_lower: Float64[np.ndarray, "A"]
    q_upper: Float64[np.ndarray, "A"]
    action: int
    states: int
    status: Status
    exact: bool
    dead_end_part: float

    @property
    def gap(self) -> float:
        """Width of the interval as a share of its upper end."""
        return (self.upper - self.lower) / self.upper if self.upper > 0 else 0.0


def solve_exact(problem: PlanningProblem, *, max_states: int = 3_000_000, seconds: float = 60.0) -> ExactSolution:
    """Solve one unbatched problem exactly: the value and the Q of every action.

    Args:
      problem: the problem; ``problem.check()`` is called.
      max_states: nodes after which to give up (about 0.5 kB each).
      seconds: processor time after which to give up.

    Returns:
      The optimum.

    Raises:
      ProblemError: the problem is not valid.
      ProblemTooLargeError: a limit was met; ``bound_exact`` still gives an interval.
    """
    bounds = _explore(problem, max_states, seconds, None)
    if not bounds.exact:
        raise ProblemTooLargeError(
            f"more than {max_states} states or {seconds:g} s with {problem.subgoal_count} subgoals: raise max_states "
            "or seconds, or use bound_exact or plan_actions"
        )
    return ExactSolution(
        bounds.lower, bounds.q_lower, bounds.action, bounds.states, bounds.status, bounds.dead_end_part
    )


def bound_exact(
    problem: PlanningProblem, *, max_states: int = 3_000_000, seconds: float = 60.0, tolerance: float = 1e-3
) -> Bounds:
    """Certified bounds on the optimum of one unbatched problem, as tight as the limits allow.

    Args:
      problem: the problem; ``problem.check()`` is called.
      max_states: nodes after which to stop (about 0.5 kB each).
      seconds: processor time after which to stop.
      tolerance: stop where ``gap`` is no larger; 0 asks for the optimum.

    Returns:
      The interval in which the optimum lies, and whether it is a point.

    Raises:
      ProblemError: the problem is not valid.
      ProblemTooLargeError: too many things can be known of one subgoal to begin with.
    """
    return _explore(problem, max_states, seconds, tolerance)


def _explore(problem: PlanningProblem, max_states: int, seconds: float, tolerance: float | None) -> Bounds:
    """Bounds by search; without a tolerance until every action's bounds meet."""
    # Processor time, not wall time: what is found must not depend on what else the machine does.
    problem.check()
    deadline = time.process_time() + seconds
    rollouts = Rollouts(problem)
    if rollouts.accepting[rollouts.root().state]:
        nothing = np.full(problem.action_count, np.inf)
        return Bounds(0.0, 0.0, nothing, nothing, NO_ACTION, 0, Status.ACCEPTING_ROOT, True, 0.0)
    return _tighten(Graph(Knowledge(rollouts)), max_states, deadline, tolerance)


def _tighten(graph: Graph, max_states: int, deadline: float, tolerance: float | None) -> Bounds:
    """Expand until the bounds meet the tolerance (None: until they are the optimum), or a limit."""
    start = time.process_time()
    bounds = GraphBounds(graph)
    exploration = Exploration(graph, bounds)
    exploration.begin(max_states)
    while True:
        # Bounds are backed up in full before a decision is made on them: ``grow`` updates only what is new.
        bounds.back_up(np.arange(graph.expansions.count))
        lower, upper = bounds.of_actions()
        # Without a tolerance the Q of every action is wanted, so the policy is followed from all of them; otherwise
        # only from the action that looks best.
        flow = exploration.follow(np.where(np.isfinite(lower), 1.0, 0.0) if tolerance is None else _least(lower))
        # A policy that meets no open node has a known cost, and it is the best by lower bounds: the optimum.
        exact = not flow.open.any()
        if not exact and tolerance is not None and lower.min() >= (1.0 - tolerance) * upper.min():
            return _result(graph, exploration, lower, upper, False)
        if exact or graph.nodes.count > max_states or time.process_time() > deadline:
            return _result(graph, exploration, lower, upper, exact)
        # In the last fifth of the budget nodes beside the policy are left alone: closing the policy tightens the bound.
        closing = graph.nodes.count > 0.8 * max_states or time.process_time() > start + 0.8 * (deadline - start)
        exploration.grow(flow, max_states, deadline, closing)


def _result(graph: Graph, exploration: Exploration, lower: np.ndarray, upper: np.ndarray, exact: bool) -> Bounds:
    """What to report, from bounds on the Q of every action."""
    dead_end_cost, states = graph.tables.rollouts.dead_end_cost, graph.nodes.count
    # No action is within reach, and finish is out of reach.
    if np.isinf(lower).all():
        return Bounds(
            dead_end_cost, dead_end_cost, lower, lower, NO_ACTION, states, Status.DEAD_END, True, dead_end_cost
        )
    best = _least(lower)
    dead = exploration.follow(best).dead
    # The value of the best action is its lower bound. Those of others may still have a gap, which the caller is told.
    if exact:
        upper = np.where(best > 0, lower, upper)
    return Bounds(
        lower=float(lower.min()),
        upper=float(upper.min()),
        q_lower=lower,
        q_upper=upper,
        action=int(np.argmin(lower if exact else upper)),
        states=states,
        status=Status.OK,
        exact=exact,
        dead_end_part=float(dead * dead_end_cost),
    )


def _least(lower: np.ndarray) -> np.ndarray:
    """Weight 1 on the action of least lower bound."""
    best = np.zeros(len(lower))
    best[np.argmin(lower)] = 1.0
    return best
