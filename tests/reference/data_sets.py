"""Parts of data sets that a test needs and does not care about: maps of which nothing is known."""

import dataclasses
from typing import Any

import numpy as np

from potlp_jax.learning.map_images import EncodedView, EncodedWorld, encode_view, encode_world
from potlp_jax.learning.painting import blank_painting
from potlp_jax.world.grid import BeliefMap, make_world

SHAPE = (6, 8)
"""Of the maps."""


def blank_map() -> tuple[EncodedView, EncodedWorld]:
    """A small room of which nothing is known."""
    occupied = np.ones(SHAPE, bool)
    occupied[1:-1, 1:-1] = False
    world = make_world(occupied, np.zeros(SHAPE, np.int32), (1, 1), propositions=("goal",))
    return encode_view(BeliefMap.unobserved(world), blank_painting(*SHAPE)), encode_world(world)


def blank_fields(views: int, samples: int) -> dict[str, Any]:
    """Fields of ``Samples`` that only networks which read maps look at; all subgoals are in view."""
    view, world = blank_map()
    return {
        "maps": [view] * views,
        "worlds": [world],
        "world_of": np.zeros(views, np.int32),
        "cells": np.ones((samples, 2), np.int32),
        "in_view": np.ones(samples, bool),
    }


def blank_columns(views: int) -> dict[str, list[bytes]]:
    """Columns of the views' maps in a file."""
    return {name: [image] * views for name, image in dataclasses.asdict(blank_map()[0]).items()}


def world_columns(*numbers: int) -> dict[str, list[Any]]:
    """Columns of worlds with these numbers in a file."""
    world = dataclasses.asdict(blank_map()[1])
    return {"world": list(numbers), **{name: [value] * len(numbers) for name, value in world.items()}}
