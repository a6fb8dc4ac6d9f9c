"""Benchmark problems for planners: families of tasks on random maps, as many instances as wanted.

An instance is a map about 100 cells on a side, with the robot, S subgoals and sometimes a few labelled cells on it.
These locations are joined by paths of octile length times a random detour, closed under shortest paths, so travel is a
metric. Travel and finish costs are shortest paths in the product of the locations and the task's automaton: the path
between two locations reads empty letters, arriving reads the location's own letter, which is empty at most subgoals.
Estimates look like those of a trained estimator: a share of them, which differs from map to map, is confident, mostly
of failure.

Everything follows from (family, S, split, index); tuning and test instances are drawn from different seeds, and in
the random family from different tasks. All problems of one family and S have arrays of the same shapes.
"""

import dataclasses
import zlib
from collections.abc import Mapping
from functools import cache
from types import MappingProxyType
from typing import Any, Literal, get_args

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64, Int32

from potlp_jax.environments.firefighting import Firefighting
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.task.task import Task, TaskArrays, TaskSizes
from potlp_jax.world.moves import DIAGONAL

Split = Literal["tuning", "test"]

Chances = Literal["estimated", "rare", "extreme"]
"""How P_S is drawn: like a trained estimator's; from 0.005 to 0.08; 0.001 or 0.999."""

SUBGOAL_COUNTS: tuple[int, ...] = (1, 2, 4, 6, 8)
"""Numbers of subgoals that the benchmark reports."""

DEAD_END_COST: float = 500.0
"""Cost of a dead end unless the family says otherwise, in cells; the map's diagonal is 141."""

_SIDE = 100.0
"""Side of the map in cells."""
_LARGEST_DETOUR = 1.8
"""Length of a path, of that across an empty map, at most."""
_MOST_LABELLED = 2
"""Labelled cells of a problem that has any, at most."""
_FARTHEST_LABELLED = 100.0
"""How far off the other locations a labelled cell may lie: going there can be a bad choice."""

# Chances in the drawing of problems and estimates. Changing one changes every published figure of the benchmark.
_CHANCE_LABELLED_CELLS = 0.3
_CHANCE_LABELLED_SUBGOAL = 0.25
_CHANCE_OTHER_START = 0.2
_CHANCE_IMPOSSIBLE = 0.05
_MOST_CONFIDENT = 0.7
_CHANCE_CONFIDENT_SUCCESS = 0.15
_RARE = (0.005, 0.08)
_EXTREME = (0.001, 0.999)
_CLUSTER_RADIUS = 6.0
"""How far from the centre of its cluster a location lies, along either axis at most."""

# Transitions whose guard needs several cubes: b or c together with a, two of three, one without another.
_SEVERAL_CUBES = (
    "F(a & (b | c))",
    "F((a | b) & X(b | c))",
    "(!c U (a | b)) & F(b | (c & a))",
    "F(a | b) & F c",
    "F((a & b) | (b & c) | (a & c))",
    "F(a & !b & F(b | c))",
    "(!a U (b | c)) & F a",
)

