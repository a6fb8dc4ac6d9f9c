"""Decisions of recorded trials, made again: from the world, the beliefs and the looks that the record implies."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int32, UInt8

from potlp_jax.codec import config_from_dict
from potlp_jax.errors import CheckpointError, RecordError
from potlp_jax.learning.estimator import TrainedEstimator, estimator_for, look
from potlp_jax.learning.labels import TrueMapEstimator
from potlp_jax.planning.estimates import Estimator, ask
from potlp_jax.planning.policies import DecisionConfig, Policy, assess, planning_problem
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.api import Plan, search_tree
from potlp_jax.planning.search.graph import Tree
from potlp_jax.task.task import Task, TaskArrays
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.record import LOG_PREFIX, Decision, Trial
from potlp_jax.trials.robot import photograph
from potlp_jax.world.camera import Disturbance
from potlp_jax.world.grid import BeliefMap


def replay_decision(
    trial: Trial, index: int, estimator: TrainedEstimator | None = None
) -> tuple[PlanningProblem, Plan, Tree]:
    """Search again as in decision ``index`` of a recorded trial: its problem, plan and searched tree.

    ``estimator`` is the one of the trial, where its policy uses one; by default the shipped one.

    Raises:
        ValueError: the trial has no such decision, or its policy does not search.
        CheckpointError: the estimator is not the trial's.
    """
    if not 0 <= index < len(trial.decisions):
        raise ValueError(f"the trial has decisions 0 to {len(trial.decisions) - 1}; there is no decision {index}")
    if not Policy(trial.policy).searches:
        raise ValueError(f"policy {trial.policy!r} does not search: its decisions have no tree")
    decision = trial.decisions[index]
    task = Task.from_hoa(trial.task_hoa, propositions=trial.propositions)
    config = config_from_dict(TrialConfig, trial.config, "trial record")
    problem = _replayed_problem(
        trial.belief_at(decision.step),
        jnp.asarray(decision.cell, jnp.int32),
        jnp.int32(decision.state),
        task.arrays,
        _replayed_estimator(trial, index, task, estimator, config),
        config.decision,
    )
    key = jax.random.wrap_key_data(jnp.asarray(decision.key, jnp.uint32))
    plan, tree = search_tree(problem, key, config.decision.search)
    return problem, plan, tree


def _replayed_estimator(
    trial: Trial, index: int, task: Task, estimator: TrainedEstimator | None, config: TrialConfig
) -> Estimator | None:
    """The estimator with all that it had seen at a decision: the looks are taken again."""
    if trial.policy != Policy.POTLP:
        return TrueMapEstimator(world=trial.world)
    trained = estimator_for(task.propositions, estimator)
    if trial.versions.get("estimator") != trained.identity:
        raise CheckpointError(
            f"the trial was made with the estimator {trial.versions.get('estimator')}, not {trained.identity}: "
            "give that one"
        )
    eyes = trained.start(*trial.world.shape)
    for decision in trial.decisions[: index + 1]:
        cell = jnp.asarray(decision.cell, jnp.int32)
        eyes = look(eyes, panorama_at(trial, decision, config), trial.belief_at(decision.step), cell)
    return eyes


def panorama_at(trial: Trial, decision: Decision, config: TrialConfig | None = None) -> UInt8[Array, "rows columns 3"]:
    """What the camera saw at a decision of a trial in simulation. Raises RecordError where the trial is from a log."""
    if trial.environment.startswith(LOG_PREFIX):
        raise RecordError(
            f"the trial is the replay of a robot's log, {trial.environment.removeprefix(LOG_PREFIX)}: its panoramas "
            "are in the log, and in the page that `potlp log replay` wrote"
        )
    config = config_from_dict(TrialConfig, trial.config, "trial record") if config is None else config
    if config.disturbance != Disturbance():
        raise ValueError("the trial's camera was disturbed: its panoramas cannot be made again without the trial's key")
    cell = jnp.asarray(decision.cell, jnp.int32)
    return photograph(trial.world, cell, jax.random.key(0), config.camera, config.disturbance)


def panoramas_of(trial: Trial) -> dict[int, UInt8[np.ndarray, "rows columns 3"]]:
    """What the camera saw at the decisions whose panoramas were used, by number; none for policies that do not look."""
    looks = sorted({look for decision in trial.decisions for look in decision.looks})
    return {look: np.asarray(panorama_at(trial, trial.decisions[look])) for look in looks}


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
    estimates = ask(estimator, belief, situation.subgoals, task, state)
    return planning_problem(situation, estimates, config)
