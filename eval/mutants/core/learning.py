"""Faults of the core: labels, what is painted, and loss."""

from eval.mutants.mutant import Mutant

PART = "labels and loss"

_LABELS = "potlp_jax/learning/labels.py"
_RESAMPLING = "potlp_jax/learning/resampling.py"
_LOSS = "potlp_jax/learning/loss.py"
_PAINTING = "potlp_jax/learning/painting.py"

MUTANTS = (
    Mutant(
        PART,
        "nearest ways: long detours count",
        _LABELS,
        "_DETOUR * least + _DETOUR_CELLS",
        "2 * _DETOUR * least + _DETOUR_CELLS",
        ("tests/test_labels.py",),
        "nearest",
    ),
    Mutant(
        PART,
        "glances: the obstacle at the end of a line is not met",
        _PAINTING,
        "met = (enter <= free_until[None])",
        "met = (enter < free_until[None])",
        ("tests/test_painting.py",),
        "loop_over_cells or glance",
    ),
    Mutant(
        PART,
        "glances: a cell takes its own column, which does not meet it",
        _PAINTING,
        "column = jnp.where(in_sight, column, (column + turn) % panorama.shape[1])",
        "column = column % panorama.shape[1]",
        ("tests/test_painting.py",),
        "loop_over_cells or glance",
    ),
    Mutant(
        PART,
        "R_S: a path may come back through its own frontier",
        _LABELS,
        "[:, :, None] & ~own\n",
        "[:, :, None]\n",
        ("tests/test_labels.py",),
    ),
    Mutant(
        PART,
        "R_S: what was seen may be left for the unobserved again",
        _LABELS,
        "enter((~hidden & ~own, SEEN))",
        "enter((~own, SEEN))",
        ("tests/test_labels.py",),
    ),
    Mutant(
        PART,
        "R_F: observed cells beyond count too",
        _LABELS,
        "enter((hidden, HIDDEN), (way_back, SEEN)),",
        "enter((hidden | way_back, HIDDEN)),",
        ("tests/test_labels.py",),
    ),
    Mutant(
        PART,
        "R_F: the nearest cell",
        _LABELS,
        "failure_cost = jnp.max(jnp.where(jnp.isfinite(cost[HIDDEN]), cost[HIDDEN], 0.0), axis=(0, 1))",
        "failure_cost = jnp.min(jnp.where(jnp.isfinite(cost[HIDDEN]), cost[HIDDEN], jnp.inf), axis=(0, 1))",
        ("tests/test_labels.py",),
    ),
    Mutant(
        PART,
        "loss: failures are pulled toward success",
        _LOSS,
        "taken = (1 - success) * of_failure * jax.nn.softplus(answers.success_logit)",
        "taken = (1 - success) * of_failure * jax.nn.softplus(-answers.success_logit)",
        ("tests/test_training.py",),
        "written_out",
    ),
    Mutant(
        PART,
        "loss: weights are not scaled by their mean",
        _LOSS,
        "of_failure = weighting * jnp.where(batch.mask, batch.failure_weight, jnp.float32(0)) / mean + (1 - weighting)",
        "of_failure = weighting * jnp.where(batch.mask, batch.failure_weight, jnp.float32(0)) + (1 - weighting)",
        ("tests/test_training.py",),
        "written_out",
    ),
    Mutant(
        PART,
        "loss: R_S is learned from failures too, and R_F from successes",
        _LOSS,
        "jnp.where(known, share * error**2, jnp.float32(0))",
        "jnp.where(known, error**2, jnp.float32(0))",
        ("tests/test_training.py",),
        "written_out or nan_gradient",
    ),
    Mutant(
        PART,
        "loss: padding counts",
        _LOSS,
        "cross_entropy=jnp.sum(real * (missed + taken))",
        "cross_entropy=jnp.sum(missed + taken)",
        ("tests/test_training.py",),
        "written_out or nan_gradient",
    ),
    Mutant(
        PART,
        "resampling: what is in the way needs half of a larger cell",
        _RESAMPLING,
        "_THICK = 3",
        "_THICK = 2",
        ("tests/test_resampling.py",),
        "walk_over or thin_wall",
    ),
    Mutant(
        PART,
        "resampling: colours of walls and floors are mixed",
        _RESAMPLING,
        "best = painted & (alike | ~jnp.any(painted & alike, axis=(1, 3), keepdims=True))",
        "best = painted",
        ("tests/test_resampling.py",),
        "walk_over",
    ),
    Mutant(
        PART,
        "building estimator: the camera has its height in the network's cells on every map",
        "potlp_jax/learning/building_estimator.py",
        "camera.lengths(1 / self.scale)",
        "camera.lengths(1.0)",
        ("tests/test_resampling.py",),
        "painted_where",
    ),
    Mutant(
        PART,
        "drives of a collection sense as trials do",
        "potlp_jax/recipes/collection.py",
        "        sensor=config.explorer.sensor,\n        decision",
        "        decision",
        ("tests/test_collect.py",),
        "drives_sense",
    ),
)
