"""What campus buildings in training are good for: the delivery recipe's first stage without them.

    potlp fit --recipe delivery --out out/recipe --processes 2
    python -m eval.small_generator out/recipe --plans PLANS --out out/small --report out/small/arms

The recipe's first stage learns from the floors of ``delivery``, 40 × 68 m at most, and from some campus buildings of
the size and kind of real ones beside them. Here the same network learns in as many passes from as many buildings, all
of them such floors.
PO-TLP runs with both estimators in the same test worlds: generated floors, campus buildings, and real plans,
for which ``PLANS`` is a folder of folders. Shares and their differences are paired by world, intervals clustered by
building. The same command goes on where it was stopped. ``--report`` writes NAME.json.
"""

import argparse
import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eval.delivery import WITHOUT_ORACLE, building_of, groups
from eval.savings import audit, pairs_of, read_rows, sweep
from potlp_jax.codec import json_copy
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split
from potlp_jax.planning.policies import Policy
from potlp_jax.recipes.fitting import ESTIMATOR
from potlp_jax.recipes.recipe import Recipe, read_recipe
from potlp_jax.sweep.rows import provenance
from potlp_jax.sweep.statistics import attainable_interval, attainable_share
from potlp_jax.sweep.store import Row

RECIPE = "delivery"
CAMPUS, SMALL = "campus", "small"
"""The arms: the recipe's first stage as it is, and without campus buildings."""

_POTLP = (sys.executable, "-c", "from potlp_jax.cli import main; main()")


def without_campus(recipe: Recipe) -> Recipe:
    """The first stage of a recipe, with further worlds of its own family in place of those beside them."""
    per_shard = recipe.collect.worlds_per_shard
    instead = sum(beside.worlds(recipe.training_worlds, per_shard) for beside in recipe.beside)
    return dataclasses.replace(recipe, training_worlds=recipe.training_worlds + instead, beside=(), rounds=())


def fit_small(out: Path, processes: int) -> Path:
    """The file of the estimator that knows the small floors alone; what is missing is collected and fitted."""
    folder = out / "fit"
    if not (folder / ESTIMATOR).is_file():
        file = out / "recipe.yaml"
        file.parent.mkdir(parents=True, exist_ok=True)
        # JSON is YAML.
        file.write_text(json.dumps(json_copy(dataclasses.asdict(without_campus(read_recipe(RECIPE))))))
        words = ("fit", "--recipe", str(file), "--out", str(folder), "--processes", str(processes))
        if subprocess.run([*_POTLP, *words], stdout=subprocess.DEVNULL, check=False).returncode:
            raise SystemExit(f"potlp {' '.join(words)} failed; what is finished is kept in {folder}")
    return folder / ESTIMATOR


def run_arm(folder: Path, environment: str, estimator: Path, worlds: int, processes: int) -> list[Row]:
    """Trials of the first task of a family with an estimator, in its first test worlds."""
    specification = {
        "environments": [environment],
        "tasks": [1],
        "policies": WITHOUT_ORACLE,
        "worlds": worlds,
        "split": Split.TEST.value,
        "estimator": str(estimator),
    }
    sweep(folder, specification, processes)
    return read_rows(folder)


