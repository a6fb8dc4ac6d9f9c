"""The page of results: shares of the attainable savings, and what each true answer brings."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from eval.limit.arms import Arm
from eval.provenance import lines_of
from eval.savings import policy_row, versions_of
from potlp_jax.codec import finite_or_null
from potlp_jax.sweep.rows import provenance
from potlp_jax.sweep.statistics import (
    UNRELIABLE,
    Comparison,
    PolicyRow,
    TrialResult,
    attainable_interval,
    attainable_share,
)
from potlp_jax.trials.record import Outcome

TITLES = {
    Arm.KNOWN_MAP: "known map",
    Arm.ORACLE: "oracle",
    Arm.IDEAL_OBSERVER: "ideal observer",
    Arm.TRUE_CHANCES: "PO-TLP, true P_S",
    Arm.TRUE_COSTS: "PO-TLP, true R_S and R_F",
    Arm.POTLP: "PO-TLP",
    Arm.BASELINE: "baseline",
}

OBSERVERS = {
    "firefighting": (
        "the generator's exact one, given every mapped cell and letter, and the tiles and the smoke (above a density "
        "of 0.01) of every floor cell that has been in line of sight from any cell that was entered, at any distance. "
        "It knows how buildings are drawn; what it does not know, nobody can."
    )
}
PARTS = (Arm.TRUE_CHANCES, Arm.TRUE_COSTS)
"""The truth in place of one part of the answers."""

# An interval that ends nearer to none ends beyond it with another seed of the bootstrap.
_EDGE = 5e-4
_TRUE = {Arm.TRUE_CHANCES: "true P_S", Arm.TRUE_COSTS: "true R_S and R_F"}

OTHER_OBSERVER = (
    "who may be where, given the floor plan, every mapped cell and letter, and whether a room is lit, of every room of "
    "which a floor cell has been in line of sight from any cell that was entered. Having the plan, it bounds from "
    "above what can be known of a floor that was never seen."
)
"""What an ideal observer knows, by environment; of floors with people or parcels."""

Columns = Mapping[str, Callable[[Mapping[str, Any]], str]]
"""Of a table, by their titles: what each says of the figures of one task."""


def results_of(rows: Sequence[Mapping[str, Any]], formulas: Mapping[str, str]) -> dict[str, Any]:
    """What a page needs: a comparison for each task over the worlds that all arms have finished.

    Args:
        rows: of one environment, one split and one estimator.
        formulas: of the tasks, by their names.

    Returns:
        JSON-able values.
    """
    arms = [arm for arm in Arm if any(row["arm"] == arm for row in rows)]
    return {
        "environment": rows[0]["environment"],
        "split": rows[0]["split"],
        "identities": {arm.value: next(row["identity"] for row in rows if row["arm"] == arm) for arm in arms},
        "tables": {task: _table(formula, _pairs(rows, task, arms), arms) for task, formula in formulas.items()},
        "decisions": {arm.value: _seconds(rows, arm) for arm in arms},
        "audited": len(rows),
        "problems": [f"{row['task']} {row['world']} {row['arm']}: {text}" for row in rows for text in row["problems"]],
        "commits": sorted({row["commit"] for row in rows}),
        "provenance": provenance() | {"versions": versions_of(row["versions"] for row in rows)},
    }


def _pairs(rows: Sequence[Mapping[str, Any]], task: str, arms: Sequence[Arm]) -> list[dict[str, Mapping[str, Any]]]:
    """The rows of each world by arm, of the worlds that have all."""
    by_world: dict[int, dict[str, Mapping[str, Any]]] = defaultdict(dict)
    for row in rows:
        if row["task"] == task:
            by_world[row["world"]][row["arm"]] = row
    return [found for _, found in sorted(by_world.items()) if len(found) == len(arms)]


def _table(formula: str, pairs: Sequence[Mapping[str, Mapping[str, Any]]], arms: Sequence[Arm]) -> dict[str, Any]:
    results = {
        arm.value: [
            TrialResult(**{name: pair[arm][name] for name in ("cost", "outcome", "budget", "status")}) for pair in pairs
        ]
        for arm in arms
    }
    # Every world of the generator is another building.
    comparison = Comparison.from_results(results)
    return {
        "task": formula,
        "world_numbers": [pair[Arm.BASELINE]["world"] for pair in pairs],
        "costs": {arm.value: [pair[arm]["cost"] for pair in pairs] for arm in arms},
        **comparison.to_dict(),
        "gains": finite_or_null(_gains(results)) if Arm.POTLP in arms else {},
    }


def _gains(results: Mapping[str, Sequence[TrialResult]]) -> dict[str, dict[str, float]]:
    """By arm: how much larger its share is than PO-TLP's in the same worlds, with a paired 95 % interval."""
    kept = [
        all(trial.outcome == Outcome.SATISFIED.value and not trial.status & UNRELIABLE for trial in trials)
        for trials in zip(*results.values(), strict=True)
    ]
    costs = {arm: np.array([trial.cost for trial in trials])[kept] for arm, trials in results.items()}
    baseline, known_map = costs[Arm.BASELINE], costs[Arm.KNOWN_MAP]
    found = {}
    for arm in results:
        # A share whose numerator is what PO-TLP pays more than the arm, so that worlds are resampled for both at once.
        instead = baseline - (costs[Arm.POTLP] - costs[arm])
        low, high = attainable_interval(instead, baseline, known_map)
        found[arm] = {"gain": attainable_share(instead, baseline, known_map), "low": low, "high": high}
    return found


