"""A robot that drives on while it is decided: what is handed over begins beside it, and means the same to the task."""

import itertools
import json

import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.drive.config import DriveConfig
from potlp_jax.drive.inbox import Inbox
from potlp_jax.drive.movers import Adviser
from potlp_jax.drive.rejoining import rest_of_path
from potlp_jax.drive.robot import RemoteRobot
from potlp_jax.environments.ros.poses import shortest
from potlp_jax.planning.distances.paths import KnownPath
from potlp_jax.trials.rules import Stop
from potlp_jax.world.moves import legal_moves, path_length


def without_repeats(letters):
    return [letter for letter, _ in itertools.groupby(letters)]


def some_drive(rng):
    """A map, a planned path, and a walk from its first cell: along another path, or anywhere."""
    while True:
        free = rng.random((9, 12)) < 0.75
        letters = np.where(rng.random(free.shape) < 0.15, rng.integers(1, 4, free.shape), 0).astype(np.int32)
        cells = [tuple(map(int, cell)) for cell in np.argwhere(free)]
        start, end, other = (cells[index] for index in rng.integers(0, len(cells), 3))
        try:
            planned, before = ([start, *shortest(free, start, there)] for there in (end, other))
        except KeyError:
            continue
        return free, letters, planned, before[1 : 1 + rng.integers(0, 6)]


def test_the_rest_begins_beside_the_robot_and_says_the_same_to_the_task():
    rng, shorter, back = np.random.default_rng(0), 0, 0
    for _ in range(3000):
        free, letters, planned, entered = some_drive(rng)
        rest = rest_of_path(planned, entered, free, letters)
        here = entered[-1] if entered else planned[0]
        for cell, following in itertools.pairwise([here, *rest]):
            assert following in {there for there, _ in legal_moves(free, cell)}
        assert [here, *rest][-1] == planned[-1]
        # All the way back and then the path: what was done before, and never shorter.
        whole = [*reversed(entered[:-1]), *planned] if entered else planned[1:]
        assert path_length([here, *rest]) <= path_length([here, *whole]) + 1e-9
        driven, wanted = (
            without_repeats(letters[cell] for cell in cells)
            for cells in ([planned[0], *entered, *rest], [planned[0], *entered, *whole])
        )
        assert driven == wanted
        shorter += len(rest) < len(whole)
        back += rest == whole and bool(entered)
    # Both happen.
    assert min(shorter, back) > 300


def test_of_cells_that_matter_to_the_task_none_is_left_out():
    free, letters = np.ones((3, 7), bool), np.zeros((3, 7), np.int32)
    planned, entered = [(1, column) for column in range(7)], [(0, 1), (0, 2), (0, 3)]
    assert rest_of_path(planned, entered, free, letters) == planned[4:]
    letters[1, 3] = 1
    assert rest_of_path(planned, entered, free, letters) == planned[3:]
    # What it has driven through may have changed what the path is for.
    letters[0, 2] = 1
    assert rest_of_path(planned, entered, free, letters) == [(0, 2), (0, 1), *planned]


class Listening(Adviser):
    """Commands a robot that does not exist."""

    commands = True

    def __init__(self):
        self.begun = []

    def begin(self, points, frame_id):
        self.begun.append(points)


def pose(x):
    place = {"translation": {"x": x, "y": 0.75}, "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    header = {"frame_id": "map", "stamp": {"sec": int(10 * x), "nanosec": 0}}
    return {"transforms": [{"header": header, "child_frame_id": "base_link", "transform": place}]}


@pytest.mark.parametrize(("there", "first"), [(0.25, 0.75), (1.75, 2.25), (2.75, 3.25)])
def test_what_is_driven_while_it_is_decided_is_not_driven_twice(there, first):
    inbox, mover = Inbox(DriveConfig(resolution=0.5, radius=0.0), ("exit",)), Listening()
    info = {"resolution": 0.5, "width": 12, "height": 3, "origin": pose(0)["transforms"][0]["transform"]}
    info["origin"] = {"position": {"x": 0.0, "y": 0.0}, "orientation": info["origin"]["rotation"]}
    stamped = {"frame_id": "map", "stamp": {"sec": 0, "nanosec": 0}}
    inbox.handle("/map", {"header": stamped, "info": info, "data": [0] * 36})
    inbox.handle("/tf", pose(0.25))
    inbox.handle("/potlp/places", {"data": json.dumps({})})
    config = DriveConfig(resolution=0.5, radius=0.0)
    # Once its goal is sent.
    robot = RemoteRobot(inbox, mover, config, ("exit",), interrupted=lambda: bool(mover.begun))
    _, (row, column) = robot.observe()
    for x in np.arange(0.75, there + 0.1, 0.5):
        inbox.handle("/tf", pose(float(x)))
    cells = jnp.array([[row, column + number] for number in range(10)], jnp.int32)
    path = KnownPath(cells=cells, states=jnp.zeros(10, jnp.int32), length=jnp.int32(9), cost=jnp.float32(4.5))
    leg = robot.advance(path, Stop(replan_distance=jnp.float32(4), budget=jnp.float32(99), is_frontier=jnp.bool_(True)))
    assert [cell[1] - column for cell in leg.cells] == list(range(1, round((there - 0.25) / 0.5) + 1))
    (points,) = mover.begun
    assert points[0] == pytest.approx((first, 0.75))
    assert points[-1] == pytest.approx((4.75, 0.75))