# The text of a formula is what the golden problems are known by, so the brackets stay as the generator wrote them.
# Drawn at random, the first six of each number of states from 2 to 8 that ask the robot to look for something.
_RANDOM = (
    "F((((b) | (c))) & F(((b) M (b))))",
    "((F(a)) & (F((a) & F(c))))",
    "F((((a) U (c))) & F(((!a) U (a))))",
    "F(F((F((b) & F(a))) & F(F((b) & F(!b)))))",
    "((F((F(b)) & F(X(a)))) | (X(((a) & (!b)))))",
    "F((F((c) & F(!b))) & F(X(b)))",
    "((((c) M (!b))) U (X(a)))",
    "F(((a) M (b)))",
    "((F(a)) U (F((a) & F(b))))",
    "((F((b) & F(!c))) | (a))",
    "((X(a)) M (((b) U (!b))))",
    "F((F(c)) & F(F((a) & F(!a))))",
    "X(F((F((!a) & F(a))) & F(F((a) & F(!a)))))",
    "((((b) M (!a))) M (X(!c)))",
    "F(c)",
    "F((((!b) | (a))) & F(F((a) & F(!a))))",
    "F(F((((!a) U (b))) & F(X(b))))",
    "F(((X(!c)) M (((c) M (b)))))",
    "F(((F(a)) M (F((!c) & F(X(b))))))",
    "((((X(!b)) M (F(c)))) & (((!c) | (X(c)))))",
    "((((!c) M (b))) M (X(!a)))",
    "F(((a) M (a)))",
    "F(F((c) & F(a)))",
    "((((b) U (!a))) & (F((!a) & F(c))))",
    "((F(X(!b))) & (F(F(c))))",
    "((!c) & (((F((c) & F(b))) M (X(!a)))))",
    "F((F(F((c) & F(b)))) & F(X(((b) U (!b)))))",
    "((X(F(a))) M (((F((a) & F(c))) | (X(!b)))))",
    "F((((!a) & (b))) & F(F(!a)))",
    "F((((a) & (c))) & F(X(!b)))",
    "F((a) & F(((c) | (F((!b) & F(b))))))",
    "F((((b) M (!c))) & F(F((a) & F(!b))))",
    "((F((!c) & F(c))) U (a))",
    "F((X(F(!a))) & F(F(F((a) & F(b)))))",
    "X(F((X(!b)) & F(F((!a) & F(b)))))",
    "F(((b) M (((((c) M (b))) & (((a) U (c)))))))",
    "F((((!b) & (c))) & F(((b) U (!c))))",
    "F((F(b)) & F(!b))",
    "X(F((F(b)) & F(((!b) U (!c)))))",
    "((((X(!c)) M (F(a)))) U (a))",
    "((X(F(!c))) M (F((((a) | (a))) & F(c))))",
    "F(F((X(X(b))) & F(F(((a) U (c))))))",
)


@dataclasses.dataclass(frozen=True)
class Family:
    """Tasks that are benchmarked together.

    Attributes:
        name: key in ``FAMILIES``.
        formulas: the tasks. Instance ``index`` of a split has task ``index`` of the split's own, round robin; a family
            of one task uses it in both splits.
        propositions: Sigma of every task.
        sizes: array sizes of every task.
        max_positive_literals: as in ``Task.from_formula``.
        disjoint_tasks: whether every second task is kept for the test split.
        shares_conditions: whether edges that look for the same things have one condition, whatever the state: what
            fails in one state then fails in all.
        chances: how P_S is drawn.
        clustered: whether subgoals lie in two clusters.
        dead_end_cost: of every problem.
    """

    name: str
    formulas: tuple[str, ...]
    propositions: tuple[str, ...]
    sizes: TaskSizes
    max_positive_literals: int | None = None
    disjoint_tasks: bool = False
    shares_conditions: bool = False
    chances: Chances = "estimated"
    clustered: bool = False
    dead_end_cost: float = DEAD_END_COST

    def formula(self, split: Split, index: int) -> str:
        """The task of an instance."""
        # Every second formula belongs to the test split, so that both have automata of every size.
        own = self.formulas[get_args(Split).index(split) :: 2] if self.disjoint_tasks else self.formulas
        return own[index % len(own)]


_DEAR: float = 5000.0


def _shared(name: str, max_positive_literals: int | None, **options: Any) -> Family:
    """Three things in any order: 3 conditions on 12 edges, or 7 on 19 where several at one cell count as well."""
    count = 12 if max_positive_literals else 19
    sizes = TaskSizes(8, 3, count, count, 0, 1)
    formulas, propositions = ("F a & F b & F c",), ("a", "b", "c")
    return Family(name, formulas, propositions, sizes, max_positive_literals, shares_conditions=True, **options)


_FIREFIGHTING = Firefighting.tasks["1"]

