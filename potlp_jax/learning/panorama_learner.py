"""The panorama network in training: it answers what one panorama shows."""

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32, Int8, PRNGKeyArray, UInt8

from potlp_jax.learning.augmentation import Augmentation, draw_gains, draw_mirrors
from potlp_jax.learning.batches import Choice
from potlp_jax.learning.data_figures import camera_geometry, cost_scales, image_shape, spread
from potlp_jax.learning.dataset import Samples, decode
from potlp_jax.learning.network import Answers, EstimatorNetwork, NetworkConfig, Params


@struct.dataclass(kw_only=True)
class PanoramaInputs:
    """``G`` panoramas, and where in each the ``K`` subgoals are.

    Attributes:
        pixels: bytes, or in [0, 1] once they were augmented.
        bearing: of the subgoals, in the map's frame.
        distance: to the subgoals through known space.
    """

    pixels: UInt8[Array, "G rows columns 3"] | Float32[Array, "G rows columns 3"]
    bearing: Float32[Array, "G K"]
    distance: Float32[Array, "G K"]


@dataclasses.dataclass(frozen=True)
class PanoramaLearner:
    """A ``Learner`` of the panorama network."""

    config: NetworkConfig

    def init(self, key: PRNGKeyArray) -> Params:
        """New parameters."""
        return EstimatorNetwork(self.config).init(key)

    def usable(self, samples: Samples) -> Bool[np.ndarray, "N"]:
        """The samples whose subgoal the panorama shows."""
        return samples.in_view

    def inputs(self, samples: Samples, choice: Choice) -> PanoramaInputs:
        """The decoded panoramas."""
        images = [decode(samples.images[view]) for view in choice.views]
        return PanoramaInputs(
            pixels=jnp.asarray(np.stack(images)),
            bearing=jnp.asarray(samples.bearing[choice.index]),
            distance=jnp.asarray(samples.distance[choice.index]),
        )

    def augmented(self, inputs: PanoramaInputs, key: PRNGKeyArray, amount: Augmentation) -> PanoramaInputs:
        """Mirrored panoramas and bearings, and pixels with a gain.

        It is the image that is mirrored, not the features: the first stage's kernels are not symmetrical.
        """
        of_mirrors, of_gains = jax.random.split(key)
        views, columns = inputs.pixels.shape[0], inputs.pixels.shape[2]
        mirrored_rows, mirrored_columns = draw_mirrors(of_mirrors, views, amount)

        def chosen(mirrored: Array, one: Array, other: Array) -> Array:
            return jnp.where(mirrored.reshape(-1, *(1,) * (one.ndim - 1)), one, other)

        # A pixel's column and its bearing change sign together. Exchanging left and right turns by half a circle too.
        pixels = chosen(mirrored_rows, inputs.pixels[:, :, ::-1], inputs.pixels)
        pixels = chosen(mirrored_columns, jnp.roll(pixels[:, :, ::-1], columns // 2, axis=2), pixels)
        bearing = chosen(mirrored_rows, -inputs.bearing, inputs.bearing)
        bearing = chosen(mirrored_columns, jnp.float32(jnp.pi) - bearing, bearing)
        gains = draw_gains(of_gains, views, amount)[:, None, None, :]
        return dataclasses.replace(inputs, pixels=jnp.clip(_scaled(pixels) * gains, 0, 1), bearing=bearing)

    def answers(
        self, params: Params, inputs: PanoramaInputs, phi_stay: Int8[Array, "G K P"], phi_go: Int8[Array, "G K P"]
    ) -> tuple[Answers, Float32[Array, " G"]]:
        """The network's answers; it says nothing of a view beside them."""
        network = EstimatorNetwork(self.config)
        features = network.encode_pixels(params, _scaled(inputs.pixels))
        centred = jax.vmap(network.centre)(features, inputs.bearing, inputs.distance)
        return network.answer(params, centred, phi_stay, phi_go), jnp.zeros(inputs.pixels.shape[0])


@dataclasses.dataclass(frozen=True, kw_only=True)
class PanoramaOptions:
    """What can be chosen of a panorama network; the rest of ``NetworkConfig`` follows from the data.

    Attributes:
        kind: ``panorama``.
        fovea: columns of pixels on each side of a subgoal that the network sees at full resolution; 0 for none.
        second_widths: channels of the eight convolutions after phi is joined.
        exclusive_within: cells within which subgoals exclude each other, as ``eval.exclusion`` measures; 0: nowhere.
    """

    kind: Literal["panorama"] = "panorama"
    fovea: int = NetworkConfig.fovea
    second_widths: tuple[int, ...] = NetworkConfig.second_widths
    exclusive_within: float = NetworkConfig.exclusive_within

    def learner(self, samples: Samples) -> PanoramaLearner:
        """The network for a data set.

        Raises:
            TrainingError: it has no panoramas, or a fovea is asked for and it does not say how its camera sees the
                floor.
        """
        return PanoramaLearner(
            NetworkConfig(
                propositions=tuple(samples.metadata.propositions),
                image_shape=image_shape(samples),
                distance_scale=spread(samples.distance[samples.in_view], float(samples.metadata.resolution)),
                fovea=self.fovea,
                second_widths=self.second_widths,
                exclusive_within=self.exclusive_within,
                **cost_scales(samples, samples.in_view),
                **(camera_geometry(samples, "a fovea") if self.fovea else {}),
            )
        )


def _scaled(pixels: Array) -> Float32[Array, "G rows columns 3"]:
    return pixels.astype(jnp.float32) / jnp.float32(255) if pixels.dtype == jnp.uint8 else pixels
