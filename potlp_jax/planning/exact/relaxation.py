"""Bounds on what a history will cost from what can at best and at worst come of it, without looking ahead.

References:
  Bradley et al., Learning and Planning for Temporally Extended Tasks in Unknown Environments, ICRA 2021, Eq. 3.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int32

from potlp_jax.planning.exact.knowledge import Knowledge


class Relaxation:
    """Bounds on open nodes.

    Below: in one state of the automaton (or those that paths lead to from it) every attempt can be made once at most;
    it costs no less than the cheapest path to its subgoal, shared by the attempts there, and succeeds with the largest
    probability that later knowledge may give it. With the order of attempts free, the best one is by ratio of cost to
    probability, and the rollout ends when success leads on, the robot finishes, or nothing is left. Attempts that are
    certain to stay available must be made before a dead end; others may be left out.

    Above: the dead end after as many of the longest steps as there are conditions to close.
    """

    def __init__(self, tables: Knowledge) -> None:
        self._tables = tables
        rollouts = tables.rollouts
        self._dead_end = rollouts.dead_end_cost
        self._largest, self._least = self._reachable_probabilities()
        states = rollouts.states
        subgoals = len(tables.subgoals)
        self._stages = [self._stage(z) for z in range(states)]
        self._values = np.zeros((subgoals, states, tables.width))
        for _ in range(states):
            self._values = self._success_values()

    def _reachable_probabilities(self) -> tuple[np.ndarray, np.ndarray]:
        """``[s, q, z, k]``: the largest P_S of edge k of state z that failures and paths can lead to from row q, and
        the least while the edge's own condition is not closed (own state only)."""
        t = self._tables
        shape = (*t.probability.shape[:2], t.rollouts.states, t.width)
        largest, least = np.zeros(shape), np.zeros(shape)
        own = np.arange(shape[1])
        largest[:, own, t.state] = t.probability
        least[:, own, t.state] = np.where(t.certain, 0.0, t.probability)
        changed = True
        while changed:
            before = largest.copy(), least.copy()
            for z in range(shape[2]):
                rows = np.flatnonzero(t.move[:, z] >= 0)
                rows = rows[[z in t.travels_to[s] for s in t.state[rows]]] if len(rows) else rows
                largest[:, rows] = np.maximum(largest[:, rows], largest[:, t.move[rows, z]])
            for k in range(t.width):
                rows = np.flatnonzero(t.failure[:, k] >= 0)
                after = t.failure[rows, k]
                largest[:, rows] = np.maximum(largest[:, rows], largest[:, after])
                other = np.arange(t.width) != k
                least[:, rows[:, None], t.state[rows][:, None], np.flatnonzero(other)[None]] = np.minimum(
                    least[:, rows[:, None], t.state[rows][:, None], np.flatnonzero(other)[None]],
                    least[:, after[:, None], t.state[rows][:, None], np.flatnonzero(other)[None]],
                )
            changed = not (np.array_equal(before[0], largest) and np.array_equal(before[1], least))
        return largest, least

    def _stage(self, state: int) -> "_Stage":
        t = self._tables
        within = {state}
        while True:
            more = within | {z for source in within for z in t.travels_to[source]}
            if more == within:
                break
            within = more
        zs, subgoals = sorted(within), len(t.subgoals)
        pairs = [(z, k) for z in zs for k in range(len(t.edges[z]))]
        pending_cost = np.array(
            [min((t.failure_cost[s, z, k] for z, k in pairs), default=0.0) for s in range(subgoals)], dtype=np.float64
        )
        path_costs = t.travel[:subgoals][:, zs][:, :, :, zs]
        enter = np.full(subgoals, np.inf)
        for s in range(subgoals):
            path_cost = path_costs[:, :, s] + pending_cost[:, None, None]
            path_cost[s, range(len(zs)), range(len(zs))] = np.inf
            enter[s] = path_cost.min() if path_cost.size else np.inf
        finish = t.finish[:subgoals][:, zs]
        always = np.zeros(subgoals, bool)
        if zs == [state]:
            apart = np.where(np.eye(subgoals, dtype=bool), 0.0, t.travel[:subgoals, state, :, state])
            always = np.asarray(np.isfinite(apart).all(axis=0))
        return _Stage(
            pairs=np.array(pairs, dtype=int).reshape(-1, 2),
            pending_cost=pending_cost,
            enter=np.where(np.isfinite(enter), enter, 0.0),
            finish=float(finish.min()) if finish.size else math.inf,
            always=always,
        )

    def _success_values(self) -> np.ndarray:
        """``[s, z, k]``: the least that success of edge k of z beyond s can cost from the subgoal on."""
        t = self._tables
        values = np.zeros_like(self._values)
        cheapest = np.where(t.probability > 0, t.success_cost, np.inf)
        for target in range(t.rollouts.states):
            into = np.argwhere(t.target == target)
            if not len(into):
                continue
            arrival = np.zeros(len(t.subgoals))
            rows = np.flatnonzero(t.entry & (t.state == target))
            bounds = None
            if not t.rollouts.accepting[target] and len(rows):
                stage = self._stages[target]
                largest = self._largest[:, rows][:, :, stage.pairs[:, 0], stage.pairs[:, 1]].max(axis=1)
                least = self._least[:, rows][:, :, stage.pairs[:, 0], stage.pairs[:, 1]].min(axis=1)
                total, forced = self._total(stage, largest[None], least[None])
                bounds = total[0], forced[0]
            for z, k in into:
                own = np.flatnonzero(t.state == z)
                cost = cheapest[:, own, k].min(axis=1, initial=np.inf)
                if bounds is not None:
                    leave = np.maximum(bounds[0] - self._stages[target].pending_cost, 0.0) + np.where(
                        np.isfinite(cost), cost, 0.0
                    )
                    arrival = np.minimum(leave, np.maximum(bounds[0] - self._stages[target].enter, 0.0))
                    arrival = arrival if bounds[1] else np.minimum(arrival, self._dead_end)
                values[:, z, k] = np.where(np.isfinite(cost), cost, 0.0) + arrival
        return values

    def _total(self, stage: "_Stage", largest: np.ndarray, least: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower bound on the cost of a stage, ``[N]``, from probabilities ``[N, S, I]`` of its attempts; and whether
        some attempt must be made."""
        t = self._tables
        zs, ks = stage.pairs[:, 0], stage.pairs[:, 1]
        share = largest / np.maximum(largest.sum(axis=2, keepdims=True), 1e-300)
        cost = (
            share * stage.enter[None, :, None]
            + largest * self._values[:, zs, ks][None]
            + (1.0 - largest) * t.failure_cost[:, zs, ks][None]
        )
        forced = (largest > 0) & (largest < 1.0) & (least == largest) & stage.always[None, :, None]
        count = len(largest)
        cost, largest, forced = (values.reshape(count, -1) for values in (cost, largest, forced))
        ratio = np.where(largest > 0, cost / np.maximum(largest, 1e-300), np.inf)
        order = np.argsort(ratio, axis=1)
        cost, chance = np.take_along_axis(cost, order, 1), np.take_along_axis(largest, order, 1)
        must = np.take_along_axis(forced, order, 1)
        total = np.full(count, min(self._dead_end, stage.finish))
        for i in range(cost.shape[1] - 1, -1, -1):
            attempt = np.where(chance[:, i] > 0, cost[:, i] + (1.0 - chance[:, i]) * total, np.inf)
            total = np.minimum(np.where(must[:, i], attempt, np.minimum(attempt, total)), stage.finish)
        return total * (1.0 - 1e-9), np.asarray(forced.any(axis=1))

    def below(self, state: int, q: Int32[np.ndarray, "N S"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """For nodes of one state: least cost of leaving (less the pending cost) and of an attempt beyond each subgoal,
        both ``[N, S]``, inf where there is nothing to do; and whether it may be a dead end, ``[N]``."""
        t, stage = self._tables, self._stages[state]
        subgoals = np.arange(len(t.subgoals))[None]
        zs, ks = stage.pairs[:, 0], stage.pairs[:, 1]
        pick = (subgoals[..., None], q[..., None], zs[None, None], ks[None, None])
        largest, least = self._largest[pick], self._least[pick]
        total, forced = self._total(stage, largest, least)
        nothing = ~(largest > 0).any(axis=(1, 2)) & np.isinf(stage.finish)
        leave = np.where(nothing[:, None], np.inf, np.maximum(total[:, None] - stage.pending_cost, 0.0))
        first = np.where(t.available[subgoals, q], self._first_try(state, q), np.inf).min(axis=2)
        attempt = np.maximum(first, total[:, None] - stage.enter)
        return leave, attempt, ~forced

    def _first_try(self, state: int, q: Int32[np.ndarray, "N S"]) -> np.ndarray:
        """Least cost of one attempt, ``[N, S, K]``, as if nothing came after a failure."""
        t = self._tables
        chance = t.probability[np.arange(len(t.subgoals))[None], q]
        return (1.0 - 1e-9) * (chance * self._values[:, state] + (1.0 - chance) * t.failure_cost[:, state])

    def above(self, state: int, q: Int32[np.ndarray, "N S"]) -> Float64[np.ndarray, " N"]:
        """No policy costs more from here on."""
        t = self._tables
        conditions = int(t.known_count.max(initial=0)) if t.rollouts.closure.has_compounds else self._relevant(state)
        unknown = len(t.subgoals) * conditions - t.known_count[q].sum(axis=1)
        repeats = len(t.subgoals) * t.rollouts.states if t.certain.any() else 0
        path_costs = np.concatenate([t.travel.ravel(), t.finish.ravel()])
        path_cost = float(np.max(path_costs[np.isfinite(path_costs)], initial=0.0))
        inside = float(max(t.success_cost.max(initial=0.0), t.failure_cost.max(initial=0.0)))
        return self._dead_end + (unknown + 1) * (1 + repeats) * (path_cost + 2.0 * inside)

    def _relevant(self, state: int) -> int:
        t = self._tables
        return len({m for source, _, m in t.rollouts.edges.values() if t.reach[state, source]})


class _Stage(NamedTuple):
    """What the relaxation needs to know of a state and those that paths lead to from it.

    ``pairs``: (z, k) of its edges. ``pending_cost``: least pending cost by subgoal. ``enter``: least cost of getting to
    a subgoal, the pending cost included. ``finish``: least path cost to acceptance. ``always``: subgoals within reach
    from every other.
    """

    pairs: np.ndarray
    pending_cost: np.ndarray
    enter: np.ndarray
    finish: float
    always: np.ndarray
