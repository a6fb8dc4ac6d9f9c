"""How many simulations a second: our search, as a kernel and under vmap, and others on the same problem.

    python -m eval.bench.throughput
    python -m eval.bench.throughput --scaling
    python -m eval.bench.throughput --quick

The problem has S = 8 subgoals, an automaton of Z = 8 states and 97 actions: three things to be found, one at a time,
on a random map, none of them in known space. A simulation runs to acceptance, a dead end or a new leaf; the mean number
of actions on that way stands beside the rate, because a deeper simulation is more work. mctx counts otherwise: it adds
a chance node and a decision node where a simulation of ours adds one outcome, so its rate is halved.

Seconds are CPU seconds of the whole process (pin it to a core: ``taskset -c 0``), medians of repeats; compilation and
the preparation on the host are apart. ``--scaling`` measures how the cost of a simulation of one search grows with S, Z
and the batch, with the exponents of a fit in double-logarithmic scale. Writes JSON, a Markdown table, and a plot.
"""

import argparse
import functools
import json
import platform
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np

from eval.bench.opponents import installed
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.api import plan_actions, search
from potlp_jax.planning.search.config import BestFirstConfig, UctConfig
from potlp_jax.sweep.rows import provenance
from potlp_jax.task.task import Task

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.ticker import LogLocator, ScalarFormatter

SUBGOALS, GOALS = 8, 3
DEAD_END_COST = 500.0


@dataclass(frozen=True)
class Rate:
    """One measurement.

    Attributes:
      program: who searched.
      subgoals: S.
      states: Z, the accepting state included.
      actions: A.
      batch: searches at once.
      simulations: simulations per search that were run, in our unit.
      rate: simulations per CPU second, all searches together.
      search_ms: CPU milliseconds per search.
      depth: actions per simulation; for mctx the mean depth of a new node.
      compile_s: seconds of compilation; 0 where there is none or it was done before.
      repeats_s: CPU seconds of each repeat.
    """

    program: str
    subgoals: int
    states: int
    actions: int
    batch: int
    simulations: float
    rate: float
    search_ms: float
    depth: float
    compile_s: float
    repeats_s: list[float]


@dataclass(frozen=True)
class Prepared:
    """A program, ready to be timed.

    Attributes:
      start: makes a fresh search, outside the timed part; calling that runs it and returns the mean depth and the mean
        number of simulations that it took: ours ends early where nothing is left to find out.
      compile_s: CPU seconds of compilation.
    """

    start: Callable[[], Callable[[], tuple[float, float]]]
    compile_s: float


@functools.cache
def goals_task(goals: int) -> Task:
    """Find that many things, one at a cell: 2^goals states, goals·2^(goals-1) edges."""
    names = [chr(ord("a") + goal) for goal in range(goals)]
    return Task.from_formula(" & ".join(f"F {name}" for name in names), max_positive_literals=1)


def goals_problem(goals: int, subgoals: int, seed: int) -> PlanningProblem:
    """A random map on which nothing is in known space: straight paths between subgoals, every one reachable."""
    task, rng = goals_task(goals), np.random.default_rng((goals, subgoals, seed))
    states, classes = task.sizes.states, task.sizes.classes
    places = rng.uniform(0.0, 100.0, (subgoals + 1, 2))
    path_costs = 1.0 + np.linalg.norm(places[:, None] - places[None, :-1], axis=-1)
    stays = np.eye(states, dtype=bool)[None, :, None, :]
    return PlanningProblem.from_arrays(
        task.arrays,
        travel=np.where(stays, path_costs[:, None, :, None], np.inf),
        finish=np.full((subgoals + 1, states), np.inf),
        success_probability=rng.uniform(0.05, 0.6, (subgoals, classes)),
        success_cost=rng.uniform(5.0, 60.0, (subgoals, classes)),
        failure_cost=rng.uniform(5.0, 60.0, (subgoals, classes)),
        dfa_state=task.dfa.initial,
        subgoal_mask=np.ones(subgoals, bool),
        dead_end_cost=DEAD_END_COST,
    )


