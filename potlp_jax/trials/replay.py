"""Decisions of recorded trials, made again: from the world, the beliefs and the panoramas that the record implies."""

import dataclasses
import functools
import logging
from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int32, UInt8

from potlp_jax.codec import config_from_dict
from potlp_jax.compiling import jit_by_class
from potlp_jax.errors import EstimatorError, RecordError
from potlp_jax.learning.estimator import TrainedEstimator, identity_of, shipped_estimators
from potlp_jax.learning.labels import TrueMapEstimator
from potlp_jax.learning.observing import (
    ObservingEstimator,
    look_step,
    looks_between,
    looks_on_the_way,
    observe_panorama,
)
from potlp_jax.learning.overlays import Overlay, ShowsOverlays, overlays_of
from potlp_jax.planning.estimates import Estimator, ask
from potlp_jax.planning.policies import Policy
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.api import search_tree
from potlp_jax.planning.search.graph import Tree
from potlp_jax.planning.search.plan import Plan
from potlp_jax.planning.search.uct import UctTree
from potlp_jax.planning.situation import DecisionConfig, assess, planning_problem
from potlp_jax.precision import in_32_bits
from potlp_jax.task.task import Task, TaskArrays
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.record import LOG_PREFIX, ROBOT_PREFIX, Decision, Trial
from potlp_jax.trials.robot import photograph
from potlp_jax.trials.rules import asked_of, first_estimator
from potlp_jax.world.camera import Disturbance
from potlp_jax.world.grid import BeliefMap

logger = logging.getLogger(__name__)

Panorama = UInt8[np.ndarray, "rows columns 3"]

PanoramaOfStep = Callable[[int], UInt8[Array, "rows columns 3"] | Panorama | None]
"""What the camera saw after so many cells entered; None where there is no picture."""


@dataclasses.dataclass(frozen=True)
class Views:
    """What the robot saw and what it made of it, by the number of the decision.

    Attributes:
        panoramas: those that decisions used, in the frame of the map.
        overlays: what the estimator shows, of the map's shape; empty where it has nothing to show.
    """

    panoramas: Mapping[int, Panorama] = dataclasses.field(default_factory=dict)
    overlays: Mapping[int, tuple[Overlay, ...]] = dataclasses.field(default_factory=dict)


@in_32_bits
def replay_decision(
    trial: Trial, index: int, estimator: TrainedEstimator | Estimator | None = None
) -> tuple[PlanningProblem, Plan, Tree | UctTree]:
    """Search again as in one decision of a recorded trial.

    Args:
        trial: from ``run_trial`` or ``load_trial``.
        index: number of the decision.
        estimator: the one of the trial, where its policy asks one; by default the shipped one that it names.

    Returns:
        The planning problem of the decision, its plan and the searched tree.

    Raises:
        RecordError: the trial has no such decision, its policy does not search, its settings are not those that it
            was made with, or it asked what is not in the record (``estimator_at``).
        EstimatorError: the estimator is not the trial's.
    """
    if not 0 <= index < len(trial.decisions):
        raise RecordError(f"the trial has decisions 0 to {len(trial.decisions) - 1}; there is no decision {index}")
    # A policy of the user's own is known by its name alone: what it searches, if anything, cannot be searched again.
    if trial.policy not in (Policy.ORACLE, Policy.POTLP):
        raise RecordError(f"policy {trial.policy!r} does not search: its decisions have no tree")
    decision = trial.decisions[index]
    # From the automaton in the record: formulas need Spot, and a record is read without it.
    task = Task.from_hoa(trial.task_hoa, trial.propositions, trial.max_positive_literals)
    config = _decision_config_at(trial, index)
    problem = _replayed_problem(
        trial.planned_on(decision),
        jnp.asarray(decision.cell, jnp.int32),
        jnp.int32(decision.state),
        task.arrays,
        estimator_at(trial, index, estimator),
        config,
    )
    # The decision's own key: no need to know how it came from the trial's.
    if len(decision.key) != 2:
        raise RecordError(f"the decision's key has {len(decision.key)} words: keys of threefry2x32 alone are read")
    key = jax.random.wrap_key_data(jnp.asarray(decision.key, jnp.uint32), impl="threefry2x32")
    plan, tree = search_tree(problem, key, config.search)
    return problem, plan, tree


