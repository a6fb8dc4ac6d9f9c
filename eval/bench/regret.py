"""How far from the optimum are planners, by the CPU time they take?

    python -m eval.bench.regret --families find two --subgoals 4 8 --instances 12
    python -m eval.bench.regret --quick

The truth - Q of every root action by Eq. 3 - is computed once and kept. Where the exact solution does not fit into the
time allowed, V* is bounded by a certified interval, and regrets are measured against the best that is known: best-first
search as BEST_KNOWN says, within the certified bounds of each action; such instances are counted apart. The
regret of a choice is its Q less the least Q, absolute and in % of V* less its dead-end part: what a dead end costs is a
parameter, and would hide everything else where it is likely.

Planners: ``best-first`` is the library's default search, ``po-uct`` its PO-UCT; ``po-uct-numba`` and
``po-uct-pomdp-py`` are the same algorithm compiled by Numba and in pomdp-py; ``mctx`` is mctx's stochastic MuZero
search.

Mean regrets have a bootstrap interval of 95 % over instances. Of best-first search, which may end by itself, it is
counted how many searches had ended, and how many of these were wrong where the truth is exact: none should be.

Rows of earlier runs into the same folder are kept where the new run does not repeat them.

CPU time is that of the whole process per decision, compilation and the preparation on the host apart: batched
planners' time is divided by the rows. Writes ``regret.json``, ``regret.md`` and ``regret-S<S>.png``.
"""

import argparse
import functools
import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from eval.bench.opponents import installed
from eval.bench.regret_report import Row, report
from potlp_jax.bench.memory import tree_memory
from potlp_jax.bench.problems import FAMILIES, SUBGOAL_COUNTS, Split, family_problem
from potlp_jax.errors import ProblemTooLargeError
from potlp_jax.planning.exact.api import bound_exact, solve_exact
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.api import plan_actions
from potlp_jax.planning.search.config import BestFirstConfig, UctConfig
from potlp_jax.sweep.rows import provenance
from potlp_jax.types import NO_ACTION, Status

TREE_BYTES = 1_000_000_000
"""Memory for trees: as many of our searches as fit run in one batch."""

BEST_KNOWN = BestFirstConfig(simulations=100_000, optimism=0.4, max_depth=48)
"""Search that stands in for the exact solution where that is out of reach; not of the default optimism, so that
no search is judged by itself."""


@dataclass(frozen=True)
class Truth:
    """What the root actions of an instance cost.

    Attributes:
      q_values: ``[A]``, Q, inf where the action is not available; the best that is known where not ``exact``.
      lower, upper: certified bounds of V*, equal where ``exact``.
      dead_end_part: how much of V* comes from dead ends; from below where the truth is not exact.
      exact: whether Q is known.
    """

    q_values: np.ndarray
    lower: float
    upper: float
    dead_end_part: float
    exact: bool

    def regret(self, action: int) -> float:
        """Absolute regret of an action; inf for none."""
        return float("inf") if action == NO_ACTION else float(self.q_values[action] - self.q_values.min())

    @property
    def scale(self) -> float:
        """V* without its dead-end part."""
        return float(self.q_values.min()) - self.dead_end_part


Answer = tuple[str, int, float, list[int], list[bool]]
"""Planner, budget, CPU seconds per decision, chosen action of each instance, and whether its search ended by itself."""


def truth_of(problem: PlanningProblem, cache: Path, seconds: float) -> Truth:
    """The truth of an instance, from the cache where that belongs to this very problem and took as long as allowed."""
    digest = _fingerprint(problem)
    if cache.exists():
        with np.load(cache) as kept:
            lower, upper, dead_end_part = (float(kept[name]) for name in ("lower", "upper", "dead_end_part"))
            truth = Truth(kept["q_values"], lower, upper, dead_end_part, bool(kept["exact"]))
            if str(kept["digest"]) == digest and (truth.exact or float(kept["seconds"]) >= seconds):
                return truth
    try:
        solution = solve_exact(problem, seconds=seconds)
        truth = Truth(solution.q_values, solution.value, solution.value, solution.dead_end_part, True)
    except ProblemTooLargeError:
        bounds = bound_exact(problem, seconds=seconds)
        found = _long_search(problem, jax.random.key(0))
        best_known = np.clip(np.asarray(found, np.float64), bounds.q_lower, bounds.q_upper)
        truth = Truth(best_known, bounds.lower, bounds.upper, bounds.dead_end_part, False)
    cache.parent.mkdir(parents=True, exist_ok=True)
    np.savez(cache, digest=digest, seconds=seconds, **asdict(truth))
    return truth


