"""Sets of letters as few conjunctions of literals: prime implicants and canonical covers.

A **guard** is a set of letters, ``bool[L]`` with ``L = 2 ** n``. A **cube** is a conjunction of literals, written as
its vector phi in {-1, 0, 1}^n: 1 where the proposition must hold, -1 where it must not, 0 where it has no effect
(Bradley et al. 2021, section IV-A).

Covers are canonical: equal guards get equal cubes, in one order. Estimators are trained per cube, and what they learnt
must mean the same whenever a formula is compiled again.

References:
    Quine, The problem of simplifying truth functions, 1952 (prime implicants, minimal covers).
    McCluskey, Minimization of Boolean functions, 1956.
"""

import heapq
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

Phi = tuple[int, ...]

MAX_PRIMES_EXACT: int = 64
"""Guards with more prime implicants get a greedy cover. 64 primes are the bits of one integer per letter."""


def num_propositions(guard: Bool[np.ndarray, " L"]) -> int:
    """n, from ``L = 2 ** n``."""
    return guard.size.bit_length() - 1


def cube_letters(phi: Sequence[int]) -> Bool[np.ndarray, " L"]:
    """The letters that satisfy the cube."""
    letters = np.zeros((2,) * len(phi), dtype=bool)
    letters[_cube_index(phi)] = True
    return letters.ravel()


def hull(guard: Bool[np.ndarray, " L"]) -> Phi:
    """The literals that all letters of a non-empty guard share: the smallest cube around it."""
    # A bit set in every letter is a positive literal, one set in none a negative one.
    letters = np.flatnonzero(guard)
    always, ever = np.bitwise_and.reduce(letters), np.bitwise_or.reduce(letters)
    return tuple(1 if always >> i & 1 else 0 if ever >> i & 1 else -1 for i in range(num_propositions(guard)))


