"""Maps as images without loss (PNG): how data sets keep true maps, and what was known and painted at a view.

Only the map's extent is kept; the padding that gives all worlds of a family one shape is added again on reading.
"""

import dataclasses
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int8, Int32, Shaped, UInt8

from potlp_jax.errors import DatasetError
from potlp_jax.files import reading
from potlp_jax.images import decode_image
from potlp_jax.learning.painting import Painting
from potlp_jax.world.grid import BeliefMap, World

MAP_COLUMNS: tuple[str, ...] = ("cells", "letters", "floor", "beyond", "distance")
"""Images of a view: those of the belief, then those of the painting."""

# Distances are kept in steps of a 32nd of a cell; the largest number means that a cell was never in sight.
_STEPS = 32
_NEVER = np.iinfo(np.uint16).max
# Values of cells are -1, 0 and 1; pixels are not negative.
_OFFSET = 1


@dataclass(frozen=True)
class EncodedWorld:
    """A true map of ``rows`` and ``columns`` without padding; cells that a log does not show are ``UNKNOWN``."""

    rows: int
    columns: int
    cells: bytes
    letters: bytes


@dataclass(frozen=True)
class EncodedView:
    """The belief and the painting at a view, of the world's rows and columns."""

    cells: bytes
    letters: bytes
    floor: bytes
    beyond: bytes
    distance: bytes


@dataclass(frozen=True)
class DecodedView:
    """Arrays of a view, padded to one shape: of the belief, of the painting, and of the true map."""

    extent: tuple[int, int]
    cells: Int8[np.ndarray, "H W"]
    letters: Int32[np.ndarray, "H W"]
    floor: UInt8[np.ndarray, "H W 3"]
    beyond: UInt8[np.ndarray, "H W 3"]
    distance: Float32[np.ndarray, "H W"]
    true_cells: Int8[np.ndarray, "H W"]
    true_letters: Int32[np.ndarray, "H W"]


def encode_world(world: World, unseen: Bool[np.ndarray, "H W"] | None = None) -> EncodedWorld:
    """A world's map.

    Args:
        world: the true map.
        unseen: True where a log does not say what is there.
    """
    rows, columns = np.asarray(world.extent).tolist()
    cells = np.where(np.asarray(world.occupied), BeliefMap.OCCUPIED, BeliefMap.FREE)
    if unseen is not None:
        cells = np.where(unseen, BeliefMap.UNKNOWN, cells)
    return EncodedWorld(
        rows=rows,
        columns=columns,
        cells=_encoded(_cropped(cells + _OFFSET, rows, columns, np.uint8)),
        letters=_encoded(_cropped(np.asarray(world.letters), rows, columns, np.uint16)),
    )


def encode_view(belief: BeliefMap, painting: Painting) -> EncodedView:
    """What is known and painted."""
    rows, columns = np.asarray(belief.extent).tolist()
    distance = np.asarray(painting.distance, np.float64)
    # A map would have to be 2,000 cells wide to reach the largest number.
    steps = np.where(np.isfinite(distance), np.minimum(np.round(distance * _STEPS), _NEVER - 1), _NEVER)
    return EncodedView(
        cells=_encoded(_cropped(np.asarray(belief.cells) + _OFFSET, rows, columns, np.uint8)),
        letters=_encoded(_cropped(np.asarray(belief.letters), rows, columns, np.uint16)),
        floor=_encoded(_cropped(np.asarray(painting.floor), rows, columns, np.uint8)),
        beyond=_encoded(_cropped(np.asarray(painting.beyond), rows, columns, np.uint8)),
        distance=_encoded(_cropped(steps, rows, columns, np.uint16)),
    )


def decode_view(view: EncodedView, world: EncodedWorld, shape: tuple[int, int]) -> DecodedView:
    """Arrays of a view and its world; may be called from several threads.

    Args:
        view: of the world.
        world: its true map.
        shape: rows and columns of the arrays; what the map does not fill is occupied and never seen.

    Returns:
        What the robot knew in the view, and what is true.

    Raises:
        DatasetError: an image is damaged, or of another size than the world, or the world is larger than the arrays.
    """
    extent = world.rows, world.columns
    if extent[0] > shape[0] or extent[1] > shape[1]:
        raise DatasetError(f"a world of {extent} cells is larger than the data set's arrays of {shape}")

    def padded(image: bytes, value: int) -> np.ndarray:
        return _padded(_decoded(image, extent), shape, value)

    def cells(image: bytes, outside: int) -> Int8[np.ndarray, "H W"]:
        return padded(image, outside + _OFFSET).astype(np.int8) - np.int8(_OFFSET)

    steps = padded(view.distance, _NEVER)
    return DecodedView(
        extent=extent,
        cells=cells(view.cells, BeliefMap.UNKNOWN),
        letters=padded(view.letters, 0).astype(np.int32),
        floor=padded(view.floor, 0),
        beyond=padded(view.beyond, 0),
        distance=np.where(steps == _NEVER, np.float32(np.inf), steps.astype(np.float32) / np.float32(_STEPS)),
        true_cells=cells(world.cells, BeliefMap.OCCUPIED),
        true_letters=padded(world.letters, 0).astype(np.int32),
    )


def without_painting(view: EncodedView) -> EncodedView:
    """The same view with nothing painted on its map."""
    rows, columns = _pixels(view.distance).shape
    black = _encoded(np.zeros((rows, columns, 3), np.uint8))
    never = _encoded(np.full((rows, columns), _NEVER, np.uint16))
    return dataclasses.replace(view, floor=black, beyond=black, distance=never)


def _cropped(array: np.ndarray, rows: int, columns: int, dtype: type) -> Shaped[np.ndarray, "rows columns *channels"]:
    return np.ascontiguousarray(array[:rows, :columns].astype(dtype))


def _encoded(array: np.ndarray) -> bytes:
    # The fastest compression of PNG: maps are mostly even, and shrink well with any.
    done, data = cv2.imencode(".png", array, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    assert done
    return data.tobytes()


def _decoded(image: bytes, extent: tuple[int, int]) -> np.ndarray:
    array = _pixels(image)
    if array.shape[:2] != extent:
        raise DatasetError(f"a map of the dataset has {array.shape[:2]} cells; its world has {extent}")
    return array


def _pixels(image: bytes) -> np.ndarray:
    with reading("a map of the dataset", DatasetError, "an image"):
        return decode_image(image, cv2.IMREAD_UNCHANGED)


def _padded(array: np.ndarray, shape: tuple[int, int], value: int) -> np.ndarray:
    rows, columns = (size - have for size, have in zip(shape, array.shape[:2], strict=True))
    return np.pad(array, ((0, rows), (0, columns), *((0, 0),) * (array.ndim - 2)), constant_values=value)
