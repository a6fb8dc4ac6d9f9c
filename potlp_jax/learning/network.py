"""The estimator: P_S, R_S and R_F from a panorama, a distance and the vectors phi (Bradley et al. 2021, section IV-B).

Four convolutions encode the panorama (the first stage, once per panorama); the distance and both phi are then joined
to every spatial element; eight more convolutions and five fully connected layers answer (the second stage, once per
subgoal and outcome class). This is the only module that imports Flax's modules.

**One panorama, many subgoals.** All convolutions pad circularly across the image's width, and the first stage's total
stride is ``STRIDE`` = 16, so rolling the image by 16 px rolls the features by one column, exactly. The paper's network
sees an image centred on the subgoal; here the features are rolled instead, by the multiple of 16 px nearest to the
subgoal's bearing. What is left of the bearing, at most half a column, enters the second stage as sine and cosine.

**What differs from the textbook layer.** The first two convolutions have kernels as large as their strides (4 and 2):
such a convolution is a matrix product of patches, whose gradient costs a CPU several times less than that of
overlapping strided kernels. A condition that is constant over the image passes a convolution as one vector per sample,
so the second stage's first layer adds ``W @ condition`` to every element instead of convolving copies of it. Circular
padding hides from a convolution where the centre is: a learned bias per spatial element says it. Layers that keep the
shape have a residual connection. There is no normalisation layer: one panorama's answer never depends on the batch.

With ``fovea``, a patch of pixels around the subgoal is an input of its own (``learning.fovea``), and the condition
scales what is made of it: which colours matter depends on who is looked for. The pixels travel as further channels of
the features.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float32, Int8, PRNGKeyArray, UInt8

from potlp_jax.checks import POSITIVE, require_fields
from potlp_jax.errors import NetworkError
from potlp_jax.learning.fovea import ABOVE, BAND, BELOW, bands_of, packed, patch, unpacked
from potlp_jax.task.propositions import require_same_propositions
from potlp_jax.world.camera import CameraConfig, floor_rows

Params = Any
"""Parameters of the network: nested dictionaries of float32 arrays, ``{"first": ..., "second": ...}``."""

STRIDE: int = 16
"""Pixels of the image per column (and row) of the features."""

# The strides multiply to STRIDE; the kernels of the first two layers equal their strides, for the reason given above.
_FIRST_KERNELS = (4, 2, 3, 3)
_FIRST_STRIDES = (4, 2, 2, 1)
_SECOND_STRIDES = (2, 1, 1, 1, 2, 1, 1, 1)
# The logit of P_S, and R_S and R_F before they are made positive.
_OUTPUTS = 3
# Channels in which the bands of pixels of a fovea travel with the features.
_FINE = STRIDE // BAND * STRIDE * 3
# Units of the layers that read the fovea; their sizes were not tuned (docs/results/delivery.md).
_FOVEA_WIDTHS = (256, 128)
# Of the leaky ReLU below 0, where a plain one would pass no gradient.
_SLOPE = 0.1


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """Everything that, with the parameters, defines the answers; it is stored in every estimator's file.

    Attributes:
        propositions: Sigma: the meaning of the entries of both phi, in order.
        image_shape: rows and columns of the panorama; the rows a multiple of 64, the columns of 64 too.
        first_widths: channels of the four convolutions before phi is joined.
        second_widths: channels of the eight after.
        dense_widths: units of the first four fully connected layers; the fifth has the three outputs.
        fovea: columns of pixels on each side of the subgoal that are looked at closely; 0 for none.
        horizon, far, fold: of the camera (``CameraConfig``), for the row in which a subgoal is looked for.
        distance_scale: the distance is divided by it.
        success_cost_scale, failure_cost_scale: unit of the outputs R_S and R_F, and of their errors in the loss
            (standard deviations over the training data).
        step: the least R_S, one step of the grid, in the unit of cost.
        pixel_mean, pixel_scale: pixels in [0, 1] enter as ``(pixel - pixel_mean) / pixel_scale``.
        exclusive_within: subgoals so many cells apart exclude each other (``learning.exclusion.exclusive_chances``); a
            property of the buildings, which ``eval.exclusion`` measures. 0: attempts are independent, as in Eq. 3.
    """

    propositions: tuple[str, ...]
    image_shape: tuple[int, int] = (128, 512)
    first_widths: tuple[int, ...] = (16, 32, 48, 48)
    second_widths: tuple[int, ...] = (32, 32, 32, 32, 48, 48, 48, 48)
    dense_widths: tuple[int, ...] = (128, 64, 64, 32)
    fovea: int = 0
    horizon: float = CameraConfig.horizon
    far: float = CameraConfig.far
    fold: float = CameraConfig.fold
    distance_scale: float = 30.0
    success_cost_scale: float = 30.0
    failure_cost_scale: float = 30.0
    step: float = 1.0
    pixel_mean: float = 0.5
    pixel_scale: float = 0.25
    exclusive_within: float = 0.0

    def __post_init__(self) -> None:
        for name, count in (
            ("first_widths", len(_FIRST_STRIDES)),
            ("second_widths", len(_SECOND_STRIDES)),
            ("dense_widths", 4),
        ):
            widths = getattr(self, name)
            if len(widths) != count or min(widths) < 1:
                raise NetworkError(f"{name} is {widths}; give {count} positive numbers")
        # Every stage halves or quarters the image: what remains must be whole.
        side = STRIDE * math.prod(_SECOND_STRIDES)
        if any(size < side or size % side for size in self.image_shape):
            raise NetworkError(f"image_shape is {self.image_shape}; rows and columns must be multiples of {side}")
        scales = ("distance_scale", "success_cost_scale", "failure_cost_scale", "step", "pixel_scale", "far", "fold")
        require_fields(self, scales, POSITIVE, NetworkError)
        if not (math.isfinite(self.exclusive_within) and self.exclusive_within >= 0):
            raise NetworkError(f"exclusive_within is {self.exclusive_within}; give a number of cells, 0 for none")
        if not math.isfinite(self.horizon):
            raise NetworkError(f"horizon is {self.horizon}; give a number of rows")
        if not 0 <= 2 * self.fovea < self.image_shape[1]:
            raise NetworkError(f"fovea is {self.fovea}; give a number of columns, less than half the image's")
        if not self.propositions:
            raise NetworkError("propositions is empty; name at least one")

    @property
    def feature_shape(self) -> tuple[int, int, int]:
        """Rows, columns and channels of the first stage's output."""
        rows, columns = self.image_shape
        return rows // STRIDE, columns // STRIDE, self.first_widths[-1] + (_FINE if self.fovea else 0)


