"""Batches of training data: some views and several samples of each; a network's first stage runs once per view.

The batch of a step depends on (seed, step) alone: every epoch has its own permutation of the views and its own choice
of samples.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32, Int8, Int32, Int64

from potlp_jax.errors import TrainingError
from potlp_jax.learning.dataset import Samples

_COLUMNS = ("phi_stay", "phi_go", "success", "success_cost", "failure_cost", "success_weight", "failure_weight")
"""Of a data set, in every batch."""

# Batches decoded ahead: a few, because each holds its images as pixels.
_PREFETCHED = 4


Inputs = Any
"""What a network is shown of the views of a batch: a pytree, of a class of its own for each architecture."""


@struct.dataclass(kw_only=True)
class Batch:
    """``G`` views with ``K`` samples each; ``mask`` is True where a sample is real."""

    inputs: Inputs
    phi_stay: Int8[Array, "G K P"]
    phi_go: Int8[Array, "G K P"]
    success: Float32[Array, "G K"]
    """The true P_S."""
    success_cost: Float32[Array, "G K"]
    """The true R_S; NaN where P_S = 0."""
    failure_cost: Float32[Array, "G K"]
    """The true R_F."""
    success_weight: Float32[Array, "G K"]
    failure_weight: Float32[Array, "G K"]
    mask: Bool[Array, "G K"]


@dataclasses.dataclass(frozen=True)
class Choice:
    """Which samples a batch holds.

    Attributes:
        views: of the data set.
        real: True for the rows of the batch; those that fill it up show a view of it again.
        index: of the samples; where masked, another one of the same view.
        mask: True where a sample is real.
    """

    views: Int64[np.ndarray, " G"]
    real: Bool[np.ndarray, " G"]
    index: Int64[np.ndarray, "G K"]
    mask: Bool[np.ndarray, "G K"]


@dataclasses.dataclass(frozen=True)
class Share:
    """The rows of every batch that one process makes; all are made where there is one.

    Attributes:
        index, count: which of how many equal parts.
        devices: of all processes; batches are filled up with rows that count nothing, so that all have equally many.
    """

    index: int = 0
    count: int = 1
    devices: int = 1


class Batches:
    """The batches of a data set, each a function of its number.

    Args:
        samples: the data; views without samples are never drawn.
        make_inputs: what the network is shown of a choice of samples; called from another thread.
        views, samples_per_view: shape of a batch.
        seed: of the order.
        usable: True for the samples that take part; all by default.
        share: which rows of the batches are made.
    """

    def __init__(
        self,
        samples: Samples,
        make_inputs: Callable[[Samples, Choice], Inputs],
        views: int,
        samples_per_view: int,
        seed: int,
        usable: Bool[np.ndarray, "N"] | None = None,
        share: Share = Share(),
    ) -> None:
        taking_part = np.arange(len(samples.view_of)) if usable is None else np.flatnonzero(usable)
        # Checked here, where every use of a data set begins.
        if not len(taking_part):
            raise TrainingError("the data set has no samples")
        self._samples, self._make_inputs = samples, make_inputs
        self._seed = seed
        # Stable, so that the samples of a view keep the data set's order and batches do not depend on the sort.
        view_of = samples.view_of[taking_part]
        sort = np.argsort(view_of, kind="stable")
        self.order = taking_part[sort]
        """The samples in the order in which ``evaluation_batches`` gives them."""
        self._views, first, counts = np.unique(view_of[sort], return_index=True, return_counts=True)
        self._members = [self.order[start : start + count] for start, count in zip(first, counts, strict=True)]
        # A data set smaller than a batch makes batches of its own size.
        self.views = min(views, len(self._views))
        self.samples_per_view = samples_per_view
        self._rows = -(-self.views // share.devices) * share.devices
        part = self._rows // share.count
        self._own = slice(share.index * part, (share.index + 1) * part)
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
        first_view, members_of_first = groups[0]
        # A row too many repeats a view of the batch, and padding a sample of its own view, so that neither asks about
        # anything new.
        filling = [(first_view, members_of_first[:1])] * (self._rows - len(groups))
        own = [*groups, *filling][self._own]
        real = (np.arange(self._rows) < len(groups))[self._own]
        index = np.zeros((len(own), self.samples_per_view), np.int64)
        mask = np.zeros(index.shape, bool)
        for row, (_, members) in enumerate(own):
            index[row] = members[0]
            index[row, : len(members)] = members
            mask[row, : len(members)] = real[row]
        choice = Choice(
            views=self._views[[view for view, _ in own]].astype(np.int64), real=real, index=index, mask=mask
        )
        columns = {name: jnp.asarray(getattr(self._samples, name)[index]) for name in _COLUMNS}
        return Batch(inputs=self._make_inputs(self._samples, choice), mask=jnp.asarray(mask), **columns)


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
