"""The page, its data and its picture."""

import json
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from eval.ablations.running import POLICIES, SECONDS
from eval.ablations.variants import FAMILY, VARIANTS
from eval.gains import Costs, gain
from eval.provenance import lines_of
from eval.savings import audit, compare_first, policy_row, read_rows
from potlp_jax.codec import finite_or_null
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split
from potlp_jax.planning.policies import Policy
from potlp_jax.recipes.fitting import ESTIMATOR
from potlp_jax.sweep.rows import provenance
from potlp_jax.sweep.runner import RESULTS
from potlp_jax.sweep.statistics import UNRELIABLE
from potlp_jax.sweep.store import Row
from potlp_jax.trials.record import Outcome
from potlp_jax.view.style import new_figure, save_figure

SHIPPED: str = "shipped"
WHOLE: str = next(iter(VARIANTS))
TIMES: tuple[str, ...] = ("one-epoch", WHOLE, "six-epochs")
"""Variants that differ in time alone."""


def results_of(out: Path, views: Sequence[str]) -> dict[str, Any]:
    """Figures of all variants that are finished.

    Args:
        out: the folder of ``eval.ablations.running.run``.
        views: names of the data sets that were evaluated on.

    Returns:
        For each variant ``says``, ``seconds`` of its fit, ``answers`` by data set, and ``tasks``: the comparison, and
        points of the share beside the whole network.
    """
    # Another process may be at the next one.
    names = [name for name in (*VARIANTS, SHIPPED) if (out / "trials" / name / RESULTS).is_file()]
    rows = {name: read_rows(out / "trials" / name) for name in names}
    everything = [row for found in rows.values() for row in found]
    return {
        "provenance": provenance(),
        "commits": sorted({row.commit for row in everything}),
        "split": Split.VALIDATION.value,
        "worlds": sorted({row.item.world for row in everything}),
        "audited": len(everything),
        "problems": audit(everything, make(FAMILY), Split.VALIDATION),
        "variants": {name: _variant(out, name, rows, views) for name in names},
    }


def _variant(out: Path, name: str, rows: Mapping[str, Sequence[Row]], views: Sequence[str]) -> dict[str, Any]:
    seconds = out / "fits" / name / SECONDS
    return {
        "says": VARIANTS[name].says if name in VARIANTS else "the shipped file, for comparison",
        "epochs": VARIANTS[name].epochs if name in VARIANTS else None,
        "seconds": json.loads(seconds.read_text()) if seconds.is_file() else None,
        "bytes": (out / "fits" / name / ESTIMATOR).stat().st_size if name in VARIANTS else None,
        "answers": {of: found for of in views if (found := _answers(out / "answers" / name / of)) is not None},
        "tasks": {
            number: {
                **compare_first(rows[name], task, POLICIES, len(rows[name]), lambda world: world),
                "beside": None if name == WHOLE else finite_or_null(_beside(rows[WHOLE], rows[name], task)),
            }
            for number, task in make(FAMILY).tasks.items()
        },
    }


def _answers(folder: Path) -> dict[str, Any] | None:
    file = folder / "evaluation.json"
    if not file.is_file():
        return None
    overall = json.loads(file.read_text())["figures"]["intact"]["overall"]
    costs = {name: overall[name]["r2"] for name in ("success_cost", "failure_cost")}
    return {name: overall[name] for name in ("samples", "brier", "skill", "auc", "calibration_error")} | costs


def _beside(whole: Sequence[Row], other: Sequence[Row], task: str) -> list[float]:
    """Points of the share by which a variant is better than the whole network, with the 95 % interval."""
    return [100 * value for value in gain(_costs(whole, task), _costs(other, task), task)]


def _costs(rows: Sequence[Row], task: str) -> Costs:
    found: Costs = {}
    for row in rows:
        # Of a trial that gave up, or was cut short, nobody knows what it would have cost.
        if row.item.task == task and row.outcome == Outcome.SATISFIED and not row.status & UNRELIABLE:
            found.setdefault((task, row.item.world), {})[row.item.policy] = row.cost
    return {key: costs for key, costs in found.items() if len(costs) == len(POLICIES)}


def write_report(out: Path, views: Sequence[str], report: Path, beside: Path | None = None) -> None:
    """NAME.json, NAME.png and NAME.md; ``beside``: the JSON file of other fits of the same networks."""
    found = results_of(out, views)
    report.parent.mkdir(parents=True, exist_ok=True)
    report.with_suffix(".json").write_text(json.dumps(found, indent=1) + "\n")
    draw_times(found, report.with_suffix(".png"))
    report.with_suffix(".md").write_text(lines_of(page(found, views, report.name, beside), report.parent))


