"""The building network as an estimator: what it remembers in a trial, and what it answers in a decision."""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int8, Int32, UInt8

from potlp_jax.learning.building_config import BuildingConfig
from potlp_jax.learning.building_network import BuildingNetwork, EncodedMap, Params
from potlp_jax.learning.exclusion import exclusive_chances
from potlp_jax.learning.imagined_paths import Outlook, Scenery, outlook_of_first, prospects, scenery
from potlp_jax.learning.map_channels import map_channels
from potlp_jax.learning.network import require_propositions
from potlp_jax.learning.overlays import Imagined, Overlay, imagined_overlay, painting_overlays, spread_over
from potlp_jax.learning.painting import Painting, moved_painting, paint
from potlp_jax.learning.resampling import cells_in, resampled
from potlp_jax.learning.squares import SQUARE
from potlp_jax.planning.estimates import Estimates
from potlp_jax.task.task import TaskArrays
from potlp_jax.world.frontiers import Subgoals
from potlp_jax.world.grid import BeliefMap


@struct.dataclass(kw_only=True)
class BuildingEstimator:
    """P_S, R_S and R_F from the belief and from what the panoramas seen so far painted on it.

    Attributes:
        params: of the network.
        memory: the painting, on the belief's own cells.
        config: of the network; static.
        scale: how many of the network's cells are as long as one of the belief's; static. Where it is not 1 the network
            looks at another map (``learning.resampling``).
    """

    params: Params
    memory: Painting
    config: BuildingConfig = struct.field(pytree_node=False)
    scale: float = struct.field(pytree_node=False, default=1.0)

    @property
    def looks_on_the_way(self) -> bool:
        """Always: doorways that the robot passes between two decisions show what is behind them."""
        return True

    def encode(self, panorama: UInt8[Array, "rows columns 3"]) -> UInt8[Array, "rows columns 3"]:
        """The panorama itself: what a pixel shows is known only with the belief."""
        return panorama

    def remember(
        self, seen: UInt8[Array, "rows columns 3"], belief: BeliefMap, cell: Int32[Array, "2"]
    ) -> "BuildingEstimator":
        """The estimator with one panorama more painted on its map (``learning.painting.paint``)."""
        camera = self.config.camera
        if self.scale != 1.0:
            # The same metres are another number of cells.
            camera = dataclasses.replace(camera, **camera.lengths(1 / self.scale))
        painted = paint(self.memory, seen, belief, cell, camera, glances=self.config.glances)
        return dataclasses.replace(self, memory=painted)

    def moved(self, shape: tuple[int, int], rows: int, columns: int) -> "BuildingEstimator":
        """The estimator for another array of the same map (``learning.observing.MovesWithMap``)."""
        return dataclasses.replace(self, memory=moved_painting(self.memory, shape, rows, columns))

    def imagine(self, belief: BeliefMap) -> EncodedMap:
        """The network's first stage: what it makes of the map, also of squares that were not observed.

        Args:
            belief: on the network's own cells, as the memory is.
        """
        return BuildingNetwork(self.config).encode(self.params, map_channels(belief, self.memory))

    def overlays(self, belief: BeliefMap) -> tuple[Overlay, ...]:
        """The painting, and what the network makes of squares that were not observed."""
        if self.scale != 1.0:
            asked, own = self._on_own_cells(belief, jnp.zeros(belief.cells.shape, bool))
            return (*painting_overlays(self.memory), spread_over(asked._imagined(own), belief, self.scale))
        return (*painting_overlays(self.memory), self._imagined(belief))

    def _imagined(self, belief: BeliefMap) -> Imagined:
        """What the network makes of squares of its own cells."""
        squares = jax.tree.map(jax.nn.sigmoid, self.imagine(belief).squares)
        return imagined_overlay(squares.free, squares.holds, belief, SQUARE)

    def _on_own_cells(self, belief: BeliefMap, entered: Bool[Array, "H W"]) -> "tuple[BuildingEstimator, BeliefMap]":
        """The estimator and the map on cells as large as those that the network learned from (``resampled``)."""
        own, painting = resampled(belief, self.memory, entered, self.scale)
        return dataclasses.replace(self, memory=painting, scale=1.0), own

    def __call__(self, belief: BeliefMap, subgoals: Subgoals, task: TaskArrays) -> Estimates:
        """Estimates of every real (subgoal, class); padded pairs have P_S = 0.

        Raises:
            PropositionsError: the network was trained for other propositions than the task's.
        """
        require_propositions(self.config.propositions, task.propositions, "the estimator's network")
        if self.scale != 1.0:
            height, width = belief.cells.shape
            # Masked subgoals point at cell (0, 0), whatever is there.
            entered = jnp.zeros((height, width), bool).at[subgoals.cells[:, 0], subgoals.cells[:, 1]].max(subgoals.mask)
            asked, own = self._on_own_cells(belief, entered)
            there = cells_in(subgoals.cells, (height, width), self.scale)
            return asked(own, dataclasses.replace(subgoals, cells=there), task)
        network = BuildingNetwork(self.config)
        encoded = self.imagine(belief)
        stay, go = task.class_phi[:, 0], task.class_phi[:, 1]
        modulation = network.modulation(self.params, stay, go)
        places = network.places(self.params, encoded, subgoals.cells)
        imagined = jax.tree.map(jax.nn.sigmoid, encoded.squares)
        beyond = outlook_of_classes(scenery(belief, imagined, self.config.own_within), subgoals, stay, task.class_mask)

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


def outlook_of_classes(
    scene: Scenery, subgoals: Subgoals, stay: Int8[Array, "C P"], class_mask: Bool[Array, " C"]
) -> Outlook:
    """The outlook of every real (subgoal, class), leading dimensions ``S C``; classes that avoid the same share one.

    Args:
        scene: of the map, without leading dimensions.
        subgoals: padding is masked out.
        stay: of the task's classes, ``phi_stay``: -1 for what is avoided.
        class_mask: True for real classes.

    Returns:
        Numbers of about the size of 1; of masked subgoals and classes they mean nothing.
    """
    count, classes = subgoals.mask.shape[0], class_mask.shape[0]
    same = jnp.all(stay[:, None, :] == stay[None, :, :], axis=2) & class_mask[None, :]
    first = jnp.argmax(same, axis=1).astype(jnp.int32)
    asked = class_mask & (first == jnp.arange(classes, dtype=jnp.int32))
    # Pairs of a subgoal and the first class that avoids something, real ones first.
    real = (subgoals.mask[:, None] & asked[None, :]).reshape(-1)
    order = jnp.argsort(~real, stable=True).astype(jnp.int32)
    cells, avoided = subgoals.cells[order // classes], stay[order % classes]
    solved = outlook_of_first(jnp.sum(real, dtype=jnp.int32), scene, cells, avoided)
    # From the order of work to that of the pairs, and from the first class to all that avoid the same.
    back = jnp.argsort(order)
    return jax.tree.map(lambda rows: rows[back].reshape(count, classes, *rows.shape[1:])[:, first], solved)
