"""Writes occupancy maps in the format that `potlp_jax.environments.ros.occupancy_map` reads."""

import json
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.map_settings import DEFAULT_FREE_THRESH, DEFAULT_OCCUPIED_THRESH
from potlp_jax.errors import MapError
from potlp_jax.files import whole_file, write_whole

FREE_GREY = 254
OCCUPIED_GREY = 0
"""The greys of the map savers of ROS 1 and ROS 2."""


def save_map(file: Path, free: Bool[np.ndarray, "H W"], frame: GridFrame) -> Path:
    """Write a trinary map: a YAML file, and its image beside it.

    Args:
        file: the YAML's name, ending in .yaml; the image's ends in .pgm.
        free: True on free cells; all others become obstacles.
        frame: where the grid lies; reading the file gives the same frame.

    Returns:
        The image's path.

    Raises:
        MapError: the name does not end in .yaml.
        OSError: a file cannot be written.
    """
    if file.suffix != ".yaml":
        raise MapError(file, "", "a map's name must end in .yaml")
    # Binary PGM needs no library and has no compression to get wrong.
    image = file.with_suffix(".pgm")
    pixels = np.where(free, FREE_GREY, OCCUPIED_GREY).astype(np.uint8)
    with whole_file(image) as pgm:
        pgm.write(f"P5\n{frame.width} {frame.height}\n255\n".encode() + pixels.tobytes())
    # Quoted, for names may hold what YAML reads as a comment, a key or a list. A text of JSON is one of YAML too, but
    # for characters that are escaped in halves.
    name = json.dumps(image.name, ensure_ascii=False)
    # ``!r`` is the shortest text that reads back as the same float.
    write_whole(
        file,
        f"image: {name}\n"
        "mode: trinary\n"
        f"resolution: {frame.resolution!r}\n"
        f"origin: [{frame.x!r}, {frame.y!r}, {frame.yaw!r}]\n"
        "negate: 0\n"
        f"occupied_thresh: {DEFAULT_OCCUPIED_THRESH}\n"
        f"free_thresh: {DEFAULT_FREE_THRESH}\n",
    )
    return image
