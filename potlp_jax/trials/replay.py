"""Decisions of recorded trials, made again: from the world, the beliefs and the panoramas that the record implies."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int32, UInt8

from potlp_jax.codec import config_from_dict
from potlp_jax.errors import EstimatorError, RecordError
from potlp_jax.learning.estimator import TrainedEstimator, identity_of, observe_panorama, shipped_estimators
from potlp_jax.learning.labels import TrueMapEstimator
from potlp_jax.planning.estimates import Estimator, ask
from potlp_jax.planning.policies import Policy
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.api import search_tree
from potlp_jax.planning.search.graph import Tree
from potlp_jax.planning.search.plan import Plan
from potlp_jax.planning.search.uct import UctTree
from potlp_jax.planning.situation import DecisionConfig, assess, planning_problem
from potlp_jax.task.task import Task, TaskArrays
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.record import LOG_PREFIX, Decision, Trial
from potlp_jax.trials.robot import photograph
from potlp_jax.trials.rules import asked_of
from potlp_jax.world.camera import Disturbance
from potlp_jax.world.grid import BeliefMap


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
        RecordError: the trial has no such decision, or its policy does not search.
        EstimatorError: the estimator is not the trial's.
    """
    if not 0 <= index < len(trial.decisions):
        raise RecordError(f"the trial has decisions 0 to {len(trial.decisions) - 1}; there is no decision {index}")
    # A policy of the user's own is known by its name alone: what it searches, if anything, cannot be searched again.
    if trial.policy not in (Policy.ORACLE, Policy.POTLP):
        raise RecordError(f"policy {trial.policy!r} does not search: its decisions have no tree")
    decision = trial.decisions[index]
    # From the automaton in the record: formulas need Spot, and a record is read without it.
    task = Task.from_hoa(trial.task_hoa, propositions=trial.propositions)
    config = config_from_dict(TrialConfig, trial.config, "trial record")
    problem = _replayed_problem(
        trial.belief_at(decision.step),
        jnp.asarray(decision.cell, jnp.int32),
        jnp.int32(decision.state),
        task.arrays,
        _replayed_estimator(trial, index, estimator, config),
        config.decision,
    )
    # The decision's own key: no need to know how it came from the trial's.
    key = jax.random.wrap_key_data(jnp.asarray(decision.key, jnp.uint32))
    plan, tree = search_tree(problem, key, config.decision.search)
    return problem, plan, tree


def _replayed_estimator(
    trial: Trial, index: int, estimator: TrainedEstimator | Estimator | None, config: TrialConfig
) -> Estimator | None:
    """The estimator with all that it had seen at a decision: the panoramas are taken again."""
    if trial.policy != Policy.POTLP:
        return TrueMapEstimator(world=trial.world)
    given = _estimator_of_record(trial, asked_of(Policy.POTLP, estimator))
    if not isinstance(given, TrainedEstimator):
        # A function of the belief alone: it has seen nothing that would have to be seen again.
        return given
    asked = given.start(*trial.world.shape, config.panoramas)
    # The decision's own panorama included: it is taken before the decision.
    for decision in trial.decisions[: index + 1]:
        cell = jnp.asarray(decision.cell, jnp.int32)
        asked = observe_panorama(asked, panorama_at(trial, decision, config), trial.belief_at(decision.step), cell)
    return asked


def _estimator_of_record(trial: Trial, given: TrainedEstimator | Estimator | None) -> TrainedEstimator | Estimator:
    """The estimator that a trial was made with: the one given, or a shipped one. Raises EstimatorError for another."""
    made_with = trial.versions.get("estimator")
    # Another estimator would answer otherwise, and the replay would explain a decision that was never taken.
    candidates = shipped_estimators() if given is None else (given,)
    for estimator in candidates:
        if identity_of(estimator) == made_with:
            return estimator
    wrong = "which is not one of those that are shipped" if given is None else f"not {identity_of(given)}"
    raise EstimatorError(f"the trial was made with the estimator {made_with}, {wrong}: give that one")


def panorama_at(trial: Trial, decision: Decision, config: TrialConfig | None = None) -> UInt8[Array, "rows columns 3"]:
    """What the camera saw at a decision of a trial in simulation.

    Args:
        trial: from ``run_trial`` or ``load_trial``.
        decision: one of the trial's.
        config: the trial's; read from its record where it is None.

    Returns:
        The panorama, in the frame of the map.

    Raises:
        RecordError: the trial is from a log, or its camera was disturbed.
    """
    if trial.environment.startswith(LOG_PREFIX):
        raise RecordError(
            f"the trial is the replay of a robot's log, {trial.environment.removeprefix(LOG_PREFIX)}: its panoramas "
            "are in the log, and in the page that `potlp log replay` wrote"
        )
    config = config_from_dict(TrialConfig, trial.config, "trial record") if config is None else config
    # The record does not hold the sensors' key.
    if config.disturbance != Disturbance():
        raise RecordError("the trial's camera was disturbed: its panoramas cannot be made without the trial's key")
    cell = jnp.asarray(decision.cell, jnp.int32)
    return photograph(trial.world, cell, jax.random.key(0), config.camera, config.disturbance)


def panoramas_of(trial: Trial) -> dict[int, UInt8[np.ndarray, "rows columns 3"]]:
    """What the camera saw at the decisions whose panoramas were used, by number; none where a policy takes none."""
    # Several subgoals, and several decisions, share a panorama: each is rendered once.
    numbers = sorted({number for decision in trial.decisions for number in decision.observations})
    return {number: np.asarray(panorama_at(trial, trial.decisions[number])) for number in numbers}


# Compiled like the decision itself, so that rounding is the same and equal plans stay equal.
@partial(jax.jit, static_argnames=("config",))
def _replayed_problem(
    belief: BeliefMap,
    cell: Int32[Array, "2"],
    state: Int32[Array, ""],
    task: TaskArrays,
    estimator: Estimator,
    config: DecisionConfig,
) -> PlanningProblem:
    situation = assess(belief, cell, state, task, config.frontiers)
    # The same two calls as in ``policies.decide``: the problem is what its search saw, bit by bit.
    estimates = ask(estimator, belief, situation.subgoals, task, state)
    return planning_problem(situation, estimates, config)
