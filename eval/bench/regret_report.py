"""What ``eval.bench.regret`` says: its rows with their intervals, the table and the plots."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
import matplotlib.pyplot as plt

from potlp_jax.bench.problems import FAMILIES
from potlp_jax.planning.search.config import BestFirstConfig

GOAL_PERCENT = 1.0

WRONG_PERCENT = 0.05
"""Regret from which on an ended search is wrong: 32 bits cost less."""

RESAMPLES = 10_000

RATED = 8
"""Subgoals of the problems whose decisions a second are given."""


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
        return bootstrap_interval(self.percent)

    @property
    def ended_wrong(self) -> int:
        """Searches that ended by themselves at a wrong choice."""
        return sum(e and x and p > WRONG_PERCENT for e, x, p in zip(self.ended, self.exact, self.percent, strict=True))


def bootstrap_interval(values: Sequence[float]) -> tuple[float, float]:
    """Of the mean, 95 %, over the values."""
    chosen = np.random.default_rng(0).integers(0, len(values), (RESAMPLES, len(values)))
    low, high = np.percentile(np.asarray(values)[chosen].mean(axis=1), [2.5, 97.5])
    return float(low), float(high)


def time_to_goal(rows: Sequence[Row]) -> float:
    """CPU ms of the least budget from which on the mean regret stays within the goal; inf where it does not."""
    reached = float("inf")
    for row in sorted(rows, key=lambda row: -row.budget):
        if row.mean_percent > GOAL_PERCENT:
            break
        reached = row.cpu_ms
    return reached


def tables(rows: Sequence[Row]) -> str:
    """Markdown: for each planner its families by number of subgoals at the default budget, and over all by budget; then
    the planners beside each other, CPU time to the goal, and everything."""
    default = BestFirstConfig().simulations
    parts = []
    for planner in dict.fromkeys(row.planner for row in rows):
        own = [row for row in rows if row.planner == planner]
        parts += [f"{planner}, {default} simulations, mean (worst) regret in %:\n\n{by_subgoals(own, default)}"]
        parts += [f"{planner}, over all S, mean (95 %) regret in % by simulations:\n\n{by_budget(own)}"]
    parts += [f"Over all S, mean regret in %, and where it stays within {GOAL_PERCENT:g} %:\n\n{beside(rows)}"]
    parts += [f"{line}\n" for line in times_as_fast(rows)]
    parts += [f"Decisions a CPU second within {GOAL_PERCENT:g} %, S = {RATED} (simulations):\n\n{rates(rows)}"]
    return "\n".join([*parts, _every_row(rows)])


def by_subgoals(rows: Sequence[Row], budget: int) -> str:
    """Markdown of one planner: a line a family, a column a number of subgoals, at one budget."""
    rows = [row for row in rows if row.budget == budget]
    counts = sorted({row.subgoals for row in rows})
    lines = [
        "| family | " + "".join(f"S = {count} | " for count in counts) + "exact |",
        "|---" * (len(counts) + 2) + "|",
    ]
    for family in dict.fromkeys(row.family for row in rows):
        own = {row.subgoals: row for row in rows if row.family == family}
        cells = [
            f"{_short(own[count].mean_percent)} ({_short(max(own[count].percent))})" if count in own else "–"
            for count in counts
        ]
        exact = [known for row in own.values() for known in row.exact]
        lines.append(f"| {family} | {' | '.join(cells)} | {sum(exact)} of {len(exact)} |")
    return "\n".join(lines) + "\n"


def by_budget(rows: Sequence[Row]) -> str:
    """Markdown of one planner: a line a family, over all numbers of subgoals, a column a budget."""
    budgets = sorted({row.budget for row in rows})
    lines = ["| family | " + "".join(f"{budget:,} | " for budget in budgets) + "ended at the last, wrong |"]
    lines.append("|---" * (len(budgets) + 2) + "|")
    for family in [*dict.fromkeys(row.family for row in rows), "all"]:
        own = [row for row in rows if family in (row.family, "all")]
        cells = [_mean_and_interval([row for row in own if row.budget == budget]) for budget in budgets]
        last = [row for row in own if row.budget == budgets[-1]]
        ended, wrong = sum(sum(row.ended) for row in last), sum(row.ended_wrong for row in last)
        lines.append(f"| {family} | {' | '.join(cells)} | {ended} of {sum(len(row.ended) for row in last)}, {wrong} |")
    return "\n".join(lines) + "\n"


def beside(rows: Sequence[Row]) -> str:
    """Markdown: a line a family, over all numbers of subgoals; of every planner its mean regret at the default and at
    its largest budget, in how many groups of family and number of subgoals it gets to the goal, and the median CPU time
    that it takes there."""
    default, planners = BestFirstConfig().simulations, list(dict.fromkeys(row.planner for row in rows))
    largest = {name: max(row.budget for row in rows if row.planner == name) for name in planners}
    heads = [f"{name}, {default} and {largest[name]:,} | within {GOAL_PERCENT:g} %, ms" for name in planners]
    lines = ["| family | " + " | ".join(heads) + " |", "|---" * (2 * len(planners) + 1) + "|"]
    for family in [*dict.fromkeys(row.family for row in rows), "all"]:
        cells = []
        for name in planners:
            own = [row for row in rows if row.planner == name and family in (row.family, "all")]
            means = [
                np.mean([regret for row in own if row.budget == budget for regret in row.percent])
                for budget in (default, largest[name])
            ]
            times = [time_to_goal(group) for group in _groups(own)]
            reached = [time for time in times if np.isfinite(time)]
            median = f", {_milliseconds(float(np.median(reached)))}" if reached else ""
            cells += [" and ".join(_short(float(mean)) for mean in means), f"{len(reached)} of {len(times)}{median}"]
        lines.append(f"| {family} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def times_as_fast(rows: Sequence[Row]) -> Iterator[str]:
    """How many times as fast as each other planner the first one gets to the goal, where both do."""
    first, *others = dict.fromkeys(row.planner for row in rows)
    for other in others:
        ratios = []
        for group in _groups(rows):
            times = [time_to_goal([row for row in group if row.planner == name]) for name in (first, other)]
            if np.isfinite(times).all():
                ratios.append(times[1] / times[0])
        if ratios:
            mean = np.exp(np.log(ratios).mean())
            yield f"- {first} is {mean:.2g} times as fast as {other} (geometric mean of {len(ratios)} groups)"


def rates(rows: Sequence[Row]) -> str:
    """Markdown: decisions a CPU second of every planner at the least budget that keeps to the goal, which stands beside
    it, by family, with ``RATED`` subgoals; – where no budget does."""
    rows = [row for row in rows if row.subgoals == RATED]
    planners = list(dict.fromkeys(row.planner for row in rows))
    lines = ["| family | " + " | ".join(planners) + " |", "|---" * (len(planners) + 1) + "|"]
    for family in dict.fromkeys(row.family for row in rows):
        cells = []
        for name in planners:
            own = [row for row in rows if (row.family, row.planner) == (family, name)]
            least = time_to_goal(own)
            budget = next((row.budget for row in own if row.cpu_ms == least), None)
            cells.append("–" if budget is None else f"{1e3 / least:,.0f} ({budget:,})")
        lines.append(f"| {family} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _groups(rows: Sequence[Row]) -> list[list[Row]]:
    """The rows of each family and number of subgoals."""
    keys = dict.fromkeys((row.family, row.subgoals) for row in rows)
    return [[row for row in rows if (row.family, row.subgoals) == key] for key in keys]


def _mean_and_interval(rows: Sequence[Row]) -> str:
    percent = [regret for row in rows for regret in row.percent]
    low, high = bootstrap_interval(percent)
    return f"{_short(float(np.mean(percent)))} ({_short(low)} to {_short(high)})"


def _milliseconds(time: float) -> str:
    return f"{time:.2g}" if time < 10 else f"{time:,.0f}"


def _short(percent: float) -> str:
    # Less than this is rounding of 32 bits.
    return "0" if percent < 1e-6 else f"{percent:.2g}"


def _every_row(rows: Sequence[Row]) -> str:
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
    """Tables and plots, in the order of ``FAMILIES``."""
    rows = sorted(rows, key=lambda row: (list(FAMILIES).index(row.family), row.subgoals))
    (out / "regret.md").write_text(tables(rows))
    for subgoals in sorted({row.subgoals for row in rows}):
        plot([row for row in rows if row.subgoals == subgoals], subgoals, out / f"regret-S{subgoals}.png")