@struct.dataclass(kw_only=True)
class Answers:
    """What the network says of (subgoal, class) pairs; costs in the unit of the training data's costs."""

    success_logit: Float32[Array, "*B"]
    """Log odds of P_S."""
    success_cost: Float32[Array, "*B"]
    """R_S, at least one step."""
    failure_cost: Float32[Array, "*B"]
    """R_F, at least 0."""

    @property
    def success_probability(self) -> Float32[Array, "*B"]:
        """P_S."""
        return jax.nn.sigmoid(self.success_logit)


def _deviation(gain: float) -> Callable[..., Array]:
    """Initialiser that gives the standard deviation ``sqrt(gain / inputs)``; ``EstimatorNetwork.init`` draws."""

    # The deviation in place of a draw: EstimatorNetwork.init multiplies it by noise drawn once for all leaves.
    def fill(key: PRNGKeyArray, shape: tuple[int, ...], dtype: Any = jnp.float32) -> Array:
        return jnp.full(shape, math.sqrt(gain / math.prod(shape[:-1])), dtype)

    return fill


@struct.dataclass(kw_only=True)
class CentredView:
    """A panorama turned toward a subgoal: what ``EstimatorNetwork.centre`` makes of it."""

    features: Float32[Array, "*B feature_rows feature_columns F"]
    """Rolled by whole columns so that the subgoal's bearing is in the centre."""
    residual: Float32[Array, "*B"]
    """The angle that is left, at most half a column; positive where the subgoal lies to the right of the centre."""
    distance: Float32[Array, "*B"]
    """From the panorama's pose to the subgoal."""
    fovea: Float32[Array, "*B patch_rows patch_columns 3"] | None
    """The pixels around the subgoal; None for a network without a fovea."""


