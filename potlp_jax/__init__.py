"""Plan for temporal-logic tasks in buildings never seen before: PO-TLP, JAX-native and batched.

The public names, from a formula to a trial:

* a task: ``Task``, ``TaskArrays``, ``TaskError``, ``TaskSizes``, ``stack_tasks``
* a world and what is known of it: ``World``, ``make_world``, ``BeliefMap``, ``SensorConfig``, ``observe``,
  ``Subgoals``, ``FrontierConfig``, ``find_subgoals``
* planning: ``product_transitions``, ``product_distances``, ``Estimates``, ``PlanningProblem``, ``enumerate_actions``,
  ``SearchConfig``, ``Plan``, ``plan_actions``, ``solve_exact``, ``bound_exact``, ``Bounds``, ``ProblemTooLargeError``,
  ``DecisionConfig``, ``Policy``, ``decide``, ``Intention``
* whole trials: ``TrialConfig``, ``run_trial``, ``Trial``, ``Outcome``, ``load_trial``; many at once: ``run_batch``,
  ``Start``, ``Finished``
* sentinels and flags: ``NO_ACTION``, ``Status``
"""

from potlp_jax.errors import TaskError
from potlp_jax.planning.commitment import Intention
from potlp_jax.planning.distances.product import product_distances, product_transitions
from potlp_jax.planning.estimates import Estimates
from potlp_jax.planning.exact.api import Bounds, ProblemTooLargeError, bound_exact, solve_exact
from potlp_jax.planning.policies import DecisionConfig, Policy, decide
from potlp_jax.planning.problem import PlanningProblem, enumerate_actions
from potlp_jax.planning.search.api import Plan, plan_actions
from potlp_jax.planning.search.config import SearchConfig
from potlp_jax.task.task import Task, TaskArrays, TaskSizes, stack_tasks
from potlp_jax.trials.batch import Finished, Start, run_batch
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.record import Outcome, Trial, load_trial
from potlp_jax.types import NO_ACTION, Status
from potlp_jax.world.frontiers import FrontierConfig, Subgoals, find_subgoals
from potlp_jax.world.grid import BeliefMap, World, make_world
from potlp_jax.world.sensing import SensorConfig, observe

__all__ = [
    "NO_ACTION",
    "BeliefMap",
    "Bounds",
    "DecisionConfig",
    "Estimates",
    "Finished",
    "FrontierConfig",
    "Intention",
    "Outcome",
    "Plan",
    "PlanningProblem",
    "Policy",
    "ProblemTooLargeError",
    "SearchConfig",
    "SensorConfig",
    "Start",
    "Status",
    "Subgoals",
    "Task",
    "TaskArrays",
    "TaskError",
    "TaskSizes",
    "Trial",
    "TrialConfig",
    "World",
    "bound_exact",
    "decide",
    "enumerate_actions",
    "find_subgoals",
    "load_trial",
    "make_world",
    "observe",
    "plan_actions",
    "product_distances",
    "product_transitions",
    "run_batch",
    "run_trial",
    "solve_exact",
    "stack_tasks",
]
