"""The grid: what is there (``World``) and what has been seen of it (``BeliefMap``).

Cells are ``(row, column)`` with row 0 at the top. A letter is an integer whose bit ``i`` says that proposition ``i``
is true in the cell; labelled cells are free cells (a fire can be seen through and driven into, it merely has a
letter). Worlds and beliefs carry the names of these bits, in order, so that a task over other ones is refused
(``task.propositions``).

Fields are annotated with ``*batch`` in front of their dimensions: a stack of worlds, or what vmap returns, has the same
class. Functions take one world unless they say otherwise.
"""

import base64
import dataclasses
import hashlib
import json
import math
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32, Int, Int8, Int32, Num, Shaped, UInt8

from potlp_jax.errors import WorldError
from potlp_jax.files import one_line
from potlp_jax.precision import in_32_bits
from potlp_jax.task.propositions import check_propositions, in_order
from potlp_jax.task.reading import read_task
from potlp_jax.task.task import Task
from potlp_jax.world.settings import NO_SETTINGS, Settings

# What environments without colours of their own look like.
_FLOOR_COLOUR = (150, 150, 150)
_WALL_COLOUR = (205, 200, 190)


@struct.dataclass(kw_only=True)
class Appearance:
    """What a camera sees of the cells; the mapping sensor and the planner never read it.

    Attributes:
        floor_colour: RGB of the floor of each cell; meaningful on free cells.
        wall_colour: RGB of the sides of each cell; meaningful on obstacles.
        smoke: density of white smoke per cell travelled through, 0 (clear) to 1.
        light: brightness, 0 (dark) to 1 (lit).
    """

    floor_colour: UInt8[Array, "*batch H W 3"]
    wall_colour: UInt8[Array, "*batch H W 3"]
    smoke: Float32[Array, "*batch H W"]
    light: Float32[Array, "*batch H W"]

    # Made by numpy: ``jnp.full`` would compile a program for every shape of map.
    @classmethod
    def plain(cls, height: int, width: int) -> "Appearance":
        """Grey floor, light walls, no smoke, lights on."""
        shape = (height, width)
        return cls(
            floor_colour=jnp.asarray(np.full((*shape, 3), _FLOOR_COLOUR, np.uint8)),
            wall_colour=jnp.asarray(np.full((*shape, 3), _WALL_COLOUR, np.uint8)),
            smoke=jnp.asarray(np.zeros(shape, np.float32)),
            light=jnp.asarray(np.ones(shape, np.float32)),
        )

    def padded(self, top: int, bottom: int, left: int, right: int) -> "Appearance":
        """The same with rows and columns added that repeat the outermost colours, without smoke and lit.

        Args:
            top, bottom: rows to add.
            left, right: columns to add.

        Returns:
            The appearance of the larger grid.
        """
        rows_columns = ((top, bottom), (left, right))
        return Appearance(
            floor_colour=jnp.asarray(np.pad(np.asarray(self.floor_colour), (*rows_columns, (0, 0)), mode="edge")),
            wall_colour=jnp.asarray(np.pad(np.asarray(self.wall_colour), (*rows_columns, (0, 0)), mode="edge")),
            smoke=jnp.asarray(np.pad(np.asarray(self.smoke), rows_columns)),
            light=jnp.asarray(np.pad(np.asarray(self.light), rows_columns, constant_values=1.0)),
        )


_APPEARANCE_FIELDS: tuple[str, ...] = tuple(field.name for field in dataclasses.fields(Appearance))