def problem_batch(goals: int, subgoals: int, batch: int) -> PlanningProblem:
    """Different problems of one shape, stacked."""
    problems = [goals_problem(goals, subgoals, seed) for seed in range(min(batch, 64))]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *problems)
    return jax.tree.map(
        lambda leaf: jnp.tile(leaf, (-(-batch // len(problems)),) + (1,) * (leaf.ndim - 1))[:batch], stacked
    )


def kernel(
    problems: PlanningProblem, simulations: int, kind: type[BestFirstConfig | UctConfig] = BestFirstConfig
) -> Prepared:
    """The batched search of one kind, with its other settings by default."""
    config = kind(simulations=simulations)

    def run(problems, keys):
        plan, tree = search(problems, keys, config)
        return plan.action, tree.steps / tree.simulations, tree.simulations

    return _compiled(run, problems)


def under_vmap(problems: PlanningProblem, simulations: int) -> Prepared:
    """``jax.vmap(plan_actions)``."""
    config = BestFirstConfig(simulations=simulations)

    def run(problems, keys):
        plan = jax.vmap(lambda problem, key: plan_actions(problem, key, config))(problems, keys)
        return plan.action, jnp.full(plan.action.shape, jnp.nan), jnp.sum(plan.visits, axis=1)

    return _compiled(run, problems)


def mctx(problems: PlanningProblem, simulations: int) -> Prepared:
    """mctx with two of its simulations for one of ours."""
    from eval.bench.opponents.mctx_search import mctx_plan

    def run(problems, keys):
        plan = mctx_plan(problems, keys[0], simulations=2 * simulations)
        return plan.action, plan.depth, jnp.full(plan.action.shape, simulations)

    return _compiled(run, problems)


def one_by_one(search_class: Any, problems: PlanningProblem, simulations: int) -> Prepared:
    """A search of the first problem."""
    problem = jax.tree.map(lambda leaf: leaf[0], problems)
    start = time.process_time()
    search_class(problem).run(10)
    prepared = time.process_time() - start

    def fresh() -> Callable[[], tuple[float, float]]:
        one = search_class(problem)

        def call() -> tuple[float, float]:
            one.run(simulations)
            return one.statistics().mean_depth, float(simulations)

        return call

    return Prepared(fresh, prepared)


def _compiled(run: Callable[..., Any], problems: PlanningProblem) -> Prepared:
    keys = jax.random.split(jax.random.key(0), problems.dfa_state.shape[0])
    start = time.process_time()
    compiled = jax.jit(run).lower(problems, keys).compile()
    prepared = time.process_time() - start

    def call() -> tuple[float, float]:
        _, depth, run = jax.block_until_ready(compiled(problems, keys))
        return float(np.mean(depth)), float(np.mean(run))

    return Prepared(lambda: call, prepared)


def measure(program: str, goals: int, subgoals: int, batch: int, simulations: int, repeats: int) -> Rate:
    """Median CPU time of repeats, after one call to warm up."""
    problems = problem_batch(goals, subgoals, batch)
    prepared = PROGRAMS[program](problems, simulations)
    (depth, ran), times = prepared.start()(), []
    for _ in range(repeats):
        call = prepared.start()
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    seconds = statistics.median(times)
    return Rate(
        program=program,
        subgoals=subgoals,
        states=2**goals,
        actions=problems.action_count,
        batch=batch,
        simulations=ran,
        rate=batch * ran / seconds,
        search_ms=1e3 * seconds / batch,
        depth=depth,
        compile_s=prepared.compile_s,
        repeats_s=times,
    )


def _numba(problems: PlanningProblem, simulations: int) -> Prepared:
    from eval.bench.opponents.pouct_numba import NumbaSearch

    return one_by_one(NumbaSearch, problems, simulations)


def _pomdp_py(problems: PlanningProblem, simulations: int) -> Prepared:
    from eval.bench.opponents.pomdp_py_search import PomdpPySearch

    return one_by_one(PomdpPySearch, problems, simulations)


PROGRAMS: dict[str, Callable[[PlanningProblem, int], Prepared]] = {
    "best-first": kernel,
    "vmap(plan_actions)": under_vmap,
    "po-uct": functools.partial(kernel, kind=UctConfig),
    "mctx": mctx,
    "po-uct-pomdp-py": _pomdp_py,
    "po-uct-numba": _numba,
}
MOST_ROWS = {"mctx": 64, "po-uct-pomdp-py": 1, "po-uct-numba": 1}
"""Batches beyond which a program is not asked: one tree at a time, or more than its rate is worth waiting for."""


def rates(arguments: argparse.Namespace) -> Iterator[Rate]:
    """Every program and batch on the 97 actions."""
    for program in arguments.programs:
        for batch in arguments.batches:
            if batch <= MOST_ROWS.get(program, batch):
                yield measure(program, GOALS, SUBGOALS, batch, arguments.simulations, arguments.repeats)


def scaling(arguments: argparse.Namespace) -> dict[str, list[Rate]]:
    """Our search, one parameter at a time."""
    quick, simulations = arguments.quick, arguments.simulations
    run = functools.partial(measure, "best-first", simulations=simulations, repeats=arguments.repeats)
    return {
        "S": [run(GOALS, s, 16) for s in ((2, 4) if quick else (2, 3, 4, 6, 8, 10, 12))],
        "Z": [run(goals, SUBGOALS, 16) for goals in ((1, 2) if quick else (1, 2, 3, 4))],
        "batch": [run(GOALS, SUBGOALS, 4**power) for power in range(2 if quick else 6)],
    }


def abscissa(name: str, rate: Rate) -> int:
    """The parameter that was varied."""
    return {"S": rate.subgoals, "Z": rate.states, "batch": rate.batch}[name]


def exponent(name: str, found: Sequence[Rate]) -> float:
    """Slope of the CPU time of one simulation of all rows over the parameter, both as logarithms: 1 is proportional."""
    size = np.log([abscissa(name, rate) for rate in found])
    return float(np.polyfit(size, np.log([rate.batch / rate.rate for rate in found]), 1)[0])


def rate_table(found: Sequence[Rate]) -> str:
    """Markdown."""
    lines = [
        "| program | batch | simulations | thousand a CPU second | mean depth | ms a search | compile s |",
        "|---" * 7 + "|",
    ]
    for rate in found:
        depth = "" if np.isnan(rate.depth) else f"{rate.depth:.2f}"
        lines.append(
            f"| {rate.program} | {rate.batch} | {rate.simulations:.0f} | {rate.rate / 1e3:.3g} | {depth} | "
            f"{rate.search_ms:.3g} | {rate.compile_s:.2g} |"
        )
    return "\n".join(lines) + "\n"


def scaling_table(found: dict[str, list[Rate]]) -> str:
    """Markdown, with the exponents."""
    lines = ["| varied | value | actions | µs a simulation of one search | mean depth |", "|---" * 5 + "|"]
    for name, group in found.items():
        for rate in group:
            cost = 1e6 / rate.rate
            lines.append(f"| {name} | {abscissa(name, rate)} | {rate.actions} | {cost:.3g} | {rate.depth:.2f} |")
    lines += ["", "CPU time of one simulation of all rows grows with the power: "]
    lines += [", ".join(f"{name} {exponent(name, group):.2f}" for name, group in found.items()) + "."]
    return "\n".join(lines) + "\n"


def plot(found: dict[str, list[Rate]], path: Path) -> None:
    """CPU time of a simulation over each parameter."""
    figure, axes = plt.subplots(1, len(found), figsize=(4.0 * len(found), 3.4), sharey=True)
    for axis, (name, group) in zip(axes, found.items(), strict=True):
        axis.plot([abscissa(name, rate) for rate in group], [1e6 / rate.rate for rate in group], "o-")
        axis.set(
            xscale="log", yscale="log", xlabel=name, title=f"time of all rows ~ {name}^{exponent(name, group):.2f}"
        )
        ticks = [abscissa(name, rate) for rate in group]
        axis.set_xticks(ticks, [str(tick) for tick in ticks], minor=False)
        axis.minorticks_off()
        # One decade or less: its powers of ten alone would leave the axis without numbers.
        axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.yaxis.set_major_formatter(ScalarFormatter())
        axis.grid(alpha=0.25, which="both")
    axes[0].set_ylabel("CPU µs a simulation of one search")
    figure.tight_layout()
    figure.savefig(path, dpi=130)
    plt.close(figure)


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--programs", nargs="+", choices=list(PROGRAMS), default=list(PROGRAMS), metavar="NAME")
    parser.add_argument("--batches", nargs="+", type=int, default=[1, 16, 64, 256])
    parser.add_argument("--simulations", type=int, default=1000, help="per search")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--scaling", action="store_true", help="S 2 to 12, Z 2 to 16, batch 1 to 1024 instead")
    parser.add_argument("--quick", action="store_true", help="small batches, 100 simulations, one repeat")
    parser.add_argument("--out", default="out/bench/throughput")
    parsed = parser.parse_args(arguments)
    if parsed.quick:
        parsed.batches, parsed.simulations, parsed.repeats = [1, 16], 100, 1
    parsed.programs = installed(parsed.programs)
    return parsed


def main(arguments: Sequence[str] | None = None) -> None:
    """Run and write."""
    parsed = parse(arguments)
    out = Path(parsed.out)
    out.mkdir(parents=True, exist_ok=True)
    machine = {"provenance": provenance(), "machine": platform.processor() or platform.machine()}
    if parsed.scaling:
        groups = scaling(parsed)
        text, name = scaling_table(groups), "scaling"
        content: Any = {key: [asdict(rate) for rate in group] for key, group in groups.items()}
        content = {"exponents": {key: exponent(key, group) for key, group in groups.items()}, **content}
        plot(groups, out / "scaling.png")
    else:
        found = []
        for rate in rates(parsed):
            found.append(rate)
            print(f"{rate.program}, batch {rate.batch}: {rate.rate / 1e3:.3g} thousand a CPU second", flush=True)
        text, name, content = rate_table(found), "throughput", [asdict(rate) for rate in found]
    (out / f"{name}.json").write_text(json.dumps({**machine, "results": content}, indent=1))
    (out / f"{name}.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
