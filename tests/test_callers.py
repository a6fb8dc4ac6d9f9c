"""What a caller's own program may ask of the planner: sharding with its checks on, and keys used once."""

import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh, PartitionSpec

import potlp_jax
from potlp_jax import BestFirstConfig, DecisionConfig, FrontierConfig, SensorConfig, Start, UctConfig
from potlp_jax.errors import TaskError, WorldError
from potlp_jax.learning.estimator import TrainedEstimator
from potlp_jax.learning.network import EstimatorNetwork, NetworkConfig
from potlp_jax.rl.episodes import TaskEnv
from potlp_jax.trials.config import TrialConfig
from potlp_jax.verify.semantics import satisfies_lasso
from tests.reference.domains import domain_of
from tests.reference.toy_plan import TASK, C, S, plan

ROOT = Path(__file__).parents[1]
TOY = potlp_jax.make("toy")
NETWORK = NetworkConfig(
    propositions=TOY.propositions, first_widths=(4,) * 4, second_widths=(4,) * 8, dense_widths=(8,) * 4, fovea=3
)


@pytest.mark.long
@pytest.mark.parametrize("config", [BestFirstConfig(simulations=20), UctConfig(simulations=20)])
def test_a_search_within_shard_map_is_the_search(config):
    """With ``check_vma`` as it is by default: each loop's carry is marked as varying from its start."""
    chances = jnp.asarray(np.random.default_rng(0).uniform(0.1, 0.9, (4, S, C)), jnp.float32)
    keys = jax.random.split(jax.random.key(0), 4)
    plans = jax.vmap(lambda chances, key: plan(chances, key, config))
    rows = PartitionSpec("rows")
    sharded = jax.shard_map(plans, mesh=Mesh(np.array(jax.devices()[:1]), ("rows",)), in_specs=rows, out_specs=rows)
    found, expected = jax.jit(sharded)(chances, keys), jax.jit(plans)(chances, keys)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.long
@pytest.mark.parametrize("kind", [jnp.int8, jnp.uint8, jnp.uint32, jnp.int16])
def test_cells_and_states_may_be_whole_numbers_of_any_type(kind):
    world, config = TOY.world(0), DecisionConfig(frontiers=FrontierConfig(max_subgoals=4))
    cell, state = world.start, jnp.int32(TASK.dfa.initial)
    sensor = SensorConfig(range_cells=5.0)

    @jax.jit
    def decided(cell, state):
        belief = potlp_jax.observe(potlp_jax.BeliefMap.unobserved(world), world, cell, sensor)
        subgoals = potlp_jax.frontier_subgoals(belief, cell, state, TASK.arrays, config)
        shape = (4, TASK.arrays.class_mask.shape[0])
        estimates = potlp_jax.Estimates(
            success_probability=jnp.full(shape, 0.5), success_cost=jnp.ones(shape), failure_cost=jnp.ones(shape)
        )
        return potlp_jax.decide_from_estimates(
            belief, subgoals, estimates, TASK.arrays, cell, state, jax.random.key(0), config
        )

    expected = decided(cell, state)
    as_python = tuple(int(entry) for entry in cell), int(TASK.dfa.initial)
    for found in (decided(cell.astype(kind), state.astype(kind)), decided(*as_python)):
        np.testing.assert_array_equal(found.path.cells, expected.path.cells)
        assert float(found.value) == float(expected.value)


@pytest.mark.parametrize("config", [BestFirstConfig(simulations=20), UctConfig(simulations=20)])
def test_who_asks_for_a_derivative_is_told_what_to_do(config):
    def value(chances):
        return plan(chances, jax.random.key(0), config).value

    chances = jnp.full((S, C), 0.5)
    with pytest.raises(NotImplementedError, match="stop_gradient"):
        jax.jvp(value, (chances,), (chances,))
    with pytest.raises(NotImplementedError, match="stop_gradient"):
        jax.grad(value)(chances)
    assert jax.grad(lambda chances: jnp.sum(chances) + value(jax.lax.stop_gradient(chances)))(chances).shape == (S, C)


