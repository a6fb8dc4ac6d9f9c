"""What a floor is like in figures, whether it was generated or read from a plan: sizes, rooms, hallways, loops.

Hallways of a plan are several spaces, those of a generated floor one: both are taken together where they touch.
"""

import dataclasses

import networkx as nx
import numpy as np
from jaxtyping import Bool, Int32
from scipy import ndimage

from potlp_jax.environments.campus.furnishing import NO_ROOM, Floor, Kind

_LEAST_LOOP = 9.0
"""Square metres inside of a hallway's loop; less is furniture or a pillar."""
_END_WIDTHS = (1.0, 4.0)
"""Metres: how wide a hallway's end is; what is wider is a hall."""


@dataclasses.dataclass(frozen=True)
class FloorShape:
    """Figures of one floor, in metres.

    Attributes:
        long_side, short_side: of the rectangle around its free cells.
        area: of the free cells.
        free: their share of the rectangle.
        rooms: how many, hallways left out.
        room_areas: of each room.
        hallway_share: of hallways in the free area.
        longest_hallway: the longest straight line through hallways along rows or columns.
        hallway_width: the median over hallways' cells of the shorter line through them.
        doors: from each room that can be entered to others, and to hallways.
        room_loops: rank of the cycles of the graph of rooms and hallways.
        hallway_loops: pieces of the building that hallways go all the way around.
        dead_ends: ends of hallways.
    """

    long_side: float
    short_side: float
    area: float
    free: float
    rooms: int
    room_areas: tuple[float, ...]
    hallway_share: float
    longest_hallway: float
    hallway_width: float
    doors: tuple[int, ...]
    room_loops: int
    hallway_loops: int
    dead_ends: int

    @property
    def middle_room(self) -> float:
        """The median area of a room."""
        return float(np.median(self.room_areas))

    @property
    def doors_per_room(self) -> float:
        """The mean over rooms."""
        return float(np.mean(self.doors))


def shape_of(floor: Floor) -> FloorShape:
    """The figures of a floor that has rooms and hallways."""
    side, hallway = floor.resolution, floor.kind_of_cell == Kind.HALLWAY
    rows, columns = np.nonzero(~floor.occupied)
    short, long = sorted((int(np.ptp(rows) + 1) * side, int(np.ptp(columns) + 1) * side))
    cells = np.bincount(floor.rooms[~floor.occupied], minlength=len(floor.kinds))
    areas = [float(count) * side**2 for count, kind in zip(cells, floor.kinds, strict=True) if kind != Kind.HALLWAY]
    along, across = _line_lengths(hallway), _line_lengths(hallway.T).T
    graph, hallways = _graph_of_rooms(floor, hallway)
    return FloorShape(
        long_side=long,
        short_side=short,
        area=len(rows) * side**2,
        free=len(rows) * side**2 / (short * long),
        rooms=len(areas),
        room_areas=tuple(areas),
        hallway_share=float(np.count_nonzero(hallway) / len(rows)),
        longest_hallway=float(max(along.max(), across.max())) * side,
        hallway_width=float(np.median(np.minimum(along, across)[hallway])) * side,
        doors=tuple(int(doors) for space, doors in graph.degree(weight="doors") if space >= hallways),
        room_loops=graph.number_of_edges() - len(graph) + nx.number_connected_components(graph),
        hallway_loops=_loops(hallway, side),
        dead_ends=dead_ends(hallway, side),
    )


def _graph_of_rooms(floor: Floor, hallway: Bool[np.ndarray, "H W"]) -> tuple[nx.Graph, int]:
    """Rooms and connected hallways, joined where one can pass, with the number of doors; and how many hallways."""
    pieces, hallways = _label(hallway)
    # Hallways come first, then rooms.
    spaces = np.where(hallway, pieces - 1, np.where(floor.occupied, NO_ROOM, floor.rooms + hallways))
    graph = nx.Graph()
    for first, second in ((spaces[:-1], spaces[1:]), (spaces.T[:-1], spaces.T[1:])):
        meets = (first != second) & (first != NO_ROOM) & (second != NO_ROOM)
        pairs = np.sort(np.stack([first[meets], second[meets]], axis=1), axis=1)
        for one, other in np.unique(pairs, axis=0).tolist():
            here = meets & (np.minimum(first, second) == one) & (np.maximum(first, second) == other)
            known = graph.get_edge_data(one, other, {"doors": 0})["doors"]
            graph.add_edge(one, other, doors=known + _label(here, corners=True)[1])
    return graph, hallways


def _label(cells: Bool[np.ndarray, "H W"], *, corners: bool = False) -> tuple[Int32[np.ndarray, "H W"], int]:
    """Connected pieces, numbered from 1, and how many; cells that touch at corners are connected if ``corners``."""
    pieces = np.zeros(cells.shape, np.int32)
    count = ndimage.label(cells, np.ones((3, 3)) if corners else None, pieces)
    return pieces, int(count)  # pyright: ignore[reportArgumentType]


def _line_lengths(cells: Bool[np.ndarray, "H W"]) -> Int32[np.ndarray, "H W"]:
    """The length of the unbroken line of such cells through each, along its row; 0 elsewhere."""
    lengths = np.zeros(cells.shape, np.int32)
    for row, line in enumerate(cells):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(np.int8), [0]])))
        for first, last in zip(edges[::2], edges[1::2], strict=True):
            lengths[row, first:last] = last - first
    return lengths


def _loops(hallway: Bool[np.ndarray, "H W"], side: float) -> int:
    pieces, count = _label(np.pad(~hallway, 1, constant_values=True), corners=True)
    # What lies around the building is a piece, too.
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)[1:] * side**2
    outside = pieces[0, 0] - 1
    return int(np.count_nonzero(np.delete(sizes, outside) >= _LEAST_LOOP))


def dead_ends(hallway: Bool[np.ndarray, "H W"], side: float) -> int:
    """Ends of hallways: lines of hallway cells with walls in front and on both sides, a metre deep.

    Args:
        hallway: the cells of hallways.
        side: of a cell, in metres.

    Returns:
        How many there are, in all four directions.
    """
    least, most, deep = (max(1, round(length / side)) for length in (*_END_WIDTHS, 1.0))
    ends = 0
    for turned in range(4):
        cells = np.pad(np.rot90(hallway, turned), deep + 1)
        for row in range(deep + 1, len(cells) - deep):
            edges = np.flatnonzero(np.diff(cells[row].astype(np.int8)))
            for before, last in zip(edges[::2], edges[1::2], strict=True):
                inside, walls = slice(before + 1, last + 1), [before, last + 1]
                stretch = slice(row, row + deep)
                ends += int(
                    least <= last - before <= most
                    and not cells[row - 1, inside].any()
                    and cells[stretch, inside].all()
                    and not cells[stretch, walls].any()
                )
    return ends
