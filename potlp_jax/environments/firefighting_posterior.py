"""The fire-fighting buildings that agree with what a robot has seen: the exact posterior of the generator's layouts.

Hallways, alarm and fire are few choices: all their combinations are listed once, with their probabilities, and those
that contradict an observation drop out. Where extinguisher and exit lie in the far room is independent of them, given
the robot's room, and is drawn apart.

``FirefightingPosterior`` is what ``Firefighting.posterior`` returns (``environments.posterior``).
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, PRNGKeyArray, UInt8

from potlp_jax.environments.firefighting_layout import (
    PROPOSITIONS,
    Building,
    FirefightingConfig,
    FirefightingLayout,
    Room,
    Shares,
    building_of,
    layout_of,
    room_cells,
)
from potlp_jax.environments.posterior import Drawn
from potlp_jax.world.grid import BeliefMap
from potlp_jax.world.sensing import SensorConfig, visible

# Bits of a cell's code.
OCCUPIED, GREEN, SMOKY, FIRE, ALARM = (1 << bit for bit in range(5))
SIGNS = GREEN | SMOKY
"""What the camera shows and the mapping sensor does not."""
_MAPPED = OCCUPIED | FIRE | ALARM

SMOKE_SEEN: float = 0.01
"""Density above which smoke in a cell is seen; nearer to the fire it is denser."""

_BIT = {name: 1 << index for index, name in enumerate(PROPOSITIONS)}
_EVEN_SHARES = Shares(*[0.5] * len(Shares._fields))


def code_of(building: Building) -> UInt8[np.ndarray, "H W"]:
    """Walls, tiles, smoke, fire and alarm of every cell in one byte each."""
    code = np.where(building.occupied, OCCUPIED, 0) | np.where(building.green, GREEN, 0)
    code |= np.where(building.smoke > SMOKE_SEEN, SMOKY, 0)
    code |= np.where(building.letters & _BIT["fire"], FIRE, 0) | np.where(building.letters & _BIT["alarm"], ALARM, 0)
    return code.astype(np.uint8)


@struct.dataclass(kw_only=True)
class Prior:
    """What the generator can build around a robot in one of the rooms.

    Attributes:
        codes: of each combination of dead end, its mouth, fire's hallway and fire's place (``code_of``).
        probability: of each combination.
        middles: where the middles of extinguisher and exit may lie, all alike.
        reach: cells from the middle of their patches to the sides; static.
    """

    codes: UInt8[Array, "K H W"]
    probability: Float32[Array, " K"]
    middles: Bool[Array, "H W"]
    reach: int = struct.field(pytree_node=False)


@functools.lru_cache(maxsize=8)
def prior_of(config: FirefightingConfig, robot_room: Room) -> Prior:
    """The generator's distribution of buildings, given the room in which the robot starts."""
    layouts, probability = zip(*_layouts(config, robot_room), strict=True)
    middles = np.zeros(config.shape, bool)
    middles[tuple(room_cells(config, robot_room.other, config.patch_radius).T)] = True
    return Prior(
        codes=jnp.asarray(np.stack([code_of(building_of(config, layout)) for layout in layouts])),
        probability=jnp.asarray(np.array(probability, np.float32)),
        middles=jnp.asarray(middles),
        reach=config.patch_radius,
    )


def _layouts(config: FirefightingConfig, robot_room: Room) -> Iterator[tuple[FirefightingLayout, float]]:
    """Every combination of what is not drawn apart, with its probability; start, extinguisher and exit are anywhere."""
    side = 0.0 if robot_room is Room.LEFT else 0.5
    even = _EVEN_SHARES._replace(side=side)

    def choose(**shares: float) -> FirefightingLayout:
        return layout_of(config, even._replace(**shares))

    mouths = _pieces(lambda share: choose(mouth=share).dead_end_mouth)
    dead_ends = _pieces(lambda share: choose(dead_end=share).dead_end)
    burning = _pieces(lambda share: choose(fire_hallway=share).fire_hallway)
    # Where the fire can be depends on whether it burns in the dead end, and on nothing else.
    in_dead_end, elsewhere = (
        _pieces(lambda share, hallway=hallway: choose(dead_end=0.0, fire_hallway=hallway, fire=share).fire_columns)
        for hallway in (0.0, 0.5)
    )
    for (mouth, p), (dead_end, q), (hallway, r) in itertools.product(mouths, dead_ends, burning):
        for fire, s in in_dead_end if hallway == dead_end else elsewhere:
            yield choose(mouth=mouth, dead_end=dead_end, fire_hallway=hallway, fire=fire), p * q * r * s


