"""Frontiers: where known space ends, as connected components, one subgoal each (docs/model.md section 6).

Components of any shape and number are found exactly. On a CPU native code floods them one after the other
(``native/kernels/frontiers.cc``). Elsewhere, and where there is no compiler, they grow at the same time: the cells of
the frontier are listed, and every pass over them runs in blocks of the list, so that the cost follows the length of the
frontier and not the size of the grid.

References:
    Yamauchi, A frontier-based approach for autonomous exploration, CIRA 1997.
    Shiloach and Vishkin, An O(log n) parallel connectivity algorithm, Journal of Algorithms 1982 (hook and shorten).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, UInt32

from potlp_jax.checks import COUNT, as_python_numbers
from potlp_jax.native import by_platform, target
from potlp_jax.precision import in_32_bits
from potlp_jax.types import NO_SUBGOAL, UNREACHABLE, Status, status_if
from potlp_jax.world.grid import BeliefMap
from potlp_jax.world.moves import NEIGHBOURS, beside

_BLOCK = 512
"""Cells of the frontier that are handled at once. A frontier has some hundreds of cells, so one or two blocks do."""
_NONE = np.iinfo(np.int32).max
"""A cell's number where there is no cell; larger than any, so that a minimum passes it over."""

Carry = TypeVar("Carry")


@struct.dataclass(kw_only=True)
class Subgoals:
    """The components of the frontier that are kept, nearest first.

    Attributes:
        cells: the subgoal of each component, a cell of the frontier; (0, 0) where masked.
        mask: True on real subgoals; they come first.
        size: cells of the component; 0 where masked.
        distance: the distance that was given for the subgoal's cell; inf where masked.
        component: index of the subgoal whose component the cell belongs to, or ``NO_SUBGOAL``.
        frontier: all cells of the frontier, also those of components that were not kept.
        status: ``SUBGOAL_OVERFLOW`` where there were more components than the array holds.
    """

    cells: Int32[Array, "*batch S 2"]
    mask: Bool[Array, "*batch S"]
    size: Int32[Array, "*batch S"]
    distance: Float32[Array, "*batch S"]
    component: Int32[Array, "*batch H W"]
    frontier: Bool[Array, "*batch H W"]
    status: UInt32[Array, "*batch"]


@dataclasses.dataclass(frozen=True)
class FrontierConfig:
    """How frontiers become subgoals.

    Attributes:
        max_subgoals: length of the array of subgoals with which a trial begins (``most_subgoals``). Where an array does
            not grow and there are more components, the nearest stay, and the overflow is flagged.
        min_size: components of fewer cells are dropped while larger ones remain. Keep it below the narrowest passage:
            a passage whose whole frontier is smaller would be forgotten while anything else remains.
        most_subgoals: where there are more components than ``max_subgoals`` a trial decides again with an array of
            twice the length, and so on up to this many; only beyond that is it flagged. A length that is no more than
            ``max_subgoals`` never grows. Programs of one fixed shape (``export``, ``rl``, recordings) do not grow.
    """

    max_subgoals: int = 12
    min_size: int = 2
    most_subgoals: int = 512

    def __post_init__(self) -> None:
        if not all(COUNT.allows(size) for size in (self.max_subgoals, self.min_size, self.most_subgoals)):
            raise ValueError(
                f"max_subgoals, min_size and most_subgoals must be whole numbers of at least 1, found {self}"
            )
        as_python_numbers(self)

    def grown(self) -> "FrontierConfig | None":
        """With an array of the next length, None where it is as long as it may become."""
        # Doubled, so that few programs are compiled whatever a map asks for, and none is much larger than needed.
        longer = min(2 * self.max_subgoals, self.most_subgoals)
        return dataclasses.replace(self, max_subgoals=longer) if longer > self.max_subgoals else None


@struct.dataclass(kw_only=True)
class _Grid:
    """The frontier on a grid with one more ring, cells counted row by row.

    The ring has no frontier, so that neighbours of a cell are fixed offsets of its number, without a test for the edge.
    The number after the last cell is a dummy: reads of it are neutral, writes to it are never looked at.

    Attributes:
        listed: the frontier's cells in increasing order, then dummies, as many as fill a block.
        count: cells of the frontier.
        parent: a forest over the cells, the dummy off the frontier: a cell's parent has no larger number, a root is its
            own parent. Its trees grow until each is a component.
    """

    listed: Int32[Array, "*batch capacity"]
    count: Int32[Array, "*batch"]
    parent: Int32[Array, "*batch cells"]


