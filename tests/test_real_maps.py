"""Maps made by others: real buildings, their labels, and files that break loaders."""

import math
import warnings

import cv2
import jax
import numpy as np
import pytest
import yaml
from matplotlib.path import Path as Outline

from potlp_jax.environments.ros.cleaning import clean_map
from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.occupancy_map import load_map
from potlp_jax.environments.ros.places import Disc, Places
from potlp_jax.environments.ros.ros_map import RosMap, RosMapConfig
from potlp_jax.errors import MapError, MapWarning
from tests.reference.map_files import p5, png, write_map


def load_labels(folder, floor):
    doors = yaml.safe_load((folder / f"maps/labels/gdc_{floor}_doors.yaml").read_text())
    rooms = yaml.safe_load((folder / f"maps/labels/gdc_{floor}_locations.yaml").read_text())
    outlines = {
        name: Outline(np.reshape(polygon, (-1, 2)))
        for name, polygon in zip(rooms["locations"], rooms["polygons"], strict=True)
    }
    return [(approach["from"], approach["point"][:2]) for door in doors for approach in door["approach"]], outlines


FLOORS = [("gdc_floor2", "2", 22), ("gdc_3ne", "3ne", 48)]


@pytest.mark.parametrize(("name", "floor", "count"), FLOORS)
def test_both_sides_of_every_door_lie_in_their_rooms(external_data, name, floor, count):
    frame = load_map(external_data / f"maps/{name}.yaml").frame
    approaches, outlines = load_labels(external_data, floor)

    def hits(flip):
        cells = [(room, frame.metres_to_cell(*point)) for room, point in approaches]
        rows = [(room, frame.height - 1 - row if flip else row, col) for room, (row, col) in cells]
        return sum(bool(outlines[room].contains_point((col + 0.5, row + 0.5))) for room, row, col in rows)

    assert len(approaches) == count
    assert hits(flip=False) == count
    assert hits(flip=True) <= count // 4


@pytest.mark.parametrize(("name", "floor", "count"), FLOORS)
def test_every_door_of_a_mapped_room_stays_open_on_the_cleaned_map(external_data, name, floor, count):
    image_map = load_map(external_data / f"maps/{name}.yaml")
    clean = clean_map(image_map)
    approaches, outlines = load_labels(external_data, floor)
    closed = {room for room, point in approaches if not clean.free[clean.frame.metres_to_cell(*point)]}
    # The robot never entered these two rooms: their pixels are unknown.
    assert closed == ({"l3_402", "l3_404"} if floor == "3ne" else set())
    for room in closed:
        point = next(point for name, point in approaches if name == room)
        assert image_map.occupancy[image_map.frame.metres_to_cell(*point)] == -1
    mapped = {room for room, _ in approaches} - closed
    centres = [clean.frame.cell_to_metres(row, col) for row, col in np.argwhere(clean.free)[::5].tolist()]
    pixels = np.array([image_map.frame.metres_to_cell(*centre)[::-1] for centre in centres]) + 0.5
    assert all(outlines[room].contains_points(pixels).sum() > 4 for room in mapped)


@pytest.mark.parametrize(("name", "rooms", "reached"), [("kth_50052752", 22, 22), ("kth_50010535_PLAN1", 72, 71)])
def test_rooms_of_plans_stay_connected(external_data, name, rooms, reached):
    """Rooms above 4 m2, by the plan's labels; in the one that is lost the doorway is narrower than 0.6 m."""
    image_map = load_map(external_data / f"maps/{name}.yaml")
    labels = cv2.imread(str(external_data / f"maps/labels/{name}_rooms.png"), cv2.IMREAD_UNCHANGED)
    numbers, sizes = np.unique(labels[image_map.free], return_counts=True)
    large = set(numbers[sizes * 0.05**2 > 4].tolist())
    clean = clean_map(image_map)
    centres = [clean.frame.cell_to_metres(row, col) for row, col in np.argwhere(clean.free)[::5].tolist()]
    found = {int(labels[image_map.frame.metres_to_cell(*centre)]) for centre in centres}
    assert len(large) == rooms
    assert len(large & found) == reached


@pytest.mark.filterwarnings("ignore:.*cut off:potlp_jax.errors.MapWarning")
@pytest.mark.parametrize(
    ("name", "resolution", "radius", "shape"),
    [
        ("gdc_3ne", 0.4, 0.0, (55, 217)),
        ("gdc_floor2", 0.3, 0.1, (194, 256)),
        ("intel_lab", 0.25, 0.1, (228, 227)),
        ("uma_rooms", 0.2, 0.1, (67, 73)),
        ("sarmis_home", 0.1, 0.1, (120, 122)),
        ("levine_lobby", 0.2, 0.1, (163, 94)),
        ("kth_50052752", 0.2, 0.1, (62, 195)),
        ("kth_50010535_PLAN1", 0.4, 0.0, (75, 257)),
    ],
)
def test_real_maps_become_worlds(external_data, name, resolution, radius, shape):
    file = external_data / f"maps/{name}.yaml"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        walls = load_map(file)
    clean = clean_map(walls, resolution, radius)
    assert clean.free.shape == shape
    cells = np.argwhere(clean.free).tolist()
    first, last = (clean.frame.cell_to_metres(*cells[i]) for i in (0, -1))
    places = Places((("a", (Disc(first, 0.5),)), ("b", (Disc(last, 0.5),))))
    world = RosMap(RosMapConfig(file, places, resolution, radius)).generate(jax.random.key(0))
    assert np.array_equal(world.occupied, ~clean.free)
    assert set(np.unique(world.letters).tolist()) == {0, 1, 2}
    # No free cell lies on an obstacle pixel: the map's own walls are all there.
    centres = [walls.frame.cell_to_metres(row, col) for row, col in np.argwhere(walls.occupied)[::97].tolist()]
    there = [clean.frame.metres_to_cell(*centre) for centre in centres]
    assert not any(clean.free[cell] for cell in there if clean.frame.contains(*cell))


