"""Estimators beside each other: what each saves in the same worlds, how good its answers are, what it took to make.

    python -m eval.estimators --recipe out/building --out out/estimators                 # after every stage of a recipe
    python -m eval.estimators --named panorama=firefighting-panorama --out out/estimators --data out/building/validation

Every estimator has a sweep of its own in ``--out``, with known map, baseline and PO-TLP in the same worlds and
settings; the same command goes on. Worlds are of the split validation, from number 1000 on, which no recipe uses.
``--recipe`` takes the folder of a recipe that was followed (``potlp fit --recipe``): the estimator of every stage, with
the minutes up to it from ``times.csv``. ``--data`` is a data set on which the skill of all of them is measured.
``--report`` writes NAME.json and, where there are minutes, NAME.png: shares over minutes of collecting and fitting.
"""

import argparse
import csv
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from eval.savings import compare_first, figures, policy_row, read_rows, sweep
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split
from potlp_jax.learning.dataset import Samples
from potlp_jax.learning.dataset_reading import read_dataset
from potlp_jax.learning.estimator import TrainedEstimator, named_estimator
from potlp_jax.learning.learners import learner_of
from potlp_jax.learning.metrics import evaluate, prior_of
from potlp_jax.learning.predictions import answerable, predict
from potlp_jax.planning.policies import Policy
from potlp_jax.recipes.fitting import ESTIMATOR
from potlp_jax.recipes.recipe import TIMES
from potlp_jax.sweep.rows import provenance
from potlp_jax.view.style import new_figure, save_figure

FIRST_WORLD = 1000
"""Recipes take validation worlds from 0 on, and no more than some hundreds."""

POLICIES = (Policy.KNOWN_MAP.value, Policy.BASELINE.value, Policy.POTLP.value)


def stages(folder: Path) -> dict[str, tuple[Path, float]]:
    """The estimators of a recipe that was followed, in order, each with the seconds up to it."""
    with (folder / TIMES).open(encoding="utf-8", newline="") as file:
        spent = [(int(stage), float(seconds)) for stage, _, seconds in csv.reader(file)]
    last = max(stage for stage, _ in spent)
    folders = [*(folder / f"round-{stage}" for stage in range(last)), folder]
    return {
        f"round {stage}": (where / ESTIMATOR, sum(seconds for number, seconds in spent if number <= stage))
        for stage, where in enumerate(folders)
    }


def skill(estimator: TrainedEstimator, samples: Samples) -> float:
    """Skill of an estimator's P_S on the samples that it can answer about."""
    learner = learner_of(estimator.config)
    samples = answerable(learner, samples)
    predictions = predict(learner, estimator.params, samples)
    return evaluate(samples, predictions, prior_of(estimator.metadata, samples)).overall.skill


def shares(file: Path, out: Path, environment: str, worlds: int, processes: int) -> dict[str, Any]:
    """PO-TLP's comparison in every task of the environment, with this estimator."""
    tasks = make(environment).tasks
    specification = {
        "environments": [environment],
        "tasks": list(tasks.values()),
        "policies": list(POLICIES),
        "worlds": worlds,
        "split": Split.VALIDATION.value,
        "first_world": FIRST_WORLD,
        # Names of shipped estimators are no files; files are named in full, wherever the sweep's file lies.
        "estimator": str(file.resolve()) if file.is_file() else str(file),
    }
    sweep(out, specification, processes)
    rows = read_rows(out)
    own = [row for row in rows if row.item.policy == Policy.POTLP]
    seconds = sum(row.seconds for row in own) / max(sum(row.decisions for row in own), 1)
    tables = {
        number: compare_first(rows, task, POLICIES, worlds, building=lambda world: world)
        for number, task in tasks.items()
    }
    return {"tables": tables, "seconds_per_decision": seconds}


