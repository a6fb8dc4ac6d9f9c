"""Faults of the core: status bits."""

from eval.mutants.mutant import Mutant

PART = "status bits"

_EXPANDING = "potlp_jax/planning/search/expanding.py"
_UCT = "potlp_jax/planning/search/uct.py"
_RULES = "potlp_jax/trials/rules.py"

MUTANTS = (
    Mutant(
        PART,
        "arrays of another type are read as they are",
        "potlp_jax/planning/shapes.py",
        "if narrow_type(array.dtype) != kind:",
        "if False:",
        ("tests/test_invalid.py",),
        "types_are",
    ),
    Mutant(
        PART,
        "a full tree of best-first search is not flagged",
        _EXPANDING,
        "status_of_rows(is_new & ~added, Status.TREE_OVERFLOW)",
        "status_of_rows(is_new & ~is_new, Status.TREE_OVERFLOW)",
        ("tests/test_search.py",),
        "flagged",
    ),
    Mutant(
        PART,
        "a rollout of PO-UCT that was cut is not flagged",
        _UCT,
        "    overflow |= status_of_rows(rollout.active, Status.DEPTH_OVERFLOW)\n",
        "",
        ("tests/test_uct.py",),
        "flagged",
    ),
    Mutant(
        PART,
        "an invalid problem is a dead end and nothing more",
        "potlp_jax/planning/search/lockstep.py",
        "status = jnp.where(invalid, status_array(Status.INVALID), plan.status)",
        "status = plan.status",
        ("tests/test_status.py",),
        "situation",
    ),
    Mutant(
        PART,
        "a satisfied root counts as a dead end",
        "potlp_jax/planning/search/plan.py",
        "status_of_rows(~available & ~accepted, Status.DEAD_END)",
        "status_of_rows(~available, Status.DEAD_END)",
        ("tests/test_status.py",),
        "situation",
    ),
    Mutant(
        PART,
        "the bit of a forgotten panorama is lost with the next one",
        "potlp_jax/learning/memory.py",
        "status=memory.status | status_if(needed[place], Status.VIEW_OVERFLOW)",
        "status=status_if(needed[place], Status.VIEW_OVERFLOW)",
        ("tests/test_memory.py",),
    ),
    Mutant(
        PART,
        "a fallback is not flagged",
        "potlp_jax/planning/policies.py",
        "plan.status | status_if(kind == MoveKind.FALLBACK, Status.FALLBACK)",
        "plan.status",
        ("tests/test_status.py",),
        "situation",
    ),
    Mutant(
        PART,
        "a move forgets what was cut off among the subgoals",
        "potlp_jax/planning/move.py",
        "bits | situation.status | status_if(~goes, Status.NO_FRONTIER)",
        "bits | status_if(~goes, Status.NO_FRONTIER)",
        ("tests/test_status.py",),
        "situation",
    ),
    Mutant(
        PART,
        "a trial keeps the bits of its last decision alone",
        _RULES,
        "status=tally.status | move.status",
        "status=move.status",
        ("tests/test_status.py",),
        "stays",
    ),
)
