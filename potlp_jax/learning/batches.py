"""Batches of training data: some panoramas and several samples of each; the first stage runs once per panorama.

The batch of a step depends on (seed, step) alone: every epoch has its own permutation of the views and its own choice
of samples.
"""

import functools
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32, Int8, Int32, UInt8

from potlp_jax.errors import TrainingError
from potlp_jax.learning.dataset import Samples, decode
from potlp_jax.learning.network import Answers, EstimatorNetwork, Params

# Batches decoded ahead: a few, because each holds its images as pixels.
_PREFETCHED = 4


@struct.dataclass(kw_only=True)
class Batch:
    """``G`` panoramas with ``K`` samples each; ``mask`` is True where a sample is real."""

    images: UInt8[Array, "G rows columns 3"]
    bearing: Float32[Array, "G K"]
    distance: Float32[Array, "G K"]
    phi_stay: Int8[Array, "G K P"]
    phi_go: Int8[Array, "G K P"]
    success: Float32[Array, "G K"]
    """The true P_S."""
    success_cost: Float32[Array, "G K"]
    """The true R_S; NaN where P_S = 0."""
    failure_cost: Float32[Array, "G K"]
    """The true R_F; may be NaN where it is not known."""
    success_weight: Float32[Array, "G K"]
    failure_weight: Float32[Array, "G K"]
    mask: Bool[Array, "G K"]


class Batches:
    """The batches of a data set, each a function of its number.

    Args:
        samples: the data; views without samples are never drawn.
        views, samples_per_view: shape of a batch.
        seed: of the order.
    """

    def __init__(self, samples: Samples, views: int, samples_per_view: int, seed: int) -> None:
        # Checked here, where every use of a data set begins.
        if not len(samples.view_of):
            raise TrainingError("the data set has no samples")
        self._samples = samples
        self._seed = seed
        # Stable, so that the samples of a view keep the data set's order and batches do not depend on the sort.
        self._order = np.argsort(samples.view_of, kind="stable")
        self._views, first, counts = np.unique(samples.view_of[self._order], return_index=True, return_counts=True)
        self._members = [self._order[start : start + count] for start, count in zip(first, counts, strict=True)]
        # A data set smaller than a batch makes batches of its own size.
        self.views = min(views, len(self._views))
        self.samples_per_view = samples_per_view
        self.per_epoch = len(self._views) // self.views
        # Two epochs are remembered: batches are made ahead, so that one may begin before the other has ended.
        self._permutation = functools.lru_cache(2)(
            lambda epoch: np.random.default_rng((seed, epoch)).permutation(len(self._views))
        )

    def training_batch(self, step: int) -> Batch:
        """The batch of this step; an epoch's last views that fill no batch are left out of that epoch."""
        epoch, index = divmod(step, self.per_epoch)
        chosen = self._permutation(epoch)[index * self.views : (index + 1) * self.views]
        return self._batch([(view, self._choice(epoch, view)) for view in chosen.tolist()])

    def evaluation_batches(self) -> Iterator[Batch]:
        """Every sample once, in a fixed order; a view with many samples comes several times."""
        size = self.samples_per_view
        groups = [
            (view, members[start : start + size])
            for view, members in enumerate(self._members)
            for start in range(0, len(members), size)
        ]
        blocks = [groups[start : start + self.views] for start in range(0, len(groups), self.views)]
        return prefetched(lambda index: self._batch(blocks[index]), 0, len(blocks))

    def _choice(self, epoch: int, view: int) -> Int32[np.ndarray, " k"] | np.ndarray:
        members = self._members[view]
        if len(members) <= self.samples_per_view:
            return members
        # The last number keeps these draws apart from those of the permutation, whose seed is (seed, epoch).
        random = np.random.default_rng((self._seed, epoch, view, 1))
        return random.choice(members, self.samples_per_view, replace=False)

    def _batch(self, groups: list[tuple[int, np.ndarray]]) -> Batch:
        index = np.zeros((self.views, self.samples_per_view), np.int64)
        mask = np.zeros(index.shape, bool)
        for row, (_, members) in enumerate(groups):
            index[row, : len(members)] = members
            mask[row, : len(members)] = True
        images = [decode(self._samples.images[self._views[view]]) for view, _ in groups]
        # The last group of an evaluation may be short: black panoramas fill it up, and their samples are masked.
        images += [np.zeros_like(images[0])] * (self.views - len(groups))
        columns = {
            name: jnp.asarray(getattr(self._samples, name)[index])
            for name in Batch.__dataclass_fields__
            if name not in ("images", "mask")
        }
        return Batch(images=jnp.asarray(np.stack(images)), mask=jnp.asarray(mask), **columns)


def prefetched(make: Callable[[int], Batch], start: int, stop: int) -> Iterator[Batch]:
    """``make(start)``, ..., ``make(stop - 1)`` in this order, made a few ahead in another thread.

    Args:
        make: the batch of a number; OpenCV decodes without Python's lock, so it runs beside the caller.
        start, stop: the range of numbers.

    Returns:
        An iterator; closing it cancels what was not made yet.
    """
    with ThreadPoolExecutor(1, thread_name_prefix="decode") as pool:
        pending = [pool.submit(make, number) for number in range(start, min(start + _PREFETCHED, stop))]
        try:
            for number in range(start, stop):
                batch = pending.pop(0).result()
                if number + _PREFETCHED < stop:
                    pending.append(pool.submit(make, number + _PREFETCHED))
                yield batch
        finally:
            for future in pending:
                future.cancel()


def batch_answers(
    network: EstimatorNetwork,
    params: Params,
    pixels: Float32[Array, "G rows columns 3"],
    bearing: Float32[Array, "G K"],
    batch: Batch,
) -> Answers:
    """The network's answers for a batch: the first stage once per panorama.

    Args:
        network, params: the estimator.
        pixels: in [0, 1], perhaps augmented.
        bearing: of the subgoals, mirrored where the pixels are.
        batch: the rest of what is asked; its images and bearings are not used.

    Returns:
        Answers of shape ``G K``, also where the batch is padded.
    """
    features = network.encode_pixels(params, pixels)
    centred = jax.vmap(network.centre)(features, bearing, batch.distance)
    return network.answer(params, centred, batch.phi_stay, batch.phi_go)
