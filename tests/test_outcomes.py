"""Cubes, conditions, outcome classes and implications, against definitions tried out exhaustively."""

import itertools
import json
import time

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from potlp_jax.errors import TaskError
from potlp_jax.task.automaton import canonical_dfa
from potlp_jax.task.guards import MAX_PRIMES_EXACT, cube_letters, hull, minimal_cover, prime_implicants
from potlp_jax.task.outcomes import find_outcomes
from potlp_jax.task.task import Task
from tests.reference import covers
from tests.reference.make_golden_covers import GOLDEN_COVERS


def guard_of(letters, n: int) -> np.ndarray:
    guard = np.zeros(2**n, dtype=bool)
    guard[list(letters)] = True
    return guard


def union(cubes, n: int) -> np.ndarray:
    return np.any([np.zeros(2**n, dtype=bool), *map(cube_letters, cubes)], axis=0)


def guards(n: int):
    return st.sets(st.integers(0, 2**n - 1)).map(lambda letters: (frozenset(letters), n))


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 3).flatmap(guards))
@example((frozenset(), 0))
@example((frozenset({0}), 0))
@example((frozenset({1, 2, 3, 4, 5, 6}), 3))  # a cycle of six primes with two covers of three
def test_primes_and_canonical_cover_by_definition(case):
    letters, n = case
    guard = guard_of(letters, n)
    assert prime_implicants(guard) == covers.prime_implicants(letters, n)
    assert minimal_cover(guard) == covers.canonical_cover(letters, n)


@settings(max_examples=25, deadline=None)
@given(guards(4))
def test_primes_and_canonical_cover_of_four_propositions(case):
    letters, n = case
    guard = guard_of(letters, n)
    assert prime_implicants(guard) == covers.prime_implicants(letters, n)
    assert minimal_cover(guard) == covers.canonical_cover(letters, n)


@settings(max_examples=30, deadline=None)
@given(st.sets(st.integers(0, 63)))
def test_covers_of_six_propositions_are_exact_and_made_of_primes(letters):
    guard = guard_of(letters, 6)
    cover = minimal_cover(guard)
    assert set(cover) <= set(prime_implicants(guard))
    assert (union(cover, 6) == guard).all()
    for left_out in cover:
        assert (union([cube for cube in cover if cube != left_out], 6) != guard).any(), "no cube is superfluous"


def test_cyclic_core_has_one_canonical_cover():
    """Six primes in a cycle, none essential, two covers of three cubes: the lexicographically first is taken."""
    cycle = [1, 2, 3, 4, 5, 6]
    guard = guard_of([*cycle, *(8 + letter for letter in cycle)], 5)
    cover = minimal_cover(guard)
    assert cover == ((-1, 0, 1, 0, -1), (0, 1, -1, 0, -1), (1, -1, 0, 0, -1))
    assert (union(cover, 5) == guard).all()


def test_greedy_cover_above_the_limit():
    """The most uncovered letters first, then phi: recomputed from scratch at every step."""
    rng = np.random.default_rng(3)
    guard = rng.random(2**8) < 0.55
    primes = prime_implicants(guard)
    assert len(primes) > MAX_PRIMES_EXACT
    uncovered, chosen = guard.copy(), []
    while uncovered.any():
        best = max(primes, key=lambda phi: (int((uncovered & cube_letters(phi)).sum()), [-sign for sign in phi]))
        chosen.append(best)
        uncovered &= ~cube_letters(best)
    assert minimal_cover(guard) == tuple(sorted(chosen))


def test_cube_letters_and_hull():
    assert np.flatnonzero(cube_letters((1, 0, -1))).tolist() == [1, 3]
    assert hull(guard_of([1, 3], 3)) == (1, 0, -1)
    assert hull(guard_of([1, 2], 2)) == (0, 0)
    assert hull(guard_of([5], 3)) == (1, -1, 1)


