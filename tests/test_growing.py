"""Arrays of subgoals that grow: a trial that begins with a short one is that which had a long one from the start."""

import dataclasses
import functools
import itertools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from potlp_jax.environments.rooms import Rooms
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.errors import RecordError
from potlp_jax.native import twin_only
from potlp_jax.planning.estimates import Estimates
from potlp_jax.planning.policies import Policy
from potlp_jax.planning.search.config import BestFirstConfig, UctConfig
from potlp_jax.planning.situation import DecisionConfig
from potlp_jax.sweep.rows import path_text
from potlp_jax.sweep.specification import specification_from_dict
from potlp_jax.sweep.store import Item
from potlp_jax.sweep.work import Work
from potlp_jax.task.task import Task
from potlp_jax.trials import batch
from potlp_jax.trials import loop as trial_module
from potlp_jax.trials.batch import Start, run_batch
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.live import run_robot
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.replay import replay_decision
from potlp_jax.trials.robot import SimulatedRobot
from potlp_jax.trials.slots import LOCKSTEP
from potlp_jax.types import Status
from potlp_jax.verify.audit import problems_of
from potlp_jax.world.camera import CameraConfig
from potlp_jax.world.frontiers import FrontierConfig
from potlp_jax.world.sensing import SensorConfig

ROOMS = Rooms.toy()
TASK = Task.from_formula("F(a & F(b & F c))", propositions=ROOMS.propositions)
FEW, SOME, MANY = 3, 4, 5
"""Worlds in which there are at most 2, 3 to 4 and more than 4 frontiers at a decision."""


def _world(number):
    return ROOMS.generate(world_key(Split.VALIDATION, number, "rooms"))


def _config(subgoals, most=512, search=BestFirstConfig(simulations=30)):
    return TrialConfig(
        sensor=SensorConfig(range_cells=5.0),
        camera=CameraConfig(height=16, width=64, horizon=6.0, fold=2.0),
        decision=DecisionConfig(
            frontiers=FrontierConfig(max_subgoals=subgoals, most_subgoals=most), search=search, path_horizon=64
        ),
    )


SHORT, LONG = _config(2), _config(16)


@struct.dataclass
class Counter:
    """Remembers how often the camera looked, and answers with it: a look too many leads elsewhere."""

    memory: jax.Array

    @property
    def looks_on_the_way(self):
        return True

    def encode(self, panorama):
        return jnp.int32(panorama.shape[0] > 0)

    def remember(self, seen, belief, cell):
        return dataclasses.replace(self, memory=self.memory + seen)

    def __call__(self, belief, subgoals, task):
        index = jnp.arange(subgoals.mask.shape[0], dtype=jnp.int32)
        chance = ((self.memory * 7 + index * 5) % 11 + 1).astype(jnp.float32) / 12
        shape = (subgoals.mask.shape[0], task.class_mask.shape[0])
        return Estimates(
            success_probability=jnp.where(task.class_mask[None, :], jnp.broadcast_to(chance[:, None], shape), 0.0),
            success_cost=jnp.full(shape, 10.0),
            failure_cost=jnp.full(shape, 10.0),
        )


COUNTER = Counter(memory=jnp.int32(0))


@functools.cache
def _trial(number, policy, config):
    return run_trial(_world(number), TASK, policy, jax.random.key(number), config, estimator=COUNTER)


def _batch(numbers, policy, config, slots=2):
    starts = [Start(_world(number), TASK.arrays, jax.random.key(number), name=number) for number in numbers]
    return {trial.name: trial for trial in run_batch(starts, policy, config, slots=slots, estimator=COUNTER)}


def _decided(decision):
    """A decision without what is numbered by the length of the array: actions by what they are, not by their index."""
    by_index = {action.index: dataclasses.replace(action, index=-1) for action in decision.actions}
    named = dataclasses.replace(decision, choice=None, preferred=None, actions=())
    return named, list(by_index.values()), by_index.get(decision.choice), by_index.get(decision.preferred)


