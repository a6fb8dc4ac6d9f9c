"""Plan one decision from arrays: a map as a robot has it, a task, and estimates of your own."""

import jax
import jax.numpy as jnp
import numpy as np

import potlp_jax

# The belief as a robot's mapping has it: -1 not observed, 0 free, 1 occupied.
MAP = """
  #########????
  #.......?????
  #.......?????
  #...#########
  #...#????????
  #.R..????????
  #########????
"""


def read_belief(text: str) -> tuple[potlp_jax.BeliefMap, tuple[int, int]]:
    """The belief that a drawing shows, and the robot's cell."""
    rows = [line.strip() for line in text.strip().splitlines()]
    width = max(map(len, rows))
    codes = {"#": potlp_jax.BeliefMap.OCCUPIED, "?": potlp_jax.BeliefMap.UNKNOWN}
    cells = np.array([[codes.get(sign, potlp_jax.BeliefMap.FREE) for sign in row.ljust(width, "?")] for row in rows])
    row = next(number for number, line in enumerate(rows) if "R" in line)
    # No proposition has been seen yet: the letter of every observed cell is 0.
    belief = potlp_jax.belief_from_numpy(cells, np.zeros_like(cells), propositions=("fire", "exit"))
    return belief, (row, rows[row].index("R"))


def main() -> None:
    """Two frontiers, and an estimator that takes the farther one for more promising."""
    belief, robot = read_belief(MAP)
    task = potlp_jax.Task.from_formula("!fire U exit", belief.propositions)
    cell, state = jnp.array(robot, jnp.int32), jnp.int32(task.dfa.initial)

    # Both parts of a decision are pure: compiled once, they serve every decision on maps of this size.
    find = jax.jit(potlp_jax.frontier_subgoals, static_argnames="config")
    decide = jax.jit(potlp_jax.decide_from_estimates, static_argnames="config")

    subgoals = find(belief, cell, state, task.arrays)
    count, classes = subgoals.mask.shape[0], task.sizes.classes
    # P_S, R_S and R_F of Eq. 3: the chance that the exit is beyond a frontier, the cost to it, and the cost to find
    # out that it is not. Here they only depend on which frontier it is.
    promising = subgoals.cells[:, 0] < 3
    chance = jnp.where(promising, 0.9, 0.1)[:, None] * jnp.ones((1, classes))
    estimates = potlp_jax.Estimates(
        success_probability=chance,
        success_cost=jnp.full((count, classes), 6.0),
        failure_cost=jnp.full((count, classes), 8.0),
    )
    move = decide(belief, subgoals, estimates, task.arrays, cell, state, jax.random.key(0))
    print(f"the robot is at {robot}, frontiers are at {np.asarray(subgoals.cells)[np.asarray(subgoals.mask)].tolist()}")
    print(
        f"go to {move.target_cell.tolist()}, expected cost {float(move.value):.1f}, over {int(move.path.length)} cells"
    )


if __name__ == "__main__":
    main()
