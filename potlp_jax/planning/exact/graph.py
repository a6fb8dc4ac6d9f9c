"""The graph of what can be known in the course of a rollout: the states of the exact solver.

Neither the location nor the pending cost enters a node: what an attempt at a subgoal is worth depends on the
automaton's state and on what is known of every subgoal, so one node serves all locations. Nodes are told apart by
fingerprints of 63 random bits: the chance that any two of ten million nodes are confused is below 1e-5.

References:
  Bradley et al., Learning and Planning for Temporally Extended Tasks in Unknown Environments, ICRA 2021, Eq. 3.
  Zobrist, A new hashing method with application for game playing, ICCA Journal 1990 (fingerprints by exclusive or).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from potlp_jax.planning.exact.knowledge import ACCEPTED, NOWHERE, Knowledge
from potlp_jax.planning.exact.relaxation import Relaxation

CHUNK = 4096
"""Nodes handled together: enough for numpy to be fast, few enough for arrays over their attempts to fit the memory."""


class Table:
    """Arrays, by name, that grow by their first axis; ``count`` is its length."""

    # Columns hold 64 entries at first and half as many again whenever they are full, so appending costs O(1) an entry.
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
      nodes: by node: ``rows [S]``, the row of knowledge of every subgoal; ``state``; ``rank``, see ``Knowledge.ranks``;
        ``expansion``, -1 while open; ``leave_*`` and ``attempt_*`` ``[S]``, bounds on the value from beyond the
        subgoal, less the pending cost, if the robot leaves and if it makes an attempt there first; ``ceiling``, which
        no policy exceeds; ``may_be_dead``, whether the relaxation leaves a dead end possible.
      expansions: by expansion: ``node``; ``success`` and ``failure`` ``[S, K]``, children of an attempt (``ACCEPTED``,
        ``NOWHERE``); ``link [Z]``, the node in each state that paths lead to, or ``NOWHERE``; ``best_edge [S]`` and
        ``best_path [S, 2]``, the attempt there and the next one elsewhere (state, subgoal) that are best from below.
    """

    def __init__(self, tables: Knowledge) -> None:
        self.tables, self._relaxation = tables, Relaxation(tables)
        subgoals, states, width = len(tables.subgoals), tables.rollouts.states, tables.most_edges
        self.nodes = Table(
            rows=((subgoals,), np.int32),
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
        self.expansions = Table(
            node=((), np.int32),
            success=((subgoals, width), np.int32),
            failure=((subgoals, width), np.int32),
            link=((states,), np.int32),
            best_edge=((subgoals,), np.int32),
            best_path=((subgoals, 2), np.int32),
        )
        # A fingerprint is the exclusive or of one random number for each subgoal and its row, so that changing one row
        # takes two operations (Zobrist hashing). Seeded, so that runs repeat.
        fingerprints = np.random.default_rng(0).integers(0, 2**63, (subgoals, len(tables.state)), dtype=np.int64)
        self._prints = fingerprints.astype(np.uint64)
        # All fingerprints in order, and the node of each: looked up by binary search, thousands at a time.
        self._keys, self._key_nodes = np.empty(0, np.uint64), np.empty(0, np.int64)
        root = np.zeros((1, subgoals), np.int32)
        self._find_or_add(self._fingerprint(root), lambda _: (root, tables.state[:1]))

    def open(self, nodes: np.ndarray) -> np.ndarray:
        """Those of the nodes that have no children yet."""
        return nodes[self.nodes["expansion"][nodes] < 0]

    def expand(self, nodes: np.ndarray) -> None:
        """Give open nodes their children."""
        # Nodes of one state have the same edges, so one set of array operations serves them all.
        for z in np.unique(self.nodes["state"][nodes]):
            own = nodes[self.nodes["state"][nodes] == z]
            for start in range(0, len(own), CHUNK):
                self._expand_alike(int(z), own[start : start + CHUNK])

    def groups(self, expansions: np.ndarray) -> list[np.ndarray]:
        """Expansions of equal rank, in order of rank."""
        # No attempt leads from a node to one of equal rank, so the members of a group can be backed up together.
        rank = self.nodes["rank"][self.expansions["node"][expansions]]
        order = np.argsort(rank, kind="stable")
        return np.split(expansions[order], np.flatnonzero(np.diff(rank[order])) + 1)

    def root_actions(self) -> Iterator[tuple[int, int, int, int, float]]:
        """Attempts within reach of the robot: action, s, k, expansion of the node it is made in, path cost."""
        tables, z = self.tables, int(self.nodes["state"][0])
        # The robot may change the automaton's state on its path before the first attempt.
        for other in tables.travels_to[z]:
            expansion = int(self.nodes["expansion"][self.expansions["link"][0, other]])
            for s, subgoal in enumerate(tables.subgoals):
                for k, edge in enumerate(tables.edges[other]):
                    if np.isfinite(tables.travel[-1, z, s, other]):
                        action = subgoal * tables.rollouts.edge_count + edge
                        yield action, s, k, expansion, float(tables.travel[-1, z, s, other])

    def _fingerprint(self, rows: np.ndarray) -> np.ndarray:
        """Fingerprints of rows of knowledge: ``[..., S]`` to ``[...]``."""
        # The automaton's state is part of every row; a problem without subgoals has one node.
        prints = self._prints[np.arange(rows.shape[-1]), rows]
        return np.bitwise_xor.reduce(prints, axis=-1) if rows.shape[-1] else np.zeros(rows.shape[:-1], np.uint64)

    def _find_or_add(
        self, keys: np.ndarray, rows_of: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    ) -> np.ndarray:
        """Nodes of fingerprints; ``rows_of`` gives the rows and states of those that are new, by their positions."""
        # Many children of a batch are the same node; one of each kind is looked up.
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

    def _add(self, rows: np.ndarray, state: np.ndarray) -> None:
        """Append open nodes, with the bounds of the relaxation."""
        count, subgoals = rows.shape
        leave, attempt = np.empty((count, subgoals)), np.empty((count, subgoals))
        ceiling, may_be_dead = np.empty(count), np.empty(count, bool)
        for z in np.unique(state).tolist():
            own = np.flatnonzero(state == z)
            leave[own], attempt[own], may_be_dead[own] = self._relaxation.lower_bounds(z, rows[own])
            ceiling[own] = self._relaxation.upper_bound(z, rows[own])
        self.nodes.append(
            rows=rows,
            state=state,
            rank=self.tables.ranks(rows, state),
            expansion=np.full(count, NOWHERE),
            leave_lower=leave,
            attempt_lower=attempt,
            # Until a node is expanded nothing is known of a policy that leaves; one that makes an attempt costs the
            # ceiling at most.
            leave_upper=np.full((count, subgoals), np.inf),
            attempt_upper=np.where(np.isfinite(attempt), ceiling[:, None], np.inf),
            ceiling=ceiling,
            may_be_dead=may_be_dead,
        )

    def _expand_alike(self, z: int, nodes: np.ndarray) -> None:
        """Expand open nodes, all in state z of the automaton."""
        tables, rows = self.tables, self.nodes["rows"][nodes]
        count, subgoals = rows.shape
        success = np.full((count, subgoals, tables.most_edges), NOWHERE)
        failure = success.copy()
        link = np.full((count, tables.rollouts.states), NOWHERE)
        if z in tables.travels_to[z]:
            link[:, z] = nodes
        # Children are listed first and looked up all at once; each kind goes into a slice of one of the arrays above.
        kinds = list(self._after_attempts(z, rows, success, failure))
        kinds += [(self._after_path(rows, other), link[:, other]) for other in tables.travels_to[z] if other != z]
        for (children, into), found in zip(kinds, self._number([kind for kind, _ in kinds]), strict=True):
            into[children.index] = found
        self.nodes["expansion"][nodes] = self.expansions.count + np.arange(count)
        # The bounds now come from the children, which know their own dead ends.
        self.nodes["may_be_dead"][nodes] = False
        self.expansions.append(
            node=nodes,
            success=success,
            failure=failure,
            link=link,
            best_edge=np.zeros((count, subgoals)),
            best_path=np.zeros((count, subgoals, 2)),
        )

    def _after_attempts(
        self, z: int, rows: np.ndarray, success: np.ndarray, failure: np.ndarray
    ) -> Iterator[tuple["_Children", np.ndarray]]:
        """What attempts from state z can lead to, by edge and outcome, each with the slice that its nodes belong into.

        Success in an accepting state needs no node and is written at once.
        """
        tables, here = self.tables, np.arange(rows.shape[1])[None]
        # Once something is learnt, every subgoal's visits are forgotten: a rollout may come back with new knowledge.
        cleared = tables.row_without_visits[rows]
        for k in range(len(tables.edges[z])):
            available, certain = tables.available[here, rows, k], tables.certain[rows, k]
            target, succeeded = int(tables.target[z, k]), tables.row_after_success[rows, k]
            if tables.rollouts.accepting[target]:
                success[..., k] = np.where(available, ACCEPTED, NOWHERE)
            else:
                # What is certain teaches nothing, so visits stay; they are what keeps a rollout from going in circles.
                learnt, repeated = tables.row_in_state[cleared, target], tables.row_in_state[rows, target]
                yield self._attempts(available & ~certain, learnt, succeeded, target), success[..., k]
                yield self._attempts(available & certain, repeated, succeeded, target), success[..., k]
            fails = available & (tables.probability[here, rows, k] < 1.0)
            yield self._attempts(fails, cleared, tables.row_after_failure[rows, k], z), failure[..., k]

    def _attempts(self, made: np.ndarray, before: np.ndarray, own: np.ndarray, state: int) -> "_Children":
        """Children of the attempts ``made``, ``[N, S]``: rows as ``before``, the subgoal's ``own``, and this state."""
        here = np.arange(before.shape[1])[None]
        # One row is exchanged, so the fingerprint is that of all rows before, less the old one, with the new one.
        keys = self._fingerprint(before)[:, None] ^ self._prints[here, before] ^ self._prints[here, own]
        parent, subgoal = np.nonzero(made)
        return _Children(keys[parent, subgoal], state, before, parent, subgoal, own[parent, subgoal])

    def _after_path(self, rows: np.ndarray, state: int) -> "_Children":
        """What a path through known space leads to that ends in ``state``: nothing is learnt."""
        before = self.tables.row_in_state[rows, state]
        return _Children(self._fingerprint(before), state, before, np.arange(len(rows)), None, None)

    def _number(self, kinds: list["_Children"]) -> list[np.ndarray]:
        """The nodes of all children, in the order given; those that are new are added."""
        if not kinds:
            return []
        ends = np.cumsum([0, *(len(children.keys) for children in kinds)])

        def rows_of(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            rows = np.empty((len(positions), len(self.tables.subgoals)), np.int32)
            states = np.empty(len(positions), np.int32)
            for children, begin, end in zip(kinds, ends[:-1], ends[1:], strict=True):
                mine = np.flatnonzero((positions >= begin) & (positions < end))
                rows[mine] = children.rows(positions[mine] - begin)
                states[mine] = children.state
            return rows, states

        nodes = self._find_or_add(np.concatenate([children.keys for children in kinds]), rows_of)
        return np.split(nodes, ends[1:-1])


@dataclass(frozen=True)
class _Children:
    """Children of one kind: of attempts along one edge with one outcome, or of a path to one state.

    Their rows are not stored but can be made, since most children are nodes already.

    Attributes:
        keys: fingerprint of each child, ``[n]``.
        state: the automaton's state in all of them.
        before: rows of knowledge of all subgoals by parent, ``[N, S]``.
        parent: index of each child's parent, ``[n]``.
        subgoal, own: the subgoal of which something was learnt, and its new row, ``[n]``; None where nothing was.
    """

    keys: np.ndarray
    state: int
    before: np.ndarray
    parent: np.ndarray
    subgoal: np.ndarray | None
    own: np.ndarray | None

    @property
    def index(self) -> tuple[np.ndarray, ...]:
        """Where the children belong in an array over parents, or over parents and subgoals."""
        return (self.parent,) if self.subgoal is None else (self.parent, self.subgoal)

    def rows(self, chosen: np.ndarray) -> np.ndarray:
        """Rows of knowledge of the chosen children, ``[., S]``."""
        rows = self.before[self.parent[chosen]]
        if self.subgoal is not None and self.own is not None:
            rows[np.arange(len(chosen)), self.subgoal[chosen]] = self.own[chosen]
        return rows
