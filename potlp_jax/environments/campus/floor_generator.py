"""What generators of floors share: a building and the people in it follow from the key of their world."""

import abc
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from potlp_jax.environments.base import Generator, host_generators
from potlp_jax.environments.campus.furnishing import Errand, Floor, FurnishConfig, Placement, furnish, missing_kinds
from potlp_jax.environments.campus.people_posterior import PeoplePosterior, people_posterior
from potlp_jax.errors import WorldError
from potlp_jax.world.grid import World

_ATTEMPTS = 20
"""Buildings that are drawn, at most, until one has the kinds of rooms that the errand needs."""


class FloorGenerator(Generator):
    """Generator of floors with an errand on them. A class of its own says how a building is drawn.

    Attributes:
        name: the family's; it goes into the keys of its worlds.
        errand: who is to be found, and where they can be.
    """

    def __init__(
        self, config: Any, shape: tuple[int, int], furnishing: FurnishConfig, name: str, errand: Errand
    ) -> None:
        """Of this configuration, with arrays of this shape.

        Args:
            config: parameters of the buildings; kept, and read by ``build`` alone.
            shape: rows and columns of the worlds' arrays.
            furnishing: people, light and colours.
            name: the family's.
            errand: who is to be found, and where they can be.
        """
        self.config = config
        self.name = name
        self.errand = errand
        self.propositions = errand.propositions
        self.tasks = errand.tasks
        self._shape, self._furnishing = shape, furnishing

    @abc.abstractmethod
    def build(self, rng: np.random.Generator) -> Floor:
        """Draw one building, which may lack what the errand needs."""

    def draw(self, key: PRNGKeyArray) -> World:
        """The world of this key."""
        return self.generate_with_layout(key)[0]

    def generate_with_layout(self, key: PRNGKeyArray) -> tuple[World, Floor, Placement]:
        """The world of this key, its floor without padding, and who is where.

        Raises:
            WorldError: the configuration leaves no space for the rooms that the errand needs.
        """
        # The building does not change with the people in it. No setting of jax changes either.
        with jax.threefry_partitionable(True):
            floor_key, furnish_key = jax.random.split(key)
        floor = self.draw_floor(floor_key)
        world, placement = furnish(floor, furnish_key, self.errand, self._furnishing, self._shape)
        return self.signed(world), floor, placement

    def posterior(self, key: PRNGKeyArray, noise: PRNGKeyArray, count: int) -> PeoplePosterior:
        """Who may be where on the floor of a key, the floor being known; see ``Generator.posterior``.

        Args:
            key: of the world, as of ``generate``: its floor is known from the start; in which rooms there is light is
                read as these come in sight.
            noise: another key; decides which places of people are drawn.
            count: how many floors are drawn at a time.

        Returns:
            The posterior before the first panorama: people are in any room of their kinds, all equally likely.

        Raises:
            WorldError: no world can be made (``generate_with_layout``), or the errand's people share rooms in another
                way than ``people_posterior`` can draw.
        """
        _, floor, placement = self.generate_with_layout(key)
        reach = self._furnishing.person_radius
        return people_posterior(floor, self.errand, reach, placement.rooms, self._shape, noise, count)

    def draw_floor(self, key: PRNGKeyArray) -> Floor:
        """The building alone, with every kind of room that the task needs."""
        (rng,) = host_generators(key, 1)
        for _ in range(_ATTEMPTS):
            floor = self.build(rng)
            if not missing_kinds(floor, self.errand):
                return floor
        raise WorldError(f"no floor of {_ATTEMPTS} had the rooms that {self.name} needs; make largest larger")