def _seconds(rows: Sequence[Mapping[str, Any]], arm: Arm) -> dict[str, float]:
    own = [row for row in rows if row["arm"] == arm]
    number = sum(row["decisions"] for row in own)
    # The median over trials: compilation falls to the first.
    per_decision = [row["seconds"] / max(row["decisions"], 1) for row in own]
    return {"trials": len(own), "decisions": number / len(own), "seconds": float(np.median(per_decision))}


def page(results: Mapping[str, Any], data: Path) -> str:
    """The text of the page, with the line of how it was made below each table; ``data`` is the file of the results."""
    lines = "\n".join(
        [*_head(results), *_shares(results, data.name), *_gain_lines(results, data.name), *_foot(results, data.name)]
    )
    return lines_of(lines + "\n", data.parent)


def markdown(results: Mapping[str, Any]) -> str:
    """The tables alone; gains are over PO-TLP, where it ran."""
    gains = ["", *_gain_table(results)] if _arms(results, [Arm.POTLP]) else []
    return "\n".join([*_share_table(results), *gains])


def _head(results: Mapping[str, Any]) -> Iterator[str]:
    yield f"# The limit of estimates{_of_environment(results, ': ')}"
    yield ""
    yield (
        "**Question.** How much of the attainable savings could PO-TLP keep if its estimates used all that the robot "
        "has seen? And which of the estimates costs what?"
    )
    yield ""
    yield f"**Answer.** {_answer(results)}"
    yield ""


def _answer(results: Mapping[str, Any]) -> str:
    """One sentence for each task, on the limit and on PO-TLP."""
    sentences = []
    for name, table in results["tables"].items():
        shares = {entry["policy"]: entry["attainable_share"] for entry in table["satisfied"]["rows"]}
        if shares[Arm.POTLP] is None:
            sentences.append(f"Task {name}: no world to compare, or nothing to be saved.")
            continue
        ideal = shares.get(Arm.IDEAL_OBSERVER)
        limit = "" if ideal is None else f"the ideal observer reaches {100 * ideal:.0f} %, "
        gains = {arm: table["gains"][arm]["gain"] for arm in PARTS if arm in table["gains"]}
        told = " and ".join(
            f"{_TRUE[arm]} {'add' if gain >= 0 else 'take'} {100 * abs(gain):.1f} points" for arm, gain in gains.items()
        )
        sentences.append(f"Task {name}: {limit}PO-TLP {100 * shares[Arm.POTLP]:.0f} %{'; ' + told if told else ''}.")
    differences = {
        f"{_TRUE[arm]} in task {name}": gain
        for name, table in results["tables"].items()
        for arm in PARTS
        if (gain := table["gains"].get(arm, {"low": None}))["low"] is not None
    }
    certain = [name for name, gain in differences.items() if gain["low"] > _EDGE or gain["high"] < -_EDGE]
    if differences:
        told = f"{', '.join(certain)} alone" if certain else "none of true P_S or of true R_S and R_F"
        sentences.append(f"Of these differences {told} can be told from none.")
    counts = [table["satisfied"]["pairs"] for table in results["tables"].values()]
    number = f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"
    return f"In {number} {results['split']} worlds a task: {' '.join(sentences)}"


def _shares(results: Mapping[str, Any], data: str) -> Iterator[str]:
    yield "## Shares of the attainable savings"
    yield ""
    yield (
        "The same worlds for all, the same planner for all but known map and baseline; 95 % intervals draw whole "
        "buildings. The columns stand in the order of what the estimates know:"
    )
    yield ""
    yield "- **oracle**: the true labels of the building;"
    if Arm.IDEAL_OBSERVER in _arms(results, Arm):
        yield (
            "- **ideal observer**: the means of the true labels over buildings drawn from a posterior: "
            f"{OBSERVERS.get(results['environment'], OTHER_OBSERVER)} The planner takes attempts to be independent of "
            "each other (Eq. 3), also here. R_S and R_F are means over the buildings in which the attempt succeeds and "
            "over those in which it fails;"
        )
    yield "- **true P_S**: the trained estimator's R_S and R_F with the true labels' P_S, 0 or 1;"
    yield (
        "- **true R_S and R_F**: the trained estimator's P_S, with the true labels' R_S of attempts that succeed in "
        "the building and their R_F of those that fail; an attempt that succeeds has no true R_F, one that fails no "
        "true R_S, and there the estimator's own is kept;"
    )
    yield "- **PO-TLP**: the trained estimator alone."
    yield ""
    yield from _share_table(results)
    yield ""
    yield f"<!-- made: {data} -->"
    yield ""


