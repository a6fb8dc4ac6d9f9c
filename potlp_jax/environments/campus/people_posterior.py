"""Who may be where on a floor, to a robot that has seen a part of it: the posterior of `furnishing.furnish`.

The floor is taken as known: its walls and the kinds of its rooms are those of the robot's own building, and only the
people are drawn. So the answers are those of an observer who has the floor plan, which bounds from above what can be
known of a floor that was never seen. As labels they are as good as the means over all floors would be: the robot's own
floor is one of those that agree with what it has seen, drawn in proportion to its probability, so that the means of
both are the same and only their noise differs.

What was seen: whether rooms are lit, of every room of which a floor cell has been in line of sight from where a
panorama was taken, and the map.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, PRNGKeyArray

from potlp_jax.environments.campus.furnishing import NO_ROOM, Errand, Floor
from potlp_jax.environments.posterior import Drawn
from potlp_jax.errors import WorldError
from potlp_jax.world.grid import BeliefMap
from potlp_jax.world.sensing import SensorConfig, visible

# Numbers of rooms are padded to multiples of this, so that not every floor compiles anew.
_ROOMS = 64


@struct.dataclass(kw_only=True)
class Plan:
    """What the observer knows of the floor.

    Attributes:
        occupied: True on obstacles.
        rooms: number of the room of each free cell, ``NO_ROOM`` elsewhere.
        prior: of each person, the probability of each middle cell.
        by_room: indices of the flat grid, room by room, so that neighbouring strata of a draw are in one room.
        reach: cells from a person's middle cell on which the person is met; static.
        room_count: of rooms, padded; static.
        groups: people who may be in the same rooms, by the index of their proposition; static.
    """

    occupied: Bool[Array, "H W"]
    rooms: Int32[Array, "H W"]
    prior: Float32[Array, "P H W"]
    by_room: Int32[Array, " _"]
    reach: int = struct.field(pytree_node=False)
    room_count: int = struct.field(pytree_node=False)
    groups: tuple[tuple[int, ...], ...] = struct.field(pytree_node=False)


@struct.dataclass(kw_only=True)
class PeoplePosterior:
    """Where people are, given the floor, the map and the lights that were seen.

    Attributes:
        evidence: floor cells that have been in line of sight from where panoramas were taken, however far away.
        plan: the floor.
        strata: of each person, the stratum that each drawn building takes: a permutation, the same at every decision.
        lit: rooms in which somebody is; read of what is in line of sight, and of nothing else.
    """

    evidence: Bool[Array, "*batch H W"]
    plan: Plan
    strata: Int32[Array, "P N"]
    lit: Bool[Array, " R"]

    def after(self, cell: Int32[Array, "2"]) -> "PeoplePosterior":
        """The posterior after a panorama from ``cell``."""
        occupied = self.plan.occupied
        # The longest line of sight on the grid is shorter than the sum of its sides.
        everywhere = SensorConfig(range_cells=float(sum(occupied.shape)))
        in_sight = self.evidence | (visible(occupied, cell, everywhere) & ~occupied)
        return dataclasses.replace(self, evidence=in_sight)

    def draw(self, belief: BeliefMap) -> Drawn:
        """Floors with the people of the posterior."""
        plan = self.plan
        seen = self._of_rooms(self.evidence.astype(jnp.float32)) > 0
        lit, dark = seen & self.lit, seen & ~self.lit
        fits = jnp.stack([_fits(plan, belief, person) for person in range(plan.prior.shape[0])])
        weights = jnp.where(fits & ~dark[plan.rooms][None], plan.prior, 0.0)
        count = self.strata.shape[1]
        letters = jnp.zeros((count, *plan.rooms.shape), jnp.int32)
        agrees = jnp.bool_(True)
        for group in plan.groups:
            drawn, agree = self._draw_group(group, weights, lit)
            agrees &= agree
            for person, cells in zip(group, drawn, strict=True):
                letters |= jnp.where(_patches(plan, cells), 1 << person, 0)
        occupied = jnp.broadcast_to(plan.occupied, letters.shape)
        return Drawn(occupied=occupied, letters=letters, agrees=agrees)

    def _draw_group(
        self, group: tuple[int, ...], weights: Float32[Array, "P H W"], lit: Bool[Array, " R"]
    ) -> tuple[list[Int32[Array, " N"]], Bool[Array, ""]]:
        """Middle cells of one person, or of two who share their rooms but no room; whether there are any."""
        # Lights that only these people can have turned on.
        theirs = lit & (self._of_rooms(jnp.max(self.plan.prior[jnp.asarray(group)], axis=0)) > 0)
        rooms = self.plan.rooms
        if len(group) == 1:
            (person,) = group
            own = jnp.where(~jnp.any(theirs) | theirs[rooms], weights[person], 0.0)
            return [self._cells(own[None], person)], jnp.sum(own) > 0
        one, other = group
        chance = self._of_rooms(weights[other])
        # Of lit rooms the second person must be in those in which the first is not.
        left = jnp.sum(theirs, dtype=jnp.int32) - theirs.astype(jnp.int32)
        in_lit = jnp.sum(jnp.where(theirs, chance, 0.0)) - jnp.where(theirs, chance, 0.0)
        possible = jnp.where(left == 0, jnp.sum(chance) - chance, jnp.where(left == 1, in_lit, 0.0))
        # Differences of sums: what is left of a person who can be in one room alone must not be a rounding error.
        possible = jnp.where(possible > 1e-6, possible, 0.0)
        first = weights[one] * possible[rooms]
        cells = self._cells(first[None], one)
        at = rooms.reshape(-1)[cells]
        elsewhere = rooms[None] != at[:, None, None]
        wanted = jnp.where((left[at] == 1)[:, None, None], theirs[rooms][None], True)
        second = jnp.where(elsewhere & wanted, weights[other][None], 0.0)
        return [cells, self._cells(second, other)], jnp.sum(first) > 0

    def _cells(self, weights: Float32[Array, "_ H W"], person: int) -> Int32[Array, " N"]:
        """A cell for each building in proportion to the weights, as systematic sampling draws them.

        Each cell, and each room, is drawn as often as its probability says, to within one building.
        """
        flat = weights.reshape(weights.shape[0], -1)[:, self.plan.by_room]
        cumulated = jnp.cumsum(flat, axis=1)
        count = self.strata.shape[1]
        points = (self.strata[person].astype(jnp.float32) + 0.5) / count * cumulated[:, -1]
        cumulated = jnp.broadcast_to(cumulated, (count, flat.shape[1]))
        # The first entry that reaches a point adds something to the sum: none of probability 0 is drawn.
        return self.plan.by_room[jax.vmap(jnp.searchsorted)(cumulated, points)]

    def _of_rooms(self, values: Float32[Array, "H W"]) -> Float32[Array, " R"]:
        """Sums over the cells of each room."""
        rooms = self.plan.rooms
        inside = jnp.where(rooms == NO_ROOM, 0.0, values)
        return jax.ops.segment_sum(inside.reshape(-1), rooms.reshape(-1), num_segments=self.plan.room_count)


def people_posterior(
    floor: Floor,
    errand: Errand,
    reach: int,
    placed: Mapping[str, int],
    shape: tuple[int, int],
    key: PRNGKeyArray,
    count: int,
) -> PeoplePosterior:
    """The posterior of a robot that has seen nothing yet but has the floor plan.

    Args:
        floor: the building.
        errand: who is to be found, and in which kinds of rooms.
        reach: ``FurnishConfig.person_radius``.
        placed: the room of each person who is there (``Placement.rooms``); read for the lights alone.
        shape: rows and columns of the world's arrays.
        key: of the noise.
        count: how many floors are drawn at a time.

    Returns:
        Where the people can be.

    Raises:
        WorldError: more than two people may be in the same rooms, or some rooms are for one of them and not for
            another.
    """
    rooms = np.full(shape, NO_ROOM, np.int32)
    rows, columns = floor.rooms.shape
    rooms[:rows, :columns] = floor.rooms
    doors = np.zeros(shape, bool)
    doors[:rows, :columns] = floor.doors
    prior = [_prior(floor, rooms, doors, errand, name, name in placed) for name in errand.propositions]
    room_count = -(-(len(floor.kinds) + 1) // _ROOMS) * _ROOMS
    lit = np.zeros(room_count, bool)
    lit[list(placed.values())] = True
    keys = jax.random.split(key, len(prior))
    return PeoplePosterior(
        evidence=jnp.zeros(shape, bool),
        plan=Plan(
            occupied=jnp.asarray(rooms == NO_ROOM),
            rooms=jnp.asarray(rooms),
            prior=jnp.asarray(np.stack(prior)),
            by_room=jnp.asarray(np.argsort(rooms, axis=None, kind="stable").astype(np.int32)),
            reach=reach,
            room_count=room_count,
            groups=_groups(errand, tuple(placed)),
        ),
        strata=jnp.stack([jax.random.permutation(own, count).astype(jnp.int32) for own in keys]),
        lit=jnp.asarray(lit),
    )


def _prior(
    floor: Floor,
    rooms: Int32[np.ndarray, "H W"],
    doors: Bool[np.ndarray, "H W"],
    errand: Errand,
    name: str,
    is_there: bool,
) -> Float32[np.ndarray, "H W"]:
    """The probability of each middle cell of a person alone: the room first, then a cell of it that is no door's."""
    own = np.zeros(rooms.shape, np.float32)
    numbers = [number for kind in errand.rooms[name] for number in floor.rooms_of(kind)] if is_there else []
    for number in numbers:
        cells = (rooms == number) & ~doors
        own[cells] = 1.0 / (len(numbers) * np.count_nonzero(cells))
    return own


