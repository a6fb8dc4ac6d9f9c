"""The top of a searched tree as nested plain values, for pictures and JSON."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from potlp_jax.planning.history import ActionTerms, History, action_terms, initial_history, step
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.graph import Tree
from potlp_jax.planning.search.uct import UctTree


def tree_top(problem: PlanningProblem, tree: Tree | UctTree, *, depth: int = 2, width: int = 4) -> dict[str, Any]:
    """The best of a searched tree as nested plain values. Host only.

    Args:
      problem: the unbatched problem that was searched.
      tree: its tree, unbatched, from ``search_tree``.
      depth: actions per branch.
      width: actions per node: those of least Q, ties by index.

    Returns:
      A node: ``location`` (None at the robot), ``state``, ``value``, ``visits``, ``accepting``, ``dead_end`` and
      ``actions`` (empty at the last level). An action: ``index``, ``subgoal``, ``from_state``, ``to_state`` (all None
      for finish), ``q_value``, ``visits`` (below the root those of the nodes that it leads to, which other orders of
      the same events may share), ``distance`` (D), ``success`` and ``failure``. An outcome (None where it cannot
      occur): ``probability``, ``cost`` (R_S or R_F), ``value`` and ``node``, both None where not searched.
    """
    return _TreeViewer(problem, tree, width).node(Tree.ROOT, initial_history(problem), depth)


class _TreeViewer:
    """Replays histories down a tree on the host."""

    def __init__(self, problem: PlanningProblem, tree: Tree | UctTree, width: int) -> None:
        self._problem, self._width = problem, width
        self._q_values, self._root_visits = np.asarray(tree.q_values), np.asarray(tree.root_visits)
        self._children, self._node_visits = np.asarray(tree.children), np.asarray(tree.node_visits)
        self._q_includes_pending_cost = tree.Q_INCLUDES_PENDING_COST
        self._accepting = np.asarray(problem.task.accepting)

    def node(self, index: int, history: History, depth: int) -> dict[str, Any]:
        """A node of the tree with the branches below it, as this history arrives there."""
        terms = _action_terms(self._problem, history)
        q_values = self._q_values[index]
        if not self._q_includes_pending_cost:
            q_values = q_values + self._paid(history)
        # Stable, so that ties keep the order of their indices.
        order = [int(a) for a in np.argsort(q_values, kind="stable")[: self._width] if np.isfinite(q_values[a])]
        actions = [self._action(index, a, float(q_values[a]), terms, history, depth) for a in order if depth > 0]
        accepting, dead_end = bool(self._accepting[int(history.state)]), bool(np.isinf(q_values).all())
        value = float(self._problem.dead_end_cost) if dead_end else float(q_values.min())
        return {
            **self._where(history),
            "value": 0.0 if accepting else value,
            "visits": int(self._node_visits[index]),
            "accepting": accepting,
            "dead_end": not accepting and dead_end,
            "actions": actions,
        }

    def _paid(self, history: History) -> np.ndarray:
        """What each action pays of the pending cost: nothing where it stays in the unknown region, otherwise all."""
        location, state, edges = int(history.location), int(history.state), self._problem.edge_count
        paid = np.full(self._problem.action_count, float(history.pending_cost))
        if location < self._problem.subgoal_count:
            inside = np.asarray(self._problem.task.edges)[:, 0] == state
            paid[location * edges : (location + 1) * edges][inside] = 0.0
        return paid

    def _where(self, history: History) -> dict[str, Any]:
        location = int(history.location)
        return {"location": None if location == self._problem.subgoal_count else location, "state": int(history.state)}

    def _visits(self, index: int, action: int) -> int:
        if index == Tree.ROOT:
            return int(self._root_visits[action])
        reached = [int(child) for child in self._children[index, action] if child >= 0]
        return sum(int(self._node_visits[child]) for child in reached)

    def _action(
        self, index: int, action: int, q_value: float, terms: ActionTerms, history: History, depth: int
    ) -> dict[str, Any]:
        finish = action == self._problem.action_count - 1
        subgoal, edge = divmod(action, self._problem.edge_count)
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
            "q_value": q_value,
            "visits": self._visits(index, action),
            "distance": float(terms.distance[action]),
            "success": outcome(True),
            "failure": outcome(False),
        }

    def _outcome(self, index: int, action: int, success: bool, history: History, depth: int) -> dict[str, Any]:
        # An outcome that satisfies the task has no node in the tree; here it gets one, to be drawn.
        after = _step(self._problem, history, jnp.int32(action), jnp.asarray(success))
        if self._accepting[int(after.state)]:
            satisfied = {"value": 0.0, "visits": 0, "accepting": True, "dead_end": False, "actions": []}
            return {"value": 0.0, "node": {**self._where(after), **satisfied}}
        child = int(self._children[index, action, int(success)])
        if child < 0:
            return {"value": None, "node": None}
        node = self.node(child, after, depth - 1)
        return {"value": node["value"], "node": node}


_action_terms, _step = jax.jit(action_terms), jax.jit(step)
