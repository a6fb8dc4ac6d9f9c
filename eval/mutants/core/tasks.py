"""Faults of the core: tasks."""

from eval.mutants.mutant import Mutant

PART = "tasks"

_OUTCOMES = "potlp_jax/task/outcomes.py"

MUTANTS = (
    Mutant(
        PART,
        "the order of Σ does not matter",
        "potlp_jax/task/propositions.py",
        "    if tuple(asked) == tuple(known):\n",
        "    if sorted(asked) == sorted(known):\n",
        ("tests/test_propositions.py",),
        "refused",
    ),
    Mutant(
        PART,
        "a world may have propositions that the task does not know",
        "potlp_jax/task/propositions.py",
        "    if tuple(asked) == tuple(known):\n",
        "    if tuple(asked) == tuple(known)[: len(asked)]:\n",
        ("tests/test_propositions.py",),
        "refused",
    ),
    Mutant(
        PART,
        "bits of Σ are those of the automaton's own order",
        "potlp_jax/task/task.py",
        "bits = [propositions.index(name) for name in automaton.propositions]",
        "bits = list(range(len(automaton.propositions)))",
        ("tests/test_task.py", "tests/test_automaton.py"),
        "propositions",
    ),
    Mutant(
        PART,
        "a state is satisfied that can still avoid acceptance",
        "potlp_jax/task/automaton.py",
        "            return ~_reaches(adjacency, avoiding)",
        "            return ~avoiding",
        ("tests/test_automaton.py",),
    ),
    Mutant(
        PART,
        "a condition implies another only if its staying letters stay there too",
        _OUTCOMES,
        "implies[a] = go_within & ~(stay[a] & ~(stay | go)).any(axis=1)",
        "implies[a] = go_within & ~(stay[a] & ~stay).any(axis=1)",
        ("tests/test_outcomes.py",),
        "implications",
    ),
    Mutant(
        PART,
        "a condition implies another whatever the letters on the way",
        _OUTCOMES,
        "implies[a] = go_within & ~(stay[a] & ~(stay | go)).any(axis=1)",
        "implies[a] = go_within",
        ("tests/test_outcomes.py",),
        "implications",
    ),
    Mutant(
        PART,
        "there are actions that lead to a trap",
        _OUTCOMES,
        "            if target == source or dfa.trap[target]:\n",
        "            if target == source:\n",
        ("tests/test_outcomes.py",),
        "firefighting",
    ),
    Mutant(
        PART,
        "cubes of a guard are not prime",
        "potlp_jax/task/guards.py",
        "cubes |= {(*cube, -1) for cube in primes(low) - both}",
        "cubes |= {(*cube, -1) for cube in primes(low)}",
        ("tests/test_outcomes.py",),
        "canonical_cover",
    ),
    Mutant(
        PART,
        "classes of other staying letters are one",
        _OUTCOMES,
        "return [(self.phi_stay, cube, self.stay.tobytes()) for cube in self.cubes]",
        'return [(self.phi_stay, cube, b"") for cube in self.cubes]',
        ("tests/test_outcomes.py",),
        "equal_hulls",
    ),
    Mutant(
        PART,
        "max_positive_literals drops cubes that need just so many",
        _OUTCOMES,
        "positive <= max_positive_literals",
        "positive < max_positive_literals",
        ("tests/test_outcomes.py",),
        "max_positive_literals_drops",
    ),
)
