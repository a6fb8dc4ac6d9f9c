"""The exported planner: its files run with jax alone and answer as the library does."""

import dataclasses
import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.environments.splits import Split, world_key
from potlp_jax.environments.toy import Toy
from potlp_jax.errors import ExportError
from potlp_jax.export import ANY_BATCH, MANIFEST, ExportConfig, export_planner, load_program
from potlp_jax.learning.labels import TrueMapEstimator
from potlp_jax.planning.decision import frontier_subgoals
from potlp_jax.planning.move import MoveKind
from potlp_jax.planning.policies import Policy, decide
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.api import plan_actions
from potlp_jax.planning.search.config import BestFirstConfig, UctConfig
from potlp_jax.planning.search.plan import Plan
from potlp_jax.planning.situation import DecisionConfig
from potlp_jax.task.task import Task
from potlp_jax.types import Status
from potlp_jax.world.frontiers import FrontierConfig
from potlp_jax.world.grid import BeliefMap
from potlp_jax.world.sensing import SensorConfig, observe
from tests.reference.problems import random_fields

pytestmark = pytest.mark.optimised

pytest.importorskip("flatbuffers", reason="jax writes exported programs with flatbuffers")

SUBGOALS = 2
CONFIG = DecisionConfig(
    frontiers=FrontierConfig(max_subgoals=SUBGOALS), search=BestFirstConfig(simulations=16), path_horizon=12
)
# What a program's caller needs, and nothing else; importing the package that made the program is an error.
CALLER = """
import importlib.abc, json, pathlib, sys

class Refuse(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("potlp_jax", "flax", "spot"):
            raise ImportError(f"{name} is imported where only jax may be")

sys.meta_path.insert(0, Refuse())
import jax, jax.export, numpy

folder, name, arrays = pathlib.Path(sys.argv[1]), sys.argv[2], numpy.load(sys.argv[3])
entry = json.loads((folder / "manifest.json").read_text())["functions"][name]
program = jax.export.deserialize(bytearray((folder / entry["file"]).read_bytes()))
outputs = jax.jit(program.call)(*[arrays[value["name"]] for value in entry["inputs"]])
names = [value["name"] for value in entry["outputs"]]
numpy.savez(sys.argv[4], **{each: numpy.asarray(output) for each, output in zip(names, outputs, strict=True)})
assert "potlp_jax" not in sys.modules
"""


@dataclasses.dataclass(frozen=True)
class Situation:
    """A robot in the toy world that has looked around once."""

    belief: BeliefMap
    cell: jax.Array
    state: jax.Array
    task: Task
    estimator: TrueMapEstimator


@pytest.fixture(scope="module")
def situation():
    toy = Toy()
    world = toy.generate(world_key(Split.VALIDATION, 3, toy.name))
    task = Task.from_formula(toy.tasks["2"], toy.propositions)
    belief = observe(BeliefMap.unobserved(world), world, world.start, SensorConfig(range_cells=4.0))
    letter = int(belief.letters[world.start[0], world.start[1]])
    state = jnp.int32(task.dfa.transitions[task.dfa.initial, letter])
    return Situation(belief, world.start, state, task, TrueMapEstimator(world=world))


@pytest.fixture(scope="module")
def exported(situation, tmp_path_factory):
    folder = tmp_path_factory.mktemp("export")
    height, width = situation.belief.cells.shape
    export_planner(
        situation.task,
        folder,
        ExportConfig(grid=(height, width), subgoals=SUBGOALS, decision=CONFIG, platforms=("cpu",)),
    )
    return folder


@pytest.fixture(scope="module")
def searches(situation, tmp_path_factory):
    """The search alone, for batches of any size and for two platforms."""
    folder = tmp_path_factory.mktemp("searches")
    export_planner(situation.task, folder, ExportConfig(subgoals=SUBGOALS, decision=CONFIG, batch=ANY_BATCH))
    return folder


def manifest_of(folder):
    return json.loads((folder / MANIFEST).read_text())


def called_elsewhere(folder, name, inputs, scratch):
    """The program's outputs from a fresh process that has jax but not this package."""
    np.savez(scratch / "inputs.npz", **{key: np.asarray(value) for key, value in inputs.items()})
    command = [sys.executable, "-c", CALLER, str(folder), name, str(scratch / "inputs.npz"), str(scratch / "out.npz")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=scratch)
    assert done.returncode == 0, done.stderr
    return np.load(scratch / "out.npz")