OF_ANOTHER_TYPE = """
from dataclasses import replace
import jax
import numpy as np
from potlp_jax import BeliefMap, BestFirstConfig, DecisionConfig, FrontierConfig, Task, UctConfig
from potlp_jax import frontier_subgoals, make, plan_actions
from tests.reference.toy_plan import C, S, problem
world = make("toy").world(0)
belief, task = BeliefMap.unobserved(world), world.task("F goal")
for make in (
    lambda: DecisionConfig(search="uct"),
    lambda: BestFirstConfig(simulations=1e3),
    lambda: BestFirstConfig(simulations=True),
    lambda: BestFirstConfig(simulations=None),
    lambda: BestFirstConfig(optimism="x"),
    lambda: repr(BestFirstConfig(simulations=np.int64(50)).simulations),
    lambda: UctConfig(exploration="x"),
    lambda: FrontierConfig(max_subgoals=8.0),
    lambda: FrontierConfig(min_size=True),
    lambda: repr(FrontierConfig(max_subgoals=np.int32(4)).max_subgoals),
    lambda: DecisionConfig(path_horizon=2.5),
    lambda: DecisionConfig(commitment="x"),
    lambda: Task.from_formula("F a", max_positive_literals="1"),
    lambda: Task.from_formula("F a", max_positive_literals=2.5),
    lambda: Task.from_formula("F a", max_positive_literals=True),
    lambda: repr(Task.from_formula("F a", max_positive_literals=np.int64(1)).max_positive_literals),
    lambda: plan_actions(problem(np.full((S, C), 0.5), np), jax.random.key(0), simulations=2.7),
    lambda: plan_actions(problem(np.full((S, C), 0.5), np), jax.random.key(0), simulations=jax.numpy.array([2])),
    lambda: frontier_subgoals(belief, (1.5, 1.0), 0, task.arrays),
    lambda: frontier_subgoals(belief, world.start, 0, task),
    lambda: frontier_subgoals(replace(belief, letters=belief.letters * 1.0), world.start, 0, task.arrays),
    lambda: frontier_subgoals(replace(belief, cells=belief.cells * 1.0), world.start, 0, task.arrays),
    lambda: frontier_subgoals(replace(belief, letters=np.int8(belief.letters)), (1, 1), 0, task.arrays).mask.shape,
):
    try:
        print("no error", make())
    except ValueError as error:
        print(error)
"""


def test_what_has_another_type_is_refused_by_name():
    """In a program of its own: here annotations are checked."""
    command = [sys.executable, "-c", OF_ANOTHER_TYPE]
    told = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout
    expected = (
        "search is 'uct'; give a BestFirstConfig",
        "simulations is 1000.0, must be a whole",
        "simulations is True, must be a whole",
        "simulations is None, must be a whole",
        "optimism is x, must lie in [0, 1]",
        "no error 50",
        "exploration is x, must be finite",
        "must be whole",
        "must be whole",
        "no error 4",
        "path_horizon is 2.5; give a whole number",
        "commitment is x; give a number from 0",
        "max_positive_literals is '1': it must be None or a whole",
        "max_positive_literals is 2.5: it must be None or a whole",
        "max_positive_literals is True: it must be None or a whole",
        "no error 1",
        "simulations has the type float32: give whole",
        "simulations has shape (1,), expected (): one number for each problem",
        "cell has the type float32: give whole",
        "the task is a Task; give its arrays",
        "belief.letters has the type float32: give whole",
        "belief.cells has the type float32: give whole",
        "no error (",
    )
    for line, said in zip(told.splitlines(), expected, strict=True):
        assert said in line


SETTINGS_OF_ANOTHER_TYPE = """
from potlp_jax import DecisionConfig, SensorConfig
from potlp_jax.trials.config import TrialConfig
from potlp_jax.world.camera import CameraConfig, Disturbance
for make in (
    lambda: TrialConfig(panoramas=2.5),
    lambda: TrialConfig(panoramas=True),
    lambda: TrialConfig(look_every=1.5),
    lambda: TrialConfig(replan_distance=True),
    lambda: DecisionConfig(commitment=True),
    lambda: SensorConfig(range_cells=True),
    lambda: CameraConfig(height=96.5),
    lambda: CameraConfig(ceiling_colour=(1.5, 2, 3)),
    lambda: Disturbance(noise="x"),
):
    try:
        print("no error", make())
    except ValueError as error:
        print(error)
"""


