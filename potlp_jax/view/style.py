"""Colours, figures and files that all pictures share.

Colours are those of Okabe and Ito (2008) and Tol's light scheme, which remain distinct under the common colour
deficiencies. Figures are made without pyplot, so drawing keeps no global state and works in any thread.
"""

import dataclasses
import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import UInt8
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text

from potlp_jax.errors import PictureError

# States against areas: at least 19 apart in CIELAB in normal sight and in the simulated colour deficiencies of
# Machado et al. (2009), for lightness alone keeps them apart: 22 to 51 against 69 to 85. Neighbours in each list are
# farther apart than later ones, because most tasks have few states and propositions.
STATE_COLOURS: tuple[str, ...] = (
    "#0072B2",
    "#3C3C96",
    "#7A1F7A",
    "#00835F",
    "#008796",
    "#7A45D6",
    "#1F5C1F",
    "#3C69C8",
    "#5A1A5A",
    "#005A78",
)
"""Automaton states: dark and cool. They repeat after ten, where the numbers beside them tell states apart."""

AREA_COLOURS: tuple[str, ...] = (
    "#F0906A",
    "#EBD36A",
    "#FF9FB0",
    "#C8C850",
    "#F0C396",
    "#FFB3DC",
    "#D9B46C",
    "#FFC8B4",
)
"""Areas where a proposition holds: light and warm, so that none is taken for a state, in any kind of sight."""

INK = "#222222"
QUIET = "#6E6E6E"
"""Small print: axes, captions, explanations."""

FAINT = "#9A9A9A"
# Magenta stands out from cool states and warm areas alike; nothing else has it.
CHOSEN = "#E6007E"
CHOSEN_ROW = "#FCE1F0"
# Warm like areas, but only small marks have it, and they have a rim of ink.
ROBOT = "#FFD400"

# What was seen has the stronger contrast; a wall is darker than free space whether it was seen or not.
FREE_SEEN, WALL_SEEN = "#FFFFFF", "#4A4A4A"
FREE_UNSEEN, WALL_UNSEEN = "#E4E4E4", "#C6C6C6"
HATCH = "#B4B4B4"
# Bluish, so that nobody takes what is imagined for known; light for free and dark for obstacles, as everywhere.
IMAGINED_FREE, IMAGINED_WALL = "#DCE8F5", "#5C6F8C"

# Okabe and Ito's green and vermilion, which readers with a red-green deficiency tell apart.
RIGHT, WRONG = "#009E73", "#D55E00"
"""Predictions that came true, and those that did not."""

SERIES_COLOURS: tuple[str, ...] = ("#0072B2", "#D55E00", "#009E73", "#56B4E9", "#8C510A", "#F0C808")
"""Data that are neither states nor policies, and policies that the library does not ship."""

POLICY_COLOURS: Mapping[str, str] = MappingProxyType(
    {"known-map": INK, "baseline": "#747474", "optimistic": "#E69F00", "oracle": "#CC79A7", "potlp": "#D55E00"}
)
"""One colour a policy in every picture, page and table. The known map is drawn in ink, which follows the page."""

MARKERS = "osD^vP*X"
LINES = ("-", "--", "-.", ":")

# A map of the full 11 inches (maps.LONGEST) has about 1200 pixels: as wide as most pages show a picture.
DOTS_PER_INCH: int = 110


@dataclasses.dataclass(frozen=True)
class PolicyStyle:
    """Colour, marker and line of a policy: policies are told apart without colour too."""

    colour: str
    marker: str
    line: str


def policy_styles(policies: Iterable[str]) -> dict[str, PolicyStyle]:
    """The style of each policy.

    A shipped policy looks the same whatever it is compared with. Others take the remaining colours in the order in
    which they are given, the same colours in all pictures of one comparison.
    """
    shown = list(dict.fromkeys(policies))
    names = [*POLICY_COLOURS, *(policy for policy in shown if policy not in POLICY_COLOURS)]
    # A policy of one's own never looks like a shipped one.
    colours = list(dict.fromkeys([*POLICY_COLOURS.values(), *SERIES_COLOURS]))
    styles = {
        # There are ten colours; the eleventh policy has the first again, but neither its marker nor its line.
        name: PolicyStyle(colours[rank % len(colours)], MARKERS[rank % len(MARKERS)], LINES[rank % len(LINES)])
        for rank, name in enumerate(names)
    }
    return {policy: styles[policy] for policy in shown}


def state_colour(state: int) -> str:
    """The colour of an automaton state."""
    return STATE_COLOURS[state % len(STATE_COLOURS)]


def area_colour(proposition: int) -> str:
    """The colour of the areas of a proposition, by its position in the task's propositions."""
    return AREA_COLOURS[proposition % len(AREA_COLOURS)]


def rgb(colour: str) -> tuple[int, int, int]:
    """A colour as three bytes."""
    red, green, blue = to_rgb(colour)
    return round(red * 255), round(green * 255), round(blue * 255)


def faded(colours: UInt8[np.ndarray, "... 3"]) -> UInt8[np.ndarray, "... 3"]:
    """Colours of areas where they were not seen: still recognisable, so that one sees what the robot did not know."""
    return (0.55 * colours + 0.45 * np.array(rgb(FREE_UNSEEN))).astype(np.uint8)


def take_literally(artist: Artist) -> None:
    """Take the texts of a part of a figure as they are: names and formulas may hold ``$``, which begins mathematics."""
    for text in artist.findobj(Text):
        assert isinstance(text, Text)
        text.set_parse_math(False)


class _LiteralFigure(Figure):
    """A figure without mathematics in its texts, however it is drawn."""

    # Renderers have no base in common: that of SVG and PDF is none of matplotlib's `RendererBase`.
    def draw(self, renderer: Any) -> None:
        take_literally(self)
        super().draw(renderer)


def new_figure(width: float, height: float) -> Figure:
    """An empty white figure of the given size in inches, drawn by Agg."""
    figure = _LiteralFigure(figsize=(width, height), dpi=DOTS_PER_INCH, facecolor="white")
    # The canvas registers itself with the figure; without one matplotlib would import pyplot's.
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure in the format of the file's ending.

    Args:
        figure: any figure of ``new_figure``.
        path: where to write; ``.png``, ``.svg`` or ``.pdf``. In SVG text stays text.

    Raises:
        PictureError: the ending names no known format.
    """
    suffix = path.suffix.removeprefix(".").lower()
    if suffix not in figure.canvas.get_supported_filetypes():
        raise PictureError(f"{path}: cannot write a picture of type {suffix!r}; use .svg, .png or .pdf")
    path.write_bytes(figure_bytes(figure, suffix))


def figure_bytes(figure: Figure, suffix: str) -> bytes:
    """A figure as the content of a file of the given type; equal figures give equal bytes."""
    # Dates and random identifiers would make equal pictures differ from run to run.
    date = {"svg": "Date", "pdf": "CreationDate"}.get(suffix)
    buffer = io.BytesIO()
    # Text that stays text is searched, copied and set in the page's font; outlines are not.
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "potlp"}):
        figure.savefig(buffer, format=suffix, metadata=None if date is None else {date: None})
    return buffer.getvalue()
