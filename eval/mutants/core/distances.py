"""Faults of the core: distances."""

from eval.mutants.mutant import Mutant

PART = "distances"

_MOVES = "potlp_jax/world/moves.py"
_PRODUCT = "potlp_jax/planning/distances/product.py"

MUTANTS = (
    Mutant(
        PART,
        "a diagonal move costs 1",
        _MOVES,
        "1.0 if 0 in offset else DIAGONAL for offset",
        "1.0 for offset",
        ("tests/test_moves.py",),
    ),
    Mutant(
        PART,
        "a move cuts one kind of corner",
        _MOVES,
        "if free[there] and free[there[0], column] and free[row, there[1]]:",
        "if free[there] and free[there[0], column]:",
        ("tests/test_moves.py",),
    ),
    Mutant(
        PART,
        "falling and rising diagonals are exchanged",
        _MOVES,
        "    return falling, rising\n",
        "    return rising, falling\n",
        ("tests/test_moves.py", "tests/test_product.py"),
        "corners",
    ),
    Mutant(
        PART,
        "the cost to finish is in cells",
        _PRODUCT,
        "return travel * resolution, finish * resolution",
        "return travel * resolution, finish",
        ("tests/test_product.py",),
        "table_equals",
    ),
    Mutant(
        PART,
        "a letter that leads to a trap may be entered",
        _PRODUCT,
        "known_free[:, :, None] & ~task.trap[following]",
        "known_free[:, :, None]",
        ("tests/test_product.py",),
        "trap or equal_a_heap",
    ),
    Mutant(
        PART,
        "a diagonal step of a sweep costs 1",
        "potlp_jax/planning/distances/sweeping.py",
        "return jnp.where(blocked, jnp.inf, DIAGONAL).astype(jnp.float32)",
        "return jnp.where(blocked, jnp.inf, 1.0).astype(jnp.float32)",
        ("tests/test_product.py",),
        "equal_a_heap",
    ),
)
