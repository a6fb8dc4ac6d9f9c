"""A map brought onto cells as large as those that a network learned from, so that it sees buildings in their size.

A building network reads cells, and a door of one cell is a door to it whatever a cell measures. On a map with cells of
another size it therefore looks at another map, whose cells are its own. Each cell of the finer of the two maps belongs
to the cell of the coarser one that holds its middle.

A wall is one cell thick on most maps, and what is in the way must stay in the way: a larger cell is occupied where a
third of its cells is. It is unknown where more than half of its cells are, and otherwise free where one of them is. Its
letter has every proposition that holds in one of its cells, its colours are the mean of those of its cells that are as
it is itself, free or not.
"""

import functools
import math
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float32, Int32, UInt8

from potlp_jax.learning.painting import Painting
from potlp_jax.world.grid import BeliefMap

# Of the cells of a larger one: what is occupied counts this many times.
_THICK = 3
# Sides of cells are float32: this close to the border of two cells is on the border.
_SLACK = 1e-4


def cells_in(cells: Int32[Array, "*B 2"], shape: tuple[int, int], scale: float) -> Int32[Array, "*B 2"]:
    """The cells of the other map in which the middles of these lie.

    Args:
        cells: of the one map.
        shape: its rows and columns.
        scale: how many cells of the other map are as long as one of this.

    Returns:
        Cells of the other map.
    """
    rows, columns = (jnp.asarray(_places(length, scale), jnp.int32) for length in shape)
    return jnp.stack([rows[cells[..., 0]], columns[cells[..., 1]]], axis=-1)


def resampled(
    belief: BeliefMap, painting: Painting, entered: Bool[Array, "H W"], scale: float
) -> tuple[BeliefMap, Painting]:
    """A map and what is painted on it, on cells of another size.

    Args:
        belief: the map, without leading dimensions.
        painting: of its shape.
        entered: True on cells that are free on the other map whatever lies beside them, as those of subgoals are.
        scale: how many cells of the other map are as long as one of this; static.

    Returns:
        Both, with as many rows and columns as hold the middles of all cells; distances of the painting are in cells of
        the other map.
    """
    height, width = belief.cells.shape
    shape = (height, width)
    gather, inside = _gathering(shape, scale)
    opened = jnp.any(gather(entered) & inside, axis=(1, 3))
    cells = jnp.where(opened, jnp.int8(BeliefMap.FREE), _larger_cells(gather(belief.cells), inside))
    letters = jnp.zeros(cells.shape, jnp.int32)
    for bit in range(len(belief.propositions)):
        holds = jnp.any((gather(belief.letters) >> bit & 1 == 1) & inside, axis=(1, 3))
        letters |= holds.astype(jnp.int32) << bit
    other = BeliefMap(
        cells=cells,
        letters=letters,
        resolution=belief.resolution / jnp.float32(scale),
        extent=cells_in(belief.extent - 1, shape, scale) + 1,
        propositions=belief.propositions,
    )
    alike = inside & (gather(belief.cells) == cells[:, None, :, None])
    painted = inside & jnp.isfinite(gather(painting.distance))
    # Where no cell was painted that is like the larger one, any other says more than nothing.
    best = painted & (alike | ~jnp.any(painted & alike, axis=(1, 3), keepdims=True))
    count = jnp.sum(best, axis=(1, 3)).astype(jnp.float32)

    def mean(layer: Float32[Array, "h k w _ *rest"]) -> Float32[Array, "h w *rest"]:
        weight = jnp.expand_dims(best, range(4, layer.ndim))
        total = jnp.sum(jnp.where(weight, layer, 0.0), axis=(1, 3))
        return total / jnp.maximum(jnp.expand_dims(count, range(2, total.ndim)), 1.0)

    def colour(layer: UInt8[Array, "H W 3"]) -> UInt8[Array, "h w 3"]:
        return jnp.round(mean(gather(layer).astype(jnp.float32))).astype(jnp.uint8)

    distance = jnp.where(count > 0, mean(gather(painting.distance)) * jnp.float32(scale), jnp.inf)
    return other, Painting(floor=colour(painting.floor), beyond=colour(painting.beyond), distance=distance)


def _larger_cells(parts: Array, inside: Bool[np.ndarray, "h k w _"]) -> Array:
    """What a larger cell is, from its parts."""
    occupied, unknown = (
        jnp.sum((parts == kind) & inside, axis=(1, 3)) for kind in (BeliefMap.OCCUPIED, BeliefMap.UNKNOWN)
    )
    of = np.sum(inside, axis=(1, 3))
    seen = jnp.where(2 * unknown > of, BeliefMap.UNKNOWN, BeliefMap.FREE)
    return jnp.where(_THICK * occupied >= of, BeliefMap.OCCUPIED, seen).astype(jnp.int8)


@functools.lru_cache(maxsize=32)
def _places(length: int, scale: float) -> tuple[int, ...]:
    """In which cell of the other map the middle of each cell lies, along one axis."""
    return tuple(math.floor((index + 0.5) * scale + _SLACK) for index in range(length))


@functools.lru_cache(maxsize=32)
def _parts(length: int, scale: float) -> Int32[np.ndarray, "h k"]:
    """The cells that belong to each cell of the other map, along one axis; rows are filled up with -1."""
    places = np.asarray(_places(length, scale))
    found = [np.flatnonzero(places == index) for index in range(places[-1] + 1)]
    # On a finer map most cells hold no middle of a coarser one: they are what the cell is in which they lie.
    found = [
        part if len(part) else np.asarray([min(math.floor((index + 0.5) / scale + _SLACK), length - 1)])
        for index, part in enumerate(found)
    ]
    most = max(len(part) for part in found)
    return np.stack([np.pad(part, (0, most - len(part)), constant_values=-1) for part in found]).astype(np.int32)


def _gathering(shape: tuple[int, int], scale: float) -> tuple[Callable[[Array], Array], Bool[np.ndarray, "h k w _"]]:
    """What takes a layer to its parts, ``[h, k, w, l, ...]``, and which of them there are."""
    rows, columns = (_parts(length, scale) for length in shape)
    inside = (rows >= 0)[:, :, None, None] & (columns >= 0)[None, None]

    def gather(layer: Array) -> Array:
        # Parts that are not there are left out by the mask, whatever stands in them.
        return layer[jnp.maximum(rows, 0)][:, :, jnp.maximum(columns, 0)]

    return gather, inside