def _pieces(choice: Callable[[float], Any]) -> list[tuple[float, float]]:
    """The intervals of [0, 1) on which a monotone choice stays the same: where each begins and how long it is."""
    found, begin = [], 0.0
    while begin < 1.0:
        chosen, inside, outside = choice(begin), begin, 1.0
        # Bisection down to neighbouring floats: shares are floats too, so no probability is lost.
        while (middle := (inside + outside) / 2) not in (inside, outside):
            inside, outside = (middle, outside) if choice(middle) == chosen else (inside, middle)
        found.append((begin, outside - begin))
        begin = outside
    return found


@struct.dataclass(kw_only=True)
class Evidence:
    """What the camera showed beside the map.

    Attributes:
        in_sight: cells whose floor has been in line of sight, however far away.
        signs: their tiles and smoke (``SIGNS``); 0 elsewhere.
    """

    in_sight: Bool[Array, "*batch H W"]
    signs: UInt8[Array, "*batch H W"]


@struct.dataclass(kw_only=True)
class Noise:
    """What drawn buildings are made of, the same at every decision; exponential variables, by drawn building."""

    extinguisher: Float32[Array, "N H W"]
    exit: Float32[Array, "N H W"]


@struct.dataclass(kw_only=True)
class FirefightingPosterior:
    """The buildings around one robot that agree with the map and with what its camera showed.

    What the camera showed: tiles and smoke of every floor cell that has been in line of sight from where a panorama was
    taken, at any distance.

    Attributes:
        evidence: what the camera showed so far.
        prior: what can be built.
        noise: of the buildings that are drawn.
        truth: codes of the building in which the robot is; read for what is in line of sight, and for nothing else.
    """

    evidence: Evidence
    prior: Prior
    noise: Noise
    truth: UInt8[Array, "H W"]

    def after(self, cell: Int32[Array, "2"]) -> "FirefightingPosterior":
        """The posterior after a panorama from ``cell``."""
        occupied = self.truth & OCCUPIED > 0
        # The longest line of sight on the grid is shorter than the sum of its sides.
        everywhere = SensorConfig(range_cells=float(sum(occupied.shape)))
        in_sight = self.evidence.in_sight | (visible(occupied, cell, everywhere) & ~occupied)
        signs = jnp.where(in_sight, self.truth & SIGNS, 0).astype(jnp.uint8)
        return dataclasses.replace(self, evidence=Evidence(in_sight=in_sight, signs=signs))

    def draw(self, belief: BeliefMap) -> Drawn:
        """Buildings of the posterior."""
        occupied, letters = draw_buildings(self.prior, belief, self.evidence, self.noise)
        agrees = jnp.sum(posterior(self.prior, belief, self.evidence)) > 0.0
        return Drawn(occupied=occupied, letters=letters, agrees=agrees)


def firefighting_posterior(
    config: FirefightingConfig, layout: FirefightingLayout, key: PRNGKeyArray, count: int
) -> FirefightingPosterior:
    """The posterior of a robot that has seen nothing yet.

    Args:
        config: of the generator.
        layout: of the building in which the robot is.
        key: of the noise.
        count: how many buildings are drawn at a time.

    Returns:
        What the robot's building can be.
    """
    return FirefightingPosterior(
        evidence=Evidence(in_sight=jnp.zeros(config.shape, bool), signs=jnp.zeros(config.shape, jnp.uint8)),
        prior=prior_of(config, layout.robot_room),
        noise=draw_noise(key, count, config.shape),
        truth=jnp.asarray(code_of(building_of(config, layout))),
    )


def draw_noise(key: PRNGKeyArray, count: int, shape: tuple[int, int]) -> Noise:
    """What buildings are drawn with: exponential variables, of which the first to arrive is the cell of a patch.

    Args:
        key: of the noise; it is split, and not to be used again.
        count: N, the number of buildings.
        shape: rows and columns of a building.

    Returns:
        Independent variables of mean 1, one for each building and cell, for the extinguisher and for the exit.
    """
    one, other = jax.random.split(key)
    return Noise(
        extinguisher=jax.random.exponential(one, (count, *shape), jnp.float32),
        exit=jax.random.exponential(other, (count, *shape), jnp.float32),
    )


def posterior(prior: Prior, belief: BeliefMap, evidence: Evidence) -> Float32[Array, " K"]:
    """The probability of each combination of dead end, mouth and fire, given what was seen.

    Observation is perfect, so that a combination which contradicts a cell drops out, and the others keep their
    proportions. What was seen of extinguisher and exit is not looked at: it says nothing of the hallways.

    Args:
        prior: of the robot's room.
        belief: the map, of the building's shape; walls, fire and alarm are compared where a cell was observed.
        evidence: what the camera showed; tiles and smoke are compared where a cell was in sight.

    Returns:
        Probabilities that add up to 1; all 0 where no combination agrees.
    """
    weight = jnp.where(_agrees(prior, belief, evidence), prior.probability, 0.0)
    total = jnp.sum(weight)
    return weight / jnp.where(total > 0.0, total, 1.0)


