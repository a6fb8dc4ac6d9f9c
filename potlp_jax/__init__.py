"""Plan for temporal-logic tasks in buildings never seen before: PO-TLP, JAX-native and batched.

``__all__`` lists the public names by use: a task, a world and what is known of it, planning, whole trials. They are
imported on first use, so that ``import potlp_jax`` itself takes milliseconds and loads no JAX.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    # What type checkers and editors see; ``_MODULES`` says the same at run time.
    from potlp_jax.environments.base import Generator as Generator
    from potlp_jax.environments.base import host_generators as host_generators
    from potlp_jax.environments.registry import make as make
    from potlp_jax.environments.splits import Split as Split
    from potlp_jax.environments.splits import world_key as world_key
    from potlp_jax.errors import PotlpError as PotlpError
    from potlp_jax.errors import ProblemTooLargeError as ProblemTooLargeError
    from potlp_jax.errors import TaskError as TaskError
    from potlp_jax.errors import WorldError as WorldError
    from potlp_jax.planning.commitment import Intention as Intention
    from potlp_jax.planning.decision import decide_from_estimates as decide_from_estimates
    from potlp_jax.planning.decision import frontier_subgoals as frontier_subgoals
    from potlp_jax.planning.distances.product import product_distances as product_distances
    from potlp_jax.planning.distances.product import product_transitions as product_transitions
    from potlp_jax.planning.estimates import Estimates as Estimates
    from potlp_jax.planning.exact.api import Bounds as Bounds
    from potlp_jax.planning.exact.api import bound_exact as bound_exact
    from potlp_jax.planning.exact.api import solve_exact as solve_exact
    from potlp_jax.planning.move import move_to as move_to
    from potlp_jax.planning.policies import Policy as Policy
    from potlp_jax.planning.policies import PolicyFunction as PolicyFunction
    from potlp_jax.planning.policies import decide as decide
    from potlp_jax.planning.problem import PlanningProblem as PlanningProblem
    from potlp_jax.planning.problem import enumerate_actions as enumerate_actions
    from potlp_jax.planning.search.api import plan_actions as plan_actions
    from potlp_jax.planning.search.config import BestFirstConfig as BestFirstConfig
    from potlp_jax.planning.search.config import UctConfig as UctConfig
    from potlp_jax.planning.search.plan import Plan as Plan
    from potlp_jax.planning.situation import DecisionConfig as DecisionConfig
    from potlp_jax.rl.episodes import TaskEnv as TaskEnv
    from potlp_jax.task.task import Task as Task
    from potlp_jax.task.task import TaskArrays as TaskArrays
    from potlp_jax.task.task import TaskSizes as TaskSizes
    from potlp_jax.task.task import stack_tasks as stack_tasks
    from potlp_jax.trials.batch import Finished as Finished
    from potlp_jax.trials.batch import Start as Start
    from potlp_jax.trials.batch import run_batch as run_batch
    from potlp_jax.trials.config import TrialConfig as TrialConfig
    from potlp_jax.trials.config import trial_config_for as trial_config_for
    from potlp_jax.trials.live import run_robot as run_robot
    from potlp_jax.trials.loop import run_trial as run_trial
    from potlp_jax.trials.record import Outcome as Outcome
    from potlp_jax.trials.record import RunRecord as RunRecord
    from potlp_jax.trials.record import Trial as Trial
    from potlp_jax.trials.record import load_trial as load_trial
    from potlp_jax.trials.robot import Leg as Leg
    from potlp_jax.trials.robot import Robot as Robot
    from potlp_jax.trials.rules import Stop as Stop
    from potlp_jax.trials.run import run as run
    from potlp_jax.types import NO_ACTION as NO_ACTION
    from potlp_jax.types import Status as Status
    from potlp_jax.verify.audit import problems_of as problems_of
    from potlp_jax.verify.audit import problems_of_path as problems_of_path
    from potlp_jax.world.frontiers import FrontierConfig as FrontierConfig
    from potlp_jax.world.frontiers import Subgoals as Subgoals
    from potlp_jax.world.frontiers import find_subgoals as find_subgoals
    from potlp_jax.world.grid import BeliefMap as BeliefMap
    from potlp_jax.world.grid import World as World
    from potlp_jax.world.grid import belief_from_numpy as belief_from_numpy
    from potlp_jax.world.grid import make_world as make_world
    from potlp_jax.world.sensing import SensorConfig as SensorConfig
    from potlp_jax.world.sensing import observe as observe

    __version__: str

__all__ = [  # noqa: RUF022 - by use, not by the alphabet
    # A task: from a formula to arrays.
    "Task",
    "TaskArrays",
    "TaskSizes",
    "stack_tasks",
    # A world, and what is known of it.
    "make",
    "Generator",
    "host_generators",
    "Split",
    "world_key",
    "World",
    "make_world",
    "BeliefMap",
    "belief_from_numpy",
    "SensorConfig",
    "observe",
    "FrontierConfig",
    "Subgoals",
    "find_subgoals",
    # Planning: one decision.
    "product_transitions",
    "product_distances",
    "frontier_subgoals",
    "Estimates",
    "decide_from_estimates",
    "DecisionConfig",
    "Intention",
    "Policy",
    "PolicyFunction",
    "move_to",
    "decide",
    "PlanningProblem",
    "enumerate_actions",
    "BestFirstConfig",
    "UctConfig",
    "Plan",
    "plan_actions",
    "Bounds",
    "bound_exact",
    "solve_exact",
    # Whole trials, one or many.
    "run",
    "TrialConfig",
    "trial_config_for",
    "run_trial",
    "run_robot",
    "RunRecord",
    "Trial",
    "Outcome",
    "load_trial",
    "Robot",
    "Leg",
    "Stop",
    "Start",
    "Finished",
    "run_batch",
    "TaskEnv",
    # An auditor that shares no code with the planner.
    "problems_of",
    "problems_of_path",
    # Sentinels, flags and errors.
    "NO_ACTION",
    "Status",
    "PotlpError",
    "ProblemTooLargeError",
    "TaskError",
    "WorldError",
    "__version__",
]

_MODULES: dict[str, tuple[str, ...]] = {
    "environments.base": ("Generator", "host_generators"),
    "environments.registry": ("make",),
    "environments.splits": ("Split", "world_key"),
    "errors": ("PotlpError", "ProblemTooLargeError", "TaskError", "WorldError"),
    "planning.commitment": ("Intention",),
    "planning.decision": ("decide_from_estimates", "frontier_subgoals"),
    "planning.distances.product": ("product_distances", "product_transitions"),
    "planning.estimates": ("Estimates",),
    "planning.exact.api": ("Bounds", "bound_exact", "solve_exact"),
    "planning.move": ("move_to",),
    "planning.policies": ("Policy", "PolicyFunction", "decide"),
    "planning.problem": ("PlanningProblem", "enumerate_actions"),
    "planning.situation": ("DecisionConfig",),
    "planning.search.api": ("plan_actions",),
    "planning.search.config": ("BestFirstConfig", "UctConfig"),
    "planning.search.plan": ("Plan",),
    "rl.episodes": ("TaskEnv",),
    "task.task": ("Task", "TaskArrays", "TaskSizes", "stack_tasks"),
    "trials.batch": ("Finished", "Start", "run_batch"),
    "trials.config": ("TrialConfig", "trial_config_for"),
    "trials.live": ("run_robot",),
    "trials.loop": ("run_trial",),
    "trials.record": ("Outcome", "RunRecord", "Trial", "load_trial"),
    "trials.robot": ("Leg", "Robot"),
    "trials.rules": ("Stop",),
    "trials.run": ("run",),
    "types": ("NO_ACTION", "Status"),
    "verify.audit": ("problems_of", "problems_of_path"),
    "world.frontiers": ("FrontierConfig", "Subgoals", "find_subgoals"),
    "world.grid": ("BeliefMap", "World", "belief_from_numpy", "make_world"),
    "world.sensing": ("SensorConfig", "observe"),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for (PEP 562)."""
    if name == "__version__":
        # Imported here because it takes 25 ms, which nobody should pay who does not ask.
        from importlib.metadata import version

        # From the installed package, so that the version is written in pyproject.toml alone.
        value = version("potlp-jax")
    elif name in _HOME:
        value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    # The next look-up finds it without coming here.
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names, loaded or not."""
    return sorted({*globals(), *__all__})