def frontier_cells(belief: BeliefMap, reachable: Bool[Array, "H W"]) -> Bool[Array, "H W"]:
    """Free cells that can be reached and touch, with a side, a cell that is not observed.

    What lies outside of the array counts as not observed.
    """
    # Sides suffice: a diagonal move needs the two cells beside it free, and these touch its target with a side.
    return belief.free & reachable & beside(belief.unknown, beyond=True)


@in_32_bits
def find_subgoals(
    belief: BeliefMap,
    reachable: Bool[Array, "H W"],
    distance: Float32[Array, "H W"],
    config: FrontierConfig,
) -> Subgoals:
    """The frontier's components (8-connected), each with its subgoal: its cell nearest its centroid.

    Of equally near cells the first in row-major order is the subgoal. Subgoals are ordered by distance, then in
    row-major order of their cells.

    Args:
        belief: what has been observed.
        reachable: True on the free cells that the robot can reach in known space.
        distance: the robot's product distance to each cell in the unit of cost, inf where there is none.
        config: how many subgoals there are at most, and how small a component may be; static.

    Returns:
        The nearest subgoals, padded to ``config.max_subgoals``; ``status`` tells whether there were more.
    """
    frontier = frontier_cells(belief, reachable)
    ways = (functools.partial(function, config=config) for function in (_found_natively, _found_by_rounds))
    return by_platform("frontiers", *ways, frontier, distance)


def connected_parts(cells: Bool[Array, "H W"]) -> Int32[Array, "H W"]:
    """Which cells belong together: 8-connected components, told apart by their first cells.

    Args:
        cells: any cells, such as those of a frontier.

    Returns:
        For each of them the number of its component's first cell, counted row by row from 1; 0 for all others.
    """
    return by_platform("frontiers", _labelled_natively, _labelled_by_rounds, cells)


def _labelled_natively(cells: Bool[Array, "H W"]) -> Int32[Array, "H W"]:
    result = jax.ShapeDtypeStruct(cells.shape, jnp.int32)
    return jax.ffi.ffi_call(target("label_components"), result, vmap_method="sequential")(cells)


