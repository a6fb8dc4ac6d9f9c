"""The native kernel of best-first search beside its twin in JAX: CPU time a decision, by family, batch and simulations.

    taskset -c 0 python -m eval.bench.native
    taskset -c 0 python -m eval.bench.native --quick

Problems are those of the split ``tuning``, S = 8. Seconds are CPU seconds of the whole process, the least of the
repeats; the two take turns, so that both meet the same machine. ``first_s`` is the wall time of the first decision:
tracing, compilation and one run. ``fresh_process_s`` is the wall time from the start of a process to its first decision
with full caches: imports, the formula's automaton, and what was compiled before is read. Writes JSON.
"""

import argparse
import contextlib
import json
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax

from potlp_jax.bench.planner import family_batch
from potlp_jax.native import is_usable, status, twin_only
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.api import plan_actions
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.planning.search.plan import Plan
from potlp_jax.sweep.rows import provenance

SUBGOALS = 8
FAMILIES = ("find", "two", "firefighting", "three-single")

_FIRST_DECISION = """
import jax
from potlp_jax.bench.problems import family_problem
from potlp_jax.cache import enable_compilation_cache
from potlp_jax.planning.search.api import plan_actions

enable_compilation_cache()
problem = family_problem("three-single", 8, "tuning", 0)
jax.block_until_ready(jax.jit(plan_actions)(problem, jax.random.key(0)))
"""


@dataclass(frozen=True)
class Row:
    """One measurement of both.

    Attributes:
      family: of the problems.
      batch: problems at once.
      simulations: most a decision.
      native_us: CPU microseconds a decision of the kernel.
      twin_us: of the twin.
      ratio: how many times faster the kernel is.
      decisions_a_second: of the kernel, on one core.
      native_first_s: wall seconds to the first decision.
      twin_first_s: of the twin.
    """

    family: str
    batch: int
    simulations: int
    native_us: float
    twin_us: float
    ratio: float
    decisions_a_second: float
    native_first_s: float
    twin_first_s: float


def _planner(config: BestFirstConfig) -> Any:
    def plan(problems: PlanningProblem) -> Plan:
        return jax.vmap(lambda problem: plan_actions(problem, jax.random.key(0), config))(problems)

    return jax.jit(plan)


def measure(family: str, batch: int, simulations: int, repeats: int) -> Row:
    """Both programs on the same problems.

    Args:
      family: a key of ``bench.problems.FAMILIES``.
      batch: problems at once.
      simulations: most a decision.
      repeats: turns of each; the least counts.

    Returns:
      Their times.
    """
    problems, plan = family_batch(family, SUBGOALS, batch), _planner(BestFirstConfig(simulations=simulations))
    contexts = {"native": contextlib.nullcontext, "twin": twin_only}
    first, least = {}, dict.fromkeys(contexts, float("inf"))
    # One decision takes less than the clock resolves.
    calls = max(1, 64 // batch)
    for name, context in contexts.items():
        with context():
            began = time.perf_counter()
            jax.block_until_ready(plan(problems))
            first[name] = time.perf_counter() - began
    for _ in range(repeats):
        for name, context in contexts.items():
            with context():
                began = time.process_time()
                for _ in range(calls):
                    jax.block_until_ready(plan(problems))
                least[name] = min(least[name], (time.process_time() - began) / calls / batch)
    return Row(
        family=family,
        batch=batch,
        simulations=simulations,
        native_us=1e6 * least["native"],
        twin_us=1e6 * least["twin"],
        ratio=least["twin"] / least["native"],
        decisions_a_second=1 / least["native"],
        native_first_s=first["native"],
        twin_first_s=first["twin"],
    )


def fresh_process_seconds(repeats: int) -> float:
    """Wall seconds from the start of a process to its first decision; the least, after one that fills caches."""
    seconds = []
    for _ in range(1 + repeats):
        began = time.perf_counter()
        subprocess.run([sys.executable, "-c", _FIRST_DECISION], check=True)
        seconds.append(time.perf_counter() - began)
    return min(seconds[1:])


def main() -> None:
    """Measure, print one line a row and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one family and small batches")
    parser.add_argument("--out", type=Path, default=Path("docs/results/planner") / "native.json")
    options = parser.parse_args()
    if not is_usable("search"):
        reason = next(library.reason for library in status() if library.name == "search")
        raise SystemExit(f"the kernel is not used: {reason}")
    families = FAMILIES[:1] if options.quick else FAMILIES
    batches = (1, 16) if options.quick else (1, 16, 64, 256)
    rows = []
    for family in families:
        for simulations in (30,) if options.quick else (30, 300):
            for batch in batches:
                row = measure(family, batch, simulations, repeats=2 if options.quick else 5)
                print(
                    f"{row.family:13} batch {row.batch:3} simulations {row.simulations:3}:"
                    f" native {row.native_us:8.1f} us,"
                    f" twin {row.twin_us:9.1f} us, {row.ratio:5.1f} times"
                )
                rows.append(asdict(row))
    fresh = fresh_process_seconds(repeats=1 if options.quick else 3)
    print(f"first decision of a fresh process: {fresh:.2f} s")
    found = {"provenance": provenance(), "subgoals": SUBGOALS, "fresh_process_s": fresh, "rows": rows}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
