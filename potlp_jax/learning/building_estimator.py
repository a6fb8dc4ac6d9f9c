"""The building network as an estimator: what it remembers in a trial, and what it answers in a decision."""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int8, Int32, UInt8

from potlp_jax.learning.building_network import BuildingConfig, BuildingNetwork, EncodedMap, Params, map_channels
from potlp_jax.learning.exclusion import exclusive_chances
from potlp_jax.learning.imagined_paths import OF_GOAL, OF_WAY, Outlook, Scenery, outlook, prospects, scenery
from potlp_jax.learning.network import require_propositions
from potlp_jax.learning.overlays import Overlay, imagined_overlay, painting_overlays
from potlp_jax.learning.painting import Painting, paint
from potlp_jax.learning.squares import SQUARE
from potlp_jax.planning.estimates import Estimates
from potlp_jax.task.task import TaskArrays
from potlp_jax.world.frontiers import Subgoals
from potlp_jax.world.grid import BeliefMap

# Pairs of a subgoal and a class for which paths are solved side by side: a vector of the widest units.
_LANES = 16


@struct.dataclass(kw_only=True)
class BuildingEstimator:
    """P_S, R_S and R_F from the belief and from what the panoramas seen so far painted on it. ``config`` is static."""

    params: Params
    memory: Painting
    config: BuildingConfig = struct.field(pytree_node=False)

    def encode(self, panorama: UInt8[Array, "rows columns 3"]) -> UInt8[Array, "rows columns 3"]:
        """The panorama itself: what a pixel shows is known only with the belief."""
        return panorama

    def remember(
        self, seen: UInt8[Array, "rows columns 3"], belief: BeliefMap, cell: Int32[Array, "2"]
    ) -> "BuildingEstimator":
        """The estimator with one panorama more painted on its map (``learning.painting.paint``)."""
        return dataclasses.replace(self, memory=paint(self.memory, seen, belief, cell, self.config.camera))

    def imagine(self, belief: BeliefMap) -> EncodedMap:
        """The network's first stage: what it makes of the map, also of squares that were not observed."""
        return BuildingNetwork(self.config).encode(self.params, map_channels(belief, self.memory))

    def overlays(self, belief: BeliefMap) -> tuple[Overlay, ...]:
        """The painting, and what the network makes of squares that were not observed."""
        squares = jax.tree.map(jax.nn.sigmoid, self.imagine(belief).squares)
        imagined = imagined_overlay(squares.free, squares.holds, belief, SQUARE)
        return (*painting_overlays(self.memory), imagined)

    def __call__(self, belief: BeliefMap, subgoals: Subgoals, task: TaskArrays) -> Estimates:
        """Estimates of every real (subgoal, class); padded pairs have P_S = 0.

        Raises:
            PropositionsError: the network was trained for other propositions than the task's.
        """
        require_propositions(self.config.propositions, task.propositions, "the estimator's network")
        network = BuildingNetwork(self.config)
        encoded = self.imagine(belief)
        stay, go = task.class_phi[:, 0], task.class_phi[:, 1]
        modulation = network.modulation(self.params, stay, go)
        places = network.places(self.params, encoded, subgoals.cells)
        imagined = jax.tree.map(jax.nn.sigmoid, encoded.squares)
        beyond = _outlook_of_classes(scenery(belief, imagined), subgoals, stay, task.class_mask)

        def ask(subgoal: Int32[Array, ""], found: Float32[Array, "3 S C"]) -> Float32[Array, "3 S C"]:
            seen = prospects(jax.tree.map(lambda array: array[subgoal], beyond), go)
            answers = network.answer(self.params, places[subgoal][None], seen, modulation)
            return found.at[:, subgoal].set(
                jnp.stack([answers.success_probability, answers.success_cost, answers.failure_cost])
            )

        # Real subgoals come first, so the loop ends with the last of them: padding costs nothing.
        real = jnp.sum(subgoals.mask, dtype=jnp.int32)
        shape = (subgoals.mask.shape[0], task.class_mask.shape[0])
        nothing = jnp.stack([jnp.zeros(shape), jnp.ones(shape), jnp.ones(shape)])
        probability, success_cost, failure_cost = jax.lax.fori_loop(0, real, ask, nothing)
        probability = jnp.where(task.class_mask[None, :], probability, 0.0)
        return Estimates(
            success_probability=exclusive_chances(probability, subgoals, self.config.exclusive_within),
            success_cost=success_cost,
            failure_cost=failure_cost,
        )


def _outlook_of_classes(
    scene: Scenery, subgoals: Subgoals, stay: Int8[Array, "C P"], class_mask: Bool[Array, " C"]
) -> Outlook:
    """The outlook of every real (subgoal, class), leading dimensions ``S C``; classes that avoid the same share one."""
    count, classes = subgoals.mask.shape[0], class_mask.shape[0]
    same = jnp.all(stay[:, None, :] == stay[None, :, :], axis=2) & class_mask[None, :]
    first = jnp.argmax(same, axis=1).astype(jnp.int32)
    asked = class_mask & (first == jnp.arange(classes, dtype=jnp.int32))
    # Pairs of a subgoal and the first class that avoids something, real ones first: padding costs nothing.
    real = (subgoals.mask[:, None] & asked[None, :]).reshape(-1)
    lanes = min(_LANES, count * classes)
    order = jnp.argsort(~real, stable=True).astype(jnp.int32)
    pairs = jnp.pad(order, (0, -order.size % lanes))

    def solve(chunk: Int32[Array, ""], found: Outlook) -> Outlook:
        chosen = jax.lax.dynamic_slice_in_dim(pairs, chunk * lanes, lanes)
        solved = outlook(scene, subgoals.cells[chosen // classes], stay[chosen % classes])
        return jax.tree.map(
            lambda into, rows: jax.lax.dynamic_update_slice_in_dim(into, rows, chunk * lanes, axis=0), found, solved
        )

    nothing = Outlook(way=jnp.zeros((pairs.size, OF_WAY)), goal=jnp.zeros((pairs.size, stay.shape[1], OF_GOAL)))
    chunks = -(-jnp.sum(real, dtype=jnp.int32) // lanes)
    solved = jax.lax.fori_loop(0, chunks, solve, nothing)
    # From the order of work to that of the pairs, and from the first class to all that avoid the same.
    back = jnp.argsort(order)
    return jax.tree.map(lambda rows: rows[back].reshape(count, classes, *rows.shape[1:])[:, first], solved)
