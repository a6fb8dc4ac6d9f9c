"""The graph of what can be known in the course of a rollout: the states of the exact solver.

Neither the location nor the pending cost enters a node: what an attempt at a subgoal is worth depends on the
automaton's state and on what is known of every subgoal, so one node serves all locations. Nodes are told apart by
64-bit fingerprints: the chance that two of ten million nodes are confused is below 1e-5.

References:
  Bradley et al., Learning and Planning for Temporally Extended Tasks in Unknown Environments, ICRA 2021, Eq. 3.
  Zobrist, A new hashing method with application for game playing, ICCA Journal 1990 (fingerprints by exclusive or).
"""

from collections.abc import Callable, Iterator

import numpy as np

from potlp_jax.planning.exact.knowledge import ACCEPTED, NOWHERE, Knowledge
from potlp_jax.planning.exact.relaxation import Relaxation

CHUNK = 4096
"""Nodes handled together."""


class Rows:
    """Arrays, by name, that grow by their first axis; ``count`` is its length."""

    def __init__(self, **columns: tuple[tuple[int, ...], type]) -> None:
        self.count = 0
        self._columns = {name: np.empty((64, *shape), dtype) for name, (shape, dtype) in columns.items()}

    def __getitem__(self, name: str) -> np.ndarray:
        return self._columns[name][: self.count]

    def append(self, **values: np.ndarray) -> None:
        """Rows at the end; every column is named."""
        added = len(next(iter(values.values())))
        for name, value in values.items():
            column = self._columns[name]
            if self.count + added > len(column):
                grown = np.empty((max(self.count + added, len(column) * 3 // 2), *column.shape[1:]), column.dtype)
                grown[: self.count] = column[: self.count]
                self._columns[name] = column = grown
            column[self.count : self.count + added] = value
        self.count += added


class Graph:
    """Nodes, those among them that have been given children, and bounds on both.

    A node is open until it is expanded; its bounds are those of the relaxation until then. Node and expansion 0 are the
    root's; subgoals, rows of knowledge and k are numbered as in ``Knowledge``.

    Attributes:
      tables: what can be known of one subgoal.
      nodes: by node: ``q [S]``, the row of knowledge of every subgoal; ``state``; ``rank``, see ``Knowledge.ranks``;
        ``expansion``, -1 while open; ``leave_*`` and ``attempt_*`` ``[S]``, bounds on the value from beyond the
        subgoal, less the pending cost, if the robot leaves and if it makes an attempt there first; ``ceiling``, which
        no policy exceeds; ``may_be_dead``, whether the relaxation leaves a dead end possible.
      expansions: by expansion: ``node``; ``success`` and ``failure`` ``[S, K]``, children of an attempt (``ACCEPTED``,
        ``NOWHERE``); ``link [Z]``, the node in each state that paths lead to, else ``NOWHERE``; ``best_edge [S]`` and
        ``best_path [S, 2]``, the attempt there and the next one elsewhere (state, subgoal) that are best from below.
    """

    def __init__(self, tables: Knowledge) -> None:
        self.tables, self._relaxation = tables, Relaxation(tables)
        subgoals, states, width = len(tables.subgoals), tables.rollouts.states, tables.width
        self.nodes = Rows(
            q=((subgoals,), np.int32),
            state=((), np.int32),
            rank=((), np.int64),
            expansion=((), np.int32),
            leave_lower=((subgoals,), np.float64),
            attempt_lower=((subgoals,), np.float64),
            leave_upper=((subgoals,), np.float64),
            attempt_upper=((subgoals,), np.float64),
            ceiling=((), np.float64),
            may_be_dead=((), np.bool_),
        )
        self.expansions = Rows(
            node=((), np.int32),
            success=((subgoals, width), np.int32),
            failure=((subgoals, width), np.int32),
            link=((states,), np.int32),
            best_edge=((subgoals,), np.int32),
            best_path=((subgoals, 2), np.int32),
        )
        fingerprints = np.random.default_rng(0).integers(0, 2**63, (subgoals, len(tables.state)), dtype=np.int64)
        self._prints = fingerprints.astype(np.uint64)
        self._keys, self._key_nodes = np.empty(0, np.uint64), np.empty(0, np.int64)
        root = np.zeros((1, subgoals), np.int32)
        self._find_or_add(self._fingerprint(root), lambda _: (root, tables.state[:1]))

    def open(self, nodes: np.ndarray) -> np.ndarray:
        """Those of the nodes that have no children yet."""
        return nodes[self.nodes["expansion"][nodes] < 0]

    def expand(self, nodes: np.ndarray) -> None:
        """Give open nodes their children."""
        for z in np.unique(self.nodes["state"][nodes]):
            own = nodes[self.nodes["state"][nodes] == z]
            for start in range(0, len(own), CHUNK):
                self._expand_alike(int(z), own[start : start + CHUNK])

    def groups(self, expansions: np.ndarray) -> list[np.ndarray]:
        """Expansions of equal rank, in order of rank."""
        rank = self.nodes["rank"][self.expansions["node"][expansions]]
        order = np.argsort(rank, kind="stable")
        return np.split(expansions[order], np.flatnonzero(np.diff(rank[order])) + 1)

    def root_actions(self) -> Iterator[tuple[int, int, int, int, float]]:
        """Attempts within reach of the robot: action, s, k, expansion of the node it is made in, path cost."""
        t, z = self.tables, int(self.nodes["state"][0])
        for other in t.travels_to[z]:
            expansion = int(self.nodes["expansion"][self.expansions["link"][0, other]])
            for s, subgoal in enumerate(t.subgoals):
                for k, edge in enumerate(t.edges[other]):
                    if np.isfinite(t.travel[-1, z, s, other]):
                        action = subgoal * t.rollouts.edge_count + edge
                        yield action, s, k, expansion, float(t.travel[-1, z, s, other])

    def _fingerprint(self, q: np.ndarray) -> np.ndarray:
        """``[..., S]`` to ``[...]``."""
        prints = self._prints[np.arange(q.shape[-1]), q]
        return np.bitwise_xor.reduce(prints, axis=-1) if q.shape[-1] else np.zeros(q.shape[:-1], np.uint64)

    def _find_or_add(
        self, keys: np.ndarray, rows_of: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    ) -> np.ndarray:
        """Nodes of fingerprints; ``rows_of`` gives the rows and states of those that are new, by their positions."""
        distinct, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
        slot = np.searchsorted(self._keys, distinct)
        known = np.zeros(len(distinct), bool)
        inner = slot < len(self._keys)
        known[inner] = self._keys[slot[inner]] == distinct[inner]
        nodes = np.empty(len(distinct), np.int64)
        nodes[known] = self._key_nodes[slot[known]]
        fresh = np.flatnonzero(~known)
        if len(fresh):
            nodes[fresh] = self.nodes.count + np.arange(len(fresh))
            self._keys = np.insert(self._keys, slot[fresh], distinct[fresh])
            self._key_nodes = np.insert(self._key_nodes, slot[fresh], nodes[fresh])
            self._add(*rows_of(first[fresh]))
        return nodes[inverse]

    def _add(self, q: np.ndarray, state: np.ndarray) -> None:
        count, subgoals = q.shape
        leave, attempt = np.empty((count, subgoals)), np.empty((count, subgoals))
        ceiling, may_be_dead = np.empty(count), np.empty(count, bool)
        for z in np.unique(state).tolist():
            own = np.flatnonzero(state == z)
            leave[own], attempt[own], may_be_dead[own] = self._relaxation.below(z, q[own])
            ceiling[own] = self._relaxation.above(z, q[own])
        self.nodes.append(
            q=q,
            state=state,
            rank=self.tables.ranks(q, state),
            expansion=np.full(count, NOWHERE),
            leave_lower=leave,
            attempt_lower=attempt,
            leave_upper=np.full((count, subgoals), np.inf),
            attempt_upper=np.where(np.isfinite(attempt), ceiling[:, None], np.inf),
            ceiling=ceiling,
            may_be_dead=may_be_dead,
        )

    def _expand_alike(self, z: int, nodes: np.ndarray) -> None:
        t, q = self.tables, self.nodes["q"][nodes]
        count, subgoals = q.shape
        cleared = t.clear[q]
        here = np.arange(subgoals)[None]
        parts: list[tuple[np.ndarray, np.ndarray, np.ndarray, int, np.ndarray, int]] = []
        success = np.full((count, subgoals, t.width), NOWHERE)
        failure = success.copy()

        def attempts(edge: int, mask: np.ndarray, before: np.ndarray, own: np.ndarray, slot: int) -> None:
            """Children in which everything but the subgoal's own row is as ``before``."""
            key = self._fingerprint(before)[:, None] ^ self._prints[here, before] ^ self._prints[here, own]
            i, s = np.nonzero(mask)
            parts.append((key[i, s], i, s, edge, np.stack([before[i, s], own[i, s]]), slot))
            befores.append(before)

        befores: list[np.ndarray] = []
        for k in range(len(t.edges[z])):
            available, certain = t.available[here, q, k], t.certain[q, k]
            target = t.target[z, k]
            if t.rollouts.accepting[target]:
                success[..., k] = np.where(available, ACCEPTED, NOWHERE)
            else:
                attempts(k, available & ~certain, t.move[cleared, target], t.success[q, k], 0)
                attempts(k, available & certain, t.move[q, target], t.success[q, k], 0)
            tries = available & (t.probability[here, q, k] < 1.0)
            attempts(k, tries, cleared, t.failure[q, k], 1)
        links = [other for other in t.travels_to[z] if other != z]
        everyone = np.arange(count)
        for other in links:
            moved = t.move[q, other]
            parts.append((self._fingerprint(moved), everyone, np.zeros(count, int), other, np.zeros((2, count)), 2))
            befores.append(moved)

        sizes = [len(part[0]) for part in parts]
        ends = np.cumsum([0, *sizes])

        def rows_of(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            rows = np.empty((len(positions), subgoals), np.int32)
            states = np.empty(len(positions), np.int32)
            for part, (before, (_, i, s, label, own, slot)) in enumerate(zip(befores, parts, strict=True)):
                mine = np.flatnonzero((positions >= ends[part]) & (positions < ends[part + 1]))
                at = positions[mine] - ends[part]
                rows[mine] = before[i[at]]
                if slot < 2:
                    rows[mine, s[at]] = own[1, at]
                states[mine] = label if slot == 2 else z if slot == 1 else t.target[z, label]
            return rows, states

        link = np.full((count, t.rollouts.states), NOWHERE)
        if z in t.travels_to[z]:
            link[:, z] = nodes
        if parts:
            children = self._find_or_add(np.concatenate([part[0] for part in parts]), rows_of)
            for part, (_, i, s, label, _, slot) in enumerate(parts):
                own_children = children[ends[part] : ends[part + 1]]
                if slot == 2:
                    link[:, label] = own_children
                else:
                    (success, failure)[slot][i, s, label] = own_children
        self.nodes["expansion"][nodes] = self.expansions.count + np.arange(count)
        self.nodes["may_be_dead"][nodes] = False
        self.expansions.append(
            node=nodes,
            success=success,
            failure=failure,
            link=link,
            best_edge=np.zeros((count, subgoals)),
            best_path=np.zeros((count, subgoals, 2)),
        )
