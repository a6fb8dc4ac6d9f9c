"""Line of sight: what the mapping sensor adds to the belief.

Definition. Straight lines (Bresenham, ties away from the axis) run from the robot to every cell on the perimeter of the
square of half-width ``ceil(R)``. A line is followed while its cells are free and within ``R`` (Euclidean, in cells); it
does not pass between two obstacles that touch at their corners. The free cells of all lines are seen, the robot's cell
and its eight neighbours always. An obstacle is seen where it touches, also at a corner, a free cell that is seen: lines
alone would leave slivers in walls that are grazed. Letters do not block sight.

Method. On a CPU native code follows the lines one by one (``native/kernels/sensing.cc``). Elsewhere, and where there is
no compiler, it is the other way round. Which cells a line passes does not depend on the map, so the lines are static
tables, and the first step is to find how far each line gets. The second is the inverse: which cells lie on a line that
gets that far. The lines of one side of the square do not cross, so those through a given cell are a contiguous range of
them, and the cell is seen where any line of the range gets far enough. A maximum over a range is two look-ups in a
table of maxima over blocks of ``2 ** level`` lines (one block from the range's beginning, one up to its end), instead
of a scatter of all cells.

References:
    Bresenham, Algorithm for computer control of a digital plotter, IBM Systems Journal 1965.
    Bender and Farach-Colton, The LCA problem revisited, LATIN 2000 (sparse tables of range maxima).
"""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, Int32, UInt8

from potlp_jax.checks import NOT_NEGATIVE, as_python_numbers
from potlp_jax.errors import WorldError
from potlp_jax.native import by_platform, target
from potlp_jax.precision import in_32_bits, whole_numbers
from potlp_jax.task.propositions import require_same_propositions
from potlp_jax.types import CellLike
from potlp_jax.world.grid import BeliefMap, World
from potlp_jax.world.moves import dilate

_OCCUPIED_BIT = 1
"""Bit of a cell's code that says obstacle."""
_BLOCK = 12
"""Steps of all lines that are followed between two tests for lines that still go on."""
_DIAGONALS = ((-1, -1), (-1, 1), (1, -1), (1, 1))
"""Diagonal moves, in the order of their bits in a cell's code."""


@dataclasses.dataclass(frozen=True)
class SensorConfig:
    """The mapping sensor.

    Attributes:
        range_cells: how far it sees, Euclidean, in cells. Its cost grows with the range times the grid's longer side.
    """

    # Fixed with the fire-fighting building, see docs/results/calibration.md: at 104 cells the alarm, 102 cells from the
    # mouth of its hallway, is just seen from there.
    range_cells: float = 104.0

    def __post_init__(self) -> None:
        if not NOT_NEGATIVE.allows(self.range_cells):
            raise ValueError(f"range_cells must be a finite number of cells, 0 or more, found {self.range_cells}")
        as_python_numbers(self)


@dataclasses.dataclass(frozen=True)
class _Lines:
    """Static tables of the lines that leave the robot's cell, for one range and one shape of grid.

    Lines are counted through the four sides (up, down, left, right), ``2N + 1`` a side; step ``k`` is at distance ``k``
    along the side's axis. ``margin`` is how far the window of cells reaches from the robot, in rows and columns.
    Tables over offsets have entry ``(dr + H - 1, dc + W - 1)``.
    """

    margin: tuple[int, int]
    cells: Int[np.ndarray, "steps lines"]
    """Flat index into the window; one past its end where the line is outside of it."""
    blocking: UInt8[np.ndarray, "steps lines"]
    """Bits of a cell's code that stop the line there."""
    first: Int[np.ndarray, "two_h two_w"]
    """Flat index ``level * lines + line`` of the range's first block of ``2 ** level`` lines."""
    last: Int[np.ndarray, "two_h two_w"]
    """The same for the last block of the range; both together cover it."""
    needed: Int[np.ndarray, "two_h two_w"]
    """Step that a line must reach for the cell to be seen; more than any reaches where the cell is out of range."""
    levels: int


