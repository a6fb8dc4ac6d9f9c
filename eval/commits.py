"""Do policies keep a task possible? Random formulas with irrevocable moves, each in a small random world of its own.

Every pair of formula and world can be satisfied on the known map; a search in plain Python says so. Policies run with
``irrevocable_last`` on and off (docs/model.md section 7, "Irrevocable moves"). A trial that did not end satisfied is
run again alone, and its irrevocable moves are judged in plain Python: *forced* where no frontier could be reached
without one and acceptance was not within reach in known space, otherwise *free*. With ``irrevocable_last`` no move may
be free, and a trial without a forced move must end satisfied: both are counted as ``broken``.

    python -m eval.commits --pairs 10000 --out out/commits.jsonl
    python -m eval.commits --out out/commits.jsonl --report docs/results/commits.json

Results are appended by chunks of pairs; the same command again continues where it stopped.
"""

import argparse
import dataclasses
import json
import warnings
from collections import Counter, deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from eval.limit.rows import append_row, read_rows
from potlp_jax.cache import enable_compilation_cache
from potlp_jax.errors import SpotMissingError, TaskError, TaskWarning
from potlp_jax.planning.estimates import Estimates
from potlp_jax.planning.policies import Policy
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.planning.situation import DecisionConfig
from potlp_jax.sweep.rows import provenance, source_commit
from potlp_jax.task.task import Task, TaskArrays, TaskSizes
from potlp_jax.trials.batch import Finished, Start, run_batch
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.record import Decision, Outcome, Trial
from potlp_jax.world.frontiers import FrontierConfig, Subgoals
from potlp_jax.world.grid import BeliefMap, World, make_world
from potlp_jax.world.moves import Cell, legal_moves
from potlp_jax.world.sensing import SensorConfig

NAMES = ("a", "b", "c", "d")
SIZES = TaskSizes(states=8, propositions=4, edges=20, classes=24, compound=8, cubes=4)
SHAPE = (16, 24)
POLICIES = (Policy.BASELINE, Policy.OPTIMISTIC, Policy.ORACLE, Policy.POTLP)
CONFIG = TrialConfig(
    sensor=SensorConfig(range_cells=4.0),
    decision=DecisionConfig(frontiers=FrontierConfig(max_subgoals=6), search=BestFirstConfig(simulations=40)),
)
CHUNK = 250
"""Pairs between two writes."""
_WORLDS_TRIED = 20

Node = tuple[Cell, int]
"""A cell and a state of the automaton."""


def prior(belief: BeliefMap, subgoals: Subgoals, task: TaskArrays) -> Estimates:
    """An estimator that knows nothing: everything lies behind every frontier with an even chance, ten cells away."""
    shape = (subgoals.mask.shape[0], task.class_mask.shape[0])
    return Estimates(
        success_probability=jnp.full(shape, 0.5, jnp.float32),
        success_cost=jnp.full(shape, 10.0, jnp.float32) * belief.resolution,
        failure_cost=jnp.full(shape, 10.0, jnp.float32) * belief.resolution,
    )


def random_task(rng: np.random.Generator) -> Task:
    """A formula of two or three branches, within ``SIZES``, whose first letter can be an irrevocable one."""
    while True:
        if rng.random() < 0.5:
            text = _excluding(rng)
        else:
            text = " | ".join(_branch(rng, int(rng.integers(1, 3))) for _ in range(int(rng.integers(2, 4))))
        if rng.random() < 0.2:
            text = f"({text}) & F {rng.choice(NAMES)}"
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", TaskWarning)
                task = Task.from_formula(text, propositions=NAMES)
        except SpotMissingError:
            raise
        except TaskError:
            continue
        # A proposition on its own: cells with two are too few to be met by chance.
        first = int(task.dfa.transitions[task.dfa.initial, 0])
        if SIZES.covers(task.sizes) and task.irrevocable[first, [1, 2, 4, 8]].any():
            return task


def _excluding(rng: np.random.Generator) -> str:
    """Two branches that begin with different propositions, each of which the other branch avoids."""
    one, other = (str(name) for name in rng.choice(NAMES, 2, replace=False))
    ends = [str(name) for name in rng.choice([name for name in NAMES if name not in (one, other)], 2)]
    return f"(!{other} U ({one} & (!{other} U {ends[0]}))) | (!{one} U ({other} & (!{one} U {ends[1]})))"