def test_settings_of_trials_of_another_type_are_refused_by_name():
    command = [sys.executable, "-c", SETTINGS_OF_ANOTHER_TYPE]
    told = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout
    expected = (
        "panoramas is 2.5; give a whole number of at least 1",
        "panoramas is True; give a whole number of at least 1",
        "look_every is 1.5; give a whole number from 0",
        "replan_distance is True; give a number from 0",
        "commitment is True; give a number from 0",
        "range_cells must be a finite number of cells, 0 or more, found True",
        "height must be at least 1, width at least 4, both whole numbers",
        "a colour is three whole numbers of 0 to 255",
        "noise, exposure and colour must be finite numbers",
    )
    for line, said in zip(told.splitlines(), expected, strict=True):
        assert said in line


NUMPYS = """
import sys
from dataclasses import asdict
from pathlib import Path
import numpy as np
from potlp_jax import BestFirstConfig, DecisionConfig, FrontierConfig, SensorConfig, UctConfig, run
from potlp_jax.codec import config_from_dict
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.record import load_trial
from potlp_jax.world.camera import CameraConfig, Disturbance
half, two = np.float32(0.5), np.int64(2)
for search in (BestFirstConfig(simulations=two, optimism=half), UctConfig(simulations=two, exploration=half)):
    config = TrialConfig(
        decision=DecisionConfig(
            frontiers=FrontierConfig(min_size=two),
            search=search,
            dead_end_factor=half,
            commitment=half,
            least_chance=half,
            irrevocable_last=np.bool_(True),
        ),
        sensor=SensorConfig(range_cells=np.float64(9)),
        camera=CameraConfig(height=np.int32(8), ambient=half, ceiling_colour=(np.uint8(1), np.uint8(2), np.uint8(3))),
        disturbance=Disturbance(noise=half),
        panoramas=two,
        look_every=two,
        replan_distance=half,
        budget_factor=np.float32(20),
        revealed=np.bool_(False),
    )
    trial = run("toy", 1, "baseline", config=config)
    trial.save(Path(sys.argv[1]))
    assert config_from_dict(TrialConfig, load_trial(Path(sys.argv[1])).config, "record") == config
"""


def test_a_trial_with_numbers_of_numpys_as_settings_can_be_saved(tmp_path):
    command = [sys.executable, "-c", NUMPYS, str(tmp_path / "trial.json")]
    run = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert run.returncode == 0, run.stderr


# What the documentation says is raised.


@pytest.mark.parametrize(
    ("asked", "error", "said"),
    [
        (lambda: potlp_jax.run("toy", world=-1), WorldError, "the index of a world must lie in 0.."),
        (lambda: potlp_jax.run("toy", split="tset"), WorldError, "'tset'; choose from: calibration, training, valid"),
        (lambda: TOY.world(0, "tset"), WorldError, "unknown split 'tset'; choose from"),
        (lambda: satisfies_lasso("F b", ("a",), (), (1,)), TaskError, "b is not among the propositions ('a',)"),
        (lambda: TaskEnv([], TOY.task(1)), WorldError, "there is no world"),
    ],
)
def test_what_cannot_be_done_is_the_error_that_is_documented(asked, error, said):
    with pytest.raises(error, match=re.escape(said)):
        asked()