def _share_table(results: Mapping[str, Any]) -> Iterator[str]:
    shown = [arm for arm in _arms(results, Arm) if arm not in (Arm.KNOWN_MAP, Arm.BASELINE)]
    columns: Columns = {
        "worlds": lambda table: str(table["satisfied"]["pairs"]),
        "known map, cost": lambda table: _cost(table, Arm.KNOWN_MAP),
        **{TITLES[arm]: partial(_share, arm=arm) for arm in shown},
        "baseline, cost": lambda table: _cost(table, Arm.BASELINE),
    }
    return _rows(results, columns)


def _rows(results: Mapping[str, Any], columns: Columns) -> Iterator[str]:
    """A table with a row for each task: its name, and what each column says of its figures."""
    yield f"| task | {' | '.join(columns)} |"
    yield "|" + "---|" * (len(columns) + 1)
    for name, table in results["tables"].items():
        yield f"| {name} | {' | '.join(tell(table) for tell in columns.values())} |"


def _arms(results: Mapping[str, Any], arms: Iterable[Arm]) -> list[Arm]:
    """Those of the arms that ran."""
    return [arm for arm in arms if arm.value in results["identities"]]


def _cost(table: Mapping[str, Any], arm: Arm) -> str:
    return f"{_policy(table, arm).mean_cost:.1f}"


def _share(table: Mapping[str, Any], arm: Arm) -> str:
    row = _policy(table, arm)
    return f"{100 * row.attainable_share:.1f} % ({_interval(row.attainable_low, row.attainable_high, '.0f')})"


def _policy(table: Mapping[str, Any], arm: Arm) -> PolicyRow:
    return next(policy_row(entry) for entry in table["satisfied"]["rows"] if entry["policy"] == arm)


def _gain_lines(results: Mapping[str, Any], data: str) -> Iterator[str]:
    yield "## What better answers bring"
    yield ""
    yield (
        "Points of the share that each kind of answer has more than PO-TLP in the same worlds, with paired 95 % "
        "intervals. The parts need not add up, and one part alone can do harm: the true cost of an attempt that "
        "succeeds is compared with what the estimator believes of one that does not."
    )
    yield ""
    yield from _gain_table(results)
    yield ""
    yield f"<!-- made: {data} -->"
    yield ""


def _gain_table(results: Mapping[str, Any]) -> Iterator[str]:
    shown = _arms(results, (Arm.TRUE_CHANCES, Arm.TRUE_COSTS, Arm.ORACLE, Arm.IDEAL_OBSERVER))
    return _rows(results, {TITLES[arm]: partial(_gain, arm=arm) for arm in shown})


def _gain(table: Mapping[str, Any], arm: Arm) -> str:
    gain, low, high = (np.nan if value is None else float(value) for value in table["gains"][arm].values())
    return f"{100 * gain:+.1f} ({_interval(low, high, '+.0f')})"


def _interval(low: float, high: float, form: str) -> str:
    """In per cent; there is none where too many resamples hold nothing to be saved."""
    return "no interval" if np.isnan(low) else f"{100 * low:{form}} to {100 * high:{form}}"


def _of_environment(results: Mapping[str, Any], before: str) -> str:
    """Its name, where the page is not that of the first family."""
    return "" if results["environment"] in OBSERVERS else before + results["environment"]


def _foot(results: Mapping[str, Any], data: str) -> Iterator[str]:
    yield "**Command.** The same command goes on where it was stopped, and with more worlds or another estimator."
    yield ""
    # As it was given: number of worlds and of drawn buildings are part of what the table is.
    yield from ("```sh", results["provenance"]["command"].replace(" --as-it-is", ""), "```", "")
    yield f"Worlds of the split {results['split']}, the first of each task in which it is possible. Tasks:"
    yield ""
    yield from (f"- {name}: `{table['task']}`" for name, table in results["tables"].items())
    yield ""
    trained = results["identities"].get(Arm.POTLP)
    drawn = results["identities"].get(Arm.IDEAL_OBSERVER)
    yield (
        f"The trained estimator is `{trained}`{f'; the ideal observer draws {drawn} a decision' if drawn else ''}. "
        f"{results['audited']} trials were audited: {len(results['problems'])} problems."
    )
    yield ""
    yield from (
        f"- {TITLES[Arm(name)]}: {entry['decisions']:.1f} decisions a trial, {entry['seconds']:.2f} s each with the "
        "way to the next"
        for name, entry in results["decisions"].items()
    )
