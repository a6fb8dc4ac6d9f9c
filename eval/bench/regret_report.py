"""What ``eval.bench.regret`` says: its rows with their intervals, the table and the plots."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
import matplotlib.pyplot as plt

GOAL_PERCENT = 1.0

WRONG_PERCENT = 0.05
"""Regret from which on an ended search is wrong: 32 bits cost less."""

RESAMPLES = 10_000


@dataclass(frozen=True)
class Row:
    """One planner at one budget on one family and S. ``percent`` and ``absolute`` are per instance; ``exact`` tells
    where the truth is exact, ``interval_percent`` how wide the certified interval of V* is where not, ``ended`` where
    the search ended by itself."""

    split: str
    family: str
    subgoals: int
    planner: str
    budget: int
    cpu_ms: float
    instances: list[int]
    percent: list[float]
    absolute: list[float]
    exact: list[bool]
    interval_percent: list[float]
    ended: list[bool]

    @property
    def mean_percent(self) -> float:
        """Mean regret in %."""
        return float(np.mean(self.percent))

    @property
    def mean_interval(self) -> tuple[float, float]:
        """Bootstrap interval of the mean regret, 95 %."""
        chosen = np.random.default_rng(0).integers(0, len(self.percent), (RESAMPLES, len(self.percent)))
        low, high = np.percentile(np.asarray(self.percent)[chosen].mean(axis=1), [2.5, 97.5])
        return float(low), float(high)

    @property
    def ended_wrong(self) -> int:
        """Searches that ended by themselves at a wrong choice."""
        return sum(e and x and p > WRONG_PERCENT for e, x, p in zip(self.ended, self.exact, self.percent, strict=True))


def time_to_goal(rows: Sequence[Row]) -> float:
    """CPU ms of the least budget from which on the mean regret stays within the goal; inf where it does not."""
    reached = float("inf")
    for row in sorted(rows, key=lambda row: -row.budget):
        if row.mean_percent > GOAL_PERCENT:
            break
        reached = row.cpu_ms
    return reached


def table(rows: Sequence[Row]) -> str:
    """Markdown: CPU time to the goal, then everything."""
    planners = list(dict.fromkeys(row.planner for row in rows))
    cases = list(dict.fromkeys((row.family, row.subgoals) for row in rows))
    lines = [f"CPU ms per decision to a mean regret of at most {GOAL_PERCENT:g} % (– where no budget gets there).", ""]
    lines += ["| family | S | instances | " + " | ".join(planners) + " |", "|---|---|---|" + "---|" * len(planners)]
    for family, subgoals in cases:
        own = [row for row in rows if (row.family, row.subgoals) == (family, subgoals)]
        times = [time_to_goal([row for row in own if row.planner == name]) for name in planners]
        shown = [f"{t:.3g}" if np.isfinite(t) else "–" for t in times]
        lines.append(f"| {family} | {subgoals} | {len(own[0].instances)} | " + " | ".join(shown) + " |")
    lines += [
        "",
        "| family | S | planner | budget | CPU ms | mean % (95 %) | worst % | mean | worst | not exact | ended, wrong"
        " |",
        "|---" * 11 + "|",
    ]
    for row in rows:
        low, high = row.mean_interval
        figures = (max(row.percent), float(np.mean(row.absolute)), max(row.absolute))
        lines.append(
            f"| {row.family} | {row.subgoals} | {row.planner} | {row.budget} | {row.cpu_ms:.3g} | "
            f"{row.mean_percent:.3g} ({low:.3g} to {high:.3g}) | "
            + " | ".join(f"{figure:.3g}" for figure in figures)
            + f" | {len(row.exact) - sum(row.exact)} of {len(row.exact)} | {sum(row.ended)}, {row.ended_wrong} |"
        )
    return "\n".join(lines) + "\n"


def plot(rows: Sequence[Row], subgoals: int, path: Path) -> None:
    """Mean regret over CPU time, a panel a family."""
    families = list(dict.fromkeys(row.family for row in rows))
    planners = list(dict.fromkeys(row.planner for row in rows))
    columns = min(4, len(families))
    lines = -(-len(families) // columns)
    figure, axes = plt.subplots(
        lines,
        columns,
        figsize=(max(8.0, 4.0 * columns), 3.2 * lines + 0.8),
        sharex=True,
        sharey=True,
        squeeze=False,
        layout="constrained",
    )
    for axis, family in zip(axes.flat, families, strict=False):
        for number, planner in enumerate(planners):
            own = [row for row in rows if (row.family, row.planner) == (family, planner)]
            times, regrets = [row.cpu_ms for row in own], [max(row.mean_percent, 1e-3) for row in own]
            axis.plot(times, regrets, "osv^Dx*P"[number % 8] + "-", label=planner, color=f"C{number}", markersize=4)
        axis.axhline(GOAL_PERCENT, color="0.6", linewidth=0.8, linestyle="--")
        axis.set(xscale="log", yscale="log", title=family)
        axis.grid(alpha=0.25)
    for axis in axes.flat[len(families) :]:
        axis.set_visible(False)
    figure.supxlabel(f"CPU ms per decision, S = {subgoals} (drawn at 0.001 %: less than that)")
    figure.supylabel("mean regret, %")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=min(6, len(labels)), frameon=False)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def report(rows: Sequence[Row], out: Path) -> None:
    """Table and plots."""
    (out / "regret.md").write_text(table(rows))
    for subgoals in sorted({row.subgoals for row in rows}):
        plot([row for row in rows if row.subgoals == subgoals], subgoals, out / f"regret-S{subgoals}.png")
