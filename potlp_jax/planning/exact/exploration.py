"""Which nodes of the exact solver's graph to expand next: those that the policy which looks best is likely to meet.

References:
  Bradley et al., Learning and Planning for Temporally Extended Tasks in Unknown Environments, ICRA 2021, Eq. 3.
  Martelli and Montanari, Optimizing decision trees through heuristically guided search, CACM 1978 (AO*).
"""

import math
import time
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from potlp_jax.planning.exact.bounds import FINISH, GraphBounds
from potlp_jax.planning.exact.graph import CHUNK, Graph

_BREADTH = 2000
"""Nodes that are expanded in any case: small problems are solved without any choice of what to expand."""
_HARD = 4000
"""Expanded nodes from which on a problem counts as hard for the choice of what to expand: it may be smaller than it is
hard, so that all of it is expanded once, if it fits."""
_WHOLE = 150_000
"""Nodes that are expanded at most in trying to expand all: some 3 s."""
_BATCH = 1000
"""Nodes that are expanded at least between two updates of all bounds. numpy is fast on many nodes at a time, and the
update, which passes over all nodes, must not be most of the work; so from 2,000 nodes on it is half of their number."""
_FORESIGHT = 10
"""Attempts of the policy that are followed between two updates of all bounds."""
_CLOSING = 100
"""The same when time runs out: enough to follow nearly every history to its end."""
_NEARLY = 30.0
"""Cost by which an attempt may seem worse than the best and still be expanded beside it; values of the benchmark's
problems are some hundreds."""
_NEGLIGIBLE = 1e-3
"""Share of the policy's open probability below which a node is not followed further before the next update."""


@dataclass
class Flow:
    """Where a policy goes: the chances of its histories, by what it does next.

    Attributes:
      leaving: chance of meeting a node beyond each subgoal and leaving from there, ``[N, S]``.
      trying: the same where another attempt is made there.
      open: the same where the node is open.
      dead: chance of a dead end.
    """

    leaving: np.ndarray
    trying: np.ndarray
    open: np.ndarray
    dead: float = 0.0


