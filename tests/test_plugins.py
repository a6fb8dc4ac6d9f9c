"""Environments, policies, cameras and estimators of others, by ``module:attribute`` and by entry point."""

import functools
import sys
from typing import ClassVar

import jax
import jax.numpy as jnp
import pytest

from potlp_jax import plugins
from potlp_jax.cli import completion
from potlp_jax.environments.families import FAMILIES
from potlp_jax.environments.registry import make
from potlp_jax.environments.toy import Toy
from potlp_jax.errors import EstimatorError, PluginError, StoreError, WorldError
from potlp_jax.learning.estimator import named_estimator
from potlp_jax.planning.policies import Policy, named_policy
from potlp_jax.sweep.runner import RESULTS, run_sweep
from potlp_jax.sweep.specification import specification_from_dict, specification_from_store
from potlp_jax.sweep.store import Store
from potlp_jax.trials.config import trial_config_for
from potlp_jax.trials.replay import replay_decision
from potlp_jax.trials.run import run
from potlp_jax.world.camera import CameraConfig
from potlp_jax.world.grid import world_digest, world_from_dict, world_to_dict
from potlp_jax.world.renderer import render

MODULE = """
import jax.numpy as jnp
from potlp_jax.environments.toy import Toy, ToyConfig
from potlp_jax.planning.estimates import Estimates
from potlp_jax.planning.policies import Policy, policy_function

def nearest(situation, estimates, key, config, intention):
    return policy_function(Policy.BASELINE)(situation, estimates, key, config, intention)

def guess(belief, subgoals, task):
    ones = jnp.ones((subgoals.mask.shape[0], task.class_mask.shape[0]))
    return Estimates(success_probability=0.5 * ones, success_cost=ones, failure_cost=ones)

class Small(Toy):
    name = "small"

    def __init__(self):
        super().__init__(ToyConfig(height=5, width=9))

made = Small()

def tall():
    return Toy(ToyConfig(height=11))

number = 3

def forgets(situation, estimates, key, config, intention):
    nearest(situation, estimates, key, config, intention)

def blind(world, cell, config):
    pass

class Unnamed(Toy):
    def __init__(self):
        pass

from potlp_jax.environments.base import Generator

class Undrawn(Generator):
    name, propositions = "undrawn", ("goal",)

class Empty(Small):
    tasks = {1: "F goal"}

    def draw(self, key):
        pass

class Bare(Generator):
    name = "bare"

    def draw(self, key):
        pass
"""


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """The current directory is one with modules in it that sys.path does not name, as for a console script."""
    (tmp_path / "foreign_worlds.py").write_text(MODULE)
    (tmp_path / "broken_worlds.py").write_text("import a_library_that_is_missing")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    yield tmp_path
    sys.modules.pop("foreign_worlds", None)


@pytest.fixture
def installed(elsewhere):
    """A package that is installed and declares entry points."""
    folder = elsewhere / "foreign-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: foreign\nVersion: 1.0\n")
    lines = [
        "[potlp_jax.environments]",
        "small = foreign_worlds:Small",
        "gone = foreign_worlds:Gone",
        "bare = foreign_worlds",
    ]
    (folder / "entry_points.txt").write_text("\n".join(lines))
    sys.path.insert(0, str(elsewhere))


def test_settings_of_a_family_may_be_a_dictionary():
    class Impatient(Toy):
        name = "impatient"
        settings: ClassVar = {"replan_distance": 2, "decision": {"frontiers": {"max_subgoals": 3}}}

    world = Impatient().world(0)
    hash(world.settings)
    assert trial_config_for(world) == trial_config_for(Impatient())
    assert trial_config_for(world).decision.frontiers.max_subgoals == 3
    assert world_digest(world_from_dict(world_to_dict(world))) == world_digest(world)


@pytest.mark.parametrize(("name", "height"), [("Small", 5), ("made", 5), ("tall", 11)])
def test_an_environment_is_a_class_an_object_or_a_function(elsewhere, name, height):
    generator = make(f"foreign_worlds:{name}")
    assert isinstance(generator, Toy)
    assert generator.world(0).shape[0] == height


def test_an_environment_by_entry_point(installed):
    assert make("small").name == "small"
    assert plugins.entry_points("potlp_jax.environments") == ("bare", "gone", "small")
    assert completion.complete_environment("s") == ["small"]


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "mars",
            f"unknown environment 'mars'; choose one of: {', '.join([*FAMILIES, 'bare', 'gone', 'small'])}; or",
        ),
        ("gone", "environment 'gone' (entry point 'foreign_worlds:Gone'): foreign_worlds has no attribute 'Gone'"),
        ("bare", "environment 'bare': its entry point 'foreign_worlds' names no attribute: write module:attribute"),
        ("foreign_worlds:number", "environment 'foreign_worlds:number': int is no environment"),
        ("foreign_worlds:Big", "foreign_worlds has no attribute 'Big'"),
        ("foreign_worlds:Undrawn", "cannot be made: Can't instantiate abstract class Undrawn"),
        ("foreign_worlds:Bare", "environment 'foreign_worlds:Bare': its class has no propositions"),
        ("no_such_worlds:Small", "importing no_such_worlds failed: ModuleNotFoundError: No module named 'no_such"),
        ("broken_worlds:Small", "importing broken_worlds failed: ModuleNotFoundError: No module named 'a_library"),
    ],
)
def test_errors_say_what_is_wrong(name, message):
    with pytest.raises(PluginError) as error:
        make(name)
    assert message in str(error.value)