PAGE: str = """# What each part of the estimator is good for

**Question.** What do answers and trials lose without the map, without what the camera painted on it, and without drives
of the policy's own, and what does more time bring?

**Answer.** {answer}

```sh
python -m eval.ablations --out out/ablations --views {views}{option} --report docs/results/ablations
```

All but the last line are fitted to the same number of views: 1,200 buildings of the explorer, and 400 drives of PO-TLP
with a first network. The [shipped estimator](estimator.md#how-it-was-made) had many more. Two epochs where nothing
else is said; the network of one panorama has the settings of its own recipe but for the epochs, of which that has
seven. **Each network was fitted once for this table**: the intervals are those of the worlds alone, and the same
network fitted again with other draws would differ, too. Minutes are those of a machine that had other work as well.

What larger buildings in training bring was measured [for deliveries](delivery.md#deliveries-to-people): no difference
that could be told.

## In trials

Shares of the attainable savings in the validation worlds {first} to {last}, those among them in which a task is
possible, with 95 % intervals. {audited:,} trials were audited: {problems} problems.

{shares}
<!-- made: {data} -->

Points of the share beside the whole network, paired by world:

{points}
<!-- made: {data} -->
{second}
![Share of the attainable savings over passes through the views]({picture})

## In answers

[What the figures mean](../estimator.md#what-evaluate-writes). The network of one panorama is asked about the subgoals
in its view alone, which are fewer and nearer.

{answers}
<!-- made: {data} -->
"""
"""The page of results."""

_SECOND = """
### What a second fit changes

All but no-paths and no-contrast were fitted once before, to as many views, by other code, and drove in the same worlds
([{beside}]({beside})). Points of the share beside the whole network, of this
fit and then of that one; bold where both can be told from none and have the same sign:

{points}
<!-- made: {data}, {beside} -->
"""


def page(found: Mapping[str, Any], views: Sequence[str], name: str, beside: Path | None = None) -> str:
    """The page about what ``results_of`` gave.

    Args:
        found: the figures.
        views: names of the data sets.
        name: of the files beside the page.
        beside: the figures of other fits of the same networks, a JSON file in the folder of the page.
    """
    return PAGE.format(
        second="" if beside is None else _second(found, name, beside),
        option="" if beside is None else f" --beside {beside}",
        answer=_answer(found, again=beside is not None),
        views=" ".join(f"{of}=out/{of}" for of in views),
        first=found["worlds"][0],
        last=found["worlds"][-1],
        audited=found["audited"],
        problems=len(found["problems"]),
        shares="".join(f"{line}\n" for line in _shares(found)),
        points="".join(f"{line}\n" for line in _gains(found)),
        answers="".join(f"{line}\n" for line in _answers_table(found, views)),
        data=f"{name}.json",
        picture=f"{name}.png",
    )


def _shares(found: Mapping[str, Any]) -> Iterator[str]:
    tasks = _tasks(found)
    yield "| network | minutes of fitting | " + " | ".join(f"task {task}" for task in tasks) + " | mean |"
    yield "|---|---|" + "---|" * (len(tasks) + 1)
    for variant, entry in found["variants"].items():
        cells = [_share(entry["tasks"][task]) for task in tasks]
        minutes = "" if entry["seconds"] is None else f"{entry['seconds'] / 60:.1f}"
        yield f"| **{variant}**: {entry['says']} | {minutes} | {' | '.join(cells)} | {100 * mean_share(entry):.1f} % |"


def _gains(found: Mapping[str, Any]) -> Iterator[str]:
    tasks = _tasks(found)
    yield "| network | " + " | ".join(f"task {task}" for task in tasks) + " |"
    yield "|---|" + "---|" * len(tasks)
    for variant, entry in found["variants"].items():
        if variant != WHOLE:
            yield f"| {variant} | " + " | ".join(_points(entry["tasks"][task]["beside"]) for task in tasks) + " |"


def _second(found: Mapping[str, Any], name: str, beside: Path) -> str:
    before = json.loads(beside.read_text("utf-8"))
    points = "".join(f"{line}\n" for line in _both(found["variants"], before["variants"]))
    return _SECOND.format(points=points, data=f"{name}.json", beside=beside.name)


