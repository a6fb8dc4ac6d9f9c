"""True P_S, R_S and R_F of every (subgoal, outcome class), from the underlying map (docs/model.md section 6).

A path of subgoal ``s`` starts at ``s``. It passes through phases, which serve as automaton states of a product:

* PORCH: on the subgoal's own frontier or on known cells beside it,
* HIDDEN: in unobserved cells, entered from the porch,
* SEEN: back in observed space through another frontier, never through its own.

Every cell entered on the way carries a staying letter; the last one, from HIDDEN or SEEN or entered as the first
unobserved cell, carries a letter of the class's cube. Staying depends on the automaton's state alone, so that the
distances are solved once per (subgoal, state), for all classes of the state together.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32

from potlp_jax.native import by_platform, target
from potlp_jax.planning.distances.product import SOURCES_AT_ONCE, arrivals_per_source, distances_per_source
from potlp_jax.planning.estimates import Estimates
from potlp_jax.task.propositions import require_same_propositions
from potlp_jax.task.task import TaskArrays
from potlp_jax.types import NO_STATE
from potlp_jax.world.frontiers import Subgoals, frontier_cells
from potlp_jax.world.grid import BeliefMap, World
from potlp_jax.world.moves import dilate

# Phases of a path beyond a subgoal: still on the subgoal's own frontier, in what is not observed, or out again in what
# is. They are the states of the automaton with which distances are solved.
PORCH, HIDDEN, SEEN = range(3)

# How much longer than the shortest way to a class others may be that count beside it: times its length, and cells.
_DETOUR, _DETOUR_CELLS = 1.25, 4.0


@struct.dataclass(kw_only=True)
class TrueMapEstimator:
    """The oracle of docs/model.md section 8: estimates are the true labels of ``world``.

    Attributes:
        world: the true map.
        nearest: whether only subgoals count that are nearly the shortest way to a class (``nearest_ways``).
    """

    world: World
    nearest: bool = struct.field(pytree_node=False, default=False)

    def __call__(self, belief: BeliefMap, subgoals: Subgoals, task: TaskArrays) -> Estimates:
        return labels_in(self.world, belief, subgoals, task, nearest=self.nearest)


def labels_in(world: World, belief: BeliefMap, subgoals: Subgoals, task: TaskArrays, *, nearest: bool) -> Estimates:
    """``true_labels``, as they are or of the nearest ways alone.

    Args:
        world: the true map.
        belief: what the robot knows of it.
        subgoals: that are asked about.
        task: whose classes are asked about.
        nearest: whether only subgoals count that are nearly the shortest way to a class (``nearest_ways``).

    Returns:
        Labels of every real (subgoal, class).
    """
    labels = true_labels(world, belief, subgoals, task)
    return nearest_ways(labels, subgoals, world.resolution) if nearest else labels


def nearest_ways(labels: Estimates, subgoals: Subgoals, resolution: Float32[Array, ""]) -> Estimates:
    """Labels by which a subgoal leads to a class only where hardly any other is a shorter way to it.

    Through a dark room with a second door one gets to whatever lies beyond, and to a planner that takes attempts to be
    independent of each other thirty such rooms are thirty chances of what is one. So each place is left to the
    subgoals from which it is nearest: R_S at most a quarter and four cells above the least R_S of all for the class.

    Args:
        labels: of one building; R_S means something where P_S is above 0.
        subgoals: that they are of.
        resolution: side of a cell in the unit of cost.

    Returns:
        The labels with P_S = 0, and R_S the resolution, for all longer ways; R_F as it was.
    """
    leads = (labels.success_probability > 0) & subgoals.mask[:, None]
    least = jnp.min(jnp.where(leads, labels.success_cost, jnp.inf), axis=0, keepdims=True)
    kept = leads & (labels.success_cost <= _DETOUR * least + _DETOUR_CELLS * resolution)
    return dataclasses.replace(
        labels,
        success_probability=jnp.where(kept, labels.success_probability, 0.0),
        success_cost=jnp.where(kept, labels.success_cost, resolution),
    )


def true_labels(world: World, belief: BeliefMap, subgoals: Subgoals, task: TaskArrays) -> Estimates:
    """Labels of every real (subgoal, class); padded pairs have P_S = 0.

    P_S is 0 or 1. R_S is the shortest successful path from the subgoal (the resolution where P_S = 0), R_F the
    distance of the farthest unobserved cell that can be reached while staying, one way, 0 if there is none.

    Args:
        world: the true map.
        belief: what the robot knows of it.
        subgoals: of the belief, with masks.
        task: whose classes are asked, or a sheet of questions (``questions.question_sheet``).

    Returns:
        Costs in the world's unit.

    Raises:
        PropositionsError: world, belief and task are not over the same propositions.
    """
    require_same_propositions(task.propositions, world.propositions, knower="the true map")
    require_same_propositions(task.propositions, belief.propositions, knower="the belief")
    states = task.transitions.shape[0]
    stays = task.transitions == jnp.arange(states, dtype=jnp.int32)[:, None]
    # One state for each class, of those whose staying letters are the class's.
    same_stay = jnp.all(task.class_stay[:, None, :] == stays[None, :, :], axis=2)
    state_of_class = jnp.argmax(same_stay, axis=1)
    used = jnp.any((state_of_class[:, None] == jnp.arange(states)[None, :]) & task.class_mask[:, None], axis=0)
    # Pairs of a subgoal and a state: the distances of a pair answer for all classes with these staying letters.
    asked = subgoals.mask[:, None] & used[None, :]
    arrays = (world, belief, subgoals, asked, stays, task.class_go)
    success_cost, failure_cost = by_platform("labels", _searched_labels, _swept_labels, *arrays)
    success_cost = jnp.take_along_axis(success_cost, state_of_class[None, None, :], axis=1)[:, 0]
    reached = jnp.isfinite(success_cost) & task.class_mask[None, :]
    return Estimates(
        success_probability=reached.astype(jnp.float32),
        success_cost=jnp.where(reached, success_cost, world.resolution),
        failure_cost=failure_cost[:, state_of_class],
    )


def _searched_labels(
    world: World,
    belief: BeliefMap,
    subgoals: Subgoals,
    asked: Bool[Array, "S Z"],
    stays: Bool[Array, "Z L"],
    class_go: Bool[Array, "C L"],
) -> tuple[Float32[Array, "S Z C"], Float32[Array, "S Z"]]:
    """R_S (``inf`` where it fails) and R_F of every pair that is asked, in native code: one search a pair."""
    results = (
        jax.ShapeDtypeStruct((*asked.shape, class_go.shape[0]), jnp.float32),
        jax.ShapeDtypeStruct(asked.shape, jnp.float32),
    )
    call = jax.ffi.ffi_call(target("true_labels"), results, vmap_method="sequential")
    free = ~world.occupied
    way_back = frontier_cells(belief, jnp.ones_like(free))
    places = (subgoals.component, subgoals.cells)
    success_cost, failure_cost = call(
        free, world.letters, belief.unknown, way_back, *places, asked, stays, class_go, world.resolution
    )
    return success_cost, failure_cost


def _swept_labels(
    world: World,
    belief: BeliefMap,
    subgoals: Subgoals,
    asked: Bool[Array, "S Z"],
    stays: Bool[Array, "Z L"],
    class_go: Bool[Array, "C L"],
) -> tuple[Float32[Array, "S Z C"], Float32[Array, "S Z"]]:
    """As ``_searched_labels``, by sweeps: several pairs side by side."""
    count, states = asked.shape
    lanes = max(min(SOURCES_AT_ONCE, count * states), 1)
    # Real pairs first, so that padding costs nothing.
    real = asked.reshape(-1)
    order = jnp.argsort(~real, stable=True).astype(jnp.int32)
    chunks = -(-jnp.sum(real, dtype=jnp.int32) // lanes)
    missing = -(count * states) % lanes
    pairs, real = jnp.pad(order, (0, missing)), jnp.pad(real[order], (0, missing))

    def label(chunk, found):
        chosen, wanted = (jax.lax.dynamic_slice_in_dim(array, chunk * lanes, lanes) for array in (pairs, real))
        labels = _labels_of_lanes(world, belief, subgoals, class_go, stays, chosen // states, chosen % states, wanted)
        return jax.tree.map(
            lambda into, rows: jax.lax.dynamic_update_slice_in_dim(into, rows, chunk * lanes, axis=0), found, labels
        )

    nothing = (
        jnp.full((pairs.shape[0], class_go.shape[0]), jnp.inf, jnp.float32),
        jnp.zeros(pairs.shape[0], jnp.float32),
    )
    success_cost, failure_cost = jax.lax.fori_loop(0, chunks, label, nothing)
    # From the order of work to that of the pairs.
    back = jnp.argsort(order)
    return success_cost[back].reshape(count, states, -1), failure_cost[back].reshape(count, states)


def _labels_of_lanes(
    world: World,
    belief: BeliefMap,
    subgoals: Subgoals,
    class_go: Bool[Array, "C L"],
    stays: Bool[Array, "Z L"],
    subgoal: Int32[Array, " lanes"],
    state: Int32[Array, " lanes"],
    real: Bool[Array, " lanes"],
) -> tuple[Float32[Array, "lanes C"], Float32[Array, " lanes"]]:
    """R_S of every class (``inf`` where it fails) and R_F, for paths of some subgoals that stay in some states."""
    free = ~world.occupied
    staying = jnp.moveaxis(stays[:, world.letters][state], 0, -1) & free[:, :, None]
    hidden = belief.unknown[:, :, None]
    own = subgoals.component[:, :, None] == subgoal[None, None, :]
    porch = dilate(own) & ~hidden
    # Also a frontier that known space does not reach: a goal may have been seen across a gap, or through a fire.
    way_back = frontier_cells(belief, jnp.ones_like(free))[:, :, None] & ~own

    def enter(*ways: tuple[Bool[Array, "H W _"], int]) -> Int32[Array, "H W lanes"]:
        phase = jnp.full(staying.shape, NO_STATE, jnp.int32)
        for allowed, next_phase in ways:
            phase = jnp.where(allowed & staying, next_phase, phase)
        return phase

    # From each phase: where a path may go next. It never comes back to its own frontier, and once it has come out into
    # what is observed it stays there: coming out and going in again is another attempt.
    transitions = jnp.stack(
        [
            enter((porch, PORCH), (hidden, HIDDEN)),
            enter((hidden, HIDDEN), (way_back, SEEN)),
            enter((~hidden & ~own, SEEN)),
        ]
    )
    start = jnp.where(real, PORCH, NO_STATE).astype(jnp.int32)
    cost = distances_per_source(transitions, free, subgoals.cells[subgoal], start, world.resolution)

    # The last move of a success: where it may lead from each phase, whatever the letter.
    ends = (hidden, hidden | way_back, ~hidden & ~own)
    # The cost to enter a cell from the best neighbour, also a cell whose letter ends the stay: that is the success.
    arrival = arrivals_per_source(cost, free, world.resolution)
    last = jnp.min(jnp.stack([jnp.where(way, arrival[phase], jnp.inf) for phase, way in enumerate(ends)]), axis=0)

    def cheapest(go: Bool[Array, " L"]) -> Float32[Array, " lanes"]:
        return jnp.min(jnp.where((go[world.letters] & free)[:, :, None], last, jnp.inf), axis=(0, 1))

    # What a robot explores in vain: all unobserved cells that it can reach beyond the subgoal while it keeps the state.
    failure_cost = jnp.max(jnp.where(jnp.isfinite(cost[HIDDEN]), cost[HIDDEN], 0.0), axis=(0, 1))
    return jax.lax.map(cheapest, class_go).T, failure_cost