def compare(environment: str, arms: Mapping[str, Sequence[Row]]) -> dict[str, Any]:
    """Both arms over the worlds in which all their trials ended satisfied.

    Args:
        environment: of all rows.
        arms: the rows of each, in the same worlds.

    Returns:
        ``worlds``, ``buildings``, ``mean_cost`` by policy and arm, ``share`` by arm and ``gain``, what campus buildings
        add to the share: each with the ends of its 95 % interval; and ``problems`` of the audit.
    """
    generator = make(environment)
    found = {arm: pairs_of(rows, WITHOUT_ORACLE) for arm, rows in arms.items()}
    worlds = sorted(set.intersection(*(set(pairs) for pairs in found.values())))
    _, clusters = np.unique([str(building_of(generator, world)) for world in worlds], return_inverse=True)
    cost = {
        (arm, policy): np.array([pairs[world][policy] for world in worlds])
        for arm, pairs in found.items()
        for policy in WITHOUT_ORACLE
    }
    baseline, known = cost[CAMPUS, Policy.BASELINE], cost[CAMPUS, Policy.KNOWN_MAP]

    def with_interval(ours: np.ndarray) -> list[float]:
        return [
            attainable_share(ours, baseline, known),
            *attainable_interval(ours, baseline, known, clusters=clusters),
        ]

    ours = {arm: cost[arm, Policy.POTLP] for arm in arms}
    means = {"known-map": known, "baseline": baseline, **ours}
    return {
        "worlds": len(worlds),
        "buildings": len(set(clusters.tolist())),
        "mean_cost": {name: float(values.mean()) for name, values in means.items()},
        "share": {arm: with_interval(values) for arm, values in ours.items()},
        "gain": with_interval(baseline - (ours[SMALL] - ours[CAMPUS])),
        "audited": sum(len(rows) for rows in arms.values()),
        "problems": [problem for rows in arms.values() for problem in audit(rows, generator, Split.TEST)],
        "commits": sorted({row.commit for rows in arms.values() for row in rows}),
    }


def markdown(found: Mapping[str, Mapping[str, Any]]) -> str:
    """The table as it stands in docs/results."""
    lines = [
        "| test worlds | number | known map | baseline | with campus buildings | small floors alone | campus buildings "
        "bring, points |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, group in found.items():
        means = [f"{group['mean_cost'][policy]:.0f}" for policy in ("known-map", "baseline")]
        shares = [_percent(group["share"][arm], "") + " %" for arm in (CAMPUS, SMALL)]
        number = f"{group['worlds']} in {group['buildings']} buildings"
        lines.append(f"| {name} | {number} | {' | '.join(means + shares)} | {_percent(group['gain'], '+')} |")
    return "\n".join(lines)


def _percent(value: Sequence[float], sign: str) -> str:
    share, low, high = (100 * part for part in value)
    return f"{share:{sign}.1f} ({low:{sign}.0f} to {high:{sign}.0f})"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recipe", type=Path, help="folder that potlp fit --recipe delivery wrote")
    parser.add_argument("--plans", type=Path, help="folder with folders of floor plans")
    parser.add_argument("--out", type=Path, required=True, help="folder of the fit and of the sweeps")
    parser.add_argument("--worlds", type=int, default=60, help="test worlds of each group")
    parser.add_argument("--only", nargs="+", metavar="GROUP", help="of generated floors, plans by folder and campus")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--report", type=Path, metavar="NAME", help="without suffix: where the results go")
    options = parser.parse_args()
    campus = options.recipe / "round-0" / ESTIMATOR
    if not campus.is_file():
        parser.error(f"{campus} is missing: name the folder that `potlp fit --recipe delivery --out` wrote")
    beside = {one.environment: one.environment for one in read_recipe(RECIPE).beside}
    every = {**groups(options.plans), **beside}
    if unknown := set(options.only or ()) - every.keys():
        parser.error(f"there is no group {', '.join(sorted(unknown))}; there are {', '.join(every)}")
    estimators = {CAMPUS: campus, SMALL: fit_small(options.out, options.processes)}
    found = {}
    for name, environment in every.items():
        if options.only and name not in options.only:
            continue
        arms = {
            arm: run_arm(options.out / arm / name, environment, file, options.worlds, options.processes)
            for arm, file in estimators.items()
        }
        found[name] = compare(environment, arms)
        print(f"{name}: {found[name]['audited']} trials, {len(found[name]['problems'])} problems", flush=True)
    print(markdown(found))
    if options.report is not None:
        results = {"provenance": provenance(), "groups": found}
        options.report.with_suffix(".json").write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
