"""A comparison of policies as tables and as a picture."""

import math
import textwrap
from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.box import SIMPLE_HEAD
from rich.table import Table as RichTable
from rich.text import Text

from potlp_jax.sweep.results import Pair, reliable_pairs
from potlp_jax.sweep.statistics import BASELINE, KNOWN_MAP, SATISFIED, UNRELIABLE, Comparison, PolicyRow
from potlp_jax.types import status_of
from potlp_jax.view.style import FAINT, INK, PolicyStyle, new_figure, policy_styles

FEW_WORLDS: int = 30
"""Below so many worlds a comparison is shown with a warning: percentile intervals of few pairs are too narrow."""


def comparison_table(comparison: Comparison) -> RichTable:
    """All that a comparison says of each policy, in one table.

    Costs and savings are those of the worlds in which every policy satisfied the task. Where that leaves worlds out,
    a last column has the share of attainable savings over all worlds, with unsatisfied trials charged their budget.
    Worlds with an unreliable trial (``UNRELIABLE``) are in neither.
    """
    satisfied, charged = comparison.satisfied, comparison.charged
    # Where the known map costs as much as the baseline, the share of attainable savings is 0 / 0.
    nothing = any(math.isnan(row.attainable_share) for row in satisfied.rows)
    shown = RichTable(
        box=SIMPLE_HEAD,
        pad_edge=False,
        caption="-: the baseline leaves nothing to attain" if nothing and satisfied.pairs else None,
        caption_justify="left",
    )
    shown.add_column("policy", no_wrap=True)
    names = [
        "task\nsatisfied",
        "mean\ncost",
        "attainable\nsavings",
        "95%\ninterval",
        "net\nsavings",
        "savings\nper trial",
    ]
    if satisfied.dropped:
        names.append("attainable,\nall worlds")
    for name in names:
        shown.add_column(name, justify="right", no_wrap=True)
    styles = policy_styles(row.policy for row in satisfied.rows)
    for row, of_all in zip(satisfied.rows, charged.rows, strict=True):
        ended = comparison.outcomes[row.policy].get(SATISFIED, 0)
        last = (percent(of_all.attainable_share),) if satisfied.dropped else ()
        shown.add_row(_policy_name(row.policy, styles), f"{ended} of {comparison.worlds}", *_cells(row), *last)
    return shown


def _policy_name(policy: str, styles: Mapping[str, PolicyStyle]) -> Text:
    """In the colour that the policy has in pictures; ink is whatever the terminal writes in."""
    colour = styles[policy].colour
    return Text(policy, style="" if colour == INK else colour)


def _cells(row: PolicyRow) -> tuple[str, ...]:
    low, high = (percent(share, unit="") for share in (row.attainable_low, row.attainable_high))
    # A single world has no standard error.
    error = "" if math.isnan(row.trial_savings_error) else f" ± {100 * row.trial_savings_error:.1f}%"
    return (
        "-" if math.isnan(row.mean_cost) else f"{row.mean_cost:.1f}",
        percent(row.attainable_share),
        "-" if math.isnan(row.attainable_low) else f"{low} .. {high}%",
        percent(row.net_savings),
        percent(row.trial_savings, unit="" if error else "%") + error,
    )


def percent(share: float, unit: str = "%") -> str:
    """A share with one digit, "-" where it is NaN."""
    # Adding zero turns a rounded -0.0 into 0.0.
    return "-" if math.isnan(share) else f"{round(100 * share, 1) + 0.0:.1f}{unit}"


def remark_lines(comparison: Comparison) -> list[str]:
    """What qualifies the table: worlds left out, how other trials ended, arrays that were full, and too few worlds."""
    satisfied = comparison.satisfied
    lines = []
    if satisfied.dropped:
        lines.append(
            f"Costs and savings are of the {satisfied.pairs} worlds in which every policy satisfied the task "
            f"({satisfied.dropped} left out); 'all worlds' charges an unsatisfied trial its budget."
        )
    lines += unreliable_lines(comparison)
    for policy, counts in comparison.outcomes.items():
        # Trials that ended satisfied have a column of the table.
        others = [f"{count} {name}" for name, count in counts.items() if name != SATISFIED]
        if others:
            lines.append(f"{policy}: {', '.join(others)}")
    lines += flag_lines(comparison)
    if 0 < satisfied.pairs < FEW_WORLDS:
        known = any(not math.isnan(row.attainable_low) for row in satisfied.rows)
        # In draws of the same world again and again nothing may be left to save.
        told = "the interval says how far the share may be off" if known else "they tell no interval"
        lines.append(f"{satisfied.pairs} worlds are few: {told}.")
    return lines


