"""Reads occupancy maps in the format of ROS ``map_server`` (ROS 1) and ``nav2_map_server`` (ROS 2).

A map is a YAML file and an image. A pixel's *occupancy* is ``(255 - p) / 255``, where ``p`` is the mean of its channels
on a scale to 255, or ``p / 255`` with ``negate: 1``. Then, by ``mode``:

=========  =====================================================================================================
trinary    above ``occupied_thresh``: 100; below ``free_thresh``: 0; else -1 (unknown). Alpha is averaged in, as both
           servers do.
scale      as trinary, but between the thresholds ``floor(99 (occupancy - free) / (occupied - free))``, and pixels that
           are not opaque are -1 (ROS 2; ROS 1 looks at fully transparent ones only).
raw        the pixel itself where it is at most 100, else -1; ``free_thresh`` and ``occupied_thresh`` in percent say
           what is free and what is an obstacle.
=========  =====================================================================================================

Thresholds are compared in exact arithmetic, as fractions of the decimal text: 205 is unknown under a ``free_thresh`` of
0.196 (50/255 = 0.19608), and 204 is unknown under an ``occupied_thresh`` of 0.2 (51/255 is not above 1/5), whatever the
rounding of floats.

The first row of the image is the top of the map. ``origin`` is the pose (x, y, yaw) of the lower left corner of the
lower left pixel; a yaw turns the whole image about that corner.

References:
    ROS wiki, "map_server", and the sources of ``map_server/image_loader.cpp`` and ``nav2_map_server/map_io.cpp``.
"""

import math
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import yaml
from jaxtyping import Bool, Float64, Int8, Int64, Shaped

from potlp_jax import files, images
from potlp_jax.environments.ros.working_grid import require_memory
from potlp_jax.errors import MapError, MapWarning
from potlp_jax.files import short

if TYPE_CHECKING:
    from potlp_jax.environments.ros.places import Places

ROS_MAP = "ROS map"
"""The kind of a map that is an image with a YAML file."""

MODES = ("trinary", "scale", "raw")
OCCUPIED = 100
FREE = 0
UNKNOWN = -1

DEFAULT_OCCUPIED_THRESH = "0.65"
DEFAULT_FREE_THRESH = "0.196"
"""ROS 1's value: under nav2's 0.25 the grey by which map savers mean "unknown" would be free."""

SAVED_UNKNOWN = 205
"""Grey value by which the map savers of ROS 1 and ROS 2 mean "unknown"."""

PLATEAU_FRACTION = 0.05
PLATEAU_GREYS = 8
"""A grey that covers this fraction of an image, so much darker than another such grey, means something else than it."""

BOUNDARY_DECIMALS = 6
"""Cell coordinates are rounded to so many decimals: a point on a cell's edge stays there in spite of floating point."""

LONGEST_NUMBER = 60
"""Characters of a number: those that programs write have at most 24."""

LARGEST_NUMBER = 1e9
"""Metres from the origin of a map at which floats still tell micrometres; maps in UTM coordinates reach 1e7."""

SMALLEST_PIXEL, LARGEST_PIXEL = 1e-4, 100.0
"""Metres a pixel between which a map can be one of a building."""

_REQUIRED_KEYS = ("image", "resolution", "origin")
_OPTIONAL_KEYS = ("mode", "negate", "occupied_thresh", "free_thresh")
_BOOLEANS = {"0": False, "1": True, "false": False, "true": True, "no": False, "yes": True}