class Exploration:
    """Grows a graph from its root where that helps to tell the best action."""

    def __init__(self, graph: Graph, bounds: GraphBounds) -> None:
        self._graph, self._tables, self._bounds = graph, graph.tables, bounds
        self._nodes, self._expansions = graph.nodes, graph.expansions
        self._tried_whole = False

    def begin(self, max_states: int) -> None:
        """Expand the root and what paths lead to from it; beyond that breadth first, while there are few nodes."""
        # ``root_actions`` reads the expansions of all nodes that a path from the robot leads to.
        self._graph.expand(np.array([0]))
        links = self._expansions["link"][0]
        self._graph.expand(self._graph.open(np.unique(links[links > 0])))
        self._expand_breadth_first(_BREADTH, max_states, math.inf)

    def _expand_breadth_first(self, limit: int, max_states: int, deadline: float) -> None:
        """Expand all open nodes, and theirs, while no more than ``limit`` are expanded."""
        breadth = self._graph.open(np.arange(self._nodes.count))
        while len(breadth) and self._expansions.count + len(breadth) <= limit and self._nodes.count <= max_states:
            if time.process_time() > deadline:
                return
            self._graph.expand(breadth)
            breadth = self._graph.open(np.arange(self._nodes.count))

    def follow(self, weights: np.ndarray) -> Flow:
        """Play the policy that is best by the lower bounds from the root's actions, each with its weight."""
        shape = self._nodes["leave_lower"].shape
        flow = Flow(np.zeros(shape), np.zeros(shape), np.zeros(shape))
        for action, s, k, expansion, _ in self._graph.root_actions():
            if weights[action] > 0:
                self._play(flow, np.array([expansion]), np.array([s]), np.array([k]), weights[[action]])
        # By rank, so that all of a node's chances have arrived before they are passed on. First those that leave: a
        # path may lead to a node of the same rank, whose attempts come after.
        for group in self._graph.groups(np.arange(self._expansions.count)):
            nodes = self._expansions["node"][group]
            i, p = np.nonzero(flow.leaving[nodes])
            other, s = self._expansions["best_path"][group[i], p].T
            on = other != FINISH
            link = self._expansions["link"][group[i[on]], other[on]]
            mass = flow.leaving[nodes[i[on]], p[on]]
            closed = self._nodes["expansion"][link] >= 0
            np.add.at(flow.trying, (link[closed], s[on][closed]), mass[closed])
            np.add.at(flow.open, (link[~closed], s[on][~closed]), mass[~closed])
            i, s = np.nonzero(flow.trying[nodes])
            best = self._expansions["best_edge"][group[i], s]
            self._play(flow, group[i], s, best, flow.trying[nodes[i], s])
        return flow

    def grow(self, flow: Flow, max_states: int, deadline: float, closing: bool) -> None:
        """Expand open nodes: those that the policy meets, and what it meets next from there, and others beside it.

        Args:
          flow: where the policy goes by the present bounds.
          max_states: nodes after which to stop.
          deadline: processor time after which to stop.
          closing: expand nothing beside the policy, and follow it to the end.
        """
        # Bounds are loose where attempts mostly fail or conditions imply each other: one such problem of 67,000 nodes
        # was given up after seven times the time that expanding all of them takes.
        if self._expansions.count > _HARD and not self._tried_whole:
            self._tried_whole = True
            self._expand_breadth_first(_WHOLE, max_states, deadline)
            return
        # By chance times the most that the node can cost: what it can change in the value of the root.
        size = max(_BATCH, self._expansions.count // 2)
        nodes = _largest_first(flow.open.sum(axis=1) * self._nodes["ceiling"], size)
        beside = _largest_first(self._deviations() * self._nodes["ceiling"], size)
        mass, least, begin = flow.open, flow.open.sum() * _NEGLIGIBLE, self._expansions.count
        for _ in range(_CLOSING if closing else _FORESIGHT):
            first = self._expansions.count
            self._graph.expand(nodes)
            fresh = np.arange(first, self._expansions.count)
            self._bounds.back_up(fresh)
            if self._nodes.count > max_states or time.process_time() > deadline:
                return
            nodes, mass = self._look_ahead(fresh, mass)
            nodes = nodes[mass.sum(axis=1)[nodes] > least][:size]
            if not len(nodes):
                break
        # The policy looks best by lower bounds; another may turn out better once these rise. Expanding beside it twice
        # as many nodes as for it keeps the search from following one policy to the end and only then seeing that it is
        # bad.
        if not closing:
            count = max(_BATCH // 4, 2 * (self._expansions.count - begin))
            self._graph.expand(self._graph.open(beside)[:count])

    def _play(self, flow: Flow, expansions: np.ndarray, s: np.ndarray, k: np.ndarray, mass: np.ndarray) -> None:
        """Add both outcomes of attempts to a flow.

        Args:
          flow: changed in place.
          expansions: where the attempts are made, ``[n]``.
          s: their subgoals.
          k: their edges.
          mass: chance of each.
        """
        tables, nodes = self._tables, self._expansions["node"][expansions]
        row, state = self._nodes["rows"][nodes, s], self._nodes["state"][nodes]
        chance = tables.probability[s, row, k]
        success, failure = self._expansions["success"][expansions, s, k], self._expansions["failure"][expansions, s, k]
        # The outcome's cost is pending beyond the subgoal: it is paid where the robot leaves, and not where it tries
        # on.
        for child, pending_cost, share in (
            (success, tables.success_cost[s, row, k], chance),
            (failure, tables.failure_cost[s, state, k], 1.0 - chance),
        ):
            real = (child >= 0) & (share * mass > 0)
            n, at, amount = child[real], s[real], (share * mass)[real]
            leave = pending_cost[real] + self._nodes["leave_lower"][n, at]
            stay = self._nodes["attempt_lower"][n, at]
            closed = self._nodes["expansion"][n] >= 0
            dead = np.isinf(np.minimum(leave, stay))
            flow.dead += float(amount[dead].sum())
            for into, which in (
                (flow.open, ~closed & ~dead),
                (flow.leaving, closed & ~dead & (leave <= stay)),
                (flow.trying, closed & ~dead & (leave > stay)),
            ):
                np.add.at(into, (n[which], at[which]), amount[which])

    def _deviations(self) -> Float64[np.ndarray, " N"]:
        """The chance of meeting each open node if attempts are chosen at random, those that seem better more often.

        Locations are left out of it: this only says which nodes are worth expanding beside those of the best policy.
        """
        mass = np.zeros(self._nodes.count)
        mass[0] = 1.0
        for group in self._graph.groups(np.arange(self._expansions.count)):
            for start in range(0, len(group), CHUNK):
                self._spread(mass, group[start : start + CHUNK])
        return np.where(self._nodes["expansion"] < 0, mass, 0.0)

    def _spread(self, mass: np.ndarray, expansions: np.ndarray) -> None:
        """Pass the mass of nodes on to their children; to those that paths lead to, half of it besides."""
        nodes = self._expansions["node"][expansions]
        lower, _ = self._bounds.attempt_bounds(expansions)
        # A softmax over all attempts of a node. Those that are not available have infinite bounds and weight 0; the
        # initial value stands for nodes without any.
        slack = lower - lower.min(axis=(1, 2), keepdims=True, initial=1e300)
        weight = np.exp(-slack / _NEARLY)
        weight *= (mass[nodes] / np.maximum(weight.sum(axis=(1, 2)), 1e-300))[:, None, None]
        chance = self._tables.probability[np.arange(lower.shape[1])[None], self._nodes["rows"][nodes]]
        for name, share in (("success", chance), ("failure", 1.0 - chance)):
            child = self._expansions[name][expansions]
            np.add.at(mass, child[child >= 0], (weight * share)[child >= 0])
        link = self._expansions["link"][expansions]
        other = (link >= 0) & (link != nodes[:, None])
        np.add.at(mass, link[other], 0.5 * np.broadcast_to(mass[nodes][:, None], link.shape)[other])

    def _look_ahead(self, fresh: np.ndarray, mass: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Open nodes that the policy meets next from fresh expansions; ``mass`` is that of arriving there."""
        nodes = self._expansions["node"][fresh]
        shape = self._nodes["leave_lower"].shape
        flow = Flow(np.zeros(shape), np.zeros(shape), np.zeros(shape))
        i, s = np.nonzero(mass[nodes])
        # As in ``follow``, but from the nodes just expanded only: where the robot leaves, the next attempt is
        # elsewhere.
        leave = self._nodes["leave_lower"][nodes[i], s] < self._nodes["attempt_lower"][nodes[i], s]
        amount = mass[nodes[i], s]
        other, there = self._expansions["best_path"][fresh[i], s].T
        link = np.where(leave & (other >= 0), self._expansions["link"][fresh[i], other], nodes[i])
        goes = ~leave | (other >= 0)
        at = np.where(leave, there, s)
        expansion = self._nodes["expansion"][link]
        goes &= (expansion >= 0) & np.isfinite(self._nodes["attempt_lower"][link, at])
        best = self._expansions["best_edge"][expansion[goes], at[goes]]
        self._play(flow, expansion[goes], at[goes], best, amount[goes])
        return np.flatnonzero(flow.open.any(axis=1)), flow.open


def _largest_first(score: Float64[np.ndarray, " N"], count: int) -> np.ndarray:
    """Indices of the largest positive scores."""
    # Partition first: only what is kept is sorted.
    positive = np.flatnonzero(score > 0)
    if len(positive) > count:
        positive = positive[np.argpartition(-score[positive], count)[:count]]
    return positive[np.argsort(-score[positive])]