def _groups(errand: Errand, there: Sequence[str]) -> tuple[tuple[int, ...], ...]:
    """People who may be in the same rooms, together."""
    groups: dict[frozenset, list[int]] = {}
    for index, name in enumerate(errand.propositions):
        if name in there:
            groups.setdefault(frozenset(errand.rooms[name]), []).append(index)
    apart = sum(len(kinds) for kinds in groups) == len(frozenset().union(*groups))
    if not apart or any(len(group) > 2 for group in groups.values()):
        raise WorldError(
            "who may be where is known for people whose kinds of rooms differ, and for two who share all of theirs"
        )
    return tuple(tuple(group) for group in groups.values())


def _fits(plan: Plan, belief: BeliefMap, person: int) -> Bool[Array, "H W"]:
    """Where a person's middle cell can be: met on all cells where it was, and on none where it was not."""
    has = (belief.letters >> person) & 1 > 0
    lacks = ~belief.unknown & ~has
    met, missed = jnp.zeros(plan.rooms.shape, jnp.int32), jnp.zeros(plan.rooms.shape, jnp.bool_)
    side = range(-plan.reach, plan.reach + 1)
    # A patch ends at its room's walls.
    for offset in ((row, column) for row in side for column in side):
        same = _shifted(plan.rooms, offset, NO_ROOM) == plan.rooms
        met += (same & _shifted(has, offset, False)).astype(jnp.int32)
        missed |= same & _shifted(lacks, offset, False)
    return (met == jnp.sum(has, dtype=jnp.int32)) & ~missed


def _shifted(values: Array, offset: tuple[int, int], beyond: bool | int) -> Array:
    """At each cell the value of the one so many rows and columns on."""
    (row, column), (height, width) = offset, values.shape
    reach = max(abs(row), abs(column))
    padded = jnp.pad(values, reach, constant_values=beyond)
    return padded[reach + row : reach + row + height, reach + column : reach + column + width]


def _patches(plan: Plan, cells: Int32[Array, " N"]) -> Bool[Array, "N H W"]:
    """The cells on which people in these middle cells are met."""
    height, width = plan.rooms.shape
    rows, columns = cells // width, cells % width
    near_row = jnp.abs(jnp.arange(height, dtype=jnp.int32)[None] - rows[:, None]) <= plan.reach
    near_column = jnp.abs(jnp.arange(width, dtype=jnp.int32)[None] - columns[:, None]) <= plan.reach
    same = plan.rooms[None] == plan.rooms.reshape(-1)[cells][:, None, None]
    return near_row[:, :, None] & near_column[:, None, :] & same
