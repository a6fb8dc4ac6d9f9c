"""What every search looks up about a batch of problems: tables by action, and how a history goes on."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, UInt32

from potlp_jax.planning.history import (
    ActionRow,
    ActionTables,
    History,
    action_tables,
    initial_history,
    step_row,
)
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.arrays import pack_rows, unpack_rows
from potlp_jax.types import NO_STATE

NOWHERE: int = -1
"""Product state of actions that are not attempted beyond a subgoal: finish, and padding."""

FAILURE, SUCCESS = 0, 1
"""Outcomes of an action, as indices of a node's children."""


@struct.dataclass(kw_only=True)
class Model:
    """A batch of problems, arranged for search. Constant during a search.

    A **product state** ``location * Z + state`` numbers where a rollout can be: beyond which subgoal (S for the
    robot's own cell) and in which state of the automaton.

    Attributes:
      tables: the problems, rearranged by action.
      packed: all of an action's row of ``tables`` as bits (``pack_rows``), so that one lookup reads it.
      product_states: where each action is attempted, ``NOWHERE`` for finish and padding.
      accepts: whether each action's success satisfies the task.
      root: at the robot, nothing known.
      dead_end_cost: cost of a history without actions.
    """

    tables: ActionTables
    packed: UInt32[Array, "*B A n"]
    product_states: Int32[Array, "*B A"]
    accepts: Bool[Array, "*B A"]
    root: History
    dead_end_cost: Float32[Array, "*B"]

    @property
    def finish(self) -> int:
        """Index of the finish action, the last."""
        return self.product_states.shape[-1] - 1

    @property
    def states(self) -> int:
        """Z, padding included."""
        return self.tables.accepting.shape[-1]

    @property
    def rows(self) -> Int32[Array, "B"]:
        """Index of every row of the batch, to gather one entry from each."""
        return jnp.arange(self.dead_end_cost.shape[0], dtype=jnp.int32)

    def product_state(self, location: Int32[Array, "B"], state: Int32[Array, "B"]) -> Int32[Array, "B"]:
        """Number of a location and a state of the automaton."""
        return location * self.states + state

    def stays_inside(self, location: Int32[Array, "B"], state: Int32[Array, "B"]) -> Bool[Array, "B A"]:
        """Which actions go on in the unknown region where the rollout is: they pay neither path nor pending cost."""
        return self.product_states == self.product_state(location, state)[:, None]

    def action_rows(self, action: Int32[Array, "B"]) -> ActionRow:
        """One action's row of the tables, for each row of the batch."""
        return unpack_rows(self.packed[self.rows, action], self.tables.actions)

    def step(self, history: History, action: Int32[Array, "B"], success: Bool[Array, "B"]) -> History:
        """The history of each row after an available action with the given outcome.

        Args:
            history: before it.
            action: by its number in the tables.
            success: True where it succeeds.

        Returns:
            The history after it.
        """
        return jax.vmap(step_row)(self.tables, self.action_rows(action), history, success)


def make_model(problems: PlanningProblem) -> Model:
    """Arrange a batch of problems (one leading axis) for search."""
    tables, root = jax.vmap(action_tables)(problems), jax.vmap(initial_history)(problems)
    rows, states = tables.actions, tables.accepting.shape[1]
    # Finish is attempted nowhere: S * Z + NO_STATE would be the last subgoal in the last state.
    where = jnp.where(rows.from_state == NO_STATE, NOWHERE, rows.subgoal * states + rows.from_state)
    # Bit for bit the same tables twice: by column for the minima over actions, by row for the one that is taken.
    return Model(
        tables=tables,
        packed=jax.vmap(pack_rows)(rows),
        product_states=where,
        accepts=rows.accepts,
        root=root,
        dead_end_cost=problems.dead_end_cost,
    )
