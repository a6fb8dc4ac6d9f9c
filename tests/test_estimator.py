"""The network inside a decision: against asking pair by pair; padding, records, replays; what was seen, drawn."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.cli.explain import explain_decision
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import world_key
from potlp_jax.errors import EstimatorError, PropositionsError
from potlp_jax.learning.estimator import (
    estimator_for,
    read_estimator,
    shipped_estimator,
)
from potlp_jax.learning.exclusion import SURE, exclusive_chances
from potlp_jax.learning.network import EstimatorNetwork, NetworkConfig
from potlp_jax.learning.observing import observe_panorama
from potlp_jax.learning.serialization import save_estimator
from potlp_jax.planning.decision import subgoals_at
from potlp_jax.planning.policies import Policy
from potlp_jax.task.task import Task
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.record import ActionRecord, load_trial
from potlp_jax.trials.replay import panorama_at, replay_decision
from potlp_jax.view.panoramas import draw_panoramas
from potlp_jax.world.camera import Disturbance
from potlp_jax.world.frontiers import FrontierConfig, find_subgoals
from potlp_jax.world.grid import BeliefMap
from potlp_jax.world.renderer import render
from potlp_jax.world.sensing import SensorConfig, observe
from tests.reference.dijkstra import product_distances
from tests.reference.domains import domain_of

TINY = {"first_widths": (4, 4, 4, 4), "second_widths": (4,) * 8, "dense_widths": (8, 8, 8, 8)}
WITHIN = 16.0
"""Cells within which subgoals exclude each other."""

NEAR = TrialConfig(sensor=SensorConfig(range_cells=5.0))


@pytest.fixture(scope="module")
def generator():
    return make("toy")


@pytest.fixture(scope="module")
def trained_file(generator, tmp_path_factory):
    config = NetworkConfig(propositions=generator.propositions, exclusive_within=WITHIN, fovea=4, **TINY)
    path = tmp_path_factory.mktemp("estimator") / "tiny.npz"
    save_estimator(path, EstimatorNetwork(config).init(jax.random.key(3)), config, domain_of("toy"), {})
    return path


@pytest.fixture(scope="module")
def trained(trained_file):
    return read_estimator(trained_file)


@pytest.fixture(scope="module")
def world(generator):
    return generator.generate(world_key("validation", 0, generator.name))


@pytest.fixture(scope="module")
def task(generator):
    return Task.from_formula(generator.tasks["1"], propositions=generator.propositions)


@pytest.fixture(scope="module")
def trial(world, task, trained):
    return run_trial(world, task, Policy.POTLP, jax.random.key(0), NEAR, estimator=trained)


def _with_neighbours(chances, cells):
    """The chances given those of the subgoals near by, one after the other."""
    raised = np.array(chances)
    for s, c in np.ndindex(*chances.shape):
        group = [chances[t, c] for t in range(len(cells)) if np.hypot(*(cells[s] - cells[t])) <= WITHIN]
        none = np.prod([1 - chance for chance in group])
        if 0 < none < 1:
            power = np.log(max(1 - sum(group), 1 - SURE)) / np.log(none)
            raised[s, c] = 1 - (1 - chances[s, c]) ** max(power, 1)
    return raised


def test_subgoals_side_by_side_fail_together_with_what_their_sum_leaves():
    cells = jnp.asarray([[0, 0], [0, 10], [0, 60], [0, 5]], jnp.int32)
    subgoals = subgoals_at(cells, jnp.asarray([True, True, True, False]), 10, 80)
    chances = jnp.asarray([[0.3, 0.53, 0.0, 0.99], [0.4, 0.54, 0.2, 0.5], [0.3, 0.6, 0.1, 0.2], [0.9, 0.9, 0.9, 0.9]])
    raised = np.asarray(exclusive_chances(chances, subgoals, WITHIN))
    np.testing.assert_allclose((1 - raised[0]) * (1 - raised[1]), [0.3, 1 - SURE, 0.8, 0.005], rtol=1e-4)
    np.testing.assert_allclose(raised[2:], chances[2:], rtol=1e-5)
    np.testing.assert_allclose(raised[:3], _with_neighbours(np.asarray(chances)[:3], np.asarray(cells)[:3]), rtol=1e-4)
    assert np.all(raised >= np.asarray(chances) - 1e-6)
    np.testing.assert_allclose(exclusive_chances(chances, subgoals, 0.0), chances, rtol=1e-5)


@pytest.mark.long
@pytest.mark.parametrize("resolution", [1.0, 0.5])
def test_answers_equal_the_network_asked_pair_by_pair(world, task, trained, resolution):
    world = dataclasses.replace(world, resolution=jnp.float32(resolution))
    belief = observe(BeliefMap.unobserved(world), world, world.start, NEAR.sensor)
    subgoals = find_subgoals(belief, belief.free, jnp.zeros(world.shape), FrontierConfig())
    eyes = observe_panorama(trained.start(*world.shape, 4, 1.0), render(world, world.start), belief, world.start)
    estimates = jax.jit(lambda eyes, *asked: eyes(*asked))(eyes, belief, subgoals, task.arrays)
    network = EstimatorNetwork(trained.config)
    # Operation by operation they would be hundreds of programs.
    encode, centre, answer_of = jax.jit(network.encode), jax.jit(network.centre), jax.jit(network.answer)
    features = encode(trained.params, render(world, world.start))
    start = tuple(world.start.tolist())
    count = int(subgoals.mask.sum())
    assert count > 0
    assert len(task.classes) > 0
    chances = np.zeros((count, len(task.classes)))
    free = np.asarray(belief.free)
    distances = product_distances(free, np.zeros(free.shape, int), np.zeros((1, 1), int), [False], start, 0)
    for s in range(count):
        row, column = subgoals.cells[s].tolist()
        angle = jnp.float32(math.atan2(row - start[0], column - start[1]))
        distance = jnp.float32(resolution * distances[((row, column), 0)])
        centred = centre(features, angle[None], distance[None])
        for c, (stay, go) in enumerate(task.classes):
            answer = answer_of(trained.params, centred, jnp.asarray([stay], jnp.int8), jnp.asarray([go], jnp.int8))
            chances[s, c] = answer.success_probability[0]
            pair = (estimates.success_cost, estimates.failure_cost)
            expected = (answer.success_cost, answer.failure_cost)
            for found, wanted in zip(pair, expected, strict=True):
                np.testing.assert_allclose(found[s, c], wanted[0], rtol=1e-4)
    expected = _with_neighbours(chances, np.asarray(subgoals.cells)[:count])
    np.testing.assert_allclose(estimates.success_probability[:count], expected, rtol=1e-3)
    assert np.all(np.asarray(estimates.success_probability)[count:] == 0)
    assert np.all(np.asarray(estimates.success_cost) > 0)


def test_a_trial_is_satisfied_and_repeats(world, task, trained, trial):
    again = run_trial(world, task, Policy.POTLP, jax.random.key(0), NEAR, estimator=trained)
    assert trial.outcome == "satisfied"
    assert again.path == trial.path
    assert again.decisions == trial.decisions
    assert trial.versions["estimator"] == trained.identity


def test_observations_name_earlier_decisions(trial):
    assert any(decision.observations for decision in trial.decisions)
    for decision in trial.decisions:
        assert len(decision.observations) == len(decision.subgoals)
        assert all(0 <= number <= decision.index for number in decision.observations)


def test_a_saved_trial_replays_its_decisions(trial, trained, tmp_path):
    trial.save(tmp_path / "trial.json")
    loaded = load_trial(tmp_path / "trial.json")
    assert loaded.decisions == trial.decisions
    searched = [decision for decision in loaded.decisions if decision.actions]
    decision = searched[-1]
    _, plan, _ = replay_decision(loaded, decision.index, trained)
    q_values = {action.index: action.q_value for action in decision.actions}
    assert int(plan.action) == decision.choice
    for index, value in q_values.items():
        np.testing.assert_allclose(plan.q_values[index], value, rtol=1e-4)


def test_a_replay_wants_the_same_estimator(trial, trained):
    other = dataclasses.replace(trained, digest="another")
    with pytest.raises(EstimatorError, match="give that one"):
        replay_decision(trial, 0, other)


def test_panoramas_are_made_again(world, trial):
    last = trial.decisions[-1]
    expected = render(world, jnp.asarray(last.cell, jnp.int32))
    np.testing.assert_array_equal(panorama_at(trial, last), expected)


def test_a_disturbed_camera_changes_what_is_estimated(world, task, trained, trial):
    noisy = dataclasses.replace(NEAR, disturbance=Disturbance(noise=40.0, exposure=0.5))
    disturbed = run_trial(world, task, Policy.POTLP, jax.random.key(0), noisy, estimator=trained)
    assert disturbed.decisions[0].actions != trial.decisions[0].actions
    with pytest.raises(ValueError, match="disturbed"):
        panorama_at(disturbed, disturbed.decisions[0])


def test_which_estimator_is_used(trained, generator):
    here = domain_of("toy")
    assert estimator_for(generator.propositions, here, trained) is trained
    with pytest.raises(PropositionsError, match=r"task has the propositions \(other\), estimator"):
        estimator_for(("other",), here, trained)
    with pytest.raises(EstimatorError, match="no estimator is shipped"):
        estimator_for(("other",), here)
    assert shipped_estimator(("other",), here) is None


ROWS, COLUMNS = 8, 64
RED = np.array([255, 0, 0], np.uint8)


def _action(index, subgoal):
    return ActionRecord(
        index=index,
        subgoal=subgoal,
        cell=(0, 0),
        from_state=0,
        to_state=1,
        success_probability=0.625,
        success_cost=12.0,
        failure_cost=34.0,
        distance=5.0,
        q_value=56.0 + index,
        visits=3,
    )


def _panorama(origin, cell):
    """Grey, with a red column where the cell is; columns run from -pi to pi of atan2(rows, columns)."""
    image = np.full((ROWS, COLUMNS, 3), 128, np.uint8)
    angle = np.arctan2(cell[0] - origin[0], cell[1] - origin[1])
    image[:, int(np.floor((angle + np.pi) / (2 * np.pi) * COLUMNS)) % COLUMNS] = RED
    return image


def test_a_file_that_was_written_again_is_read_again(generator, tmp_path):
    path = tmp_path / "mine.npz"
    found = []
    for made_by in ("the first fit", "the next fit"):
        config = NetworkConfig(propositions=generator.propositions, exclusive_within=WITHIN, fovea=4, **TINY)
        params = EstimatorNetwork(config).init(jax.random.key(3))
        save_estimator(path, params, config, domain_of("toy"), {"says": made_by})
        found.append(read_estimator(path))
        # A file that stays as it is is read once.
        assert read_estimator(path) is found[-1]
    assert [estimator.metadata["says"] for estimator in found] == ["the first fit", "the next fit"]
    assert found[0].identity != found[1].identity


def test_each_subgoal_is_shown_in_the_centre_of_the_panorama_that_its_estimates_come_from(trial):
    first, last = trial.decisions[0], trial.decisions[-1]
    seen_from = {0: first.cell, last.index: last.cell}
    cells = ((first.cell[0] - 3, first.cell[1]), (last.cell[0] + 2, last.cell[1] - 2))
    decision = dataclasses.replace(
        last,
        subgoals=cells,
        observations=(0, last.index),
        actions=tuple(_action(index, 0) for index in range(8)),
        choice=1,
        preferred=1,
    )
    shown = zip(decision.observations, cells, strict=True)
    panoramas = {number: _panorama(seen_from[number], cell) for number, cell in shown}
    figure = draw_panoramas(trial, decision, panoramas)
    pictures = [axes for axes in figure.axes if axes.images]
    assert len(pictures) == 2
    for axes in pictures:
        red = np.all(np.asarray(axes.images[0].get_array()) == RED, axis=-1).all(axis=0)
        assert np.flatnonzero(red).tolist() in ([COLUMNS // 2 - 1], [COLUMNS // 2])
    assert pictures[0].get_title(loc="left").startswith("chosen: s0")
    assert "at decision 0" in pictures[0].get_title(loc="left")
    assert pictures[1].get_title(loc="left").startswith("s1")
    assert "seen now" in pictures[1].get_title(loc="left")
    answers = [axes.texts[0] for axes in figure.axes if not axes.images]
    told = [text.get_text() for text in answers]
    # Nothing is cut off at the picture's edge, nor written over the panoramas.
    assert all(text.get_window_extent().x1 <= figure.bbox.x1 for text in [*answers, *figure.texts])
    assert min(t.get_window_extent().x0 for t in answers) > max(axes.get_window_extent().x1 for axes in pictures)
    assert "0.62" in told[0]
    assert "and 2 more" in told[0]
    assert told[1] == "nothing can be tried here"


def test_explain_writes_the_panoramas_beside_the_tree(trial, trained_file, tmp_path, capsys):
    trial.save(tmp_path / "trial.json")
    index = next(decision.index for decision in trial.decisions if decision.actions)
    explain_decision(f"{tmp_path}:{index}", out=tmp_path / "tree.png", estimator=str(trained_file))
    told = capsys.readouterr().out
    for name in ("tree.png", "tree-panoramas.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
        assert name in told.replace("\n", "")