@struct.dataclass(kw_only=True)
class World:
    """The truth: a grid with a closed border. Made by ``make_world``, which checks it.

    Attributes:
        occupied: True on obstacles.
        letters: the letter of each cell, 0 on obstacles.
        start: the robot's first cell, free.
        resolution: the length of a cell's side in the unit of cost (1: costs are in cells).
        extent: rows and columns of the map without padding; budgets and dead-end costs refer to it.
        appearance: what a camera sees.
        propositions: bit ``i`` of a letter is ``propositions[i]``. Static under jit.
        settings: what trials in this world need to be different from the defaults. Static under jit.
        family: what kind of worlds it is one of (``Generator.family``); empty where nobody says. Static under jit.
    """

    occupied: Bool[Array, "*batch H W"]
    letters: Int32[Array, "*batch H W"]
    start: Int32[Array, "*batch 2"]
    resolution: Float32[Array, "*batch"]
    extent: Int32[Array, "*batch 2"]
    appearance: Appearance
    propositions: tuple[str, ...] = struct.field(pytree_node=False)
    settings: Settings = struct.field(pytree_node=False, default=NO_SETTINGS)
    family: str = struct.field(pytree_node=False, default="")

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        height, width = self.occupied.shape[-2:]
        return height, width

    def task(self, text: str) -> Task:
        """A task over the world's propositions: a formula, the name of a shipped task, or a ``.hoa`` file.

        Raises:
            TaskError: it is none, or it names a proposition that the world does not have.
        """
        return read_task(text, self.propositions)


@struct.dataclass(kw_only=True)
class BeliefMap:
    """What has been observed. Observation is perfect: what is not ``UNKNOWN`` agrees with the world.

    Attributes:
        cells: ``UNKNOWN``, ``FREE`` or ``OCCUPIED``.
        letters: the letter of each cell, 0 where it is not observed.
        resolution: the length of a cell's side in the unit of cost.
        extent: rows and columns of the map without padding.
        propositions: bit ``i`` of a letter is ``propositions[i]``. Static under jit.
    """

    UNKNOWN: ClassVar[int] = -1
    FREE: ClassVar[int] = 0
    OCCUPIED: ClassVar[int] = 1

    cells: Int8[Array, "*batch H W"]
    letters: Int32[Array, "*batch H W"]
    resolution: Float32[Array, "*batch"]
    extent: Int32[Array, "*batch 2"]
    propositions: tuple[str, ...] = struct.field(pytree_node=False)

    @property
    def free(self) -> Bool[Array, "*batch H W"]:
        """Observed free."""
        return self.cells == BeliefMap.FREE

    @property
    def occupied(self) -> Bool[Array, "*batch H W"]:
        """Observed occupied."""
        return self.cells == BeliefMap.OCCUPIED

    @property
    def unknown(self) -> Bool[Array, "*batch H W"]:
        """Not observed."""
        return self.cells == BeliefMap.UNKNOWN

    @classmethod
    def unobserved(cls, world: World) -> "BeliefMap":
        """Nothing seen yet."""
        return cls(
            cells=jnp.full(world.occupied.shape, BeliefMap.UNKNOWN, jnp.int8),
            letters=jnp.zeros(world.letters.shape, jnp.int32),
            resolution=world.resolution,
            extent=world.extent,
            propositions=world.propositions,
        )

    @classmethod
    def revealed(cls, world: World) -> "BeliefMap":
        """Everything seen."""
        cells = jnp.where(world.occupied, jnp.int8(BeliefMap.OCCUPIED), jnp.int8(BeliefMap.FREE))
        return cls(
            cells=cells,
            letters=world.letters,
            resolution=world.resolution,
            extent=world.extent,
            propositions=world.propositions,
        )


@in_32_bits
def make_world(
    occupied: Bool[np.ndarray, "H W"],
    letters: Int[np.ndarray, "_ _"],
    start: tuple[int, int],
    resolution: float = 1.0,
    appearance: Appearance | None = None,
    propositions: Sequence[str] = (),
) -> World:
    """Check the arrays and close the border.

    If any cell of the border is free, a ring of obstacles is added around the arrays; ``start`` refers to the arrays as
    given and is moved with them. Letters on obstacles are dropped.

    Args:
        occupied: True on obstacles.
        letters: bit ``i`` says that ``propositions[i]`` holds in the cell; any integer type.
        start: row and column of the robot's first cell.
        resolution: length of a cell's side in the unit of cost.
        appearance: what a camera sees; default: plain.
        propositions: names of the bits of a letter, in order; by default there are none, and no letters.

    Returns:
        A world with a closed border.

    Raises:
        WorldError: where the shapes disagree, a letter has a bit without a name, the start is outside or on an
            obstacle, or the resolution is not a positive number.
        TaskError: where the propositions are no distinct names, or too many.
    """
    names = check_propositions(propositions)
    _check(occupied, letters, start, resolution, appearance)
    _check_letters(letters, names)
    row, column = (int(entry) for entry in start)
    height, width = occupied.shape
    appearance = Appearance.plain(height, width) if appearance is None else appearance
    # Sensing, rendering and frontiers rely on a closed border: no line leaves the array, no frontier lies on its edge.
    interior = np.zeros(occupied.shape, bool)
    interior[1:-1, 1:-1] = True
    if not np.all(occupied[~interior]):
        occupied = np.pad(occupied, 1, constant_values=True)
        letters = np.pad(letters, 1)
        appearance = appearance.padded(1, 1, 1, 1)
        row, column = row + 1, column + 1
    return World(
        # A copy, because the caller's array may change.
        occupied=jnp.array(occupied),
        letters=jnp.asarray(np.where(occupied, 0, letters).astype(np.int32)),
        start=jnp.asarray(np.array([row, column], np.int32)),
        resolution=jnp.asarray(np.float32(resolution)),
        extent=jnp.asarray(np.array(occupied.shape, np.int32)),
        appearance=appearance,
        propositions=names,
    )


