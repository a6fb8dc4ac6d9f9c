"""Product distances and paths against Dijkstra with a heap."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from potlp_jax import Task
from potlp_jax.planning.distances.paths import shortest_path
from potlp_jax.planning.distances.portals import CAPACITY, find_active_cells, portals_pay
from potlp_jax.planning.distances.product import (
    SOURCES_AT_ONCE,
    distance_table,
    grid_distances,
    one_letter_successors,
    product_distances,
    product_transitions,
    reachable_cells,
)
from potlp_jax.planning.distances.sweeping import Wildcard
from potlp_jax.task.task import TaskSizes
from potlp_jax.types import NO_STATE
from potlp_jax.world.moves import DIAGONAL
from tests.reference import dijkstra

FORMULAS = {
    "F a": ("a", "b"),
    "!b U a": ("a", "b"),
    "F a & F b": ("a", "b"),
    "X(a | X b)": ("a", "b"),
    "F(a & X b)": ("a", "b"),
    "!b U (a & F b)": ("a", "b"),
    "F(a & F(b & F a))": ("a", "b"),
    "F(a & X(a & X b))": ("a", "b"),
    "(!a U b) & F(a & X X a)": ("a", "b"),
}
"""With next, cycles of live states, and letters that jump two states at once (``a & b`` in ``F a & F b``)."""

SIZES = TaskSizes(states=8, propositions=2, edges=24, classes=24, compound=4, cubes=4)
SHAPE = (9, 12)

tasks = {text: Task.from_formula(text, propositions=names) for text, names in FORMULAS.items()}


@st.composite
def maps(draw):
    """Free cells, letters and a free source cell on a small map."""
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    free = rng.random(SHAPE) > draw(st.sampled_from([0.1, 0.3, 0.45]))
    letters = np.where(rng.random(SHAPE) < draw(st.sampled_from([0.05, 0.3])), rng.integers(0, 4, SHAPE), 0)
    source = tuple(int(entry) for entry in rng.integers(0, SHAPE))
    free[source] = True
    return free, np.where(free, letters, 0).astype(np.int32), source


_distances = jax.jit(product_distances)
_grid = jax.jit(grid_distances)
_reachable = jax.jit(reachable_cells)


@jax.jit
@chex.assert_max_traces(n=1)
def _solve(arrays, letters, free, source, state):
    transitions = product_transitions(arrays, letters, free)
    return transitions, product_distances(transitions, free, source[None], state[None], jnp.float32(0.5))[0]


def _dense(costs, states):
    dense = np.full((*SHAPE, states), np.inf)
    for ((row, column), state), cost in costs.items():
        dense[row, column, state] = cost
    return dense


@settings(max_examples=60, deadline=None)
@given(maps(), st.sampled_from(sorted(tasks)), st.data())
def test_distances_equal_a_heap(world, text, data):
    free, letters, source = world
    task, arrays = tasks[text], tasks[text].padded(SIZES)
    state = data.draw(st.sampled_from(np.flatnonzero(~task.dfa.trap).tolist()))
    _, distances = _solve(
        arrays, jnp.asarray(letters), jnp.asarray(free), jnp.asarray(source, jnp.int32), jnp.int32(state)
    )
    expected = dijkstra.product_distances(free, letters, task.dfa.transitions, task.dfa.trap, source, state)
    np.testing.assert_allclose(np.asarray(distances), 0.5 * _dense(expected, SIZES.states), rtol=1e-5)


@settings(max_examples=25, deadline=None)
@given(maps(), st.sampled_from(sorted(tasks)), st.integers(0, 2**32 - 1))
def test_optimistic_distances_equal_a_heap(world, text, seed):
    free, letters, source = world
    unknown = np.random.default_rng(seed).random(SHAPE) < 0.5
    unknown[source] = False
    known = free & ~unknown
    letters = np.where(known, letters, 0).astype(np.int32)
    task, arrays = tasks[text], tasks[text].padded(SIZES)
    state = task.dfa.initial
    distances = _optimistic(
        arrays,
        jnp.asarray(letters),
        jnp.asarray(known),
        jnp.asarray(unknown),
        jnp.asarray(source, jnp.int32),
        jnp.int32(state),
    )
    expected = dijkstra.optimistic_distances(
        known, unknown, letters, task.dfa.transitions, task.dfa.trap, source, state
    )
    np.testing.assert_allclose(np.asarray(distances), _dense(expected, SIZES.states), rtol=1e-5)


@jax.jit
def _optimistic(arrays, letters, known, unknown, source, state):
    transitions = product_transitions(arrays, letters, known)
    wildcard = Wildcard(cells=unknown, successors=one_letter_successors(arrays))
    one = jnp.float32(1.0)
    return product_distances(transitions, known | unknown, source[None], state[None], one, wildcard)[0]


@settings(max_examples=40, deadline=None)
@given(maps(), st.sampled_from(sorted(tasks)), st.integers(0, 2**32 - 1), st.sampled_from([3, 64]))
def test_paths_are_valid_and_as_long_as_the_distance(world, text, seed, horizon):
    free, letters, source = world
    task, arrays = tasks[text], tasks[text].padded(SIZES)
    state = task.dfa.initial
    transitions, distances = _solve(
        arrays, jnp.asarray(letters), jnp.asarray(free), jnp.asarray(source, jnp.int32), jnp.int32(state)
    )
    reachable = np.argwhere(np.isfinite(np.asarray(distances)))
    row, column, target_state = reachable[seed % len(reachable)]
    path = _path(horizon, distances, transitions, free, source, state, (row, column), target_state)
    cells, states = np.asarray(path.cells), np.asarray(path.states)
    assert tuple(cells[0]) == source
    assert states[0] == state
    travelled = 0.0
    for before, after, z, z_next in zip(cells[:-1], cells[1:], states[:-1], states[1:], strict=True):
        if len(range(int(path.length))) == 0 or np.array_equal(before, after):
            continue
        steps = dict(dijkstra.grid_moves(free, tuple(before)))
        assert tuple(after) in steps
        assert free[tuple(after)]
        assert task.dfa.transitions[z, letters[tuple(after)]] == z_next
        travelled += steps[tuple(after)] * 0.5
    total = float(path.cost)
    assert total == pytest.approx(float(distances[row, column, target_state]))
    if int(path.length) < horizon:
        assert tuple(cells[int(path.length)]) == (row, column)
        assert states[int(path.length)] == target_state
        assert travelled == pytest.approx(total, rel=1e-5)
    else:
        end = cells[int(path.length)]
        assert travelled == pytest.approx(float(distances[end[0], end[1], states[int(path.length)]]), rel=1e-5)


def _path(horizon, distances, transitions, free, source, state, target, target_state):
    return jax.jit(shortest_path, static_argnames="horizon")(
        distances,
        transitions,
        jnp.asarray(free),
        jnp.asarray(source, jnp.int32),
        jnp.int32(state),
        jnp.asarray(target, jnp.int32),
        jnp.int32(target_state),
        horizon=horizon,
        resolution=jnp.float32(0.5),
    )


def test_unreachable_target_gives_an_empty_path():
    free = np.ones((3, 5), bool)
    free[:, 2] = False
    transitions = jnp.where(jnp.asarray(free), 0, NO_STATE)[:, :, None]
    distances = _distances(
        transitions, jnp.asarray(free), jnp.zeros((1, 2), jnp.int32), jnp.zeros(1, jnp.int32), jnp.float32(1)
    )[0]
    path = _path(4, distances, transitions, free, (0, 0), 0, (0, 4), 0)
    assert int(path.length) == 0
    assert np.isinf(float(path.cost))
    assert np.asarray(path.cells).tolist() == [[0, 0]] * 5


def test_more_sources_than_are_solved_at_once_keep_their_order():
    rng = np.random.default_rng(3)
    free = rng.random(SHAPE) > 0.2
    arrays = tasks["F a & F b"].padded(SIZES)
    letters = np.where(free, rng.integers(0, 4, SHAPE), 0).astype(np.int32)
    count = 2 * SOURCES_AT_ONCE + 3
    cells = np.argwhere(free)[:count].astype(np.int32)
    states = np.where(np.arange(count) % 3 == 0, NO_STATE, np.arange(count) % 3).astype(np.int32)
    transitions = jax.jit(product_transitions)(arrays, jnp.asarray(letters), jnp.asarray(free))
    everything = (transitions, jnp.asarray(free), jnp.asarray(cells), jnp.asarray(states), jnp.float32(1))
    together = np.asarray(_distances(*everything))
    for index in range(count):
        alone = _distances(*everything[:2], cells[index : index + 1], states[index : index + 1], everything[4])
        np.testing.assert_array_equal(together[index], np.asarray(alone)[0])
        assert np.isinf(together[index]).all() == (states[index] == NO_STATE)

    targets = jnp.asarray(cells[:4])
    travel, finish = jax.jit(distance_table)(
        transitions, jnp.asarray(free), arrays.accepting, everything[2], everything[3], targets, jnp.float32(1)
    )
    np.testing.assert_allclose(np.asarray(travel), together[:, cells[:4, 0], cells[:4, 1]], rtol=1e-6)
    accepted = np.where(np.asarray(arrays.accepting), together, np.inf).min(axis=(1, 2, 3))
    np.testing.assert_allclose(np.asarray(finish), accepted, rtol=1e-6)


LARGE = (15, 20)
"""A map on which a few letters leave most cells neutral."""


@jax.jit
@chex.assert_max_traces(n=1)
def _table(arrays, letters, free, cells, states, targets):
    transitions = product_transitions(arrays, letters, free)
    everything = (transitions, free, arrays.accepting, cells, states, targets, jnp.float32(0.5))
    active = find_active_cells(transitions)
    return distance_table(*everything), portals_pay(transitions, active, cells, states), active.count


def _labelled_map(rng, labelled):
    """Free cells, and letters: on a few cells, or over areas that cover a good part of the map."""
    free = rng.random(LARGE) > 0.25
    letters = np.zeros(LARGE, np.int32)
    if labelled == "points":
        for row, column in rng.integers(0, LARGE, (5, 2)):
            letters[row, column] = rng.integers(1, 4)
    if labelled == "areas":
        for row, column in rng.integers(-2, LARGE, (4, 2)):
            letters[max(row, 0) : row + 7, max(column, 0) : column + 7] |= rng.integers(1, 4)
    return free, np.where(free, letters, 0).astype(np.int32)


@pytest.mark.parametrize("labelled", ["nothing", "points", "areas"])
@pytest.mark.parametrize("text", sorted(tasks))
def test_table_equals_a_heap_however_much_is_labelled(text, labelled):
    task, arrays = tasks[text], tasks[text].padded(SIZES)
    rng = np.random.default_rng([len(labelled), len(text)])
    free, letters = _labelled_map(rng, labelled)
    live = np.flatnonzero(~task.dfa.trap)
    corners = rng.permutation(np.argwhere(free))[:4].astype(np.int32)
    labels = rng.permutation(np.argwhere(letters > 0)).reshape(-1, 2)[:2].astype(np.int32)
    places = np.concatenate([corners, labels, corners])[:6]
    cells = np.repeat(places, SIZES.states, axis=0)
    states = np.tile(np.where(np.isin(np.arange(SIZES.states), live), np.arange(SIZES.states), NO_STATE), 6)
    (travel, finish), _, _ = _table(
        arrays, jnp.asarray(letters), jnp.asarray(free), jnp.asarray(cells), jnp.asarray(states, jnp.int32), places
    )
    for index, (cell, state) in enumerate(zip(cells, states, strict=True)):
        expected = np.full((len(places), SIZES.states), np.inf)
        accepted = np.inf
        if state != NO_STATE:
            costs = dijkstra.product_distances(free, letters, task.dfa.transitions, task.dfa.trap, cell, state)
            accepted = min((cost for (_, z), cost in costs.items() if task.dfa.accepting[z]), default=np.inf)
            for place, (row, column) in enumerate(places):
                for z in live:
                    expected[place, z] = costs.get(((int(row), int(column)), int(z)), np.inf)
        np.testing.assert_allclose(np.asarray(travel)[index], 0.5 * expected, rtol=1e-5)
        np.testing.assert_allclose(np.asarray(finish)[index], 0.5 * accepted, rtol=1e-5)


def test_portals_are_used_where_few_cells_are_labelled():
    arrays = tasks["F a & F b"].padded(SIZES)
    rng = np.random.default_rng(1)
    chosen = {}
    for labelled in ("points", "areas"):
        free, letters = _labelled_map(rng, labelled)
        places = np.argwhere(free)[::40][:6].astype(np.int32)
        cells, states = np.repeat(places, SIZES.states, axis=0), np.tile(np.arange(SIZES.states), 6)
        states = np.where(states < 4, states, NO_STATE).astype(np.int32)
        _, pays, count = _table(arrays, jnp.asarray(letters), jnp.asarray(free), cells, states, places)
        chosen[labelled] = bool(pays)
        assert int(count) == np.sum(free & (letters > 0))
    assert chosen == {"points": True, "areas": False}


def test_more_active_cells_than_portals_hold_are_swept():
    """A map whose every cell is labelled: nothing is dropped."""
    task, arrays = tasks["F a & F b"], tasks["F a & F b"].padded(SIZES)
    letters = np.random.default_rng(0).integers(1, 4, LARGE).astype(np.int32)
    free = np.ones(LARGE, bool)
    cells = np.zeros((48, 2), np.int32)
    states = np.where(np.arange(48) == 0, 0, NO_STATE).astype(np.int32)
    targets = np.array([[14, 19], [0, 1], [3, 3], [7, 7], [14, 0], [0, 0]], np.int32)
    (travel, _), pays, count = _table(arrays, jnp.asarray(letters), jnp.asarray(free), cells, states, targets)
    assert int(count) == free.size > CAPACITY
    assert not bool(pays)
    costs = dijkstra.product_distances(free, letters, task.dfa.transitions, task.dfa.trap, (0, 0), 0)
    for target, row in zip(targets, np.asarray(travel)[0], strict=True):
        expected = [costs.get((tuple(target.tolist()), z), np.inf) for z in range(task.dfa.transitions.shape[0])]
        np.testing.assert_allclose(row[: len(expected)], 0.5 * np.asarray(expected), rtol=1e-5)


@jax.jit
def _any_table(arrays, letters, free, cells, states, targets):
    transitions = product_transitions(arrays, letters, free)
    return distance_table(transitions, free, arrays.accepting, cells, states, targets, jnp.float32(1))


@pytest.mark.parametrize("labelled", ["points", "areas"])
def test_padding_changes_no_bit(labelled):
    """Padded states, padded sources and a wall of cells around: the same costs, to the last bit."""
    task = tasks["F a & F b"]
    rng = np.random.default_rng(11)
    free, letters = _labelled_map(rng, labelled)
    places = np.argwhere(free)[::35][:6].astype(np.int32)
    cells, states = np.repeat(places, 4, axis=0), np.tile(np.arange(4), 6).astype(np.int32)
    travel, finish = _any_table(task.arrays, letters, free, cells, states, places)
    wider = ((0, 3), (0, 5))
    wide, wide_finish = _any_table(
        task.padded(SIZES),
        np.pad(letters, wider),
        np.pad(free, wider),
        np.pad(cells, ((0, 8), (0, 0))),
        np.pad(states, (0, 8), constant_values=NO_STATE),
        places,
    )
    np.testing.assert_array_equal(np.asarray(wide)[:24, :, :4], np.asarray(travel))
    np.testing.assert_array_equal(np.asarray(wide_finish)[:24], np.asarray(finish))
    assert np.isinf(np.asarray(wide)[24:]).all()
    assert np.isinf(np.asarray(wide)[:, :, 4:]).all()


def test_a_batch_of_tables_equals_a_loop():
    """Rows of which some go by portals and some by sweeps, each the same as alone, to the last bit."""
    arrays = tasks["F a & F b"].arrays
    rng = np.random.default_rng(13)
    maps = [_labelled_map(rng, labelled) for labelled in ("points", "areas", "nothing")]
    frees, letters = (jnp.asarray(np.stack(entries)) for entries in zip(*maps, strict=True))
    cells = jnp.asarray(np.repeat(rng.integers(0, LARGE, (6, 2)), 4, axis=0), jnp.int32)
    states = jnp.asarray(np.tile(np.arange(4), 6), jnp.int32)
    places = cells[::4]
    together = jax.vmap(lambda free, letter: _any_table(arrays, letter, free, cells, states, places))(frees, letters)
    for row in range(len(maps)):
        alone = _any_table(arrays, letters[row], frees[row], cells, states, places)
        chex.assert_trees_all_equal(jax.tree.map(lambda array, row=row: array[row], together), alone)


def test_corners_are_not_cut():
    free = np.array([[True, False], [True, True]])
    cost = np.asarray(_grid(jnp.asarray(free), jnp.array([0, 0], jnp.int32), jnp.float32(1)))
    assert cost[1, 1] == 2.0
    free = np.array([[True, True], [True, True]])
    cost = np.asarray(_grid(jnp.asarray(free), jnp.array([0, 0], jnp.int32), jnp.float32(1)))
    assert cost[1, 1] == pytest.approx(DIAGONAL)


@settings(max_examples=40, deadline=None)
@given(maps(), st.sampled_from(sorted(tasks)))
def test_reachable_cells_ignore_letters(world, text):
    free, letters, source = jnp.asarray(world[0]), jnp.asarray(world[1]), jnp.asarray(world[2], jnp.int32)
    arrays, state = tasks[text].padded(SIZES), jnp.int32(tasks[text].dfa.initial)
    _, distances = _solve(arrays, letters, free, source, state)
    found = _reachable(free, source, jnp.any(jnp.isfinite(distances), axis=2))
    np.testing.assert_array_equal(found, np.isfinite(_grid(free, source, jnp.float32(1))))


def test_trap_letters_are_never_entered():
    task = tasks["!b U a"]
    letters = jnp.asarray(np.array([[0, 2, 1]], np.int32))
    transitions = np.asarray(product_transitions(task.arrays, letters, jnp.ones((1, 3), bool)))
    assert transitions[0, 1, task.dfa.initial] == NO_STATE
    assert task.dfa.accepting[transitions[0, 2, task.dfa.initial]]


def test_vmap_equals_loop():
    rng = np.random.default_rng(5)
    frees = rng.random((3, *SHAPE)) > 0.3
    frees[:, 0, 0] = True
    source = jnp.zeros(2, jnp.int32)
    batched = jax.vmap(lambda free: _grid(free, source, jnp.float32(1)))(jnp.asarray(frees))
    for free, together in zip(frees, batched, strict=True):
        np.testing.assert_array_equal(np.asarray(_grid(jnp.asarray(free), source, jnp.float32(1))), together)
