"""The building network: P_S, R_S and R_F from all that the robot has seen, the map and what is painted on it.

The belief and the painting are one picture of the building from above (``learning.map_channels``). A U-Net encodes it
once a decision, for all frontiers and all classes (the first stage). Colours are compared across the building first:
each building has its own shade of all of them, and thin smoke in one hallway shows beside the others. What a subgoal is
asked about is read off around its cell at every scale, together with one vector of the whole building; a small head per
(subgoal, class) answers, its units scaled and shifted by phi (the second stage).

The first stage also says of every square of ``SQUARE`` cells how much of it is free, what lies in it and how one gets
through it (``learning.squares``), also where nothing was observed: training asks for it, because the simulator knows it
everywhere. In the building that is imagined so, paths are computed from each subgoal (``learning.imagined_paths``), and
the head is told how much of what the class looks for they reach, and how far it is: paths are easily computed and
hard to learn.

No layer normalises over a batch, and the map is padded to whole squares on the right and below, so a map's answers
never depend on what else is computed with it. Convolutions see where the edge of the array is, and the answers for a
building may depend on where in the array it lies: worlds of a family are placed alike in training and in trials.

References:
    Ronneberger, Fischer and Brox, U-Net: convolutional networks for biomedical image segmentation, MICCAI 2015.
    Perez et al., FiLM: visual reasoning with a general conditioning layer, AAAI 2018.
"""

import dataclasses
import itertools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float32, Int8, Int32, PRNGKeyArray

from potlp_jax.learning.building_config import BuildingConfig
from potlp_jax.learning.imagined_paths import PROSPECTS
from potlp_jax.learning.map_channels import PAINTED, channel_count, of_painting
from potlp_jax.learning.network import Answers, require_phi
from potlp_jax.learning.squares import SQUARE, Squares, numbers_per_square, split

Params = Any
"""Parameters of the network: nested dictionaries of float32 arrays."""

# The logit of P_S, and R_S and R_F before they are made positive.
_OUTPUTS = 3
# Layers of the head that phi modulates.
_MODULATED = 3
# Of the leaky ReLU below 0, where a plain one would pass no gradient.
_SLOPE = 0.1
# Cells to each side of a subgoal, in features of the first scale and of the others, that its head reads.
_CLOSE, _NEAR = 2, 1
# A coordinate of 100 cells enters the head as 1.
_COORDINATE = 100.0


@struct.dataclass(kw_only=True)
class EncodedMap:
    """What the first stage makes of a map; any leading dimensions.

    Attributes:
        cells: the channels that it was made from, as far as the network is shown them.
        close: features of squares of 2 cells.
        scales: features of squares of ``SQUARE`` cells, then of twice the side, and so on.
        whole: of the building as a whole.
        squares: logits of what ``Squares`` holds.
    """

    cells: Float32[Array, "*B H W K"]
    close: Float32[Array, "*B h w F"]
    scales: tuple[Array, ...]
    whole: Float32[Array, "*B G"]
    squares: Squares


def _dense(width: int, gain: float) -> nn.Dense:
    return nn.Dense(width, kernel_init=nn.initializers.variance_scaling(gain, "fan_in", "normal"))


def _convolution(width: int, gain: float) -> nn.Conv:
    return nn.Conv(width, (3, 3), kernel_init=nn.initializers.variance_scaling(gain, "fan_in", "normal"))


def _painted_share(channels: Array) -> Array:
    """Of each square of two by two, the share that was painted, ``[..., rows, columns, 1]``."""
    return jnp.mean(_halved(channels[..., PAINTED, None]), axis=-1, keepdims=True)


def _activated(x: Array) -> Array:
    return nn.leaky_relu(x, _SLOPE)


