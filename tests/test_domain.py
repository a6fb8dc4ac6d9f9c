"""An estimator is asked where it was made for: not wherever places have the names of its propositions."""

import dataclasses
import warnings

import jax
import numpy as np
import pytest
from typer.testing import CliRunner

from potlp_jax.cli import app
from potlp_jax.environments.campus.delivery import Delivery
from potlp_jax.environments.registry import make
from potlp_jax.environments.rooms import Rooms, RoomsConfig
from potlp_jax.environments.ros.mapped_rooms import MappedRooms, MappedRoomsConfig
from potlp_jax.environments.ros.ros_map import RosMap, RosMapConfig
from potlp_jax.errors import BatchError, EstimatorError, PotlpWarning
from potlp_jax.learning.domain import LOGS, Domain
from potlp_jax.learning.estimator import (
    estimator_for,
    named_estimator,
    shipped_estimator,
    shipped_estimators,
)
from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.specification import specification_from_dict
from potlp_jax.trials.batch import Start, run_batch
from potlp_jax.trials.config import TrialConfig, trial_config_for
from potlp_jax.trials.live import run_robot
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.robot import SimulatedRobot
from potlp_jax.trials.run import default_policy
from potlp_jax.world.camera import CameraConfig
from potlp_jax.world.grid import world_digest, world_from_dict, world_to_dict
from tests.reference.map_files import p5, write_map

PARCELS = ("document", "package")
TASK = "F document & F package"
PLACES = """propositions:
  document: [{point: [1.5, 3.5], radius: 0.4}]
  package: [{point: [9.5, 3.5], radius: 0.4}]
tasks:
  "1": "F document & F package"
"""
NAMED_ROOMS = """rooms:
  a: [{polygon: [[0.5, 2.0], [3.0, 2.0], [3.0, 4.0], [0.5, 4.0]]}]
  b: [{polygon: [[3.5, 2.0], [6.0, 2.0], [6.0, 4.0], [3.5, 4.0]]}]
  c: [{polygon: [[6.5, 2.0], [10.0, 2.0], [10.0, 4.0], [6.5, 4.0]]}]
"""
BUILDING = np.array(
    [
        [c == "." for c in row]
        for row in (
            "#####################",
            "#.....#.....#.......#",
            "#.....#.....#.......#",
            "#.....#.....#.......#",
            "#.....#.....#.......#",
            "###.#####.######.####",
            "#...................#",
            "#...................#",
            "#####################",
        )
    ]
)


@pytest.fixture
def building(tmp_path):
    file = write_map(tmp_path, p5(np.where(np.kron(BUILDING, np.ones((2, 2))), 254, 0)), "office", resolution="0.25")
    (tmp_path / "office.places.yaml").write_text(PLACES)
    (tmp_path / "office.rooms.yaml").write_text(NAMED_ROOMS)
    return file


def _here(world, **camera):
    config = trial_config_for(world)
    return Domain.of_world(world, dataclasses.replace(config.camera, **camera))


@pytest.mark.parametrize("name", ["delivery", "firefighting", "parcels"])
def test_every_shipped_estimator_serves_its_family_by_default(name):
    world = make(name).world(0)
    estimator = shipped_estimator(world.propositions, _here(world))
    assert estimator is not None
    assert (estimator.name, estimator.domain.family, world.family) == (name, name, name)
    assert default_policy(world) is Policy.POTLP
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert estimator_for(world.propositions, _here(world)) is estimator


@pytest.mark.parametrize("resolution", [0.25, 0.4, 0.5])
def test_cells_of_another_size_are_served_where_the_camera_shows_the_same_metres(building, resolution):
    world = MappedRooms(MappedRoomsConfig(building, resolution=resolution, radius=0.0)).world(0, "test")
    assert world.family == "parcels"
    assert default_policy(world) is Policy.POTLP
    # As it stood before: a camera that counts in cells would show other metres.
    assert (default_policy(world, TrialConfig()) is Policy.POTLP) == (resolution == 0.5)


def test_a_map_with_places_of_the_same_names_has_no_default_estimator(building):
    world = RosMap(RosMapConfig(building, resolution=0.5, radius=0.0)).world(0)
    assert world.propositions == PARCELS
    assert shipped_estimator(PARCELS, _here(world)) is None
    assert default_policy(world) is Policy.BASELINE
    with pytest.raises(EstimatorError, match=r"parcels knows the propositions, but .* of parcels, .* of map:office"):
        run_trial(world, world.task(TASK), "potlp", jax.random.key(0))