def unreliable_lines(comparison: Comparison) -> list[str]:
    """One line if worlds were left out of every table, because a trial there is flagged with an ``UNRELIABLE`` bit."""
    dropped = comparison.charged.dropped
    return [f"Worlds with a trial that counts in no mean, left out of all tables: {dropped}."] if dropped else []


def flag_lines(comparison: Comparison) -> list[str]:
    """One line per policy whose trials have status bits, and whether they count in costs and savings."""
    return [
        f"{policy}: trials with " + ", ".join(_flag_words(name, count) for name, count in counts.items())
        for policy, counts in comparison.flagged.items()
        if counts
    ]


def _flag_words(name: str, count: int) -> str:
    left_out = " (left out of costs and savings)" if status_of([name]) & UNRELIABLE else ""
    return f"{name.replace('_', ' ')}: {count}{left_out}"


def draw_scatter(pairs: Sequence[Pair], policies: Sequence[str], title: str) -> Figure:
    """The picture of ``scatter_costs`` with a title, of the pairs that count in means.

    Args:
        pairs: rows of all policies, by world.
        policies: in the order of the legend; ``baseline`` is the horizontal axis.
        title: stands above, broken into lines.

    Returns:
        The figure.
    """
    figure = new_figure(6.4, 6.9)
    scatter_costs(figure.add_axes((0.12, 0.1, 0.84, 0.78)), reliable_pairs(pairs), policies)
    figure.text(0.5, 0.975, textwrap.fill(title, 88), ha="center", va="top", size=8.5, color=INK)
    return figure


def scatter_costs(axes: Axes, pairs: Sequence[Pair], policies: Sequence[str]) -> None:
    """Each policy's cost over the baseline's, world by world, as in the paper; below the diagonal is cheaper.

    Trials that did not end satisfied, or whose baseline did not, are crosses.

    Args:
        axes: where to draw; limits and labels are set.
        pairs: rows of all policies, by world.
        policies: in the order of the legend; ``baseline`` is the horizontal axis.
    """
    # Both axes alike, from 0: distances from the diagonal are savings.
    limit = 1.05 * max((row.cost for pair in pairs for row in pair.values()), default=1.0) or 1.0
    axes.set(xlim=(0, limit), ylim=(0, limit), aspect="equal")
    axes.set(xlabel="cost of the baseline", ylabel="cost of the policy")
    axes.grid(color=FAINT, linewidth=0.3)
    axes.set_axisbelow(True)
    _mark_diagonal(axes, limit)
    unsatisfied = False
    for policy, style in policy_styles(policies).items():
        if policy == BASELINE:
            continue
        good = [pair for pair in pairs if pair[policy].outcome == pair[BASELINE].outcome == SATISFIED]
        bad = [pair for pair in pairs if not pair[policy].outcome == pair[BASELINE].outcome == SATISFIED]
        axes.scatter(
            [pair[BASELINE].cost for pair in good],
            [pair[policy].cost for pair in good],
            # The bound lies below everything and should not hide it.
            s=12 if policy == KNOWN_MAP else 26,
            marker=style.marker,
            color=style.colour,
            # Worlds may lie on each other, above all on the diagonal, where a policy does as the baseline does.
            alpha=0.65,
            linewidths=0,
            label=f"{policy} ({len(good)} worlds)",
            zorder=2,
        )
        # The cost up to the failure: it is no cost of the task, hence another mark.
        failed = [pair[BASELINE].cost for pair in bad], [pair[policy].cost for pair in bad]
        axes.scatter(*failed, s=34, marker="x", color=style.colour, zorder=3)
        unsatisfied = unsatisfied or bool(bad)
    if unsatisfied:
        # One entry for all policies: the colour of a cross says whose trial it was.
        axes.scatter([], [], s=34, marker="x", color=FAINT, label="not satisfied")
    axes.legend(loc="upper left", fontsize=8.5, frameon=False)


def _mark_diagonal(axes: Axes, limit: float) -> None:
    axes.plot([0, limit], [0, limit], color=FAINT, linewidth=1.0, zorder=1)
    axes.annotate(
        # Named where it is: in the legend it would be taken for a policy.
        "as the baseline",
        (0.985 * limit, 0.985 * limit),
        xytext=(-4, -10),
        textcoords="offset points",
        ha="right",
        va="top",
        rotation=45,
        rotation_mode="anchor",
        size=8,
        color=FAINT,
    )
