"""Planning problems: the dense, fixed-shape description of one decision that search and exact solution share.

A problem has ``S + 1`` nodes. Nodes ``0 .. S-1`` are the subgoals, node ``S`` is the robot's own cell. Action
``s * E + e`` travels through known space to subgoal ``s``, arriving in state ``z'`` of edge ``e = (z', z'')``, and
tries ``z' -> z''`` in the unknown space beyond; the last action, ``S * E``, finishes in known space (paper III-B).
"""

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float32, Int32

from potlp_jax.errors import ProblemError
from potlp_jax.task.task import TaskArrays
from potlp_jax.types import NO_CLASS


@struct.dataclass(kw_only=True)
class PlanningProblem:
    """Everything a planner needs to know about one decision; costs in the unit of ``World.resolution``.

    Attributes:
      task: automaton, edges, conditions and outcome classes.
      travel: ``travel[u, z, s, z']``, path cost through known space from node ``u`` in state ``z`` to subgoal ``s`` in
        state ``z'``, inf where there is no path. From a subgoal's node the path starts by entering the subgoal's cell
        from the unknown region, so its first state is ``δ(z, l(s))``; from the robot's node it starts in ``z``.
      finish: ``finish[u, z]``, path cost through known space to acceptance, inf where there is no path.
      success_probability: P_S of each subgoal and outcome class.
      success_cost: R_S, path cost from the subgoal to the success, positive (also where P_S is 0).
      failure_cost: R_F, path cost from the subgoal to where the failure is known, not negative.
      dfa_state: the robot's automaton state, the letter of its cell read.
      subgoal_mask: True where a subgoal is real.
      dead_end_cost: what a history costs in which nothing can be done and the task is not satisfied, positive.

    Any number of equal leading axes (``*B``) makes a batch of problems.
    """

    task: TaskArrays
    travel: Float32[Array, "*B S1 Z S Z"]
    finish: Float32[Array, "*B S1 Z"]
    success_probability: Float32[Array, "*B S C"]
    success_cost: Float32[Array, "*B S C"]
    failure_cost: Float32[Array, "*B S C"]
    dfa_state: Int32[Array, "*B"]
    subgoal_mask: Bool[Array, "*B S"]
    dead_end_cost: Float32[Array, "*B"]

    @classmethod
    def from_arrays(
        cls,
        task: TaskArrays,
        *,
        travel: ArrayLike,
        finish: ArrayLike,
        success_probability: ArrayLike,
        success_cost: ArrayLike,
        failure_cost: ArrayLike,
        dfa_state: ArrayLike,
        subgoal_mask: ArrayLike,
        dead_end_cost: ArrayLike,
    ) -> "PlanningProblem":
        """Bring the arrays to their types. Pure and traceable; ``check`` validates the values on the host.

        Args:
          task: arrays of the task, ``Task.arrays`` or ``Task.padded(sizes)``.
          travel: ``[S+1, Z, S, Z]``; see the class for the meaning of this and the following.
          finish: ``[S+1, Z]``.
          success_probability: ``[S, C]``.
          success_cost: ``[S, C]``.
          failure_cost: ``[S, C]``.
          dfa_state: scalar.
          subgoal_mask: ``[S]``.
          dead_end_cost: scalar.

        Returns:
          The problem.
        """
        # Types alone: values may be traced here, so that nothing can be checked.
        return cls(
            task=task,
            travel=jnp.asarray(travel, jnp.float32),
            finish=jnp.asarray(finish, jnp.float32),
            success_probability=jnp.asarray(success_probability, jnp.float32),
            success_cost=jnp.asarray(success_cost, jnp.float32),
            failure_cost=jnp.asarray(failure_cost, jnp.float32),
            dfa_state=jnp.asarray(dfa_state, jnp.int32),
            subgoal_mask=jnp.asarray(subgoal_mask, jnp.bool_),
            dead_end_cost=jnp.asarray(dead_end_cost, jnp.float32),
        )

    @property
    def subgoal_count(self) -> int:
        """S, padding included."""
        return self.subgoal_mask.shape[-1]

    @property
    def edge_count(self) -> int:
        """E, padding included."""
        return self.task.edge_mask.shape[-1]

    @property
    def action_count(self) -> int:
        """A = S * E + 1; the last action is finish."""
        return self.subgoal_count * self.edge_count + 1

    def check(self) -> None:
        """Validate one unbatched problem on the host.

        Raises:
          ProblemError: shapes do not agree, a value is NaN, a travel or finish cost is negative, P_S lies outside
            [0, 1], R_S is not positive, R_F is negative, or ``dead_end_cost`` is not positive. Estimates are checked
            where subgoal and outcome class are real, travel and finish everywhere.
        """
        # Shapes first: the checks of values below rely on them.
        _check_shapes(self)
        task = self.task
        # Padding may hold anything: no result depends on it.
        real = np.asarray(self.subgoal_mask)[:, None] & np.asarray(task.class_mask)[None, :]
        travel, finish = np.asarray(self.travel), np.asarray(self.finish)
        _refuse("travel", travel, np.isnan(travel) | (travel < 0), "a cost is not negative, inf where unreachable")
        _refuse("finish", finish, np.isnan(finish) | (finish < 0), "a cost is not negative, inf where unreachable")
        probability = np.asarray(self.success_probability)
        _refuse("success_probability", probability, real & ~((probability >= 0) & (probability <= 1)), "P_S in [0, 1]")
        # R_S is positive: a success lies at least one move beyond its subgoal.
        success, failure = np.asarray(self.success_cost), np.asarray(self.failure_cost)
        _refuse("success_cost", success, real & ~((success > 0) & (success < np.inf)), "R_S is positive and finite")
        _refuse("failure_cost", failure, real & ~((failure >= 0) & (failure < np.inf)), "R_F is finite, not negative")
        dead_end = np.asarray(self.dead_end_cost)
        _refuse("dead_end_cost", dead_end, ~((dead_end > 0) & (dead_end < np.inf)), "must be positive and finite")
        # The index is clipped only to look it up; a state out of range is refused all the same.
        state = np.asarray(self.dfa_state)
        known = (state >= 0) & (state < task.state_mask.shape[-1])
        known = known & np.asarray(task.state_mask)[np.clip(state, 0, task.state_mask.shape[-1] - 1)]
        _refuse("dfa_state", state, ~known, "must be a state of the task's automaton")