@in_32_bits
def observe(belief: BeliefMap, world: World, cell: CellLike, config: SensorConfig) -> BeliefMap:
    """The belief with all that is in line of sight added.

    Args:
        belief: what has been observed before.
        world: the truth, of the belief's shape.
        cell: the robot's row and column.
        config: the sensor; static.

    Returns:
        The belief after the observation; what was observed before stays.

    Raises:
        PropositionsError: belief and world do not name the same propositions.
        WorldError: the cell is no whole numbers.
    """
    require_same_propositions(
        belief.propositions, world.propositions, asker="the belief", remedy="begin with BeliefMap.unobserved(world)"
    )
    seen = visible(world.occupied, whole_numbers(cell, "cell", WorldError), config)
    truth = jnp.where(world.occupied, jnp.int8(BeliefMap.OCCUPIED), jnp.int8(BeliefMap.FREE))
    return dataclasses.replace(
        belief, cells=jnp.where(seen, truth, belief.cells), letters=jnp.where(seen, world.letters, belief.letters)
    )


def visible(occupied: Bool[Array, "H W"], cell: Int32[Array, "2"], config: SensorConfig) -> Bool[Array, "H W"]:
    """The cells, free or not, that are seen from a cell (see the definition at the top of the module).

    Args:
        occupied: True on obstacles.
        cell: row and column, inside of the array.
        config: the sensor; static.

    Returns:
        True on the cells that are seen. Outside of the array nothing is.
    """
    return by_platform(
        "sensing",
        functools.partial(_followed, config=config),
        functools.partial(_tabled, config=config),
        occupied,
        cell,
    )


def _followed(occupied: Bool[Array, "H W"], cell: Int32[Array, "2"], config: SensorConfig) -> Bool[Array, "H W"]:
    """In native code: the definition, line by line."""
    result = jax.ShapeDtypeStruct(occupied.shape, jnp.bool_)
    call = jax.ffi.ffi_call(target("visible"), result, vmap_method="sequential")
    half, height, width = _half_width(config.range_cells), *occupied.shape
    # No line is longer on the grid than its longer side, but where it leads the range says.
    return call(
        occupied,
        cell,
        range=np.float64(config.range_cells),
        half=np.int64(half),
        steps=np.int64(min(half, max(height, width) - 1)),
    )


def _tabled(occupied: Bool[Array, "H W"], cell: Int32[Array, "2"], config: SensorConfig) -> Bool[Array, "H W"]:
    """By tables of which lines pass which cells."""
    height, width = occupied.shape
    lines = _lines(config.range_cells, height, width)
    # Tables over offsets from the robot become tables over cells by cutting out the window that begins here.
    corner = (jnp.int32(height - 1) - cell[0], jnp.int32(width - 1) - cell[1])
    reach = _range_maxima(_reach(occupied, cell, lines), lines.levels)
    farthest = jnp.maximum(
        reach[_at_offsets(lines.first, corner, height, width)], reach[_at_offsets(lines.last, corner, height, width)]
    )
    seen = farthest >= _at_offsets(lines.needed, corner, height, width)
    near = (jnp.abs(jnp.arange(height) - cell[0]) <= 1)[:, None] & (jnp.abs(jnp.arange(width) - cell[1]) <= 1)[None, :]
    # Obstacles are seen from the free cells in front of them, not by lines (see the definition).
    free_seen = (seen | near) & ~occupied
    return near | free_seen | (occupied & dilate(free_seen))


