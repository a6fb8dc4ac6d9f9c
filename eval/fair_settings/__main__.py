"""A fair opponent: the settings that are best for each policy, chosen on validation worlds.

    python -m eval.fair_settings firefighting --policies baseline --worlds 60 --out out/fair
    python -m eval.fair_settings delivery --policies baseline,potlp --worlds 60 --out out/fair
    python -m eval.fair_settings --out out/fair --report docs/results/fair_settings     # what is finished so far

Every policy runs in the same worlds with every combination of

- the frontier rule: the fewest cells of a frontier that is a subgoal while larger ones remain (``min_size``),
- the replanning distance: cells after which a changed map is worth a new decision (``replan_distance``),
- the commitment of policies that search: by what fraction another action must be cheaper (``commitment``).

A trial that is not satisfied is charged its budget, as in sweeps. The best setting has the least mean cost in the
worlds of the default. It runs beside the default in as many other worlds once more, and is chosen if the 95 % interval
of its difference to the default, paired by world, lies below 0 in both; otherwise the default is.
Rows are appended to ``rows.jsonl`` as trials end, and the same command goes on. ``--report`` writes NAME.json and the
page NAME.md; the former holds ``policy_settings`` of each family as a sweep's file takes them.
"""

import argparse
from pathlib import Path

from eval.fair_settings.confirming import confirm
from eval.fair_settings.report import write_report
from eval.fair_settings.running import run
from eval.fair_settings.settings import COMMITMENTS, DISTANCES, SIZES
from potlp_jax.cache import enable_compilation_cache
from potlp_jax.environments.registry import make
from potlp_jax.planning.policies import Policy


def _numbers(text: str) -> list[float]:
    return [float(part) for part in text.split(",") if part]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("environment", nargs="?", help="family of worlds; without it nothing is run")
    parser.add_argument("--policies", default=Policy.BASELINE.value, help="names, joined by commas")
    parser.add_argument("--worlds", type=int, default=60)
    parser.add_argument("--estimator", help="what potlp asks; default: the shipped one")
    parser.add_argument("--min-sizes", type=_numbers, default=list(SIZES))
    parser.add_argument("--replan-distances", type=_numbers, default=list(DISTANCES))
    parser.add_argument("--commitments", type=_numbers, default=list(COMMITMENTS))
    parser.add_argument("--out", type=Path, required=True, help="folder of the rows")
    parser.add_argument("--report", type=Path, help="NAME of NAME.json and NAME.md")
    arguments = parser.parse_args()
    enable_compilation_cache()
    if arguments.environment is not None:
        sizes = [int(size) for size in arguments.min_sizes]
        values = (sizes, arguments.replan_distances, arguments.commitments)
        policies = arguments.policies.split(",")
        family, worlds, asked = make(arguments.environment), arguments.worlds, arguments.estimator
        run(family, policies, worlds, arguments.out, values, asked)
        confirm(family, policies, worlds, arguments.out, asked)
    if arguments.report is not None:
        write_report(arguments.out, arguments.report)


if __name__ == "__main__":
    main()
