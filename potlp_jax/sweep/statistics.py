"""Paired statistics of policies over the same worlds (docs/model.md, section 8).

Costs are in the unit of the resolution. A pair is one world with one trial of every policy; it is dropped for all
policies or for none. The savings tables are host objects: nothing here is traced.

References:
  Liang and Zeger, Longitudinal data analysis using generalized linear models, Biometrika 1986 (errors by clusters).
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
from potlp_jax.types import Status, status_names

# Names as rows hold them. The enumerations that define them (`planning.policies`, `trials.record`) load the planner,
# which statistics of finished trials do not need.
BASELINE = "baseline"
KNOWN_MAP = "known-map"
SATISFIED = "satisfied"

UNRELIABLE: Status = Status.TREE_OVERFLOW | Status.DEPTH_OVERFLOW | Status.INVALID
"""Status bits after which a trial is not what its planner would have done: it is never averaged in. (That only the
nearest subgoals are kept is part of the model, docs/model.md section 6.)"""

CONFIDENCE: float = 0.95
# 10,000 less one: the ends of the interval are then the 250th resample from either side.
RESAMPLES: int = 9_999

# Numbers that SciPy draws at once: three float64 arrays of this many entries take 48 MB.
_DRAWN_AT_ONCE: int = 2_000_000

# Attainable savings below this share of the baseline's cost are rounding: costs are sums of float32 moves.
_NOTHING: float = 1e-6


@dataclasses.dataclass(frozen=True)
class TrialResult:
    """What the statistics need of one trial.

    Attributes:
        cost: what it travelled.
        outcome: the name of how it ended.
        budget: the cost at which it would have been given up, which an unsatisfied trial is charged.
        status: ``Status`` bits.
    """

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
    ``charged`` has all worlds without such a bit, with a trial that did not end satisfied charged its budget.
    ``outcomes`` counts the ends of trials per policy, ``flagged`` the trials per policy and status bit, by its name.
    """

    worlds: int
    satisfied: Table
    charged: Table
    outcomes: Mapping[str, Mapping[str, int]]
    flagged: Mapping[str, Mapping[str, int]]

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

        Args:
            results: the trials of each policy, all in the same order of worlds.
            clusters: ``clusters[i]`` names what world ``i`` shares with others, such as its building; None: every world
                is independent of the others.
            resamples: of the bootstrap.
            seed: of the bootstrap.

        Returns:
            The comparison, policies in the order of ``results``.

        Raises:
            ValueError: the baseline or the known map is missing, or the policies have unequally many trials.
        """
        _check(results)
        bootstrapped = _Bootstrap(_numbered(clusters, len(results[BASELINE])), resamples, seed)
        costs = {policy: np.array([trial.cost for trial in trials], float) for policy, trials in results.items()}
        budgets = {policy: np.array([trial.budget for trial in trials], float) for policy, trials in results.items()}
        ended = {
            policy: np.array([trial.outcome == SATISFIED for trial in trials], bool)
            for policy, trials in results.items()
        }
        # One policy's full tree drops the world for all: otherwise policies would be compared over different worlds.
        unreliable = [
            np.array([trial.status & UNRELIABLE != 0 for trial in trials], bool) for trials in results.values()
        ]
        reliable = ~np.any(unreliable, axis=0)
        kept = np.all(list(ended.values()), axis=0) & reliable
        # Giving up must not look cheap, so that a trial that stopped early is charged all that it might have spent.
        charged = {policy: np.where(ended[policy], costs[policy], budgets[policy]) for policy in results}
        return cls(
            worlds=len(kept),
            satisfied=_table(
                {policy: values[kept] for policy, values in costs.items()}, bootstrapped.of(kept), len(kept)
            ),
            charged=_table(
                {policy: values[reliable] for policy, values in charged.items()}, bootstrapped.of(reliable), len(kept)
            ),
            outcomes={policy: _count([trial.outcome for trial in trials]) for policy, trials in results.items()},
            flagged={
                policy: _count([name for trial in trials for name in status_names(trial.status)])
                for policy, trials in results.items()
            },
        )

    def to_dict(self) -> dict[str, Any]:
        """JSON-able values; undefined figures become None."""
        return finite_or_null(dataclasses.asdict(self))


def attainable_share(
    ours: Float64[np.ndarray, "*B"], baseline: Float64[np.ndarray, "*B"], known_map: Float64[np.ndarray, "*B"]
) -> float:
    """Share of the attainable savings over the given trials (docs/model.md, section 8).

    Args:
        ours: costs of a policy, a world an entry.
        baseline: costs of the baseline in the same worlds.
        known_map: costs with the map known, the least possible.

    Returns:
        (Σ baseline - Σ ours) / (Σ baseline - Σ known map); NaN where the baseline leaves nothing to attain.
    """
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
    """95 % paired bootstrap percentile interval of ``attainable_share``.

    A resample that holds no attainable savings counts toward both tails: where more than a tail is made of such
    resamples there is no interval, rather than one that looks narrow because it ignores them.

    Args:
        ours: costs of a policy, a world an entry.
        baseline: costs of the baseline in the same worlds.
        known_map: costs with the map known.
        clusters: numbers what is resampled as a whole; None: each world is.
        resamples: how many.
        seed: of the draws.

    Returns:
        Lower and upper end; NaNs where there is no interval.
    """
    if clusters is not None:
        # The share is a ratio of sums, so a cluster counts by the sums of its trials.
        ours, baseline, known_map = (np.bincount(clusters, values) for values in (ours, baseline, known_map))
        held = np.bincount(clusters) > 0
        ours, baseline, known_map = ours[held], baseline[held], known_map[held]
    if len(ours) < 2:
        return math.nan, math.nan
    with warnings.catch_warnings():
        # Resamples without attainable savings are handled below, so SciPy need not warn of them.
        warnings.simplefilter("ignore", DegenerateDataWarning)
        result = bootstrap(
            (ours, baseline, known_map),
            _share,
            paired=True,
            vectorized=True,
            n_resamples=resamples,
            batch=max(1, _DRAWN_AT_ONCE // len(ours)),
            method="percentile",
            rng=np.random.default_rng(seed),
        )
    shares = result.bootstrap_distribution
    tail = (1 - CONFIDENCE) / 2
    # "lower" and "higher" return resamples: between an infinity and a number there is nothing to interpolate.
    low = np.quantile(np.where(np.isnan(shares), -np.inf, shares), tail, method="lower")
    high = np.quantile(np.where(np.isnan(shares), np.inf, shares), 1 - tail, method="higher")
    if not (np.isfinite(low) and np.isfinite(high)):
        return math.nan, math.nan
    return float(low), float(high)


def _share(ours: np.ndarray, baseline: np.ndarray, known_map: np.ndarray, axis: int = -1) -> np.ndarray:
    attainable = baseline.sum(axis) - known_map.sum(axis)
    some = attainable > _NOTHING * baseline.sum(axis)
    # The inner `where` keeps the division quiet where its result is not taken.
    return np.where(some, (baseline.sum(axis) - ours.sum(axis)) / np.where(some, attainable, 1.0), np.nan)


@dataclasses.dataclass(frozen=True)
class _Bootstrap:
    """How intervals are made: the number of each world's cluster, the resamples and their seed."""

    clusters: Int64[np.ndarray, " B"]
    resamples: int
    seed: int

    def of(self, kept: np.ndarray) -> "_Bootstrap":
        """For the worlds of a mask."""
        return dataclasses.replace(self, clusters=self.clusters[kept])


