"""Irrevocable moves: which there are, by words, and that no policy makes one while another way is left."""

import dataclasses
from collections import deque
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval import trials
from eval.commits import CONFIG, POLICIES, SIZES, irrevocable_steps, pair, prior, report, run_chunk
from eval.formulas import random_tasks
from eval.limit.rows import append_row, read_rows
from potlp_jax.environments.firefighting import Firefighting
from potlp_jax.environments.toy import Toy
from potlp_jax.errors import TaskWarning
from potlp_jax.planning.policies import Policy, decide
from potlp_jax.planning.situation import assess
from potlp_jax.sweep.rows import source_commit
from potlp_jax.task import irrevocable
from potlp_jax.task.irrevocable import inclusion, irrevocable_moves
from potlp_jax.task.task import Task, TaskSizes
from potlp_jax.trials.batch import Start, run_batch
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.record import Outcome
from potlp_jax.types import NO_STATE
from potlp_jax.verify.audit import problems_of
from potlp_jax.world.grid import BeliefMap, make_world

TWO_BRANCHES = "(!b U (a & (!b U c))) | (!a U (b & (!a U d)))"
NAMES = ("a", "b", "c", "d")
A, B, C, D = 1, 2, 4, 8

RANDOM = random_tasks(12, ("a", "b"), TaskSizes(7, 2, 20, 20, 8, 4), seed=5)
BRANCHING = [TWO_BRANCHES, "(F a & !b U c) | (!a U b)", "a & X b", "F a & F b", "!a U b", "F(a & X(b | X b))"]
TASKS = [*RANDOM, *(Task.from_formula(text) for text in BRANCHING)]


def _witness(dfa, first, second):
    """A shortest word that leads from ``first`` to acceptance and not from ``second``; None if there is none."""
    came_from, queue = {(first, second): ()}, deque([(first, second)])
    while queue:
        one, other = queue.popleft()
        if dfa.accepting[one] and not dfa.accepting[other]:
            return came_from[one, other]
        for letter, after in enumerate(zip(*dfa.transitions[[one, other]].tolist(), strict=True)):
            if after not in came_from:
                came_from[after] = (*came_from[one, other], letter)
                queue.append(after)
    return None


def _accepts(dfa, state, word):
    for letter in word:
        state = int(dfa.transitions[state, letter])
    return bool(dfa.accepting[state])


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.text)
def test_inclusion_is_that_of_the_words(task):
    dfa = task.dfa
    included = inclusion(dfa.transitions, dfa.accepting)
    short = [word for length in range(4) for word in product(range(dfa.transitions.shape[1]), repeat=length)]
    short = short if len(short) < 5000 else short[::7]
    for first, second in product(range(dfa.num_states), repeat=2):
        witness = _witness(dfa, first, second)
        assert included[first, second] == (witness is None)
        if witness is not None:
            assert _accepts(dfa, first, witness)
            assert not _accepts(dfa, second, witness)
        else:
            assert all(_accepts(dfa, second, word) for word in short if _accepts(dfa, first, word))


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.text)
def test_a_move_is_irrevocable_if_stepping_back_loses_a_word(task):
    dfa = task.dfa
    found = irrevocable_moves(dfa)
    for state, entered in product(range(dfa.num_states), range(dfa.transitions.shape[1])):
        after = int(dfa.transitions[state, entered])
        # Letters of the cell that is left: those after which the automaton can be in this state.
        left = [letter for letter in range(dfa.transitions.shape[1]) if (dfa.transitions[:, letter] == state).any()]
        loses = any(_witness(dfa, state, int(dfa.transitions[after, letter])) is not None for letter in left)
        assert found[state, entered] == (loses and not dfa.trap[after])


def test_the_first_letter_of_either_branch_is_irrevocable():
    task = Task.from_formula(TWO_BRANCHES, NAMES)
    start = int(task.dfa.transitions[0, 0])
    # Both letters at once lead to a trap unless they end the task.
    assert [bool(task.irrevocable[start, letter]) for letter in (0, A, B, C, D, A | B)] == [
        False,
        True,
        True,
        False,
        False,
        False,
    ]


@pytest.mark.parametrize("text", ["!a U b", "F a & F b", "F(a & F b)", "F(a & (a U b))"])
def test_tasks_without_irrevocable_moves(text):
    assert not Task.from_formula(text).irrevocable.any()


def test_no_fire_fighting_task_has_an_irrevocable_move():
    family = Firefighting()
    for text in family.tasks.values():
        assert not Task.from_formula(text, family.propositions).irrevocable.any()


def test_padding_adds_no_irrevocable_move():
    task = Task.from_formula(TWO_BRANCHES, NAMES)
    sizes = task.sizes.union(TaskSizes(states=9, propositions=5, edges=1, classes=1, compound=0, cubes=1))
    padded = np.asarray(task.padded(sizes).irrevocable)
    states, letters = task.irrevocable.shape
    assert np.array_equal(padded[:states], np.tile(task.irrevocable, 2))
    assert padded.shape == (9, 2 * letters)
    assert not padded[states:].any()


