"""Paths through the building that a network imagines: how likely a goal is beyond a subgoal, and how far it is.

A network that says what unobserved squares hold (``learning.squares``) knows nearly all that P_S, R_S and R_F depend
on, but a path is hard to learn. So it is computed: from each subgoal, for each set of propositions to stay away from,
the cheapest way to every square through what is not observed (``learning.square_ways``), as docs/model.md section 6 has
it on cells. What comes out is not an estimate yet: steps are not independent, and the head of the network learns what
the numbers are worth.

No gradient passes: what is imagined is learned from what the buildings are, not from what would suit the answers.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int8, Int32

from potlp_jax.learning.square_ways import INSIDE, SideWays, Ways, cheapest_ways, ways_into_squares, ways_to_sides
from potlp_jax.learning.squares import PASSAGES, SIDES, SQUARE, Squares, in_squares
from potlp_jax.world.frontiers import connected_parts, frontier_cells
from potlp_jax.world.grid import BeliefMap

OF_WAY: int = 3
"""Numbers that describe a way whatever is looked for; see ``_of_way``."""

OF_GOAL: int = 7
"""Numbers that describe a way to a proposition; see ``_of_goal``."""

PROSPECTS: int = OF_WAY + OF_GOAL + 1
"""Numbers that the head of a network is told of a pair of a subgoal and a class (``prospects``)."""

# Lanes for which paths are solved side by side: a vector of the widest units.
_LANES = 16
# Which numbers of a way to a proposition are costs, and not chances.
_IS_COST = (False, False, False, False, True, False, True)
# From this share of cells on that nobody has seen, of those that are not known to be occupied, a square is a part of
# what is not observed; with fewer a path through it would mostly cross what is.
_HIDDEN = 0.6
# On a map of other cells the subgoal may lie this many cells beside the frontier: window, stride and edge for it.
_NEAR = ((5, 5), (1, 1), "SAME")
# Below this many obstacles a way is likely open.
_OPEN = 0.5
# A square as free as this can be walked in.
_ROOMY = 0.3
# Below this there is nothing to divide by.
_LITTLE = 1e-3
# Costs enter the head in this unit of cells, as a logarithm.
_UNIT = 10.0


@struct.dataclass(kw_only=True)
class Outlook:
    """What lies beyond subgoals as the network imagines it, for each lane: a subgoal and what to stay away from."""

    way: Float32[Array, "*B of_way"]
    """``OF_WAY`` numbers, whatever is looked for."""
    goal: Float32[Array, "*B P of_goal"]
    """``OF_GOAL`` numbers for each proposition."""


@struct.dataclass(kw_only=True)
class Scenery:
    """What is known of the squares of a map.

    Attributes:
        unseen: whether a cell is unknown.
        hidden: whether the square is a part of what is not observed.
        seen: whether a cell with each proposition was seen in it.
        open: whether a free cell was seen in it.
        parts: the connected part of the frontier that each cell belongs to or lies near to (``connected_parts``).
        lowest, highest: of the parts that have a cell in the square, 0 where it has no cell of the frontier.
        own_within: how the frontier of a subgoal is told from others, as ``BuildingConfig`` has it.
        free: share of the unknown cells that are free, as imagined.
        holds: chance that an unknown cell with each proposition lies in it.
        passages, approach: as imagined.
    """

    unseen: Bool[Array, "*B rows columns"]
    hidden: Bool[Array, "*B rows columns"]
    seen: Bool[Array, "*B rows columns P"]
    open: Bool[Array, "*B rows columns"]
    parts: Int32[Array, "*B H W"]
    lowest: Int32[Array, "*B rows columns"]
    highest: Int32[Array, "*B rows columns"]
    free: Float32[Array, "*B rows columns"]
    holds: Float32[Array, "*B rows columns P"]
    passages: Float32[Array, "*B rows columns 6"]
    approach: Float32[Array, "*B rows columns P 4"]
    own_within: int = struct.field(pytree_node=False)


def scenery(belief: BeliefMap, imagined: Squares, own_within: int) -> Scenery:
    """What is known of the squares of a belief, and what is imagined of the rest.

    Args:
        belief: one map.
        imagined: chances; of at least the map's squares, more are left out.
        own_within: as ``BuildingConfig`` has it; static.
    """
    unseen, free = (in_squares(mask).sum(axis=(2, 3)).astype(jnp.float32) for mask in (belief.unknown, belief.free))
    rows, columns = unseen.shape
    imagined = jax.tree.map(lambda array: array[:rows, :columns], imagined)
    labelled = jnp.stack([(belief.letters >> bit) & 1 for bit in range(len(belief.propositions))], axis=-1) > 0
    seen = jnp.any(in_squares(labelled & belief.free[:, :, None]), axis=(2, 3))
    # Of the square's free cells those that are not known to be free.
    rest = SQUARE * SQUARE * imagined.free - free
    parts = connected_parts(frontier_cells(belief, belief.free))
    inside = in_squares(parts)
    highest = jnp.max(inside, axis=(2, 3))
    lowest = jnp.min(jnp.where(inside > 0, inside, highest[:, :, None, None]), axis=(2, 3))
    return Scenery(
        unseen=unseen > 0,
        hidden=unseen > _HIDDEN * (unseen + free),
        seen=seen,
        open=free > 0,
        parts=jnp.where(parts > 0, parts, jax.lax.reduce_window(parts, 0, jax.lax.max, *_NEAR)),
        lowest=lowest,
        highest=highest,
        free=jnp.clip(rest / jnp.maximum(unseen, 1.0), 0.0, 1.0),
        holds=jnp.where(seen | (unseen == 0)[:, :, None], 0.0, imagined.holds),
        passages=imagined.passages,
        approach=imagined.approach,
        own_within=own_within,
    )


def outlook(scene: Scenery, subgoals: Int32[Array, "L 2"], stay: Int8[Array, "L P"]) -> Outlook:
    """What lies beyond subgoals.

    Args:
        scene: of the maps.
        subgoals: a cell for each lane.
        stay: its ``phi_stay``: the propositions at -1 are avoided.

    Returns:
        Numbers of about the size of 1.
    """
    scene = jax.tree.map(jax.lax.stop_gradient, scene)
    avoided = (stay == -1)[None, None]
    # [rows, columns, L], as all that follows.
    clear = jnp.prod(jnp.where(avoided, 1 - scene.holds[:, :, None], 1.0), axis=-1)
    barred = jnp.any(scene.seen[:, :, None] & avoided, axis=-1)
    away = _squares_away(scene, subgoals)
    own, other = _frontiers_of(scene, subgoals, away)
    begins = (away == 0) | ((away == 1) & own)
    start = ways_to_sides(jnp.where(begins, INSIDE + SQUARE * away.astype(jnp.float32), jnp.inf))
    passages = [scene.passages[:, :, number, None] for number in range(len(PASSAGES))]
    inside = scene.hidden[:, :, None]
    hidden = cheapest_ways(start, [jnp.where(inside, 1 - chance * clear, jnp.inf) for chance in passages])
    # Out by another frontier than the subgoal's own, and on through what is observed.
    leaves = ways_to_sides(jnp.where(scene.open[:, :, None] & other, 0.0, jnp.inf))
    out = jax.tree.map(jnp.add, hidden, leaves)
    inside = scene.open[:, :, None] & ~barred
    seen = ways_into_squares(cheapest_ways(out, [jnp.where(inside, 1 - chance, jnp.inf) for chance in passages]))
    goals = [_of_goal(scene, hidden, seen, away == 0, bit) for bit in range(stay.shape[-1])]
    return Outlook(way=_of_way(scene, clear, ways_into_squares(hidden)), goal=jnp.stack(goals, axis=-2))


def outlook_of_first(
    count: Int32[Array, ""], scene: Scenery, subgoals: Int32[Array, "L 2"], stay: Int8[Array, "L P"]
) -> Outlook:
    """The outlook of the first ``count`` lanes, as ``outlook``; of those behind them nothing is asked, and 0 is said.

    A part of the lanes at a time, so that padding costs nothing and the last of few does not wait for many.
    """
    scene = jax.tree.map(jax.lax.stop_gradient, scene)
    total = stay.shape[0]
    size = min(_LANES, total)
    spare = ((0, -total % size), (0, 0))
    subgoals, stay = jnp.pad(subgoals, spare), jnp.pad(stay, spare)

    def solve(part: Int32[Array, ""], found: Outlook) -> Outlook:
        cells, avoided = (jax.lax.dynamic_slice_in_dim(array, part * size, size) for array in (subgoals, stay))
        solved = outlook(scene, cells, avoided)
        return jax.tree.map(
            lambda into, rows: jax.lax.dynamic_update_slice_in_dim(into, rows, part * size, axis=0), found, solved
        )

    lanes, propositions = stay.shape
    nothing = Outlook(way=jnp.zeros((lanes, OF_WAY)), goal=jnp.zeros((lanes, propositions, OF_GOAL)))
    solved = jax.lax.fori_loop(0, -(-count // size), solve, nothing)
    said = jnp.arange(total, dtype=jnp.int32) < count
    return jax.tree.map(lambda rows: jnp.where(jnp.expand_dims(said, range(1, rows.ndim)), rows[:total], 0.0), solved)


def _squares_away(scene: Scenery, subgoals: Int32[Array, "L 2"]) -> Int32[Array, "rows columns L"]:
    """How many squares each is away from each subgoal's, diagonal steps counted as one."""
    rows, columns = scene.unseen.shape
    row, column = (subgoals // SQUARE).T
    down = jnp.abs(jnp.arange(rows, dtype=jnp.int32)[:, None, None] - row[None, None])
    across = jnp.abs(jnp.arange(columns, dtype=jnp.int32)[None, :, None] - column[None, None])
    return jnp.maximum(down, across)


def _frontiers_of(
    scene: Scenery, subgoals: Int32[Array, "L 2"], away: Int32[Array, "rows columns L"]
) -> tuple[Bool[Array, "rows columns L"], Bool[Array, "rows columns L"]]:
    """In which squares each subgoal's own frontier lies, and in which another one by which a path may come out."""
    if scene.own_within:
        frontier = (scene.highest > 0)[:, :, None] & (away >= 0)
        return frontier, frontier & (away > scene.own_within)
    part = scene.parts[subgoals[:, 0], subgoals[:, 1]][None, None]
    lowest, highest = scene.lowest[:, :, None], scene.highest[:, :, None]
    # In the subgoal's own square a path does not get anywhere yet.
    other = (highest > 0) & ((lowest != part) | (highest != part)) & (away > 0)
    return (lowest == part) | (highest == part), other


def _of_way(scene: Scenery, clear: Float32[Array, "rows columns L"], arrived: Ways) -> Float32[Array, "*B of_way"]:
    """How far and how much one can explore there: what R_F depends on."""
    hidden, free = scene.hidden[:, :, None], scene.free[:, :, None]
    walked = hidden & (arrived.obstacles < _OPEN) & (free * clear > _ROOMY) & jnp.isfinite(arrived.cost)
    farthest = jnp.max(jnp.where(walked, arrived.length, 0.0), axis=(0, 1))
    expected = jnp.max(jnp.where(hidden & (free > _ROOMY), arrived.chance() * arrived.length, 0.0), axis=(0, 1))
    room = jnp.sum(walked, axis=(0, 1)).astype(jnp.float32)
    return jnp.stack([_scaled(farthest), _scaled(expected), _scaled(room)], axis=-1)


def _of_goal(
    scene: Scenery, hidden: SideWays, seen: Ways, here: Bool[Array, "rows columns L"], bit: int
) -> Float32[Array, "L of_goal"]:
    """How much of a proposition can be reached, and how far it is: what P_S and R_S depend on."""
    approach = [1 - scene.approach[:, :, bit, side, None] for side in range(SIDES)]
    arrived = ways_into_squares(hidden, approach)
    # The subgoal's own square is entered already.
    cost, obstacles = (jnp.where(here, 0.0, array) for array in (arrived.cost, arrived.obstacles))
    arrived = Ways(cost=cost, obstacles=obstacles)
    mass = jnp.where(scene.unseen, scene.holds[:, :, bit], 0.0)[:, :, None]

    def total(weight: Array) -> Array:
        return jnp.sum(mass * weight, axis=(0, 1))

    there, near = jnp.sum(mass, axis=(0, 1)), arrived.chance(2.0)
    reached, share = total(arrived.chance()), jnp.maximum(there, _LITTLE)
    length = total(near * arrived.length) / jnp.maximum(total(near), _LITTLE)
    found = jnp.where(scene.seen[:, :, bit, None], seen.chance(), 0.0)
    best = jnp.max(found, axis=(0, 1))
    likeliest = (found > 0) & (found >= best[None, None])
    distance = jnp.min(jnp.where(likeliest, seen.length, jnp.inf), axis=(0, 1))
    return jnp.stack(
        [
            jnp.minimum(there, 3.0) + jnp.zeros_like(reached),
            jnp.minimum(reached, 3.0),
            reached / share,
            total(near) / share,
            _scaled(length),
            best,
            _scaled(jnp.where(best > 0, distance, 0.0)),
        ],
        axis=-1,
    )


def _scaled(cost: Array) -> Array:
    return jnp.log1p(cost / _UNIT)


def prospects(lanes: Outlook, phi_go: Int8[Array, "*B K P"]) -> Float32[Array, "*B K N"]:
    """What the head of the network is told of pairs of a subgoal and a class.

    Args:
        lanes: for each pair the outlook of its lane, ``[*B, K, ...]``.
        phi_go: of the pair's class.

    Returns:
        ``PROSPECTS`` numbers. Of several propositions that must hold together the least chance and the farthest way
        count, of none all are 0.
    """
    wanted = (phi_go == 1)[..., None]
    some = jnp.any(wanted, axis=-2)
    # The least chance and the largest cost, which is the least of what lies below 0.
    sign = jnp.broadcast_to(jnp.where(jnp.asarray(_IS_COST), -1.0, 1.0), lanes.goal.shape)
    worst = sign[..., 0, :] * jnp.min(jnp.where(wanted, sign * lanes.goal, jnp.inf), axis=-2)
    goal = jnp.where(some, worst, 0.0)
    return jnp.concatenate([lanes.way, goal, some.astype(jnp.float32)], axis=-1)
