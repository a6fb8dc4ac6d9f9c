"""Faults of the core: judges."""

from eval.mutants.mutant import Mutant

PART = "judges"

_AUDIT = "potlp_jax/verify/audit.py"
_ALONE = "not sweep and not command and not row"
"""Of the auditor's tests: those of one trial, which need no sweep."""

MUTANTS = (
    Mutant(
        PART,
        "a sweep goes on with rows of worlds that have changed",
        "potlp_jax/sweep/runner.py",
        "if not self.work.is_of(row):",
        "if False:",
        ("tests/test_sweep.py",),
        "has_changed",
    ),
    Mutant(
        PART,
        "a world whose known path is longer than the budget is impossible",
        "potlp_jax/sweep/work.py",
        "trial.outcome is not Outcome.INFEASIBLE",
        "trial.outcome is Outcome.SATISFIED",
        ("tests/test_sweep.py",),
        "longer_than_the_budget",
    ),
    Mutant(
        PART,
        "the auditor sees no violation",
        _AUDIT,
        "if len(word) > 1 and violated:",
        "if False:",
        ("tests/test_audit.py",),
        _ALONE,
    ),
    Mutant(
        PART,
        "the auditor believes any outcome",
        _AUDIT,
        "if satisfied != (outcome == Outcome.SATISFIED):",
        "if False:",
        ("tests/test_audit.py",),
        _ALONE,
    ),
    Mutant(
        PART,
        "an automaton without a formula is never satisfied",
        _AUDIT,
        "return any(task.dfa.accepting[state] for state in states), bool(task.dfa.trap[states[-1]])",
        "return False, bool(task.dfa.trap[states[-1]])",
        ("tests/test_audit.py",),
        "automaton",
    ),
    Mutant(
        PART,
        "the auditor takes costs roughly",
        _AUDIT,
        "_TOLERANCE = 1e-9",
        "_TOLERANCE = 1e-1",
        ("tests/test_audit.py",),
        _ALONE,
    ),
    Mutant(
        PART,
        "the auditor does not look where the path begins",
        _AUDIT,
        "if not cells or cells[0] != start:",
        "if not cells:",
        ("tests/test_audit.py",),
        _ALONE,
    ),
    Mutant(
        PART,
        "the auditor lets unobserved cells be entered",
        _AUDIT,
        "_decision_differences(trial) + _entered_before_observed(trial)",
        "_decision_differences(trial)",
        ("tests/test_audit.py",),
        _ALONE,
    ),
    Mutant(
        PART,
        "without Spot xor binds no stronger than |",
        "potlp_jax/task/language.py",
        '"xor": (2, False',
        '"xor": (1, False',
        ("tests/test_language.py",),
        "bind_as",
    ),
    Mutant(
        PART,
        "an automaton's bits are the world's in any order",
        "potlp_jax/verify/audit.py",
        "        if task.propositions != propositions:\n",
        "        if sorted(task.propositions) != sorted(propositions):\n",
        ("tests/test_audit.py",),
        "those_of_the_world",
    ),
    Mutant(
        PART,
        "the auditor stops at a formula that it does not read",
        "potlp_jax/sweep/audit.py",
        "    if can_be_judged(text, propositions):\n",
        "    if True:\n",
        ("tests/test_audit.py",),
        "any_spelling",
    ),
)