def _agrees(prior: Prior, belief: BeliefMap, evidence: Evidence) -> Bool[Array, " K"]:
    """Which combinations agree with every cell that was mapped, and with every sign that was in sight."""
    letters = jnp.where(belief.letters & _BIT["fire"] > 0, FIRE, 0)
    letters = letters | jnp.where(belief.letters & _BIT["alarm"] > 0, ALARM, 0)
    observed = (letters | jnp.where(belief.occupied, OCCUPIED, 0)).astype(jnp.uint8) | evidence.signs
    compared = jnp.where(belief.unknown, 0, _MAPPED) | jnp.where(evidence.in_sight, SIGNS, 0)
    return ~jnp.any((prior.codes ^ observed[None]) & compared.astype(jnp.uint8)[None], axis=(1, 2))


def draw_buildings(
    prior: Prior, belief: BeliefMap, evidence: Evidence, noise: Noise
) -> tuple[Bool[Array, "N H W"], Int32[Array, "N H W"]]:
    """Buildings from the posterior, as many as the noise is for.

    Args:
        prior: of the robot's room.
        belief: what was mapped.
        evidence: what the camera showed.
        noise: of the draws.

    Returns:
        Walls and letters of each. They mean nothing where no building agrees with what was seen (``posterior``).
    """
    count = noise.exit.shape[0]
    # Systematic sampling: every combination is drawn as often as its probability says, to within one building. Drawn
    # one by one, P_S would be off by some tenth.
    cumulated = jnp.cumsum(posterior(prior, belief, evidence))
    points = jnp.asarray((np.arange(count) + 0.5) / count, jnp.float32) * cumulated[-1]
    # The first entry that reaches a point adds something to the sum: none of probability 0 is drawn.
    codes = prior.codes[jnp.searchsorted(cumulated, points)]
    extinguisher, exit = _draw_patches(prior, belief, noise)
    letters = jnp.where(codes & FIRE > 0, _BIT["fire"], 0) | jnp.where(codes & ALARM > 0, _BIT["alarm"], 0)
    letters = letters | jnp.where(extinguisher, _BIT["extinguisher"], 0) | jnp.where(exit, _BIT["exit"], 0)
    return codes & OCCUPIED > 0, letters.astype(jnp.int32)


def _draw_patches(prior: Prior, belief: BeliefMap, noise: Noise) -> tuple[Bool[Array, "N H W"], Bool[Array, "N H W"]]:
    """Cells of extinguisher and exit."""
    near = 2 * prior.reach
    middles = _fits(prior, belief, "extinguisher")
    exits = _fits(prior, belief, "exit")
    # The generator draws the exit among the cells apart from the extinguisher, of which there are more or fewer: a
    # place of the extinguisher is as likely as the share of these at which the exit agrees with the map.
    apart, possible = (jnp.sum(mask) - _box_sum(mask, near) for mask in (prior.middles, exits))
    weight = jnp.where(middles, possible / jnp.maximum(apart, 1), 0.0)
    extinguisher = _first(noise.extinguisher, weight[None])
    exit = _first(noise.exit, jnp.where(exits[None] & ~_patches(extinguisher, near), 1.0, 0.0))
    return _patches(extinguisher, prior.reach), _patches(exit, prior.reach)


def _fits(prior: Prior, belief: BeliefMap, name: str) -> Bool[Array, "H W"]:
    """Where the middle of a proposition's patch can be: it covers what was seen of it, and nothing seen to be none."""
    has = belief.letters & _BIT[name] > 0
    lacks = ~belief.unknown & ~has
    return prior.middles & (_box_sum(has, prior.reach) == jnp.sum(has)) & (_box_sum(lacks, prior.reach) == 0)


def _box_sum(mask: Bool[Array, "H W"], reach: int) -> Int32[Array, "H W"]:
    """How many cells of the mask are within ``reach`` rows and columns of each cell."""
    side = 2 * reach + 1
    return jax.lax.reduce_window(mask.astype(jnp.int32), np.int32(0), jax.lax.add, (side, side), (1, 1), "SAME")


def _first(noise: Float32[Array, "N H W"], weight: Float32[Array, "_ H W"]) -> Bool[Array, "N H W"]:
    """One cell of each building, drawn in proportion to the weights: that with the least noise over weight.

    A cell stays drawn for as long as it has a weight, whatever drops out beside it.
    """
    # Of exponential variables with rates w the first is number i with probability w_i / Σ w.
    race = jnp.where(weight > 0.0, noise / jnp.where(weight > 0.0, weight, 1.0), jnp.inf).reshape(noise.shape[0], -1)
    chosen = jnp.argmin(race, axis=1)
    return (jnp.arange(race.shape[1])[None] == chosen[:, None]).reshape(noise.shape)


def _patches(middles: Bool[Array, "N H W"], reach: int) -> Bool[Array, "N H W"]:
    return jax.vmap(functools.partial(_box_sum, reach=reach))(middles) > 0
