"""Faults of the core: trials."""

from eval.mutants.mutant import Mutant

PART = "trials"

_RULES = "potlp_jax/trials/rules.py"

MUTANTS = (
    Mutant(
        PART,
        "products are contracted with the sum that they are added to (rounding)",
        "potlp_jax/planning/rounding.py",
        "return jnp.abs(first * second)",
        "return first * second",
        ("tests/test_rounding.py",),
    ),
    Mutant(
        PART,
        "the word begins with the second cell",
        _RULES,
        "state=task.transitions[task.initial, letter]",
        "state=task.initial",
        ("tests/test_trial.py",),
        "start_that",
    ),
    Mutant(
        PART,
        "a proposition seen for the first time is no reason to decide",
        _RULES,
        "return replans | surprised | pointless",
        "return replans | pointless",
        ("tests/test_rules.py",),
    ),
    Mutant(
        PART,
        "the robot goes on to a frontier that has nothing more to show",
        _RULES,
        "return replans | surprised | pointless",
        "return replans | surprised",
        ("tests/test_rules.py",),
    ),
    Mutant(
        PART,
        "a map that has not changed is decided on again",
        _RULES,
        "replans = (now.cells > before.cells) & (travelled >= self.replan_distance)",
        "replans = travelled >= self.replan_distance",
        ("tests/test_rules.py",),
    ),
    Mutant(
        PART,
        "where the horizon cuts a path there is taken to be a frontier",
        _RULES,
        "is_frontier &= jnp.all(move.path.cells[move.path.length] == move.target_cell)",
        "is_frontier &= True",
        ("tests/test_rules.py",),
    ),
    Mutant(
        PART,
        "visits are not counted anew on another map",
        _RULES,
        "jnp.where(known == tally.known, tally.visits, 0)",
        "tally.visits",
        ("tests/test_rules.py",),
    ),
    Mutant(
        PART,
        "a trial that satisfied its task beyond its budget ends as budget",
        _RULES,
        "    outcome = jnp.where(tally.travelled >= budget(belief, config), _BUDGET, outcome)\n"
        "    outcome = jnp.where(task.trap[tally.state], _INFEASIBLE, outcome)\n"
        "    outcome = jnp.where(task.accepting[tally.state], _SATISFIED, outcome)\n",
        "    outcome = jnp.where(task.trap[tally.state], _INFEASIBLE, outcome)\n"
        "    outcome = jnp.where(task.accepting[tally.state], _SATISFIED, outcome)\n"
        "    outcome = jnp.where(tally.travelled >= budget(belief, config), _BUDGET, outcome)\n",
        ("tests/test_rules.py",),
    ),
    Mutant(
        PART,
        "a path of a batch is written over its last cell",
        "potlp_jax/trials/slots.py",
        "cells[1:].astype(jnp.int16), (tally.steps + 1, 0))",
        "cells[1:].astype(jnp.int16), (tally.steps, 0))",
        ("tests/test_batch.py",),
        "alone",
    ),
    Mutant(
        PART,
        "a planner without an action stays where it is (liveness)",
        "potlp_jax/planning/policies.py",
        "kind = jnp.where(falls_back, MoveKind.FALLBACK, jnp.where(acts, MoveKind.ACTION, MoveKind.NONE))",
        "kind = jnp.where(acts, MoveKind.ACTION, MoveKind.NONE)",
        ("tests/test_trial.py",),
        "lose_nothing or keep_their_promises",
    ),
    Mutant(
        PART,
        "what the robot saw stays where it was when its map outgrows its array",
        "potlp_jax/trials/loop.py",
        "self._estimator.moved(_shape(belief), rows, columns)",
        "self._estimator.moved(_shape(belief), 0, 0)",
        ("tests/test_robot.py",),
        "moves_with_the_map",
    ),
    Mutant(
        PART,
        "panoramas stay where they were taken when the map outgrows its array",
        "potlp_jax/learning/memory.py",
        "cells=memory.cells + jnp.array([[rows, columns]], jnp.int32),",
        "cells=memory.cells,",
        ("tests/test_memory.py",),
        "outgrows",
    ),
    Mutant(
        PART,
        "a robot drives as known-map",
        "potlp_jax/trials/loop.py",
        "if policy is Policy.KNOWN_MAP and not config.revealed:",
        "if False:",
        ("tests/test_robot.py",),
        "no_robot_knows",
    ),
    Mutant(
        PART,
        "a pose that was heard before the map is lost",
        "potlp_jax/drive/inbox.py",
        "placed = self._placed() if renamed else None",
        "placed = None",
        ("tests/test_drive.py",),
        "heard_before_the_map",
    ),
    Mutant(
        PART,
        "after a restart of the clock updates are old",
        "potlp_jax/drive/inbox.py",
        " | (stamp <= stamps[area] - RESTART)",
        "",
        ("tests/test_drive.py",),
        "clock_began",
    ),
    Mutant(
        PART,
        "an estimator runs the program of another class",
        "potlp_jax/compiling.py",
        "hash(jax.tree.structure((args, kwargs)))",
        "0",
        ("tests/test_compiling.py",),
    ),
)
