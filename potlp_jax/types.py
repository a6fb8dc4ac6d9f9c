"""Names shared by every room: array dimensions, sentinels and status bits.

Dimension names (they appear in the jaxtyping annotations and mean the same thing everywhere):

====  ==========================================================================================
H, W  rows and columns of the grid; row 0 is the top row, a cell is ``(row, column)``
Z     states of the task automaton (DFA)
L     letters, ``2 ** n`` for ``n`` propositions; bit ``i`` of a letter is proposition ``i``
E     edges ``(z', z'')`` of the automaton that a high-level action can attempt
C     outcome classes ``(stay, cube)``: what an estimator is asked for
M     conditions: the C classes first, then the conditions that several cubes make up
K     cubes of a condition, at most
S     subgoals; node ``S`` of a planning problem is the robot's own cell
A     actions of a planning problem, ``S * E + 1``: ``s * E + e``, and last the finish action
B     batch
N     nodes of a search tree
====  ==========================================================================================

Costs are ``float32`` in the unit of ``World.resolution`` (cells where it is 1). Unreachable is ``inf``.
Masks are True where an entry is real, False where it is padding.
"""

from enum import IntFlag

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, UInt32

UNREACHABLE: float = float("inf")
"""Cost of what cannot be reached."""

NO_STATE: int = -1
"""Entry of a transition table where the move does not exist (obstacle, unobserved cell, trap state)."""

NO_CLASS: int = -1
"""Padding of a condition's list of outcome classes."""

NO_SUBGOAL: int = -1
"""Cell that belongs to no kept subgoal."""

NO_ACTION: int = -1
"""Index of the chosen action where there is none (accepting root or dead end, told apart in ``status``)."""


class Status(IntFlag):
    """Sticky bits that every padded producer ORs into its ``status``; zero means that nothing was lost."""

    OK = 0
    SUBGOAL_OVERFLOW = 1
    """More frontier components than the array of subgoals holds; the farthest were left out."""
    TREE_OVERFLOW = 2
    """The search tree was full; later simulations did not grow it."""
    DEPTH_OVERFLOW = 4
    """A simulation was cut at the depth limit and valued by the heuristic."""
    DEAD_END = 8
    """No action is available and the root is not accepting: the value is the dead-end cost."""
    ACCEPTING_ROOT = 16
    """The task is already satisfied: the value is zero."""
    NOT_CONVERGED = 32
    """An iteration reached its limit before its fixed point."""
    FALLBACK = 64
    """No action was available; the robot went to the nearest frontier that violates nothing (liveness)."""
    NO_FRONTIER = 128
    """No action, no finish and no frontier that can be reached without violation."""
    VIEW_OVERFLOW = 256
    """The memory of panoramas was full; one was dropped that still showed a frontier."""


def status_array(status: Status = Status.OK) -> UInt32[Array, ""]:
    """The bits as a device scalar."""
    return jnp.asarray(np.uint32(int(status)))


def status_if(condition: Array, status: Status) -> UInt32[Array, ""]:
    """``status`` where ``condition`` holds, else no bits; works under jit and vmap."""
    return jnp.where(condition, np.uint32(int(status)), np.uint32(0))
