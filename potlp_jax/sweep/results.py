"""What a store holds, paired by world: the same worlds for every policy."""

import dataclasses
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

from potlp_jax.errors import StoreError
from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.statistics import SATISFIED, UNRELIABLE, Comparison, TrialResult
from potlp_jax.sweep.store import Item, Row, Store

Pair = Mapping[str, Row]
"""The rows of one world by policy."""


@dataclasses.dataclass(frozen=True)
class CellResults:
    """What is finished of one environment and task.

    Attributes:
        environment, task: as in the specification.
        pairs: the worlds that all policies have finished, by number.
        redrawn: worlds before the last of the pairs that were left out, because the task is impossible in them.
        comparison: the statistics of the pairs.
    """

    environment: str
    task: str
    pairs: Sequence[Pair]
    redrawn: int
    comparison: Comparison

    def to_dict(self) -> dict[str, Any]:
        """JSON-able values."""
        return {
            "environment": self.environment,
            "task": self.task,
            "world_numbers": [world_of(pair) for pair in self.pairs],
            "redrawn": self.redrawn,
            **self.comparison.to_dict(),
        }


@dataclasses.dataclass(frozen=True)
class Results:
    """What is finished of a sweep.

    Attributes:
        specification: as ``Specification.to_dict`` wrote it.
        cells: of each environment and task.
        given_up: trials that were given up, each with its error.
    """

    specification: Mapping[str, Any]
    cells: tuple[CellResults, ...]
    given_up: Mapping[Item, str]

    def to_dict(self) -> dict[str, Any]:
        """JSON-able values."""
        return {
            "specification": self.specification,
            "cells": [cell.to_dict() for cell in self.cells],
            "given_up": [{**dataclasses.asdict(item), "error": error} for item, error in sorted(self.given_up.items())],
        }


@dataclasses.dataclass(frozen=True)
class SweepStatus:
    """How far a sweep is.

    Attributes:
        done, total: trials that have rows, and all.
        broken: trials that were given up.
        of_policies: trials that have rows, by policy.
    """

    done: int
    total: int
    broken: int
    of_policies: Mapping[str, int]


def read_status(store: Store) -> SweepStatus:
    """How far a sweep is; reads no row."""
    specification, done = store.specification(), store.counts()
    policies = specification["policies"]
    return SweepStatus(
        done=sum(done.values()),
        total=len(specification["cells"]) * len(policies) * specification["worlds"],
        broken=len(store.broken()),
        of_policies={policy: done.get(policy, 0) for policy in policies},
    )


def read_results(store: Store) -> Results:
    """The results of a sweep, finished or not."""
    specification = store.specification()
    policies, cells = specification["policies"], []
    for cell in specification["cells"]:
        pairs = pair_rows(store.rows(cell["environment"], cell["task"]), policies)
        possible = store.possible(cell["environment"], cell["task"])
        # Beyond the last pair workers may have looked at worlds that the sweep does not need.
        last = world_of(pairs[-1]) if pairs else -1
        cells.append(
            CellResults(
                environment=cell["environment"],
                task=cell["task"],
                pairs=pairs,
                redrawn=sum(not is_possible for world, is_possible in possible.items() if world < last),
                comparison=compare_pairs(pairs, policies),
            )
        )
    return Results(specification, tuple(cells), store.broken())


def subject_of(policies: Sequence[str]) -> str:
    """The policy whose trials are looked at: PO-TLP where it took part, otherwise the last."""
    # Savings need another policy than the two they are measured between; of several the last named is on trial.
    return Policy.POTLP.value if Policy.POTLP.value in policies else policies[-1]


def world_of(pair: Pair) -> int:
    """The number of a pair's world."""
    # All rows of a pair are of one world.
    return next(iter(pair.values())).item.world


def pair_rows(rows: Sequence[Row], policies: Sequence[str]) -> list[Pair]:
    """The worlds in which every policy has a row, by number. A pair is there for all policies or for none.

    Raises:
        StoreError: the policies of a pair were not in the same world.
    """
    # Of an unfinished sweep some policies have no row yet in the last worlds; those worlds are not compared.
    by_world: dict[int, dict[str, Row]] = {}
    for row in rows:
        by_world.setdefault(row.item.world, {})[row.item.policy] = row
    pairs: list[Pair] = [
        {policy: found[policy] for policy in policies}
        for _, found in sorted(by_world.items())
        if all(policy in found for policy in policies)
    ]
    for pair in pairs:
        _require_one_world(pair)
    return pairs


def _require_one_world(pair: Pair) -> None:
    # Savings over different worlds would be numbers like any others.
    if len({row.world_digest for row in pair.values()}) > 1:
        item = next(iter(pair.values())).item
        raise StoreError(
            f"{item.environment}: world {item.world} was not the same for all policies: worlds are made from their key "
            "alone, without a random generator or a file that changes; mend that and begin in another folder"
        )


def remarks_on_given_up(given_up: Mapping[Item, str]) -> list[str]:
    """A line for each trial that was given up, with its error."""
    return [
        f"given up: {item.policy} in world {item.world} of {item.environment}, {item.task}: {error}"
        for item, error in sorted(given_up.items())
    ]


def remarks_on_worlds(pairs: Sequence[Pair]) -> list[str]:
    """One line where worlds of different numbers are the same one, so that intervals say nothing."""
    digests = {row.world_digest for pair in pairs for row in pair.values()}
    if len(pairs) < 2 or len(digests) > 1:
        return []
    return [f"All {len(pairs)} worlds are the same one, as on a map with a fixed start: they count as one, many times."]


def compare_pairs(
    pairs: Sequence[Pair], policies: Sequence[str], clusters: Sequence[Hashable] | None = None
) -> Comparison:
    """The paired comparison (docs/model.md, section 8).

    Args:
        pairs: worlds with the rows of at least these policies.
        policies: in the order of the comparison.
        clusters: names, for each pair, what it shares with others, such as its building; None: nothing.

    Returns:
        The comparison.
    """
    results = {policy: [_result(pair[policy]) for pair in pairs] for policy in policies}
    return Comparison.from_results(results, clusters=clusters)


def reliable_pairs(pairs: Sequence[Pair]) -> list[Pair]:
    """The pairs that figures may be made of: no trial of theirs has an ``UNRELIABLE`` bit."""
    return [pair for pair in pairs if not any(row.status & UNRELIABLE for row in pair.values())]


def charged_cost(row: Row) -> float:
    """What a trial counts for: its cost, or its budget where it did not end satisfied. Giving up is not cheap."""
    return row.cost if row.outcome == SATISFIED else row.budget


def _result(row: Row) -> TrialResult:
    return TrialResult(cost=row.cost, outcome=row.outcome, budget=row.budget, status=row.status)
