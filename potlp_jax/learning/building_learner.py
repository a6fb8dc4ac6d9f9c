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
from potlp_jax.learning.building_network import SQUARE, BuildingConfig, BuildingNetwork, Params, map_channels
from potlp_jax.learning.data_figures import camera_geometry, cost_scales, image_shape
from potlp_jax.learning.dataset import Samples
from potlp_jax.learning.map_images import DecodedView, decode_view
from potlp_jax.learning.network import Answers
from potlp_jax.learning.painting import Painting
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
        """The decoded maps; the first one again fills the batch up."""
        views = [_decoded(samples, view) for view in choice.views]
        views += [views[0]] * (len(choice.index) - len(views))

        def stacked(name: str) -> Array:
            return jnp.asarray(np.stack([getattr(view, name) for view in views]))

        subgoals, subgoal_of = _distinct(samples.cells[choice.index], samples.most_subgoals)
        return BuildingInputs(
            cells=stacked("cells"),
            letters=stacked("letters"),
            extent=jnp.asarray(np.array([view.extent for view in views], np.int32)),
            painting=Painting(floor=stacked("floor"), beyond=stacked("beyond"), distance=stacked("distance")),
            true_cells=stacked("true_cells"),
            true_letters=stacked("true_letters"),
            subgoals=jnp.asarray(subgoals),
            subgoal_of=jnp.asarray(subgoal_of),
            real=jnp.arange(len(views)) < len(choice.views),
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
        network = BuildingNetwork(self.config)
        encoded = network.encode(params, jax.vmap(self._channels)(inputs.cells, inputs.letters, inputs.painting))
        places = network.places(params, encoded, inputs.subgoals)
        asked = jnp.take_along_axis(places, inputs.subgoal_of[:, :, None], axis=1)
        answers = network.answer(params, asked, network.modulation(params, phi_stay, phi_go))
        loss = jax.vmap(_squares_loss, in_axes=(0, 0, 0, None))(
            encoded.squares, inputs.true_cells, inputs.true_letters, len(self.config.propositions)
        )
        return answers, jnp.where(inputs.real, loss, jnp.float32(0))

    def _channels(
        self, cells: Int8[Array, "H W"], letters: Int32[Array, "H W"], painting: Painting
    ) -> Float32[Array, "H W K"]:
        belief = BeliefMap(
            cells=cells,
            letters=letters,
            # Neither enters the channels.
            resolution=jnp.float32(1),
            extent=jnp.asarray(cells.shape, jnp.int32),
            propositions=self.config.propositions,
        )
        return map_channels(belief, painting)


@dataclasses.dataclass(frozen=True, kw_only=True)
class BuildingOptions:
    """What can be chosen of a building network, as in ``BuildingConfig``, the rest of which follows from the data."""

    kind: Literal["building"] = "building"
    widths: tuple[int, ...] = BuildingConfig.widths
    blocks: tuple[int, ...] = BuildingConfig.blocks
    decoder: int = BuildingConfig.decoder
    head: int = BuildingConfig.head
    condition: int = BuildingConfig.condition
    exclusive_within: float = BuildingConfig.exclusive_within

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
            )
        )


def _decoded(samples: Samples, view: np.integer) -> DecodedView:
    return decode_view(samples.maps[view], samples.worlds[samples.world_of[view]], samples.metadata.shape)


def _distinct(
    cells: Int32[np.ndarray, "G K 2"], most: int
) -> tuple[Int32[np.ndarray, "G S 2"], Int32[np.ndarray, "G K"]]:
    """The distinct cells of each row, at most ``most`` and padded to so many, and which of them each entry is."""
    found = [np.unique(row, axis=0, return_inverse=True) for row in cells]
    distinct = np.stack([np.pad(row, ((0, most - len(row)), (0, 0))) for row, _ in found])
    return distinct.astype(np.int32), np.stack([index.reshape(-1) for _, index in found]).astype(np.int32)


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
        # Places that are not asked about may lie outside of the map then.
        subgoals=jnp.clip(subgoals, 0, inputs.extent[None, :] - 1),
    )


def _with_gains(painting: Painting, gains: Float32[Array, "G 3"]) -> Painting:
    def lit(colour: UInt8[Array, "G H W 3"]) -> UInt8[Array, "G H W 3"]:
        scaled = colour.astype(jnp.float32) * gains[:, None, None, :]
        return jnp.clip(jnp.round(scaled), 0, 255).astype(jnp.uint8)

    return dataclasses.replace(painting, floor=lit(painting.floor), beyond=lit(painting.beyond))


def _squares_loss(
    logits: Float32[Array, "rows columns P1"],
    true_cells: Int8[Array, "H W"],
    true_letters: Int32[Array, "H W"],
    propositions: int,
) -> Float32[Array, ""]:
    """Cross-entropy of what is said of one map's squares: mean over squares, summed over what is said of each."""
    known, targets = square_targets(true_cells, true_letters, propositions)
    rows, columns = known.shape
    # The network pads maps to whole squares of its coarsest scale, of which nothing is asked.
    entropy = optax.sigmoid_binary_cross_entropy(logits[:rows, :columns], targets)
    return jnp.sum(jnp.where(known[:, :, None], entropy, 0.0)) / jnp.maximum(jnp.sum(known), 1).astype(jnp.float32)


def square_targets(
    true_cells: Int8[Array, "H W"], true_letters: Int32[Array, "H W"], propositions: int
) -> tuple[Bool[Array, "rows columns"], Float32[Array, "rows columns P1"]]:
    """What is true of the squares.

    Args:
        true_cells, true_letters: of the building.
        propositions: their number.

    Returns:
        Which squares have a cell that is known; and of each square the share of its known cells that are free, and
        for each proposition whether a known cell has it.
    """
    known = true_cells != BeliefMap.UNKNOWN
    free = true_cells == BeliefMap.FREE
    letters = jnp.stack([(true_letters >> bit) & 1 for bit in range(propositions)], axis=-1) > 0
    number = _in_squares(known[:, :, None]).sum(axis=2)
    share = _in_squares(free[:, :, None]).sum(axis=2) / jnp.maximum(number, 1)
    holds = jnp.any(_in_squares(letters & known[:, :, None]), axis=2)
    return number[:, :, 0] > 0, jnp.concatenate([share, holds.astype(jnp.float32)], axis=-1).astype(jnp.float32)


def _in_squares(array: Array) -> Array:
    """``[H, W, channels]`` to ``[rows, columns, cells of a square, channels]``; what is missing of a square is 0."""
    height, width, channels = array.shape
    array = jnp.pad(array, ((0, -height % SQUARE), (0, -width % SQUARE), (0, 0)))
    rows, columns = array.shape[0] // SQUARE, array.shape[1] // SQUARE
    array = array.reshape(rows, SQUARE, columns, SQUARE, channels)
    return jnp.moveaxis(array, 2, 1).reshape(rows, columns, SQUARE * SQUARE, channels)