def _decision_config_at(trial: Trial, index: int) -> DecisionConfig:
    """What a decision of a trial was made with: the array of subgoals may have grown until then."""
    config = config_from_dict(TrialConfig, trial.config, "trial record").decision
    # An array that has grown stays long, so that the largest number up to here tells its length.
    most = max(len(decision.subgoals) for decision in trial.decisions[: index + 1])
    while config.frontiers.max_subgoals < most:
        grown = config.grown()
        if grown is None:
            raise RecordError(f"a decision has {most} subgoals, more than the trial's settings allow")
        config = grown
    return config


@in_32_bits
def estimator_at(trial: Trial, index: int, estimator: TrainedEstimator | Estimator | None = None) -> Estimator | None:
    """What a decision of the policies ``oracle`` and ``potlp`` asked, with all that it had seen.

    Args:
        trial: from ``run_trial`` or ``load_trial``.
        index: number of the decision.
        estimator: as in ``replay_decision``.

    Returns:
        A pytree that can be called inside jit.

    Raises:
        EstimatorError: the estimator is not the trial's.
        RecordError: its panoramas cannot be made again (``panorama_at``), or the policy is ``oracle`` and a robot
            drove, whose record does not hold the true map.
    """
    if trial.policy != Policy.POTLP:
        # The record's world is the map that the robot knew at the end: its answers would be others.
        if trial.environment.startswith(ROBOT_PREFIX):
            raise RecordError("the oracle asked the true map, which is not in the record of a robot's drive")
        return TrueMapEstimator(world=trial.world)
    given = asked_of(Policy.POTLP, estimator)
    found = _estimator_of_record(trial, given)
    if found is None:
        made_with = trial.versions.get("estimator")
        wrong = "which is not one of those that are shipped" if given is None else f"not {identity_of(given)}"
        raise EstimatorError(f"the trial was made with the estimator {made_with}, {wrong}: give that one")
    config = config_from_dict(TrialConfig, trial.config, "trial record")
    asked = _first(trial, found, config)
    # The decision's own panorama included: it is taken before the decision.
    for decision in trial.decisions[: index + 1]:
        asked = _after_looking(asked, trial, decision, config, lambda step: _panorama_of_step(trial, step, config))
    return asked


def _first(trial: Trial, estimator: TrainedEstimator | Estimator, config: TrialConfig) -> Estimator | None:
    """What a trial's first decision asked, nothing seen yet."""
    return first_estimator(
        Policy.POTLP, estimator, trial.world.shape, float(trial.world.resolution), config.panoramas, None
    )


def _after_looking(
    asked: Estimator | None,
    trial: Trial,
    decision: Decision,
    config: TrialConfig,
    panorama_of: PanoramaOfStep,
) -> Estimator | None:
    """The estimator after the panoramas up to a decision from the one before; one that forgets has seen nothing."""
    if not isinstance(asked, ObservingEstimator):
        return asked
    belief = trial.belief_of(decision)
    steps = [*_steps_on_the_way(trial, decision, config), decision.step] if looks_on_the_way(asked) else [decision.step]
    for step in steps:
        seen = panorama_of(step)
        if seen is not None:
            asked = observe_panorama(asked, jnp.asarray(seen), belief, jnp.asarray(trial.path[step], jnp.int32))
    return asked


def _steps_on_the_way(trial: Trial, decision: Decision, config: TrialConfig) -> list[int]:
    """After how many cells entered the camera looked on the way to a decision."""
    if decision.index == 0:
        return []
    before, every = trial.decisions[decision.index - 1].step, config.look_every
    return [look_step(before, number, every) for number in range(looks_between(before, decision.step, every))]


def _estimator_of_record(
    trial: Trial, given: TrainedEstimator | Estimator | None
) -> TrainedEstimator | Estimator | None:
    """The estimator that a trial was made with: the one given, or a shipped one; None where it is neither."""
    # Another estimator would answer otherwise, and the replay would explain a decision that was never taken.
    candidates: Sequence[TrainedEstimator | Estimator] = shipped_estimators() if given is None else (given,)
    made_with = trial.versions.get("estimator")
    return next((estimator for estimator in candidates if identity_of(estimator) == made_with), None)


def panorama_at(trial: Trial, decision: Decision, config: TrialConfig | None = None) -> UInt8[Array, "rows columns 3"]:
    """What the camera saw at a decision of a trial in simulation.

    Args:
        trial: from ``run_trial`` or ``load_trial``.
        decision: one of the trial's.
        config: the trial's; read from its record where it is None.

    Returns:
        The panorama, in the frame of the map.

    Raises:
        RecordError: the trial is from a log or a robot, or its camera was disturbed.
    """
    config = config_from_dict(TrialConfig, trial.config, "trial record") if config is None else config
    return _panorama_of_step(trial, decision.step, config)


