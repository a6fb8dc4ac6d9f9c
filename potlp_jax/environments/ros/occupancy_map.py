"""Reads occupancy maps in the format of ROS ``map_server`` (ROS 1) and ``nav2_map_server`` (ROS 2).

A map is a YAML file (`environments.ros.map_settings`) and an image. A pixel's *occupancy* is ``(255 - p) / 255``, where
``p`` is the mean of its channels on a scale to 255, or ``p / 255`` with ``negate: 1``. Then, by ``mode``:

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

The first row of the image is the top of the map.

References:
    ROS wiki, "map_server", and the sources of ``map_server/image_loader.cpp`` and ``nav2_map_server/map_io.cpp``.
"""

import math
import re
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Int8, Int64, Shaped

from potlp_jax import files, images
from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.map_settings import MapSettings, load_settings, warn_of_field
from potlp_jax.environments.ros.places import Places
from potlp_jax.environments.ros.working_grid import require_memory
from potlp_jax.errors import MapError

ROS_MAP = "ROS map"
"""The kind of a map that is an image with a YAML file."""

OCCUPIED = 100
FREE = 0
UNKNOWN = -1

SAVED_UNKNOWN = 205
"""Grey value by which the map savers of ROS 1 and ROS 2 mean "unknown"."""

PLATEAU_FRACTION = 0.05
PLATEAU_GREYS = 8
"""A grey that covers this fraction of an image, so much darker than another such grey, means something else than it."""


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
    places: Places | None = None

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
            warn_of_field(
                settings.file,
                "free_thresh",
                f"all that is free has the value {grey}, which map servers write for 'unknown': look at the image",
            )
            continue
        # Rounded down, so that the number in the message really excludes the grey.
        at_most = math.floor(1000 * exact) / 1000
        warn_of_field(
            settings.file,
            "free_thresh",
            f"{float(settings.free_thresh)} makes {counts[grey]} pixels of value {grey} free "
            f"({100 * counts[grey] / free.size:.1f} % of the image), though they probably mean 'unknown'; "
            f"if so, set free_thresh to {at_most} or less",
        )
