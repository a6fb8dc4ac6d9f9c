"""Maps for tests, as files and in memory."""

from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np

from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.map_settings import MapSettings
from potlp_jax.environments.ros.occupancy_map import OccupancyMap

FIELDS = {
    "image": "map.pgm",
    "resolution": "0.05",
    "origin": "[0, 0, 0]",
    "negate": "0",
    "occupied_thresh": "0.65",
    "free_thresh": "0.196",
}


def p5(pixels, white=255):
    body = np.asarray(pixels).astype(">u2" if white > 255 else np.uint8).tobytes()
    return f"P5\n# made by a test\n{len(pixels[0])} {len(pixels)}\n{white}\n".encode() + body


def p2(pixels, white=255):
    rows = "\n".join(" ".join(map(str, row)) for row in np.asarray(pixels).tolist())
    return f"P2\n# made by a test\n{len(pixels[0])} {len(pixels)} # width, height\n{white}\n{rows}".encode()


def png(pixels):
    return cv2.imencode(".png", np.asarray(pixels))[1].tobytes()


def write_map(folder, content, name="map", **fields):
    """Writes NAME.yaml and its image; a field of None is left out."""
    values = FIELDS | {"image": f"{name}.pgm"} | fields
    text = "".join(f"{key}: {value}\n" for key, value in values.items() if value is not None)
    (folder / f"{name}.yaml").write_text(text)
    (folder / f"{name}.pgm").write_bytes(content)
    return folder / f"{name}.yaml"


def occupancy_map(free, pixel="1", origin=(0.0, 0.0, 0.0)):
    """A map in memory: True is free, False an obstacle."""
    free = np.asarray(free, dtype=bool)
    resolution = Fraction(pixel)
    map_settings = MapSettings(
        Path("map.yaml"), Path("map.pgm"), resolution, origin, "trinary", False, Fraction(13, 20), Fraction(1, 5)
    )
    frame = GridFrame(*free.shape, float(resolution), *origin)
    return OccupancyMap(map_settings, np.where(free, 0, 100).astype(np.int8), free, ~free, frame)


def drawn(*rows):
    """'.' is free, '#' an obstacle."""
    return np.array([[cell == "." for cell in row] for row in rows])


TWO_ROOMS = drawn(
    "###########",
    "#....#....#",
    "#....#....#",
    "#.........#",
    "#....#....#",
    "###########",
)

PLACES = """propositions:
  document: [{point: [1.5, 1.5], radius: 0.5}]
  package: [{polygon: [[8, 1], [10, 1], [10, 3], [8, 3]]}, {point: [9.5, 4.5], radius: 0}]
tasks:
  "1": F document & F package
"""
