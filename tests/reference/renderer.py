"""A slow, obvious ray caster: one sight line at a time, cell by cell, in double precision."""

import itertools
import math

import numpy as np

from potlp_jax.world.camera import CameraConfig
from potlp_jax.world.grid import World

BRICK, MORTAR = 0.5, 0.05
TILE_EDGE, SAMPLES = 0.06, 6
SKIRTING, SKIRTING_SHADE = 0.2, 0.7
GRAZED = 0.7


def bearing_of(column: float, config: CameraConfig) -> float:
    """The bearing along which (the middle of) a column looks."""
    return 2 * math.pi * (column + 0.5) / config.width - math.pi


def slope_of(row: float, config: CameraConfig) -> float:
    """The tangent of the elevation along which (the middle of) a row looks."""
    return -config.eye_height / config.far * math.sinh((row + 0.5 - config.horizon) / config.fold)


def render(world: World, cell: tuple[int, int], config: CameraConfig) -> np.ndarray:
    """The panorama, uint8[rows, columns, 3]."""
    picture = np.zeros((config.height, config.width, 3), np.uint8)
    scene = Scene(world, cell, config)
    for row in range(config.height):
        for column in range(config.width):
            tiles = tile_share(row, column, config)
            picture[row, column] = scene.look(bearing_of(column, config), slope_of(row, config), tiles)
    return picture


def render_equirectangular(
    world: World, cell: tuple[int, int], config: CameraConfig, shape: tuple[int, int], field: float
) -> np.ndarray:
    """What an equirectangular camera of ``field`` radians from bottom to top sees; without textures on the floor."""
    height, width = shape
    picture = np.zeros((height, width, 3), np.uint8)
    scene = Scene(world, cell, config)
    for row in range(height):
        slope = math.tan((0.5 - (row + 0.5) / height) * field)
        for column in range(width):
            picture[row, column] = scene.look(2 * math.pi * (column + 0.5) / width - math.pi, slope, 0.0)
    return picture


class Scene:
    """A world seen from the middle of a cell."""

    def __init__(self, world: World, cell: tuple[int, int], config: CameraConfig) -> None:
        self.config = config
        self.cell = cell
        self.occupied = np.asarray(world.occupied)
        self.floor = np.asarray(world.appearance.floor_colour, float)
        self.wall = np.asarray(world.appearance.wall_colour, float)
        self.smoke = np.asarray(world.appearance.smoke, float)
        self.light = config.ambient + (1 - config.ambient) * np.asarray(world.appearance.light, float)

    def look(self, bearing: float, slope: float, tiles: float) -> tuple[int, int, int]:
        """The colour seen along a sight line; ``tiles`` is the share of floor or ceiling that is edges of tiles."""
        config = self.config
        gap = config.eye_height if slope < 0 else config.wall_height - config.eye_height
        end = gap / abs(slope) if slope else math.inf
        transmission, glow, cell_before, surface = 1.0, 0.0, self.cell, np.zeros(3)
        for enter, leave, cell in self.walk(bearing):
            if self.occupied[cell]:
                light = self.light[cell_before]
                surface = self.wall[cell] * light * self.wall_shade(bearing, slope, enter)
                break
            passed = math.exp(-self.smoke[cell] * (min(leave, end) - enter))
            glow += transmission * (1 - passed) * self.light[cell]
            transmission *= passed
            if end < leave:
                colour = self.floor[cell] if slope < 0 else np.array(config.ceiling_colour)
                surface = colour * self.light[cell] * (1 - config.texture * tiles)
                break
            cell_before = cell
        seen = surface * transmission + glow * np.array(config.smoke_colour)
        red, green, blue = (int(min(value, 255) + 0.5) for value in seen)
        return red, green, blue

    def walk(self, bearing: float):
        """The cells along a bearing: distance of entering and leaving, and the cell. Ends at the first obstacle."""
        down, right = math.sin(bearing), math.cos(bearing)
        rows, columns = self.occupied.shape
        lines = [(k + 0.5) / abs(down) for k in range(rows)] + [(k + 0.5) / abs(right) for k in range(columns)]
        crossings = [0.0, *sorted(lines)]
        for enter, leave in itertools.pairwise(crossings):
            middle = (enter + leave) / 2
            cell = (round(self.cell[0] + middle * down), round(self.cell[1] + middle * right))
            yield enter, leave, cell
            if self.occupied[cell]:
                return

    def wall_shade(self, bearing: float, slope: float, distance: float) -> float:
        """The angle at which a wall is met, its bricks and its skirting."""
        config = self.config
        down, right = distance * math.sin(bearing), distance * math.cos(bearing)
        # Half-way between two rows (or columns) of cells is where a side lies.
        by_row = abs(abs(down) % 1 - 0.5) < abs(abs(right) % 1 - 0.5)
        facing = abs(math.sin(bearing)) if by_row else abs(math.cos(bearing))
        along = ((right if by_row else down) + 0.5) % 1
        height = config.eye_height + distance * slope
        course = height / BRICK + 0.5
        brick = along / BRICK + (0.5 if math.floor(course) % 2 else 0.0)
        joint = max(abs(course % 1 - 0.5), abs(brick % 1 - 0.5)) > 0.5 - MORTAR / BRICK
        contrast = config.texture / (1 + (distance / config.texture_reach) ** 2)
        shade = GRAZED + (1 - GRAZED) * facing
        return shade * (1 - contrast if joint else 1) * (SKIRTING_SHADE if height < SKIRTING else 1)


def tile_share(row: int, column: int, config: CameraConfig) -> float:
    """The share of a pixel that shows edges of tiles, were there no walls, from samples spread over the pixel."""
    edges = 0
    for i in range(SAMPLES):
        for j in range(SAMPLES):
            slope = slope_of(row + (i + 0.5) / SAMPLES - 0.5, config)
            bearing = bearing_of(column + (j + 0.5) / SAMPLES - 0.5, config)
            gap = config.eye_height if slope < 0 else config.wall_height - config.eye_height
            distance = gap / abs(slope)
            parts = (distance * math.sin(bearing), distance * math.cos(bearing))
            edges += any(abs((part + 0.5) % 1 - 0.5) > 0.5 - TILE_EDGE for part in parts)
    return edges / SAMPLES**2


def cells_seen(world: World, cell: tuple[int, int], config: CameraConfig) -> np.ndarray:
    """True on the cells that the ray of some column enters, the obstacle that ends it included."""
    scene = Scene(world, cell, config)
    seen = np.zeros(scene.occupied.shape, bool)
    for column in range(config.width):
        for _, _, entered in scene.walk(bearing_of(column, config)):
            seen[entered] = True
    return seen
