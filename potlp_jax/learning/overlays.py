"""What an estimator can show people of what it remembers and imagines: rasters to be laid over the map.

Nothing in a decision reads them. An estimator that has some to show has a method ``overlays``; pages and pictures of
trials ask ``overlays_of`` and need to know no kind of estimator.
"""

from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32, UInt8

from potlp_jax.compiling import jit_by_class
from potlp_jax.learning.painting import Painting
from potlp_jax.learning.resampling import cells_in
from potlp_jax.planning.estimates import Estimator
from potlp_jax.world.grid import BeliefMap


@struct.dataclass(kw_only=True)
class Painted:
    """Colours of cells.

    Attributes:
        name: for people; static.
        colours: RGB.
        mask: True for cells that have a colour.
    """

    name: str = struct.field(pytree_node=False)
    colours: UInt8[Array, "H W 3"]
    mask: Bool[Array, "H W"]


@struct.dataclass(kw_only=True)
class Imagined:
    """Chances about squares of cells, the first one in the map's upper left corner. Known cells stay as known.

    Attributes:
        name: for people; static.
        side: cells of a square's side; static.
        free: that a cell of the square is free.
        holds: that somewhere in the square, out of what is known, each proposition holds; in the order of the belief's
            propositions.
    """

    name: str = struct.field(pytree_node=False)
    side: int = struct.field(pytree_node=False)
    free: Float32[Array, "rows columns"]
    holds: Float32[Array, "rows columns P"]


Overlay = Painted | Imagined


@runtime_checkable
class ShowsOverlays(Protocol):
    """An estimator with something to show. Which overlays there are, and their names, are the same at every belief."""

    def overlays(self, belief: BeliefMap) -> tuple[Overlay, ...]:
        """Its overlays of the map, of the belief's shape; pure."""
        ...


def overlays_of(estimator: Estimator | None, belief: BeliefMap) -> tuple[Overlay, ...]:
    """What an estimator shows at a belief; nothing where it has no overlays."""
    return _overlays(estimator, belief) if isinstance(estimator, ShowsOverlays) else ()


@jit_by_class
def _overlays(estimator: ShowsOverlays, belief: BeliefMap) -> tuple[Overlay, ...]:
    return estimator.overlays(belief)


def painting_overlays(painting: Painting) -> tuple[Painted, Painted]:
    """The two colours of every cell that was in sight."""
    mask = jnp.isfinite(painting.distance)
    return (
        Painted(name="painted: floors", colours=painting.floor, mask=mask),
        Painted(name="painted: at eye height", colours=painting.beyond, mask=mask),
    )


def imagined_overlay(
    free: Float32[Array, "rows columns"], holds: Float32[Array, "rows columns P"], belief: BeliefMap, side: int
) -> Imagined:
    """What is imagined of squares, without the propositions that are known to hold in them.

    Args:
        free: as in ``Imagined``; squares may reach beyond the belief's lower and right edges.
        holds: that each proposition holds in the square, in a known cell or another.
        belief: what is known.
        side: cells of a square's side.

    Returns:
        The overlay; where a known cell of a square has a proposition, the square has no other chance of it.
    """
    rows, columns = free.shape
    height, width = belief.cells.shape
    letters = jnp.pad(belief.letters, ((0, rows * side - height), (0, columns * side - width)))
    found = jax.lax.reduce(letters.reshape(rows, side, columns, side), np.int32(0), jax.lax.bitwise_or, (1, 3))
    known = jnp.stack([(found >> bit) & 1 for bit in range(holds.shape[-1])], axis=-1) == 1
    return Imagined(name="imagined", side=side, free=free, holds=jnp.where(known, 0.0, holds))


def spread_over(imagined: Imagined, belief: BeliefMap, scale: float) -> Imagined:
    """Chances about squares of other cells, for the cells of the belief.

    Args:
        imagined: of a map whose cells are not the belief's.
        belief: what is known.
        scale: how many of the cells of that map are as long as one of the belief's.

    Returns:
        The overlay with squares of one cell; each has the chances of the larger one in which it lies.
    """
    height, width = belief.cells.shape
    shape = (height, width)
    cells = jnp.stack(jnp.meshgrid(*(jnp.arange(length) for length in shape), indexing="ij"), axis=-1)
    square = cells_in(cells, shape, scale) // imagined.side
    free, holds = (layer[square[..., 0], square[..., 1]] for layer in (imagined.free, imagined.holds))
    return Imagined(name=imagined.name, side=1, free=free, holds=holds)