def test_rooms_with_the_same_names_have_no_default_estimator():
    config = RoomsConfig(PARCELS, smallest=16, largest=24, room=5, patches=1, patch_radius=0)
    world = Rooms(config).world(0)
    assert default_policy(world) is Policy.BASELINE
    start = Start(world, world.task(TASK).arrays, jax.random.key(0))
    with pytest.raises(EstimatorError, match="it counts in metres, and here costs are in cells"):
        list(run_batch([start], "potlp"))


def test_on_request_an_estimator_is_asked_anywhere_with_a_note(building):
    world = RosMap(RosMapConfig(building, resolution=0.5, radius=0.0)).world(0)
    parcels = named_estimator("parcels")
    assert any(parcels is estimator for estimator in shipped_estimators())
    with pytest.warns(
        PotlpWarning, match="estimator 'parcels' is asked about worlds that it was not made for: .*map:office"
    ):
        assert estimator_for(PARCELS, _here(world), parcels) is parcels
    assert default_policy(world, given=parcels) is Policy.POTLP


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"eye_height": 0.4}, r"eye_height \(0.75, here 0.2\)"),
        ({"horizon": 40.0}, r"horizon \(48, here 40\)"),
        ({"ambient": 0.3}, r"ambient \(0.12, here 0.3\)"),
        ({"width": 256}, r"width \(512, here 256\)"),
        ({"renderer": "mine:look"}, r"renderer \('', here 'mine:look'\)"),
    ],
)
def test_another_camera_is_named(change, words):
    world = Delivery.parcels().world(0)
    assert default_policy(world, TrialConfig(camera=CameraConfig(**change))) is Policy.BASELINE
    with pytest.raises(EstimatorError, match=f"its camera has another {words}"):
        estimator_for(PARCELS, _here(world, **change))


def test_a_robot_of_ones_own_is_of_no_family():
    """Its map has the propositions, and what its pictures look like nobody knows."""
    world = Delivery.parcels().world(0)
    robot = SimulatedRobot(world, TrialConfig(), jax.random.key(0))
    with pytest.raises(EstimatorError, match="of no named family"):
        run_robot(robot, world.task(TASK), "potlp", jax.random.key(0))


def test_what_learned_from_logs_serves_robots_and_their_maps(building):
    """That is what it was made for."""
    logs = Domain(LOGS, None, "metres")
    assert not logs.misfits(Domain.of_robot(0.2))
    assert not logs.misfits(_here(RosMap(RosMapConfig(building, resolution=0.5, radius=0.0)).world(0)))
    (misfit,) = logs.misfits(Domain("parcels", None, "metres"))
    assert misfit == "it learned from worlds of log, and these are of parcels"


def test_two_unnamed_families_are_not_the_same():
    mine = Domain("", CameraConfig(), "cells")
    assert mine.family_misfits(mine)


def test_a_world_keeps_its_family(building):
    world = Delivery.parcels().world(0)
    assert world_from_dict(world_to_dict(world)).family == "parcels"
    assert world_digest(world) != world_digest(dataclasses.replace(world, family="other"))
    start = Start(world, world.task(TASK).arrays, jax.random.key(0))
    other = dataclasses.replace(start, world=dataclasses.replace(world, family="other"), name="second")
    with pytest.raises(BatchError, match="'second': its world has the family other"):
        list(run_batch([start, other], "baseline"))


def test_a_sweep_takes_a_shipped_estimator_by_name(tmp_path):
    entries = {"environments": ["toy"], "tasks": [1], "policies": ["baseline"], "worlds": 1}
    found = specification_from_dict({**entries, "estimator": "parcels"}, "here", tmp_path)
    assert found.estimator == "parcels"
    (tmp_path / "parcels").write_text("a file of the same name goes first")
    found = specification_from_dict({**entries, "estimator": "parcels"}, "here", tmp_path)
    assert found.estimator == str(tmp_path / "parcels")


def test_the_command_says_why_it_takes_the_baseline(building):
    result = CliRunner().invoke(app, ["run", f"map:{building},resolution=0.5,radius=0.0"])
    assert "the shipped estimator parcels knows the propositions, but" in result.stderr
    assert "the policy is baseline" in result.stderr
    assert "satisfied" in result.stdout