def pad_world(world: World, height: int, width: int) -> World:
    """The world with obstacles added below and to the right until it has ``height`` rows and ``width`` columns.

    Nothing that can be seen, reached or planned changes.

    Args:
        world: one world.
        height, width: rows and columns of the result.

    Returns:
        The padded world; ``extent`` keeps the size without padding.

    Raises:
        WorldError: where the world is larger than that.
    """
    rows, columns = world.shape
    if height < rows or width < columns:
        raise WorldError(f"a world of {rows}x{columns} cells cannot be padded to {height}x{width}: give a larger size")
    # Below and to the right, so that cells keep their coordinates.
    missing = ((0, height - rows), (0, width - columns))
    return dataclasses.replace(
        world,
        occupied=jnp.asarray(np.pad(np.asarray(world.occupied), missing, constant_values=True)),
        letters=jnp.asarray(np.pad(np.asarray(world.letters), missing)),
        appearance=world.appearance.padded(0, height - rows, 0, width - columns),
    )


@in_32_bits
def moved_layer(
    layer: Shaped[Array, "H W *rest"], shape: tuple[int, int], rows: int, columns: int, fill: Any
) -> Shaped[Array, "_ _ *rest"]:
    """A layer of a map on another array, as a robot's map needs that outgrows its own.

    Args:
        layer: one entry for each cell.
        shape: rows and columns of the other array.
        rows, columns: of the other array that lie above the first row and left of the first column of this one;
            negative where it begins farther in.
        fill: for cells that this one does not have.

    Returns:
        The layer; cells outside the other array are gone.
    """
    height, width = layer.shape[:2]
    top, left = max(rows, 0), max(columns, 0)
    bottom, right = min(height + rows, shape[0]), min(width + columns, shape[1])
    moved = jnp.full((*shape, *layer.shape[2:]), fill, layer.dtype)
    if top >= bottom or left >= right:
        return moved
    return moved.at[top:bottom, left:right].set(layer[top - rows : bottom - rows, left - columns : right - columns])


def belief_from_numpy(
    cells: Num[np.ndarray, "H W"],
    letters: Int[np.ndarray, "..."],
    resolution: float = 1.0,
    extent: tuple[int, int] | None = None,
    propositions: Sequence[str] = (),
) -> BeliefMap:
    """A belief from host arrays.

    Args:
        cells: ``BeliefMap.UNKNOWN``, ``FREE`` or ``OCCUPIED`` (-1, 0, 1) in any type of number.
        letters: the letter of each cell in any integer type, 0 where it is not observed; of the shape of ``cells``.
        resolution: length of a cell's side in the unit of cost.
        extent: rows and columns without padding; default: those of the arrays.
        propositions: names of the bits of a letter, in order. A task of other ones is refused, so that a robot names
            all that it could meet, whether it has seen it or not.

    Returns:
        The belief as the planner takes it.

    Raises:
        WorldError: where the shapes disagree, an entry of ``cells`` is none of the three, an unobserved cell has a
            letter, a letter has a bit without a name, or the resolution is not positive.
        TaskError: where the propositions are no distinct names, or too many.
    """
    names = check_belief(cells, letters, resolution, propositions)
    return BeliefMap(
        cells=jnp.asarray(cells.astype(np.int8)),
        letters=jnp.asarray(letters.astype(np.int32)),
        resolution=jnp.asarray(np.float32(resolution)),
        extent=jnp.asarray(np.array(cells.shape if extent is None else extent, np.int32)),
        propositions=names,
    )