def robot_inputs(situation):
    belief = situation.belief
    return {
        "cells": belief.cells,
        "letters": belief.letters,
        "resolution": belief.resolution,
        "extent": belief.extent,
        "cell": situation.cell,
        "state": situation.state,
    }


def plan_inputs(task, seed):
    fields = random_fields(task, SUBGOALS, seed)
    types = {"dfa_state": np.int32, "subgoal_mask": np.bool_}
    return {name: np.asarray(value, types.get(name, np.float32)) for name, value in fields.items()}


def plan_of(task, inputs, search, key=None):
    problem = PlanningProblem.from_arrays(task.arrays, **inputs)
    return jax.jit(plan_actions, static_argnums=2)(problem, jax.random.key(0) if key is None else key, search)


def assert_equal_plan(outputs, plan):
    """Bit for bit, though two programs made them."""
    for field in dataclasses.fields(Plan):
        np.testing.assert_array_equal(outputs[field.name], np.asarray(getattr(plan, field.name)), err_msg=field.name)


@pytest.mark.long
def test_whole_decision_in_a_process_without_the_package(situation, exported, tmp_path):
    key = jax.random.key(7)
    move = jax.jit(decide, static_argnames=("policy", "config"))(
        situation.belief,
        situation.cell,
        situation.state,
        situation.task.arrays,
        situation.estimator,
        key,
        policy=Policy.ORACLE,
        config=CONFIG,
    )
    assert move.search is not None
    problem, plan, length = move.search.problem, move.search.plan, int(move.path.length)
    inputs = robot_inputs(situation) | {
        "subgoal_cells": move.subgoals.cells,
        "subgoal_mask": move.subgoals.mask,
        "success_probability": problem.success_probability,
        "success_cost": problem.success_cost,
        "failure_cost": problem.failure_cost,
    }
    outputs = called_elsewhere(exported, "decide", inputs, tmp_path)
    assert length > 0
    assert int(outputs["kind"]) == int(move.kind) == MoveKind.ACTION
    assert int(outputs["action"]) == int(move.action)
    assert int(outputs["subgoal"]) == int(plan.subgoal)
    np.testing.assert_array_equal(outputs["target_cell"], move.target_cell)
    assert int(outputs["path_length"]) == length
    np.testing.assert_array_equal(outputs["path_cells"][: length + 1], move.path.cells[: length + 1])
    np.testing.assert_array_equal(outputs["path_states"][: length + 1], move.path.states[: length + 1])
    np.testing.assert_array_equal(outputs["value"], move.value)
    np.testing.assert_array_equal(outputs["q_values"], plan.q_values)


@pytest.mark.long
def test_exported_subgoals_are_the_librarys(situation, exported):
    found = load_program(exported, "subgoals", situation.belief.propositions)(**robot_inputs(situation))
    subgoals = jax.jit(frontier_subgoals, static_argnums=4)(
        situation.belief, situation.cell, situation.state, situation.task.arrays, CONFIG
    )
    assert bool(subgoals.mask[0])
    np.testing.assert_array_equal(found["subgoal_cells"], subgoals.cells)
    np.testing.assert_array_equal(found["subgoal_mask"], subgoals.mask)
    np.testing.assert_array_equal(found["frontier"], subgoals.frontier)
    np.testing.assert_array_equal(found["component"], subgoals.component)


@pytest.mark.long
def test_search_for_any_batch_in_a_process_without_the_package(situation, searches, tmp_path):
    task, batch = situation.task, 3
    rows = [plan_inputs(task, seed) for seed in range(batch)]
    inputs = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    outputs = called_elsewhere(searches, "plan", inputs, tmp_path)
    for row in range(batch):
        assert_equal_plan({name: outputs[name][row] for name in outputs}, plan_of(task, rows[row], CONFIG.search))