def test_quirk_ascii_image(external_data, tmp_path):
    image = external_data / "maps/quirks/columbia_P2_ascii.pgm"
    loaded = load_map(write_map(tmp_path, b"", image=image))
    assert loaded.free.shape == (350, 435)
    tokens = [line.split("#")[0] for line in image.read_text().splitlines()]
    values = np.array(" ".join(tokens[1:]).split()[3:], dtype=int).reshape(350, 435)
    assert np.array_equal(loaded.free, 1000 * (255 - values) < 196 * 255)
    assert np.array_equal(loaded.occupied, 100 * (255 - values) > 65 * 255)
    assert clean_map(loaded).free.sum() > 500


def test_quirk_no_pixel_dark_enough(external_data, tmp_path):
    image = external_data / "maps/quirks/intel_map_no_black.png"
    with pytest.raises(MapError, match=r"leaves no obstacle.*255 .*230 .*127 .occupancy 0.502"):
        load_map(write_map(tmp_path, b"", image=image, resolution=0.1))
    with pytest.warns(MapWarning, match=r"pixels of value 230 free .* set free_thresh to 0\.098 or less"):
        load_map(write_map(tmp_path, b"", image=image, resolution=0.1, occupied_thresh=0.4))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = load_map(write_map(tmp_path, b"", image=image, resolution=0.1, occupied_thresh=0.4, free_thresh=0.05))
    assert clean_map(loaded).free.sum() > 30000


def test_quirk_unknown_that_is_free(external_data):
    with pytest.warns(
        MapWarning, match=r"0.25 makes 83631 pixels of value 205 free .34.3 %.* set free_thresh to 0.196"
    ):
        loaded = load_map(external_data / "maps/quirks/pal_office_freethresh025.yaml")
    assert not (loaded.occupancy == -1).any()


def test_quirk_inline_comment(external_data, tmp_path):
    quirk = external_data / "maps/quirks/UMA_236_inline_comment.yaml"
    with pytest.raises(MapError, match=r"image: .*UMA_236\.pgm does not exist; put the image there"):
        load_map(quirk)
    (tmp_path / "copy.yaml").write_bytes(quirk.read_bytes())
    (tmp_path / "UMA_236.pgm").write_bytes(p5([[0, 254]]))
    assert load_map(tmp_path / "copy.yaml").frame == GridFrame(1, 2, 0.05, -8.325, -46.575, 0.0)


def test_quirk_absolute_path(external_data, tmp_path):
    quirk = external_data / "maps/quirks/movecare_map_absolute_path.yaml"
    with pytest.raises(
        MapError, match=r"image: /home/.*movecare_map\.pgm does not exist, nor does .*quirks/movecare_map"
    ):
        load_map(quirk)
    (tmp_path / "copy.yaml").write_bytes(quirk.read_bytes())
    (tmp_path / "movecare_map.pgm").write_bytes(p5([[0, 254]]))
    with pytest.warns(MapWarning, match="does not exist; using"):
        assert load_map(tmp_path / "copy.yaml").settings.image == tmp_path / "movecare_map.pgm"


def test_quirk_yaw(external_data, tmp_path):
    quirk = external_data / "maps/quirks/stata_yaw314.yaml"
    with pytest.raises(MapError, match=r"image: .*basement_fixed\.png does not exist"):
        load_map(quirk)
    (tmp_path / "copy.yaml").write_bytes(quirk.read_bytes())
    pixels = np.full((100, 200), 255, np.uint8)
    pixels[:50, 100:] = 0
    (tmp_path / "basement_fixed.png").write_bytes(png(pixels))
    loaded = load_map(tmp_path / "copy.yaml")
    clean = clean_map(loaded)
    # Turned by nearly half a turn, the map lies to the lower left of its origin, its dark top right corner farthest.
    lower_left, dark = (25.9 - 1, 48.5 - 1), (25.9 - 0.0504 * 150, 48.5 - 0.0504 * 75)
    assert clean.free[clean.frame.metres_to_cell(*lower_left)]
    assert loaded.occupied[loaded.frame.metres_to_cell(*dark)]
    assert not clean.free[clean.frame.metres_to_cell(*dark)]
    x, y = 0.0504 * 150, 0.0504 * 20
    there = 25.9 + math.cos(3.14) * x - math.sin(3.14) * y, 48.5 + math.sin(3.14) * x + math.cos(3.14) * y
    assert loaded.frame.metres_to_cell(*there) in {(79, 150), (80, 150), (79, 149), (80, 149)}
    assert clean.free[clean.frame.metres_to_cell(*there)]
