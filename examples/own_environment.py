"""An environment of your own: a corridor with doors, of which one leads to the exit.

    potlp run examples.own_environment:Corridor --policy oracle

The command line takes it by ``module:attribute``; so do ``potlp compare``, sweeps and ``potlp collect``. A package that
is installed may declare it instead as an entry point in the group ``potlp_jax.environments``.
"""

from types import MappingProxyType

import numpy as np
from jaxtyping import PRNGKeyArray

import potlp_jax

DOORS = 6


class Corridor(potlp_jax.Generator):
    """A corridor with closets along it, the exit in one and a fire in another; the robot starts in the middle."""

    name = "corridor"
    propositions = ("fire", "exit")
    tasks = MappingProxyType({"1": "!fire U exit"})

    def draw(self, key: PRNGKeyArray) -> potlp_jax.World:
        """The corridor of this key."""
        (rng,) = potlp_jax.host_generators(key, 1)
        # Rows: wall, corridor, wall with doors, closets of three rows, wall.
        occupied = np.ones((7, 4 * DOORS + 1), bool)
        occupied[1, 1:-1] = False
        middles = 4 * np.arange(DOORS) + 2
        for middle in middles:
            occupied[3:6, middle - 1 : middle + 2] = False
            occupied[2, middle] = False
        letters = np.zeros(occupied.shape, np.int32)
        fire, way_out = rng.permutation(middles)[:2]
        letters[5, fire], letters[5, way_out] = 0b01, 0b10
        return potlp_jax.make_world(occupied, letters, (1, 2 * DOORS), propositions=self.propositions)


def main() -> None:
    """The baseline explores one side and then the other; the oracle takes the right one."""
    for policy in ("baseline", "oracle"):
        costs = [potlp_jax.run(Corridor(), policy=policy, world=number).cost for number in range(4)]
        print(f"{policy}: {', '.join(f'{cost:.1f}' for cost in costs)}")


if __name__ == "__main__":
    main()
