"""Tasks: shipped files, device arrays, padding, stacking, description."""

import json
from dataclasses import astuple, fields, replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from potlp_jax.errors import PropositionsError, TaskError
from potlp_jax.task.shipped import shipped_hoa, shipped_tasks
from potlp_jax.task.task import UNNAMED, Task, TaskSizes, stack_tasks
from potlp_jax.types import NO_CLASS
from train.write_shipped_tasks import shipped_texts

FIREFIGHTING = [f"firefighting-{number}" for number in range(1, 5)]
TASKS = [
    *(Task.shipped(name) for name in shipped_tasks()),
    Task.from_formula("F(a & F(b & F a))"),
    Task.from_formula("(a | b) U (c & F(a | b & c))"),
    Task.from_formula("1"),
    Task.from_formula("a & X b"),
]


def host(arrays) -> SimpleNamespace:
    """The fields as NumPy arrays."""
    return SimpleNamespace(**{field.name: np.asarray(getattr(arrays, field.name)) for field in fields(arrays)})


def test_shipped_tasks_are_what_their_formulas_say():
    assert dict(shipped_hoa()) == dict(sorted(shipped_texts().items())), "run train/write_shipped_tasks.py"
    for name, formula in shipped_tasks().items():
        shipped = Task.shipped(name)
        fresh = Task.from_formula(formula, shipped.propositions)
        assert shipped.text == formula
        for field in ("transitions", "accepting", "trap"):
            assert np.array_equal(getattr(shipped.dfa, field), getattr(fresh.dfa, field)), (name, field)
        assert shipped.classes == fresh.classes


def test_shipped_firefighting_tasks_share_the_papers_propositions():
    for name in FIREFIGHTING:
        assert Task.shipped(name).propositions == ("fire", "alarm", "extinguisher", "exit")


def test_shipped_task_that_does_not_exist():
    with pytest.raises(TaskError, match=r"no shipped task 'x'; there are: campus-large-1, .*, toy-2"):
        Task.shipped("x")


def test_from_hoa_propositions():
    text = Task.shipped("toy-2").to_hoa()
    assert Task.from_hoa(text).propositions == ("goal", "hazard")
    wide = Task.from_hoa(text, ("x", "hazard", "goal"))
    assert wide.dfa.transitions.shape == (3, 8)
    assert wide.classes == (((0, -1, -1), (0, 0, 1)),)
    with pytest.raises(TaskError, match="unknown proposition 'goal'; known: hazard"):
        Task.from_hoa(text, ("hazard",))
    nameless = "\n".join(line for line in text.splitlines() if not line.startswith("name:"))
    assert Task.from_hoa(nameless).text == UNNAMED


def test_arrays_say_what_the_task_says():
    for task in TASKS:
        arrays, outcomes = host(task.arrays), task.outcomes
        assert np.array_equal(arrays.transitions, task.dfa.transitions)
        assert np.array_equal(arrays.accepting, task.dfa.accepting)
        assert np.array_equal(arrays.trap, task.dfa.trap)
        assert int(arrays.initial) == task.dfa.initial
        edges, conditions = len(task.edges), len(task.conditions)
        assert np.array_equal(arrays.edges[:edges], task.edges)
        assert np.array_equal(arrays.edge_condition[:edges], outcomes.edge_condition)
        assert np.array_equal(arrays.implies[:conditions, :conditions], outcomes.implies)
        # A row of padding stands where there is no edge, or no class.
        for mask, count in (
            (arrays.state_mask, task.dfa.num_states),
            (arrays.edge_mask, edges),
            (arrays.class_mask, len(task.classes)),
            (arrays.condition_mask, conditions),
        ):
            assert mask.tolist() == ([True] * count or [False])
        for c, (phi_stay, phi_cube) in enumerate(task.classes):
            assert tuple(arrays.class_phi[c, 0].tolist()) == phi_stay
            assert tuple(arrays.class_phi[c, 1].tolist()) == phi_cube
            assert np.array_equal(arrays.class_stay[c], task.conditions[c].stay)
            assert np.array_equal(arrays.class_go[c], task.conditions[c].go)
        for m, condition in enumerate(task.conditions):
            row = arrays.condition_classes[m].tolist()
            assert tuple(c for c in row if c != NO_CLASS) == condition.classes
            assert row == sorted(row, key=lambda c: c == NO_CLASS), "padding comes last"