def test_an_automaton_that_is_too_large_has_none_and_says_so(monkeypatch):
    task = Task.from_formula(TWO_BRANCHES, NAMES)
    monkeypatch.setattr(irrevocable, "MOST_COMPARISONS", 10)
    with pytest.warns(TaskWarning, match=f"an automaton of {task.dfa.num_states} states"):
        moves = irrevocable_moves(task.dfa)
    assert moves.shape == task.dfa.transitions.shape
    assert not moves.any()


# Trials


def _two_doors(near, far, beyond):
    """64 × 30 cells: a small room beside the near door, a passage from it to the far one, and a large room beyond."""
    occupied, letters = np.zeros((30, 64), bool), np.zeros((30, 64), np.int32)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    occupied[:, 10] = True
    # The robot's room is five rows high; its other way out is at the far end.
    occupied[1:13, 1:10] = occupied[18, 2:10] = True
    for row, letter in ((15, near), (26, far)):
        occupied[row, 10] = False
        letters[row, 10] = letter
    for cell, letter in beyond.items():
        letters[cell] = letter
    return make_world(occupied, letters, (15, 9), resolution=0.2, propositions=NAMES)


def _run(world, task, policy, last=True):
    decision = dataclasses.replace(CONFIG.decision, irrevocable_last=last)
    config = dataclasses.replace(CONFIG, decision=decision)
    estimator = prior if policy is Policy.POTLP else None
    return run_trial(world, task, policy, jax.random.key(0), config, arrays=task.padded(SIZES), estimator=estimator)


@pytest.mark.long
@pytest.mark.parametrize("policy", POLICIES)
def test_no_branch_is_entered_while_another_way_is_left(policy):
    # The near door begins the branch that needs c, which is nowhere; behind the other door the other branch ends.
    world, task = _two_doors(A, 0, {(20, 30): B, (20, 40): D}), Task.from_formula(TWO_BRANCHES, NAMES)
    known = _run(world, task, Policy.KNOWN_MAP)
    assert known.outcome is Outcome.SATISFIED
    trial = _run(world, task, policy)
    assert trial.outcome is Outcome.SATISFIED
    assert problems_of(trial, task, world) == []
    assert set(irrevocable_steps(trial, task)) == {"certain"}


@pytest.mark.parametrize("policy", [Policy.BASELINE, Policy.OPTIMISTIC])
def test_without_the_rule_the_near_door_is_the_end(policy):
    world, task = _two_doors(A, 0, {(20, 30): B, (20, 40): D}), Task.from_formula(TWO_BRANCHES, NAMES)
    trial = _run(world, task, policy, last=False)
    assert trial.outcome is Outcome.INFEASIBLE
    assert irrevocable_steps(trial, task)["free"] > 0


@pytest.mark.parametrize("policy", POLICIES)
def test_a_move_that_nothing_else_is_left_for_is_made(policy):
    # Both doors begin a branch: one of them must be entered, and the near one is right.
    world, task = _two_doors(A, B, {(20, 30): C}), Task.from_formula(TWO_BRANCHES, NAMES)
    trial = _run(world, task, policy)
    steps = irrevocable_steps(trial, task)
    assert steps["forced"] == 1
    assert steps["free"] == 0
    assert problems_of(trial, task, world) == []
    # Where the estimates know what lies behind, so does the policy; the nearest door is the right one here.
    if policy in (Policy.ORACLE, Policy.BASELINE):
        assert trial.outcome is Outcome.SATISFIED


def _on_the_revealed_map(task, world, last):
    belief, state = BeliefMap.revealed(world), task.arrays.transitions[0, 0]
    return assess(belief, world.start, state, task.arrays, CONFIG.decision.frontiers, last)


def test_a_known_path_to_acceptance_uses_irrevocable_moves():
    world, task = _two_doors(A, 0, {(20, 30): C}), Task.from_formula(TWO_BRANCHES, NAMES)
    held, free = (_on_the_revealed_map(task, world, last) for last in (True, False))
    assert float(held.finish_cost) == float(free.finish_cost) < np.inf
    assert np.array_equal(held.all_distances, free.distances)
    # In the door itself, and so in the state of the branch, the robot does not come otherwise.
    branch = int(task.dfa.transitions[int(held.state), A])
    assert np.isfinite(np.asarray(held.all_distances)[15, 10, branch])
    assert np.isinf(np.asarray(held.distances)[15, 10, branch])
    assert int(held.transitions[15, 10, int(held.state)]) == NO_STATE


def test_a_task_without_such_moves_is_decided_as_without_the_rule():
    world = Toy().generate(jax.random.key(3))
    task = world.task("!hazard U goal")
    decisions = []
    for last in (True, False):
        trial = _run_toy(world, task, last)
        decisions.append((trial.cost, trial.path, [(d.kind, d.target, d.value) for d in trial.decisions]))
    assert decisions[0] == decisions[1]