OF_ANOTHER_SHAPE = """
import dataclasses
import jax
import jax.numpy as jnp
from potlp_jax import BeliefMap, DecisionConfig, SensorConfig, frontier_subgoals, make, observe
from potlp_jax.planning.decision import subgoals_at
from potlp_jax.planning.distances.paths import shortest_path
from potlp_jax.planning.distances.product import distance_table, grid_distances, product_distances, product_transitions
from potlp_jax.planning.policies import decide
from potlp_jax.task.task import stack_tasks
world = make("toy").world(0)
belief, task = observe(BeliefMap.unobserved(world), world, world.start, SensorConfig()), world.task("F goal")
arrays, free, one, key = task.arrays, belief.free, jnp.float32(1), jax.random.key(0)
product = product_transitions(arrays, belief.letters, free)
two, cells = jnp.array([0, 1]), jnp.array([[1, 1]])
fields = product_distances(product, free, cells, two[:1], one)[0]
ends = (cells[0], two[0], cells[0], two[0])

def decided(cell, state, known=belief, of=arrays):
    return decide(known, cell, state, of, None, key, policy="baseline", config=DecisionConfig())

for make in (
    lambda: frontier_subgoals(belief, world.start, two, arrays),
    lambda: decided(jnp.array([5]), 0),
    lambda: decided(cells, 0),
    lambda: decided(world.start, 0, dataclasses.replace(belief, letters=belief.letters[1:])),
    lambda: decided(world.start, 0, of=stack_tasks([task, task])),
    lambda: product_distances(product, free, cells, two, one),
    lambda: product_distances(product, free[1:], cells, two[:1], one),
    lambda: distance_table(product, free, arrays.accepting, cells, two[:1], jnp.array([1, 1]), one),
    lambda: grid_distances(free, jnp.array([1, 1, 1]), one),
    lambda: shortest_path(fields[1:], product, free, *ends, horizon=4, resolution=one),
    lambda: shortest_path(fields, product, free, cells, *ends[1:], horizon=4, resolution=one),
    lambda: subgoals_at(cells, jnp.array([True, True]), 5, 5),
    lambda: subgoals_at(jnp.array([[1.0, 1.0]]), jnp.array([True]), 5, 5),
    lambda: subgoals_at(cells.astype(jnp.uint8), jnp.array([True]), 5, 5).cells.dtype,
):
    try:
        print("no error", make())
    except ValueError as error:
        print(type(error).__name__, error)
"""


def test_what_has_another_shape_is_refused_by_name():
    """The kernels read memory by these shapes."""
    run = subprocess.run([sys.executable, "-c", OF_ANOTHER_SHAPE], capture_output=True, text=True, check=True)
    expected = (
        "ProblemError state has shape (2,), expected (): the map is",
        "ProblemError cell has shape (1,), expected (2,): the map is",
        "ProblemError cell has shape (1, 2), expected (2,): the map is",
        "ProblemError belief.letters has shape",
        "ProblemError task.state_mask has shape",
        "ProblemError source_cells has shape (1, 2), expected (2, 2)",
        "ProblemError free has shape",
        "ProblemError target_cells has shape (2,), expected (2, 2)",
        "ProblemError cell has shape (3,), expected (2,)",
        "ProblemError distances has shape",
        "ProblemError source_cell has shape (1, 2), expected (2,)",
        "ProblemError cells has shape (1, 2), expected (2, 2)",
        "ProblemError cells has the type float32: give whole numbers",
        "no error int32",
    )
    for line, said in zip(run.stdout.splitlines(), expected, strict=True):
        assert line.startswith(said)


@pytest.mark.long
def test_no_key_is_used_twice():
    """In a trial and in a batch of trials: keys of worlds, of the camera's disturbance and of the sampling search."""
    settings = TrialConfig(
        sensor=SensorConfig(range_cells=5.0),
        decision=DecisionConfig(frontiers=FrontierConfig(max_subgoals=4), search=UctConfig(simulations=20)),
    )
    with jax.debug_key_reuse(True):
        key = jax.random.key(0)
        jax.random.normal(key)
        with pytest.raises(jax.errors.KeyReuseError):
            jax.random.uniform(key)
        params = EstimatorNetwork(NETWORK).init(jax.random.key(0))
        estimator = TrainedEstimator(
            params=params, config=NETWORK, domain=domain_of("toy"), metadata={}, name="untrained", digest=""
        )
        trial = potlp_jax.run(TOY, 2, "potlp", config=settings, estimator=estimator)
        start = Start(TOY.world(0), TASK.arrays, jax.random.key(0), name=0)
        (finished,) = potlp_jax.run_batch([start], "potlp", settings, slots=1, estimator=estimator)
    assert (trial.outcome, finished.outcome) == ("satisfied", "satisfied")
