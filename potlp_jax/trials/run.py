"""A trial by the names that the command line uses."""

from potlp_jax.environments.base import Generator
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split, default_split
from potlp_jax.learning.estimator import TrainedEstimator, named_estimator, shipped_estimator
from potlp_jax.planning.estimates import Estimator
from potlp_jax.planning.policies import Policy, PolicyFunction
from potlp_jax.task.task import Task
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.record import Trial
from potlp_jax.trials.rules import trial_key


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
            shipped for the environment, otherwise ``baseline``.
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
        WorldError: there is no such world.
        EstimatorError: no estimator is shipped for the task.
        PropositionsError: the task, or the estimator, is over other propositions than the environment.
    """
    generator = make(environment) if isinstance(environment, str) else environment
    chosen = Split(default_split(generator.name) if split is None else split)
    return run_trial(
        generator.world(world, chosen),
        task if isinstance(task, Task) else generator.task(task),
        default_policy(generator.propositions) if policy is None else policy,
        trial_key(world, seed),
        config,
        environment=f"{environment if isinstance(environment, str) else generator.name}/{chosen}",
        world_number=world,
        estimator=named_estimator(estimator) if isinstance(estimator, str) else estimator,
    )


def default_policy(propositions: tuple[str, ...]) -> Policy:
    """PO-TLP where an estimator is shipped for the propositions, otherwise the baseline."""
    return Policy.BASELINE if shipped_estimator(propositions) is None else Policy.POTLP
