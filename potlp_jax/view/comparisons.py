"""A comparison of policies as tables and as a picture."""

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure
from rich.box import SIMPLE_HEAD
from rich.table import Table as RichTable

from potlp_jax.sweep.statistics import BASELINE, KNOWN_MAP, SATISFIED, Comparison, PolicyRow, Table
from potlp_jax.view.style import FAINT, INK, STATE_COLOURS, new_figure

_MARKERS = "osD^vP*X"


def savings_table(table: Table, title: str) -> RichTable:
    """The figures of all policies, the share of attainable savings first."""
    nothing = any(math.isnan(row.attainable_share) for row in table.rows)
    shown = RichTable(
        title=title,
        title_justify="left",
        box=SIMPLE_HEAD,
        pad_edge=False,
        caption="-: the baseline leaves nothing to attain" if nothing and table.pairs else None,
        caption_justify="left",
    )
    shown.add_column("policy", no_wrap=True)
    for name in ("attainable\nsavings", "95%\ninterval", "net\nsavings", "savings\nper trial", "mean\ncost"):
        shown.add_column(name, justify="right", no_wrap=True)
    for row in table.rows:
        shown.add_row(row.policy, *_cells(row))
    return shown


def _cells(row: PolicyRow) -> tuple[str, ...]:
    low, high = (_percent(share, unit="") for share in (row.attainable_low, row.attainable_high))
    error = "" if math.isnan(row.trial_savings_error) else f" ± {100 * row.trial_savings_error:.1f}%"
    return (
        _percent(row.attainable_share),
        "-" if math.isnan(row.attainable_low) else f"{low} .. {high}%",
        _percent(row.net_savings),
        _percent(row.trial_savings, unit="" if error else "%") + error,
        "-" if math.isnan(row.mean_cost) else f"{row.mean_cost:.1f}",
    )


def _percent(share: float, unit: str = "%") -> str:
    # Adding zero turns a rounded -0.0 into 0.0.
    return "-" if math.isnan(share) else f"{round(100 * share, 1) + 0.0:.1f}{unit}"


def outcome_table(comparison: Comparison) -> RichTable:
    """How the trials of each policy ended."""
    endings = sorted({SATISFIED, *(name for counts in comparison.outcomes.values() for name in counts)})
    endings.sort(key=lambda name: name != SATISFIED)
    shown = RichTable(title="how trials ended", title_justify="left", box=SIMPLE_HEAD)
    shown.add_column("policy", no_wrap=True)
    for name in endings:
        shown.add_column(name, justify="right")
    for policy, counts in comparison.outcomes.items():
        shown.add_row(policy, *(str(counts.get(name, 0)) for name in endings))
    return shown


def loss_lines(comparison: Comparison) -> list[str]:
    """One line per policy whose trials lost something to the bounds of arrays or loops."""
    return [
        f"{policy}: "
        + ", ".join(f"{count} trials with {name.replace('_', ' ')}" for name, count in counts.items())
        + " (left out of the first table)"
        for policy, counts in comparison.losses.items()
        if counts
    ]


def draw_scatter(trials: Mapping[str, Sequence[Mapping[str, Any]]], title: str) -> Figure:
    """Each policy's cost over the baseline's, world by world; below the diagonal is cheaper than the baseline.

    ``trials`` holds per policy one mapping with ``cost`` and ``outcome`` per world. Trials that did not end satisfied,
    or whose baseline did not, are crosses.
    """
    baseline = trials[BASELINE]
    limit = 1.05 * max((trial["cost"] for rows in trials.values() for trial in rows), default=1.0) or 1.0
    figure = new_figure(6.4, 6.9)
    axes = figure.add_axes((0.12, 0.1, 0.84, 0.78))
    axes.plot([0, limit], [0, limit], color=FAINT, linewidth=1.0, zorder=1)
    axes.annotate(
        "as the baseline",
        (0.985 * limit, 0.985 * limit),
        xytext=(-4, -10),
        textcoords="offset points",
        ha="right",
        va="top",
        rotation=45,
        rotation_mode="anchor",
        size=8,
        color="#6E6E6E",
    )
    others = [policy for policy in trials if policy != BASELINE]
    unsatisfied = False
    for index, policy in enumerate(others):
        colour = "#777777" if policy == KNOWN_MAP else STATE_COLOURS[index % len(STATE_COLOURS)]
        good = [
            pair for pair in zip(baseline, trials[policy], strict=True) if all(t["outcome"] == SATISFIED for t in pair)
        ]
        bad = [
            pair for pair in zip(baseline, trials[policy], strict=True) if any(t["outcome"] != SATISFIED for t in pair)
        ]
        axes.scatter(
            [pair[0]["cost"] for pair in good],
            [pair[1]["cost"] for pair in good],
            s=14 if policy == KNOWN_MAP else 30,
            marker=_MARKERS[index % len(_MARKERS)],
            color=colour,
            alpha=0.75,
            linewidths=0,
            label=f"{policy} ({len(good)} worlds)",
            zorder=2,
        )
        axes.scatter([p[0]["cost"] for p in bad], [p[1]["cost"] for p in bad], s=34, marker="x", color=colour, zorder=3)
        unsatisfied = unsatisfied or bool(bad)
    if unsatisfied:
        axes.scatter([], [], s=34, marker="x", color=INK, label="not satisfied")
    axes.set(xlim=(0, limit), ylim=(0, limit), aspect="equal")
    axes.set_xlabel("cost of the baseline", color=INK)
    axes.set_ylabel("cost of the policy", color=INK)
    axes.grid(color="#EEEEEE", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.legend(loc="upper left", fontsize=8.5, framealpha=0.9)
    figure.text(0.5, 0.975, textwrap.fill(title, 88), ha="center", va="top", size=8.5, color=INK)
    return figure