def lines(found: Mapping[str, Any]) -> Iterator[str]:
    """The table in Markdown."""
    first = next(iter(found["estimators"].values()))
    tasks = first["tables"]
    yield f"| estimator | minutes | skill | {' | '.join(f'task {number}' for number in tasks)} | ms a decision |"
    yield "|---" * (len(tasks) + 4) + "|"
    for name, entry in found["estimators"].items():
        cells = [f"{figures(_potlp(table)).split(' | ')[0]}" for table in entry["tables"].values()]
        minutes = "" if entry["minutes"] is None else f"{entry['minutes']:.0f}"
        skilled = "" if entry["skill"] is None else f"{entry['skill']:.3f}"
        yield f"| {name} | {minutes} | {skilled} | {' | '.join(cells)} | {1000 * entry['seconds_per_decision']:.0f} |"


def _potlp(table: Mapping[str, Any]) -> Any:
    return policy_row(next(entry for entry in table["satisfied"]["rows"] if entry["policy"] == Policy.POTLP))


def draw(found: Mapping[str, Any], file: Path) -> None:
    """Shares of the attainable savings over the minutes that an estimator took."""
    timed = [entry for entry in found["estimators"].values() if entry["minutes"] is not None]
    figure = new_figure(6.4, 4.2)
    axes = figure.add_subplot()
    for number in timed[0]["tables"]:
        rows = [_potlp(entry["tables"][number]) for entry in timed]
        middle = [100 * row.attainable_share for row in rows]
        below = [100 * (row.attainable_share - row.attainable_low) for row in rows]
        above = [100 * (row.attainable_high - row.attainable_share) for row in rows]
        minutes = [entry["minutes"] for entry in timed]
        axes.errorbar(minutes, middle, yerr=(below, above), marker="o", capsize=3, label=f"task {number}")
    axes.set_xlabel("minutes of collecting and fitting")
    axes.set_ylabel("share of the attainable savings, %")
    axes.set_xlim(left=0)
    axes.legend()
    save_figure(figure, file)


def _asked(named: Sequence[str], recipe: Path | None) -> dict[str, tuple[Path, float | None]]:
    asked: dict[str, tuple[Path, float | None]] = {}
    for entry in named:
        name, separator, file = entry.partition("=")
        if not separator:
            raise SystemExit(f"--named {entry}: give NAME=ESTIMATOR")
        asked[name] = (Path(file), None)
    return asked | ({} if recipe is None else stages(recipe))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--named", action="append", default=[], metavar="NAME=ESTIMATOR", help="may be repeated")
    parser.add_argument("--recipe", type=Path, help="folder of a recipe that was followed")
    parser.add_argument("--environment", default="firefighting")
    parser.add_argument("--worlds", type=int, default=60, help="per task")
    parser.add_argument("--data", type=Path, help="data set on which the skill is measured")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, required=True, help="folder of the sweeps")
    parser.add_argument("--report", type=Path, help="NAME of NAME.json and NAME.png")
    arguments = parser.parse_args()
    samples = None if arguments.data is None else read_dataset(arguments.data)
    found: dict[str, Any] = {"provenance": provenance(), "environment": arguments.environment, "estimators": {}}
    for name, (file, seconds) in _asked(arguments.named, arguments.recipe).items():
        estimator = named_estimator(file)
        if not isinstance(estimator, TrainedEstimator):
            raise SystemExit(f"--named {name}={file}: only estimators of files can be compared")
        folder = arguments.out / name.replace(" ", "-")
        found["estimators"][name] = {
            "identity": estimator.identity,
            "minutes": None if seconds is None else seconds / 60,
            "skill": None if samples is None else skill(estimator, samples),
            **shares(file, folder, arguments.environment, arguments.worlds, arguments.processes),
        }
    if not found["estimators"]:
        raise SystemExit("name estimators: --named NAME=ESTIMATOR, or --recipe FOLDER")
    print("\n".join(lines(found)))
    if arguments.report is not None:
        arguments.report.parent.mkdir(parents=True, exist_ok=True)
        arguments.report.with_suffix(".json").write_text(json.dumps(found, indent=1) + "\n")
        if any(entry["minutes"] is not None for entry in found["estimators"].values()):
            draw(found, arguments.report.with_suffix(".png"))


if __name__ == "__main__":
    main()
