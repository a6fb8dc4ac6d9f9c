"""The mutants: small faults of the core, each as one exchange of text, with the tests that must notice it.

One module for each part of the core, in the order of the table.
"""

from eval.mutants.core import (
    distances,
    imagination,
    judges,
    kernels,
    learning,
    posteriors,
    resumption,
    rollouts,
    search,
    status,
    tasks,
    trials,
    world,
)
from eval.mutants.mutant import Mutant

MUTANTS: tuple[Mutant, ...] = (
    *rollouts.MUTANTS,
    *search.MUTANTS,
    *world.MUTANTS,
    *posteriors.MUTANTS,
    *distances.MUTANTS,
    *tasks.MUTANTS,
    *learning.MUTANTS,
    *imagination.MUTANTS,
    *trials.MUTANTS,
    *resumption.MUTANTS,
    *status.MUTANTS,
    *judges.MUTANTS,
    *kernels.MUTANTS,
)
