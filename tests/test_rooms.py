"""Floors of rooms: every free cell can be reached, whatever size the rooms have."""

import dataclasses

import numpy as np
import pytest
from scipy import ndimage

from potlp_jax.environments.rooms import Rooms, RoomsConfig
from potlp_jax.errors import WorldError


@pytest.mark.parametrize("room", [3, 4, 5])
def test_obstacles_leave_a_way_around_them_in_the_smallest_rooms(room):
    config = RoomsConfig(smallest=24, largest=40, room=room, obstacles=1.0, patches=1, patch_radius=0)
    for number in range(40):
        free = ~np.asarray(Rooms(config).world(number).occupied)
        # Corners do not join cells: the robot may not pass between two obstacles.
        assert ndimage.label(free)[1] == 1


def test_large_rooms_have_obstacles():
    """Three cells a side, in rooms that are wide enough."""
    with_one, without = (RoomsConfig(smallest=24, largest=24, obstacles=share) for share in (1.0, 0.0))
    cells = [int(np.asarray(Rooms(config).world(1).occupied).sum()) for config in (with_one, without)]
    assert dataclasses.replace(with_one, obstacles=0.0) == without
    assert cells[0] - cells[1] >= 9


def test_tasks_hold_names_of_any_kind():
    names = ("my room", "U", "küche", "b")
    rooms = Rooms(RoomsConfig(propositions=names))
    assert all(rooms.task(number).propositions == names for number in ("1", "2"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"propositions": ()}, "propositions is empty"), ({"loops": float("nan")}, "loops is nan; give a number from 0")],
)
def test_floors_that_cannot_be_are_refused(changes, message):
    with pytest.raises(WorldError, match=message):
        RoomsConfig(**changes)
