"""Settings of the searches: the type of the configuration says which search runs.

Each has a ``kind`` that says the same as text, for records and settings files: ``{kind: uct, simulations: 1000}``.
"""

import dataclasses
from typing import Literal

from potlp_jax.checks import COUNT, NOT_NEGATIVE, SHARE, as_python_numbers


@dataclasses.dataclass(frozen=True)
class BestFirstConfig:
    """Settings of best-first search on bounds (``search.best_first``), the default; deterministic.

    Attributes:
      simulations: descents per search; each adds at most one node. The search ends earlier once it has proven its value
        to be the optimum.
      optimism: fraction by which guessed values, apart from what dead ends cost in them, are assumed to be too high:
        the descent takes the action that would be best if they all were. Once nothing is left to examine under this
        assumption, the search goes on as if all guesses were 0, so that one that ends by itself is exact. The default
        is tuned on problems that no result uses (docs/results/planner.md, "How optimistic?").
      max_depth: actions per descent. A descent that gets there is cut, valued by what is known of its last node, and
        flagged.
      tree_capacity: nodes per tree, at least 1; None for one more than simulations. A full tree is flagged.
      guess_failures: failures in a row that the guess at outcomes without a node follows; a dead end counts after them.
      kind: ``best-first``.
    """

    simulations: int = 300
    optimism: float = 0.5
    max_depth: int = 64
    tree_capacity: int | None = None
    guess_failures: int = 24
    kind: Literal["best-first"] = "best-first"

    def __post_init__(self) -> None:
        _check_kind(self, "best-first")
        _check_counts(self, "simulations", "max_depth", "tree_capacity", "guess_failures")
        if not SHARE.allows(self.optimism):
            raise ValueError(f"BestFirstConfig.optimism is {self.optimism}, must lie in [0, 1]")
        as_python_numbers(self)

    @property
    def capacity(self) -> int:
        """Nodes per tree."""
        return self.simulations + 1 if self.tree_capacity is None else self.tree_capacity

    @property
    def slots(self) -> int:
        """Slots of the hash table of nodes: a power of two, at most half of them taken."""
        return 1 << max(self.capacity * 2 - 1, 1).bit_length()


@dataclasses.dataclass(frozen=True)
class UctConfig:
    """Settings of PO-UCT, the paper's search (``search.uct``).

    Attributes:
      simulations: sampled rollouts per search; each adds at most one node. PO-UCT has no criterion to end earlier, and
        needs more of them than best-first search: 1,000 to 100,000 for a mean regret near 1 %
        (docs/results/planner.md).
      exploration: weight of the exploration term, a cost: a rollout takes the least
        ``Q - exploration * sqrt(log(n) / n_a)``. The code of Bradley et al. uses 50.
      max_depth: actions per rollout. A rollout that gets there is cut, costs nothing beyond its last node, and is
        flagged.
      tree_capacity: nodes per tree, at least 1; None for one more than simulations. A full tree is flagged.
      kind: ``uct``.
    """

    simulations: int = 1000
    exploration: float = 50.0
    max_depth: int = 32
    tree_capacity: int | None = None
    kind: Literal["uct"] = "uct"

    def __post_init__(self) -> None:
        _check_kind(self, "uct")
        _check_counts(self, "simulations", "max_depth", "tree_capacity")
        # With infinity no action would look better than another, and the first one would be taken again and again.
        if not NOT_NEGATIVE.allows(self.exploration):
            raise ValueError(f"UctConfig.exploration is {self.exploration}, must be finite and not negative")
        as_python_numbers(self)

    @property
    def capacity(self) -> int:
        """Nodes per tree."""
        return self.simulations + 1 if self.tree_capacity is None else self.tree_capacity


def _check_kind(config: BestFirstConfig | UctConfig, kind: str) -> None:
    # A wrong kind would be written to records, and read back as another search.
    if config.kind != kind:
        raise ValueError(f"{type(config).__name__}.kind is {config.kind!r}, must be {kind!r}")


def _check_counts(config: BestFirstConfig | UctConfig, *names: str) -> None:
    for name in names:
        value = getattr(config, name)
        if not (COUNT.allows(value) or (value is None and name == "tree_capacity")):
            raise ValueError(f"{type(config).__name__}.{name} is {value}, must be {COUNT.wanted}")
