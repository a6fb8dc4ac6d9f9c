"""Bounds on what a history will cost from what can at best and at worst come of it, without looking ahead.

A lower bound must not exceed the value, whatever is found later; so wherever the problem is simplified here, it is
simplified in the robot's favour, and sums are lowered by 1e-9 of themselves to stay bounds under rounding.

References:
  Bradley et al., Learning and Planning for Temporally Extended Tasks in Unknown Environments, ICRA 2021, Eq. 3.
  Smith, Various optimizers for single-stage production, Naval Research Logistics 1956 (order by ratio).
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int32

from potlp_jax.planning.exact.knowledge import Knowledge

_ROUNDING = 1.0 - 1e-9
"""Factor that keeps sums of lower bounds below the value despite rounding."""
_TINY = 1e-300
"""Stands in for a divisor of 0 where the quotient is not used."""


class Relaxation:
    """Bounds on open nodes.

    Below: in one state of the automaton (or those that paths lead to from it) every attempt can be made once at most;
    it costs no less than the cheapest path to its subgoal, shared by the attempts there, and succeeds with the largest
    probability that later knowledge may give it. With the order of attempts free, the best one is by ratio of cost to
    probability, and the rollout ends when success leads on, the robot finishes, or nothing remains. Attempts that are
    certain to stay available must be made before a dead end; others may be left out.

    Above: the dead end after as many of the longest steps as there are conditions to close.
    """

    def __init__(self, tables: Knowledge) -> None:
        self._tables = tables
        rollouts = tables.rollouts
        self._dead_end = rollouts.dead_end_cost
        self._largest_chance, self._least_chance = self._reachable_probabilities()
        states = rollouts.states
        subgoals = len(tables.subgoals)
        self._stages = [self._stage(z) for z in range(states)]
        # Values of success refer to those of the next stage. From 0, each round looks one success further ahead and
        # gives better bounds; paths without repetition have as many successes as there are states.
        self._values = np.zeros((subgoals, states, tables.most_edges))
        for _ in range(states):
            self._values = self._success_values()

    def _reachable_probabilities(self) -> tuple[np.ndarray, np.ndarray]:
        """``[s, q, z, k]``: the largest P_S of edge k of state z that failures and paths can lead to from row q, and
        the least while the edge's own condition is not closed (own state only)."""
        tables = self._tables
        shape = (*tables.probability.shape[:2], tables.rollouts.states, tables.most_edges)
        largest, least = np.zeros(shape), np.zeros(shape)
        own = np.arange(shape[1])
        largest[:, own, tables.state] = tables.probability
        least[:, own, tables.state] = np.where(tables.certain, 0.0, tables.probability)
        # A fixed point over what can follow a row without a success: other states of the automaton by paths, failures
        # here. Both tables are monotone, so this ends.
        changed = True
        while changed:
            before = largest.copy(), least.copy()
            for z in range(shape[2]):
                rows = np.flatnonzero(tables.row_in_state[:, z] >= 0)
                rows = rows[[z in tables.travels_to[s] for s in tables.state[rows]]] if len(rows) else rows
                largest[:, rows] = np.maximum(largest[:, rows], largest[:, tables.row_in_state[rows, z]])
            for k in range(tables.most_edges):
                rows = np.flatnonzero(tables.row_after_failure[:, k] >= 0)
                after = tables.row_after_failure[rows, k]
                largest[:, rows] = np.maximum(largest[:, rows], largest[:, after])
                # A failure of edge k closes its own condition, so only those of other edges are asked for later.
                edges = (tables.state[rows][:, None], np.flatnonzero(np.arange(tables.most_edges) != k)[None])
                now, later = (slice(None), rows[:, None], *edges), (slice(None), after[:, None], *edges)
                least[now] = np.minimum(least[now], least[later])
            changed = not (np.array_equal(before[0], largest) and np.array_equal(before[1], least))
        return largest, least

    def _stage(self, state: int) -> "_Stage":
        """The stage of a state: everything that can happen before a success."""
        tables = self._tables
        within = {state}
        while True:
            more = within | {z for source in within for z in tables.travels_to[source]}
            if more == within:
                break
            within = more
        zs, subgoals = sorted(within), len(tables.subgoals)
        edges = [(z, k) for z in zs for k in range(len(tables.edges[z]))]
        pending_cost = np.array(
            [min((tables.failure_cost[s, z, k] for z, k in edges), default=0.0) for s in range(subgoals)],
            dtype=np.float64,
        )
        # Before a subgoal is entered something is pending from the subgoal before, at least its cheapest failure. A
        # stage begins at any of the subgoals, so the cheapest path from any of them counts.
        path_costs = tables.travel[:subgoals][:, zs][:, :, :, zs]
        enter = np.full(subgoals, np.inf)
        for s in range(subgoals):
            path_cost = path_costs[:, :, s] + pending_cost[:, None, None]
            # Trying on beyond the same subgoal in the same state is no path.
            path_cost[s, range(len(zs)), range(len(zs))] = np.inf
            enter[s] = path_cost.min() if path_cost.size else np.inf
        finish = tables.finish[:subgoals][:, zs]
        # Only where no path changes the state is it certain that an attempt stays within reach until it is made.
        always = np.zeros(subgoals, bool)
        if zs == [state]:
            apart = np.where(np.eye(subgoals, dtype=bool), 0.0, tables.travel[:subgoals, state, :, state])
            always = np.asarray(np.isfinite(apart).all(axis=0))
        return _Stage(
            edges=np.array(edges, dtype=int).reshape(-1, 2),
            pending_cost=pending_cost,
            enter=np.where(np.isfinite(enter), enter, 0.0),
            finish=float(finish.min()) if finish.size else math.inf,
            always=always,
        )

    def _success_values(self) -> np.ndarray:
        """``[s, z, k]``: the least that success of edge k of z beyond s can cost from the subgoal on."""
        tables = self._tables
        values = np.zeros_like(self._values)
        # Rows in which the edge is impossible do not count in the minimum.
        cheapest = np.where(tables.probability > 0, tables.success_cost, np.inf)
        for target in range(tables.rollouts.states):
            into = np.argwhere(tables.target == target)
            if not len(into):
                continue
            arrival = np.zeros(len(tables.subgoals))
            rows = np.flatnonzero(tables.follows_success & (tables.state == target))
            bounds = None
            if not tables.rollouts.accepting[target] and len(rows):
                # Whatever row the success leads to: the best chances of all of them.
                stage = self._stages[target]
                largest = self._largest_chance[:, rows][:, :, stage.edges[:, 0], stage.edges[:, 1]].max(axis=1)
                least = self._least_chance[:, rows][:, :, stage.edges[:, 0], stage.edges[:, 1]].min(axis=1)
                total, forced = self._stage_cost(stage, largest[None], least[None])
                bounds = total[0], forced[0]
            for z, k in into:
                own = np.flatnonzero(tables.state == z)
                cost = cheapest[:, own, k].min(axis=1, initial=np.inf)
                # After the success the robot leaves, and pays R_S, or tries on beyond the same subgoal, which saves a
                # path to it; where no attempt is forced, it may also be a dead end.
                if bounds is not None:
                    leave = np.maximum(bounds[0] - self._stages[target].pending_cost, 0.0) + np.where(
                        np.isfinite(cost), cost, 0.0
                    )
                    arrival = np.minimum(leave, np.maximum(bounds[0] - self._stages[target].enter, 0.0))
                    arrival = arrival if bounds[1] else np.minimum(arrival, self._dead_end)
                values[:, z, k] = np.where(np.isfinite(cost), cost, 0.0) + arrival
        return values

    def _stage_cost(self, stage: "_Stage", largest: np.ndarray, least: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower bound on the cost of a stage, ``[N]``, from probabilities ``[N, S, I]`` of its attempts; and whether
        some attempt must be made."""
        tables = self._tables
        zs, ks = stage.edges[:, 0], stage.edges[:, 1]
        # The cost of getting to a subgoal is shared by the attempts there, by their chances: whichever of them are
        # made, they carry no more than it.
        share = largest / np.maximum(largest.sum(axis=2, keepdims=True), _TINY)
        cost = (
            share * stage.enter[None, :, None]
            + largest * self._values[:, zs, ks][None]
            + (1.0 - largest) * tables.failure_cost[:, zs, ks][None]
        )
        # An attempt must be made before a dead end where it is possible, uncertain, unchanged by what is learnt
        # elsewhere, and always within reach.
        forced = (largest > 0) & (largest < 1.0) & (least == largest) & stage.always[None, :, None]
        count = len(largest)
        cost, largest, forced = (values.reshape(count, -1) for values in (cost, largest, forced))
        # Attempts one after the other until one succeeds cost least in the order of cost by probability: exchanging two
        # neighbours of another order cannot raise the cost.
        ratio = np.where(largest > 0, cost / np.maximum(largest, _TINY), np.inf)
        order = np.argsort(ratio, axis=1)
        cost, chance = np.take_along_axis(cost, order, 1), np.take_along_axis(largest, order, 1)
        must = np.take_along_axis(forced, order, 1)
        # From the last attempt to the first, each made or, unless it is forced, left out; finish is always open.
        total = np.full(count, min(self._dead_end, stage.finish))
        for i in range(cost.shape[1] - 1, -1, -1):
            attempt = np.where(chance[:, i] > 0, cost[:, i] + (1.0 - chance[:, i]) * total, np.inf)
            total = np.minimum(np.where(must[:, i], attempt, np.minimum(attempt, total)), stage.finish)
        return total * _ROUNDING, np.asarray(forced.any(axis=1))

    def lower_bounds(self, state: int, rows: Int32[np.ndarray, "N S"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lower bounds for open nodes of one state.

        Args:
          state: the automaton's state in all of them.
          rows: their rows of knowledge, by subgoal.

        Returns:
          The least cost of leaving, less the pending cost, and of an attempt beyond each subgoal, both ``[N, S]``, inf
          where there is nothing to do; and whether the node may be a dead end, ``[N]``.
        """
        tables, stage = self._tables, self._stages[state]
        subgoals = np.arange(len(tables.subgoals))[None]
        zs, ks = stage.edges[:, 0], stage.edges[:, 1]
        entries = (subgoals[..., None], rows[..., None], zs[None, None], ks[None, None])
        largest, least = self._largest_chance[entries], self._least_chance[entries]
        total, forced = self._stage_cost(stage, largest, least)
        nothing = ~(largest > 0).any(axis=(1, 2)) & np.isinf(stage.finish)
        leave = np.where(nothing[:, None], np.inf, np.maximum(total[:, None] - stage.pending_cost, 0.0))
        # Two bounds on the first attempt: what it costs by itself, and the stage less the path there that it saves.
        first = np.where(tables.available[subgoals, rows], self._first_try(state, rows), np.inf).min(axis=2)
        attempt = np.maximum(first, total[:, None] - stage.enter)
        return leave, attempt, ~forced

    def _first_try(self, state: int, rows: Int32[np.ndarray, "N S"]) -> np.ndarray:
        """Least cost of one attempt, ``[N, S, K]``, as if nothing came after a failure."""
        tables = self._tables
        chance = tables.probability[np.arange(len(tables.subgoals))[None], rows]
        return _ROUNDING * (chance * self._values[:, state] + (1.0 - chance) * tables.failure_cost[:, state])

    def upper_bound(self, state: int, rows: Int32[np.ndarray, "N S"]) -> Float64[np.ndarray, " N"]:
        """No policy costs more from here on."""
        tables = self._tables
        conditions = (
            int(tables.known_count.max(initial=0)) if tables.rollouts.closure.has_compounds else self._relevant(state)
        )
        unknown = len(tables.subgoals) * conditions - tables.known_count[rows].sum(axis=1)
        repeats = len(tables.subgoals) * tables.rollouts.states if tables.certain.any() else 0
        path_costs = np.concatenate([tables.travel.ravel(), tables.finish.ravel()])
        path_cost = float(np.max(path_costs[np.isfinite(path_costs)], initial=0.0))
        inside = float(max(tables.success_cost.max(initial=0.0), tables.failure_cost.max(initial=0.0)))
        return self._dead_end + (unknown + 1) * (1 + repeats) * (path_cost + 2.0 * inside)

    def _relevant(self, state: int) -> int:
        """Conditions of edges that are still within reach."""
        tables = self._tables
        return len({m for source, _, m in tables.rollouts.edges.values() if tables.reach[state, source]})


class _Stage(NamedTuple):
    """What the relaxation needs to know of a state and those that paths lead to from it.

    Attributes:
      edges: (z, k) of the edges that leave these states, ``[I, 2]``.
      pending_cost: least pending cost by subgoal, ``[S]``.
      enter: least cost of getting to a subgoal, the pending cost included, ``[S]``.
      finish: least path cost to acceptance.
      always: True on subgoals within reach from every other, ``[S]``.
    """

    edges: np.ndarray
    pending_cost: np.ndarray
    enter: np.ndarray
    finish: float
    always: np.ndarray
