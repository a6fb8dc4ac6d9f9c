"""The building network in training: it answers from the map and the painting, and says what the squares hold."""

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Bool, Float32, Int8, Int32, PRNGKeyArray, UInt8

from potlp_jax.codec import KIND
from potlp_jax.learning.augmentation import Augmentation, draw_gains, draw_mirrors
from potlp_jax.learning.batches import Choice
from potlp_jax.learning.building_config import BuildingConfig
from potlp_jax.learning.building_network import BuildingNetwork, Params
from potlp_jax.learning.data_figures import camera_geometry, cost_scales, image_shape
from potlp_jax.learning.dataset import Samples
from potlp_jax.learning.imagined_paths import Outlook, outlook_of_first, prospects, scenery
from potlp_jax.learning.map_channels import map_channels
from potlp_jax.learning.map_images import DecodedView, decode_view
from potlp_jax.learning.network import Answers
from potlp_jax.learning.painting import Painting
from potlp_jax.learning.squares import Squares, true_squares
from potlp_jax.world.grid import BeliefMap


@struct.dataclass(kw_only=True)
class BuildingInputs:
    """``G`` maps with at most ``S`` subgoals each; one without ``G``.

    Attributes:
        cells, letters: of the beliefs.
        extent: of the maps, without padding.
        painting: on the maps.
        true_cells, true_letters: of the buildings, ``UNKNOWN`` where nobody knows.
        subgoals: cells of the subgoals that are asked about; any where there are fewer.
        subgoal_of: which of them each of the ``K`` samples asks about.
        lanes: a sample of each pair of a subgoal and a ``phi_stay`` that are asked about; any where there are fewer.
        lane_of: which of these pairs each sample asks about.
        real: True for views, False for what fills the batch up.
    """

    cells: Int8[Array, "*G H W"]
    letters: Int32[Array, "*G H W"]
    extent: Int32[Array, "*G 2"]
    painting: Painting
    true_cells: Int8[Array, "*G H W"]
    true_letters: Int32[Array, "*G H W"]
    subgoals: Int32[Array, "*G S 2"]
    subgoal_of: Int32[Array, "*G K"]
    lanes: Int32[Array, "*G L"]
    lane_of: Int32[Array, "*G K"]
    real: Bool[Array, "*G"]