def _panorama_of_step(trial: Trial, step: int, config: TrialConfig) -> UInt8[Array, "rows columns 3"]:
    if trial.environment.startswith(ROBOT_PREFIX):
        raise RecordError("a robot drove the trial: what its camera saw is not in the record")
    if trial.environment.startswith(LOG_PREFIX):
        raise RecordError(
            f"the trial is the replay of a robot's log, {trial.environment.removeprefix(LOG_PREFIX)}: its panoramas "
            "are in the log, and in the page that `potlp log replay` wrote"
        )
    # The record does not hold the sensors' key.
    if config.disturbance != Disturbance():
        raise RecordError("the trial's camera was disturbed: its panoramas cannot be made without the trial's key")
    cell = jnp.asarray(trial.path[step], jnp.int32)
    return photograph(trial.world, cell, jax.random.key(0), config.camera, config.disturbance)


@in_32_bits
def views_of(trial: Trial, estimator: TrainedEstimator | Estimator | None = None) -> Views:
    """The panoramas of a trial in simulation, and what its estimator has to show, made again.

    Args:
        trial: from ``run_trial`` or ``load_trial``.
        estimator: the one of the trial, where its policy asks one; by default the shipped one that it names. What an
            estimator shows that is neither is left out, with a warning in the log.

    Returns:
        The views; empty where the policy takes no panoramas, and where a robot drove, whose pictures nobody kept.

    Raises:
        RecordError: the panoramas cannot be made again (``panorama_at``).
    """
    if trial.environment.startswith(ROBOT_PREFIX):
        return Views()
    config = config_from_dict(TrialConfig, trial.config, "trial record")
    made_with = trial.versions.get("estimator")
    # Policies of the user's own may ask one too, which the record tells and the policy's name does not.
    asked = None if made_with is None else _estimator_of_record(trial, asked_of(Policy.POTLP, estimator))
    if made_with is not None and asked is None:
        logger.warning(f"the trial was made with the estimator {made_with}: give that one to see what it shows")
    return recall_views(trial, asked, config, lambda step: _panorama_of_step(trial, step, config))


@in_32_bits
def recall_views(
    trial: Trial,
    asked: TrainedEstimator | Estimator | None,
    config: TrialConfig,
    panorama_of: PanoramaOfStep,
) -> Views:
    """The views of a trial, its estimator shown every panorama once more.

    Args:
        trial: a trial in simulation, or along a log.
        asked: the trial's estimator; None where there is none, or it is not known.
        config: the trial's.
        panorama_of: what the camera saw after so many cells entered. Asked in their order; of steps between two
            decisions there may be none.

    Returns:
        The panoramas that were used and the overlays of the estimator, one entry for each decision, if it has any.
    """

    # Several subgoals, and several decisions, share a panorama: each is rendered once.
    @functools.cache
    def look(step: int) -> Panorama:
        return np.asarray(panorama_of(step))

    steps = {decision.step for decision in trial.decisions}

    estimator = None if asked is None else _first(trial, asked, config)
    # One that does not say from which panorama it judges a subgoal has seen that of the decision.
    own = isinstance(estimator, ObservingEstimator)
    used = [decision.observations or ((decision.index,) if own else ()) for decision in trial.decisions]
    overlays = {}
    if isinstance(estimator, ShowsOverlays):
        for decision in trial.decisions:
            # Those of the way are seen once, and there are many.
            estimator = _after_looking(
                estimator, trial, decision, config, lambda at: look(at) if at in steps else panorama_of(at)
            )
            overlays[decision.index] = overlays_of(estimator, trial.belief_of(decision))
    numbers = sorted({number for numbers in used for number in numbers})
    return Views({number: look(trial.decisions[number].step) for number in numbers}, overlays)


# Compiled like the decision itself, so that rounding is the same and equal plans stay equal.
@functools.partial(jit_by_class, static_argnames=("config",))
def _replayed_problem(
    belief: BeliefMap,
    cell: Int32[Array, "2"],
    state: Int32[Array, ""],
    task: TaskArrays,
    estimator: Estimator,
    config: DecisionConfig,
) -> PlanningProblem:
    situation = assess(belief, cell, state, task, config.frontiers, config.irrevocable_last)
    # The same two calls as in ``policies.decide``: the problem is what its search saw, bit by bit.
    estimates = ask(estimator, belief, situation.subgoals, task, state)
    return planning_problem(situation, estimates, config)
