"""A task and a world are joined by position, so by names: every place where two of them meet refuses other ones."""

import dataclasses
import json

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.environments.base import Generator
from potlp_jax.environments.toy import Toy
from potlp_jax.errors import PropositionsError, TaskError
from potlp_jax.export import FORMAT, MANIFEST, load_program
from potlp_jax.learning.estimator import TrainedEstimator, estimator_for
from potlp_jax.learning.labels import TrueMapEstimator
from potlp_jax.learning.network import EstimatorNetwork, NetworkConfig
from potlp_jax.learning.questions import question_sheet, questions_of
from potlp_jax.planning.decision import decide_from_estimates, frontier_subgoals, subgoals_at
from potlp_jax.planning.estimates import Estimates, ask
from potlp_jax.planning.policies import Policy, decide
from potlp_jax.planning.situation import DecisionConfig
from potlp_jax.recipes.exploration import Explorer
from potlp_jax.rl.episodes import TaskEnv
from potlp_jax.task.propositions import require_same_propositions
from potlp_jax.task.task import Task, stack_tasks
from potlp_jax.trials.batch import Start, run_batch
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.live import run_robot
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.robot import SimulatedRobot
from potlp_jax.trials.rules import first_tally
from potlp_jax.trials.run import run
from potlp_jax.world.frontiers import FrontierConfig
from potlp_jax.world.grid import BeliefMap, belief_from_numpy, make_world
from potlp_jax.world.sensing import SensorConfig, observe
from tests.reference.domains import domain_of

TOY = Toy()
WORLD = TOY.world(0)
BELIEF = BeliefMap.revealed(WORLD)
KEY = jax.random.key(0)
STATE = jnp.int32(0)
CONFIG = DecisionConfig(frontiers=FrontierConfig(max_subgoals=3))
RIGHT = WORLD.task("F goal")
NAMES = {
    "fewer": ("hazard",),
    "more": ("goal", "hazard", "exit"),
    "another": ("goal", "fire"),
    "order": ("hazard", "goal"),
}
WRONG = {case: Task.from_formula(f"F {names[0]}", names) for case, names in NAMES.items()}
SUBGOALS = subgoals_at(WORLD.start[None], jnp.ones(1, bool), *WORLD.shape)


def _estimates(task):
    shape = (1, len(task.classes))
    return Estimates(
        success_probability=jnp.full(shape, 0.5), success_cost=jnp.ones(shape), failure_cost=jnp.ones(shape)
    )


def _trained(propositions):
    config = NetworkConfig(
        propositions=propositions, first_widths=(4,) * 4, second_widths=(4,) * 8, dense_widths=(8,) * 4
    )
    params = EstimatorNetwork(config).init(KEY)
    return TrainedEstimator(params=params, config=config, domain=domain_of("toy"), metadata={}, name="other", digest="")


def _batch(task, **others):
    return list(run_batch([Start(WORLD, task.arrays, KEY, name="one")], "baseline", **others))


ENTRIES = {
    "run": lambda task: run(TOY, task, "baseline"),
    "run_trial": lambda task: run_trial(WORLD, task, "baseline", KEY),
    "run_trial with arrays of another task": lambda task: run_trial(WORLD, RIGHT, "baseline", KEY, arrays=task.arrays),
    "run_batch": _batch,
    "run_robot": lambda task: run_robot(SimulatedRobot(WORLD, TrialConfig()), task, "baseline", KEY),
    "first_tally": lambda task: first_tally(BELIEF, WORLD.start, task.arrays),
    "frontier_subgoals": lambda task: frontier_subgoals(BELIEF, WORLD.start, STATE, task.arrays, CONFIG),
    "decide_from_estimates": lambda task: decide_from_estimates(
        BELIEF, SUBGOALS, _estimates(task), task.arrays, WORLD.start, STATE, KEY, CONFIG
    ),
    "ask": lambda task: ask(TrueMapEstimator(world=WORLD), BELIEF, SUBGOALS, task.arrays, STATE),
    "true_labels": lambda task: TrueMapEstimator(world=WORLD)(BELIEF, SUBGOALS, task.arrays),
    "TaskEnv": lambda task: TaskEnv([WORLD], task),
    "TaskEnv of a family": lambda task: TaskEnv.of_family(TOY, task, worlds=[0]),
    "reset_in": lambda task: TaskEnv([WORLD], RIGHT).reset_in(_renamed(task)),
    "collection": lambda task: Explorer(WORLD, [task], np.random.default_rng(0)),
    "stack_tasks": lambda task: stack_tasks([RIGHT, task]),
    "questions": lambda task: question_sheet((*questions_of(RIGHT), *questions_of(task)), 8, 4),
    "estimator of a task": lambda task: estimator_for(task.propositions, domain_of("toy"), _trained(TOY.propositions)),
    "network under a decision": lambda task: _trained(TOY.propositions).start(*WORLD.shape, 2, 1.0)(
        dataclasses.replace(BELIEF, propositions=task.propositions), SUBGOALS, task.arrays
    ),
    "observe": lambda task: observe(BeliefMap.unobserved(WORLD), _renamed(task), WORLD.start, SensorConfig()),
}
ENTRIES |= {
    f"decide, {policy}": lambda task, policy=policy: decide(
        BELIEF, WORLD.start, STATE, task.arrays, TrueMapEstimator(world=WORLD), KEY, policy=policy, config=CONFIG
    )
    for policy in Policy
}