def prime_implicants(guard: Bool[np.ndarray, " L"]) -> list[Phi]:
    """All maximal cubes inside the guard, in lexicographic order.

    Splits on the highest proposition: a prime that does not mention it is a prime of both halves' intersection; one
    that does is a prime of its half which is not a prime of the intersection. Equal halves are solved once, so that
    the effort follows the guard's structure and not ``3 ** n``.
    """
    solved: dict[bytes, frozenset[Phi]] = {}

    def primes(part: np.ndarray) -> frozenset[Phi]:
        if part.all():
            return frozenset({(0,) * num_propositions(part)})
        if not part.any():
            return frozenset()
        key = part.tobytes()
        if key not in solved:
            # Letters are in increasing order, so the halves are those without and with the highest proposition.
            low, high = part[: part.size // 2], part[part.size // 2 :]
            both = primes(low & high)
            cubes = {(*cube, 0) for cube in both}
            cubes |= {(*cube, -1) for cube in primes(low) - both}
            cubes |= {(*cube, 1) for cube in primes(high) - both}
            solved[key] = frozenset(cubes)
        return solved[key]

    return sorted(primes(guard))


def minimal_cover(guard: Bool[np.ndarray, " L"]) -> tuple[Phi, ...]:
    """Prime implicants whose union is the guard, as few as possible, in lexicographic order.

    Among covers of that size the lexicographically first one is taken, so that equal guards get equal cubes. Above
    ``MAX_PRIMES_EXACT`` primes the cover is greedy: the prime with the most uncovered letters, ties by phi.
    """
    # Some smallest cover by cubes consists of primes alone: growing a cube within the guard loses no letter.
    primes = prime_implicants(guard)
    if len(primes) > MAX_PRIMES_EXACT:
        return _greedy_cover(guard, primes)
    return tuple(primes[i] for i in _smallest_hitting_set(_requirements(guard, primes), len(primes)))


def _cube_index(phi: Sequence[int]) -> tuple[slice | int, ...]:
    """Index of the cube in an array of shape ``(2,) * n``, whose first axis is the highest proposition."""
    return tuple(slice(None) if literal == 0 else int(literal > 0) for literal in reversed(phi))


def _requirements(guard: np.ndarray, primes: list[Phi]) -> list[int]:
    """For each letter of the guard the set of primes that cover it, as bits; only the minimal sets are kept."""
    # Each letter must be covered by one of its primes: a hitting set problem. Letters with the same primes ask the
    # same.
    covering = np.zeros(guard.size, dtype=np.uint64)
    for i, phi in enumerate(primes):
        covering[cube_letters(phi)] |= np.uint64(1 << i)
    return _minimal_sets(np.unique(covering[guard]).tolist())


def _minimal_sets(sets: list[int]) -> list[int]:
    """Drops every set that contains another one, smallest first."""
    # What hits the smaller set hits the larger one too. By increasing size, a set is compared only with those it may
    # hold.
    minimal: list[int] = []
    for candidate in sorted(sets, key=int.bit_count):
        if not any(kept & candidate == kept for kept in minimal):
            minimal.append(candidate)
    return minimal


def _smallest_hitting_set(sets: list[int], size: int) -> list[int]:
    """Lexicographically first among the smallest index sets that meet every one of ``sets``."""
    # First how many are needed, from the lower bound up; then each index in order is taken wherever the rest can still
    # be done with one fewer. That is the lexicographically first of the smallest sets.
    # A prime that is the only one of some letter is in every cover; where all are, nothing has to be searched for.
    forced = {bits.bit_length() - 1 for bits in sets if bits.bit_count() == 1}
    sets = [bits for bits in sets if not any(bits >> i & 1 for i in forced)]
    budget = _disjoint_sets(sets)
    while not _can_hit(sets, budget):
        budget += 1
    chosen: list[int] = []
    for i in range(size):
        if not sets:
            break
        # Sets that i does not hit. Taking i again is no option for what follows, so it is removed from all sets.
        missed = [bits for bits in sets if not bits >> i & 1]
        without = [bits & ~(1 << i) for bits in missed]
        if _can_hit(without, budget - 1):
            chosen.append(i)
            sets, budget = without, budget - 1
        else:
            sets = [bits & ~(1 << i) for bits in sets]
    return sorted(forced.union(chosen))


def _disjoint_sets(sets: list[int]) -> int:
    """How many pairwise disjoint sets are found greedily: a lower bound on what hits them all."""
    used = count = 0
    for bits in sorted(sets, key=int.bit_count):
        if not bits & used:
            used |= bits
            count += 1
    return count


def _can_hit(sets: list[int], budget: int) -> bool:
    """Whether ``budget`` indices can meet every set: branches on the smallest set."""
    if not sets:
        return True
    if budget < 0:
        return False
    # Both reductions keep the least number that is needed. An empty set, which comes first, can be hit by nothing.
    sets = _minimal_sets(_without_dominated(sets))
    if not sets[0] or _disjoint_sets(sets) > budget:
        return False
    # One member of the smallest set must be chosen; members that have failed are not tried again in deeper branches.
    smallest = sets[0]
    for i in range(smallest.bit_length()):
        if smallest >> i & 1:
            if _can_hit([bits for bits in sets if not bits >> i & 1], budget - 1):
                return True
            sets = [bits & ~(1 << i) for bits in sets]
    return False


def _without_dominated(sets: list[int]) -> list[int]:
    """Removes indices that meet no set which another index would not meet as well (the lowest of equals stays)."""
    # The transpose of ``sets``: for each index the rows that it meets, as bits.
    members = [sum(1 << row for row, bits in enumerate(sets) if bits >> i & 1) for i in range(max(sets).bit_length())]
    kept = 0
    # By decreasing number of rows met: an index can be dominated only by one with at least as many, decided before.
    for i in sorted(range(len(members)), key=lambda i: -members[i].bit_count()):
        if members[i] and not any(kept >> j & 1 and members[i] & members[j] == members[i] for j in range(len(members))):
            kept |= 1 << i
    return [bits & kept for bits in sets]


def _greedy_cover(guard: np.ndarray, primes: list[Phi]) -> tuple[Phi, ...]:
    """Repeatedly the prime with the most uncovered letters; counts only fall, so stale ones are upper bounds."""
    uncovered = guard.reshape((2,) * num_propositions(guard)).copy()
    # Nothing is covered yet, so a prime's count is the number of its letters; equal counts go by phi.
    queue = [(-(2 ** phi.count(0)), phi) for phi in primes]
    heapq.heapify(queue)
    chosen: list[Phi] = []
    while uncovered.any():
        bound, phi = heapq.heappop(queue)
        count = int(np.count_nonzero(uncovered[_cube_index(phi)]))
        # An up-to-date count at the head of the queue is the largest. A stale one goes back with its new count.
        if count == -bound:
            chosen.append(phi)
            uncovered[_cube_index(phi)] = False
        elif count:
            heapq.heappush(queue, (-count, phi))
    return tuple(sorted(chosen))