def check_belief(
    cells: Num[np.ndarray, "H W"], letters: Int[np.ndarray, "..."], resolution: float, propositions: Sequence[str]
) -> tuple[str, ...]:
    """The names of a belief's propositions; raises as ``belief_from_numpy``, whose arguments these are."""
    names = check_propositions(propositions)
    _check_resolution(resolution)
    # First, for letters of a row, a column or a cell would be compared with every cell, and taken for all of them.
    if letters.shape != cells.shape or cells.ndim != 2 or cells.size == 0:
        raise WorldError(f"cells {cells.shape} and letters {letters.shape} must have one shape [H, W], not empty")
    if not np.isin(cells, (BeliefMap.UNKNOWN, BeliefMap.FREE, BeliefMap.OCCUPIED)).all():
        raise WorldError(f"a belief's cells must be -1, 0 or 1, found {np.unique(cells).tolist()[:8]}")
    # Goals of which the robot is told beforehand would be letters of unobserved cells; the model has none.
    if np.any((cells == BeliefMap.UNKNOWN) & (letters != 0)):
        raise WorldError("a belief has letters in cells that were not observed; set them to 0")
    _check_letters(letters, names)
    return names


def world_to_dict(world: World) -> dict[str, Any]:
    """JSON-able values of one world; arrays are compressed. Read back bit for bit by ``world_from_dict``."""
    appearance = world.appearance
    return {
        "occupied": pack_array(np.asarray(world.occupied)),
        "letters": pack_array(np.asarray(world.letters)),
        "start": np.asarray(world.start).tolist(),
        "resolution": float(world.resolution),
        "extent": np.asarray(world.extent).tolist(),
        "propositions": list(world.propositions),
        "settings": world.settings.to_dict(),
        "family": world.family,
        "appearance": {name: pack_array(np.asarray(getattr(appearance, name))) for name in _APPEARANCE_FIELDS},
    }


def world_digest(world: World) -> str:
    """Sixteen hexadecimal digits that differ for worlds in which anything differs: 64 bits of a SHA-256."""
    digest = hashlib.sha256()
    # Names, types and shapes as well as bytes, so that no two fields can be taken for one.
    arrays = {name: getattr(world, name) for name in ("occupied", "letters", "start", "resolution", "extent")}
    arrays |= {name: getattr(world.appearance, name) for name in _APPEARANCE_FIELDS}
    for name, values in arrays.items():
        array = np.ascontiguousarray(values)
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.tobytes())
    digest.update(json.dumps([world.propositions, world.settings.to_dict(), world.family], sort_keys=True).encode())
    return digest.hexdigest()[:16]


def world_from_dict(data: Mapping[str, Any]) -> World:
    """The world that ``world_to_dict`` wrote. Raises WorldError where the values are damaged."""
    try:
        # The same checks as for a new world, so that a damaged file cannot make one that breaks elsewhere.
        appearance = {name: jnp.asarray(unpack_array(values)) for name, values in data["appearance"].items()}
        row, column = (int(entry) for entry in data["start"])
        rows, columns = (int(size) for size in data["extent"])
        settings, propositions, family = Settings(data["settings"]), data["propositions"], data["family"]
        # A mapping has keys where a list has names, and a text has letters.
        if not isinstance(propositions, list):
            raise TypeError(f"propositions is a list of names, found {propositions!r}")
        if not isinstance(family, str):
            raise TypeError(f"family is a name, found {family!r}")
        world = make_world(
            unpack_array(data["occupied"]),
            unpack_array(data["letters"]),
            (row, column),
            float(data["resolution"]),
            Appearance(**appearance),
            propositions,
        )
    except WorldError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, zlib.error) as error:
        raise WorldError(f"not the values of a world: {one_line(repr(error))}") from error
    if not (0 < rows <= world.shape[0] and 0 < columns <= world.shape[1]):
        raise WorldError(f"the extent {rows}x{columns} does not fit the {world.shape[0]}x{world.shape[1]} grid")
    # The border was closed when the world was made, so ``make_world`` has added no ring; padding is told by the extent.
    extent = jnp.asarray(np.array([rows, columns], np.int32))
    return dataclasses.replace(world, extent=extent, settings=settings, family=family)