def enumerate_actions(problem: PlanningProblem) -> Bool[Array, "S E"]:
    """The paper's A(b_t) without finish: actions that are available at the root (section III-B).

    True where subgoal and edge are real, the subgoal can be reached in state z' through known space, and P_S of the
    edge's condition is not 0. All False where the task is already satisfied.
    """
    # The conditions of `history.terms_of_all` at a history in which nothing is known.
    task = problem.task
    robot, state = problem.subgoal_count, problem.dfa_state
    reachable = jnp.isfinite(problem.travel[robot, state][:, task.edges[:, 0]])
    # A condition is possible if any of its cubes is.
    classes = take_rows(task.condition_classes, task.edge_condition)
    chance = take_rows(problem.success_probability.T, classes)
    possible = jnp.any((classes != NO_CLASS)[..., None] & (chance > 0), axis=1).T
    real = problem.subgoal_mask[:, None] & task.edge_mask[None, :]
    return reachable & possible & real & ~task.accepting[state]


def action_index(problem: PlanningProblem, subgoal: int, edge: int) -> int:
    """Index of an action.

    Args:
      problem: its shapes alone matter.
      subgoal: where it is attempted.
      edge: the transition that it tries.

    Returns:
      ``s * E + e``.
    """
    return subgoal * problem.edge_count + edge


def take_rows(values: Array, index: Int32[Array, "*N"]) -> Array:
    """``values[index]``: for a negative index the first row, and zeros where there is no row to take (a task without
    conditions)."""
    # Indexing an array without rows is an error even where no index is used.
    if values.shape[0] == 0:
        return jnp.zeros((*index.shape, *values.shape[1:]), values.dtype)
    return values[jnp.maximum(index, 0)]


def _check_shapes(problem: PlanningProblem) -> None:
    # The mask and the task give the sizes that all other arrays have to have.
    subgoals, task = problem.subgoal_count, problem.task
    states, classes = task.state_mask.shape[-1], task.class_mask.shape[-1]
    expected = {
        "travel": (subgoals + 1, states, subgoals, states),
        "finish": (subgoals + 1, states),
        "success_probability": (subgoals, classes),
        "success_cost": (subgoals, classes),
        "failure_cost": (subgoals, classes),
        "dfa_state": (),
        "subgoal_mask": (subgoals,),
        "dead_end_cost": (),
    }
    for name, shape in expected.items():
        found = getattr(problem, name).shape
        if found != shape:
            raise ProblemError(
                f"{name} has shape {found}, expected {shape}: {subgoals} subgoals (from subgoal_mask), "
                f"{states} states and {classes} outcome classes (from the task)"
            )


def _refuse(name: str, values: np.ndarray, wrong: np.ndarray | np.bool_, rule: str) -> None:
    """Raise for the first wrong value, if any."""
    if not np.any(wrong):
        return
    # One example says more than a count of all.
    index = tuple(int(i) for i in np.argwhere(wrong)[0])
    where = f"{name}[{', '.join(map(str, index))}]" if index else name
    raise ProblemError(f"{where} is {values[index]}: {rule}")
