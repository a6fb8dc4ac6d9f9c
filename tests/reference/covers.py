"""Prime implicants and canonical covers from their definitions, by trying everything. For at most four propositions."""

import itertools

Phi = tuple[int, ...]


def letters_of(phi: Phi) -> frozenset[int]:
    """Letters (integers, bit i is proposition i) that satisfy a cube."""
    return frozenset(
        letter
        for letter in range(2 ** len(phi))
        if all(sign == 0 or (letter >> i & 1) == (sign > 0) for i, sign in enumerate(phi))
    )


def prime_implicants(guard: frozenset[int], n: int) -> list[Phi]:
    """Cubes inside the guard that lie in no larger cube inside the guard, in lexicographic order."""
    cubes = [phi for phi in itertools.product((-1, 0, 1), repeat=n) if letters_of(phi) <= guard]
    return [phi for phi in cubes if not any(letters_of(phi) < letters_of(other) for other in cubes)]


def canonical_cover(guard: frozenset[int], n: int) -> tuple[Phi, ...]:
    """Fewest primes whose union is the guard; of several such sets the lexicographically first."""
    primes = prime_implicants(guard, n)
    for size in range(len(primes) + 1):
        for chosen in itertools.combinations(primes, size):  # in lexicographic order, as primes are
            if frozenset().union(*map(letters_of, chosen)) == guard:
                return chosen
    raise AssertionError(guard)