def _renamed(task):
    """The world by the names of another task; no letter in it has a bit beyond them."""
    return dataclasses.replace(WORLD, propositions=task.propositions, letters=jnp.zeros_like(WORLD.letters))


@pytest.mark.parametrize("case", WRONG)
@pytest.mark.parametrize("entry", ENTRIES)
def test_a_task_over_other_propositions_is_refused_by_every_entry(entry, case):
    task = WRONG[case]
    with pytest.raises(PropositionsError) as caught:
        ENTRIES[entry](task)
    # Both, in their order, and what to do.
    assert f"({', '.join(task.propositions)})" in str(caught.value)
    assert "(goal, hazard)" in str(caught.value)
    assert "differ in order" in str(caught.value) if case == "order" else "differ in names" in str(caught.value)
    assert ";" in str(caught.value)


def test_a_goal_is_not_taken_for_a_hazard():
    """The symptom: bit 0 of toy is its goal, and of a task over the formula's own names its hazard."""
    with pytest.raises(
        PropositionsError, match=r"'F hazard' has the propositions \(hazard\), the world \(goal, hazard\)"
    ):
        run_trial(WORLD, Task.from_formula("F hazard"), "baseline", KEY)
    trial = run_trial(WORLD, WORLD.task("F hazard"), "baseline", KEY)
    assert trial.word[-1] == 1 << WORLD.propositions.index("hazard")


def test_a_task_of_a_world_is_over_its_propositions():
    assert WORLD.task("F hazard").propositions == WORLD.propositions == BELIEF.propositions
    assert WORLD.task("toy-1").text == Task.shipped("toy-1").text
    with pytest.raises(TaskError, match="unknown proposition 'fire'; known: goal, hazard"):
        WORLD.task("F fire")


@pytest.mark.parametrize("case", WRONG)
def test_it_is_found_while_tracing_whatever_was_compiled_before(case):
    """Names are part of what is compiled for: a program for the right ones does not serve others."""
    compiled = jax.jit(frontier_subgoals, static_argnums=4)
    compiled(BELIEF, WORLD.start, STATE, RIGHT.arrays, CONFIG)
    with pytest.raises(PropositionsError):
        compiled(BELIEF, WORLD.start, STATE, WRONG[case].arrays, CONFIG)


def test_another_task_of_the_same_names_compiles_nothing_new():
    compiled = jax.jit(chex.assert_max_traces(frontier_subgoals, n=1), static_argnums=4)
    tasks = [WORLD.task(text) for text in ("F goal", "F hazard", "!hazard U goal")]
    for arrays in stack_of(tasks):
        compiled(BELIEF, WORLD.start, STATE, arrays, CONFIG)


def stack_of(tasks):
    """Each task in arrays of the size that fits all."""
    stacked = stack_tasks(tasks)
    return [jax.tree.map(lambda leaf, row=row: leaf[row], stacked) for row in range(len(tasks))]


def test_worlds_beliefs_and_tasks_are_stacked_with_their_names():
    worlds = [TOY.world(number) for number in range(3)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *worlds)
    tasks = stack_tasks([RIGHT, WORLD.task("F hazard"), WORLD.task("!hazard U goal")])

    def finish_cost(world, task):
        move = decide(
            BeliefMap.revealed(world), world.start, task.initial, task, None, KEY, policy=Policy.BASELINE, config=CONFIG
        )
        return move.value

    together = jax.jit(jax.vmap(finish_cost))(stacked, tasks)
    alone = [finish_cost(world, task) for world, task in zip(worlds, stack_of([RIGHT] * 3), strict=True)]
    assert float(together[0]) == float(alone[0])
    assert stacked.propositions == tasks.propositions == WORLD.propositions


def test_an_environment_that_draws_other_names_is_refused():
    class Misnamed(Generator):
        name, propositions = "misnamed", ("exit", "fire")

        def draw(self, key):
            return make_world(np.zeros((3, 3), bool), np.ones((3, 3), int), (1, 1), propositions=("fire", "exit"))

    with pytest.raises(PropositionsError, match=r"'misnamed' has the propositions \(exit, fire\).*differ in order"):
        Misnamed().world(0)


def test_an_exported_planner_is_loaded_for_its_own_names_alone(tmp_path):
    (tmp_path / MANIFEST).write_text(json.dumps({"format": FORMAT, "task": RIGHT.describe(), "functions": {}}))
    with pytest.raises(PropositionsError, match=r"\(goal, hazard\), what is to call it \(hazard, goal\)"):
        load_program(tmp_path, "decide", NAMES["order"])
    with pytest.raises(ValueError, match="no program 'decide'"):
        load_program(tmp_path, "decide", WORLD.propositions)


def test_a_robot_that_names_nothing_is_refused():
    class Rover:
        def observe(self):
            return belief_from_numpy(np.zeros((3, 3)), np.zeros((3, 3), int)), (1, 1)

        def panorama(self):
            raise AssertionError("never asked")

        def advance(self, path, stop):
            raise AssertionError("never driven")

    with pytest.raises(PropositionsError, match=r"the robot's map \(\)"):
        run_robot(Rover(), RIGHT, "baseline", KEY)


def test_the_check_itself():
    require_same_propositions(("a", "b"), ["a", "b"])
    with pytest.raises(
        PropositionsError, match=r"^the task has the propositions \(a\), the world \(\): .*; world.task"
    ):
        require_same_propositions(("a",), (), remedy="world.task(formula)")