def _fingerprint(problem: PlanningProblem) -> str:
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(problem):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()


@jax.jit
def _long_search(problem: PlanningProblem, key: Any) -> Any:
    return plan_actions(problem, key, BEST_KNOWN).q_values


def ours(
    name: str, kind: type[BestFirstConfig | UctConfig] = BestFirstConfig, **settings: Any
) -> Callable[..., Iterator[Answer]]:
    """One of our searches on all instances, compiled as users compile it, in batches whose trees fit ``TREE_BYTES``;
    every budget begins anew."""

    def run(problems: Sequence[PlanningProblem], budgets: Sequence[int]) -> Iterator[Answer]:
        keys = jax.random.split(jax.random.key(0), len(problems))
        for budget in budgets:
            config = kind(simulations=budget, **settings)
            rows = min(len(problems), max(1, TREE_BYTES // tree_memory(problems[0], config).total))
            compiled = jax.jit(jax.vmap(functools.partial(_choice, config=config)))
            jax.block_until_ready(compiled(_stack(problems[:rows]), keys[:rows]))
            seconds, (actions, ended) = _in_batches(compiled, problems, keys, rows)
            yield name, budget, seconds, actions.tolist(), ended.tolist()

    return run


def _choice(problem: PlanningProblem, key: Any, config: BestFirstConfig | UctConfig) -> tuple[Any, Any]:
    """The chosen action, and whether the search ended by itself."""
    plan = plan_actions(problem, key, config)
    overflows = plan.status & jnp.uint32(int(Status.DEPTH_OVERFLOW | Status.TREE_OVERFLOW))
    return plan.action, (plan.lower_bound >= plan.value) & (overflows == 0)


def numba_pouct(problems: Sequence[PlanningProblem], budgets: Sequence[int]) -> Iterator[Answer]:
    """The paper's PO-UCT in Numba; by its most visited action, and by the one of least mean cost."""
    from eval.bench.opponents.pouct_numba import NumbaSearch

    NumbaSearch(problems[0]).run(10)
    yield from _one_by_one(
        "po-uct-numba", NumbaSearch, problems, budgets, {"": "most_visited", ", least mean": "least_mean"}
    )


def pomdp_py(problems: Sequence[PlanningProblem], budgets: Sequence[int]) -> Iterator[Answer]:
    """pomdp-py's PO-UCT; its own answer is the action of the best mean."""
    from eval.bench.opponents.pomdp_py_search import PomdpPySearch

    PomdpPySearch(problems[0]).run(10)
    yield from _one_by_one("pomdp-py", PomdpPySearch, problems, budgets, {"": "least_mean"})


def mctx(problems: Sequence[PlanningProblem], budgets: Sequence[int]) -> Iterator[Answer]:
    """mctx's stochastic MuZero search, twice as many of its simulations, 16 rows at a time."""
    from eval.bench.opponents.mctx_search import mctx_plan

    rows, key = min(16, len(problems)), jax.random.key(0)
    for budget in budgets:
        compiled = mctx_plan.lower(_stack(problems[:rows]), key, simulations=2 * budget).compile()
        seconds, actions = _in_batches(
            lambda batch, _, compiled=compiled: compiled(batch, key).action, problems, np.arange(len(problems)), rows
        )
        yield "mctx", budget, seconds, actions.tolist(), [False] * len(problems)


def _in_batches(
    run: Callable[[PlanningProblem, Any], Any], problems: Sequence[PlanningProblem], keys: Any, rows: int
) -> tuple[float, Any]:
    """Run so many rows at once; returns CPU seconds per row and the arrays that ``run`` gives, a row a problem."""
    seconds, parts = 0.0, []
    for first in range(0, len(problems), rows):
        # The last rows are filled up from the front, so that every call has the compiled shape.
        start_row = min(first, len(problems) - rows)
        batch = _stack(problems[start_row : start_row + rows])
        start = time.process_time()
        answers = jax.block_until_ready(run(batch, keys[start_row : start_row + rows]))
        seconds += time.process_time() - start
        parts.append(jax.tree.map(lambda leaf, known=first - start_row: np.asarray(leaf)[known:], answers))
    return seconds / (len(parts) * rows), jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


PLANNERS: dict[str, Callable[..., Iterator[Answer]]] = {
    "best-first": ours("best-first"),
    "po-uct": ours("po-uct", UctConfig),
    "po-uct-numba": numba_pouct,
    "po-uct-pomdp-py": pomdp_py,
    "mctx": mctx,
}
FEW = {"po-uct-pomdp-py": 6}
"""Instances of a planner too slow for all."""
LARGEST = {"po-uct": 1000, "po-uct-pomdp-py": 1000, "mctx": 1000}
"""Budgets beyond which a planner is not asked: it gains no more, or takes too long."""


def _one_by_one(
    name: str, search: Any, problems: Sequence[PlanningProblem], budgets: Sequence[int], choices: dict[str, str]
) -> Iterator[Answer]:
    """A search of one problem that can be continued: every budget goes on from the one before."""
    seconds = np.zeros((len(budgets), len(problems)))
    found: dict[str, list[list[int]]] = {suffix: [[] for _ in budgets] for suffix in choices}
    for column, problem in enumerate(problems):
        one, before, spent = search(problem, seed=column), 0, 0.0
        for level, budget in enumerate(budgets):
            start = time.process_time()
            one.run(budget - before)
            spent, before = spent + time.process_time() - start, budget
            seconds[level, column] = spent
            statistics = one.statistics()
            for suffix, choice in choices.items():
                found[suffix][level].append(getattr(statistics, choice))
    for suffix, levels in found.items():
        for level, budget in enumerate(budgets):
            yield name + suffix, budget, float(seconds[level].mean()), levels[level], [False] * len(problems)


def _stack(problems: Sequence[PlanningProblem]) -> PlanningProblem:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *problems)


def benchmark(arguments: argparse.Namespace) -> Iterator[Row]:
    """Every family, S, planner and budget in turn."""
    for family in arguments.families:
        for subgoals in arguments.subgoals:
            chosen = list(_instances(arguments, family, subgoals))
            print(
                f"{family} S={subgoals}: {len(chosen)} of {arguments.instances} instances have a choice to make",
                flush=True,
            )
            for name, planner in (_planners(arguments) if chosen else {}).items():
                few = chosen[: FEW.get(name, len(chosen))]
                largest = LARGEST.get(name.partition(",")[0], max(arguments.budgets))
                budgets = [budget for budget in arguments.budgets if budget <= largest]
                yield from _rows(arguments.split, (family, subgoals), few, planner, budgets)


def _planners(arguments: argparse.Namespace) -> dict[str, Callable[..., Iterator[Answer]]]:
    """Those that were asked for, and our own with each optimism."""
    chosen = {name: PLANNERS[name] for name in arguments.planners}
    for optimism in arguments.optimism:
        name = f"best-first, optimism {optimism:g}"
        chosen[name] = ours(name, optimism=optimism)
    return chosen


Instance = tuple[int, PlanningProblem, Truth]


def _instances(arguments: argparse.Namespace, family: str, subgoals: int) -> Iterator[Instance]:
    """Instances with something to do."""
    for index in range(arguments.instances):
        problem = family_problem(family, subgoals, arguments.split, index)
        cache = Path(arguments.out) / "truth" / f"{family}-{subgoals}-{arguments.split}-{index}.npz"
        truth = truth_of(problem, cache, arguments.seconds)
        if np.isfinite(truth.q_values).any():
            yield index, problem, truth


def _rows(
    split: str,
    case: tuple[str, int],
    chosen: Sequence[Instance],
    planner: Callable[..., Iterator[Answer]],
    budgets: list[int],
) -> Iterator[Row]:
    truths = [truth for _, _, truth in chosen]
    for name, budget, seconds, actions, ended in planner([problem for _, problem, _ in chosen], budgets):
        absolute = [truth.regret(action) for truth, action in zip(truths, actions, strict=True)]
        yield Row(
            split=split,
            family=case[0],
            subgoals=case[1],
            planner=name,
            budget=budget,
            cpu_ms=1e3 * seconds,
            instances=[index for index, _, _ in chosen],
            percent=[100.0 * regret / truth.scale for regret, truth in zip(absolute, truths, strict=True)],
            absolute=absolute,
            exact=[truth.exact for truth in truths],
            interval_percent=[100.0 * (truth.upper - truth.lower) / truth.scale for truth in truths],
            ended=ended,
        )


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    splits = Split.__args__
    parser.add_argument("--families", nargs="+", choices=list(FAMILIES), default=list(FAMILIES), metavar="NAME")
    parser.add_argument("--subgoals", nargs="+", type=int, default=list(SUBGOAL_COUNTS), metavar="S")
    parser.add_argument("--instances", type=int, default=24)
    parser.add_argument("--split", choices=splits, default="test", help="tune on 'tuning' only")
    parser.add_argument("--budgets", nargs="+", type=int, default=[10, 30, 100, 300, 1000, 10_000, 100_000])
    parser.add_argument("--planners", nargs="+", choices=list(PLANNERS), default=list(PLANNERS), metavar="NAME")
    parser.add_argument(
        "--optimism", nargs="+", type=float, default=[], metavar="W", help="best-first search with each, too"
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="for the truth of one instance")
    parser.add_argument("--quick", action="store_true", help="one family, S = 4, 6 tuning instances, two budgets")
    parser.add_argument("--out", default="out/bench/regret")
    parsed = parser.parse_args(arguments)
    if parsed.quick:
        parsed.families, parsed.subgoals, parsed.instances = ["two"], [4], 6
        parsed.budgets, parsed.split = [30, 300], "tuning"
    parsed.budgets = sorted(parsed.budgets)
    parsed.planners = installed(parsed.planners)
    return parsed


def main(arguments: Sequence[str] | None = None) -> None:
    """Run, and write what was found after every row."""
    parsed = parse(arguments)
    out = Path(parsed.out)
    out.mkdir(parents=True, exist_ok=True)
    rows = _earlier(out / "regret.json", parsed.split)
    for row in benchmark(parsed):
        rows[row.family, row.subgoals, row.planner, row.budget] = row
        print(
            f"{row.family} S={row.subgoals} {row.planner} {row.budget}: {row.mean_percent:.3g} % mean, "
            f"{max(row.percent):.3g} % worst, {row.cpu_ms:.3g} CPU ms",
            flush=True,
        )
        content = {
            "provenance": provenance(),
            "arguments": vars(parsed),
            "rows": [asdict(row) for row in rows.values()],
        }
        (out / "regret.json").write_text(json.dumps(content, indent=1))
    ordered = sorted(rows.values(), key=lambda row: (list(FAMILIES).index(row.family), row.subgoals))
    report(ordered, out)
    print(f"ended searches that were wrong: {sum(row.ended_wrong for row in ordered)}")


def _earlier(path: Path, split: str) -> dict[tuple[str, int, str, int], Row]:
    """Rows of an earlier run on the same split."""
    if not path.exists():
        return {}
    rows = [Row(**row) for row in json.loads(path.read_text())["rows"]]
    return {(row.family, row.subgoals, row.planner, row.budget): row for row in rows if row.split == split}


if __name__ == "__main__":
    main()