def _both(now: Mapping[str, Any], before: Mapping[str, Any]) -> Iterator[str]:
    """A line for each network that was fitted twice: its points in both fits."""
    tasks = list(now[WHOLE]["tasks"])
    yield "| network | " + " | ".join(f"task {task}" for task in tasks) + " |"
    yield "|---|" + "---|" * len(tasks)
    for variant in now:
        # The shipped network is the same file beside both.
        if variant in before and variant not in (WHOLE, SHIPPED):
            pairs = [
                (now[variant]["tasks"][task]["beside"], before[variant]["tasks"][task]["beside"]) for task in tasks
            ]
            yield f"| {variant} | " + " | ".join(_pair(*pair) for pair in pairs) + " |"


def _pair(now: Sequence[float], before: Sequence[float]) -> str:
    text = f"{now[0]:+.0f}, {before[0]:+.0f}"
    same = all(low > 0 for _, low, _ in (now, before)) or all(high < 0 for _, _, high in (now, before))
    return f"**{text}**" if same else text


def _answers_table(found: Mapping[str, Any], views: Sequence[str]) -> Iterator[str]:
    yield "| network | views of | questions | skill | AUC | calibration error | R² of R_S | R² of R_F |"
    yield "|---|---|---|---|---|---|---|---|"
    for variant, entry in found["variants"].items():
        for of in views:
            if of in entry["answers"]:
                yield f"| {variant} | {of} | {_answer_cells(entry['answers'][of])} |"


def _tasks(found: Mapping[str, Any]) -> list[str]:
    return list(found["variants"][WHOLE]["tasks"])


def _answer(found: Mapping[str, Any], again: bool) -> str:
    told = []
    for name, entry in found["variants"].items():
        besides = {task: found_in["beside"] for task, found_in in entry["tasks"].items() if found_in["beside"]}
        clear = [f"{gain:+.0f} in task {task}" for task, (gain, low, high) in besides.items() if low > 0 or high < 0]
        if clear:
            told.append(f"{name}: {', '.join(clear)}")
    mean = 100 * mean_share(found["variants"][WHOLE])
    differences = "; ".join(told) if told else "none"
    text = (
        f"With nothing left out the mean over the tasks of the share of attainable savings is {mean:.0f} %. "
        f"Differences to it that can be told from none, in points (the names are those of the table): {differences}."
    )
    if again:
        text += (
            " Each is of one fit, and its interval of the worlds alone: [another fit](#what-a-second-fit-changes) "
            "tells again only what is bold there."
        )
    # As it stands behind the word before it.
    return textwrap.fill(text, 120, initial_indent=" " * len("**Answer.** "), break_on_hyphens=False).lstrip()


def mean_share(entry: Mapping[str, Any]) -> float:
    """The mean over the tasks of a variant's share; 1 is all of the attainable savings."""
    rows = [_potlp(task).attainable_share for task in entry["tasks"].values()]
    return sum(rows) / len(rows)


def _potlp(task: Mapping[str, Any]) -> Any:
    return next(policy_row(row) for row in task["satisfied"]["rows"] if row["policy"] == Policy.POTLP)


def _share(task: Mapping[str, Any]) -> str:
    row = _potlp(task)
    return f"{100 * row.attainable_share:.1f} % ({100 * row.attainable_low:.0f} to {100 * row.attainable_high:.0f})"


def _points(beside: Sequence[float]) -> str:
    value, low, high = beside
    return f"{value:+.1f} ({low:+.0f} to {high:+.0f})"


def _answer_cells(found: Mapping[str, float]) -> str:
    return (
        f"{found['samples']:,} | {found['skill']:.3f} | {found['auc']:.3f} | {found['calibration_error']:.3f} | "
        f"{found['success_cost']:.2f} | {found['failure_cost']:.2f}"
    )


def draw_times(found: Mapping[str, Any], file: Path) -> None:
    """Shares over passes through the views, a line for each task: minutes are those of a machine with other work."""
    names = [name for name in TIMES if name in found["variants"]]
    known = [found["variants"][name] for name in names]
    figure = new_figure(6.0, 3.4)
    axes = figure.add_subplot()
    for number in known[0]["tasks"] if known else ():
        rows = [_potlp(entry["tasks"][number]) for entry in known]
        axes.plot(
            [VARIANTS[name].epochs for name in names],
            [100 * row.attainable_share for row in rows],
            marker="o",
            label=f"task {number}",
        )
    axes.set_xlabel("passes through the views")
    axes.set_ylabel("share of the attainable savings, %")
    axes.legend(frameon=False)
    figure.subplots_adjust(bottom=0.16, top=0.96)
    save_figure(figure, file)