def _table(costs: Mapping[str, np.ndarray], bootstrapped: _Bootstrap, worlds: int) -> Table:
    pairs = len(costs[BASELINE])
    rows = tuple(_row(policy, costs, bootstrapped) for policy in costs)
    return Table(pairs=pairs, dropped=worlds - pairs, rows=rows)


def _row(policy: str, costs: Mapping[str, np.ndarray], bootstrapped: _Bootstrap) -> PolicyRow:
    ours, baseline, known_map = costs[policy], costs[BASELINE], costs[KNOWN_MAP]
    pairs, clusters = len(ours), bootstrapped.clusters
    # The same seed for every policy: their intervals come from the same resamples, so that they can be compared.
    low, high = attainable_interval(
        ours, baseline, known_map, clusters=clusters, resamples=bootstrapped.resamples, seed=bootstrapped.seed
    )
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
    # Deviations within a cluster are added before they are squared: what its worlds share does not average out.
    deviations = np.bincount(clusters, values - values.mean())
    return float(math.sqrt(count / (count - 1) * np.sum(deviations**2)) / len(values))


def _numbered(clusters: Sequence[Hashable] | None, count: int) -> Int64[np.ndarray, " B"]:
    if clusters is None:
        return np.arange(count)
    if len(clusters) != count:
        raise ValueError(f"{len(clusters)} clusters are named for {count} worlds; name one for each")
    # In order of first appearance, so that the draws do not depend on how clusters are named.
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