def _figures(trial):
    return trial.outcome, trial.cost, np.asarray(trial.path).tolist(), trial.status


def _most(trial):
    return max(len(decision.subgoals) for decision in trial.decisions)


def test_the_next_length_is_twice_the_last_up_to_the_most():
    config, lengths = FrontierConfig(max_subgoals=12, most_subgoals=100), []
    while (grown := config.grown()) is not None:
        config = grown
        lengths.append(config.max_subgoals)
    assert lengths == [24, 48, 96, 100]
    assert FrontierConfig(max_subgoals=12, most_subgoals=12).grown() is None
    assert FrontierConfig(max_subgoals=12, most_subgoals=5).grown() is None
    assert DecisionConfig(frontiers=FrontierConfig(max_subgoals=3, most_subgoals=3)).grown() is None


@pytest.mark.long
@pytest.mark.parametrize("policy", [Policy.BASELINE, Policy.ORACLE, Policy.POTLP])
def test_a_short_array_that_grows_gives_the_trial_of_a_long_one(policy):
    for number in (SOME, MANY):
        short, long = (_trial(number, policy, config) for config in (SHORT, LONG))
        # It has grown, and nobody is told to worry.
        assert _most(short) > 2
        assert not short.status & Status.SUBGOAL_OVERFLOW
        assert _figures(short) == _figures(long)
        assert (short.word, short.states) == (long.word, long.states)
        assert [_decided(decision) for decision in short.decisions] == [
            _decided(decision) for decision in long.decisions
        ]
        # The record has the settings as they were given.
        assert short.config["decision"]["frontiers"]["max_subgoals"] == 2
        assert problems_of(short, TASK, _world(number)) == []
    # More than once in the last, by policies that do not answer as they please.
    assert _most(short) > 4 or policy is Policy.POTLP


def test_an_array_that_has_grown_stays_long_and_only_decisions_are_compiled_anew():
    programs = (trial_module._decide, trial_module._first_tally, trial_module._arrive)

    def compiled(number, config):
        before = [program._cache_size() for program in programs]
        _trial(number, Policy.BASELINE, config)
        after = [program._cache_size() for program in programs]
        return [now - then for now, then in zip(after, before, strict=True)]

    # Another commitment makes other programs than those of the tests above.
    config = dataclasses.replace(SHORT, decision=dataclasses.replace(SHORT.decision, commitment=0.1))
    assert compiled(FEW, config)[0] == 1
    # For 4 and for 8 subgoals.
    assert compiled(MANY, config) == [2, 0, 0]
    assert compiled(MANY, config) == [0, 0, 0]


@pytest.mark.long
@pytest.mark.parametrize("policy", [Policy.BASELINE, Policy.ORACLE, Policy.POTLP])
def test_trials_that_outgrow_a_batch_are_what_they_are_alone(policy):
    numbers = (SOME, FEW, MANY, 0, 1)
    found = _batch(numbers, policy, SHORT)
    assert sorted(found) == sorted(numbers)
    for number in numbers:
        alone = _trial(number, policy, SHORT)
        assert _figures(found[number]) == _figures(alone)
        assert found[number].decisions == len(alone.decisions)
        assert not found[number].status & Status.SUBGOAL_OVERFLOW
        assert found[number].fallbacks == sum(decision.fallback for decision in alone.decisions)


@pytest.mark.long
def test_in_lockstep_without_native_kernels_they_grow_too(monkeypatch):
    expected = _batch((SOME, FEW), Policy.BASELINE, SHORT)
    monkeypatch.setenv(LOCKSTEP, "1")
    with twin_only():
        found = _batch((SOME, FEW), Policy.BASELINE, SHORT)
    assert {number: _figures(trial) for number, trial in found.items()} == {
        number: _figures(trial) for number, trial in expected.items()
    }


