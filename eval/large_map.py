"""A ROS map of 4,000 x 4,000 pixels, as mapping writes one: 200 x 200 m of 400 rooms with doors between them."""

from pathlib import Path

import numpy as np

PIXELS, ROOM, WALL, DOOR = 4000, 200, 3, 32
"""Pixels of 0.05 m: of the map's side, a room's, half a wall's thickness, and a door's width."""

_SETTINGS = """image: large.pgm
resolution: 0.05
origin: [0.0, 0.0, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""


def write_large_map(folder: Path, pixels: int = PIXELS) -> Path:
    """Write the map's image and its settings.

    Three of four walls between two rooms have a door. A room may be shut, as some are on maps of robots.

    Args:
        folder: that is there.
        pixels: of a side.

    Returns:
        The file of the settings.
    """
    rng, free = np.random.default_rng(0), np.ones((pixels, pixels), bool)
    for wall in range(0, pixels + 1, ROOM):
        free[max(wall - WALL, 0) : wall + WALL] = False
        free[:, max(wall - WALL, 0) : wall + WALL] = False
    for top in range(0, pixels, ROOM):
        for left in range(0, pixels, ROOM):
            to_the_right, downwards = rng.random(2) < 0.75
            down, across = rng.integers(20, ROOM - 60, 2)
            if to_the_right and left + ROOM < pixels:
                free[top + down : top + down + DOOR, left + ROOM - WALL : left + ROOM + WALL] = True
            if downwards and top + ROOM < pixels:
                free[top + ROOM - WALL : top + ROOM + WALL, left + across : left + across + DOOR] = True
    image = np.where(free, 254, 0).astype(np.uint8)
    (folder / "large.pgm").write_bytes(b"P5\n%d %d\n255\n" % image.shape[::-1] + image.tobytes())
    (folder / "large.yaml").write_text(_SETTINGS, "utf-8")
    return folder / "large.yaml"
