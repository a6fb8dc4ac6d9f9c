"""The backup of best-first search: values, bounds and floors along a descent, from its leaf to the root.

It only writes. The descent has recorded what each of its nodes passes up as a function of the value of the outcome that
was followed (``descending.Path``), so that no node is read again.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from potlp_jax.planning.rounding import rounded_product
from potlp_jax.planning.search.descending import Descent, Path
from potlp_jax.planning.search.expanding import Leaf
from potlp_jax.planning.search.graph import Costs, NodeValues, Tree
from potlp_jax.planning.sharding import vary_alike


def back_up(tree: Tree, descent: Descent, leaf: Leaf) -> Tree:
    """From the leaf to the root: Q, bound and floor of the actions taken, and what their nodes pass up.

    Args:
      tree: the graphs, with the nodes of ``expanding.expand``.
      descent: of all rows; those that took no action are left as they are.
      leaf: what the descent ended at.

    Returns:
      The graphs; a leaf that has a node is linked to the node from which the descent left the graph.
    """
    rows = jnp.arange(tree.size.shape[0], dtype=jnp.int32)

    def ascend(carry):
        level, after, tree = carry
        step = jax.tree.map(lambda records: records[level], descent.path)
        # Rows with a shorter descent wait at their leaf until the level of their last action.
        taken = step.nodes < tree.capacity
        action = jax.tree.map(lambda base, after: base + rounded_product(step.weight, after), step.base, after)
        values = _with_action(step, action)

        def arrive(after: Array, leave: Array, stay: Array) -> Array:
            return jnp.where(taken, jnp.minimum(step.pending_cost + leave, stay), after)

        after = jax.tree.map(arrive, after, values.leave, values.stay)

        # One node per row, so that no index occurs twice.
        def write(array: Array, new: Array, *index: Array) -> Array:
            return array.at[rows, step.nodes, *index].set(new, mode="drop", unique_indices=True)

        tree = dataclasses.replace(
            tree,
            q_values=write(tree.q_values, action.value, step.actions),
            bounds=write(tree.bounds, action.bound, step.actions),
            floors=write(tree.floors, action.floor, step.actions),
            values=write(tree.values, values.pack()),
        )
        return level - 1, after, tree

    start = (descent.level - 1, leaf.costs, tree)
    tree = jax.lax.while_loop(lambda carry: carry[0] >= 0, ascend, vary_alike(start))[2]
    # Link the child last, to the node that the descent left the graph from.
    parent = jnp.where(leaf.child == Tree.UNVISITED, tree.capacity, descent.node)
    at = (rows, parent, descent.action, descent.success.astype(jnp.int32))
    return dataclasses.replace(tree, children=tree.children.at[at].set(leaf.child, mode="drop", unique_indices=True))


def _with_action(step: Path, action: Costs) -> NodeValues:
    """What a node passes up once the action taken there costs this; ``step`` is one level of a path."""
    # The other kind of action is as it was; a descent touches one action of a node.
    before = NodeValues.unpack(step.values)
    least = jax.tree.map(jnp.minimum, step.rival, action)

    def of_kind(taken: Bool[Array, "B"], before: Costs) -> Costs:
        return jax.tree.map(lambda new, old: jnp.where(taken, new, old), least, before)

    return NodeValues(
        leave=of_kind(~step.inside, before.leave),
        stay=of_kind(step.inside, before.stay),
        visits=before.visits + 1.0,
    )


def count_descent(tree: Tree, descent: Descent) -> Tree:
    """Count the descent and its actions, in the rows that took one.

    Args:
      tree: the graphs.
      descent: of all rows.

    Returns:
      The graphs with ``root_visits``, ``simulations`` and ``steps`` renewed.
    """
    rows, first = jnp.arange(tree.size.shape[0], dtype=jnp.int32), descent.path.nodes[0]
    moved = first < tree.capacity
    # An index behind the last action: the write is dropped.
    action = jnp.where(moved, descent.path.actions[0], tree.root_visits.shape[1])
    return dataclasses.replace(
        tree,
        root_visits=tree.root_visits.at[rows, action].add(1, mode="drop", unique_indices=True),
        simulations=tree.simulations + moved.astype(jnp.int32),
        steps=tree.steps + jnp.sum(descent.path.nodes < tree.capacity, axis=0, dtype=jnp.int32),
    )
