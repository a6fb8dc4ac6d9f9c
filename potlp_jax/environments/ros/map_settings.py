"""Reads and checks the YAML file of an occupancy map, without its image, which `environments.ros.occupancy_map` reads.

    image: map.pgm              # beside this file, or an absolute path
    resolution: 0.05            # metres a pixel
    origin: [-9.0, -7.0, 0.0]   # x, y and yaw, in metres and radians
    mode: trinary               # or scale, or raw; trinary where it is missing
    negate: 0                   # 1: light pixels are obstacles; 0 where it is missing
    occupied_thresh: 0.65
    free_thresh: 0.196

``origin`` is the pose (x, y, yaw) of the lower left corner of the lower left pixel; a yaw turns the whole image about
that corner. Numbers are kept as the fractions of their decimal text, so that comparisons with them are exact.

References:
    ROS wiki, "map_server", and the source of ``nav2_map_server/map_io.cpp``.
"""

import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import yaml

from potlp_jax import files
from potlp_jax.errors import MapError, MapWarning
from potlp_jax.files import short

MODES = ("trinary", "scale", "raw")

DEFAULT_OCCUPIED_THRESH = "0.65"
DEFAULT_FREE_THRESH = "0.196"
"""ROS 1's value: under nav2's 0.25 the grey by which map savers mean "unknown" would be free."""

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


def load_settings(file: Path | str) -> MapSettings:
    """Read and check a map's YAML.

    Raises:
        MapError: the file or the image that it names is missing, or a field is missing or makes no sense.

    Warns:
        MapWarning: an unknown key, a default in the place of a missing threshold, and an image found elsewhere than the
            YAML says.
    """
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
        warn_of_field(
            file, ", ".join(unknown), "unknown, ignored; known are " + ", ".join((*_REQUIRED_KEYS, *_OPTIONAL_KEYS))
        )


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
        warn_of_field(file, "image", f"{image} does not exist; using {sibling}")
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
        warn_of_field(file, field, f"is missing; using {default}")
    value = parse_number(file, field, fields.get(field, default))
    if not 0 <= value <= 1:
        raise MapError(file, field, f"{float(value)} must lie between 0 and 1")
    return value


def warn_of_field(file: Path, field: str, message: str) -> None:
    """Warn of a map's field (MapWarning), in the name of the caller."""
    warnings.warn(f"{file}: {field}: {message}", MapWarning, stacklevel=2)