@dataclass(frozen=True)
class GridFrame:
    """Where a grid lies in the world: the pose of its lower left corner, in metres and radians.

    Rows count from the top, so a cell ``(row, col)`` has ``height - 1 - row`` rows of cells below it. ``yaw`` turns the
    grid counter-clockwise about its lower left corner.
    """

    height: int
    width: int
    resolution: float
    x: float
    y: float
    yaw: float = 0.0

    def to_grid(self, points: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        """Metres (x, y) to cells from the lower left corner: along the grid's columns and, upwards, its rows."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        # The inverse turn: into the grid's own axes.
        shifted = points - np.array([[self.x, self.y]])
        along = shifted @ np.array([[cos, -sin], [sin, cos]])
        return np.round(along / self.resolution, BOUNDARY_DECIMALS)

    def metres_to_cell(self, x: float | int, y: float | int) -> tuple[int, int]:
        """Cell (row, col) that holds a point; outside of the grid where the point is (see `contains`).

        A point on an edge belongs to the cell of larger x and larger y (of the grid's own axes).
        """
        # To the cell of larger y means to the lower row number: rows count from the top.
        across, up = self.to_grid(np.array([[x, y]], dtype=np.float64))[0]
        return self.height - 1 - math.floor(up), math.floor(across)

    def cell_to_metres(self, row: int, col: int) -> tuple[float, float]:
        """Centre of a cell in metres (x, y)."""
        return self._corner_to_metres(col + 0.5, self.height - 1 - row + 0.5)

    def contains(self, row: int, col: int) -> bool:
        """Whether (row, col) is a cell of the grid."""
        return 0 <= row < self.height and 0 <= col < self.width

    def window(self, top: int, left: int, height: int, width: int) -> "GridFrame":
        """Frame of a part of the grid; it may reach beyond it.

        Args:
            top, left: first row and first column.
            height, width: rows and columns.

        Returns:
            The same axes and size of cells, with the lower left corner of the part.
        """
        # Of the window's lower left corner, as that of every frame is given.
        x, y = self._corner_to_metres(left, self.height - top - height)
        return GridFrame(height, width, self.resolution, x, y, self.yaw)

    def _corner_to_metres(self, across: float | int, up: float | int) -> tuple[float, float]:
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        right, above = across * self.resolution, up * self.resolution
        return self.x + cos * right - sin * above, self.y + sin * right + cos * above


@dataclass(frozen=True)
class MapSettings:
    """The YAML of a map, checked. Numbers that thresholds and cells depend on are exact."""

    file: Path
    image: Path
    resolution: Fraction
    origin: tuple[float, float, float]
    mode: str
    negate: bool
    occupied_thresh: Fraction
    free_thresh: Fraction


@dataclass(frozen=True, eq=False)
class OccupancyMap:
    """A map as its server would publish it, with row 0 at the top; plans of other formats become one, too.

    Attributes:
        settings: the YAML.
        occupancy: 0 to 100, or -1 for unknown.
        free: what the thresholds call free.
        occupied: what the thresholds call an obstacle; neither of the two is unknown.
        frame: metres to pixels.
        kind: of file, for people.
        closed: obstacles that the file does not have, added to close outer walls; None where nothing was to be closed.
        places: what the file names; None where it names nothing.
    """

    settings: MapSettings
    occupancy: Int8[np.ndarray, "H W"]
    free: Bool[np.ndarray, "H W"]
    occupied: Bool[np.ndarray, "H W"]
    frame: GridFrame
    kind: str = ROS_MAP
    closed: Bool[np.ndarray, "H W"] | None = None
    places: "Places | None" = None

    @property
    def closed_gaps(self) -> int:
        """Gaps in outer walls that were closed."""
        return 0 if self.closed is None else cv2.connectedComponents(self.closed.astype(np.uint8))[0] - 1


def load_map(file: Path | str) -> OccupancyMap:
    """Read a map's YAML and its image.

    Raises:
        MapError: a file is missing, cut short or not of its format; a field is missing or makes no sense; the map has
            no obstacle, or nothing free.

    Warns:
        MapWarning: an unknown key, a default in the place of a missing threshold, an image found elsewhere than the
            YAML says, and pixels that mean "unknown" but are free under ``free_thresh``.
    """
    settings = load_settings(file)
    # The largest value of the format, by which pixels are scaled: 255, 65535 or what a PGM's header says.
    pixels, white = _read_image(settings.image)
    shade = _shade(settings, pixels, white)
    occupancy, free, occupied = (
        _raw_occupancy(settings, shade) if settings.mode == "raw" else _threshold(settings, shade)
    )
    _check_classes(settings, shade, free, occupied)
    _warn_of_unknown_as_free(settings, shade, free)
    height, width = free.shape
    frame = GridFrame(height, width, float(settings.resolution), *settings.origin)
    return OccupancyMap(settings, occupancy, free, occupied, frame)


def load_settings(file: Path | str) -> MapSettings:
    """Read and check a map's YAML; `load_map` lists what it raises."""
    file = Path(file)
    # Every scalar is still text here, so that 0.196 stays 196/1000.
    fields = read_yaml(file)
    _check_keys(file, fields)
    settings = MapSettings(
        file=file,
        image=_find_image(file, fields["image"]),
        resolution=parse_number(file, "resolution", fields["resolution"]),
        origin=_parse_origin(file, fields["origin"]),
        mode=_parse_choice(file, "mode", fields.get("mode", "trinary"), MODES),
        negate=_BOOLEANS[_parse_choice(file, "negate", fields.get("negate", "0"), tuple(_BOOLEANS))],
        occupied_thresh=_parse_threshold(file, fields, "occupied_thresh", DEFAULT_OCCUPIED_THRESH),
        free_thresh=_parse_threshold(file, fields, "free_thresh", DEFAULT_FREE_THRESH),
    )
    if not SMALLEST_PIXEL <= settings.resolution <= LARGEST_PIXEL:
        raise MapError(
            file,
            "resolution",
            f"{fields['resolution']} must lie between {SMALLEST_PIXEL:g} and {LARGEST_PIXEL:g} (metres a pixel)",
        )
    if settings.occupied_thresh <= settings.free_thresh:
        raise MapError(
            file,
            "occupied_thresh",
            f"{float(settings.occupied_thresh)} must be larger than free_thresh, {float(settings.free_thresh)}",
        )
    # The two servers disagree, so that whatever is read would be wrong for one of them.
    if settings.mode == "raw" and settings.negate:
        raise MapError(
            file, "negate", "ROS 1 inverts raw pixels and ROS 2 does not: invert the image and set negate: 0"
        )
    return settings


_LOADER = yaml.CBaseLoader if yaml.__with_libyaml__ else yaml.BaseLoader
"""Leaves every scalar as its text, so that numbers stay exact."""


def read_yaml(file: Path) -> dict[str, Any]:
    """The mapping in a YAML file, every scalar as its text.

    Raises:
        MapError: the file is missing, is no YAML, or holds something else than a mapping of names.
    """
    fields = files.read_yaml(file, MapError, _LOADER)
    if not isinstance(fields, dict) or not all(isinstance(key, str) for key in fields):
        raise MapError(file, "", "must hold lines of the form 'key: value'")
    return fields


def parse_number(file: Path, field: str, text: Any) -> Fraction:
    """The exact value of a decimal text.

    Args:
        file, field: where the text is from, for messages.
        text: what the YAML has there.

    Returns:
        The number as a fraction, so that comparisons with it are exact.

    Raises:
        MapError: it is not a finite decimal number.
    """
    # An exponent of more than three digits would make a fraction of millions of digits, and so would the digits alone.
    pattern = r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d{1,3})?"
    if not isinstance(text, str) or len(text) > LONGEST_NUMBER or not re.fullmatch(pattern, text.strip(), re.ASCII):
        raise MapError(file, field, f"{short(text)} is not a finite number of at most {LONGEST_NUMBER} characters")
    value = Fraction(text.strip())
    if abs(value) > LARGEST_NUMBER:
        raise MapError(file, field, f"{text} is beyond {LARGEST_NUMBER:g}, the largest number that is read")
    return value


def parse_numbers(file: Path, field: str, value: Any, names: tuple[str, ...]) -> tuple[float, ...]:
    """A list of numbers, one for each name, such as ``[x, y]``.

    Args:
        file, field: where the list is from, for messages.
        value: what the YAML has there.
        names: of the numbers.

    Returns:
        As many numbers as there are names.

    Raises:
        MapError: it is something else.
    """
    if not isinstance(value, list) or len(value) != len(names):
        raise MapError(file, field, f"{short(value)} must be a list [{', '.join(names)}]")
    return tuple(float(parse_number(file, field, item)) for item in value)


def _check_keys(file: Path, fields: Mapping[str, Any]) -> None:
    for key in _REQUIRED_KEYS:
        if key not in fields:
            raise MapError(file, key, "is missing; a map needs " + ", ".join(_REQUIRED_KEYS))
    unknown = sorted(set(fields) - {*_REQUIRED_KEYS, *_OPTIONAL_KEYS})
    if unknown:
        _warn(file, ", ".join(unknown), "unknown, ignored; known are " + ", ".join((*_REQUIRED_KEYS, *_OPTIONAL_KEYS)))


def _find_image(file: Path, text: Any) -> Path:
    if not isinstance(text, str) or not text.strip():
        raise MapError(file, "image", f"{short(text)} must be the name of an image file")
    image = file.parent / text.strip()  # an absolute path stays as it is
    with files.reading(file, MapError, "the name of an image file"):
        if image.exists():
            return image
    # Maps that were copied from another machine often keep the absolute path of their image.
    sibling = file.parent / image.name
    if sibling.exists():
        _warn(file, "image", f"{image} does not exist; using {sibling}")
        return sibling
    looked_at = f"{image} does not exist" + ("" if sibling == image else f", nor does {sibling}")
    raise MapError(file, "image", f"{looked_at}; put the image there or mend the path")


def _parse_origin(file: Path, value: Any) -> tuple[float, float, float]:
    x, y, yaw = parse_numbers(file, "origin", value, ("x", "y", "yaw"))
    return x, y, yaw


def _parse_choice(file: Path, field: str, text: Any, choices: tuple[str, ...]) -> str:
    if not isinstance(text, str) or text.strip().lower() not in choices:
        raise MapError(file, field, f"{short(text)} must be one of {', '.join(choices)}")
    return text.strip().lower()


def _parse_threshold(file: Path, fields: Mapping[str, Any], field: str, default: str) -> Fraction:
    # The two servers have different defaults, so a missing threshold is worth a word.
    if field not in fields:
        _warn(file, field, f"is missing; using {default}")
    value = parse_number(file, field, fields.get(field, default))
    if not 0 <= value <= 1:
        raise MapError(file, field, f"{float(value)} must lie between 0 and 1")
    return value


def _warn(file: Path, field: str, message: str) -> None:
    warnings.warn(f"{file}: {field}: {message}", MapWarning, stacklevel=2)


def _read_image(file: Path) -> tuple[Shaped[np.ndarray, "H W C"], int]:
    """Pixels, and the value that stands for white."""
    content = files.read_bytes(file, MapError, images.MOST_IMAGE)
    # Magic numbers of the two kinds of PGM.
    if content[:2] in (b"P2", b"P5"):
        with files.reading(file, MapError, "a PGM image"):
            return _read_pgm(file, content)
    with files.reading(file, MapError, "an image (PGM, PNG or BMP)"):
        require_memory(file, *images.image_size(content))
        pixels = images.decode_image(content, cv2.IMREAD_UNCHANGED, whole=True)
    if pixels.dtype not in (np.uint8, np.uint16):
        raise MapError(file, "", f"has pixels of type {pixels.dtype}; needed are 8 or 16 bits a channel")
    return pixels.reshape(*pixels.shape[:2], -1), int(np.iinfo(pixels.dtype).max)


def _read_pgm(file: Path, content: bytes) -> tuple[Int64[np.ndarray, "H W 1"], int]:
    """ASCII (P2) and binary (P5) PGM with any maximum, which image libraries scale differently or not at all."""
    # Comments may stand between any two numbers of the header.
    header = re.match(rb"P[25]((?:\s|#[^\n]*\n)+\d+){3}", content)
    if header is None:
        raise MapError(file, "", "has no valid PGM header (width, height, maximum)")
    width, height, white = (int(text) for text in re.sub(rb"#[^\n]*\n", b" ", header[0])[2:].split())
    if width == 0 or height == 0 or not 0 < white < 2**16:
        raise MapError(file, "", f"has an invalid PGM header: {width} x {height} pixels, maximum {white}")
    if width * height > images.MOST_PIXELS:
        raise MapError(file, "", f"has {width:,} x {height:,} pixels; at most {images.MOST_PIXELS:,} are read")
    require_memory(file, width, height)
    body = content[header.end() :]
    values = _ascii_values(file, body) if content[:2] == b"P2" else _binary_values(body, white)
    # A file with more is accepted, as by every reader; one with less has lost a part of the building.
    if len(values) < width * height:
        raise MapError(
            file, "", f"is cut short: {len(values)} of {width} x {height} = {width * height} pixels are there"
        )
    pixels = values[: width * height].astype(np.int64).reshape(height, width, 1)
    if pixels.max() > white:
        raise MapError(file, "", f"has a pixel of {pixels.max()}, above its maximum {white}")
    return pixels, white


def _ascii_values(file: Path, body: bytes) -> Shaped[np.ndarray, "N"]:
    try:
        return np.array(re.sub(rb"#[^\n]*", b"", body).split(), dtype=np.uint32)
    except (ValueError, OverflowError) as error:
        raise MapError(file, "", f"has a pixel that is no number: {error}") from error


def _binary_values(body: bytes, white: int) -> Shaped[np.ndarray, "N"]:
    """One byte a pixel, or two, the larger first, after a single white space."""
    size = 1 if white < 256 else 2
    pixels = body[1:]
    return np.frombuffer(pixels[: len(pixels) // size * size], dtype=np.uint8 if size == 1 else ">u2")


@dataclass(frozen=True, eq=False)
class _Shade:
    """Darkness of each pixel as the exact fraction ``darkness / full`` (before ``negate``: 0 is white); what is opaque.

    In trinary mode alpha is one more channel, and every pixel counts as opaque.
    """

    darkness: Int64[np.ndarray, "H W"]
    full: int
    opaque: Bool[np.ndarray, "H W"]

    def greys(self) -> Int64[np.ndarray, "H W"]:
        """Pixel values on a scale from 0, black, to 255, white, rounded; half a grey goes up."""
        return (510 * (self.full - self.darkness) + self.full) // (2 * self.full)


def _shade(settings: MapSettings, pixels: Shaped[np.ndarray, "H W C"], white: int) -> _Shade:
    # Grey or colour, each with or without alpha: an even number of channels means that the last is alpha.
    has_alpha = pixels.shape[-1] in (2, 4)
    counts_alpha = has_alpha and settings.mode == "trinary"
    counted = pixels[..., :-1] if has_alpha and not counts_alpha else pixels
    opaque = np.ones(pixels.shape[:2], dtype=bool)
    if has_alpha and not counts_alpha:
        opaque = pixels[..., -1] == white
    full = white * counted.shape[-1]
    return _Shade(full - counted.sum(axis=-1, dtype=np.int64), full, opaque)


def _threshold(
    settings: MapSettings, shade: _Shade
) -> tuple[Int8[np.ndarray, "H W"], Bool[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """Occupancy, free and occupied of trinary and scale maps, compared without rounding.

    For an integer d, ``d / full > t`` is ``d > floor(full t)``, and ``d / full < t`` is ``d < ceil(full t)``.
    """
    full, occupied_thresh, free_thresh = shade.full, settings.occupied_thresh, settings.free_thresh
    darkness = full - shade.darkness if settings.negate else shade.darkness
    occupied = shade.opaque & (darkness > math.floor(full * occupied_thresh))
    free = shade.opaque & (darkness < math.ceil(full * free_thresh))
    occupancy = np.where(occupied, OCCUPIED, np.where(free, FREE, UNKNOWN)).astype(np.int8)
    if settings.mode == "scale":
        # The exact fraction is taken once for each value that occurs, of which there are few.
        between = shade.opaque & ~occupied & ~free
        values, places = np.unique(darkness[between], return_inverse=True)
        scale = 99 / (occupied_thresh - free_thresh)
        scaled = [math.floor((Fraction(int(value), full) - free_thresh) * scale) for value in values]
        occupancy[between] = np.array(scaled, dtype=np.int8)[places]
    return occupancy, free, occupied


def _raw_occupancy(
    settings: MapSettings, shade: _Shade
) -> tuple[Int8[np.ndarray, "H W"], Bool[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    # A raw pixel is the occupancy itself; 101 to 255 are unknown.
    greys = shade.greys()
    known = shade.opaque & (greys <= OCCUPIED)
    occupied = known & (greys > math.floor(100 * settings.occupied_thresh))
    free = known & (greys < math.ceil(100 * settings.free_thresh))
    return np.where(known, greys, UNKNOWN).astype(np.int8), free, occupied


def _check_classes(
    settings: MapSettings, shade: _Shade, free: Bool[np.ndarray, "H W"], occupied: Bool[np.ndarray, "H W"]
) -> None:
    for field, pixels, kind in (("occupied_thresh", occupied, "no obstacle"), ("free_thresh", free, "nothing free")):
        if not pixels.any():
            value = float(getattr(settings, field))
            raise MapError(
                settings.file,
                field,
                f"{value} leaves {kind} in {settings.image.name}, where {_commonest(settings, shade)}; "
                f"check mode and negate, {_advise(settings, shade)}",
            )


def _advise(settings: MapSettings, shade: _Shade) -> str:
    """Thresholds under which the image has free space and obstacles, where there are any."""
    if settings.mode == "raw":
        known = shade.greys()[shade.opaque]
        values, full = known[known <= OCCUPIED], OCCUPIED
    else:
        darkness = shade.darkness[shade.opaque]
        values, full = shade.full - darkness if settings.negate else darkness, shade.full
    if not values.size or values.min() == values.max():
        return "and the image: no thresholds tell free space from obstacles in it"
    # Both at once: advice on one alone may ask for a value that the other forbids.
    lightest, darkest = (Fraction(int(value), full) for value in (values.min(), values.max()))
    third = (darkest - lightest) / 3
    # More digits where the image's greys are closer than three digits can tell.
    digits = 3 if third > Fraction(1, 500) else 9
    return (
        f"or set free_thresh and occupied_thresh between the lightest, {float(lightest):.{digits}f}, and the darkest, "
        f"{float(darkest):.{digits}f}, such as free_thresh: {float(lightest + third):.{digits}f} and "
        f"occupied_thresh: {float(darkest - third):.{digits}f}"
    )


def _commonest(settings: MapSettings, shade: _Shade) -> str:
    """The commonest greys and their occupancies, for a message that has to help in choosing thresholds."""
    greys, counts = np.unique(shade.greys(), return_counts=True)
    commonest = np.sort(greys[np.argsort(-counts, kind="stable")[:4]])[::-1]
    return "the commonest greys are " + ", ".join(
        f"{grey} (occupancy {float(_occupancy_of_grey(settings, int(grey))):.3f})" for grey in commonest
    )


def _occupancy_of_grey(settings: MapSettings, grey: int) -> Fraction:
    if settings.mode == "raw":
        return Fraction(grey, 100)
    return Fraction(grey if settings.negate else 255 - grey, 255)


def _warn_of_unknown_as_free(settings: MapSettings, shade: _Shade, free: Bool[np.ndarray, "H W"]) -> None:
    """Names greys that are free but look like the map's unknown: 205, or a large area darker than the free one."""
    if settings.mode == "raw":
        return  # raw pixels are occupancies already, no picture
    # A grey that covers much of the image is meant by whoever made it; noise is spread over many.
    counts = np.bincount(shade.greys()[free], minlength=256)
    common = np.flatnonzero(counts >= PLATEAU_FRACTION * free.size)
    lightest = common.min(initial=255) if settings.negate else common.max(initial=0)
    suspects = {int(grey) for grey in common if abs(int(grey) - int(lightest)) >= PLATEAU_GREYS}
    if counts[SAVED_UNKNOWN]:
        suspects.add(SAVED_UNKNOWN)
    for grey in sorted(suspects):
        exact = _occupancy_of_grey(settings, grey)
        # Where this grey is all the free space, a lower threshold would leave none.
        if not any(_occupancy_of_grey(settings, int(other)) < exact for other in np.flatnonzero(counts)):
            _warn(
                settings.file,
                "free_thresh",
                f"all that is free has the value {grey}, which map servers write for 'unknown': look at the image",
            )
            continue
        # Rounded down, so that the number in the message really excludes the grey.
        at_most = math.floor(1000 * exact) / 1000
        _warn(
            settings.file,
            "free_thresh",
            f"{float(settings.free_thresh)} makes {counts[grey]} pixels of value {grey} free "
            f"({100 * counts[grey] / free.size:.1f} % of the image), though they probably mean 'unknown'; "
            f"if so, set free_thresh to {at_most} or less",
        )
