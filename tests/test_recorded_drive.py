"""A simulated robot in a building: what it sees, where places are, what its camera shows, how its drive is judged."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.live import server
from eval.live.building import REACH, Building
from eval.live.perturbation import Network, Perturbation
from eval.live.recorded import length_to_and_fro, on_true_map, problems_of_drive
from eval.live.simulator import FLOOR, PICTURES, Behaviour, SimulatedLink, SteppedInbox
from potlp_jax.drive.config import DriveConfig, Mode, Topics
from potlp_jax.drive.driving import drive_robot
from potlp_jax.drive.movers import Adviser
from potlp_jax.drive.robot import RemoteRobot
from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.places import Polygon
from potlp_jax.environments.ros.ros_map import RosMap, RosMapConfig
from potlp_jax.task.task import Task
from potlp_jax.trials.config import trial_config_for
from potlp_jax.trials.robot import photograph
from potlp_jax.world.camera import Disturbance
from potlp_jax.world.grid import BeliefMap, make_world
from potlp_jax.world.sensing import SensorConfig, observe
from tests.reference.map_files import PLACES, TWO_ROOMS, p5, write_map

TASK = Task.from_formula("!fire U exit", FLOOR.propositions)
LETTERS = np.array([[{"f": 1, "e": 2}.get(cell, 0) for cell in row] for row in FLOOR.rows], np.int32)


def building():
    """The floor of the perturbed streams, whose corner lies elsewhere."""
    world = make_world(FLOOR.walls, LETTERS, FLOOR.start, resolution=0.4, propositions=FLOOR.propositions)
    return Building(world, GridFrame(*world.shape, 0.4, -3.2, 1.6))


def linked(topics=Topics()):
    """A link to the robot in the building, and an inbox that hears it."""
    link = SimulatedLink(
        building(), Behaviour(pixels=1, reach=REACH), Network(Perturbation(), np.random.default_rng(0))
    )
    config = DriveConfig(mode=Mode.FOLLOW, topics=topics, resolution=0.4, radius=0.0)
    return link, SteppedInbox(link, config, FLOOR.propositions), config


@pytest.mark.parametrize("seed", range(5))
def test_places_are_where_letters_were_seen(seed):
    random = np.random.default_rng(seed)
    ground = building()
    letters = np.where(ground.walls, 0, random.integers(0, 4, ground.walls.shape)).astype(np.int32)
    ground = dataclasses.replace(ground, world=dataclasses.replace(ground.world, letters=jnp.asarray(letters)))
    seen = random.random(ground.walls.shape) < 0.7
    found = np.zeros_like(letters)
    for name, regions in ground.places(seen).items():
        for region in regions:
            corners = tuple((x, y) for x, y in region["polygon"])
            found |= Polygon(corners).covers(~ground.walls, ground.frame) << FLOOR.propositions.index(name)
    assert np.array_equal(found, np.where(seen, letters, 0))


def test_a_labelled_map_is_a_building(tmp_path, monkeypatch):
    # Its panorama is a large picture that nothing here looks at.
    monkeypatch.setattr(Building, "picture_from", lambda building, cell: None)
    file = write_map(tmp_path, p5(np.where(TWO_ROOMS, 254, 0)), resolution=1)
    file.with_suffix(".places.yaml").write_text(PLACES)
    ground = Building.from_spec(f"map:{file}", 0)
    made = RosMap(RosMapConfig(file))
    assert ground.propositions == made.propositions
    assert ground.frame == made.clean.frame
    assert np.array_equal(ground.walls, np.asarray(made.world(0).occupied))
    assert set(ground.places(~ground.walls)) == set(made.propositions)


def test_a_map_that_cannot_be_used_is_one_message_of_the_server(tmp_path, monkeypatch):
    file = write_map(tmp_path, p5(np.where(TWO_ROOMS, 254, 0)), resolution=1)
    monkeypatch.setattr("sys.argv", ["server", "--environment", f"parcels:{file}"])
    with pytest.raises(SystemExit, match=r"(?s)map\.rooms\.yaml does not exist.*rooms:\n.*labelled is map:"):
        server.main()


def test_it_sees_what_a_robot_in_a_trial_sees():
    ground = building()
    belief = observe(BeliefMap.unobserved(ground.world), ground.world, jnp.asarray((3, 6)), SensorConfig(4.0))
    assert np.array_equal(ground.seen_from((3, 6), 4), ~np.asarray(belief.unknown))


def test_the_camera_arrives_as_it_was_taken():
    link, inbox, config = linked(Topics(image=PICTURES))
    for topic, (kind, _) in inbox.handlers.items():
        link.subscribe(topic, kind, lambda message, topic=topic: inbox.handle(topic, message))
    link.step(1.0)
    world, camera = building().world, trial_config_for(building().world).camera
    robot = RemoteRobot(inbox, Adviser(), config, FLOOR.propositions, camera=camera, clock=link.clock)
    taken = photograph(world, world.start, jax.random.key(0), camera, Disturbance())
    difference = np.abs(np.asarray(robot.panorama(), int) - np.asarray(taken, int))
    # A turned or mirrored picture differs by 16 and more.
    assert difference.mean() < 4


def test_a_drive_is_judged_in_the_true_building():
    link, inbox, config = linked()
    drive = drive_robot(link, TASK, "baseline", jax.random.key(0), config, inbox=inbox, clock=link.clock)
    trial = on_true_map(next(drive), building().world)
    drive.close()
    assert trial.outcome == "satisfied"
    assert problems_of_drive(trial, building().world) == []
    damaged = dataclasses.replace(trial, cost=trial.cost + 1, word=(*trial.word[:-1], 0))
    assert len(problems_of_drive(damaged, building().world)) == 2


@pytest.mark.parametrize(
    ("columns", "length"),
    [
        ((0, 1, 2, 3), 0),
        ((0, 1, 2, 1, 2, 3), 3),
        ((3, 4, 5, 6, 5, 4, 3, 2), 6),
        ((0, 1, 2, 1, 0, -1), 4),
        ((0, 1, 0, 1, 0), 4),
    ],
)
def test_what_is_driven_to_and_fro_counts_once(columns, length):
    assert length_to_and_fro([(0, column) for column in columns]) == length