def _branch(rng: np.random.Generator, depth: int) -> str:
    """Avoid something until something else, and then go on."""
    avoid, goal = (str(name) for name in rng.choice(NAMES, 2, replace=False))
    until = goal if depth == 0 else f"({goal} & {_branch(rng, depth - 1)})"
    return f"(!{avoid} U {until})" if rng.random() < 0.8 else f"F {until}"


def random_world(rng: np.random.Generator) -> World:
    """Rooms between walls with doors, some obstacles, and letters on few cells and on some of the doors."""
    height, width = SHAPE
    occupied = np.ones(SHAPE, bool)
    occupied[1:-1, 1:-1] = rng.random((height - 2, width - 2)) < 0.08
    letters = np.zeros(SHAPE, np.int32)
    doors = list(_walls(rng, occupied))
    free = np.argwhere(~occupied)
    for bit in range(len(NAMES)):
        # Often nowhere, so that a branch may have no end; often in doors, where there is no way round.
        for _ in range(int(rng.integers(0, 5))):
            cell = doors[rng.integers(len(doors))] if rng.random() < 0.5 else tuple(free[rng.integers(len(free))])
            # In a room a patch, which the nearest way may well lead over.
            size = 1 if cell in doors else int(rng.integers(1, 5))
            letters[cell[0] : cell[0] + size, cell[1] : cell[1] + size] |= 1 << bit
    plain = np.argwhere(~occupied & (letters == 0))
    row, column = plain[rng.integers(len(plain))].tolist()
    return make_world(occupied, letters, (row, column), propositions=NAMES)


def _walls(rng: np.random.Generator, occupied: np.ndarray) -> Iterator[Cell]:
    """Draw two or three walls across the map, each with one or two doors; the doors."""
    height, width = occupied.shape
    for column in rng.choice(np.arange(4, width - 4), int(rng.integers(1, 3)), replace=False).tolist():
        occupied[1:-1, column] = True
        yield from _doors(rng, occupied, [(row, column) for row in range(1, height - 1)])
    row = int(rng.integers(4, height - 4))
    occupied[row, 1:-1] = True
    yield from _doors(rng, occupied, [(row, column) for column in range(1, width - 1)])


def _doors(rng: np.random.Generator, occupied: np.ndarray, wall: list[Cell]) -> Iterator[Cell]:
    for index in rng.choice(len(wall), int(rng.integers(1, 4)), replace=False).tolist():
        occupied[wall[index]] = False
        yield wall[index]


def pair(number: int) -> tuple[Task, World]:
    """The formula and the world of a number: the known map satisfies the task, and not with the first letter."""
    rng = np.random.default_rng([23, number])
    while True:
        task = random_task(rng)
        for _ in range(_WORLDS_TRIED):
            world = random_world(rng)
            if _is_possible(task, world):
                return task, world


def _is_possible(task: Task, world: World) -> bool:
    start = (int(world.start[0]), int(world.start[1]))
    letters = np.asarray(world.letters)
    state = int(task.dfa.transitions[task.dfa.initial, letters[start]])
    if task.dfa.accepting[state] or task.dfa.trap[state]:
        return False
    reached = _reachable(task, ~np.asarray(world.occupied), letters, (start, state), irrevocable=True)
    return any(task.dfa.accepting[state] for _, state in reached)


def _reachable(task: Task, free: np.ndarray, letters: np.ndarray, start: Node, irrevocable: bool) -> set[Node]:
    """Product states that moves over free cells lead to; ``irrevocable``: such moves are made, too."""
    reached, queue = {start}, deque([start])
    while queue:
        cell, state = queue.popleft()
        # After acceptance there is nothing left to do.
        if task.dfa.accepting[state]:
            continue
        for there, _ in legal_moves(free, cell):
            following = (there, int(task.dfa.transitions[state, letters[there]]))
            withheld = task.dfa.trap[following[1]] or (task.irrevocable[state, letters[there]] and not irrevocable)
            if not withheld and following not in reached:
                reached.add(following)
                queue.append(following)
    return reached


def irrevocable_steps(trial: Trial, task: Task) -> Counter:
    """Irrevocable moves of a trial: ``certain`` (on a known path to acceptance), ``forced`` or ``free``."""
    found = Counter()
    for step in range(len(trial.path) - 1):
        if task.irrevocable[trial.states[step], trial.word[step + 1]]:
            decision = max((d for d in trial.decisions if d.step <= step), key=lambda d: d.index)
            found[_reason(trial, task, decision)] += 1
    return found


