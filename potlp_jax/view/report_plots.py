"""The pictures of a report, as SVG that takes its text and line colours from the page, light or dark."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from potlp_jax.sweep.results import Pair, charged_cost
from potlp_jax.sweep.statistics import BASELINE
from potlp_jax.view.comparisons import scatter_costs
from potlp_jax.view.style import FAINT, INK, figure_bytes, new_figure, policy_styles


def scatter(pairs: Sequence[Pair], policies: Sequence[str]) -> str:
    """Each policy's cost over the baseline's, world by world (`scatter_costs`)."""
    figure, axes = _axes(5.2, 4.6)
    scatter_costs(axes, pairs, policies)
    return _svg(figure)


def cumulative(pairs: Sequence[Pair], policies: Sequence[str]) -> str:
    """Costs summed over the worlds, in the order of their numbers; unsatisfied trials are charged their budget."""
    figure, axes = _axes(5.2, 4.6)
    for policy, style in policy_styles(policies).items():
        total = np.cumsum([charged_cost(pair[policy]) for pair in pairs])
        axes.plot(np.arange(1, len(pairs) + 1), total, style.line, color=style.colour, linewidth=1.6, label=policy)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(xlim=(0, max(len(pairs), 1)), xlabel="worlds", ylabel="cost of all of them")
    # From 0: only then are lengths in the plot in proportion to costs.
    axes.set_ylim(bottom=0)
    _legend(axes)
    return _svg(figure)


def savings_by_world(pairs: Sequence[Pair], policies: Sequence[str]) -> str:
    """What each policy saves against the baseline, worlds in order of it: few large savings, or many small ones.

    Unsatisfied trials are charged their budget.
    """
    figure, axes = _axes(5.2, 4.6)
    axes.axhline(0.0, color=FAINT, linewidth=1.0)
    # Each world in the middle of its share of the axis.
    share = 100 * (np.arange(len(pairs)) + 0.5) / max(len(pairs), 1)
    for policy, style in policy_styles(policies).items():
        # Against itself the baseline saves nothing: it is the line at 0.
        if policy == BASELINE:
            continue
        # Sorted by policy: a curve shows a distribution, points of one column belong to different worlds.
        saved = np.sort([charged_cost(pair[BASELINE]) - charged_cost(pair[policy]) for pair in pairs])[::-1]
        axes.plot(share, saved, style.line, color=style.colour, linewidth=1.6, label=policy)
    axes.set(xlim=(0, 100), xlabel="worlds (%), most saved first", ylabel="saved against the baseline")
    _legend(axes)
    return _svg(figure)


def _axes(width: float, height: float) -> tuple[Figure, Axes]:
    # Made for three beside each other on a wide page (``.plots`` in report.css).
    figure = new_figure(width, height)
    axes = figure.add_axes((0.14, 0.11, 0.83, 0.86))
    axes.grid(color=FAINT, linewidth=0.3)
    axes.set_axisbelow(True)
    return figure, axes


def _legend(axes: Axes) -> None:
    axes.legend(fontsize=8.5, frameon=False)


def _svg(figure: Figure) -> str:
    """The picture as an element of a page; its ink and grey become those of the page, its paper transparent."""
    figure.patch.set_alpha(0.0)
    for axes in figure.axes:
        axes.patch.set_alpha(0.0)
    _recolour(figure)
    # Text stays text and follows the page's font.
    text = figure_bytes(figure, "svg").decode()
    text = text[text.index("<svg") :]
    # matplotlib writes colours in small letters; INK has none. The variable is that of the page's style sheet.
    return text.replace(INK, "currentColor").replace(FAINT.lower(), "var(--faint)")


def _recolour(figure: Figure) -> None:
    """Everything that is written in ink."""
    for axes in figure.axes:
        axes.tick_params(colors=INK, labelsize=8.5)
        legend = axes.get_legend()
        for item in (axes.xaxis.label, axes.yaxis.label, *(() if legend is None else legend.get_texts())):
            item.set_color(INK)
        for spine in axes.spines.values():
            spine.set_edgecolor(INK)