# Sizes are (states, propositions, edges, classes, compound conditions, cubes): exact for families of one task, the
# largest of each for the others, so that one compiled program serves the whole family.
FAMILIES: Mapping[str, Family] = MappingProxyType(
    {
        family.name: family
        for family in (
            Family("find", ("F g",), ("g",), TaskSizes(2, 1, 1, 1, 0, 1)),
            # No cell holds two of the three things, so edges that would need one do not exist; in -joint they do.
            Family("three-single", ("F a & F b & F c",), ("a", "b", "c"), TaskSizes(8, 3, 12, 12, 0, 1), 1),
            Family("three-joint", ("F a & F b & F c",), ("a", "b", "c"), TaskSizes(8, 3, 19, 19, 0, 1)),
            Family("two", ("F a & F b",), ("a", "b"), TaskSizes(4, 2, 5, 5, 0, 1)),
            Family("firefighting", (_FIREFIGHTING,), Firefighting.propositions, TaskSizes(4, 4, 3, 5, 2, 2)),
            Family("reuse", ("F(a & F(b & F a))",), ("a", "b"), TaskSizes(4, 2, 5, 5, 0, 1)),
            Family("random", _RANDOM, ("a", "b", "c"), TaskSizes(8, 3, 9, 9, 1, 2), disjoint_tasks=True),
            Family("cubes", _SEVERAL_CUBES, ("a", "b", "c"), TaskSizes(4, 3, 5, 8, 3, 3)),
            _shared("shared", 1),
            _shared("shared-joint", None),
            _shared("shared-dear", 1, dead_end_cost=_DEAR),
            _shared("shared-rare", 1, chances="rare"),
            _shared("shared-extreme", 1, chances="extreme"),
            Family(
                "rare",
                ("F(a & F(b & F a))",),
                ("a", "b"),
                TaskSizes(4, 2, 5, 5, 0, 1),
                chances="rare",
                dead_end_cost=_DEAR,
            ),
            Family("extreme", ("F a & F b",), ("a", "b"), TaskSizes(4, 2, 5, 5, 0, 1), chances="extreme"),
            Family("cheap", ("F a & F b",), ("a", "b"), TaskSizes(4, 2, 5, 5, 0, 1), dead_end_cost=50.0),
            Family("dear", ("F a & F b",), ("a", "b"), TaskSizes(4, 2, 5, 5, 0, 1), dead_end_cost=_DEAR),
            Family("clustered", ("F a & F b",), ("a", "b"), TaskSizes(4, 2, 5, 5, 0, 1), clustered=True),
            Family("four", ("F a & F b & F c & F d",), ("a", "b", "c", "d"), TaskSizes(16, 4, 32, 32, 0, 1), 1),
        )
    }
)
"""The benchmark families by name.

* find, two, three-single, three-joint: look for one, two, three things; -joint: two or three at one cell count as well
* firefighting: task 1 of the fire-fighting building (Bradley et al. 2021, section V-A)
* reuse: what was found once is needed again
* random: co-safe formulas whose automata have 2 to 8 states
* cubes: transitions that have several cubes
* shared, shared-joint: as three-single and three-joint, but what fails in one state of the automaton fails in all;
  -dear with a dead end of 5000, -rare and -extreme with such chances
* rare: as reuse, with small chances and a dead end of 5000
* extreme, cheap, dear, clustered: as two, with extreme chances, dead ends of 50 and 5000, subgoals in two clusters
* four: look for four things
"""


def family_problem(family: str, subgoals: int, split: Split, index: int) -> PlanningProblem:
    """One benchmark instance, unbatched and checked; equal arguments give equal problems.

    Args:
        family: a key of ``FAMILIES``.
        subgoals: S, at least 1.
        split: "tuning" or "test".
        index: number of the instance, from 0.

    Returns:
        The problem; every problem of the family and S has its shapes.

    Raises:
        ValueError: no such family or split, no subgoal, or a negative index.
    """
    if family not in FAMILIES:
        raise ValueError(f"there is no family {family!r}; there are: {', '.join(FAMILIES)}")
    if split not in get_args(Split):
        raise ValueError(f"there is no split {split!r}; there are: {', '.join(get_args(Split))}")
    if subgoals < 1 or index < 0:
        raise ValueError(f"subgoals is {subgoals} and index {index}: they must be at least 1 and 0")
    spec = FAMILIES[family]
    task, arrays = _compile(spec, spec.formula(split, index))
    # A checksum and not ``hash``, which differs from process to process.
    rng = np.random.default_rng([zlib.crc32(f"{family}/{split}".encode()), subgoals, index])
    # The order of drawing is part of the definition: geometry, estimates, start.
    problem = PlanningProblem.from_arrays(
        arrays,
        **_geometry(task, spec, subgoals, rng),
        **_estimates(task, spec, arrays, subgoals, rng),
        dfa_state=_start_state(task, rng),
        subgoal_mask=np.ones(subgoals, bool),
        dead_end_cost=spec.dead_end_cost,
    )
    problem.check()
    return problem


