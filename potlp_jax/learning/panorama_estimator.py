"""The panorama network as an estimator: what it remembers in a trial, and what it answers in a decision."""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float32, Int32, UInt8

from potlp_jax.learning.exclusion import exclusive_chances
from potlp_jax.learning.memory import (
    PanoramaMemory,
    moved_memory,
    observation_of_subgoals,
    remember,
    slots_of_observations,
)
from potlp_jax.learning.network import EstimatorNetwork, NetworkConfig, Params, require_propositions
from potlp_jax.planning.distances.product import product_distances
from potlp_jax.planning.estimates import Estimates
from potlp_jax.task.task import TaskArrays
from potlp_jax.types import NO_STATE
from potlp_jax.world.camera import bearing
from potlp_jax.world.frontiers import Subgoals
from potlp_jax.world.grid import BeliefMap

QUESTIONS: int = 3
"""Classes that are asked of a subgoal at a time."""


@struct.dataclass(kw_only=True)
class NetworkEstimator:
    """P_S, R_S and R_F from the panoramas seen so far (Bradley et al. 2021, section IV). ``config`` is static."""

    params: Params
    memory: PanoramaMemory
    config: NetworkConfig = struct.field(pytree_node=False)

    def __call__(self, belief: BeliefMap, subgoals: Subgoals, task: TaskArrays) -> Estimates:
        """Estimates of every real (subgoal, class); padded pairs have P_S = 0.

        At least one observation must be remembered.

        The network counts in the unit of the worlds that it learned from, which is the belief's: cells or metres.
        Subgoals are asked one after the other, of each so many classes at a time, so that padding costs little.

        Raises:
            PropositionsError: the network was trained for other propositions than the task's.
        """
        require_propositions(self.config.propositions, task.propositions, "the estimator's network")
        # Each subgoal is judged from the panorama in which it was last in sight, taken from where the robot then stood.
        places = slots_of_observations(self.memory, self.observations(subgoals))
        distance = self.distances(belief, subgoals)
        angle = jax.vmap(bearing)(self.memory.cells[places], subgoals.cells)
        classes = task.class_mask.shape[0]

        def ask(subgoal: Int32[Array, ""], answers: Float32[Array, "3 S C"]) -> Float32[Array, "3 S C"]:
            features = self.memory.features[places[subgoal]]
            found = self._ask_of_subgoal(features, angle[subgoal], distance[subgoal], task, answers[:, subgoal])
            return answers.at[:, subgoal].set(found)

        # Real subgoals come first, so the loop ends with the last of them: what padding would cost is the second stage
        # of the network, which is most of the work.
        real = jnp.sum(subgoals.mask, dtype=jnp.int32)
        nothing = jnp.stack(
            [jnp.zeros((subgoals.mask.shape[0], classes)), *[jnp.ones((subgoals.mask.shape[0], classes))] * 2]
        )
        probability, success_cost, failure_cost = jax.lax.fori_loop(0, real, ask, nothing)
        # Rows of masked subgoals keep P_S = 0 from the start; columns of masked classes may hold anything.
        probability = jnp.where(task.class_mask[None, :], probability, 0.0)
        return Estimates(
            success_probability=exclusive_chances(probability, subgoals, self.config.exclusive_within),
            success_cost=success_cost,
            failure_cost=failure_cost,
            # Sticky: once a panorama was dropped that showed a frontier, later estimates may be worse for it.
            status=self.memory.status,
        )

    def _ask_of_subgoal(
        self,
        features: Float32[Array, "rows columns F"],
        angle: Float32[Array, ""],
        distance: Float32[Array, ""],
        task: TaskArrays,
        answers: Float32[Array, "3 C"],
    ) -> Float32[Array, "3 C"]:
        """P_S, R_S and R_F of the real classes beyond one subgoal; ``answers`` keeps what it has of the others."""
        network, classes = EstimatorNetwork(self.config), task.class_mask.shape[0]
        centred = network.centre(features, angle, distance)
        repeated = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (QUESTIONS, *leaf.shape)), centred)
        # The features of a subgoal are the same for all of its classes, so they are broadcast once.
        # Real classes first; those that fill up the last portion are dropped where they are written.
        order = jnp.argsort(~task.class_mask, stable=True).astype(jnp.int32)
        # An index of ``classes`` is out of bounds, and mode="drop" ignores it.
        order = jnp.pad(order, (0, -classes % QUESTIONS), constant_values=classes)
        portions = -(-jnp.sum(task.class_mask, dtype=jnp.int32) // QUESTIONS)

        def ask(portion: Int32[Array, ""], answers: Float32[Array, "3 C"]) -> Float32[Array, "3 C"]:
            chosen = jax.lax.dynamic_slice_in_dim(order, portion * QUESTIONS, QUESTIONS)
            answer = network.answer(self.params, repeated, task.class_phi[chosen, 0], task.class_phi[chosen, 1])
            found = jnp.stack([answer.success_probability, answer.success_cost, answer.failure_cost])
            return answers.at[:, chosen].set(found, mode="drop")

        return jax.lax.fori_loop(0, portions, ask, answers)

    def distances(self, belief: BeliefMap, subgoals: Subgoals) -> Float32[Array, " S"]:
        """From where each subgoal was seen to the subgoal through known space, letters ignored, in the belief's unit.

        0 where masked, or where known space does not lead there.
        """
        poses = self.memory.cells[slots_of_observations(self.memory, self.observations(subgoals))]
        return _distances(belief, poses, subgoals)

    def observations(self, subgoals: Subgoals) -> Int32[Array, " S"]:
        """The panorama that each subgoal is judged from (``learning.memory.observation_of_subgoals``)."""
        return observation_of_subgoals(self.memory, subgoals)

    def encode(self, panorama: UInt8[Array, "rows columns 3"]) -> Float32[Array, "feature_rows feature_columns F"]:
        """The first stage's features of a panorama."""
        return EstimatorNetwork(self.config).encode(self.params, panorama)

    def remember(
        self, seen: Float32[Array, "feature_rows feature_columns F"], belief: BeliefMap, cell: Int32[Array, "2"]
    ) -> "NetworkEstimator":
        """The estimator with one panorama more in memory (``learning.memory.remember``)."""
        return dataclasses.replace(self, memory=remember(self.memory, seen, belief, cell))

    def moved(self, shape: tuple[int, int], rows: int, columns: int) -> "NetworkEstimator":
        """The estimator for another array of the same map (``learning.observing.MovesWithMap``)."""
        return dataclasses.replace(self, memory=moved_memory(self.memory, shape, rows, columns))


def _distances(belief: BeliefMap, poses: Int32[Array, "S 2"], subgoals: Subgoals) -> Float32[Array, " S"]:
    """From each pose to its subgoal through known space, letters ignored; 0 where masked."""
    # One automaton state for all free cells: letters do not matter for how far away something was seen.
    open_cells = jnp.where(belief.free, 0, NO_STATE).astype(jnp.int32)[:, :, None]
    states = jnp.where(subgoals.mask, 0, NO_STATE).astype(jnp.int32)
    fields = product_distances(open_cells, belief.free, poses, states, belief.resolution)
    count = jnp.arange(poses.shape[0], dtype=jnp.int32)
    distance = fields[count, subgoals.cells[:, 0], subgoals.cells[:, 1], 0]
    return jnp.where(jnp.isfinite(distance), distance, 0.0)