def test_golden_covers_of_the_firefighting_tasks():
    """The golden file comes from the slow reference (tests/reference/make_golden_covers.py)."""
    golden = json.loads(GOLDEN_COVERS.read_text())
    assert sorted(golden) == [f"firefighting-{number}" for number in range(1, 5)]
    for name, transitions in golden.items():
        table = Task.shipped(name).dfa.transitions
        found = {
            f"{source}->{target}": [list(phi) for phi in minimal_cover(row == target)]
            for source, row in enumerate(table)
            for target in np.unique(row)
        }
        assert found == transitions


def edges_by_definition(dfa) -> list[tuple[int, int]]:
    table = dfa.transitions.tolist()
    return [
        (z, target)
        for z, row in enumerate(table)
        if not dfa.accepting[z] and z in row
        for target in sorted(set(row))
        if target != z and not dfa.trap[target]
    ]


def check_outcomes(task: Task) -> None:
    """Edges, guards, classes and their order, from the definitions."""
    outcomes, dfa, n = task.outcomes, task.dfa, len(task.propositions)
    assert [tuple(edge) for edge in outcomes.edges.tolist()] == edges_by_definition(dfa)
    keys = []
    for c, (phi_stay, phi_cube) in enumerate(outcomes.classes):
        condition = outcomes.conditions[c]
        assert condition.classes == (c,)
        assert (condition.go == cube_letters(phi_cube)).all()
        assert phi_stay == hull(condition.stay)
        assert outcomes.stay_is_exact[c] == (cube_letters(phi_stay) == condition.stay).all()
        keys.append((phi_stay, phi_cube, tuple(condition.stay.tolist())))
    assert keys == sorted(set(keys))
    pairs = [(condition.stay.tobytes(), condition.go.tobytes()) for condition in outcomes.conditions]
    assert len(set(pairs)) == len(pairs), "conditions are distinct"
    used = set()
    for (z, target), index in zip(outcomes.edges, outcomes.edge_condition, strict=True):
        condition = outcomes.conditions[index]
        assert (condition.stay == (dfa.transitions[z] == z)).all()
        assert (condition.go == (dfa.transitions[z] == target)).all(), "cubes cover exactly the guard"
        cover = minimal_cover(dfa.transitions[z] == target)
        assert tuple(outcomes.classes[c].phi_cube for c in condition.classes) == cover
        assert (union(cover, n) == condition.go).all()
        used |= {int(index), *condition.classes}
    assert used == set(range(len(outcomes.conditions))), "every class and condition belongs to an edge"
    compound = outcomes.edge_condition[outcomes.edge_condition >= len(outcomes.classes)].tolist()
    assert list(dict.fromkeys(compound)) == sorted(set(compound)), "numbered by first edge"
    assert all(len(condition.classes) > 1 for condition in outcomes.conditions[len(outcomes.classes) :])


def test_outcomes_of_all_reference_automata(external_data):
    for entry in json.loads((external_data / "reference" / "spot_dfas.json").read_text()):
        accepting = np.isin(np.arange(entry["num_states"]), entry["accepting"])
        dfa = canonical_dfa(np.array(entry["delta"]), accepting, entry["init"])
        check_outcomes(
            Task(text=entry["formula"], propositions=tuple(entry["ap"]), dfa=dfa, outcomes=find_outcomes(dfa))
        )


def test_outcomes_of_firefighting_1():
    """By hand: 0 -> 2 by the alarm or by fire and extinguisher at one cell, 0 -> 3 by the extinguisher, 3 -> 2."""
    task = Task.shipped("firefighting-1")
    check_outcomes(task)
    assert task.edges.tolist() == [[0, 2], [0, 3], [3, 2]]
    seek, carry = (-1, -1, -1, 0), (-1, -1, 0, 0)
    assert task.classes == (
        (seek, (-1, -1, 1, 0)),
        (seek, (0, 1, 0, 0)),
        (seek, (1, 0, 1, 0)),
        (carry, (0, 1, 0, 0)),
        (carry, (1, 0, 0, 0)),
    )
    assert task.outcomes.edge_condition.tolist() == [5, 0, 6]
    assert [condition.classes for condition in task.conditions[5:]] == [(1, 2), (3, 4)]
    assert task.outcomes.stay_is_exact.all()
    implied = [(a, b) for a, b in itertools.product(range(7), repeat=2) if a != b and task.outcomes.implies[a, b]]
    assert implied == [(1, 3), (1, 5), (1, 6), (2, 4), (2, 5), (2, 6), (3, 6), (4, 6), (5, 6)]