class _Convolution(nn.Module):
    """Convolution and leaky ReLU: circular across the width, zeros above and below; patches where kernel = stride."""

    width: int
    kernel: int
    stride: int
    gain: float = 2.0

    @nn.compact
    def __call__(self, x: Array, added: Array | None = None) -> Array:
        initial = _deviation(self.gain)
        if self.kernel == self.stride:
            x = nn.Dense(self.width, kernel_init=initial)(_patches(x, self.stride))
        else:
            edge = self.kernel // 2
            # The panorama is a circle: its left neighbour is its right edge. Above and below there is nothing.
            x = jnp.concatenate([x[..., -edge:, :], x, x[..., :edge, :]], axis=-2)
            kernel, strides = (self.kernel, self.kernel), (self.stride, self.stride)
            x = nn.Conv(self.width, kernel, strides, padding=((edge, edge), (0, 0)), kernel_init=initial)(x)
        return nn.leaky_relu(x if added is None else x + added, _SLOPE)


def _patches(x: Array, side: int) -> Array:
    """``[..., rows, columns, channels]`` to one vector of ``side * side * channels`` per patch."""
    *batch, rows, columns, channels = x.shape
    x = x.reshape(*batch, rows // side, side, columns // side, side, channels)
    return jnp.moveaxis(x, -4, -3).reshape(*batch, rows // side, columns // side, side * side * channels)


class _FirstStage(nn.Module):
    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, pixels: Array) -> Array:
        x = pixels
        for width, kernel, stride in zip(self.widths, _FIRST_KERNELS, _FIRST_STRIDES, strict=True):
            x = _Convolution(width, kernel, stride)(x)
        return x


class _Modulated(nn.Module):
    """A fully connected layer whose units the condition scales and shifts (FiLM, Perez et al. 2018), and leaky ReLU."""

    width: int

    @nn.compact
    def __call__(self, x: Array, condition: Array) -> Array:
        # A small gain: at the start the condition hardly changes what is seen.
        scale, shift = (nn.Dense(self.width, use_bias=False, kernel_init=_deviation(0.1))(condition) for _ in range(2))
        return nn.leaky_relu(nn.Dense(self.width, kernel_init=_deviation(2.0))(x) * (1 + scale) + shift, _SLOPE)


class _SecondStage(nn.Module):
    widths: tuple[int, ...]
    dense_widths: tuple[int, ...]

    @nn.compact
    def __call__(self, features: Array, condition: Array, fovea: Array | None) -> Array:
        """``[B, rows, columns, F]``, ``[B, conditions]`` and the fovea, ``[B, pixels]``, to ``[B, 3]``."""
        x = self._joined(features, condition)
        for width, stride in zip(self.widths[1:], _SECOND_STRIDES[1:], strict=True):
            keeps = stride == 1 and width == x.shape[-1]
            # Each residual layer adds to the variance; a small gain keeps seven of them in bounds.
            y = _Convolution(width, 3, stride, gain=0.5 if keeps else 2.0)(x)
            # Where the shape changes there is nothing to add to.
            x = x + y if keeps else y
        # No pooling: where something is seen matters as much as what is.
        x = x.reshape(x.shape[0], -1)
        if fovea is not None:
            seen = fovea
            for width in _FOVEA_WIDTHS:
                seen = _Modulated(width)(seen, condition)
            x = jnp.concatenate([x, seen], axis=-1)
        for width in self.dense_widths:
            x = nn.leaky_relu(nn.Dense(width, kernel_init=_deviation(2.0))(x), _SLOPE)
        # Small, so that training starts near the constant prior.
        return nn.Dense(_OUTPUTS, kernel_init=_deviation(0.01))(x)

    def _joined(self, features: Array, condition: Array) -> Array:
        """The first convolution of ``features`` with ``condition`` joined to every element (and to the padding)."""
        width, stride = self.widths[0], _SECOND_STRIDES[0]
        shape = (features.shape[1] // stride, features.shape[2] // stride, width)
        # Circular padding hides where the centre is; this bias says it (see above).
        position = self.param("position", nn.initializers.constant(0.1), shape)
        # A constant passes a convolution as one vector: no copies of the condition are convolved.
        of_condition = nn.Dense(width, use_bias=False, kernel_init=_deviation(2.0))(condition)
        return _Convolution(width, 3, stride)(features, position[None] + of_condition[:, None, None, :])


@dataclasses.dataclass(frozen=True)
class EstimatorNetwork:
    """Pure functions of the parameters. ``*B`` are any leading dimensions, equal in all arguments of a call.

    Angles are bearings in the map's plane in radians, 0 along increasing columns, growing clockwise as seen on the map
    with row 0 on top; the panorama's centre looks along bearing 0, and its right half along positive bearings.
    """

    config: NetworkConfig

    def init(self, key: PRNGKeyArray) -> Params:
        """New parameters: normal with the standard deviations of the modules' initialisers, biases 0."""
        # One program, and one random vector for all: drawn leaf by leaf, the generator is compiled once for each.
        return jax.jit(self._drawn)(key)

    def _drawn(self, key: PRNGKeyArray) -> Params:
        leaves, structure = jax.tree.flatten(self._deviations())
        noise = jax.random.normal(key, (sum(leaf.size for leaf in leaves),))
        ends = np.cumsum([leaf.size for leaf in leaves]).tolist()
        parts = [noise[end - leaf.size : end].reshape(leaf.shape) for end, leaf in zip(ends, leaves, strict=True)]
        return jax.tree.unflatten(structure, [leaf * part for leaf, part in zip(leaves, parts, strict=True)])

    def _deviations(self) -> Params:
        key = jax.random.key(0)
        pixels = jnp.zeros((1, *self.config.image_shape, 3))
        conditions = jnp.zeros((1, 2 * len(self.config.propositions) + 3))
        centred = jax.tree.map(
            lambda leaf: leaf[None], self.centre(jnp.zeros(self.config.feature_shape), *[jnp.zeros(())] * 2)
        )
        return {
            "first": self._first.init(key, pixels)["params"],
            "second": self._second.init(key, centred.features, conditions, _flat_fovea(centred))["params"],
        }

    def encode(
        self, params: Params, image: UInt8[Array, "*B rows columns 3"]
    ) -> Float32[Array, "*B feature_rows feature_columns F"]:
        """The first stage: features of panoramas in the world's frame. Raises NetworkError for another image size."""
        return self.encode_pixels(params, image.astype(jnp.float32) / jnp.float32(255))

    def encode_pixels(
        self, params: Params, pixels: Float32[Array, "*B rows columns 3"]
    ) -> Float32[Array, "*B feature_rows feature_columns F"]:
        """The first stage for pixels in [0, 1]."""
        if pixels.shape[-3:-1] != self.config.image_shape:
            raise NetworkError(f"image of {pixels.shape[-3:-1]}; this network was made for {self.config.image_shape}")
        # Fixed numbers of the configuration and not of the batch, so that one panorama's features never change.
        normalised = (pixels - jnp.float32(self.config.pixel_mean)) / jnp.float32(self.config.pixel_scale)
        flat = normalised.reshape(-1, *normalised.shape[-3:])
        features = self._first.apply({"params": params["first"]}, flat)
        assert isinstance(features, jax.Array)
        if self.config.fovea:
            # The pixels themselves come along, so that memory holds one array per panorama.
            features = jnp.concatenate([features, packed(bands_of(flat), STRIDE)], axis=-1)
        return features.reshape(*pixels.shape[:-3], *features.shape[1:])

    def centre(
        self,
        features: Float32[Array, "feature_rows feature_columns F"],
        bearing: Float32[Array, "*B"],
        distance: Float32[Array, "*B"],
    ) -> CentredView:
        """One panorama, as ``encode`` gives it, seen toward subgoals.

        Args:
            features: of one panorama.
            bearing: of the subgoals from where it was taken.
            distance: through known space from there to each subgoal, in the unit of ``config.step``.

        Returns:
            What ``answer`` asks about, for each subgoal.
        """
        fovea = None
        if self.config.fovea:
            # The camera counts in cells; the distance is in the unit of cost.
            row = floor_rows(self._camera, distance / jnp.float32(self.config.step))
            # Pixels depend on no parameter; said here, no gradient is scattered back into the panorama.
            bands = jax.lax.stop_gradient(unpacked(features[..., -_FINE:], STRIDE))
            fovea = patch(bands, bearing, row, self.config.fovea)
            features = features[..., :-_FINE]
        # Whole columns are rolled, which is exact; the rest of the angle goes into the condition.
        columns = features.shape[1]
        column = jnp.float32(2 * math.pi / columns)
        shift = jnp.round(bearing / column)
        own = jnp.broadcast_to(jnp.arange(columns, dtype=jnp.int32), (*shift.shape, columns))
        source = (own + shift[..., None].astype(jnp.int32)) % columns
        rolled = jnp.moveaxis(features[:, source], 0, -3)
        return CentredView(features=rolled, residual=bearing - shift * column, distance=distance, fovea=fovea)

    def answer(
        self, params: Params, centred: CentredView, phi_stay: Int8[Array, "*B P"], phi_go: Int8[Array, "*B P"]
    ) -> Answers:
        """The second stage.

        Args:
            params: as ``init`` made them, or trained.
            centred: panoramas turned toward subgoals; ``*B`` are its leading dimensions.
            phi_stay, phi_go: the class of each pair, entries -1, 0, 1 in the order of ``config.propositions``.

        Returns:
            One answer for each pair.

        Raises:
            NetworkError: the vectors phi have another length than the network's propositions.
        """
        require_phi(phi_stay, phi_go, self.config.propositions)
        # Half a column is turned into a quarter of a circle: the sine then uses its whole range.
        angle = centred.residual * jnp.float32(self.config.feature_shape[1] / 2)
        scaled = centred.distance / jnp.float32(self.config.distance_scale)
        scalars = jnp.stack([scaled, jnp.sin(angle), jnp.cos(angle)], axis=-1)
        condition = jnp.concatenate([phi_stay.astype(jnp.float32), phi_go.astype(jnp.float32), scalars], axis=-1)
        outputs = self._second.apply(
            {"params": params["second"]},
            centred.features.reshape(-1, *centred.features.shape[-3:]),
            condition.reshape(-1, condition.shape[-1]),
            _flat_fovea(centred),
        )
        assert isinstance(outputs, jax.Array)
        logit, success, failure = jnp.moveaxis(outputs.reshape(*centred.distance.shape, _OUTPUTS), -1, 0)
        # Softplus keeps costs positive; a success costs at least one step of the grid.
        return Answers(
            success_logit=logit,
            success_cost=jnp.float32(self.config.step)
            + jnp.float32(self.config.success_cost_scale) * jax.nn.softplus(success),
            failure_cost=jnp.float32(self.config.failure_cost_scale) * jax.nn.softplus(failure),
        )

    @property
    def _camera(self) -> CameraConfig:
        rows, columns = self.config.image_shape
        config = self.config
        return CameraConfig(height=rows, width=columns, horizon=config.horizon, far=config.far, fold=config.fold)

    @property
    def _first(self) -> _FirstStage:
        return _FirstStage(self.config.first_widths)

    @property
    def _second(self) -> _SecondStage:
        return _SecondStage(self.config.second_widths, self.config.dense_widths)


def _flat_fovea(centred: CentredView) -> Float32[Array, "B pixels"] | None:
    return None if centred.fovea is None else centred.fovea.reshape(-1, math.prod(centred.fovea.shape[-3:]))


def require_phi(phi_stay: Int8[Array, "*B P"], phi_go: Int8[Array, "*B P"], propositions: tuple[str, ...]) -> None:
    """Check that the vectors phi have an entry for each proposition.

    Args:
        phi_stay, phi_go: of classes, any leading dimensions.
        propositions: of the network.

    Raises:
        NetworkError: they have more or fewer.
    """
    expected = len(propositions)
    if phi_stay.shape[-1] != expected or phi_go.shape[-1] != expected:
        raise NetworkError(
            f"phi of lengths {phi_stay.shape[-1]} and {phi_go.shape[-1]}; this network knows {expected} "
            f"propositions: {', '.join(propositions)}"
        )


def require_propositions(
    known: tuple[str, ...], propositions: tuple[str, ...], where: str, asker: str = "the task"
) -> None:
    """Check that an estimator was trained with these propositions, in this order.

    Args:
        known: those of the estimator's network.
        propositions: those of the task or the data.
        where: names the estimator in the message.
        asker: names the task or the data.

    Raises:
        PropositionsError: it was not.
    """
    # An entry of phi means what its position says, as a bit of a letter does.
    require_same_propositions(
        propositions,
        known,
        asker=asker,
        knower=where,
        remedy="give an estimator that was trained for the former, or train one (docs/estimator.md)",
    )


def parameter_count(params: Params) -> int:
    """Number of parameters."""
    return sum(leaf.size for leaf in jax.tree.leaves(params))


def operation_counts(config: NetworkConfig) -> tuple[int, int]:
    """Floating-point operations forward, per panorama (first stage) and per (subgoal, class) pair (second stage).

    Two per multiplication of a matrix product: a convolution counts ``2 * rows * columns * kernel^2 * in * out`` at its
    output's size, a dense layer ``2 * in * out``. A training step's floor is three times these: forward, and backward
    once to the inputs and once to the parameters (less the first layer's inputs, which need no gradient).
    """
    first = _convolution_operations(config.image_shape, 3, config.first_widths, _FIRST_KERNELS, _FIRST_STRIDES)
    rows, columns, _ = config.feature_shape
    channels = config.first_widths[-1]
    kernels = (3,) * len(config.second_widths)
    second = _convolution_operations((rows, columns), channels, config.second_widths, kernels, _SECOND_STRIDES)
    conditions = 2 * len(config.propositions) + 3
    second += 2 * conditions * config.second_widths[0]
    shrink = math.prod(_SECOND_STRIDES)
    flat = (rows // shrink) * (columns // shrink) * config.second_widths[-1]
    if config.fovea:
        seen = [(ABOVE + BELOW) * (2 * config.fovea + 1) * 3, *_FOVEA_WIDTHS]
        second += sum(2 * (i + 2 * conditions) * o for i, o in itertools.pairwise(seen))
        flat += seen[-1]
    units = [flat, *config.dense_widths, _OUTPUTS]
    return first, second + sum(2 * i * o for i, o in itertools.pairwise(units))


def _convolution_operations(
    size: tuple[int, int], channels: int, widths: tuple[int, ...], kernels: tuple[int, ...], strides: tuple[int, ...]
) -> int:
    rows, columns = size
    total = 0
    for width, kernel, stride in zip(widths, kernels, strides, strict=True):
        rows, columns = rows // stride, columns // stride
        total += 2 * rows * columns * kernel**2 * channels * width
        channels = width
    return total
