"""All that can be known of one subgoal, enumerated and tabulated: what the nodes of the exact solver are made of.

Nothing that is learnt at one subgoal says anything about another, so that what is known in all is one row of one table
per subgoal. The table is small where combinations of its rows are many, so it is worked out once, with everything that
depends on it.

Knowledge about conditions that can matter no more is dropped, so rollouts that differ in nothing else meet again.

References:
  Bradley et al., Learning and Planning for Temporally Extended Tasks in Unknown Environments, ICRA 2021, Eq. 3.
"""

import numpy as np
from jaxtyping import Int32, Int64

from potlp_jax.errors import ProblemTooLargeError
from potlp_jax.planning.exact.rollouts import Rollouts, SubgoalKnowledge

ACCEPTED = -2
"""Child index of success in an accepting state: it costs nothing more and needs no node."""
NOWHERE = -1
"""Child index of an attempt or a path that does not exist."""

_MOST_ROWS = 300_000
"""Rows of knowledge at most. Tables hold some numbers for each row, edge and subgoal, and are filled in Python."""


class Knowledge:
    """What is known of one subgoal while the automaton is in some state, as numbered rows, and how it changes.

    A row q is (state, holds, fails, visited), where visited has the states in which the rollout has been at this
    subgoal since it last learnt something. What can matter no more is dropped. Row 0 is the root's. k numbers the edges
    that leave the row's state, s the real subgoals.

    Attributes:
      rollouts: the rules.
      subgoals: index of each s in the problem.
      edges: indices of the edges that leave each state.
      most_edges: the largest number of k.
      target, condition: ``[z, k]``, -1 beyond the last edge.
      travel: ``[s', z', s, z]``, path costs, from the robot where s' is -1.
      finish: ``[s', z']``, path costs to acceptance.
      travels_to: by state, those that do not accept and that paths lead to.
      reach: ``[z, z']``, attempts and paths can lead from z to z'.
      state: ``[q]``, the row's state.
      known_count, visits: ``[q]``, how many conditions are known, and how many states visited.
      row_in_state: ``[q, z]``, the row once the automaton is in z for other reasons than an attempt here; ``NOWHERE``.
      row_without_visits: ``[q]``, the row with its visits forgotten.
      row_after_success, row_after_failure: ``[q, k]``, after an attempt here; ``ACCEPTED``, ``NOWHERE``.
      certain: ``[q, k]``, the condition is known to hold.
      follows_success: ``[q]``, True on rows in which a success may leave a subgoal, this one or another.
      probability, success_cost, available: ``[s, q, k]``.
      failure_cost: ``[s, z, k]``.
    """

    def __init__(self, rollouts: Rollouts) -> None:
        self.rollouts = rollouts
        self.subgoals = rollouts.real_subgoals
        count = rollouts.states
        self.travel = np.asarray(rollouts.travel).reshape(rollouts.subgoals + 1, count, rollouts.subgoals, count)
        self.finish = np.asarray(rollouts.finish)
        # Padded subgoals are left out everywhere; the robot's own cell is the last location.
        locations = [*self.subgoals, rollouts.subgoals]
        self.travel, self.finish = self.travel[locations][:, :, self.subgoals], self.finish[locations]
        self.edges = [[e for e, (source, _, _) in rollouts.edges.items() if source == z] for z in range(count)]
        # At least one column, so that minima over edges are defined for tasks without any.
        self.most_edges = max([1, *map(len, self.edges)])
        self.target, self.condition = (np.full((count, self.most_edges), -1) for _ in range(2))
        for z, edges in enumerate(self.edges):
            for k, e in enumerate(edges):
                _, self.target[z, k], self.condition[z, k] = rollouts.edges[e]
        paths = np.asarray(np.isfinite(self.travel).any(axis=(0, 2)))
        # A path that ends in an accepting state is a finish, which ``finish`` prices.
        live = ~np.asarray(rollouts.accepting)
        self.travels_to = [np.flatnonzero(paths[z] & live).tolist() for z in range(count)]
        self.reach = _reachable(paths, list(rollouts.edges.values()))
        self._number: dict[tuple[int, int, int, int], int] = {}
        self._enumerate()
        self._tabulate_terms()

    def _enumerate(self) -> None:
        """All rows that can come about, breadth first, and what becomes of each."""
        rows: list[tuple[int, int, int, int]] = []
        entries: set[int] = set()
        self._row(self.rollouts.root().state, SubgoalKnowledge(0, 0), 0, rows)
        # ``rows`` grows while it is walked: the children of a row get the next free numbers.
        found = [self._children(row, rows, entries) for row in rows]
        moves, cleared, successes, failures, certain = zip(*found, strict=True)
        self.state = np.array([row[0] for row in rows], np.int32)
        self.known_count = np.array([(row[1] | row[2]).bit_count() for row in rows])
        self.visits = np.array([row[3].bit_count() for row in rows])
        self._rows = rows
        self.row_in_state, self.row_without_visits = np.array(moves), np.array(cleared)
        self.row_after_success, self.row_after_failure = np.array(successes), np.array(failures)
        self.certain = np.array(certain)
        self.follows_success = np.isin(np.arange(len(rows)), list(entries))

    def _children(
        self, row: tuple[int, int, int, int], rows: list[tuple[int, int, int, int]], entries: set[int]
    ) -> tuple[list[int], int, list[int], list[int], list[bool]]:
        """A row's entries in ``row_in_state``, ``row_without_visits``, ``row_after_*`` and ``certain``.

        Rows that are new are appended to ``rows``; those that a success can lead to are added to ``entries``.
        """
        state, holds, fails, visited = row
        known = SubgoalKnowledge(holds, fails)
        success, failure = [NOWHERE] * self.most_edges, [NOWHERE] * self.most_edges
        certain = [False] * self.most_edges
        # What is known stays while the robot is elsewhere and the automaton moves on, by a path or by an attempt at
        # another subgoal.
        move = {z: self._row(z, known, visited, rows) for z in self.travels_to[state]}
        for k, edge in enumerate(self.edges[state]):
            _, target, condition = self.rollouts.edges[edge]
            accepts = self.rollouts.accepting[target]
            if not accepts:
                move[target] = self._row(target, known, visited, rows)
                entries.add(move[target])
            certain[k] = bool(holds >> condition & 1)
            if fails >> condition & 1:
                continue  # no attempt is made at what is known to fail
            after, seen = known, visited | 1 << target
            if not certain[k]:
                failed = self.rollouts.closure.add_outcome(known, condition, False)
                failure[k] = self._row(state, failed, 1 << state, rows)
                after, seen = self.rollouts.closure.add_outcome(known, condition, True), 1 << target
            success[k] = ACCEPTED if accepts else self._row(target, after, seen, rows)
            entries.add(success[k])
        cleared = self._row(state, known, 0, rows)
        return [move.get(z, NOWHERE) for z in range(self.rollouts.states)], cleared, success, failure, certain

    def _row(self, state: int, known: SubgoalKnowledge, visited: int, rows: list[tuple[int, int, int, int]]) -> int:
        """Number of a row, less what can matter no more: conditions of edges out of reach (unless conditions of several
        cubes tie them to others), and visits that no attempt whose condition is known to hold could repeat."""
        holds, fails, repeatable, relevant = known.holds, known.fails, 0, 0
        for source, target, condition in self.rollouts.edges.values():
            if self.reach[state, source]:
                relevant |= 1 << condition
                repeatable |= (holds >> condition & 1) << target
        if not self.rollouts.closure.has_compounds:
            holds, fails = holds & relevant, fails & relevant
        row = (state, holds, fails, visited & repeatable)
        if row not in self._number:
            if len(rows) >= _MOST_ROWS:
                raise ProblemTooLargeError(
                    f"more than {_MOST_ROWS} things can be known of one subgoal: the task is too large"
                )
            self._number[row] = len(rows)
            rows.append(row)
        return self._number[row]

    def _tabulate_terms(self) -> None:
        """P_S, R_S, R_F and availability for every subgoal, row and edge."""
        shape = (len(self.subgoals), len(self._rows), self.most_edges)
        self.probability, self.success_cost = np.zeros(shape), np.zeros(shape)
        self.failure_cost = np.zeros((shape[0], self.rollouts.states, self.most_edges))
        self.available = np.zeros(shape, bool)
        for i, subgoal in enumerate(self.subgoals):
            for row, (state, holds, fails, visited) in enumerate(self._rows):
                for k, edge in enumerate(self.edges[state]):
                    _, target, condition = self.rollouts.edges[edge]
                    terms = self.rollouts.combined(subgoal, condition, SubgoalKnowledge(holds, fails))
                    self.probability[i, row, k], self.success_cost[i, row, k] = terms.probability, terms.success_cost
                    self.failure_cost[i, state, k] = terms.failure_cost
                    leads_back = terms.certain and visited >> target & 1
                    self.available[i, row, k] = terms.probability > 0 and not leads_back

    def ranks(self, rows: Int32[np.ndarray, "N S"], state: Int32[np.ndarray, " N"]) -> Int64[np.ndarray, " N"]:
        """Larger after every attempt, and never smaller after a path: components of the automaton come in order, each
        attempt closes a condition or, where it closes none, visits something new."""
        # Lexicographic in one integer: depth of the automaton's component, conditions known, states visited. Each count
        # is far below 2^20. By rank, every child comes after its parent, so one pass backs up all bounds.
        depth = (self.reach & ~self.reach.T).sum(axis=0)
        known, visits = self.known_count[rows].sum(axis=1), self.visits[rows].sum(axis=1)
        return (depth[state].astype(np.int64) << 40) + (known.astype(np.int64) << 20) + visits


def _reachable(paths: np.ndarray, edges: list[tuple[int, int, int]]) -> np.ndarray:
    """``[z, z']``: paths and attempts can lead from z to z'."""
    count = len(paths)
    reach = np.eye(count, dtype=bool) | paths
    for source, target, _ in edges:
        reach[source, target] = True
    # Warshall's algorithm.
    for via in range(count):
        reach |= reach[:, [via]] & reach[[via]]
    return reach
