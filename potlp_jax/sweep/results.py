"""What a store holds, paired: the same worlds for every policy."""

from collections.abc import Hashable, Mapping, Sequence

from potlp_jax.sweep.statistics import Comparison, TrialResult
from potlp_jax.sweep.store import Row

Pair = Mapping[str, Row]
"""The rows of one world by policy."""


def pair_rows(rows: Sequence[Row], policies: Sequence[str]) -> list[Pair]:
    """The worlds in which every policy has a row, by number. A pair is there for all policies or for none."""
    by_world: dict[int, dict[str, Row]] = {}
    for row in rows:
        by_world.setdefault(row.item.world, {})[row.item.policy] = row
    return [
        {policy: found[policy] for policy in policies}
        for _, found in sorted(by_world.items())
        if all(policy in found for policy in policies)
    ]


def compare_pairs(
    pairs: Sequence[Pair], policies: Sequence[str], clusters: Sequence[Hashable] | None = None
) -> Comparison:
    """The paired comparison (docs/model.md, section 8). ``clusters`` names, for each pair, what it shares with others,
    such as its building."""
    results = {policy: [_result(pair[policy]) for pair in pairs] for policy in policies}
    return Comparison.from_results(results, clusters=clusters)


def _result(row: Row) -> TrialResult:
    return TrialResult(cost=row.cost, outcome=row.outcome, budget=row.budget, status=row.status)