def _halved(x: Array) -> Array:
    """``[..., rows, columns, channels]`` to one vector for each square of two by two."""
    *batch, rows, columns, channels = x.shape
    x = x.reshape(*batch, rows // 2, 2, columns // 2, 2, channels)
    return jnp.moveaxis(x, -4, -3).reshape(*batch, rows // 2, columns // 2, 4 * channels)


def _doubled(x: Array) -> Array:
    return jnp.repeat(jnp.repeat(x, 2, axis=-3), 2, axis=-2)


class _Block(nn.Module):
    """Two convolutions beside a residual connection; the second one's gain is small, so that many can be stacked."""

    width: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        return x + _convolution(self.width, 0.2)(_activated(_convolution(self.width, 2.0)(x)))


class _Contrast(nn.Module):
    """How much each square differs from the others of its kind in the same building.

    A channel learns to weigh squares by their kind (the far floor of a hallway) and to take a value of each (how white
    it is); the value less its weighted mean over all that was painted is passed on. ``compared`` is the arithmetic.
    """

    channels: int

    @nn.compact
    def __call__(self, x: Array, painted: Array) -> Array:
        weight = nn.sigmoid(_dense(self.channels, 1.0)(x)) * painted
        value = _dense(self.channels, 1.0)(x)
        differs = jnp.concatenate([compared(value, weight), weight], axis=-1)
        differs = _activated(_dense(self.channels, 2.0)(differs))
        # Nothing at first: it corrects what the colours themselves say.
        return nn.Dense(x.shape[-1], kernel_init=nn.initializers.zeros)(differs)


def compared(value: Float32[Array, "*B h w C"], weight: Float32[Array, "*B h w C"]) -> Float32[Array, "*B h w C"]:
    """Values less their mean by weight over rows and columns, times the weight."""
    total = jnp.sum(weight, axis=(-3, -2), keepdims=True)
    # One square's worth of weight on the value 0: where hardly anything was painted the mean says nothing.
    mean = jnp.sum(weight * value, axis=(-3, -2), keepdims=True) / (total + 1)
    return (value - mean) * weight


class _Encoder(nn.Module):
    """The first stage, a U-Net whose way back ends at squares of ``SQUARE`` cells."""

    config: BuildingConfig

    @nn.compact
    def __call__(self, channels: Array) -> EncodedMap:
        config = self.config
        scales = self._down(channels)
        coarsest, width = scales[-1], config.widths[-1]
        # What is known anywhere matters everywhere: that the only fire was found, how large the building is.
        pooled = jnp.concatenate([jnp.mean(coarsest, axis=(-3, -2)), jnp.max(coarsest, axis=(-3, -2))], axis=-1)
        whole = _activated(_dense(width, 2.0)(pooled))
        x = coarsest + _dense(width, 1.0)(whole)[..., None, None, :]
        decoded = []
        for level in range(len(config.widths) - 2, 0, -1):
            width = max(config.decoder, config.widths[level] * 3 // 4)
            x = _activated(_doubled(_dense(width, 1.0)(x)) + _dense(width, 1.0)(scales[level]))
            x = x + _activated(_convolution(width, 0.5)(x))
            decoded.append(x)
        # Small, so that training starts near even odds.
        propositions = len(config.propositions)
        squares = split(_dense(numbers_per_square(propositions), 0.01)(x), propositions)
        return EncodedMap(
            cells=channels, close=scales[0], scales=tuple(reversed(decoded)), whole=whole, squares=squares
        )

    def _down(self, x: Array) -> list[Array]:
        scales, painted = [], _painted_share(x)
        for level, (width, blocks) in enumerate(zip(self.config.widths, self.config.blocks, strict=True)):
            x = _activated(_dense(width, 2.0)(_halved(x)))
            if level == 0 and self.config.contrast:
                x = x + _Contrast(self.config.contrast)(x, painted)
            # The first scale is the largest array; a convolution there would be most of the work.
            if level > 0:
                x = x + _activated(_convolution(width, 0.5)(x))
            for _ in range(blocks):
                x = _Block(width)(x)
            scales.append(x)
        return scales


class _Place(nn.Module):
    """What the head knows of a subgoal before it is asked anything."""

    config: BuildingConfig

    @nn.compact
    def __call__(self, features: Array) -> Array:
        for _ in range(2):
            features = _activated(_dense(self.config.head, 2.0)(features))
        return features


class _Modulation(nn.Module):
    """Scales and shifts of the head's units by phi, ``[..., layers, 2, units]``."""

    config: BuildingConfig

    @nn.compact
    def __call__(self, phi: Array) -> Array:
        condition = _activated(_dense(self.config.condition, 2.0)(phi))
        # A small gain: at the start the condition changes little of what is seen.
        modulation = _dense(_MODULATED * 2 * self.config.head, 0.3)(condition)
        return modulation.reshape(*phi.shape[:-1], _MODULATED, 2, self.config.head)


class _Head(nn.Module):
    config: BuildingConfig

    @nn.compact
    def __call__(self, place: Array, prospects: Array, modulation: Array) -> Array:
        x = place + _activated(_dense(self.config.head, 2.0)(prospects))
        for layer in range(_MODULATED):
            scale, shift = modulation[..., layer, 0, :], modulation[..., layer, 1, :]
            x = _activated(_dense(self.config.head, 2.0)(x) * (1 + scale) + shift)
        # Small, so that training starts near the constant prior.
        return _dense(_OUTPUTS, 0.01)(x)


class _Network(nn.Module):
    config: BuildingConfig

    def setup(self) -> None:
        self.encoder = _Encoder(self.config)
        self.place = _Place(self.config)
        self.modulation = _Modulation(self.config)
        self.head = _Head(self.config)

    def __call__(self, channels: Array, cells: Array, prospects: Array, phi: Array) -> Array:
        places = self.place_of(_read_at(self.encode(channels), cells, self.config))
        return self.answer(places, prospects, self.modulate(phi))

    def encode(self, channels: Array) -> EncodedMap:
        if "painting" in self.config.without:
            channels = jnp.where(of_painting(channels.shape[-1]), 0.0, channels)
        rows, columns = channels.shape[-3:-1]
        batch = ((0, 0),) * (channels.ndim - 3)
        side = self.config.side
        return self.encoder(jnp.pad(channels, (*batch, (0, -rows % side), (0, -columns % side), (0, 0))))

    def place_of(self, features: Array) -> Array:
        return self.place(features)

    def modulate(self, phi: Array) -> Array:
        return self.modulation(phi)

    def answer(self, places: Array, prospects: Array, modulation: Array) -> Array:
        if "paths" in self.config.without:
            prospects = jnp.zeros_like(prospects)
        return self.head(places, prospects, modulation)


def _read_at(encoded: EncodedMap, cells: Int32[Array, "*B S 2"], config: BuildingConfig) -> Float32[Array, "*B S F"]:
    """What the first stage says around cells, at every scale, and of the whole building."""
    # Which cell of a square of two by two is the subgoal, and what colour that one has, the square does not say.
    own = [_around(encoded.cells, cells, config.raw // 2)] if config.raw else []
    close = _around(encoded.close, cells // 2, _CLOSE)
    near = [_around(scale, cells // (SQUARE * 2**level), _NEAR) for level, scale in enumerate(encoded.scales)]
    whole = jnp.broadcast_to(encoded.whole[..., None, :], (*cells.shape[:-1], encoded.whole.shape[-1]))
    position = jnp.float32("position" not in config.without) * cells.astype(jnp.float32) / _COORDINATE
    return jnp.concatenate([*own, close, *near, whole, position], axis=-1)


def _around(features: Float32[Array, "*B h w F"], at: Int32[Array, "*B S 2"], reach: int) -> Float32[Array, "*B S N"]:
    """The features of the ``2 * reach + 1`` squares a side around each place; 0 outside of the array."""
    batch = ((0, 0),) * (features.ndim - 3)
    padded = jnp.pad(features, (*batch, (reach, reach), (reach, reach), (0, 0)))
    columns, steps = padded.shape[-2], np.arange(2 * reach + 1)
    # Flat indices of a window, relative to its first square; of the padded array that is the place itself.
    window = jnp.asarray((steps[:, None] * columns + steps[None, :]).reshape(-1), jnp.int32)
    first = at[..., 0] * columns + at[..., 1]
    index = first[..., None] + jnp.broadcast_to(window, (*first.shape, window.size))
    index = index.reshape(*at.shape[:-2], -1)
    flat = padded.reshape(*padded.shape[:-3], -1, padded.shape[-1])
    found = jnp.take_along_axis(flat, index[..., None], axis=-2)
    return found.reshape(*at.shape[:-1], -1)


@dataclasses.dataclass(frozen=True)
class BuildingNetwork:
    """Pure functions of the parameters. ``*B`` are any leading dimensions, equal in all arguments of a call."""

    config: BuildingConfig

    def init(self, key: PRNGKeyArray) -> Params:
        """New parameters; their shapes do not depend on the map's."""
        side, propositions = self.config.side, len(self.config.propositions)
        channels = jnp.zeros((side, side, channel_count(self.config)))
        initial = jax.jit(_Network(self.config).init)
        asked = jnp.zeros((1, 2), jnp.int32), jnp.zeros((1, PROSPECTS)), jnp.zeros((1, 2 * propositions))
        return initial(key, channels, *asked)["params"]

    def encode(self, params: Params, channels: Float32[Array, "*B H W K"]) -> EncodedMap:
        """The first stage, of ``map_channels.map_channels``."""
        return self._apply(params, "encode", channels)

    def places(self, params: Params, encoded: EncodedMap, cells: Int32[Array, "*B S 2"]) -> Float32[Array, "*B S U"]:
        """What the network knows of subgoals, whatever is asked of them.

        Args:
            params: of the network.
            encoded: the maps, of ``encode``.
            cells: of the subgoals of each map.

        Returns:
            Units of the head, for ``answer``.
        """
        return self._apply(params, "place_of", _read_at(encoded, cells, self.config))

    def modulation(
        self, params: Params, phi_stay: Int8[Array, "*B P"], phi_go: Int8[Array, "*B P"]
    ) -> Float32[Array, "*B layers 2 U"]:
        """What a class does to the head's units; the same for all subgoals.

        Args:
            params: of the network.
            phi_stay, phi_go: of the classes: 1 for what has to hold, -1 for what must not, 0 for what does not matter.

        Returns:
            A factor and a summand for each unit of each layer.

        Raises:
            NetworkError: the vectors phi have another length than the network's propositions.
        """
        require_phi(phi_stay, phi_go, self.config.propositions)
        phi = jnp.concatenate([phi_stay, phi_go], axis=-1).astype(jnp.float32)
        return self._apply(params, "modulate", phi)

    def answer(
        self,
        params: Params,
        places: Float32[Array, "*P U"],
        prospects: Float32[Array, "*Q N"],
        modulation: Float32[Array, "*M layers 2 U"],
    ) -> Answers:
        """The second stage; equally many leading dimensions, which are broadcast against each other.

        Args:
            params: of the network.
            places: of ``places``.
            prospects: of ``imagined_paths.prospects``.
            modulation: of ``modulation``.

        Returns:
            Logits of P_S, and R_S and R_F in the unit of the network's costs, above 0.
        """
        logit, success, failure = jnp.moveaxis(self._apply(params, "answer", places, prospects, modulation), -1, 0)
        # Softplus keeps costs positive; a success costs at least one step of the grid.
        return Answers(
            success_logit=logit,
            success_cost=jnp.float32(self.config.step)
            + jnp.float32(self.config.success_cost_scale) * jax.nn.softplus(success),
            failure_cost=jnp.float32(self.config.failure_cost_scale) * jax.nn.softplus(failure),
        )

    def _apply(self, params: Params, method: str, *arguments: Any) -> Any:
        return _Network(self.config).apply({"params": params}, *arguments, method=method)


def building_operations(config: BuildingConfig, height: int, width: int) -> tuple[int, int, int]:
    """Floating-point operations forward: per map (first stage), per subgoal, and per (subgoal, class) pair.

    Two per multiplication of a matrix product, as in ``network.operation_counts``.

    Args:
        config: of the network.
        height, width: of the map's array, in cells; it is padded to whole squares.

    Returns:
        The three counts.
    """
    rows, columns = (-(-size // config.side) * config.side for size in (height, width))
    areas = [rows * columns // 4 ** (level + 1) for level in range(len(config.widths))]
    inputs = [channel_count(config), *config.widths[:-1]]
    first = sum(2 * area * 4 * i * o for area, i, o in zip(areas, inputs, config.widths, strict=True))
    contrast, widest = config.contrast, config.widths[0]
    first += 2 * areas[0] * contrast * (2 * widest + 2 * contrast + widest)
    convolutions = [2 * blocks + (level > 0) for level, blocks in enumerate(config.blocks)]
    first += sum(2 * area * 9 * o * o * n for area, o, n in zip(areas, config.widths, convolutions, strict=True))
    decoded = [max(config.decoder, width * 3 // 4) for width in config.widths[1:-1]]
    for level, (o, below) in enumerate(zip(decoded, [*decoded[1:], config.widths[-1]], strict=True), start=1):
        first += 2 * areas[level] * (config.widths[level] * o + 9 * o * o) + 2 * areas[level + 1] * below * o
    first += 2 * areas[1] * decoded[0] * numbers_per_square(len(config.propositions)) + 2 * 3 * config.widths[-1] ** 2
    read = (2 * _CLOSE + 1) ** 2 * config.widths[0] + (2 * _NEAR + 1) ** 2 * sum(decoded) + config.widths[-1] + 2
    read += config.raw**2 * channel_count(config)
    place = sum(2 * i * o for i, o in itertools.pairwise((read, config.head, config.head)))
    return first, place, 2 * config.head * (PROSPECTS + _MODULATED * config.head + _OUTPUTS)