def _run_toy(world, task, last):
    decision = dataclasses.replace(CONFIG.decision, irrevocable_last=last)
    config = dataclasses.replace(CONFIG, decision=decision)
    return run_trial(world, task, Policy.POTLP, jax.random.key(0), config, estimator=prior)


@pytest.mark.long
@pytest.mark.parametrize("last", [True, False])
def test_a_batch_decides_as_trials_alone_do(last):
    config = dataclasses.replace(CONFIG, decision=dataclasses.replace(CONFIG.decision, irrevocable_last=last))
    pairs = {number: pair(number) for number in range(6)}
    # A task without irrevocable moves stands beside the others.
    pairs[6] = (Task.from_formula("F a & F b", NAMES), pairs[0][1])
    for policy in (Policy.BASELINE, Policy.OPTIMISTIC, Policy.POTLP):
        estimator = prior if policy is Policy.POTLP else None
        starts = [Start(w, t.padded(SIZES), jax.random.key(n), name=n) for n, (t, w) in pairs.items()]
        for finished in run_batch(starts, policy, config, slots=3, estimator=estimator):
            task, world = pairs[finished.name]
            key = jax.random.key(finished.name)
            alone = run_trial(world, task, policy, key, config, arrays=task.padded(SIZES), estimator=estimator)
            assert (finished.outcome, finished.path.tolist()) == (alone.outcome, [list(cell) for cell in alone.path])


@pytest.mark.parametrize(("last", "outcome"), [(True, Outcome.SATISFIED), (False, Outcome.INFEASIBLE)])
def test_a_batch_heeds_the_setting(last, outcome):
    config = dataclasses.replace(CONFIG, decision=dataclasses.replace(CONFIG.decision, irrevocable_last=last))
    world, task = _two_doors(A, 0, {(20, 30): B, (20, 40): D}), Task.from_formula(TWO_BRANCHES, NAMES)
    (finished,) = run_batch([Start(world, task.padded(SIZES), jax.random.key(0))], Policy.BASELINE, config, slots=1)
    assert finished.outcome is outcome


@pytest.mark.long
def test_random_pairs_end_satisfied_unless_a_move_was_forced():
    rows = list(run_chunk(0, 24))
    held = [row for row in rows if row["irrevocable_last"]]
    assert len(held) == 24 * len(POLICIES)
    for row in held:
        moves = row.get("moves", {})
        assert row["outcome"] == Outcome.SATISFIED or (moves.get("forced") and not moves.get("free")), row
    # The pairs are such that the rule matters.
    assert any(row["outcome"] == Outcome.INFEASIBLE for row in rows if not row["irrevocable_last"])
    # A file of rows may have been continued at another commit.
    others = [row | {"pair": 24 + row["pair"], "commit": "another"} for row in rows]
    found = report(rows + others)
    assert found["commits"] == sorted({source_commit(), "another"})
    assert found["pairs"] == 48


def test_under_vmap_each_map_has_its_own_moves():
    world = _two_doors(A, 0, {(20, 30): C})
    task, plain = (Task.from_formula(text, NAMES) for text in (TWO_BRANCHES, "F a"))
    sizes = task.sizes.union(plain.sizes)
    tasks = jax.tree.map(lambda *rows: jnp.stack(rows), task.padded(sizes), plain.padded(sizes))
    belief = BeliefMap.revealed(world)

    def move(task):
        state = task.transitions[task.initial, 0]
        return decide(
            belief, world.start, state, task, None, jax.random.key(0), policy=Policy.BASELINE, config=CONFIG.decision
        )

    both = jax.jit(jax.vmap(move))(tasks)
    for row, one in enumerate((task, plain)):
        alone = jax.jit(move)(one.padded(sizes))
        assert np.array_equal(both.path.cells[row], alone.path.cells)
        assert both.value[row] == alone.value


def test_what_a_kill_has_cut_off_is_run_again_as_a_whole(tmp_path):
    file = tmp_path / "commits.jsonl"
    append_row(file, [{"pair": 0}, {"pair": 1}])
    append_row(file, [{"pair": 2}, {"pair": 3}])
    whole = file.read_bytes()
    for size in range(len(whole)):
        file.write_bytes(whole[:size])
        assert len(read_rows(file)) % 2 == 0
    append_row(file, [{"pair": 2}])
    assert [row["pair"] for row in read_rows(file)][:3] == [0, 1, 2]
    # Rows of before stand on a line each.
    (tmp_path / "rooms.jsonl").write_text('{"number": 1}\n{"number": 2}\n')
    append_row(tmp_path / "rooms.jsonl", [{"number": 3}, {"number": 3}])
    assert [row["number"] for row in trials.rows_of(tmp_path, "rooms")] == [1, 2, 3, 3]