def test_array_types():
    arrays = Task.shipped("firefighting-1").arrays
    assert arrays.class_phi.dtype == jnp.int8
    for name in ("transitions", "initial", "edges", "edge_condition", "condition_classes"):
        assert getattr(arrays, name).dtype == jnp.int32
    for name in ("accepting", "trap", "class_stay", "class_go", "implies", "condition_mask"):
        assert getattr(arrays, name).dtype == jnp.bool_


def test_arrays_are_made_once_and_under_jit_too():
    task = Task.from_formula("F a")

    @jax.jit
    def accepting(letter):
        return task.arrays.accepting[task.arrays.transitions[task.arrays.initial, letter]]

    assert bool(accepting(1))
    assert not isinstance(task.arrays.transitions, jax.core.Tracer)
    assert task.arrays is task.arrays


PADDING = st.tuples(st.integers(0, 3), st.integers(0, 2), *[st.integers(0, 3)] * 4)


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(TASKS), PADDING)
def test_padding_changes_nothing_real_and_is_inert(task, padding):
    sizes = TaskSizes(*(size + extra for size, extra in zip(astuple(task.sizes), padding, strict=True)))
    real, padded = host(task.arrays), host(task.padded(sizes))
    # Without the row that arrays have where there is no edge or no class: that one is padding too.
    own = replace(task.sizes, edges=len(task.edges), classes=len(task.classes))
    letters = np.arange(2**sizes.propositions)
    own_letters = letters & (2**own.propositions - 1)
    conditions = own.classes + own.compound
    place = np.arange(conditions)
    place[own.classes :] += sizes.classes - own.classes

    assert padded.transitions.shape == (sizes.states, 2**sizes.propositions)
    assert np.array_equal(padded.transitions[: own.states], real.transitions[:, own_letters])
    assert (padded.transitions[own.states :] == np.arange(own.states, sizes.states)[:, None]).all()
    for name in ("accepting", "trap"):
        assert np.array_equal(getattr(padded, name)[: own.states], getattr(real, name))
    assert not padded.accepting[own.states :].any()
    assert padded.trap[own.states :].all()
    assert np.array_equal(padded.edges[: own.edges], real.edges[: own.edges])
    assert np.array_equal(padded.edge_condition[: own.edges], place[real.edge_condition[: own.edges]])
    assert not padded.edges[own.edges :].any()
    for name, size in [("state_mask", own.states), ("edge_mask", own.edges), ("class_mask", own.classes)]:
        mask = getattr(padded, name)
        assert mask[:size].all()
        assert not mask[size:].any()
    assert np.array_equal(padded.class_phi[: own.classes, :, : own.propositions], real.class_phi[: own.classes])
    assert not padded.class_phi[:, :, own.propositions :].any()
    assert not padded.class_phi[own.classes :].any()
    for name in ("class_stay", "class_go"):
        assert np.array_equal(getattr(padded, name)[: own.classes], getattr(real, name)[: own.classes, own_letters])
        assert not getattr(padded, name)[own.classes :].any()
    assert np.flatnonzero(padded.condition_mask).tolist() == place.tolist()
    classes = np.full((sizes.classes + sizes.compound, sizes.cubes), NO_CLASS)
    classes[place, : own.cubes] = real.condition_classes[:conditions]
    assert np.array_equal(padded.condition_classes, classes)
    implies = np.zeros((sizes.classes + sizes.compound,) * 2, dtype=bool)
    implies[np.ix_(place, place)] = real.implies[:conditions, :conditions]
    assert np.array_equal(padded.implies, implies)


def test_implications_are_reflexive_and_transitive():
    for task in TASKS:
        implies = task.outcomes.implies
        assert implies.diagonal().all()
        assert np.array_equal(implies, np.linalg.matrix_power(implies.astype(int), 2) > 0)


