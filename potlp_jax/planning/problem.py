"""Planning problems: the dense, fixed-shape description of one decision that search and exact solution share.

A problem has ``S + 1`` nodes. Nodes ``0 .. S-1`` are the subgoals, node ``S`` is the robot's own cell. Action
``s * E + e`` travels through known space to subgoal ``s``, arriving in state ``z'`` of edge ``e = (z', z'')``, and
tries ``z' -> z''`` in the unknown space beyond; the last action, ``S * E``, finishes in known space (paper III-B).
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float32, Int32

from potlp_jax.errors import ProblemError
from potlp_jax.planning.shapes import check_arrays, check_task, last_axis
from potlp_jax.precision import in_32_bits
from potlp_jax.task.task import TaskArrays
from potlp_jax.types import NO_CLASS

COST_LIMIT: float = 1e30
"""Costs from here on are refused like infinite ones: below it a sum of a hundred million costs is finite in float32."""


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
        """Bring the arrays to their types. Pure and traceable; ``check`` validates the values on the host, and the
        searches validate them where they run (``screen``).

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
        # Types alone: values may be traced here, so that nothing can be checked. Copies, because a caller's buffer may
        # be filled anew.
        return cls(
            task=task,
            travel=jnp.array(travel, jnp.float32),
            finish=jnp.array(finish, jnp.float32),
            success_probability=jnp.array(success_probability, jnp.float32),
            success_cost=jnp.array(success_cost, jnp.float32),
            failure_cost=jnp.array(failure_cost, jnp.float32),
            dfa_state=jnp.array(dfa_state, jnp.int32),
            subgoal_mask=jnp.array(subgoal_mask, jnp.bool_),
            dead_end_cost=jnp.array(dead_end_cost, jnp.float32),
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

    def padded(self, subgoals: int) -> "PlanningProblem":
        """The same problem, or batch of problems, with room for more subgoals: problems of one size share a program.

        Pure and traceable. With ``Task.padded`` for the task, whatever occurs in a program fits one size. No choice and
        no value changes. Actions keep their numbers but for finish, which is always the last.

        Args:
          subgoals: S of the result; what is added is absent.

        Returns:
          The problem; real subgoals come first, as before.

        Raises:
          ProblemError: it has more subgoals already, padding included.
        """
        added = subgoals - self.subgoal_count
        if added < 0:
            raise ProblemError(f"the problem has {self.subgoal_count} subgoals and cannot be padded to {subgoals}")

        def longer(values: Array, axis: int, fill: float | bool) -> Array:
            shape = list(values.shape)
            shape[axis] = added
            return jnp.concatenate([values, jnp.full(shape, fill, values.dtype)], axis=axis)

        def longer_before_robot(values: Array, axis: int) -> Array:
            # The robot's node stays the last.
            nodes, robot = jnp.split(values, [self.subgoal_count], axis=axis)
            return jnp.concatenate([longer(nodes, axis, jnp.inf), robot], axis=axis)

        return dataclasses.replace(
            self,
            travel=longer_before_robot(longer(self.travel, -2, jnp.inf), -4),
            finish=longer_before_robot(self.finish, -2),
            success_probability=longer(self.success_probability, -2, 0.0),
            success_cost=longer(self.success_cost, -2, 1.0),
            failure_cost=longer(self.failure_cost, -2, 0.0),
            subgoal_mask=longer(self.subgoal_mask, -1, False),
        )

    def check(self) -> None:
        """Validate one unbatched problem on the host: the rules of ``screen``, with a message.

        Raises:
          ProblemError: shapes or types do not agree, or a value is not allowed; the first such value is named.
        """
        # Shapes first: the masks of values below rely on them.
        check_shapes(self)
        wrong = _wrong_entries_of_one(self)
        for name in _RULES:
            _refuse(name, np.asarray(getattr(self, name)), np.asarray(wrong[name]))


def screen(problem: PlanningProblem) -> tuple[PlanningProblem, Bool[Array, ""]]:
    """A problem that can be searched whatever its arrays hold, and whether they held something that is not allowed.

    Pure, for jit and vmap. Entries that ``subgoal_mask`` (True: real) or the masks of the task mark as absent may hold
    anything, NaN too: they are blanked and do not count. One wrong value among the others makes the whole problem
    invalid: what it would change cannot be told from the rest.

    Args:
      problem: unbatched, of shapes that agree (``check_shapes``).

    Returns:
      The problem with absent entries blanked; where it is invalid, one without any action, which costs inf.
      And True where it is invalid.
    """
    wrong = functools.reduce(jnp.logical_or, (jnp.any(entries) for entries in _wrong_entries(problem).values()))
    # Blanked, not ignored: NaN times a weight of 0 is NaN, and would spread from padding into sums over subgoals.
    blank = {"travel": jnp.inf, "finish": jnp.inf, "success_probability": 0.0, "success_cost": 1.0, "failure_cost": 0.0}
    present = _present_entries(problem)
    values = {
        name: jnp.where(present[name] & ~wrong, getattr(problem, name), jnp.float32(value))
        for name, value in blank.items()
    }
    task = problem.task
    cleaned = dataclasses.replace(
        problem,
        # Otherwise a wrong number for the state could look like a task that is done.
        task=dataclasses.replace(task, accepting=task.accepting & ~wrong),
        dfa_state=jnp.where(wrong, 0, problem.dfa_state),
        subgoal_mask=problem.subgoal_mask & ~wrong,
        dead_end_cost=jnp.where(wrong, jnp.inf, problem.dead_end_cost),
        **values,
    )
    return cleaned, wrong


@in_32_bits
def enumerate_actions(problem: PlanningProblem) -> Bool[Array, "S E"]:
    """The paper's A(b_t) without finish: actions that are available at the root (section III-B).

    True where subgoal and edge are real, the subgoal can be reached in state z' through known space, and P_S of the
    edge's condition is not 0. All False where the task is already satisfied, and where the problem holds a value that
    is not allowed (``screen``).
    """
    problem, _ = screen(problem)
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


def take_rows(values: Array, index: Int32[Array, "*N"]) -> Array:
    """``values[index]``; the first row for a negative index: a task has one class at least (``TaskSizes``)."""
    return values[jnp.maximum(index, 0)]


def check_shapes(problem: PlanningProblem, batch: tuple[int, ...] = ()) -> None:
    """Check that the arrays of a problem fit together; also while tracing, when shapes and types are all that is known.

    Arrays of 64 bits pass: the searches round them.

    Args:
      problem: its subgoal mask and its task give the sizes that all other arrays must have.
      batch: leading axes that every array has, those of the task too.

    Raises:
      ProblemError: an array has another shape or type; the message names it, what was found and what is expected.
    """
    # The mask gives S, so that it must be an array with an axis before anything is compared with it.
    subgoals = last_axis("subgoal_mask", problem.subgoal_mask, batch, ("S",))
    # Not left to broadcasting: [S, 1] would pass for the same answer to every class.
    check_arrays(problem, check_task(problem.task, batch) | {"S": subgoals, "S1": subgoals + 1}, batch)


def _present_entries(problem: PlanningProblem) -> dict[str, Bool[Array, "..."]]:
    """Where each array means something: real subgoals, states and outcome classes."""
    task, subgoals = problem.task, problem.subgoal_mask
    # The robot's node comes after the subgoals, and is always real.
    nodes, states = jnp.append(subgoals, True), task.state_mask
    estimates = subgoals[:, None] & task.class_mask[None, :]
    return {
        "travel": (nodes[:, None] & states[None, :])[:, :, None, None]
        & (subgoals[:, None] & states[None, :])[None, None, :, :],
        "finish": nodes[:, None] & states[None, :],
        "success_probability": estimates,
        "success_cost": estimates,
        "failure_cost": estimates,
        "dfa_state": jnp.bool_(True),
        "dead_end_cost": jnp.bool_(True),
    }


_RULES = {
    "travel": "a path cost is not negative, inf where there is no path",
    "finish": "a path cost is not negative, inf where there is no path",
    "success_probability": "P_S lies in [0, 1]",
    "success_cost": "R_S is positive and finite",
    "failure_cost": "R_F is finite and not negative",
    "dfa_state": "must be a state of the task's automaton",
    "dead_end_cost": "must be positive and finite",
}
"""What every array must hold where it is real, in words; ``_wrong_entries`` has it in arrays."""


def _wrong_entries(problem: PlanningProblem) -> dict[str, Bool[Array, "..."]]:
    """Where each array of an unbatched problem holds a value that the model does not allow."""
    # Each rule says what is right and is negated, because every comparison with NaN is false.
    success, failure = problem.success_cost, problem.failure_cost
    chance, dead_end, state = problem.success_probability, problem.dead_end_cost, problem.dfa_state
    # Clipped only to look it up; a state out of range is wrong all the same.
    states = problem.task.state_mask
    known = (state >= 0) & (state < states.shape[-1]) & states[jnp.clip(state, 0, states.shape[-1] - 1)]
    right = {
        "travel": _is_path_cost(problem.travel),
        "finish": _is_path_cost(problem.finish),
        "success_probability": (chance >= 0.0) & (chance <= 1.0),
        # R_S is positive: a success lies at least one move beyond its subgoal.
        "success_cost": (success > 0.0) & (success < COST_LIMIT),
        "failure_cost": (failure >= 0.0) & (failure < COST_LIMIT),
        "dfa_state": known,
        "dead_end_cost": (dead_end > 0.0) & (dead_end < COST_LIMIT),
    }
    present = _present_entries(problem)
    return {name: present[name] & ~entries for name, entries in right.items()}


# One program: operation by operation a host would compile some twenty.
_wrong_entries_of_one = jax.jit(_wrong_entries)


def _is_path_cost(values: Float32[Array, "*N"]) -> Bool[Array, "*N"]:
    return ((values >= 0.0) & (values < COST_LIMIT)) | (values == jnp.inf)


def _refuse(name: str, values: np.ndarray, wrong: np.ndarray) -> None:
    """Raise for the first wrong value, if any."""
    if not np.any(wrong):
        return
    # One example says more than a count of all.
    index = tuple(int(i) for i in np.argwhere(wrong)[0])
    where = f"{name}[{', '.join(map(str, index))}]" if index else name
    raise ProblemError(f"{where} is {values[index]}: {_RULES[name]}")
