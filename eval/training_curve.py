"""What an estimator is worth over the time of its making: the stages of a recipe that was followed.

    potlp fit --recipe delivery --out out/recipe --processes 2
    python -m eval.training_curve out/recipe --environment delivery --worlds 100 --out out/curve \
        --report docs/results/delivery/curve

Each stage of the recipe left an estimator. PO-TLP runs with each in the same test worlds, which choose nothing; the
page says what share of the attainable savings it keeps, after how many minutes of collecting and fitting from nothing.
In between the picture has the skill after each epoch, on the validation data of the stage: those differ between stages,
so that only points of one stage can be compared. Rows are kept: the same command goes on where it was stopped.
"""

import argparse
import csv
import dataclasses
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from eval.limit.arms import REFERENCES, Arm, Experiment
from eval.limit.report import results_of
from eval.limit.rows import ROWS
from eval.limit.running import own_rows, run
from potlp_jax.cache import enable_compilation_cache
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split
from potlp_jax.errors import EvaluationError
from potlp_jax.learning.estimator import named_estimator
from potlp_jax.recipes.fitting import ESTIMATOR
from potlp_jax.recipes.journal import TABLE
from potlp_jax.recipes.times import TIMES, read_times
from potlp_jax.sweep.rows import provenance
from potlp_jax.view.style import new_figure, save_figure

ARMS = (*REFERENCES, Arm.POTLP)


@dataclasses.dataclass(frozen=True)
class Stage:
    """One stage of a recipe.

    Attributes:
        folder: with its estimator and the table of its fit.
        collected: seconds from nothing until its fit began.
        ended: seconds from nothing until its fit ended.
    """

    folder: Path
    collected: float
    ended: float

    def skills(self) -> list[tuple[float, float]]:
        """Minutes from nothing, and the skill on the stage's validation data, after each epoch."""
        with (self.folder / TABLE).open(newline="") as file:
            rows = list(csv.DictReader(file))
        return [((self.collected + float(row["seconds"])) / 60, float(row["validation_skill"])) for row in rows]


def stages_of(recipe: Path) -> list[Stage]:
    """The finished stages of a recipe's folder, in order.

    Raises:
        EvaluationError: the folder holds no stage that ended.
    """
    file = recipe / TIMES
    if not file.is_file():
        raise EvaluationError(f"{recipe} has no {TIMES}: name the folder that `potlp fit --recipe NAME --out` wrote")
    seconds = read_times(file)
    rounds = sorted(recipe.glob("round-*"), key=lambda folder: int(re.sub(r"\D", "", folder.name)))
    stages, before = [], 0.0
    for number, folder in enumerate([*rounds, recipe]):
        collected = before + sum(spent for (stage, step), spent in seconds.items() if stage == number and step != "fit")
        before = collected + seconds.get((number, "fit"), 0.0)
        if (folder / ESTIMATOR).is_file():
            stages.append(Stage(folder, collected, before))
    if not stages:
        raise EvaluationError(f"{recipe} has no {ESTIMATOR}: let the recipe's first stage end")
    return stages


def measured(stage: Stage, environment: str, worlds: int, out: Path) -> dict[str, Any]:
    """What the stage's estimator keeps in the first test worlds."""
    generator = make(environment)
    experiment = Experiment(
        generator=generator,
        split=Split.TEST,
        tasks=tuple(generator.tasks),
        given=named_estimator(str(stage.folder / ESTIMATOR)),
        buildings=0,
    )
    file = out / ROWS
    run(file, experiment, ARMS, worlds)
    formulas = {name: experiment.padded[name][0].text for name in experiment.tasks}
    found = results_of(own_rows(file, experiment, ARMS), formulas)
    return {
        "minutes": stage.ended / 60,
        "collecting": stage.collected / 60,
        "skills": stage.skills(),
        "tasks": {name: _share(table) for name, table in found["tables"].items()},
        "audited": found["audited"],
        "problems": found["problems"],
        "commits": found["commits"],
    }


