"""A sweep as one page: tables, plots, and the worst and best trials to look at."""

import dataclasses
import html
import math
from collections.abc import Mapping, Sequence
from typing import Any

from potlp_jax.sweep.results import Pair, compare_pairs, reliable_pairs
from potlp_jax.sweep.statistics import BASELINE, KNOWN_MAP, Table
from potlp_jax.view.comparisons import flag_lines, percent, unreliable_lines
from potlp_jax.view.replay_page import embed_json, packaged_text, page_style, replay_script
from potlp_jax.view.report_plots import cumulative, savings_by_world, scatter
from potlp_jax.view.style import INK, PolicyStyle, policy_styles

ORACLE, LEARNED = "oracle", "potlp"


@dataclasses.dataclass(frozen=True)
class Shown:
    """A trial that the page replays: why it is there, and its data (``replay_page.replay_data``)."""

    reason: str
    policy: str
    world: int
    cost: float
    outcome: str
    baseline: float
    data: Mapping[str, Any]


@dataclasses.dataclass(frozen=True)
class Cell:
    """One environment and task of a sweep, its paired rows, and the trials to replay."""

    environment: str
    task: str
    pairs: Sequence[Pair]
    shown: Sequence[Shown]


def report_page(title: str, facts: Sequence[tuple[str, str]], policies: Sequence[str], cells: Sequence[Cell]) -> str:
    """A self-contained page.

    Args:
        title: of the page.
        facts: pairs of a name and a text that say what was run and with what.
        policies: in the order of tables and legends.
        cells: one section each.

    Returns:
        HTML with all styles, scripts, plots and replays.
    """
    # Filled by the sections: data of replays stand at the end, so that tables appear before megabytes are read.
    replays: list[str] = []
    sections = [_section(number, cell, policies, replays) for number, cell in enumerate(cells)]
    contents = "".join(
        f'<li><a href="#cell{number}">{html.escape(cell.environment)}: <code>{html.escape(cell.task)}</code></a></li>'
        for number, cell in enumerate(cells)
    )
    rows = "".join(
        f"<tr><th scope=row>{html.escape(name)}</th><td>{html.escape(text)}</td></tr>" for name, text in facts
    )
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{html.escape(title)}</title>
<style>{page_style()}{packaged_text("report.css")}</style>
</head>
<body>
<main>
<h1>{html.escape(title)}</h1>
<nav aria-label="tasks"><ul>{contents}</ul></nav>
{"".join(sections)}
<section><h2>What was run</h2><div class="scroll"><table class="run">{rows}</table></div></section>
</main>
{"".join(replays)}
<script>{replay_script()}</script>
<script>{packaged_text("report.js")}</script>
</body>
</html>
"""


def _section(number: int, cell: Cell, policies: Sequence[str], replays: list[str]) -> str:
    heading = f"<h2>{html.escape(cell.environment)}: <code>{html.escape(cell.task)}</code></h2>"
    if not cell.pairs:
        return f'<section id="cell{number}">{heading}<p>No world has been finished by all policies yet.</p></section>'
    comparison = compare_pairs(cell.pairs, policies)
    # Of all policies of the sweep, as the plots ask for them: the colours of policies that are not shipped follow the
    # order of the list, and a shorter one would give others.
    styles = policy_styles(policies)
    caption = f"{comparison.satisfied.pairs} worlds in which every policy satisfied the task"
    tables = [_table(comparison.satisfied, caption, styles)]
    # Of the same worlds it would be the same table.
    if comparison.charged.pairs > comparison.satisfied.pairs:
        caption = f"{comparison.charged.pairs} worlds, unsatisfied trials charged their budget"
        tables.append(_table(comparison.charged, caption, styles))
    lines = [*_outcome_lines(comparison.outcomes), *unreliable_lines(comparison), *flag_lines(comparison)]
    # What counts in no mean is in no picture either.
    drawn = reliable_pairs(cell.pairs)
    plots = [
        (scatter(drawn, policies), "Costs world by world; below the line is cheaper than the baseline."),
        (savings_by_world(drawn, policies), "Savings against the baseline, worlds in order of savings."),
        (cumulative(drawn, policies), "Costs summed over the worlds."),
    ]
    figures = "".join(f"<figure>{svg}<figcaption>{caption}</figcaption></figure>" for svg, caption in plots)
    return f"""<section id="cell{number}">{heading}
{"".join(tables)}
{"".join(f'<p class="note">{html.escape(line)}</p>' for line in lines)}
{_losses(comparison.satisfied)}
<div class="plots">{figures}</div>
{_trials(number, cell.shown, replays, styles)}
</section>"""


_COLUMNS = ("policy", "attainable savings", "95 % interval", "net savings", "savings per trial", "mean cost")


def _table(table: Table, caption: str, styles: Mapping[str, PolicyStyle]) -> str:
    head = "".join(f"<th scope=col>{name}</th>" for name in _COLUMNS)
    # The known map is a bound, not a competitor.
    best = max((row.attainable_share for row in table.rows if row.policy != KNOWN_MAP), default=math.nan)
    body = ""
    for row in table.rows:
        # NaN equals nothing: where nothing can be attained, no row is marked.
        kind = ' class="best"' if row.attainable_share == best and row.policy != KNOWN_MAP else ""
        cells = (
            _percent(row.attainable_share),
            _interval(row.attainable_low, row.attainable_high),
            _percent(row.net_savings),
            _with_error(row.trial_savings, row.trial_savings_error),
            "-" if math.isnan(row.mean_cost) else f"{row.mean_cost:.1f}",
        )
        figures = "".join(f"<td>{html.escape(text)}</td>" for text in cells)
        body += f"<tr{kind}>{_policy_cell(row.policy, styles)}{figures}</tr>"
    return (
        f'<div class="scroll"><table><caption class="note">{html.escape(caption)}</caption>'
        f"<thead><tr>{head}</tr></thead>"
        f"<tbody>{body}</tbody></table></div>"
    )


def _policy_cell(policy: str, styles: Mapping[str, PolicyStyle]) -> str:
    """The name in the colour that the policy has in the plots; ink is whatever the page writes in, light or dark."""
    colour = styles[policy].colour
    style = "" if colour == INK else f' style="color: {colour}"'
    return f"<td{style}>{html.escape(policy)}</td>"


def _percent(share: float) -> str:
    return percent(share, unit=" %")


def _interval(low: float, high: float) -> str:
    # Of few worlds there is none.
    return "-" if math.isnan(low) else f"{_percent(low)} to {_percent(high)}"


def _with_error(share: float, error: float) -> str:
    # A single world has no standard error.
    return _percent(share) + ("" if math.isnan(error) else f" ± {_percent(error)}")


def _outcome_lines(outcomes: Mapping[str, Mapping[str, int]]) -> list[str]:
    counts = {
        policy: ", ".join(f"{count} {name}" for name, count in found.items()) for policy, found in outcomes.items()
    }
    # The usual case, every trial satisfied, takes one line.
    if len(set(counts.values())) == 1:
        return [f"Every policy: {next(iter(counts.values()))}."]
    return [f"{policy}: {text}" for policy, text in counts.items()]


def _losses(table: Table) -> str:
    """Where the savings come from, and where they are lost: to the planner, and to the estimator."""
    costs = {row.policy: row.mean_cost for row in table.rows}
    # Without savings to attain, or without the oracle between, there is nothing to divide.
    if not {ORACLE, LEARNED} <= costs.keys() or not costs[BASELINE] > costs[KNOWN_MAP]:
        return ""
    whole = costs[BASELINE] - costs[KNOWN_MAP]
    # The oracle plans with true answers: what it loses is the planner's, what is lost beyond it the estimator's.
    planner, estimator = costs[ORACLE] - costs[KNOWN_MAP], costs[LEARNED] - costs[ORACLE]
    saved = costs[BASELINE] - costs[LEARNED]
    return (
        f"<p>Of {whole:.1f} that could be saved in a world, {LEARNED} saves {saved:.1f} ({_percent(saved / whole)}). "
        f"The estimator costs {estimator:.1f} ({_percent(estimator / whole)}; {LEARNED} against the true answers), the "
        f"planner {planner:.1f} ({_percent(planner / whole)}; true answers against the known map).</p>"
    )


def _trials(number: int, shown: Sequence[Shown], replays: list[str], styles: Mapping[str, PolicyStyle]) -> str:
    if not shown:
        return ""
    rows = ""
    for index, trial in enumerate(shown):
        name = f"replay-{number}-{index}"
        replays.append(f'<script type="application/json" id="{name}">{embed_json(trial.data)}</script>\n')
        cells = (str(trial.world), trial.outcome, f"{trial.cost:.1f}", f"{trial.baseline:.1f}")
        rows += f"<tr><td>{html.escape(trial.reason)}</td>{_policy_cell(trial.policy, styles)}"
        rows += "".join(f"<td>{text}</td>" for text in cells)
        rows += f'<td><button type="button" data-replay="{name}" aria-expanded="false">replay</button></td></tr>'
    head = "".join(
        f"<th scope=col>{name}</th>" for name in ("trial", "policy", "world", "outcome", "cost", "baseline", "")
    )
    return (
        f'<h3>Trials to look at</h3><div class="scroll trials"><table><thead><tr>{head}</tr></thead>'
        f'<tbody>{rows}</tbody></table></div><div class="replay-place"></div>'
    )