def random_metric(locations: int, rng: np.random.Generator, clustered: bool = False) -> Float64[np.ndarray, "N N"]:
    """Shortest paths between random locations on the map: symmetric, 0 on the diagonal only, triangle inequality.

    Args:
        locations: N.
        rng: where they are drawn from.
        clustered: whether the locations lie in two clusters.

    Returns:
        Path costs.
    """
    points = rng.uniform(0.0, _SIDE, (locations, 2))
    if clustered:
        offsets = rng.uniform(-_CLUSTER_RADIUS, _CLUSTER_RADIUS, (locations, 2))
        points = rng.uniform(0.0, _SIDE, (2, 2))[np.arange(locations) % 2] + offsets
    offset = np.abs(points[:, None] - points[None])
    octile = offset.max(axis=-1) + (DIAGONAL - 1.0) * offset.min(axis=-1)
    # One detour for both directions; the shortest paths through other locations restore the triangle inequality.
    detour = np.triu(rng.uniform(1.0, _LARGEST_DETOUR, octile.shape), 1)
    return _shortest(np.maximum(octile, 1.0) * (detour + detour.T))


@cache
def _compile(family: Family, formula: str) -> tuple[Task, TaskArrays]:
    """A family's task and its padded arrays: compiled once, since Spot takes longer than drawing a problem."""
    task = Task.from_formula(formula, family.propositions, family.max_positive_literals)
    arrays = task.padded(family.sizes)
    return task, _with_shared_conditions(arrays) if family.shares_conditions else arrays


def _with_shared_conditions(arrays: TaskArrays) -> TaskArrays:
    """With the first class that needs the same things in place of every class; all have one cube.

    What needs more things implies what needs fewer.
    """
    needs = np.asarray(arrays.class_phi)[:, 1] > 0
    first = np.array([np.flatnonzero((needs == own).all(axis=1))[0] for own in needs])
    kept = np.arange(len(first)) == first
    implies = (needs[:, None] >= needs[None]).all(axis=2) & kept[:, None] & kept[None]
    return dataclasses.replace(
        arrays,
        edge_condition=jnp.asarray(first[np.asarray(arrays.edge_condition)], jnp.int32),
        class_mask=jnp.asarray(kept),
        condition_mask=jnp.asarray(kept),
        implies=jnp.asarray(implies),
    )


def _start_state(task: Task, rng: np.random.Generator) -> int:
    """The automaton's state after empty letters; now and then another one from which something can be tried."""
    first = int(_after_empty_letters(task)[task.dfa.initial])
    others = np.setdiff1d(task.edges[:, 0], [first])
    return int(rng.choice(others)) if rng.random() < _CHANCE_OTHER_START and len(others) else first


def _after_empty_letters(task: Task) -> Int32[np.ndarray, " Z"]:
    """State after as many empty letters as there are states: a path through free space is longer than that."""
    # Without cycles under the empty letter (as for F, U and X) the state has come to rest by then.
    state = np.arange(task.dfa.num_states, dtype=np.int32)
    for _ in range(task.dfa.num_states):
        state = task.dfa.transitions[state, 0]
    return state


