"""Batches of trials: each trial as if it ran alone, whatever runs beside it, and one compilation for all."""

import dataclasses

import jax
import numpy as np
import pytest

from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.errors import BatchError, EstimatorError
from potlp_jax.learning.estimator import TrainedEstimator
from potlp_jax.learning.network import EstimatorNetwork, NetworkConfig
from potlp_jax.native import twin_only
from potlp_jax.planning.policies import Policy
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.planning.situation import DecisionConfig
from potlp_jax.task.task import Task
from potlp_jax.trials import batch
from potlp_jax.trials.batch import Start, run_batch
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.record import Outcome
from potlp_jax.trials.slots import LOCKSTEP
from potlp_jax.world.frontiers import FrontierConfig
from potlp_jax.world.grid import pad_world
from potlp_jax.world.sensing import SensorConfig
from tests.reference.domains import domain_of

TOY = make("toy")
TASKS = [Task.from_formula(text, propositions=TOY.propositions) for text in TOY.tasks.values()]
SIZES = TASKS[0].sizes.union(TASKS[-1].sizes)
CONFIG = TrialConfig(
    sensor=SensorConfig(range_cells=5.0),
    decision=DecisionConfig(frontiers=FrontierConfig(max_subgoals=4), search=BestFirstConfig(simulations=50)),
)


def _untrained():
    config = NetworkConfig(
        propositions=TOY.propositions, first_widths=(4,) * 4, second_widths=(4,) * 8, dense_widths=(8,) * 4, fovea=3
    )
    params = EstimatorNetwork(config).init(jax.random.key(0))
    return TrainedEstimator(
        params=params, config=config, domain=domain_of("toy"), metadata={}, name="untrained", digest=""
    )


UNTRAINED = _untrained()


def _starts(count):
    for number in range(count):
        world = TOY.generate(world_key(Split.VALIDATION, number, TOY.name))
        task = TASKS[number % len(TASKS)]
        yield Start(world, task.padded(SIZES), jax.random.key(number), name=(number, task))


def _figures(finished):
    return {
        trial.name[0]: (trial.outcome, trial.cost, trial.path.tolist(), trial.decisions, trial.fallbacks, trial.status)
        for trial in finished
    }


@pytest.fixture(scope="module", params=[Policy.BASELINE, Policy.POTLP])
def ran(request):
    """A policy and seven trials in three slots: slots are filled again, and in the end stay empty."""
    starts = list(_starts(7))
    before = batch._run_until_one_ends._cache_size()
    finished = list(run_batch(starts, request.param, CONFIG, slots=3, estimator=UNTRAINED))
    return request.param, starts, finished, batch._run_until_one_ends._cache_size() - before


@pytest.mark.long
def test_every_trial_is_what_it_is_alone(ran):
    policy, starts, finished, _ = ran
    assert len(finished) == len(starts)
    alone, kept = {}, 0
    for start in starts:
        number, task = start.name
        trial = run_trial(start.world, task, policy, start.key, CONFIG, arrays=start.arrays, estimator=UNTRAINED)
        fallbacks = sum(decision.fallback for decision in trial.decisions)
        kept += sum(decision.overruled is not None for decision in trial.decisions)
        path = [list(cell) for cell in trial.path]
        alone[number] = (trial.outcome, trial.cost, path, len(trial.decisions), fallbacks, trial.status)
    assert _figures(finished) == alone
    assert len({entry[3] for entry in alone.values()}) > 1
    # The way on is remembered from decision to decision, and not in vain.
    assert kept > 0 or not policy.searches


@pytest.mark.long
@pytest.mark.parametrize("policy", [Policy.OPTIMISTIC, Policy.ORACLE, Policy.POTLP])
def test_lockstep_without_native_kernels_is_slot_by_slot_with_them(policy, monkeypatch):
    # What accelerators run, against what CPUs run.
    expected = _figures(run_batch(_starts(5), policy, CONFIG, slots=3, estimator=UNTRAINED))
    monkeypatch.setenv(LOCKSTEP, "1")
    with twin_only():
        found = _figures(run_batch(_starts(5), policy, CONFIG, slots=3, estimator=UNTRAINED))
    assert found == expected
    assert len({entry[3] for entry in found.values()}) > 1


def test_neither_neighbours_nor_order_change_a_trial(ran):
    policy, starts, finished, _ = ran
    backwards = run_batch(reversed(starts[2:]), policy, CONFIG, slots=3, estimator=UNTRAINED)
    expected = _figures(finished)
    assert _figures(backwards) == {number: expected[number] for number in range(2, 7)}


def test_a_whole_batch_is_one_compilation(ran):
    assert ran[3] == 1


def test_the_next_trial_is_asked_for_when_a_slot_is_free():
    asked = []

    def starts():
        for start in _starts(6):
            asked.append(start.name[0])
            yield start

    running = run_batch(starts(), Policy.BASELINE, CONFIG, slots=3)
    next(running)
    assert asked == [0, 1, 2]
    assert len(list(running)) == 5
    assert asked == list(range(6))


def test_a_trial_that_is_over_before_it_begins_ends_without_a_decision():
    (first,) = _starts(1)
    task = Task.from_formula("!goal", propositions=TOY.propositions)
    over = dataclasses.replace(first, arrays=task.padded(SIZES))
    (trial,) = run_batch([over], Policy.BASELINE, CONFIG, slots=3)
    assert (trial.outcome, trial.cost, trial.decisions) == (Outcome.SATISFIED, 0.0, 0)
    assert trial.path.tolist() == [np.asarray(first.world.start).tolist()]


def test_no_trials_give_nothing():
    assert list(run_batch([], Policy.BASELINE, CONFIG)) == []


def test_what_does_not_fit_is_named():
    first, second = _starts(2)
    height, width = second.world.shape
    large = dataclasses.replace(second, world=pad_world(second.world, height + 1, width), name="large")
    with pytest.raises(BatchError, match=r"'large': its world has an array of shape .*pad worlds"):
        list(run_batch([first, large], Policy.BASELINE, CONFIG, slots=3))
    finer = dataclasses.replace(second.world, resolution=second.world.resolution / 2)
    with pytest.raises(BatchError, match=r"'finer': its world has the resolution 0.5, the first of the batch 1.0"):
        list(run_batch([first, dataclasses.replace(second, world=finer, name="finer")], Policy.BASELINE, CONFIG))
    with pytest.raises(BatchError, match="slots is 0"):
        list(run_batch([first], Policy.BASELINE, CONFIG, slots=0))
    with pytest.raises(EstimatorError, match="no estimator is shipped for the propositions goal"):
        list(run_batch([first], Policy.POTLP, CONFIG))
