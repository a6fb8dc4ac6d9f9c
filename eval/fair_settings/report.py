"""The page of results and the file beside it."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from eval.fair_settings.choosing import results
from eval.fair_settings.settings import SEARCHING
from eval.provenance import lines_of


def page(found: Mapping[str, Any], name: str) -> str:
    """The page of results; ``name``: of the JSON file beside it."""
    lines = [*_introduction(), *_chosen_table(found), "", f"<!-- made: {name} -->", "", *_tables(found, name)]
    return "\n".join(lines).rstrip() + "\n"


def _introduction() -> list[str]:
    return [
        "# Settings that are fair to each policy",
        "",
        "A comparison says little if a setting suits one policy and not the other. Here is what a policy gains from",
        "other settings than the defaults: the fewest cells of a frontier that is a subgoal (`min_size`), the cells",
        "after which a changed map is worth a new decision (`replan_distance`) and, where it searches, its commitment.",
        "They are compared on validation worlds of the family. Published tables use the defaults, for all policies",
        "alike; those of real maps, which have no validation worlds, have further baselines beside. The tables below",
        "name the policies that were looked at.",
        "",
        "The best setting has the least mean cost; a trial that is not satisfied is charged its budget. The best of",
        "many looks better in the worlds that chose it than elsewhere, so it runs once more, beside the default, in as",
        "many other validation worlds. It is chosen if the 95 % interval of its difference to the default (paired by",
        "world, all tasks of a world resampled together) lies below 0 in both; otherwise the default stays. The JSON",
        "file holds the chosen settings as `policy_settings` of a [sweep's file](../sweeps.md).",
        "",
        "```sh",
        "python -m eval.fair_settings FAMILY --policies baseline --worlds 20 --out out/fair    # or baseline,potlp",
        "python -m eval.fair_settings --out out/fair --report docs/results/fair_settings",
        "```",
        "",
    ]


def _chosen_table(found: Mapping[str, Any]) -> Iterator[str]:
    yield "| family | policy | worlds | default | best | difference to the default (95 %) | in other worlds | chosen |"
    yield "|---|---|---|---|---|---|---|---|"
    for family, entry in found["families"].items():
        for policy, compared in entry["policies"].items():
            best = next(row for row in compared["settings"] if row["setting"] == compared["best"])
            again = compared["confirmed"]
            chosen = "default" if compared["chosen"] == compared["default"] else "best"
            yield (
                f"| {family} | {policy} | {compared['worlds']} | {_told(compared['default'], policy)} | "
                f"{_told(compared['best'], policy)} | {_difference(best, compared)} | "
                f"{'' if again is None else _difference(again, compared)} | {chosen} |"
            )


def _tables(found: Mapping[str, Any], name: str) -> Iterator[str]:
    for family, entry in found["families"].items():
        for policy, compared in entry["policies"].items():
            yield f"## {family}: {policy}"
            yield ""
            yield f"Tasks {', '.join(entry['tasks'])} in {compared['worlds']} worlds."
            if any(row["trials"] < compared["trials"] for row in compared["settings"]):
                yield "A setting with fewer trials than the default is not finished, or had some cut short: not chosen."
            if policy in SEARCHING and entry["estimators"]:
                yield f"Estimator: {', '.join(entry['estimators'])}."
            yield ""
            yield "| setting | trials | mean cost | difference to the default (95 %) | not satisfied |"
            yield "|---|---|---|---|---|"
            for row in compared["settings"]:
                yield (
                    f"| {_told(row['setting'], policy)} | {row['trials']} | {row['mean_cost']:.1f} | "
                    f"{_difference(row, compared)} | {row['unsatisfied']} |"
                )
            yield ""
            yield f"<!-- made: {name} -->"
            yield ""


def _told(setting: Sequence[Any], policy: str) -> str:
    size, distance, commitment = setting
    told = f"`min_size` {size}, `replan_distance` {distance:g}"
    return told + (f", `commitment` {commitment:g}" if policy in SEARCHING else "")


def _difference(row: Mapping[str, Any], compared: Mapping[str, Any]) -> str:
    if row["setting"] == compared["default"]:
        return "the default"
    percent = 100 * row["difference"] / row["default_cost"]
    return f"{row['difference']:+.1f} ({row['low']:+.1f} to {row['high']:+.1f}), {percent:+.1f} %"


def write_report(folder: Path, report: Path) -> None:
    """Write NAME.json and NAME.md of what is finished."""
    found = results(folder)
    data = report.with_suffix(".json")
    data.write_text(json.dumps(found, indent=1) + "\n", "utf-8")
    report.with_suffix(".md").write_text(lines_of(page(found, data.name), data.parent), "utf-8")