def _reach(occupied: Bool[Array, "H W"], cell: Int32[Array, "2"], lines: _Lines) -> Int32[Array, " lines"]:
    """The last step of every line before it is stopped. A few steps at a time, until all lines are."""
    # The lines are tables of indices into a window of fixed size with the robot in its middle.
    rows, columns = lines.margin
    padded = jnp.pad(_cell_codes(occupied), ((rows, rows), (columns, columns)), constant_values=_OCCUPIED_BIT)
    window = jax.lax.dynamic_slice(padded, (cell[0], cell[1]), (2 * rows + 1, 2 * columns + 1)).ravel()
    codes = jnp.append(window, jnp.uint8(_OCCUPIED_BIT))
    steps, count = lines.cells.shape
    blocks = max(1, -(-steps // _BLOCK))
    missing = blocks * _BLOCK - steps
    # Beyond the last step every line is stopped.
    cells = np.pad(lines.cells, ((0, missing), (0, 0)), constant_values=window.shape[0]).reshape(blocks, _BLOCK, count)
    blocking = np.pad(lines.blocking, ((0, missing), (0, 0)), constant_values=_OCCUPIED_BIT)
    cells, blocking = jnp.asarray(cells), jnp.asarray(blocking.reshape(blocks, _BLOCK, count))

    # Most lines of an indoor map are stopped within some steps: following a block of steps at a time and stopping with
    # the last line costs what the view is deep, not what the range is.
    def follow_block(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        block, reach = carry
        step = block * _BLOCK + jnp.arange(_BLOCK, dtype=jnp.int32)[:, None]
        stopped = (codes[cells[block]] & blocking[block]) != 0
        return block + 1, jnp.minimum(reach, jnp.min(jnp.where(stopped, step, jnp.int32(steps)), axis=0))

    def some_continue(carry: tuple[Array, Array]) -> Array:
        block, reach = carry
        # A line goes on where nothing has stopped it in the blocks before.
        return (block < blocks) & jnp.any(reach >= jnp.minimum(block * _BLOCK, steps))

    return jax.lax.while_loop(some_continue, follow_block, (jnp.int32(0), jnp.full(count, steps, jnp.int32)))[1]


def _cell_codes(occupied: Bool[Array, "H W"]) -> UInt8[Array, "H W"]:
    """Bit 0: an obstacle. Bit ``1 + d``: entering along diagonal ``d`` squeezes between two obstacles."""
    height, width = occupied.shape
    # Both cells beside a diagonal step are neighbours of the cell that it enters: looked at from there, each of the
    # four diagonals is two shifted copies of the map, and a line tests one bit instead of reading two more cells.
    around = jnp.pad(occupied, 1, constant_values=True)
    code = occupied.astype(jnp.uint8)
    for bit, (row_step, column_step) in enumerate(_DIAGONALS, start=1):
        beside = around[1 : 1 + height, 1 - column_step : 1 - column_step + width]
        above = around[1 - row_step : 1 - row_step + height, 1 : 1 + width]
        code = code | ((beside & above).astype(jnp.uint8) << jnp.uint8(bit))
    return code


def _range_maxima(values: Int32[Array, " lines"], levels: int) -> Int32[Array, " entries"]:
    """Row ``l`` of the (flattened) table holds the maximum of every block of ``2 ** l`` values from an index on."""
    rows = [values]
    for level in range(levels - 1):
        # A block of twice the length is two blocks of this level. Blocks that would reach beyond the end are never
        # read.
        shift = min(2**level, values.shape[0])
        ahead = jnp.concatenate([rows[-1][shift:], rows[-1][values.shape[0] - shift :]])
        rows.append(jnp.maximum(rows[-1], ahead))
    return jnp.concatenate(rows)


def _at_offsets(
    table: Int[np.ndarray, "two_h two_w"], corner: tuple[Array, Array], height: int, width: int
) -> Int32[Array, "H W"]:
    """Entries of a table over offsets for all cells of the grid, seen from the robot's cell."""
    return jax.lax.dynamic_slice(jnp.asarray(table), corner, (height, width))


def _half_width(range_cells: float) -> int:
    """Half the width of the square to whose perimeter lines lead."""
    return max(1, math.ceil(range_cells))


@functools.lru_cache(maxsize=32)
def _lines(range_cells: float, height: int, width: int) -> _Lines:
    """The tables. The lines depend on the range alone, so that a padded grid shows the same; the grid bounds steps."""
    half = _half_width(range_cells)
    # On a grid smaller than the range no step beyond the grid's longer side can matter.
    margin = (min(half, height - 1), min(half, width - 1))
    steps = max(margin)
    # Bresenham in closed form: at step k along the main axis the other coordinate is k aim / half, rounded to the
    # nearest integer, ties away from 0.
    k = np.arange(steps + 1)[:, None]
    aim = np.arange(-half, half + 1)[None, :]
    minor = np.sign(aim) * ((2 * k * np.abs(aim) + half) // (2 * half))
    offsets = [(-k, minor), (k, minor), (minor, -k), (minor, k)]
    row = np.concatenate([np.broadcast_to(r, minor.shape) for r, _ in offsets], axis=1)
    column = np.concatenate([np.broadcast_to(c, minor.shape) for _, c in offsets], axis=1)
    cells = (row + margin[0]) * (2 * margin[1] + 1) + column + margin[1]
    outside = (np.abs(row) > margin[0]) | (np.abs(column) > margin[1])
    window_size = (2 * margin[0] + 1) * (2 * margin[1] + 1)
    first, last, needed, levels = _covering_ranges(minor, range_cells, height, width)
    return _Lines(
        margin=margin,
        # Step 0 is the robot's cell, which stops no line.
        cells=np.where(outside, window_size, cells)[1:].astype(np.int32),
        blocking=_blocking_bits(row, column)[1:],
        first=first,
        last=last,
        needed=needed,
        levels=levels,
    )


def _blocking_bits(row: np.ndarray, column: np.ndarray) -> UInt8[np.ndarray, "steps lines"]:
    """The bits of a cell's code that stop a line at each step: an obstacle, and the squeeze along its own diagonal."""
    bits = np.full(row.shape, _OCCUPIED_BIT, np.uint8)
    row_step = np.diff(row, axis=0, prepend=0)
    column_step = np.diff(column, axis=0, prepend=0)
    for bit, diagonal in enumerate(_DIAGONALS, start=1):
        bits[(row_step == diagonal[0]) & (column_step == diagonal[1])] |= np.uint8(1 << bit)
    return bits


def _covering_ranges(
    minor: Int[np.ndarray, "steps side"], range_cells: float, height: int, width: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """For every offset: the two blocks that cover the lines through it, and the step at which they do."""
    side = minor.shape[1]
    row = np.arange(1 - height, height)[:, None]
    column = np.arange(1 - width, width)[None, :]
    # A line of a side passes the cell at the step that is the cell's distance along the side's axis.
    step = np.maximum(np.abs(row), np.abs(column))
    in_range = (row**2 + column**2 <= range_cells**2) & (step < minor.shape[0])
    # A cell on a diagonal belongs to two sides. A line that passes it has followed the diagonal up to there, whichever
    # side it belongs to, so the lines of one will do.
    vertical = np.abs(row) >= np.abs(column)
    sides = np.where(vertical, np.where(row < 0, 0, 1), np.where(column < 0, 2, 3))
    across = np.where(vertical, column, row)
    low, high = np.zeros(step.shape, np.int64), np.zeros(step.shape, np.int64)
    # At step k the lines of a side are in order of where they are, so the range of those in a column is a search.
    for k in range(minor.shape[0]):
        here = (step == k) & in_range
        low[here] = np.searchsorted(minor[k], across[here], side="left")
        high[here] = np.searchsorted(minor[k], across[here], side="right")
    # The largest power of two that fits into the range: two blocks of it cover the range, and may overlap.
    level = np.where(in_range, np.floor(np.log2(np.maximum(high - low, 1))), 0).astype(np.int64)
    first = level * 4 * side + sides * side + low
    last = level * 4 * side + sides * side + np.maximum(high - 2**level, 0)
    # The reach of a line is the number of cells it passes; the cell at step k is its k-th.
    needed = np.where(in_range, step, np.iinfo(np.int32).max)
    return first.astype(np.int32), last.astype(np.int32), needed.astype(np.int32), int(level.max()) + 1
