"""Faults of the core: sensing and frontiers."""

from eval.mutants.mutant import Mutant

PART = "sensing and frontiers"

_SENSING = "potlp_jax/world/sensing.py"
_FRONTIERS = "potlp_jax/world/frontiers.py"

MUTANTS = (
    Mutant(
        PART,
        "the sensor sees a cell farther than its range",
        _SENSING,
        "in_range = (row**2 + column**2 <= range_cells**2)",
        "in_range = (row**2 + column**2 <= (range_cells + 1) ** 2)",
        ("tests/test_sensing.py",),
        "reference or euclidean",
    ),
    Mutant(
        PART,
        "lines of sight are rounded down",
        _SENSING,
        "minor = np.sign(aim) * ((2 * k * np.abs(aim) + half) // (2 * half))",
        "minor = np.sign(aim) * ((2 * k * np.abs(aim)) // (2 * half))",
        ("tests/test_sensing.py",),
        "reference",
    ),
    Mutant(
        PART,
        "a line is stopped by one obstacle beside a diagonal step",
        _SENSING,
        "(beside & above).astype(jnp.uint8)",
        "(beside | above).astype(jnp.uint8)",
        ("tests/test_sensing.py",),
        "reference",
    ),
    Mutant(
        PART,
        "walls beside visible floor are seen by lines alone",
        _SENSING,
        "return near | free_seen | (occupied & dilate(free_seen))",
        "return near | free_seen | (occupied & seen)",
        ("tests/test_sensing.py",),
        "reference or grazed",
    ),
    Mutant(
        PART,
        "an observation forgets the letters that were known",
        _SENSING,
        "letters=jnp.where(seen, world.letters, belief.letters)",
        "letters=jnp.where(seen, world.letters, 0)",
        ("tests/test_sensing.py",),
        "kept",
    ),
    Mutant(
        PART,
        "components of a frontier part at corners",
        _FRONTIERS,
        "for row, column in NEIGHBOURS], dtype=jnp.int32)",
        "for row, column in NEIGHBOURS if 0 in (row, column)], dtype=jnp.int32)",
        ("tests/test_frontiers.py",),
        "reference or corners",
    ),
    Mutant(
        PART,
        "a connected part is numbered by a cell of the next row",
        _FRONTIERS,
        "first = (parent // (width + 2) - 1) * width",
        "first = (parent // (width + 2)) * width",
        ("tests/test_frontiers.py",),
        "flood_fill",
    ),
    Mutant(
        PART,
        "a component of the least size counts as a sliver",
        _FRONTIERS,
        "kept = is_root & ((size[:-1] >= config.min_size) | ~some_large)",
        "kept = is_root & ((size[:-1] > config.min_size) | ~some_large)",
        ("tests/test_frontiers.py",),
        "reference or small",
    ),
    Mutant(
        PART,
        "the subgoal is not the cell nearest the centroid",
        _FRONTIERS,
        "return count * square - 2 * (",
        "return count * square - (",
        ("tests/test_frontiers.py",),
        "reference or centroid",
    ),
    Mutant(
        PART,
        "as many subgoals as fit are called too many",
        _FRONTIERS,
        "jnp.sum(kept, dtype=jnp.int32) > config.max_subgoals",
        "jnp.sum(kept, dtype=jnp.int32) >= config.max_subgoals",
        ("tests/test_frontiers.py",),
        "reference or flagged or order_is",
    ),
)
