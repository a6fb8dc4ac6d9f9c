"""The choice: each setting against the default, paired by world."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from eval.fair_settings.running import CONFIRMING, Row, read_rows
from eval.fair_settings.settings import Setting, changes_of
from eval.limit.rows import charged
from potlp_jax.environments.splits import Split
from potlp_jax.errors import ConfigurationError
from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.rows import provenance
from potlp_jax.sweep.statistics import UNRELIABLE
from potlp_jax.trials.record import Outcome

RESAMPLES: int = 10_000


def compare(rows: Sequence[Row], possible: set[tuple[str, int]]) -> dict[str, Any]:
    """The settings of one policy in one family, each against the default in the worlds that both have finished.

    Args:
        rows: of the policy, with all settings.
        possible: tasks and worlds in which the known map suffices to satisfy the task.

    Returns:
        JSON-able: ``settings``, by difference to the default; the ``default``; the ``best`` of those that have as many
        trials as the default, none of which was cut short; ``confirmed``: its figures in the worlds that did not choose
        it, None where it has not run there; the one that is ``chosen``; the default's ``trials`` and ``worlds``.
    """
    if len(estimators := {row["estimator"] for row in rows}) > 1:
        raise ConfigurationError(
            f"{rows[0]['policy']} in {rows[0]['environment']} was run with several estimators, "
            f"{', '.join(sorted(map(str, estimators)))}: give each a folder of its own"
        )
    found = _by_setting([row for row in rows if row["world"] < CONFIRMING], possible)
    others = _by_setting([row for row in rows if row["world"] >= CONFIRMING], possible)
    default = next(_setting(row) for row in rows if row["is_default"])
    compared = [_against(setting, own, found[default]) for setting, own in found.items()]
    # Equal costs: the default, which nobody has to explain.
    compared.sort(key=lambda entry: (entry["difference"], entry["setting"] != list(default)))
    trials = len(found[default])
    best = next(entry for entry in compared if entry["trials"] == trials)
    first = _as_setting(best["setting"])
    again = others.get(first, {}).keys() & others.get(default, {}).keys()
    confirmed = _against(first, others[first], others[default]) if again else None
    better = best["high"] < 0 and confirmed is not None and confirmed["high"] < 0
    return {
        "default": list(default),
        "best": best["setting"],
        "confirmed": confirmed,
        "chosen": best["setting"] if better else list(default),
        "trials": trials,
        "worlds": len({world for _, world in found[default]}),
        "settings": compared,
    }


def _by_setting(rows: Sequence[Row], possible: set[tuple[str, int]]) -> dict[Setting, dict[tuple[str, int], Row]]:
    found: dict[Setting, dict[tuple[str, int], Row]] = {}
    for row in rows:
        # Of a trial that was cut short nobody knows what it would have cost.
        if (row["task"], row["world"]) in possible and not row["status"] & UNRELIABLE:
            found.setdefault(_setting(row), {})[row["task"], row["world"]] = row
    return found


def _against(
    setting: Setting, own: Mapping[tuple[str, int], Row], default: Mapping[tuple[str, int], Row]
) -> dict[str, Any]:
    """The figures of a setting in the worlds that it shares with the default."""
    pairs = sorted(own.keys() & default.keys())
    costs = np.array([charged(own[pair]) for pair in pairs])
    usual = np.array([charged(default[pair]) for pair in pairs])
    low, high = interval(costs - usual, np.array([world for _, world in pairs]))
    return {
        "setting": list(setting),
        "trials": len(pairs),
        "mean_cost": float(costs.mean()),
        "default_cost": float(usual.mean()),
        "difference": float((costs - usual).mean()),
        "low": low,
        "high": high,
        "unsatisfied": sum(own[pair]["outcome"] != Outcome.SATISFIED for pair in pairs),
    }


def _setting(row: Row) -> Setting:
    return _as_setting(row["setting"])


def _as_setting(values: Sequence[Any]) -> Setting:
    size, distance, commitment = values
    return size, distance, commitment


def interval(
    differences: Float64[np.ndarray, " B"], worlds: np.ndarray, resamples: int = RESAMPLES
) -> tuple[float, float]:
    """95 % bootstrap percentile interval of the mean; all tasks of a world are drawn together.

    Args:
        differences: one for each trial, at least one.
        worlds: the number of its world.
        resamples: how many.

    Returns:
        Lower and upper end.
    """
    _, index = np.unique(worlds, return_inverse=True)
    sums, counts = np.bincount(index, differences), np.bincount(index)
    drawn = np.random.default_rng(0).integers(0, len(sums), (resamples, len(sums)))
    means = sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


def results(folder: Path) -> dict[str, Any]:
    """What is finished, by family and policy, with the settings that were chosen."""
    rows = read_rows(folder)
    families: dict[str, Any] = {}
    for name in sorted({row["environment"] for row in rows}):
        own = [row for row in rows if row["environment"] == name]
        possible = {
            (row["task"], row["world"])
            for row in own
            if row["policy"] == Policy.KNOWN_MAP and row["outcome"] == Outcome.SATISFIED
        }
        policies = [policy for policy in dict.fromkeys(row["policy"] for row in own) if policy != Policy.KNOWN_MAP]
        compared = {policy: compare([row for row in own if row["policy"] == policy], possible) for policy in policies}
        families[name] = {
            "tasks": sorted({row["task"] for row in own}),
            "estimators": sorted({row["estimator"] for row in own if row["estimator"]}),
            "policies": compared,
            "policy_settings": {policy: _chosen_changes(entry) for policy, entry in compared.items()},
        }
    commits = sorted({row["commit"] for row in rows})
    return {"provenance": provenance(), "commits": commits, "split": Split.VALIDATION.value, "families": families}


def _chosen_changes(compared: Mapping[str, Any]) -> dict[str, Any]:
    return changes_of(_as_setting(compared["chosen"]))


def chosen_settings(file: Path, family: str) -> dict[str, Any]:
    """``policy_settings`` of a sweep over a family, from a report's JSON."""
    return json.loads(file.read_text("utf-8"))["families"][family]["policy_settings"]