def _reason(trial: Trial, task: Task, decision: Decision) -> str:
    belief = trial.belief_of(decision)
    free, letters, unknown = (np.asarray(layer) for layer in (belief.free, belief.letters, belief.unknown))
    start = (decision.cell, decision.state)
    everywhere = _reachable(task, free, letters, start, irrevocable=True)
    is_certain = any(task.dfa.accepting[state] for _, state in everywhere)
    if is_certain:
        return "certain" if decision.kind == "finish" else "free"
    beside = np.pad(unknown, 1, constant_values=True)
    frontier = free & (beside[:-2, 1:-1] | beside[2:, 1:-1] | beside[1:-1, :-2] | beside[1:-1, 2:])
    revocable = _reachable(task, free, letters, start, irrevocable=False)
    return "free" if any(frontier[cell] for cell, _ in revocable) else "forced"


def run_chunk(first: int, count: int) -> Iterator[dict[str, Any]]:
    """The rows of some pairs: every policy, with and without ``irrevocable_last``."""
    pairs = {number: pair(number) for number in range(first, first + count)}
    for last in (True, False):
        config = dataclasses.replace(CONFIG, decision=dataclasses.replace(CONFIG.decision, irrevocable_last=last))
        for policy in POLICIES:
            starts = (
                Start(world, task.padded(SIZES), jax.random.key(number), name=number)
                for number, (task, world) in pairs.items()
            )
            estimator = prior if policy is Policy.POTLP else None
            for finished in run_batch(starts, policy, config, estimator=estimator):
                task, world = pairs[int(str(finished.name))]
                yield _row(finished, task, world, policy, config)


def _row(finished: Finished, task: Task, world: World, policy: Policy, config: TrialConfig) -> dict[str, Any]:
    number = int(str(finished.name))
    row = {
        "pair": number,
        "formula": task.text,
        "policy": policy.value,
        "irrevocable_last": config.decision.irrevocable_last,
        "outcome": str(finished.outcome),
        "cost": finished.cost,
        "status": finished.status,
        "commit": source_commit(),
    }
    if finished.outcome is not Outcome.SATISFIED:
        # A batch keeps no decisions; the trial is the same alone.
        estimator = prior if policy is Policy.POTLP else None
        key = jax.random.key(number)
        trial = run_trial(world, task, policy, key, config, arrays=task.padded(SIZES), estimator=estimator)
        row["moves"] = dict(irrevocable_steps(trial, task))
    return row


def report(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts and costs by policy and rule, with the commits that the trials were run at."""
    table = []
    costs = {(row["policy"], row["irrevocable_last"], row["pair"]): row for row in rows}
    for policy in POLICIES:
        for last in (True, False):
            own = [row for row in rows if row["policy"] == policy.value and row["irrevocable_last"] is last]
            failed = [row for row in own if row["outcome"] != Outcome.SATISFIED]
            forced = [row for row in failed if row["moves"].get("forced") and not row["moves"].get("free")]
            both = [
                (row["cost"], other["cost"])
                for row in own
                if (other := costs.get((policy.value, not last, row["pair"])))
                and row["outcome"] == other["outcome"] == Outcome.SATISFIED
            ]
            table.append(
                {
                    "policy": policy.value,
                    "irrevocable_last": last,
                    "trials": len(own),
                    "outcomes": dict(Counter(row["outcome"] for row in own)),
                    "not satisfied after a forced move": len(forced),
                    # Without the rule nothing is promised.
                    "broken": len(failed) - len(forced) if last else None,
                    "mean cost where both rules satisfy": float(np.mean([mine for mine, _ in both])) if both else None,
                    "pairs where both rules satisfy": len(both),
                }
            )
    return {
        "provenance": provenance(),
        # Chunks may have been run at other commits than the one that reports them.
        "commits": sorted({row["commit"] for row in rows}),
        "pairs": len({row["pair"] for row in rows}),
        "policies": table,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=0, help="pairs to run, those of the file included")
    parser.add_argument("--out", type=Path, required=True, help="file of rows, JSON lines")
    parser.add_argument("--report", type=Path, help="file of the summary, JSON")
    arguments = parser.parse_args()
    enable_compilation_cache()
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    done = 1 + max((row["pair"] for row in read_rows(arguments.out)), default=-1)
    for first in range(done, arguments.pairs, CHUNK):
        count = min(CHUNK, arguments.pairs - first)
        # A chunk is one line, so that what a kill has cut off is run again as a whole.
        append_row(arguments.out, list(run_chunk(first, count)))
        print(f"{first + count} pairs", flush=True)
    summary = report(read_rows(arguments.out))
    for entry in summary["policies"]:
        print(entry)
    if arguments.report:
        arguments.report.write_text(json.dumps(summary, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    main()
