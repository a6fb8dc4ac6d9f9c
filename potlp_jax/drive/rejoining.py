"""A path for a robot that has driven on while the path was found."""

from collections.abc import Sequence

from jaxtyping import Bool, Int32
from numpy import ndarray

from potlp_jax.world.moves import Cell, legal_moves


def rest_of_path(
    planned: Sequence[Cell], entered: Sequence[Cell], free: Bool[ndarray, "H W"], letters: Int32[ndarray, "H W"]
) -> list[Cell]:
    """The cells to enter from where a robot is now.

    A decision takes time, in which the robot follows the path before. It need not come back to where it was: it goes
    on at the last cell of the path that is one move away, or its own. What the path does up to there must not matter
    to the task: the letters passed are all that of the first cell. Where there is no such cell the robot comes back
    the way it went.

    Args:
        planned: the path from where the robot was when it was observed, that cell first.
        entered: since then, in order.
        free: where one can drive.
        letters: of each cell.

    Returns:
        The cells after the robot's own; the last one is that of the path.
    """
    if not entered:
        return list(planned[1:])
    here, letter = entered[-1], letters[planned[0]]
    if all(letters[cell] == letter for cell in entered):
        other = next((index for index, cell in enumerate(planned) if letters[cell] != letter), len(planned) - 1)
        near = {here, *(cell for cell, _ in legal_moves(free, here))}
        joined = next((index for index in range(other, -1, -1) if planned[index] in near), None)
        if joined is not None:
            return list(planned[joined + (planned[joined] == here) :])
    return [*reversed(entered[:-1]), *planned]