def _share(table: Mapping[str, Any]) -> dict[str, Any]:
    row = next(entry for entry in table["satisfied"]["rows"] if entry["policy"] == Arm.POTLP)
    return {"pairs": table["satisfied"]["pairs"]} | {
        name: row[name] for name in ("attainable_share", "attainable_low", "attainable_high")
    }


def markdown(stages: Sequence[Mapping[str, Any]]) -> str:
    """The table: a row for each stage."""
    tasks = list(stages[0]["tasks"])
    head = "".join(f" task {task} (95 %) |" for task in tasks)
    lines = [
        f"| stage | minutes from nothing | skill, its own validation data |{head}",
        "|---|---|---|" + "---|" * len(tasks),
    ]
    for number, stage in enumerate(stages):
        cells = "".join(f" {_told(stage['tasks'][task])} |" for task in tasks)
        lines.append(f"| {number} | {stage['minutes']:.0f} | {max(skill for _, skill in stage['skills']):.3f} |{cells}")
    return "\n".join(lines)


def _told(share: Mapping[str, Any]) -> str:
    value, low, high = (100 * share[name] for name in ("attainable_share", "attainable_low", "attainable_high"))
    return f"{value:.1f} % ({low:.0f} to {high:.0f})"


def draw(stages: Sequence[Mapping[str, Any]], file: Path) -> None:
    """Shares after each stage, and the skill after each epoch, over minutes from nothing."""
    figure = new_figure(8.0, 3.6)
    left, right = figure.subplots(1, 2)
    figure.subplots_adjust(left=0.08, right=0.98, bottom=0.14, top=0.97, wspace=0.25)
    last = stages[-1]["minutes"]
    for place, task in enumerate(stages[0]["tasks"]):
        # Side by side: intervals of tasks would hide each other.
        minutes = [stage["minutes"] + 0.01 * last * place for stage in stages]
        shares = [stage["tasks"][task] for stage in stages]
        values = [100 * share["attainable_share"] for share in shares]
        below = [value - 100 * share["attainable_low"] for value, share in zip(values, shares, strict=True)]
        above = [100 * share["attainable_high"] - value for value, share in zip(values, shares, strict=True)]
        left.errorbar(minutes, values, yerr=[below, above], marker="o", capsize=3, label=f"task {task}")
    for number, stage in enumerate(stages):
        right.plot(*zip(*stage["skills"], strict=True), marker="o", label=f"stage {number}")
    left.set_ylabel("share of the attainable savings, %")
    right.set_ylabel("skill, the stage's validation data")
    left.set_ylim(0, 100)
    right.set_ylim(0, 1)
    for axes in (left, right):
        axes.set_xlabel("minutes from nothing")
        axes.set_xlim(0, 1.1 * last)
        axes.legend(loc="lower left")
    save_figure(figure, file)


def main() -> None:
    """Command line."""
    enable_compilation_cache()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recipe", type=Path, help="folder that potlp fit --recipe wrote")
    parser.add_argument("--environment", required=True, help="family of the test worlds")
    parser.add_argument("--worlds", type=int, default=100, help="per task")
    parser.add_argument("--out", type=Path, required=True, help="folder of the rows")
    parser.add_argument("--report", type=Path, help="without suffix: where the results and the picture go")
    options = parser.parse_args()
    try:
        found = [
            measured(stage, options.environment, options.worlds, options.out) for stage in stages_of(options.recipe)
        ]
    except EvaluationError as error:
        parser.error(str(error))
    print(markdown(found))
    if options.report is not None:
        results = {"provenance": provenance(), "environment": options.environment, "stages": found}
        options.report.with_suffix(".json").write_text(json.dumps(results, indent=1) + "\n", "utf-8")
        draw(found, options.report.with_suffix(".png"))


if __name__ == "__main__":
    main()
