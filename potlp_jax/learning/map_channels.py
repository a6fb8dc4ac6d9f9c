"""The picture of the building that a building network reads: the belief and the painting, channel by channel.

For P propositions the channels of a cell are, in this order:

    0-4           1 if it is free, occupied, unknown, a frontier, painted; otherwise 0
    5 to 4 + P    1 if the proposition is known to hold there; otherwise 0
    5 + P         how near it was when it was painted: exp(-distance / 20 cells)
    6 + P to end  RGB of its floor, then RGB at eye height in its direction

Colours run from -2 to 2. Nearness and colours are 0 where nothing was painted.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float32

from potlp_jax.learning.building_config import BuildingConfig
from potlp_jax.learning.painting import Painting
from potlp_jax.world.frontiers import frontier_cells
from potlp_jax.world.grid import BeliefMap

# Cells over which the weight of what was seen from afar falls by a factor of e; not tuned.
_REACH = 20.0

PAINTED: int = 4
"""The channel that says whether a cell was painted."""


def map_channels(belief: BeliefMap, painting: Painting) -> Float32[Array, "H W K"]:
    """The picture of the building that the first stage of a building network reads.

    Args:
        belief: the map, without leading dimensions.
        painting: what was painted on it, of the same shape.

    Returns:
        The channels of every cell, ``channel_count`` of them, in the order of the module's docstring.
    """
    letters = jnp.stack([(belief.letters >> bit) & 1 for bit in range(len(belief.propositions))], axis=-1)
    painted = jnp.isfinite(painting.distance)
    flags = (belief.free, belief.occupied, belief.unknown, frontier_cells(belief, belief.free), painted)
    colours = jnp.concatenate([painting.floor, painting.beyond], axis=-1).astype(jnp.float32)
    # Pixels in [0, 1] enter as (pixel - 0.5) / 0.25; where nothing was painted, 0.
    colours = jnp.where(painted[:, :, None], (colours / 255 - 0.5) * 4, 0.0)
    near = jnp.where(painted, jnp.exp(-painting.distance / _REACH), 0.0)
    parts = (jnp.stack(flags, axis=-1), letters, near[:, :, None], colours)
    return jnp.concatenate([part.astype(jnp.float32) for part in parts], axis=-1)


def channel_count(config: BuildingConfig) -> int:
    """Channels of ``map_channels``: five flags, one for each proposition, the nearness and two colours."""
    return 5 + len(config.propositions) + 1 + 6


def of_painting(channels: int) -> Bool[np.ndarray, " K"]:
    """Which of the channels of ``map_channels`` hold what was painted: a flag, the nearness and the colours."""
    index = np.arange(channels)
    return (index == PAINTED) | (index >= channels - 7)
