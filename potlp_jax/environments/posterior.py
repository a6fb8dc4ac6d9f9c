"""What a family's worlds can be, to a robot that has seen a part of one of them.

A family that knows its own distribution may offer it (``Generator.posterior``). Then labels can be means over all
buildings that agree with what was seen, in place of the answers of the one building in which the robot is
(``learning.ideal_observer``).
"""

from typing import Any, Protocol, runtime_checkable

from flax import struct
from jaxtyping import Array, Bool, Int32

from potlp_jax.world.grid import BeliefMap


@struct.dataclass(kw_only=True)
class Drawn:
    """Buildings that agree with what was seen.

    Attributes:
        occupied: walls of each.
        letters: of each.
        agrees: False where no building does; then the others mean nothing.
    """

    occupied: Bool[Array, "N H W"]
    letters: Int32[Array, "N H W"]
    agrees: Bool[Array, ""]


@runtime_checkable
class Posterior(Protocol):
    """A distribution of buildings given what was seen of one: a dataclass that is a pytree.

    Attributes:
        evidence: a pytree of arrays, what the camera showed beside the map; all that changes when it shows more.
    """

    evidence: Any

    def after(self, cell: Int32[Array, "2"]) -> "Posterior":
        """The posterior after a panorama from ``cell``."""
        ...

    def draw(self, belief: BeliefMap) -> Drawn:
        """Buildings in proportion to their probability, given the map and what the camera showed.

        The same noise serves every call: drawn buildings change only as far as the posterior does. Estimates that are
        drawn anew at every decision make a robot turn back and forth.
        """
        ...