def test_padding_that_is_too_small():
    task = Task.shipped("firefighting-1")
    with pytest.raises(TaskError, match="does not fit"):
        task.padded(replace(task.sizes, edges=2))
    with pytest.raises(TaskError, match="17 propositions are too many"):
        task.padded(replace(task.sizes, propositions=17))


def test_stacked_tasks_are_the_padded_ones():
    tasks = [Task.shipped(name) for name in FIREFIGHTING]
    stacked = stack_tasks(tasks)
    assert stacked.transitions.shape == (4, 5, 16)
    assert stacked.class_phi.shape == (4, 6, 2, 4)
    assert stacked.condition_classes.shape == (4, 6 + 2, 2)
    sizes = tasks[0].sizes
    for task in tasks:
        sizes = sizes.union(task.sizes)
    for i, task in enumerate(tasks):
        for batched, single in zip(jax.tree.leaves(stacked), jax.tree.leaves(task.padded(sizes)), strict=True):
            assert np.array_equal(batched[i], single)
    larger = stack_tasks(tasks, replace(sizes, states=9))
    assert larger.transitions.shape == (4, 9, 16)
    accepted = jax.vmap(lambda arrays: arrays.accepting[arrays.transitions[arrays.initial, 8]])(stacked)
    assert accepted.tolist() == [False, False, False, True], "exit alone satisfies task 4 only"


def test_stacking_errors():
    with pytest.raises(TaskError, match="no task"):
        stack_tasks([])
    with pytest.raises(PropositionsError, match=r"first task of the stack, .* \(goal, hazard\)"):
        stack_tasks([Task.shipped("toy-1"), Task.shipped("firefighting-1")])


def test_describe_is_json_and_readable():
    task = Task.from_formula('!fire U ("front door" & F GOAL)', ("fire", "front door", "GOAL"))
    description = task.describe()
    assert json.loads(json.dumps(description)) == description
    assert description["propositions"] == ["fire", "front door", "GOAL"]
    assert description["states"] == 4
    assert description["transitions"][:4] == [
        {"from": 0, "to": 0, "guard": '!fire & !"front door"'},
        {"from": 0, "to": 1, "guard": 'fire & !"front door"'},
        {"from": 0, "to": 2, "guard": '"front door" & !"GOAL"'},
        {"from": 0, "to": 3, "guard": '"front door" & "GOAL"'},
    ]
    assert (description["initial"], description["accepting"], description["trap"]) == (0, [3], [1])
    assert description["edges"][0] == {"from": 0, "to": 2, "condition": 0}
    assert description["classes"][0] == {
        "phi_stay": [-1, -1, 0],
        "phi_cube": [0, 1, -1],
        "stay": '!fire & !"front door"',
        "cube": '"front door" & !"GOAL"',
        "stay_is_exact": True,
    }
    assert description["conditions"][0] == {
        "stay": '!fire & !"front door"',
        "go": '"front door" & !"GOAL"',
        "classes": [0],
    }


def test_describe_where_there_is_nothing_to_do():
    assert Task.from_formula("1").describe()["transitions"] == [{"from": 0, "to": 0, "guard": "true"}]
    assert Task.from_formula("F a", max_positive_literals=1).describe()["max_positive_literals"] == 1


def test_a_formula_is_compiled_over_the_propositions_given():
    task = Task.from_formula("!fire U exit", ["fire", "exit"])
    assert task.propositions == ("fire", "exit")
    # Letters: nothing, fire, exit, both. States in the order in which letters lead there: search, fire, exit.
    assert task.dfa.transitions.tolist() == [[0, 1, 2, 2], [1, 1, 1, 1], [2, 2, 2, 2]]
    assert task.dfa.accepting.tolist() == [False, False, True]


@pytest.mark.parametrize("name", ["U", "xor", "True", "first_match", "küche", "my room", 'a "b"', "back\\slash"])
def test_guards_are_formulas_whatever_the_names_are(name):
    task = Task.from_formula("F b", (name, "b"))
    guard = task.guard_text([(1, -1)])
    letters = Task.from_formula(guard, (name, "b"))
    # Fulfilled by the one letter that holds the name and not b.
    after = letters.dfa.transitions[letters.dfa.initial]
    assert letters.dfa.accepting[after].tolist() == [False, True, False, False]
