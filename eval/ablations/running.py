"""Runs what is missing, each step by the command that a user would give."""

import json
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from eval.ablations.variants import DATA_SETS, FAMILY, START, VARIANTS, Variant
from eval.savings import sweep
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split
from potlp_jax.planning.policies import Policy
from potlp_jax.recipes.fitting import ESTIMATOR

_POTLP = (sys.executable, "-c", "from potlp_jax.cli import main; main()")
SECONDS: str = "seconds.json"
"""In a fit's folder: how long it took, interruptions left out."""

POLICIES: tuple[str, ...] = (Policy.KNOWN_MAP.value, Policy.BASELINE.value, Policy.POTLP.value)


def collect(out: Path, name: str, processes: int) -> Path:
    """A data set, with the estimator that drives in it."""
    asked, folder = DATA_SETS[name], out / "data" / name
    settings = [*asked.settings, f"first_world={asked.first}"]
    if asked.driver is not None:
        estimator = fit(out, asked.driver, START, processes)
        settings += ["driver=potlp", f"estimator={estimator}"]
    _run(
        *("collect", FAMILY, "--split", asked.split, "--worlds", str(asked.worlds), "--out", str(folder)),
        *("--processes", str(processes), *_set(settings)),
    )
    return folder


def fit(out: Path, name: str, variant: Variant, processes: int) -> Path:
    """The file of an estimator; what it is fitted to is collected first."""
    folder = out / "fits" / name
    if not (folder / ESTIMATOR).is_file():
        data = [str(collect(out, of, processes)) for of in variant.data]
        choosing = str(collect(out, "choosing", processes))
        began = time.perf_counter()
        _run(
            *("fit", *data, "--validation", choosing, "--out", str(folder), "--epochs", str(variant.epochs)),
            *_set(variant.network),
        )
        (folder / SECONDS).write_text(json.dumps(time.perf_counter() - began))
    return folder / ESTIMATOR


def evaluate(out: Path, name: str, estimator: Path, views: Mapping[str, Path]) -> None:
    """Answers on each of the data sets ``views``."""
    for of, dataset in views.items():
        folder = out / "answers" / name / of
        if not (folder / "evaluation.json").is_file():
            _run("estimator", "evaluate", str(estimator), str(dataset), "--out", str(folder))


def trials(out: Path, name: str, estimator: str, worlds: int, first: int, processes: int) -> None:
    """Trials of all tasks in the same worlds."""
    specification: dict[str, Any] = {
        "environments": [FAMILY],
        "tasks": [int(task) for task in make(FAMILY).tasks],
        "policies": list(POLICIES),
        "worlds": worlds,
        "split": Split.VALIDATION.value,
        "first_world": first,
        "estimator": estimator,
    }
    sweep(out / "trials" / name, specification, processes)


def run(out: Path, views: Mapping[str, Path], worlds: int, first: int, processes: int, only: Sequence[str]) -> None:
    """Each variant that is named, to its end, and the shipped estimator beside them.

    Args:
        out: folder of everything; the same call goes on there.
        views: data sets to evaluate on, by name.
        worlds, first: of the split validation, for trials.
        processes: for collections and trials.
        only: names of ``VARIANTS``.
    """
    for name in only:
        estimator = fit(out, name, VARIANTS[name], processes)
        evaluate(out, name, estimator, views)
        trials(out, name, str(estimator), worlds, first, processes)
        print(f"{name}: done", flush=True)
    trials(out, "shipped", FAMILY, worlds, first, processes)


def _set(settings: Sequence[str]) -> list[str]:
    return [word for setting in settings for word in ("--set", setting)]


def _run(*words: str) -> None:
    if subprocess.run([*_POTLP, *words], stdout=subprocess.DEVNULL, check=False).returncode:
        raise SystemExit(f"potlp {' '.join(words)} failed; what is finished is kept")
