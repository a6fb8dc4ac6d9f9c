"""What training and evaluation need of a network, whatever its architecture."""

from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Bool, Float32, Int8, PRNGKeyArray

from potlp_jax.learning.augmentation import Augmentation
from potlp_jax.learning.batches import Choice, Inputs
from potlp_jax.learning.dataset import Samples
from potlp_jax.learning.network import Answers, Params


@runtime_checkable
class Learner(Protocol):
    """A network and how it is shown a data set; hashable, since compiled steps are kept for each.

    Attributes:
        config: of the network, with ``propositions`` and the scales of costs.
    """

    @property
    def config(self) -> Any: ...

    def init(self, key: PRNGKeyArray) -> Params:
        """New parameters."""
        ...

    def usable(self, samples: Samples) -> Bool[np.ndarray, "N"]:
        """True for the samples that the network can answer."""
        ...

    def inputs(self, samples: Samples, choice: Choice) -> Inputs:
        """What the network is shown of some samples; on the host, from any thread."""
        ...

    def augmented(self, inputs: Inputs, key: PRNGKeyArray, amount: Augmentation) -> Inputs:
        """The inputs as they might have been just as well; traced.

        Args:
            inputs: of a batch.
            key: decides what is changed.
            amount: how much is.
        """
        ...

    def answers(
        self, params: Params, inputs: Inputs, phi_stay: Int8[Array, "G K P"], phi_go: Int8[Array, "G K P"]
    ) -> tuple[Answers, Float32[Array, " G"]]:
        """Answers of shape ``G K``, also where the batch is padded, and the loss of what the network says of each view
        beside them (0 where it says nothing, and for views that are padding); traced."""
        ...