def test_what_others_forgot_is_named(elsewhere):
    with pytest.raises(PluginError, match=r"policy foreign_worlds:forgets returned NoneType, expected a Move"):
        run("foreign_worlds:Small", policy="foreign_worlds:forgets")
    empty = make("foreign_worlds:Empty")
    with pytest.raises(WorldError, match="the environment 'small' drew NoneType, expected a World"):
        empty.world(0)
    with pytest.raises(PluginError, match=r"camera 'foreign_worlds:blind': its picture is NoneType\[\], must be uint8"):
        render(Toy().world(0), jnp.array([1, 1]), CameraConfig(renderer="foreign_worlds:blind"))
    # In a dictionary a number is a number.
    assert empty.task("1").text == empty.task(1).text == "F goal"


@pytest.mark.long
@pytest.mark.parametrize(
    "used",
    [
        {"environments": ["foreign_worlds:Small"]},
        {"policies": ["foreign_worlds:nearest"]},
        {"policies": ["potlp"], "estimator": "foreign_worlds:guess"},
    ],
)
def test_a_sweep_does_not_go_on_with_what_was_written_otherwise(elsewhere, used):
    given = {"environments": ["toy"], "tasks": ["F goal"], "policies": ["baseline"], "worlds": 1} | used
    run_sweep(specification_from_dict(given, "here"), elsewhere / "out")
    run_sweep(specification_from_dict(given | {"worlds": 2}, "here"), elsewhere / "out")
    file = elsewhere / "foreign_worlds.py"
    file.write_text(file.read_text() + "changed = True\n")
    with pytest.raises(StoreError, match="was begun with another source"):
        run_sweep(specification_from_dict(given | {"worlds": 3}, "here"), elsewhere / "out")


def test_what_comes_with_the_package_is_known_by_its_commit(tmp_path):
    given = {"environments": ["toy"], "tasks": ["F goal"], "policies": ["baseline"], "worlds": 1}
    run_sweep(specification_from_dict(given, "here"), tmp_path)
    store = Store(tmp_path / RESULTS, read_only=True)
    assert "source" not in store.facts()
    store.close()


def test_a_function_within_others_is_known_by_its_own_name_and_file(elsewhere):
    nearest = plugins.load("foreign_worlds:nearest", group=plugins.POLICIES, kind="policy")
    for found in (functools.partial(nearest), functools.partial(functools.partial(nearest)), jax.jit(nearest)):
        assert plugins.reference_of(found) == "foreign_worlds:nearest"
        assert plugins.source_digest(found) == plugins.source_digest(nearest) is not None


def test_references_are_told_from_names_and_files():
    assert plugins.is_reference("package.module:Class.method")
    assert not any(map(plugins.is_reference, ("toy", "a file.npz", "C:\\maps\\x.npz", "out/x:y/z", "/maps/x.yaml")))


def test_a_policy_is_a_function_by_name(elsewhere):
    trial = run("foreign_worlds:Small", policy="foreign_worlds:nearest", world=2)
    baseline = run("foreign_worlds:Small", policy="baseline", world=2)
    assert (trial.outcome, trial.path) == (baseline.outcome, baseline.path)
    assert (trial.policy, trial.environment) == ("foreign_worlds:nearest", "foreign_worlds:Small/validation")
    assert named_policy("known_map") is Policy.KNOWN_MAP
    with pytest.raises(PluginError, match="unknown policy 'clever'; choose one of: known-map, baseline"):
        named_policy("clever")
    with pytest.raises(PluginError, match="int is no function"):
        named_policy("foreign_worlds:number")


def test_an_estimator_is_a_function_by_name_or_a_file(elsewhere):
    trial = run("toy", policy="potlp", world=1, estimator="foreign_worlds:guess")
    assert trial.outcome == "satisfied"
    assert trial.versions["estimator"] == "foreign_worlds:guess"
    assert {action.success_probability for action in trial.decisions[0].actions if action.subgoal is not None} == {0.5}
    _, plan, _ = replay_decision(trial, 0, named_estimator("foreign_worlds:guess"))
    assert float(plan.value) == trial.decisions[0].value
    with pytest.raises(PluginError, match="int cannot be called with belief"):
        named_estimator("foreign_worlds:number")
    with pytest.raises(EstimatorError, match=r"missing\.npz"):
        named_estimator("missing.npz")


@pytest.mark.long
def test_workers_of_a_sweep_find_environments_and_policies_by_the_same_names(elsewhere):
    entries = {
        "environments": ["foreign_worlds:Small"],
        "tasks": [1],
        "policies": ["foreign_worlds:nearest"],
        "worlds": 3,
    }
    specification = specification_from_dict(entries, "sweep")
    run_sweep(specification, elsewhere / "out", processes=2)
    store = Store(elsewhere / "out" / RESULTS)
    assert specification_from_store(store.facts()["specification"]) == specification
    costs = {policy: {} for policy in specification.policies}
    for row in store.rows():
        costs[row.item.policy][row.item.world] = row.cost
    store.close()
    assert len(costs["baseline"]) == 3
    assert costs["foreign_worlds:nearest"] == costs["baseline"]