def pack_array(array: Shaped[np.ndarray, "..."]) -> dict[str, Any]:
    """Shape, type and zlib-compressed bytes (base64) of an array, as JSON-able values."""
    # ``dtype.str`` names the byte order, so that files travel between machines.
    contiguous = np.ascontiguousarray(array)
    data = base64.b64encode(zlib.compress(contiguous.tobytes())).decode()
    return {"shape": list(array.shape), "dtype": contiguous.dtype.str, "zlib": data}


def unpack_array(data: Mapping[str, Any]) -> Shaped[np.ndarray, "..."]:
    """The array that ``pack_array`` wrote."""
    # A copy, because an array over ``bytes`` cannot be written to.
    dtype, shape = np.dtype(data["dtype"]), tuple(int(size) for size in data["shape"])
    # No more is unpacked than the shape says, and one byte: a kilobyte can unpack to a gigabyte.
    size = dtype.itemsize * math.prod(shape)
    unpacker = zlib.decompressobj()
    raw = unpacker.decompress(base64.b64decode(data["zlib"]), size + 1)
    # Only at its end is the stream's checksum compared.
    if not unpacker.eof or len(raw) != size:
        raise ValueError(f"an array of shape {shape} and type {dtype} has other than {size} bytes")
    return np.frombuffer(raw, dtype=dtype).reshape(shape).copy()


def _check_resolution(resolution: float) -> None:
    if not (np.isfinite(resolution) and resolution > 0):
        raise WorldError(f"the resolution must be a positive number, found {resolution}")


def _check(
    occupied: np.ndarray,
    letters: np.ndarray,
    start: tuple[int, int],
    resolution: float,
    appearance: Appearance | None,
) -> None:
    """Raises WorldError for what ``make_world`` must not be given."""
    # Types first: what follows compares values.
    if occupied.dtype != np.bool_ or not np.issubdtype(letters.dtype, np.integer):
        raise WorldError(f"occupied must be boolean, letters integers; found {occupied.dtype} and {letters.dtype}")
    if letters.shape != occupied.shape or occupied.ndim != 2 or occupied.size == 0:
        raise WorldError(f"occupied {occupied.shape} and letters {letters.shape} must have one shape [H, W], not empty")
    row, column = start
    height, width = occupied.shape
    if not (0 <= row < height and 0 <= column < width):
        raise WorldError(f"the start ({row}, {column}) lies outside of the {height}x{width} grid")
    if occupied[row, column]:
        raise WorldError(f"the start ({row}, {column}) is an obstacle; choose a free cell")
    _check_resolution(resolution)
    if appearance is not None:
        _check_appearance(appearance, occupied.shape)


def _check_letters(letters: np.ndarray, propositions: tuple[str, ...]) -> None:
    """Raises WorldError where a letter has a bit that no proposition names."""
    # A table that is indexed with such a letter answers for another one: JAX clips indices and says nothing.
    if letters.size and (letters.min() < 0 or letters.max() >= 2 ** len(propositions)):
        raise WorldError(
            f"letters of {in_order(propositions)} must lie in 0..{2 ** len(propositions) - 1}, found "
            f"{letters.min()}..{letters.max()}; name every bit, propositions=(...)"
        )


def _check_appearance(appearance: Appearance, shape: tuple[int, ...]) -> None:
    """Raises WorldError where a field does not fit a grid of this shape."""
    # The renderer packs fields into bits by their types, so that another type would change colours without an error.
    wanted = {
        "floor_colour": ((*shape, 3), jnp.uint8),
        "wall_colour": ((*shape, 3), jnp.uint8),
        "smoke": (shape, jnp.float32),
        "light": (shape, jnp.float32),
    }
    for name, (size, dtype) in wanted.items():
        found = getattr(appearance, name)
        if found.shape != size or found.dtype != dtype:
            raise WorldError(f"{name} must be {np.dtype(dtype)}{size} on this grid, found {found.dtype}{found.shape}")
