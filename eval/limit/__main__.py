"""How much of the attainable savings estimates could bring, and which estimate costs what.

    python -m eval.limit --out out/limit                             # fire-fighting, 16 test worlds a task
    python -m eval.limit --out out/limit --estimator FILE --report docs/results/limit
    python -m eval.limit --out out/limit --environment delivery --arms true-chances true-costs potlp oracle
    python -m eval.limit --out out/limit --report docs/results/limit --as-it-is

Beside known map and baseline the planner runs with the answers of the true map (``oracle``), of an ideal observer, of a
trained estimator (``potlp``), and with one part of the trained estimator's answers replaced by the truth
(``true-chances``: P_S, ``true-costs``: R_S and R_F). Rows are appended to a file of JSON lines; the same command goes
on where it was stopped, also with another estimator or more worlds. ``--report`` writes NAME.json and NAME.md.
"""

import argparse
import json
from pathlib import Path

from eval.limit.arms import REFERENCES, Arm, Experiment
from eval.limit.report import markdown, page, results_of
from eval.limit.rows import ROWS
from eval.limit.running import own_rows, run
from potlp_jax.cache import enable_compilation_cache
from potlp_jax.environments.firefighting import Firefighting
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split
from potlp_jax.learning.estimator import named_estimator


def main() -> None:
    enable_compilation_cache()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the rows")
    parser.add_argument("--environment", default=Firefighting.name)
    parser.add_argument("--tasks", nargs="+", help="default: all that the family has by number")
    parser.add_argument("--split", type=Split, default=Split.TEST)
    parser.add_argument("--worlds", type=int, default=16, help="per task")
    parser.add_argument("--estimator", help="file or name of the trained estimator; default: the shipped one")
    parser.add_argument("--buildings", type=int, default=16, help="that the ideal observer draws at a decision")
    parser.add_argument("--arms", nargs="+", type=Arm, choices=list(Arm), metavar="ARM", help="default: all there are")
    parser.add_argument("--report", type=Path, help="without suffix: where the results and the page go")
    parser.add_argument("--as-it-is", action="store_true", help="report what is finished, run nothing")
    options = parser.parse_args()
    generator = make(options.environment)
    experiment = Experiment(
        generator=generator,
        split=options.split,
        tasks=tuple(options.tasks or generator.tasks),
        given=None if options.estimator is None else named_estimator(options.estimator),
        buildings=options.buildings,
    )
    chosen = experiment.arms if options.arms is None else options.arms
    if not set(chosen) <= set(experiment.arms):
        parser.error(f"{generator.name}: an ideal observer needs a family that says what its worlds can be")
    if options.report is not None and Arm.POTLP not in chosen:
        parser.error("a report compares with potlp: name it among the arms, or use eval.limit.beside")
    file, arms = options.out / ROWS, [arm for arm in Arm if arm in (*chosen, *REFERENCES)]
    if not options.as_it_is:
        run(file, experiment, arms, options.worlds)
    formulas = {name: experiment.padded[name][0].text for name in experiment.tasks}
    rows = own_rows(file, experiment, arms)
    if not rows:
        raise SystemExit(f"{options.out}: nothing is finished yet")
    results = results_of(rows, formulas)
    print(markdown(results))
    print("\n".join(results["problems"]))
    if options.report is not None:
        data = options.report.with_suffix(".json")
        data.write_text(json.dumps(results, indent=1) + "\n", "utf-8")
        options.report.with_suffix(".md").write_text(page(results, data), "utf-8")


if __name__ == "__main__":
    main()
