"""Paired statistics of policies over the same worlds (docs/model.md, section 8).

Costs are in units of resolution. A pair - one world with one trial of every policy - is dropped for all policies or
for none. The savings tables are host objects: nothing here is traced.
"""

import dataclasses
import math
import warnings
from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64
from scipy.stats import DegenerateDataWarning, bootstrap

from potlp_jax.codec import finite_or_null
from potlp_jax.types import Status

BASELINE = "baseline"
KNOWN_MAP = "known-map"
SATISFIED = "satisfied"

LOSSES: Status = Status.SUBGOAL_OVERFLOW | Status.TREE_OVERFLOW | Status.DEPTH_OVERFLOW
"""Status bits by which a fixed-size array or loop took something away from a trial; they are counted."""

UNRELIABLE: Status = Status.TREE_OVERFLOW | Status.DEPTH_OVERFLOW
"""Losses after which a trial is not what its planner would have done. It is never averaged in. (That only the nearest
subgoals are kept is part of the model, docs/model.md section 6.)"""

CONFIDENCE: float = 0.95
RESAMPLES: int = 9_999


@dataclasses.dataclass(frozen=True)
class TrialResult:
    """What the statistics need of one trial. ``budget`` is the cost at which the trial would have been given up."""

    cost: float
    outcome: str
    budget: float
    status: int = 0


@dataclasses.dataclass(frozen=True)
class PolicyRow:
    """One policy's figures; what is undefined (nothing to attain, fewer than two pairs, no pair) is NaN.

    ``attainable_share`` is the share of the attainable savings, (Σ baseline − Σ ours) / (Σ baseline − Σ known map),
    with its bootstrap interval ``attainable_low`` .. ``attainable_high``; ``net_savings`` is 1 − Σ ours / Σ baseline;
    ``trial_savings`` is the mean of 1 − ours / baseline, with the standard error of that mean. Interval and error take
    clusters of trials to be independent, not the trials in them.
    """

    policy: str
    attainable_share: float
    attainable_low: float
    attainable_high: float
    net_savings: float
    trial_savings: float
    trial_savings_error: float
    mean_cost: float


@dataclasses.dataclass(frozen=True)
class Table:
    """The rows of all policies over the same ``pairs`` worlds; ``dropped`` worlds were left out for all of them."""

    pairs: int
    dropped: int
    rows: tuple[PolicyRow, ...]


@dataclasses.dataclass(frozen=True)
class Comparison:
    """The paired comparison.

    ``satisfied`` has the worlds in which every policy ended satisfied, without an ``UNRELIABLE`` bit;
    ``charged`` has all worlds, with a trial that did not end satisfied charged its budget. ``outcomes`` counts the
    ends of trials per policy, ``losses`` the trials per policy and status bit of ``LOSSES``.
    """

    worlds: int
    satisfied: Table
    charged: Table
    outcomes: Mapping[str, Mapping[str, int]]
    losses: Mapping[str, Mapping[str, int]]

    @classmethod
    def from_results(
        cls,
        results: Mapping[str, Sequence[TrialResult]],
        *,
        clusters: Sequence[Hashable] | None = None,
        resamples: int = RESAMPLES,
        seed: int = 0,
    ) -> "Comparison":
        """Compare the policies that are the keys of ``results``; entry ``i`` of each is its trial in world ``i``.

        ``clusters[i]`` names what world ``i`` shares with others, such as its building; None: every world is by itself.

        Raises ValueError where the baseline or the known map is missing, or the policies have unequally many trials.
        """
        _check(results)
        cluster = _numbered(clusters, len(results[BASELINE]))
        costs = {policy: np.array([trial.cost for trial in trials], float) for policy, trials in results.items()}
        budgets = {policy: np.array([trial.budget for trial in trials], float) for policy, trials in results.items()}
        ended = {
            policy: np.array([trial.outcome == SATISFIED for trial in trials], bool)
            for policy, trials in results.items()
        }
        lost = [np.array([trial.status & UNRELIABLE != 0 for trial in trials], bool) for trials in results.values()]
        kept = np.all(list(ended.values()), axis=0) & ~np.any(lost, axis=0)
        charged = {policy: np.where(ended[policy], costs[policy], budgets[policy]) for policy in results}
        return cls(
            worlds=len(kept),
            satisfied=_table(
                {policy: values[kept] for policy, values in costs.items()}, cluster[kept], len(kept), resamples, seed
            ),
            charged=_table(charged, cluster, len(kept), resamples, seed),
            outcomes={policy: _count([trial.outcome for trial in trials]) for policy, trials in results.items()},
            losses={policy: _count_losses(trials) for policy, trials in results.items()},
        )

    def to_dict(self) -> dict[str, Any]:
        """JSON-able values; undefined figures become None."""
        return finite_or_null(dataclasses.asdict(self))


def attainable_share(
    ours: Float64[np.ndarray, "*B"], baseline: Float64[np.ndarray, "*B"], known_map: Float64[np.ndarray, "*B"]
) -> float:
    """Share of the attainable savings over the given trials; NaN where the baseline leaves nothing to attain."""
    return float(_share(ours, baseline, known_map))