def _labelled_by_rounds(cells: Bool[Array, "H W"]) -> Int32[Array, "H W"]:
    height, width = cells.shape
    parent = _label(_listed(cells), width).parent[:-1].reshape(height + 2, width + 2)[1:-1, 1:-1]
    # From cell numbers on the grid with its ring, which count from 0.
    first = (parent // (width + 2) - 1) * width + parent % (width + 2)
    return jnp.where(cells, first, 0)


def _found_natively(frontier: Bool[Array, "H W"], distance: Float32[Array, "H W"], config: FrontierConfig) -> Subgoals:
    """In native code (``native/kernels/frontiers.cc``), one component after the other."""
    most = config.max_subgoals
    results = {
        "cells": jax.ShapeDtypeStruct((most, 2), jnp.int32),
        "mask": jax.ShapeDtypeStruct((most,), jnp.bool_),
        "size": jax.ShapeDtypeStruct((most,), jnp.int32),
        "distance": jax.ShapeDtypeStruct((most,), jnp.float32),
        "component": jax.ShapeDtypeStruct(frontier.shape, jnp.int32),
        "overflow": jax.ShapeDtypeStruct((), jnp.bool_),
    }
    call = jax.ffi.ffi_call(target("find_components"), tuple(results.values()), vmap_method="sequential")
    found = dict(zip(results, call(frontier, distance, min_size=np.int64(config.min_size)), strict=True))
    status = status_if(found.pop("overflow"), Status.SUBGOAL_OVERFLOW)
    return Subgoals(**found, frontier=frontier, status=status)


def _found_by_rounds(frontier: Bool[Array, "H W"], distance: Float32[Array, "H W"], config: FrontierConfig) -> Subgoals:
    """In JAX, all components at the same time."""
    height, width = frontier.shape
    grid = _label(_listed(frontier), width)
    size, subgoal = _summarise(grid, width)
    is_root = grid.parent[:-1] == jnp.arange(grid.parent.shape[0] - 1, dtype=jnp.int32)
    # A sliver between two lines of sight is nowhere to go, unless slivers are all there is.
    some_large = jnp.max(size) >= config.min_size
    kept = is_root & ((size[:-1] >= config.min_size) | ~some_large)
    padded_distance = jnp.pad(distance, 1, constant_values=UNREACHABLE).ravel()
    cost, cell, root = _nearest(grid, kept, subgoal, padded_distance, config.max_subgoals)
    mask = cell < _NONE
    # Every cell of a component points at its root, so the subgoal's index is written there once and read by all.
    index = jnp.full(grid.parent.shape, NO_SUBGOAL, jnp.int32)
    index = index.at[root].set(jnp.where(mask, jnp.arange(config.max_subgoals, dtype=jnp.int32), NO_SUBGOAL))
    component = index[grid.parent[:-1]].reshape(height + 2, width + 2)[1:-1, 1:-1]
    # Back from cell numbers on the grid with its ring.
    row, column = cell // (width + 2) - 1, cell % (width + 2) - 1
    return Subgoals(
        cells=jnp.where(mask[:, None], jnp.stack([row, column], axis=1), 0),
        mask=mask,
        size=jnp.where(mask, size[root], 0),
        distance=cost,
        component=component,
        frontier=frontier,
        status=status_if(jnp.sum(kept, dtype=jnp.int32) > config.max_subgoals, Status.SUBGOAL_OVERFLOW),
    )


def _listed(frontier: Bool[Array, "H W"]) -> _Grid:
    """The frontier's cells in a list, each a tree of its own."""
    flat = jnp.pad(frontier, 1).ravel()
    cells = flat.shape[0]
    # The cell of rank k is the first at which the running count reaches k: a binary search for each entry of the list,
    # in as many blocks as the frontier needs. ``jnp.nonzero`` would scatter over the whole grid.
    rank = jnp.cumsum(flat, dtype=jnp.int32)
    count = rank[-1]
    capacity = -(-cells // _BLOCK) * _BLOCK

    def fill(block: Array, listed: Array) -> Array:
        wanted = block * _BLOCK + jnp.arange(1, _BLOCK + 1, dtype=jnp.int32)
        found = jnp.searchsorted(rank, wanted).astype(jnp.int32)
        return jax.lax.dynamic_update_slice(listed, found, (block * _BLOCK,))

    # A rank that is not reached is found at the end, which is the dummy.
    listed = jax.lax.fori_loop(0, _blocks(count), fill, jnp.full(capacity, cells, jnp.int32))
    parent = jnp.where(flat, jnp.arange(cells, dtype=jnp.int32), jnp.int32(cells))
    return _Grid(listed=listed, count=count, parent=jnp.append(parent, jnp.int32(cells)))


def _blocks(count: Int32[Array, ""]) -> Int32[Array, ""]:
    """Blocks of the list that hold a cell of the frontier."""
    return (count + (_BLOCK - 1)) // _BLOCK


def _over_frontier(grid: _Grid, body: Callable[[Int32[Array, " block"], Carry], Carry], carry: Carry) -> Carry:
    """Fold ``body`` over the blocks of the list; dummies may be among the cells of the last."""

    def step(block: Array, carry: Carry) -> Carry:
        return body(jax.lax.dynamic_slice(grid.listed, (block * _BLOCK,), (_BLOCK,)), carry)

    return jax.lax.fori_loop(0, _blocks(grid.count), step, carry)


def _label(grid: _Grid, width: int) -> _Grid:
    """Connected components: ``parent`` becomes the first cell of each component, the dummy off the frontier.

    Each round hooks every tree, at its root, below the least tree that touches it, and shortens the paths to roots:
    logarithmically many rounds, where passing labels from cell to cell alone would take as many as a component is long.

    Parents only ever decrease and stay within the component, so the rounds end; when nothing changes, neighbours have
    equal parents, and every tree is a component with its first cell as root.
    """
    offsets = jnp.asarray([row * (width + 2) + column for row, column in NEIGHBOURS], dtype=jnp.int32)
    dummy = grid.parent.shape[0] - 1

    def hook(cells: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        parent, changed = carry
        around = jnp.minimum(cells[:, None] + offsets[None, :], dummy)
        least = jnp.min(parent[around], axis=1)
        root = parent[cells]
        # Dummies that fill the last block stay roots of their own and hook nothing.
        least = jnp.where(cells == dummy, dummy, jnp.minimum(least, root))
        # A minimum, because several cells of one tree propose different trees for their common root.
        return parent.at[root].min(least).at[cells].min(least), changed | jnp.any(least < root)

    def shorten(cells: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        parent, changed = carry
        # Two levels up and not one: the paths to the roots shrink to a third.
        old = parent[cells]
        new = parent[parent[old]]
        return parent.at[cells].set(new), changed | jnp.any(new < old)

    def one_round(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        parent, _ = carry
        return _over_frontier(grid, shorten, _over_frontier(grid, hook, (parent, jnp.bool_(False))))

    parent, _ = jax.lax.while_loop(lambda carry: carry[1], one_round, (grid.parent, grid.count > 0))
    return dataclasses.replace(grid, parent=parent)


def _summarise(grid: _Grid, width: int) -> tuple[Int32[Array, " cells"], Int32[Array, " cells"]]:
    """Size and subgoal of each component, at the component's root.

    With ``n`` cells that sum to ``S``, the cell ``p`` nearest the centroid minimises ``n p^2 - 2 p S``. Taken relative
    to the cell that holds the centroid these integers are small: the choice is exact, and equal under jit and vmap.

    Returns:
        By cell number, at the roots: the component's size, 0 elsewhere; its subgoal, ``_NONE`` elsewhere.
    """
    nothing = jnp.zeros(grid.parent.shape, jnp.int32)

    def add(cells: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        root = grid.parent[cells]
        row, column = cells // (width + 2), cells % (width + 2)
        return carry[0].at[root].add(1), carry[1].at[root].add(row), carry[2].at[root].add(column)

    size, rows, columns = _over_frontier(grid, add, (nothing, nothing, nothing))

    def off_centre(cells: Array) -> Array:
        root = grid.parent[cells]
        count = jnp.maximum(size[root], 1)
        row, column = cells // (width + 2) - rows[root] // count, cells % (width + 2) - columns[root] // count
        # The cap keeps the product below 2^30. Only in components of thousands of cells are some so far from the
        # centroid, by hundreds of cells, that they meet it.
        square = jnp.minimum(row * row + column * column, jnp.int32(2**30) // count)
        return count * square - 2 * (row * (rows[root] % count) + column * (columns[root] % count))

    # Two passes, least value first and then the first cell that has it: a minimum over pairs is no scatter.
    none = jnp.full(grid.parent.shape, _NONE, jnp.int32)
    least = _over_frontier(grid, lambda cells, best: best.at[grid.parent[cells]].min(off_centre(cells)), none)

    def first(cells: Array, best: Array) -> Array:
        root = grid.parent[cells]
        return best.at[root].min(jnp.where(off_centre(cells) == least[root], cells, _NONE))

    dummy = grid.parent.shape[0] - 1
    return size.at[dummy].set(0), _over_frontier(grid, first, none)


def _nearest(
    grid: _Grid,
    kept: Bool[Array, " real"],
    subgoal: Int32[Array, " cells"],
    distance: Float32[Array, " real"],
    most: int,
) -> tuple[Float32[Array, "S"], Int32[Array, "S"], Int32[Array, "S"]]:
    """Distance, subgoal and root of the nearest components, by (distance, subgoal); ``_NONE`` where there is none."""
    dummy = grid.parent.shape[0] - 1
    kept = jnp.append(kept, jnp.bool_(False))
    distance = jnp.append(distance, jnp.float32(UNREACHABLE))

    def merge(cells: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        chosen = jnp.where(kept[cells], subgoal[cells], _NONE)
        cost = jnp.where(kept[cells], distance[jnp.minimum(chosen, dummy)], UNREACHABLE)
        root = jnp.where(kept[cells], cells, dummy)
        # The best so far and this block's roots, sorted by both keys; what is beyond the capacity falls off the end.
        together = tuple(jnp.concatenate(pair) for pair in zip(carry, (cost, chosen, root), strict=True))
        cost, chosen, root = (entry[:most] for entry in jax.lax.sort(together, num_keys=2))
        return cost, chosen, root

    none = (jnp.full(most, UNREACHABLE, jnp.float32), jnp.full(most, _NONE), jnp.full(most, dummy, jnp.int32))
    return _over_frontier(grid, merge, none)
