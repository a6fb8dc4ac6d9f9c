"""A robot on its way turns to another subgoal only where that is cheaper by more than a fraction."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.planning.commitment import SAME_WITHIN, Intention, apply_commitment, intention_of
from potlp_jax.planning.search.plan import Plan
from potlp_jax.planning.situation import DecisionConfig
from potlp_jax.task.task import Task
from potlp_jax.types import NO_ACTION, NO_STATE, NO_SUBGOAL
from potlp_jax.world.frontiers import Subgoals

TASK = Task.from_formula("F a & F b").arrays
EDGES = TASK.edge_mask.shape[0]
CELLS = ((10, 10), (10, 40), (10, 16))
STATE = 0


def _subgoals(cells=CELLS):
    count = len(cells)
    return Subgoals(
        cells=jnp.asarray(cells, jnp.int32),
        mask=jnp.ones(count, bool),
        size=jnp.full(count, 3, jnp.int32),
        distance=jnp.ones(count, jnp.float32),
        component=jnp.full((20, 50), NO_SUBGOAL, jnp.int32),
        frontier=jnp.zeros((20, 50), bool),
        status=jnp.uint32(0),
    )


def _plan(q_values, action=None):
    """A plan that takes the cheapest action, or the one given; ``q_values`` by (subgoal, edge), inf elsewhere."""
    table = np.full(len(CELLS) * EDGES + 1, np.inf, np.float32)
    for (subgoal, edge), value in q_values.items():
        table[subgoal * EDGES + edge] = value
    chosen = int(np.argmin(table)) if action is None else action
    acts = 0 <= chosen < len(CELLS) * EDGES
    edge = np.asarray(TASK.edges)[chosen % EDGES] if acts else (NO_STATE, NO_STATE)
    return Plan(
        action=jnp.int32(chosen),
        subgoal=jnp.int32(chosen // EDGES if acts else NO_SUBGOAL),
        from_state=jnp.int32(edge[0]),
        to_state=jnp.int32(edge[1]),
        value=jnp.float32(table[chosen]),
        q_values=jnp.asarray(table),
        visits=jnp.zeros(len(table), jnp.int32),
        optimism_gap=jnp.float32(0),
        lower_bound=jnp.float32(0),
        status=jnp.uint32(0),
    )


def _intention(cell=(10, 40), edge=1, state=STATE):
    return Intention(cell=jnp.asarray(cell, jnp.int32), edge=jnp.int32(edge), state=jnp.int32(state))


def _kept(plan, intention, commitment=0.2, state=STATE, subgoals=None):
    subgoals = _subgoals() if subgoals is None else subgoals
    return jax.jit(apply_commitment)(plan, intention, jnp.int32(state), subgoals, TASK, jnp.float32(commitment))


@pytest.mark.parametrize(("commitment", "subgoal"), [(0.0, 0), (0.14, 0), (0.16, 1), (0.2, 1)])
def test_it_turns_where_that_is_cheaper_by_more_than_the_fraction(commitment, subgoal):
    plan = _plan({(0, 1): 100.0, (1, 1): 115.0})
    kept = _kept(plan, _intention(), commitment)
    assert int(kept.subgoal) == subgoal
    assert int(kept.action) == subgoal * EDGES + 1
    assert float(kept.value) == (100.0 if subgoal == 0 else 115.0)
    assert (int(kept.from_state), int(kept.to_state)) == tuple(np.asarray(TASK.edges)[1])
    np.testing.assert_array_equal(kept.q_values, plan.q_values)


def test_of_several_the_nearest_to_the_former_subgoal_is_the_same():
    plan = _plan({(0, 1): 115.0, (1, 1): 100.0, (2, 1): 114.0})
    assert int(_kept(plan, _intention(cell=(11, 12))).subgoal) == 0
    assert int(_kept(plan, _intention(cell=(10, 15))).subgoal) == 2
    assert int(_kept(plan, _intention(cell=(10, 16 + SAME_WITHIN))).subgoal) == 2
    assert int(_kept(plan, _intention(cell=(10, 17 + SAME_WITHIN))).subgoal) == 1


def test_what_is_tried_for_beyond_it_counts():
    """At the same subgoal another transition became cheaper: no turn within the fraction."""
    plan = _plan({(1, 0): 100.0, (1, 1): 110.0})
    assert int(_kept(plan, _intention(edge=1)).action) == EDGES + 1
    assert int(_kept(plan, _intention(edge=0)).action) == EDGES
    assert int(_kept(_plan({(1, 0): 100.0}), _intention(edge=1)).action) == EDGES


def test_nothing_is_kept_after_a_change_of_state_or_without_an_intention():
    plan = _plan({(0, 1): 100.0, (1, 1): 101.0})
    assert int(_kept(plan, _intention(), state=STATE + 1).subgoal) == 0
    assert int(_kept(plan, Intention.none()).subgoal) == 0


def test_the_way_to_acceptance_and_no_way_at_all_are_not_kept_from():
    table = {(1, 1): 101.0}
    finish = len(CELLS) * EDGES
    assert int(_kept(_plan(table, action=finish), _intention()).action) == finish
    nothing = _plan({})
    nothing = nothing.replace(action=jnp.int32(NO_ACTION))
    assert int(_kept(nothing, _intention()).action) == NO_ACTION


def test_the_intention_is_what_was_chosen():
    plan = _plan({(0, 1): 100.0, (1, 1): 101.0})
    intention = intention_of(plan, jnp.int32(STATE), _subgoals(), TASK)
    assert (intention.cell.tolist(), int(intention.edge), int(intention.state)) == ([10, 10], 1, STATE)
    finish = _plan({}, action=len(CELLS) * EDGES)
    assert int(intention_of(finish, jnp.int32(STATE), _subgoals(), TASK).state) == NO_STATE


def test_a_negative_fraction_is_refused():
    with pytest.raises(ValueError, match="commitment is -1"):
        DecisionConfig(commitment=-1.0)