def test_staying_letters_that_are_no_cube_are_flagged():
    task = Task.from_formula("(a | b) U c")
    assert task.classes == (((0, 0, -1), (0, 0, 1)),)
    assert task.outcomes.stay_is_exact.tolist() == [False]
    assert np.flatnonzero(task.conditions[0].stay).tolist() == [1, 2, 3]


def test_equal_hulls_of_different_staying_letters_are_different_classes():
    """State 0 stays on 0 and 3, state 1 on 1 and 2 (and then may not read 0 or 3); 4 to 7 are accepted."""
    table = np.array([[0, 1, 1, 0, 2, 2, 2, 2], [3, 1, 1, 3, 2, 2, 2, 2], [2] * 8, [3] * 8])
    dfa = canonical_dfa(table, np.array([False, False, True, False]), 0)
    assert dfa.transitions.tolist() == table.tolist()
    outcomes = find_outcomes(dfa)
    either = (0, 0, -1)
    assert outcomes.classes == (
        (either, (-1, 1, -1)),
        (either, (0, 0, 1)),
        (either, (0, 0, 1)),
        (either, (1, -1, -1)),
    )
    assert [np.flatnonzero(condition.stay).tolist() for condition in outcomes.conditions[1:3]] == [[1, 2], [0, 3]]
    assert not outcomes.stay_is_exact.any()
    assert outcomes.edges.tolist() == [[0, 1], [0, 2], [1, 2]]
    assert outcomes.edge_condition.tolist() == [4, 2, 1]


def holds_on_line(condition, word) -> bool:
    """The condition in a world whose unknown part is a corridor of cells with these letters."""
    for letter in word:
        if condition.go[letter]:
            return True
        if not condition.stay[letter]:
            return False
    return False


def holds_in_graph(condition, letters, neighbours) -> bool:
    """The condition in a world of cells: a way from node 0 (the subgoal) over staying letters to a go letter."""
    seen, waiting = set(), list(neighbours[0])
    while waiting:
        cell = waiting.pop()
        if condition.go[letters[cell]]:
            return True
        if cell not in seen and condition.stay[letters[cell]]:
            seen.add(cell)
            waiting += neighbours[cell]
    return False


IMPLICATION_FORMULAS = [
    "(!a U b) | ((!a U c) & F a)",
    "F(a & F(b & F a))",
    "(a | b) U (c & F(a | b & c))",
    "F a & F b & F c",
    "!a U (b | c) & F(a & b)",
    "(a U b) & F(c & X(a U c))",
]


@pytest.mark.parametrize("formula", IMPLICATION_FORMULAS)
def test_implications_are_sound_and_complete_on_corridors(formula):
    """a implies b exactly if b holds in every corridor of at most two cells where a holds (longer ones add nothing)."""
    task = Task.from_formula(formula, ("a", "b", "c"))
    words = [word for length in (1, 2) for word in itertools.product(range(8), repeat=length)]
    verdicts = np.array([[holds_on_line(condition, word) for word in words] for condition in task.conditions])
    expected = np.array([[bool((~first | second).all()) for second in verdicts] for first in verdicts])
    assert np.array_equal(task.outcomes.implies, expected)
    assert expected.sum() > len(expected), "the formula has implications to find"


