"""Is a search that has ended by itself exact? Best-first search beside the exact solution, on random problems.

    python -m eval.bench.ended --instances 120

Problems are instances of every family of ``potlp_jax.bench.problems``, with one, two or three of their subgoals. A
search has ended where its certified lower bound has met its value. It is wrong where the chosen action costs more than
the best one by more than TOLERANCE of the optimum, or where its value is off by as much. Lower bounds of searches that
have not ended are judged too. Problems that ``solve_exact`` gives up on are counted and left out. Prints one line a
family, and writes ``ended.json``.
"""

import argparse
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from potlp_jax.bench.problems import FAMILIES, family_problem
from potlp_jax.errors import ProblemTooLargeError
from potlp_jax.planning.exact.api import ExactSolution, solve_exact
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.api import search
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.planning.search.plan import Plan
from potlp_jax.sweep.rows import provenance
from potlp_jax.types import NO_ACTION, Status

SUBGOALS = 3
TOLERANCE = 1e-4
"""Share of the optimum that 32 bits may cost."""


@dataclasses.dataclass(frozen=True)
class Count:
    """Searches of one family.

    Attributes:
      family: its name.
      judged: problems with an exact solution.
      too_large: problems without one.
      ended: searches that ended by themselves, none of them with an overflow.
      ended_wrong: of these, how many were wrong.
      wrong_bounds: searches, ended or not, whose lower bound is above the optimum.
      worst_error: largest error of an ended search's value, as a share of the optimum.
    """

    family: str
    judged: int
    too_large: int
    ended: int
    ended_wrong: int
    wrong_bounds: int
    worst_error: float


def judge(family: str, instances: int, simulations: int, seconds: float) -> Count:
    """Search and solve the instances of one family.

    Args:
      family: a key of ``FAMILIES``.
      instances: how many, of the split ``tuning``.
      simulations: of each search.
      seconds: processor time of ``solve_exact`` for each.

    Returns:
      What was found.
    """
    problems = [_with_few_subgoals(family, index) for index in range(instances)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *problems)
    keys = jax.random.split(jax.random.key(0), instances)
    plans, _ = jax.jit(lambda problems, keys: search(problems, keys, BestFirstConfig(simulations=simulations)))(
        stacked, keys
    )
    judged = ended = wrong = wrong_bounds = 0
    worst = 0.0
    for index, problem in enumerate(problems):
        try:
            solution = solve_exact(problem, seconds=seconds)
        except ProblemTooLargeError:
            continue
        plan = jax.tree.map(lambda leaf, index=index: np.asarray(leaf[index]), plans)
        judged += 1
        wrong_bounds += int(plan.lower_bound > solution.value * (1.0 + TOLERANCE))
        overflows = int(plan.status) & int(Status.DEPTH_OVERFLOW | Status.TREE_OVERFLOW)
        if plan.lower_bound >= plan.value and not overflows:
            ended += 1
            error, loss = _errors(plan, solution)
            worst = max(worst, error)
            wrong += int(max(error, loss) > TOLERANCE)
    return Count(family, judged, instances - judged, ended, wrong, wrong_bounds, worst)


def _with_few_subgoals(family: str, index: int) -> PlanningProblem:
    """An instance with one, two or three subgoals in arrays of one shape."""
    kept = np.arange(SUBGOALS) <= index % SUBGOALS
    return dataclasses.replace(family_problem(family, SUBGOALS, "tuning", index), subgoal_mask=jnp.asarray(kept))


def _errors(plan: Plan, solution: ExactSolution) -> tuple[float, float]:
    """Error of the value, and what the choice costs too much, both as a share of the optimum."""
    scale = max(solution.value, 1e-9)
    action = int(plan.action)
    if (action == NO_ACTION) != (solution.action == NO_ACTION):
        return float("inf"), float("inf")
    loss = 0.0 if action == NO_ACTION else float(solution.q_values[action]) - solution.value
    return abs(float(plan.value) - solution.value) / scale, loss / scale


def main(arguments: Sequence[str] | None = None) -> None:
    """Judge every family."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--families", nargs="+", choices=list(FAMILIES), default=list(FAMILIES), metavar="NAME")
    parser.add_argument("--instances", type=int, default=120, help="of each family")
    parser.add_argument("--simulations", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=5.0, help="for the exact solution of one instance")
    parser.add_argument("--out", default="out/bench/ended")
    parsed = parser.parse_args(arguments)
    counts = []
    for family in parsed.families:
        counts.append(judge(family, parsed.instances, parsed.simulations, parsed.seconds))
        print(counts[-1], flush=True)
    total = {name: sum(getattr(count, name) for count in counts) for name in ("judged", "ended", "ended_wrong")}
    print(f"{total['judged']} problems, {total['ended']} ended searches; that were wrong: {total['ended_wrong']}")
    out = Path(parsed.out)
    out.mkdir(parents=True, exist_ok=True)
    content = {"provenance": provenance(), "arguments": vars(parsed), "total": total}
    (out / "ended.json").write_text(
        json.dumps(content | {"families": [dataclasses.asdict(count) for count in counts]}, indent=1)
    )


if __name__ == "__main__":
    main()