def attainable_interval(
    ours: Float64[np.ndarray, " B"],
    baseline: Float64[np.ndarray, " B"],
    known_map: Float64[np.ndarray, " B"],
    *,
    clusters: Int64[np.ndarray, " B"] | None = None,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> tuple[float, float]:
    """95 % paired bootstrap percentile interval of ``attainable_share``; NaNs where it is undefined.

    ``clusters`` numbers what is resampled as a whole; None: each trial is.

    A resample that holds no attainable savings counts toward both tails: where more than a tail is made of such
    resamples there is no interval, rather than one that looks narrow because it ignores them.
    """
    if clusters is not None:
        # The share is a ratio of sums, so a cluster counts by the sums of its trials.
        ours, baseline, known_map = (np.bincount(clusters, values) for values in (ours, baseline, known_map))
        held = np.bincount(clusters) > 0
        ours, baseline, known_map = ours[held], baseline[held], known_map[held]
    if len(ours) < 2:
        return math.nan, math.nan
    with warnings.catch_warnings():
        # Resamples without attainable savings are told apart below, so SciPy need not warn of them.
        warnings.simplefilter("ignore", DegenerateDataWarning)
        result = bootstrap(
            (ours, baseline, known_map),
            _share,
            paired=True,
            vectorized=True,
            n_resamples=resamples,
            batch=max(1, 2_000_000 // len(ours)),
            method="percentile",
            rng=np.random.default_rng(seed),
        )
    shares = result.bootstrap_distribution
    tail = (1 - CONFIDENCE) / 2
    low = np.quantile(np.where(np.isnan(shares), -np.inf, shares), tail, method="lower")
    high = np.quantile(np.where(np.isnan(shares), np.inf, shares), 1 - tail, method="higher")
    if not (np.isfinite(low) and np.isfinite(high)):
        return math.nan, math.nan
    return float(low), float(high)


def _share(ours: np.ndarray, baseline: np.ndarray, known_map: np.ndarray, axis: int = -1) -> np.ndarray:
    attainable = baseline.sum(axis) - known_map.sum(axis)
    # Rounding of float32 costs must not pass for something to attain.
    some = attainable > 1e-6 * baseline.sum(axis)
    return np.where(some, (baseline.sum(axis) - ours.sum(axis)) / np.where(some, attainable, 1.0), np.nan)


def _table(
    costs: Mapping[str, np.ndarray], clusters: Int64[np.ndarray, " B"], worlds: int, resamples: int, seed: int
) -> Table:
    pairs = len(costs[BASELINE])
    rows = tuple(
        _row(policy, ours, costs[BASELINE], costs[KNOWN_MAP], clusters, resamples, seed)
        for policy, ours in costs.items()
    )
    return Table(pairs=pairs, dropped=worlds - pairs, rows=rows)


def _row(
    policy: str,
    ours: np.ndarray,
    baseline: np.ndarray,
    known_map: np.ndarray,
    clusters: Int64[np.ndarray, " B"],
    resamples: int,
    seed: int,
) -> PolicyRow:
    pairs = len(ours)
    low, high = attainable_interval(ours, baseline, known_map, clusters=clusters, resamples=resamples, seed=seed)
    # Where the baseline has nothing to walk, the task held at the start and nothing can be saved.
    savings = 1 - np.divide(ours, baseline, out=np.ones(pairs), where=baseline > 0)
    return PolicyRow(
        policy=policy,
        attainable_share=attainable_share(ours, baseline, known_map),
        attainable_low=low,
        attainable_high=high,
        net_savings=float(1 - ours.sum() / baseline.sum()) if baseline.sum() > 0 else math.nan,
        trial_savings=float(savings.mean()) if pairs else math.nan,
        trial_savings_error=_error_of_mean(savings, clusters),
        mean_cost=float(ours.mean()) if pairs else math.nan,
    )


def _error_of_mean(values: Float64[np.ndarray, " B"], clusters: Int64[np.ndarray, " B"]) -> float:
    """Standard error of the mean of values whose clusters are independent; NaN with fewer than two clusters.

    With a cluster for each value this is the usual one (Liang and Zeger 1986, with the factor for few clusters).
    """
    count = len(np.unique(clusters))
    if count < 2:
        return math.nan
    deviations = np.bincount(clusters, values - values.mean())
    return float(math.sqrt(count / (count - 1) * np.sum(deviations**2)) / len(values))


def _numbered(clusters: Sequence[Hashable] | None, count: int) -> Int64[np.ndarray, " B"]:
    if clusters is None:
        return np.arange(count)
    if len(clusters) != count:
        raise ValueError(f"{len(clusters)} clusters are named for {count} worlds; name one for each")
    numbers = {name: number for number, name in enumerate(dict.fromkeys(clusters))}
    return np.array([numbers[name] for name in clusters], np.int64)


def _check(results: Mapping[str, Sequence[TrialResult]]) -> None:
    missing = [policy for policy in (BASELINE, KNOWN_MAP) if policy not in results]
    if missing:
        raise ValueError(f"a paired comparison needs trials of {' and '.join(missing)}; add them to the policies")
    lengths = {policy: len(trials) for policy, trials in results.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"the policies have unequally many trials, so they are not paired: {lengths}")


def _count(names: Sequence[str]) -> dict[str, int]:
    return dict(sorted(Counter(str(name) for name in names).items()))


def _count_losses(trials: Sequence[TrialResult]) -> dict[str, int]:
    bits = [bit for trial in trials for bit in Status(trial.status & LOSSES)]
    return _count([str(bit.name).lower() for bit in bits])
