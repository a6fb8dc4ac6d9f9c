"""Names shared by every package: array dimensions, sentinels and status bits.

Glossary of the dimension names in jaxtyping annotations. ``tests/test_types.py`` compares it with the package: every
name that is used stands here, and no other. A name with a ``1`` at its end has one entry more than the name without
(``S1`` is ``S + 1``). Names behind a star, such as ``*batch``, are not listed: they stand for any number of axes.

=============================  ======================================================================================
Grid
H, W                           rows and columns of the grid; row 0 is the top row, a cell is (row, column)
H2, W2                         the same with a margin of one cell on each side
two_h, two_w                   ``2 H - 1`` and ``2 W - 1``: differences between the coordinates of two cells
h, w, h2, w2                   rows and columns of an image file or a map file, in pixels; the same once grown
cells, real                    cells of the grid, counted row by row; ``real`` without the dummy entry at the end
capacity, block                entries of a list of cells; entries that are handled at once
lines, steps                   lines of sight, or lines of the grid; cells along a line, a ray or a path
side, entries                  lines of one side of a square, or pixels of a disc; entries of a table of maxima

Task
Z                              states of the task automaton (DFA)
L                              letters, ``2 ** P``; bit ``i`` of a letter is proposition ``i``; in learning, lanes: a
                               subgoal and what to stay away from
P                              propositions
E                              edges (z', z'') of the automaton that a high-level action can attempt
C                              outcome classes (stay, cube): what an estimator is asked for
M                              conditions: the C classes first, then the conditions that several cubes make up
K                              cubes of a condition, at most; in training, samples of one view

Planning
S, S1                          subgoals; location ``S`` of a planning problem is the robot's own cell
A                              actions, ``S * E + 1``: ``s * E + e``, and last the finish action
N                              nodes of a search graph, or any number of things of one kind
NZ                             nodes times states
B                              rows of a batch
D                              depth: actions of one simulation
R                              rows of a batch of problems whose guesses are computed together
V                              words of a bit set over product states; in learning, panoramas in memory
n                              flags, or words of a packed row
slots                          entries of a hash table
Q, T                           sources and targets of distances
shared, lanes                  Q, or 1 where all sources share the entry; Q
active, keys, ends             cells where the automaton's state can change; with the sources; with the targets
to                             states that a move may lead to
horizon1                       product states of a path: its moves and the source

Pictures and estimators
rows, columns                  of a panorama; a column is a bearing
G, views, worlds               views of a training batch; views and worlds of a data set
F                              features of a position in a panorama
feature_rows, feature_columns  rows and columns of a panorama's features
bands, columns_out             bands of rows of a panorama; columns of a result where they are fewer
patch_rows, patch_columns      rows and columns of the patch around a subgoal
packed, pixels                 bands as channels; values of a patch in one vector
k                              samples chosen from more
of_way, of_goal                numbers that describe a way beyond a subgoal, and one to a proposition
U, layers                      units of a layer; layers whose units phi scales and shifts
=============================  ======================================================================================

Costs are ``float32`` in the unit of ``World.resolution`` (cells where it is 1). Unreachable is ``inf``.
Masks are True where an entry is real, False where it is padding.
"""

import functools
import operator
from collections.abc import Iterable
from enum import IntFlag

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Integer, UInt32

UNREACHABLE: float = float("inf")
"""Cost of what cannot be reached."""

NO_STATE: int = -1
"""Entry of a transition table where the move does not exist (obstacle, unobserved cell, trap state)."""

NO_CLASS: int = -1
"""Padding of a condition's list of outcome classes."""

NO_SUBGOAL: int = -1
"""Cell that belongs to no kept subgoal."""

NO_ACTION: int = -1
"""Index of the chosen action where there is none (accepting root, dead end or invalid input, told apart in
``status``)."""


StateLike = Integer[Array, ""] | Integer[np.ndarray, ""] | int | np.integer
"""A state of the automaton as callers may give it: a whole number of any type."""

CellLike = Integer[Array, "2"] | Integer[np.ndarray, "2"] | tuple[StateLike, StateLike]
"""A cell, likewise."""


class Status(IntFlag):
    """Sticky bits that every padded producer ORs into its ``status``; zero means that nothing was lost.

    No array is truncated silently: evaluation counts trials with a bit apart (``sweep.statistics``).
    """

    # Rows of results hold these numbers, so they do not change; 32 is not used.
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
    FALLBACK = 64
    """No action was available; the robot went to the nearest frontier that violates nothing (liveness)."""
    NO_FRONTIER = 128
    """No action, no finish and no frontier that can be reached without violation."""
    VIEW_OVERFLOW = 256
    """The memory of panoramas was full; one was dropped that still showed a frontier."""
    INVALID = 512
    """An input held a value that the model does not allow, such as an estimate that is NaN: nothing was planned with
    it."""


def status_names(status: int) -> tuple[str, ...]:
    """The bits that are set, by name: what people and programs are shown instead of a number."""
    return tuple(str(flag.name).lower() for flag in Status(status))


def status_of(names: Iterable[str]) -> int:
    """The bits of names that ``status_names`` gave. Raises KeyError for a name that is none."""
    return int(functools.reduce(operator.or_, (Status[name.upper()] for name in names), Status.OK))


def status_array(status: Status = Status.OK) -> UInt32[Array, ""]:
    """The bits as a device scalar."""
    # Through numpy: a Python integer would become int32, and strict dtype promotion refuses to mix the two.
    return jnp.asarray(np.uint32(int(status)))


def status_if(condition: Array, status: Status) -> UInt32[Array, ""]:
    """``status`` where ``condition`` holds, otherwise no bits; works under jit and vmap."""
    return jnp.where(condition, np.uint32(int(status)), np.uint32(0))
