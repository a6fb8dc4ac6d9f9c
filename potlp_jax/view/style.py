"""Colours, figures and files that all pictures share.

Colours are those of Okabe and Ito (2008) and Tol's light scheme, which remain distinct under the common colour
deficiencies. Figures are made without pyplot, so drawing keeps no global state and works in any thread.
"""

import io
from pathlib import Path

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from potlp_jax.errors import PictureError

STATE_COLOURS: tuple[str, ...] = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#8C510A",
    "#56B4E9",
    "#6A3D9A",
    "#B79F00",
    "#882255",
    "#332288",
    "#E69F00",
    "#117733",
)
"""Strong colours: automaton states (repeating after twelve, where the numbers beside them tell states apart)."""

AREA_COLOURS: tuple[str, ...] = (
    "#EE8866",
    "#EEDD88",
    "#99DDFF",
    "#44BB99",
    "#FFAABB",
    "#BBCC33",
    "#77AADD",
    "#AAAA00",
)
"""Light colours: areas where a proposition holds."""

INK = "#222222"
FAINT = "#9A9A9A"
CHOSEN = "#E6007E"
CHOSEN_ROW = "#FCE1F0"
ROBOT = "#FFD400"

DOTS_PER_INCH: int = 110


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


def new_figure(width: float, height: float) -> Figure:
    """An empty white figure of the given size in inches, drawn by Agg."""
    figure = Figure(figsize=(width, height), dpi=DOTS_PER_INCH, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure in the format of the file's ending (png, svg, pdf); text stays text in SVG.

    Raises PictureError where the ending names no known format.
    """
    suffix = path.suffix.removeprefix(".").lower()
    if suffix not in figure.canvas.get_supported_filetypes():
        raise PictureError(f"{path}: cannot write a picture of type {suffix!r}; use .svg, .png or .pdf")
    metadata = {"Date": None} if suffix == "svg" else None
    buffer = io.BytesIO()
    # Identifiers and dates would make equal pictures differ from run to run.
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "potlp"}):
        figure.savefig(buffer, format=suffix, metadata=metadata)
    path.write_bytes(buffer.getvalue())
