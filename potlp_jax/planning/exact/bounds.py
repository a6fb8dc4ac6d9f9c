"""Bounds of expanded nodes from those of their children, backed up through the graph of the exact solver.

The pending cost is accounted for here: an action either leaves the unknown region and pays the pending cost, or goes on
inside and pays nothing, so the value of a history is ``min(pending_cost + leave, stay)``.

References:
  Bradley et al., Learning and Planning for Temporally Extended Tasks in Unknown Environments, ICRA 2021, Eq. 3.
  Martelli and Montanari, Optimizing decision trees through heuristically guided search, CACM 1978 (AO*).
"""

import numpy as np

from potlp_jax.planning.exact.graph import CHUNK, Graph
from potlp_jax.planning.exact.knowledge import NOWHERE

FINISH = -1
"""State in ``best_path`` where the path goes to acceptance."""


class GraphBounds:
    """Keeps the bounds in a graph's ``nodes`` and the best choices in its ``expansions``."""

    def __init__(self, graph: Graph) -> None:
        self._graph, self._tables = graph, graph.tables
        self._nodes, self._expansions = graph.nodes, graph.expansions
        self._dead_end = graph.tables.rollouts.dead_end_cost

    def back_up(self, expansions: np.ndarray) -> None:
        """Bounds of expanded nodes from those of their children, last nodes first."""
        # Children have larger ranks, except those that paths lead to, which may share a rank. Hence first the attempts
        # of the whole group, which look at children of larger rank only, then its paths, which use those attempts.
        for group in self._graph.groups(expansions)[::-1]:
            for start in range(0, len(group), CHUNK):
                self._back_up_attempts(group[start : start + CHUNK])
            for start in range(0, len(group), CHUNK):
                self._back_up_paths(group[start : start + CHUNK])

    def of_actions(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds on the Q of every action."""
        tables, z = self._tables, int(self._nodes["state"][0])
        # The last row of ``finish`` and ``travel`` is the robot's own cell; finish is the last action.
        lower = np.full(tables.rollouts.finish_action + 1, np.inf)
        lower[-1] = tables.finish[-1, z]
        upper = lower.copy()
        for action, s, k, expansion, path_cost in self._graph.root_actions():
            below, above = self.attempt_bounds(np.array([expansion]))
            lower[action], upper[action] = path_cost + below[0, s, k], path_cost + above[0, s, k]
        return lower, upper

    def attempt_bounds(self, expansions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bounds on the cost of every attempt from its subgoal on, ``[N, S, K]``; inf where it is not available."""
        tables, nodes = self._tables, self._expansions["node"][expansions]
        rows, state = self._nodes["rows"][nodes], self._nodes["state"][nodes]
        here = np.arange(rows.shape[1])[None]
        chance, success_cost = tables.probability[here, rows], tables.success_cost[here, rows]
        failure_cost = tables.failure_cost[here, state[:, None]]
        success, failure = self._expansions["success"][expansions], self._expansions["failure"][expansions]
        # Eq. 3 from the subgoal on: the path to it is not part of a node.
        possible = success != NOWHERE
        bounds = []
        for after_success, after_failure in zip(
            self._arrival_bounds(success, success_cost),
            self._arrival_bounds(failure, np.broadcast_to(failure_cost, success.shape)),
            strict=True,
        ):
            cost = chance * (success_cost + after_success) + (1.0 - chance) * (failure_cost + after_failure)
            bounds.append(np.where(possible, cost, np.inf))
        return bounds[0], bounds[1]

    def _arrival_bounds(self, children: np.ndarray, pending_cost: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bounds on the value of histories ``[N, S, K]`` that end at node ``children`` beyond subgoal s."""
        # ``ACCEPTED`` and ``NOWHERE`` are negative; they read node 0 and are replaced at the end.
        n, s = np.maximum(children, 0), np.arange(children.shape[1])[None, :, None]
        lower = np.minimum(pending_cost + self._nodes["leave_lower"][n, s], self._nodes["attempt_lower"][n, s])
        upper = np.minimum(pending_cost + self._nodes["leave_upper"][n, s], self._nodes["attempt_upper"][n, s])
        upper = np.minimum(upper, self._nodes["ceiling"][n])
        # Nothing to do: a dead end. Where the relaxation cannot exclude one, the bound is no larger than its cost.
        nothing = np.isinf(lower)
        lower = np.where(nothing | (self._nodes["may_be_dead"][n] & (lower > self._dead_end)), self._dead_end, lower)
        upper = np.where(nothing, self._dead_end, upper)
        real = children >= 0
        return np.where(real, lower, 0.0), np.where(real, upper, 0.0)

    def _back_up_attempts(self, expansions: np.ndarray) -> None:
        """Value of trying on beyond each subgoal, where nothing is paid before: the best edge there."""
        nodes = self._expansions["node"][expansions]
        lower, upper = self.attempt_bounds(expansions)
        self._expansions["best_edge"][expansions] = lower.argmin(axis=2)
        self._nodes["attempt_lower"][nodes] = lower.min(axis=2)
        self._nodes["attempt_upper"][nodes] = upper.min(axis=2)

    def _back_up_paths(self, expansions: np.ndarray) -> None:
        """Value of leaving from beyond each subgoal, less the pending cost."""
        states = self._nodes["state"][self._expansions["node"][expansions]]
        for z in np.unique(states):
            self._back_up_paths_from(int(z), expansions[states == z])

    def _back_up_paths_from(self, z: int, expansions: np.ndarray) -> None:
        """``_back_up_paths`` of expansions in state z: finish, or the cheapest path to another attempt."""
        tables, nodes = self._tables, self._expansions["node"][expansions]
        subgoals = len(tables.subgoals)
        lower = np.broadcast_to(tables.finish[:subgoals, z], (len(nodes), subgoals)).copy()
        upper = lower.copy()
        best = np.full((len(nodes), subgoals, 2), FINISH)
        for other in tables.travels_to[z] if subgoals else ():
            path_cost = tables.travel[:subgoals, z, :, other]
            # The same subgoal in the same state is not left and entered again: that is trying on.
            if other == z:
                path_cost = np.where(np.eye(subgoals, dtype=bool), np.inf, path_cost)
            link = self._expansions["link"][expansions, other]
            costs = path_cost[None] + self._nodes["attempt_lower"][link][:, None, :]
            least = costs.min(axis=2)
            better = least < lower
            lower = np.where(better, least, lower)
            choice = np.stack([np.full(least.shape, other), costs.argmin(axis=2)], axis=-1)
            best = np.where(better[..., None], choice, best)
            upper = np.minimum(upper, (path_cost[None] + self._nodes["attempt_upper"][link][:, None, :]).min(axis=2))
        self._nodes["leave_lower"][nodes], self._nodes["leave_upper"][nodes] = lower, upper
        self._expansions["best_path"][expansions] = best