def _geometry(task: Task, family: Family, subgoals: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """``travel`` and ``finish``: shortest paths in the product of locations and automaton.

    Locations are subgoals, robot, labelled cells, in this order. Labelled cells lie off the map's middle, each at the
    end of a path of its own.
    """
    dfa, states, robot, sizes = task.dfa, task.dfa.num_states, subgoals, family.sizes
    labelled = int(rng.integers(1, _MOST_LABELLED + 1)) if rng.random() < _CHANCE_LABELLED_CELLS else 0
    path_cost = random_metric(subgoals + 1 + labelled, rng, family.clustered)
    aside = np.concatenate([np.zeros(subgoals + 1), rng.uniform(0.0, _FARTHEST_LABELLED, labelled)])
    path_cost = np.where(np.eye(len(path_cost), dtype=bool), 0.0, path_cost + aside[:, None] + aside[None, :])
    letters = _location_letters(task, subgoals, labelled, rng)
    # Arriving reads the empty letters of the path, then the location's own.
    arrive = dfa.transitions[_after_empty_letters(task)][:, letters].T
    cost = _shortest(_product_moves(path_cost, arrive, dfa.trap))

    # A path from beyond a subgoal re-enters the subgoal's cell and reads its letter (docs/model.md section 5); one from
    # the robot's cell does not, its letter has been read.
    entered = dfa.transitions[:, letters].T
    start = np.where(np.arange(len(path_cost))[:, None] == robot, np.arange(states)[None, :], entered)[: subgoals + 1]
    begins = cost.reshape(len(path_cost), states, len(path_cost), states)[np.arange(subgoals + 1)[:, None], start]
    # Entering the cell again may itself violate the task: then nothing can be reached from there.
    begins[dfa.trap[start]] = np.inf
    travel = np.full((subgoals + 1, sizes.states, subgoals, sizes.states), np.inf)
    travel[:, :states, :, :states] = begins[:, :, :subgoals]
    finish = np.full((subgoals + 1, sizes.states), np.inf)
    finish[:, :states] = np.where(dfa.accepting, begins, np.inf).min(axis=(2, 3))
    return {"travel": travel, "finish": finish}


def _location_letters(task: Task, subgoals: int, labels: int, rng: np.random.Generator) -> Int32[np.ndarray, " N"]:
    """One proposition at each labelled cell; in every fourth problem one at a subgoal, unless that alone satisfies
    the task."""
    letters = 1 << rng.integers(0, len(task.propositions), subgoals + 1 + labels, dtype=np.int32)
    chosen = int(rng.integers(0, subgoals)) if rng.random() < _CHANCE_LABELLED_SUBGOAL else subgoals
    # A subgoal that satisfies the task where it stands would leave nothing to plan.
    satisfies = task.dfa.accepting[task.dfa.transitions[:, letters[chosen]]] & ~task.dfa.accepting
    # Location ``subgoals`` is the robot's; chosen, it stands for no labelled subgoal.
    location = np.arange(len(letters))
    labelled = (location > subgoals) | ((location == chosen) & (chosen < subgoals) & ~satisfies.any())
    return np.where(labelled, letters, 0).astype(np.int32)


def _product_moves(
    path_cost: Float64[np.ndarray, "N N"], arrive: Int32[np.ndarray, "N Z"], trap: np.ndarray
) -> Float64[np.ndarray, "NZ NZ"]:
    """Cost of going straight from one (location, state) to another; ``arrive[v, z]`` is the state in which v is reached
    from state z. No path leads into a trap."""
    locations, states = arrive.shape
    moves = np.full((locations, states, locations, states), np.inf)
    for to, state in np.ndindex(locations, states):
        if not trap[state] and not trap[arrive[to, state]]:
            moves[:, state, to, arrive[to, state]] = np.where(np.arange(locations) == to, np.inf, path_cost[:, to])
    return moves.reshape(locations * states, locations * states)


def _shortest(cost: Float64[np.ndarray, "N N"]) -> Float64[np.ndarray, "N N"]:
    """All shortest paths (Floyd and Warshall), staying where one is included."""
    cost = np.where(np.eye(len(cost), dtype=bool), 0.0, cost)
    for via in range(len(cost)):
        cost = np.minimum(cost, cost[:, [via]] + cost[[via], :])
    return cost


def _estimates(
    task: Task, family: Family, arrays: TaskArrays, subgoals: int, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """P_S, R_S and R_F. What implies more is less likely and lies farther away."""
    shape = (subgoals, task.sizes.classes)
    confident = rng.random(shape) < rng.uniform(0.0, _MOST_CONFIDENT)
    # A confident estimate says failure far more often than success: most frontiers hide nothing.
    extreme = np.where(
        rng.random(shape) < _CHANCE_CONFIDENT_SUCCESS, rng.uniform(0.9, 0.995, shape), rng.uniform(0.005, 0.1, shape)
    )
    probability = np.where(confident, extreme, rng.uniform(0.05, 0.75, shape))
    if family.chances == "rare":
        probability = rng.uniform(*_RARE, shape)
    elif family.chances == "extreme":
        probability = rng.choice(_EXTREME, shape)
    probability[rng.random(shape) < _CHANCE_IMPOSSIBLE] = 0.0
    success = rng.uniform(3.0, 60.0, shape)
    failure = rng.uniform(5.0, 80.0, shape)
    # A condition that implies others holds no more often than they do, and is not met before them; independent draws
    # would contradict each other, and with them the closure of what a rollout knows.
    implies = np.asarray(arrays.implies)[: shape[1], : shape[1]] | np.eye(shape[1], dtype=bool)
    probability = np.where(implies, probability[:, None, :], np.inf).min(axis=2)
    success = np.where(implies, success[:, None, :], 0.0).max(axis=2)
    return {
        name: np.pad(values, [(0, 0), (0, family.sizes.classes - shape[1])], constant_values=fill)
        for name, values, fill in (
            ("success_probability", probability, 0.0),
            ("success_cost", success, 1.0),
            ("failure_cost", failure, 0.0),
        )
    }
