"""A trial by the names that the command line uses."""

import warnings

from potlp_jax.environments.base import Generator
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split, default_split
from potlp_jax.errors import PotlpWarning
from potlp_jax.learning.domain import Domain
from potlp_jax.learning.estimator import TrainedEstimator, named_estimator, shipped_estimator, why_none_is_shipped
from potlp_jax.planning.estimates import Estimator
from potlp_jax.planning.policies import Policy, PolicyFunction
from potlp_jax.task.task import Task
from potlp_jax.trials.config import TrialConfig, trial_config_for
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.record import Trial
from potlp_jax.trials.rules import trial_key
from potlp_jax.world.grid import World


def run(
    environment: str | Generator,
    task: str | int | Task = 1,
    policy: Policy | PolicyFunction | str | None = None,
    world: int = 0,
    *,
    split: Split | str | None = None,
    config: TrialConfig | None = None,
    estimator: TrainedEstimator | Estimator | str | None = None,
    seed: int = 0,
) -> Trial:
    """One trial, as ``potlp run ENVIRONMENT --task TASK --policy POLICY --world WORLD`` makes it.

    Args:
        environment: a name that ``make`` knows, or a generator.
        task: number of one of the environment's tasks, a formula over its propositions, or a task.
        policy: a name or a function (``planning.policies.named_policy``); default: ``potlp`` where an estimator is
            given, or shipped for such worlds, otherwise ``baseline``, with a ``PotlpWarning`` that says why.
        world: number of the world in the split.
        split: default: that of the command line, ``validation`` (``test`` for real buildings).
        config: default: what the environment calls for.
        estimator: what the policy ``potlp``, or a function, asks: an estimator, or the name of one
            (``learning.estimator.named_estimator``); default: the shipped one.
        seed: of the trial's key, not of the world.

    Returns:
        The trial, finished: ``outcome``, ``cost``, ``path`` and every decision. The same arguments give the same one.

    Raises:
        PluginError: there is no such environment, policy or estimator.
        TaskError: there is no such task.
        WorldError: there is no such world, or no such split.
        EstimatorError: no estimator is shipped for the task in such worlds.
        PropositionsError: the task, or the estimator, is over other propositions than the environment.
    """
    generator = make(environment) if isinstance(environment, str) else environment
    chosen = Split(default_split(generator.name) if split is None else split)
    made = generator.world(world, chosen)
    asked = named_estimator(estimator) if isinstance(estimator, str) else estimator
    return run_trial(
        made,
        task if isinstance(task, Task) else generator.task(task),
        _policy_with_warning(made, config, asked) if policy is None else policy,
        trial_key(world, seed),
        config,
        environment=f"{environment if isinstance(environment, str) else generator.name}/{chosen}",
        world_number=world,
        estimator=asked,
    )


def _policy_with_warning(
    world: World, config: TrialConfig | None, given: TrainedEstimator | Estimator | None
) -> Policy:
    """The default policy; that it is not PO-TLP is a warning that says why."""
    policy = default_policy(world, config, given)
    if policy is not Policy.POTLP:
        warnings.warn(
            f"{reason_for_baseline(world, config)}: the policy is {policy}; give policy=, or estimator=",
            PotlpWarning,
            stacklevel=3,
        )
    return policy


def reason_for_baseline(world: World, config: TrialConfig | None = None) -> str:
    """Why no estimator is shipped for such a world and camera, in words."""
    config = trial_config_for(world) if config is None else config
    return why_none_is_shipped(world.propositions, Domain.of_world(world, config.camera))


def default_policy(
    world: World, config: TrialConfig | None = None, given: TrainedEstimator | Estimator | None = None
) -> Policy:
    """PO-TLP where an estimator is given, or shipped for such a world and camera; otherwise the baseline.

    Args:
        world: where the trial is run.
        config: with its camera; None: as such worlds want it.
        given: the estimator that the user named.

    Returns:
        One of the two policies.
    """
    config = trial_config_for(world) if config is None else config
    here = Domain.of_world(world, config.camera)
    is_shipped = shipped_estimator(world.propositions, here) is not None
    return Policy.POTLP if given is not None or is_shipped else Policy.BASELINE
