"""The fire-fighting building of Bradley et al. 2021, section V-A: two rooms joined by three hallways.

``firefighting_layout`` says where things are in it, and ``firefighting_posterior`` what can be where, to a robot that
has seen a part of it. Here it gets its colours, its tasks and its name.
"""

from collections.abc import Mapping
from types import MappingProxyType

import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray, UInt8

from potlp_jax.environments.base import Generator, host_generators
from potlp_jax.environments.firefighting_layout import (
    PROPOSITIONS,
    Building,
    FirefightingConfig,
    FirefightingLayout,
    Shares,
    building_of,
    hallway_columns,
    layout_of,
)
from potlp_jax.environments.firefighting_posterior import FirefightingPosterior, firefighting_posterior
from potlp_jax.world.grid import Appearance, World, make_world

# RGB in full light. Rooms are brownish, hallways bluish; only the tiles of the dead end tell one hallway from another.
_ROOM_FLOOR, _ROOM_WALL = (164, 148, 128), (214, 206, 188)
_HALLWAY_FLOOR, _HALLWAY_WALL = (128, 132, 142), (188, 196, 206)
_GREEN_TILES = ((40, 150, 70), (96, 196, 112))


class Firefighting(Generator):
    """Generator of fire-fighting buildings (Bradley et al. 2021, section V-A)."""

    name: str = "firefighting"
    propositions: tuple[str, ...] = PROPOSITIONS
    tasks: Mapping[str, str] = MappingProxyType(
        {
            "1": "(!fire U alarm) | ((!fire U extinguisher) & F fire)",
            "2": "!fire U (alarm & F exit)",
            "3": "(!fire U extinguisher) & F (fire & F exit)",
            "4": "!fire U exit",
        }
    )

    def __init__(self, config: FirefightingConfig | None = None) -> None:
        self.config = FirefightingConfig() if config is None else config

    @classmethod
    def toy(cls) -> "Firefighting":
        """A building of the same plan on 23 x 38 cells."""
        return cls(
            FirefightingConfig(
                room_width=10, room_height=21, hallway_length=16, hallway_width=3, hallway_spacing=7, smoke_reach=3.0
            )
        )

    def draw(self, key: PRNGKeyArray) -> World:
        """The world of this key."""
        return self.generate_with_layout(key)[0]

    def posterior(self, key: PRNGKeyArray, noise: PRNGKeyArray, count: int) -> FirefightingPosterior:
        """What the building of this key can be, to a robot that knows in which room it is.

        Args:
            key: of the world, as of ``generate``: the room of the robot is known from the start; the rest of the
                building is read as it comes in sight.
            noise: another key; decides which buildings are drawn.
            count: how many buildings are drawn at a time.

        Returns:
            The posterior before the first panorama: the generator's own probabilities of hallways, alarm and fire, and
            all places of extinguisher and exit in the far room alike.
        """
        return firefighting_posterior(self.config, self._layout(key), noise, count)

    def generate_with_layout(self, key: PRNGKeyArray) -> tuple[World, FirefightingLayout]:
        """The world of this key, and where things are in it."""
        _, look_rng = host_generators(key, 2)
        layout = self._layout(key)
        built = building_of(self.config, layout)
        look = _appearance(self.config, built, look_rng)
        return self.signed(
            make_world(built.occupied, built.letters, layout.start, appearance=look, propositions=self.propositions)
        ), layout

    def _layout(self, key: PRNGKeyArray) -> FirefightingLayout:
        layout_rng, _ = host_generators(key, 2)
        # One number a choice, always in this order: a changed configuration moves nothing that it does not concern.
        return layout_of(self.config, Shares(*layout_rng.random(len(Shares._fields)).tolist()))


def _appearance(config: FirefightingConfig, built: Building, rng: np.random.Generator) -> Appearance:
    rows, columns = np.indices(config.shape)
    first, last = hallway_columns(config)
    in_hallways = (columns >= first) & (columns < last)
    # The outermost wall cells between hallways face the rooms.
    room_side = (columns <= first) | (columns >= last - 1)
    even = (rows // config.tile_size + columns // config.tile_size) % 2 == 0
    # Every world has its own shade of each colour: a network must not learn one by heart.
    tints = rng.integers(-config.tint, config.tint + 1, size=(6, 3))
    palette = np.array([_ROOM_FLOOR, _HALLWAY_FLOOR, *_GREEN_TILES, _ROOM_WALL, _HALLWAY_WALL]) + tints
    # Indices into the palette.
    floor = np.where(built.green, np.where(even, 2, 3), np.where(in_hallways, 1, 0))
    wall = np.where(room_side, 4, 5)
    noise = rng.integers(-config.tint_noise, config.tint_noise + 1, size=(2, *config.shape, 1))
    return Appearance(
        floor_colour=jnp.asarray(_colours(palette[floor] + noise[0])),
        wall_colour=jnp.asarray(_colours(palette[wall] + noise[1])),
        smoke=jnp.asarray(built.smoke),
        light=jnp.asarray(np.ones(config.shape, np.float32)),
    )


def _colours(values: np.ndarray) -> UInt8[np.ndarray, "H W 3"]:
    return np.clip(values, 0, 255).astype(np.uint8)
