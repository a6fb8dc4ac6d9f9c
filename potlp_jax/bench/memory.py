"""What a search will take, from shapes alone: nothing is allocated or compiled."""

import dataclasses
import math

import jax

from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.api import search_tree
from potlp_jax.planning.search.config import BestFirstConfig, UctConfig


@dataclasses.dataclass(frozen=True)
class TreeMemory:
    """Bytes of one search tree, by array; a batch of B takes B times as much.

    Attributes:
      arrays: bytes of each array of the tree, by its name.
      nodes: capacity of the tree.
    """

    arrays: dict[str, int]
    nodes: int

    @property
    def total(self) -> int:
        """Bytes of the whole tree."""
        return sum(self.arrays.values())

    @property
    def per_node(self) -> float:
        """Bytes that one more node of capacity takes."""
        return self.total / self.nodes


def tree_memory(problem: PlanningProblem, config: BestFirstConfig | UctConfig) -> TreeMemory:
    """Memory of the tree that searching one problem of this shape with this configuration fills.

    Args:
      problem: an unbatched problem; only its shapes matter.
      config: settings of the search; ``simulations`` and ``tree_capacity`` decide.

    Returns:
      Bytes by array.
    """

    def fields_of_tree(problem: PlanningProblem) -> dict[str, jax.Array]:
        _, tree = search_tree(problem, jax.random.key(0), config)
        return {field.name: getattr(tree, field.name) for field in dataclasses.fields(tree)}

    # Shapes are followed through the search without running it. The key needs no values either.
    fields = jax.eval_shape(fields_of_tree, problem)
    arrays = {name: math.prod(field.shape) * field.dtype.itemsize for name, field in fields.items()}
    return TreeMemory(arrays=arrays, nodes=config.capacity)