def test_what_a_trial_took_before_it_grew_counts(monkeypatch):
    ticks = itertools.count()
    # Each run of the slots takes one second: the first ends with the trial's third frontier, the second with its end.
    monkeypatch.setattr(batch, "time", SimpleNamespace(perf_counter=lambda: float(next(ticks))))
    assert _batch((SOME,), Policy.BASELINE, SHORT, slots=1)[SOME].seconds == 2.0
    assert _batch((FEW,), Policy.BASELINE, SHORT, slots=1)[FEW].seconds == 1.0


@pytest.mark.long
@pytest.mark.parametrize("most", [1, 3])
def test_beyond_the_most_the_nearest_stay_and_the_trial_is_flagged(most):
    config = _config(2, most)
    for policy in (Policy.BASELINE, Policy.POTLP):
        trial = _trial(MANY, policy, config)
        assert trial.status & Status.SUBGOAL_OVERFLOW
        # An array that may not grow is not cut down either.
        assert _most(trial) == max(2, most)
        assert problems_of(trial, TASK, _world(MANY)) == []
        assert _figures(_batch((MANY, FEW), policy, config)[MANY]) == _figures(trial)


@pytest.mark.long
@pytest.mark.parametrize("search", [BestFirstConfig(simulations=30), UctConfig(simulations=30)])
def test_a_replay_decides_with_the_array_that_the_decision_had(search):
    config = _config(2, search=search)
    trial = _trial(SOME, Policy.ORACLE, config)
    lengths = [len(decision.subgoals) for decision in trial.decisions]
    first = next(index for index, length in enumerate(lengths) if length > 2)
    for index in (0, first, len(lengths) - 1):
        decision = trial.decisions[index]
        problem, plan, _ = replay_decision(trial, index)
        assert problem.subgoal_mask.shape[0] >= max(lengths[: index + 1])
        assert int(plan.action) == decision.preferred
        for action in decision.actions:
            assert float(plan.q_values[action.index]) == action.q_value


def test_a_record_with_more_subgoals_than_its_settings_allow_is_refused():
    trial = _trial(MANY, Policy.ORACLE, SHORT)
    frontiers = {**trial.config["decision"]["frontiers"], "most_subgoals": 3}
    config = {**trial.config, "decision": {**trial.config["decision"], "frontiers": frontiers}}
    with pytest.raises(RecordError, match="more than the trial's settings allow"):
        replay_decision(dataclasses.replace(trial, config=config), len(trial.decisions) - 1)


def test_a_robots_listener_hears_each_decision_once_and_complete():
    heard = []
    trial = run_robot(
        SimulatedRobot(_world(MANY), SHORT),
        TASK,
        Policy.BASELINE,
        jax.random.key(MANY),
        SHORT,
        listener=lambda decision, belief: heard.append(decision),
    )
    assert [decision.index for decision in heard] == list(range(len(trial.decisions)))
    assert max(len(decision.subgoals) for decision in heard) > 4
    assert not any(decision.status & Status.SUBGOAL_OVERFLOW for decision in heard)
    assert trial.path == _trial(MANY, Policy.BASELINE, LONG).path


@pytest.mark.long
def test_a_sweeps_rows_are_the_trials_made_again():
    settings = {"sensor": {"range_cells": 5}, "decision": {"frontiers": {"max_subgoals": 1}}}
    work = Work(
        specification_from_dict(
            {"environments": ["toy"], "tasks": [2], "policies": ["baseline"], "worlds": 3, "settings": settings}, "here"
        )
    )
    task, most = work.specification.cells[0].task, 0
    items = [Item("toy", task, "baseline", number) for number in range(3)]
    for row in work.rows(items, "toy", "baseline"):
        trial = work.trial(row.item)
        assert row.path == path_text(np.asarray(trial.path, np.int32))
        assert (row.status, row.decisions) == (trial.status, len(trial.decisions))
        assert not row.status & Status.SUBGOAL_OVERFLOW
        most = max(most, _most(trial))
    assert most > 1
