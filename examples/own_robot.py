"""A robot of your own: any class with ``observe``, ``panorama`` and ``advance`` is driven by ``run_robot``.

This one stands for a real robot. It has its own map, a NumPy array that its own mapping fills, and may drive at most
three cells at a time. Only what it reports is known to the planner.
"""

import jax
import numpy as np
from jaxtyping import Array, UInt8

import potlp_jax
from potlp_jax.planning.distances.paths import KnownPath
from potlp_jax.trials.robot import Leg
from potlp_jax.trials.rules import Stop

FLOOR = """
  ###############
  #......#......#
  #......#..f...#
  #.............#
  #......#......#
  #......#.....e#
  ###############
"""
PROPOSITIONS = ("fire", "exit")
REACH = 3
LONGEST_DRIVE = 3


class Rover:
    """A robot that sees all cells within ``REACH`` rows and columns, through walls too: it has a strange sensor."""

    def __init__(self, floor: str, start: tuple[int, int]) -> None:
        self._floor = np.array([list(line.strip()) for line in floor.strip().splitlines()])
        self._cells = np.full(self._floor.shape, potlp_jax.BeliefMap.UNKNOWN)
        self._cell = start
        self._sense()

    def _sense(self) -> None:
        row, column = self._cell
        near = np.s_[max(row - REACH, 0) : row + REACH + 1, max(column - REACH, 0) : column + REACH + 1]
        walls = self._floor[near] == "#"
        self._cells[near] = np.where(walls, potlp_jax.BeliefMap.OCCUPIED, potlp_jax.BeliefMap.FREE)

    def observe(self) -> tuple[potlp_jax.BeliefMap, tuple[int, int]]:
        """The map as the robot has it, and its cell."""
        # Bit 0 is the first of the propositions, bit 1 the second. The map carries their names, so that a task over
        # other ones, or in another order, is refused.
        letters = np.where(self._floor == "f", 0b01, 0) | np.where(self._floor == "e", 0b10, 0)
        seen = self._cells != potlp_jax.BeliefMap.UNKNOWN
        letters = np.where(seen, letters, 0)
        return potlp_jax.belief_from_numpy(self._cells, letters, propositions=PROPOSITIONS), self._cell

    def panorama(self) -> UInt8[Array, "rows columns 3"]:
        """Asked by the policy potlp alone; this robot has no camera."""
        raise RuntimeError("the rover has no camera: choose a policy other than potlp")

    def advance(self, path: KnownPath, stop: Stop) -> Leg:
        """Drive along the path, a few cells at a time. ``stop`` would tell when it is worth to stop earlier."""
        del stop
        cells = np.asarray(path.cells)[1 : int(path.length) + 1][:LONGEST_DRIVE]
        for cell in cells:
            self._cell = int(cell[0]), int(cell[1])
            self._sense()
        return Leg(cells=tuple((int(row), int(column)) for row, column in cells))


def main() -> None:
    """Find the exit without driving through the fire."""
    task = potlp_jax.Task.from_formula("!fire U exit", PROPOSITIONS)
    run = potlp_jax.run_robot(Rover(FLOOR, (1, 1)), task, "baseline", jax.random.key(0))
    print(f"{run.outcome} after {len(run.decisions)} decisions and {len(run.path) - 1} cells, cost {run.cost:.1f}")
    print(f"the robot ended at {run.path[-1]}; states of the automaton: {sorted(set(run.states))}")


if __name__ == "__main__":
    main()