@settings(max_examples=60, deadline=None)
@given(states=st.integers(3, 5), propositions=st.integers(1, 3), seed=st.integers(0, 10**6))
def test_each_cube_of_a_condition_implies_it(states, propositions, seed):
    """What a rollout knows relies on it: where a condition fails, so do all of its cubes."""
    transitions = np.random.default_rng(seed).integers(0, states, (states, 2**propositions))
    transitions[0] = 0
    dfa = canonical_dfa(transitions, np.arange(states) == 0, states - 1)
    assume(not dfa.trap[dfa.initial])
    outcomes = find_outcomes(dfa)
    for m, condition in enumerate(outcomes.conditions):
        assert outcomes.implies[list(condition.classes), m].all()


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_implications_are_sound_in_random_worlds(data):
    name = data.draw(st.sampled_from([f"firefighting-{number}" for number in range(1, 5)]))
    task = Task.shipped(name)
    size = data.draw(st.integers(2, 7))
    letters = data.draw(st.lists(st.integers(0, 15), min_size=size, max_size=size))
    node = st.integers(1, size - 1)
    neighbours = [data.draw(st.lists(node, max_size=3)) for _ in range(size)]
    holds = [holds_in_graph(condition, letters, neighbours) for condition in task.conditions]
    for a, b in np.argwhere(task.outcomes.implies):
        assert holds[b] or not holds[a]
    for condition, verdict in zip(task.conditions, holds, strict=True):
        assert verdict == any(holds[c] for c in condition.classes), "a condition holds iff one of its cubes does"


def test_max_positive_literals_drops_cubes():
    task = Task.shipped("firefighting-1")
    limited = find_outcomes(task.dfa, 1)
    assert len(limited.classes) == 4, "fire and extinguisher at one cell is out"
    assert limited.edges.tolist() == task.edges.tolist()
    alarm_only = limited.conditions[limited.edge_condition[0]]
    assert (alarm_only.go == cube_letters((0, 1, 0, 0))).all(), "go is what the kept cubes cover"
    assert len(limited.conditions) == len(limited.classes) + 1, "one cube is left: the condition is its class"
    assert [len(find_outcomes(task.dfa, limit).classes) for limit in (2, None)] == [5, 5]


def test_max_positive_literals_drops_edges():
    task = Task.from_formula("F(a & b) | F c | F(a & F b)", max_positive_literals=1)
    free = Task.from_formula("F(a & b) | F c | F(a & F b)")
    assert {tuple(edge) for edge in task.edges.tolist()} <= {tuple(edge) for edge in free.edges.tolist()}
    for limit in (None, 1):
        assert Task.from_formula("F a & F b", max_positive_literals=limit).edges.tolist() == (
            [[0, 1], [0, 2], [0, 3], [1, 3], [2, 3]] if limit is None else [[0, 1], [0, 2], [1, 3], [2, 3]]
        )


@pytest.mark.parametrize(("formula", "limit"), [("F(a & b)", 1), ("F a", 0), ("a U (b & Fa & c)", 1), ("X(a & b)", 1)])
def test_max_positive_literals_may_not_cut_off_acceptance(formula, limit):
    with pytest.raises(TaskError, match=f"unreachable with max_positive_literals={limit}"):
        Task.from_formula(formula, max_positive_literals=limit)
    Task.from_formula(formula, max_positive_literals=3)


def test_max_positive_literals_judges_states_that_nothing_stays_in():
    """X leaves no staying letter, hence no edges; acceptance is in reach all the same."""
    task = Task.from_formula("X(a & X b)", max_positive_literals=1)
    assert task.edges.shape == (0, 2)
    with pytest.raises(TaskError, match="at least 0"):
        Task.from_formula("F a", max_positive_literals=-1)


def test_too_many_classes():
    with pytest.raises(TaskError, match="more than 724 outcome classes"):
        find_outcomes(_parity_dfa(14))


def _parity_dfa(n: int):
    odd = np.array([letter.bit_count() % 2 for letter in range(2**n)])
    return canonical_dfa(np.stack([odd, np.ones_like(odd)]), np.array([False, True]), 0)


@pytest.mark.parametrize(
    ("formula", "classes"),
    [
        ("F(" + " | ".join(f"p{i}" for i in range(16)) + ")", 16),
        ("F(" + " | ".join(f"(p{i} & !p{i + 1} & p{i + 8})" for i in range(8)) + ")", 8),
        ("!p0 U (p15 & F p7)", 3),
    ],
)
def test_sixteen_propositions_are_fast(formula, classes):
    """Effort follows the guards' structure; a table over 3 ** 16 cubes would take minutes."""
    names = tuple(f"p{i}" for i in range(16))
    before = time.process_time()
    task = Task.from_formula(formula, names)
    assert task.dfa.transitions.shape[1] == 2**16
    assert len(task.classes) == classes
    assert time.process_time() - before < 20
