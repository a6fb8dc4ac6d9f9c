"""Drives of a policy, for collecting the states that a planner meets: of the baseline, or of PO-TLP with an estimator.

An estimator that learned from a wandering robot is asked about other states once it drives itself; data of its own
drives mend that (Ross, Gordon and Bagnell, A reduction of imitation learning and structured prediction to no-regret
online learning, AISTATS 2011).
"""

import dataclasses
from collections.abc import Iterable, Iterator, Sequence

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from potlp_jax.learning.estimator import TrainedEstimator
from potlp_jax.learning.questions import LARGEST
from potlp_jax.learning.scenes import Pose
from potlp_jax.planning.estimates import Estimator
from potlp_jax.planning.policies import Policy
from potlp_jax.task.task import Task
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial
from potlp_jax.world.grid import World
from potlp_jax.world.moves import step_lengths


def policy_drives(
    world: World,
    tasks: Sequence[Task],
    policy: Policy,
    estimator: TrainedEstimator | Estimator | None,
    config: TrialConfig,
    key: PRNGKeyArray,
) -> Iterator[Iterable[Pose]]:
    """Drives from the world's start, one for each task.

    Args:
        world: the true map.
        tasks: over the world's propositions.
        policy: who drives.
        estimator: what it asks, if anything.
        config: settings of the drives.
        key: of the planner.

    Returns:
        The poses of each drive, in order: where the policy decided.
    """
    # Padded to one size for all tasks: what is compiled for one serves the others.
    sizes = dataclasses.replace(LARGEST, propositions=len(world.propositions))
    for number, task in enumerate(tasks):
        trial = run_trial(
            world,
            task,
            policy,
            config=config,
            arrays=task.padded(sizes),
            estimator=estimator,
            key=jax.random.fold_in(key, number),
        )
        travelled = np.cumsum([0.0, *step_lengths(trial.path)]).tolist()
        befores = [0, *(decision.step for decision in trial.decisions)]
        yield [
            Pose(
                belief=trial.belief_of(decision),
                cell=decision.cell,
                step=decision.step,
                travelled=travelled[decision.step],
                way=trial.path[before + 1 : decision.step],
            )
            for before, decision in zip(befores, trial.decisions, strict=False)
        ]