@dataclasses.dataclass(frozen=True)
class BuildingLearner:
    """A ``Learner`` of the building network."""

    config: BuildingConfig

    def init(self, key: PRNGKeyArray) -> Params:
        """New parameters."""
        return BuildingNetwork(self.config).init(key)

    def usable(self, samples: Samples) -> Bool[np.ndarray, "N"]:
        """All samples: the map shows every subgoal."""
        return np.ones(len(samples.success), bool)

    def inputs(self, samples: Samples, choice: Choice) -> BuildingInputs:
        """The decoded maps."""
        views = [_decoded(samples, view) for view in choice.views]

        def stacked(name: str) -> Array:
            return jnp.asarray(np.stack([getattr(view, name) for view in views]))

        cells, stays = samples.cells[choice.index], samples.phi_stay[choice.index]
        first, subgoal_of = _distinct(cells, samples.most_subgoals)
        subgoals = np.take_along_axis(cells, first[:, :, None], axis=1)
        lanes, lane_of = _distinct(np.concatenate([cells, stays], axis=-1), min(samples.most_lanes, cells.shape[1]))
        return BuildingInputs(
            cells=stacked("cells"),
            letters=stacked("letters"),
            extent=jnp.asarray(np.array([view.extent for view in views], np.int32)),
            painting=Painting(floor=stacked("floor"), beyond=stacked("beyond"), distance=stacked("distance")),
            true_cells=stacked("true_cells"),
            true_letters=stacked("true_letters"),
            subgoals=jnp.asarray(subgoals.astype(np.int32)),
            subgoal_of=jnp.asarray(subgoal_of),
            lanes=jnp.asarray(lanes),
            lane_of=jnp.asarray(lane_of),
            real=jnp.asarray(choice.real),
        )

    def augmented(self, inputs: BuildingInputs, key: PRNGKeyArray, amount: Augmentation) -> BuildingInputs:
        """Maps mirrored within their extent, and colours with a gain."""
        of_mirrors, of_gains = jax.random.split(key)
        mirrored = jnp.stack(draw_mirrors(of_mirrors, inputs.cells.shape[0], amount), axis=-1)
        gains = draw_gains(of_gains, inputs.cells.shape[0], amount)
        turned = jax.vmap(_mirrored)(inputs, mirrored)
        return dataclasses.replace(turned, painting=_with_gains(turned.painting, gains))

    def answers(
        self, params: Params, inputs: BuildingInputs, phi_stay: Int8[Array, "G K P"], phi_go: Int8[Array, "G K P"]
    ) -> tuple[Answers, Float32[Array, " G"]]:
        """The network's answers, and the cross-entropy of what it says of the squares."""
        network, belief = BuildingNetwork(self.config), self._belief(inputs)
        encoded = network.encode(params, jax.vmap(map_channels)(belief, inputs.painting))
        places = network.places(params, encoded, inputs.subgoals)
        asked = jnp.take_along_axis(places, inputs.subgoal_of[:, :, None], axis=1)
        imagined = jax.tree.map(jax.nn.sigmoid, encoded.squares)
        lanes = _outlook_of_samples(belief, imagined, inputs, phi_stay, self.config.own_within)
        beyond = prospects(lanes, phi_go)
        answers = network.answer(params, asked, beyond, network.modulation(params, phi_stay, phi_go))
        loss = jax.vmap(_squares_loss, in_axes=(0, 0, 0, None))(
            encoded.squares, inputs.true_cells, inputs.true_letters, len(self.config.propositions)
        )
        return answers, jnp.where(inputs.real, loss, jnp.float32(0))

    def _belief(self, inputs: BuildingInputs) -> BeliefMap:
        views = inputs.cells.shape[0]
        return BeliefMap(
            cells=inputs.cells,
            letters=inputs.letters,
            # Not read.
            resolution=jnp.ones(views, jnp.float32),
            extent=inputs.extent,
            propositions=self.config.propositions,
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class BuildingOptions:
    """What can be chosen of a building network: ``BuildingConfig`` explains it, and its rest follows from the data.

    Attributes:
        kind: ``building``.
    """

    kind: Literal["building"] = "building"
    widths: tuple[int, ...] = BuildingConfig.widths
    blocks: tuple[int, ...] = BuildingConfig.blocks
    decoder: int = BuildingConfig.decoder
    head: int = BuildingConfig.head
    condition: int = BuildingConfig.condition
    contrast: int = BuildingConfig.contrast
    raw: int = BuildingConfig.raw
    exclusive_within: float = BuildingConfig.exclusive_within
    own_within: int = BuildingConfig.own_within
    without: tuple[str, ...] = BuildingConfig.without

    def learner(self, samples: Samples) -> BuildingLearner:
        """The network for a data set.

        Raises:
            TrainingError: it has no panoramas, or does not say how its camera sees the floor.
        """
        chosen = {name: value for name, value in dataclasses.asdict(self).items() if name != KIND}
        return BuildingLearner(
            BuildingConfig(
                propositions=tuple(samples.metadata.propositions),
                image_shape=image_shape(samples),
                **chosen,
                **cost_scales(samples),
                **camera_geometry(samples, "painting the map"),
                glances=samples.metadata.glances,
            )
        )


def _outlook_of_samples(
    belief: BeliefMap, imagined: Squares, inputs: BuildingInputs, phi_stay: Int8[Array, "G K P"], own_within: int
) -> Outlook:
    """The outlook of every sample, leading dimensions ``G K``; those that share a subgoal and ``phi_stay`` share it."""

    def of_view(view: tuple[BeliefMap, Squares, BuildingInputs, Int8[Array, "K P"]]) -> Outlook:
        belief, imagined, inputs, stay = view
        cells = inputs.subgoals[inputs.subgoal_of[inputs.lanes]]
        asked = jnp.max(inputs.lane_of) + 1
        lanes = outlook_of_first(asked, scenery(belief, imagined, own_within), cells, stay[inputs.lanes])
        return jax.tree.map(lambda array: array[inputs.lane_of], lanes)

    # One view after the other: side by side all would be swept until the last one is done.
    return jax.lax.map(of_view, (belief, imagined, inputs, phi_stay))


def _decoded(samples: Samples, view: np.integer) -> DecodedView:
    return decode_view(samples.maps[view], samples.worlds[samples.world_of[view]], samples.metadata.shape)


def _distinct(
    asked: Int32[np.ndarray, "G K N"], most: int
) -> tuple[Int32[np.ndarray, "G S"], Int32[np.ndarray, "G K"]]:
    """Where each row has its distinct vectors, padded with 0 to ``most``, and which of them each entry is."""
    found = [np.unique(row, axis=0, return_index=True, return_inverse=True) for row in asked]
    first = np.stack([np.pad(index, (0, most - len(index))) for _, index, _ in found])
    return first.astype(np.int32), np.stack([index.reshape(-1) for _, _, index in found]).astype(np.int32)


def _mirrored(inputs: BuildingInputs, mirrored: Bool[Array, "2"]) -> BuildingInputs:
    """One view with rows, columns or both mirrored; what pads the map stays where it is."""
    places = [
        jnp.where(axis & (jnp.arange(size) < extent), extent - 1 - jnp.arange(size), jnp.arange(size))
        for axis, size, extent in zip(mirrored, inputs.cells.shape, inputs.extent, strict=True)
    ]
    maps = (inputs.cells, inputs.letters, inputs.painting, inputs.true_cells, inputs.true_letters)
    cells, letters, painting, true_cells, true_letters = jax.tree.map(
        lambda array: array[places[0]][:, places[1]], maps
    )
    subgoals = jnp.where(mirrored[None, :], inputs.extent[None, :] - 1 - inputs.subgoals, inputs.subgoals)
    return dataclasses.replace(
        inputs,
        cells=cells,
        letters=letters,
        painting=painting,
        true_cells=true_cells,
        true_letters=true_letters,
        subgoals=subgoals,
    )


def _with_gains(painting: Painting, gains: Float32[Array, "G 3"]) -> Painting:
    def lit(colour: UInt8[Array, "G H W 3"]) -> UInt8[Array, "G H W 3"]:
        scaled = colour.astype(jnp.float32) * gains[:, None, None, :]
        return jnp.clip(jnp.round(scaled), 0, 255).astype(jnp.uint8)

    return dataclasses.replace(painting, floor=lit(painting.floor), beyond=lit(painting.beyond))


def _squares_loss(
    logits: Squares, true_cells: Int8[Array, "H W"], true_letters: Int32[Array, "H W"], propositions: int
) -> Float32[Array, ""]:
    """Cross-entropy of what is said of one map's squares: mean over squares, summed over what is said of each."""
    known, truth = true_squares(true_cells, true_letters, propositions)
    rows, columns = known.shape
    # The network pads maps to whole squares of its coarsest scale, of which nothing is asked.
    said = jax.tree.map(lambda array: array[:rows, :columns], logits)
    entropy = jax.tree.map(optax.sigmoid_binary_cross_entropy, said, truth)
    # By which side one comes to a proposition is asked where it holds.
    approach = jnp.sum(truth.holds * jnp.sum(entropy.approach, axis=-1), axis=-1)
    of_square = entropy.free + jnp.sum(entropy.holds, axis=-1) + jnp.sum(entropy.passages, axis=-1) + approach
    return jnp.sum(jnp.where(known, of_square, 0.0)) / jnp.maximum(jnp.sum(known), 1).astype(jnp.float32)