@pytest.mark.long
def test_a_search_that_samples_takes_the_callers_key(situation, searches, tmp_path):
    """Best-first search has no such input: a key would change nothing."""
    search, key = UctConfig(simulations=20), jax.random.key(7)
    config = ExportConfig(subgoals=SUBGOALS, decision=DecisionConfig(search=search), platforms=("cpu",))
    export_planner(situation.task, tmp_path, config)
    for folder, keys in ((searches, 0), (tmp_path, 1)):
        entry = manifest_of(folder)["functions"]["plan"]
        assert [value["name"] for value in entry["inputs"]].count("key") == keys
    assert manifest_of(tmp_path)["functions"]["plan"]["meaning"].startswith("PO-UCT")
    inputs = plan_inputs(situation.task, 0)
    program = load_program(tmp_path, "plan", situation.task.propositions)
    outputs = program(**inputs, key=jax.random.key_data(key))
    assert_equal_plan(outputs, plan_of(situation.task, inputs, search, key))


def test_programs_of_an_earlier_export_do_not_stay(situation, tmp_path):
    (tmp_path / "decide.jaxexport").write_bytes(b"of another task")
    (tmp_path / "network.jaxexport").write_bytes(b"of another library")
    export_planner(situation.task, tmp_path, ExportConfig(platforms=("cpu",)))
    # Nor is what is somebody's own removed.
    assert sorted(file.name for file in tmp_path.glob("*.jaxexport")) == ["network.jaxexport", "plan.jaxexport"]


def test_any_batch_and_platforms_are_in_the_manifest(searches):
    entry = manifest_of(searches)["functions"]["plan"]
    assert {value["shape"][0] for value in entry["inputs"] + entry["outputs"]} == {"b"}
    assert entry["platforms"] == ["cpu", "cuda"]


def test_manifest_holds_the_task_and_what_numbers_mean(situation, exported):
    manifest = manifest_of(exported)
    task = manifest["task"]
    assert task["formula"] == situation.task.text
    assert tuple(task["propositions"]) == situation.task.propositions
    read = Task.from_hoa((exported / "task.hoa").read_text(), task["propositions"])
    np.testing.assert_array_equal(read.dfa.transitions, situation.task.dfa.transitions)
    assert task["hoa"] == (exported / "task.hoa").read_text()
    assert manifest["status_bits"]["TREE_OVERFLOW"] == Status.TREE_OVERFLOW
    assert manifest["move_kinds"]["FALLBACK"] == MoveKind.FALLBACK
    assert manifest["config"]["decision"]["search"]["simulations"] == CONFIG.search.simulations
    assert set(manifest["functions"]) == {"plan", "subgoals", "decide"}
    for field in dataclasses.fields(Plan):
        assert field.name in [value["name"] for value in manifest["functions"]["plan"]["outputs"]]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"subgoals": 0}, "subgoals is 0"),
        ({"grid": (0, 5)}, "rows and columns"),
        ({"batch": 0}, "batch is 0"),
        ({"batch": "all"}, "'all'"),
        ({"platforms": ()}, "platform"),
    ],
)
def test_what_cannot_be_exported_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ExportConfig(**options)


@pytest.mark.parametrize("found", [1, None])
def test_a_folder_of_another_format_is_refused(exported, tmp_path, found):
    manifest = json.loads((exported / MANIFEST).read_text()) | {"format": found}
    (tmp_path / MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(ExportError, match=r"format \S+ of exported planners; this version reads 2: export it again"):
        load_program(str(tmp_path), "plan", Toy.propositions)


def test_loaded_programs_name_what_is_missing(exported):
    with pytest.raises(ValueError, match="plan, subgoals, decide"):
        load_program(exported, "nothing", Toy.propositions)
    with pytest.raises(ValueError, match="takes exactly travel"):
        load_program(exported, "plan", Toy.propositions)(travel=np.zeros(1))


def widened(array):
    return np.asarray(array, np.float64) if array.dtype == np.float32 else array


def test_loaded_programs_take_64_bits_and_name_what_has_another_shape(situation, exported):
    program, inputs = load_program(exported, "plan", Toy.propositions), plan_inputs(situation.task, 0)
    expected = program(**inputs)
    with jax.enable_x64(True):
        found = program(**{name: widened(value) for name, value in inputs.items()})
    for name, value in expected.items():
        np.testing.assert_array_equal(found[name], value)
    with pytest.raises(ExportError, match=r"plan takes arrays of these types and shapes: travel: float32\["):
        program(**inputs | {"travel": inputs["travel"][0]})
