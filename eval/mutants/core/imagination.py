"""Faults of the core: paths through what a network imagines."""

from eval.mutants.mutant import Mutant

PART = "imagined paths"

_SQUARES = "potlp_jax/learning/squares.py"
_PATHS = "potlp_jax/learning/imagined_paths.py"
_WAYS = "potlp_jax/learning/square_ways.py"
_ESTIMATOR = "potlp_jax/learning/building_estimator.py"
_LEARNER = "potlp_jax/learning/building_learner.py"

MUTANTS = (
    Mutant(
        PART,
        "imagined: a side has all its openings",
        _SQUARES,
        "opening = _longest_run(along)",
        "opening = along",
        ("tests/test_squares.py",),
    ),
    Mutant(
        PART,
        "imagined: what is avoided closes nothing",
        _PATHS,
        "jnp.where(inside, 1 - chance * clear, jnp.inf)",
        "jnp.where(inside, 1 - chance, jnp.inf)",
        ("tests/test_imagined_paths.py",),
    ),
    Mutant(
        PART,
        "imagined: ways lead out by the subgoal's own frontier",
        _PATHS,
        "((lowest != part) | (highest != part)) & ",
        "",
        ("tests/test_imagined_paths.py",),
    ),
    Mutant(
        PART,
        "imagined: ways begin at frontiers beside the subgoal's own",
        _PATHS,
        "return (lowest == part) | (highest == part), other",
        "return (highest > 0) & (away >= 0), other",
        ("tests/test_imagined_paths.py",),
        "without_a_way",
    ),
    Mutant(
        PART,
        "imagined: a subgoal beside the frontier is on none",
        _PATHS,
        "jnp.where(parts > 0, parts, jax.lax.reduce_window(parts, 0, jax.lax.max, *_NEAR))",
        "parts",
        ("tests/test_imagined_paths.py",),
        "beside_the_frontier",
    ),
    Mutant(
        PART,
        "imagined: a network of before has the present frontiers",
        "potlp_jax/learning/architectures.py",
        '"own_within": 2',
        '"own_within": 0',
        ("tests/test_recipes.py",),
        "shipped",
    ),
    Mutant(
        PART,
        "imagined: ways cross what was observed",
        _PATHS,
        "inside = scene.hidden[:, :, None]\n",
        "inside = scene.hidden[:, :, None] | scene.open[:, :, None]\n",
        ("tests/test_imagined_paths.py",),
    ),
    Mutant(
        PART,
        "imagined: columns are swept with the rows' passages",
        _WAYS,
        "for number in _TRANSPOSED])",
        "for number in range(len(steps))])",
        ("tests/test_imagined_paths.py",),
        "dijkstra",
    ),
    Mutant(
        PART,
        "imagined: a goal is reached from any side",
        _PATHS,
        "arrived = ways_into_squares(hidden, approach)",
        "arrived = ways_into_squares(hidden)",
        ("tests/test_imagined_paths.py",),
    ),
    Mutant(
        PART,
        "imagined: of several propositions the best counts",
        _PATHS,
        "-1.0, 1.0), lanes.goal.shape)",
        "1.0, -1.0), lanes.goal.shape)",
        ("tests/test_imagined_paths.py",),
    ),
    Mutant(
        PART,
        "imagined: the last lanes are not solved",
        _PATHS,
        "fori_loop(0, -(-count // size), solve",
        "fori_loop(0, count // size, solve",
        ("tests/test_imagined_paths.py",),
    ),
    Mutant(
        PART,
        "imagined: classes share the outlook of the first",
        _ESTIMATOR,
        "*rows.shape[1:])[:, first], solved)",
        "*rows.shape[1:])[:, first * 0], solved)",
        ("tests/test_building_network.py",),
        "networks_answers",
    ),
    Mutant(
        PART,
        "imagined: samples of a view share one outlook",
        _LEARNER,
        "lambda array: array[inputs.lane_of], lanes)",
        "lambda array: array[inputs.lane_of * 0], lanes)",
        ("tests/test_building_learner.py",),
        "in_a_trial",
    ),
)
