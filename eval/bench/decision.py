"""What a decision costs, phase by phase, for every policy; and what a whole trial costs.

    taskset -c 0 python -m eval.bench.decision --worlds 2 --out decision.json
    POTLP_NATIVE=0 taskset -c 0 python -m eval.bench.decision --worlds 2 --out before.json

Trials of the fire-fighting building (validation worlds, all of its tasks) run decision by decision. Every phase is a
program of its own, which is given what the phases before it made; it runs until it has used ``--seconds`` of processor
time, over the situations of all decisions in turn. Whole trials run in a batch, as a sweep runs them, compiled before:
what they cost beyond the sum of their phases is copying between phases and the host. ``--estimators`` adds whole trials
of PO-TLP that ask other estimators. Operations and bytes are XLA's own count of each program, without what runs in
native kernels; loops are counted as if they ran once.

Times are milliseconds of processor time, so that other work on the machine counts little; pin the process to a core.
"""

import argparse
import dataclasses
import functools
import json
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from eval.bench.trials import ENVIRONMENT, FIRST_WORLD, starts
from potlp_jax.cache import enable_compilation_cache
from potlp_jax.learning.building_estimator import outlook_of_classes
from potlp_jax.learning.domain import Domain
from potlp_jax.learning.estimator import named_estimator
from potlp_jax.learning.imagined_paths import scenery
from potlp_jax.learning.labels import TrueMapEstimator
from potlp_jax.learning.observing import with_memory
from potlp_jax.planning.distances.product import product_distances, product_transitions
from potlp_jax.planning.estimates import ask
from potlp_jax.planning.policies import Policy, direct_move, planned_move
from potlp_jax.planning.search.api import plan_actions
from potlp_jax.planning.situation import assess, planning_problem
from potlp_jax.sweep.rows import provenance
from potlp_jax.trials import rules
from potlp_jax.trials.batch import SLOTS, Start, run_batch
from potlp_jax.trials.config import TrialConfig, config_in
from potlp_jax.trials.robot import photograph
from potlp_jax.trials.slots import Progress, Setup, advance, begin
from potlp_jax.types import NO_STATE
from potlp_jax.world.frontiers import find_subgoals
from potlp_jax.world.sensing import observe

Made = dict[str, Any]
"""What a decision begins with (``scene``, ``progress``, ``asked``), and what each phase made, by its name."""


@dataclasses.dataclass(frozen=True)
class Phase:
    """A part of a decision.

    Attributes:
        name: of the phase.
        run: from what was made before to what the phase makes.
        needs: what of it the phase reads.
        part_of: the phase that does this work too, whose time holds this one's; "" for the phases that make up a
            decision.
    """

    name: str
    run: Callable[[Made], Any]
    needs: tuple[str, ...]
    part_of: str = ""


def phases_of(setup: Setup) -> list[Phase]:
    """The phases of a decision, in order."""
    assessing = _assessing(setup)
    if setup.policy is Policy.POTLP:
        return [*_camera(setup), *assessing, *_network(), *_searching(setup, "answers"), *_going(setup)]
    if setup.policy is Policy.ORACLE:
        labels = Phase("labels", _labels, ("scene", "progress", "assess"))
        return [*assessing, labels, *_searching(setup, "labels"), *_going(setup)]

    def direct(made: Made) -> Any:
        assert isinstance(setup.policy, Policy)
        return direct_move(made["assess"], setup.policy, setup.config.decision)

    return [*assessing, Phase("move", direct, ("assess",)), *_going(setup)]


def _assessing(setup: Setup) -> list[Phase]:
    config = setup.config.decision.frontiers
    begins = ("scene", "progress")

    def assessed(made: Made) -> Any:
        progress = made["progress"]
        return assess(progress.belief, progress.cell, progress.tally.state, made["scene"].task, config)

    def transitions(made: Made) -> Any:
        task, belief = made["scene"].task, made["progress"].belief
        return jnp.where(task.accepting, NO_STATE, product_transitions(task, belief.letters, belief.free))

    def distances(made: Made) -> Any:
        progress = made["progress"]
        source = progress.cell[None], progress.tally.state[None]
        return product_distances(made["transitions"], progress.belief.free, *source, progress.belief.resolution)[0]

    def frontiers(made: Made) -> Any:
        nearest = jnp.min(made["distances"], axis=2)
        return find_subgoals(made["progress"].belief, jnp.isfinite(nearest), nearest, config)

    return [
        Phase("transitions", transitions, begins, "assess"),
        Phase("distances", distances, ("progress", "transitions"), "assess"),
        Phase("frontiers", frontiers, ("progress", "distances"), "assess"),
        Phase("assess", assessed, begins),
    ]


def _camera(setup: Setup) -> list[Phase]:
    config = setup.config

    def camera(made: Made) -> Any:
        scene = made["scene"]
        return photograph(scene.world, made["progress"].cell, scene.sensing, config.camera, config.disturbance)

    def painted(made: Made) -> Any:
        progress = made["progress"]
        before = with_memory(made["asked"], progress.memory)
        return before.remember(made["photograph"], progress.belief, progress.cell).memory

    seen = ("scene", "progress")
    return [Phase("photograph", camera, seen), Phase("paint", painted, ("asked", "progress", "photograph"))]


def _network() -> list[Phase]:
    def imagined(made: Made) -> Any:
        return with_memory(made["asked"], made["paint"]).imagine(made["progress"].belief)

    def paths(made: Made) -> Any:
        task = made["scene"].task
        squares = jax.tree.map(jax.nn.sigmoid, made["first stage"].squares)
        seen = scenery(made["progress"].belief, squares, made["asked"].config.own_within)
        return outlook_of_classes(seen, made["assess"].subgoals, task.class_phi[:, 0], task.class_mask)

    def answers(made: Made) -> Any:
        return _asked(with_memory(made["asked"], made["paint"]), made)

    return [
        Phase("first stage", imagined, ("asked", "progress", "paint"), "answers"),
        Phase("imagined paths", paths, ("scene", "progress", "asked", "first stage", "assess"), "answers"),
        Phase("answers", answers, ("scene", "progress", "asked", "paint", "assess")),
    ]


def _labels(made: Made) -> Any:
    return _asked(TrueMapEstimator(world=made["scene"].world), made)


def _asked(estimator: Any, made: Made) -> Any:
    progress, task = made["progress"], made["scene"].task
    return ask(estimator, progress.belief, made["assess"].subgoals, task, progress.tally.state)


def _searching(setup: Setup, estimates: str) -> list[Phase]:
    config = setup.config.decision

    def planned(made: Made) -> Any:
        intention = made["progress"].tally.intention
        return planned_move(made["assess"], made["problem"], made["search"], intention, config)

    return [
        Phase("problem", lambda made: planning_problem(made["assess"], made[estimates], config), ("assess", estimates)),
        Phase(
            "search",
            lambda made: plan_actions(made["problem"], made["scene"].planning, config.search),
            ("problem", "scene"),
        ),
        Phase("move", planned, ("progress", "assess", "problem", "search")),
    ]


def _going(setup: Setup) -> list[Phase]:
    def sensing(made: Made) -> Any:
        progress = made["progress"]
        return observe(progress.belief, made["scene"].world, progress.cell, setup.config.sensor)

    def advanced(made: Made) -> Progress:
        return advance(setup, dataclasses.replace(made["progress"], memory=None), made["scene"], made["move"])

    begins = ("scene", "progress")
    return [Phase("observe once", sensing, begins, "advance"), Phase("advance", advanced, (*begins, "move"))]


def decisions_of(trial: Start, setup: Setup, asked: Any) -> Iterator[Made]:
    """All that is made in the decisions of a trial, one after the other."""
    programs = _programs(setup)
    memory = None if asked is None else asked.memory
    scene, progress = begin(trial.world, trial.arrays, trial.key, memory, setup=setup)
    while bool(progress.tally.running):
        made: Made = {"scene": scene, "progress": progress, "asked": asked}
        for phase, program in programs:
            made[phase.name] = program({name: made[name] for name in phase.needs})
        yield made
        progress = dataclasses.replace(made["advance"], memory=made.get("paint"))


@functools.cache
def _programs(setup: Setup) -> list[tuple[Phase, Any]]:
    return [(phase, jax.jit(phase.run)) for phase in phases_of(setup)]


def measure(setup: Setup, asked: Any, trials: Sequence[Start], seconds: float) -> list[dict[str, Any]]:
    """Milliseconds a decision, operations and bytes of every phase."""
    decisions = [made for trial in trials for made in decisions_of(trial, setup, asked)]
    rows = []
    for phase, program in _programs(setup):
        inputs = [{name: made[name] for name in phase.needs} for made in decisions]
        counted = _counts(phase, inputs[0])
        rows.append(
            {
                "phase": phase.name,
                "part_of": phase.part_of,
                "decisions": len(inputs),
                "ms": _milliseconds(program, inputs, seconds),
                "operations": counted.get("flops", 0.0),
                "bytes": counted.get("bytes accessed", 0.0),
            }
        )
    return rows


def _counts(phase: Phase, made: Made) -> dict[str, float]:
    """XLA's own count of what a phase does, nothing where a backend has none."""
    leaves, structure = jax.tree.flatten(made)

    # Of plain arrays to plain arrays: jax describes compiled arguments by what classes that check types do not take.
    def flat(*leaves: Any) -> list[Any]:
        return jax.tree.leaves(phase.run(jax.tree.unflatten(structure, leaves)))

    return jax.jit(flat).lower(*leaves).compile().cost_analysis() or {}


def _milliseconds(program: Any, inputs: Sequence[Made], seconds: float) -> float:
    """Processor time of one run; all inputs in turn, until ``seconds`` are used."""
    jax.block_until_ready(program(inputs[0]))
    used, count = 0.0, 0
    while used < seconds:
        began = time.process_time()
        for made in inputs:
            jax.block_until_ready(program(made))
        used += time.process_time() - began
        count += len(inputs)
    return 1e3 * used / count


def whole_trials(trials: Sequence[Start], policy: Policy, slots: int, estimator: str | None = None) -> dict[str, float]:
    """Milliseconds of processor time a trial and a decision, in a batch as in a sweep; compiled before."""
    given = None if estimator is None else named_estimator(estimator)
    list(run_batch(trials[:1], policy, slots=slots, estimator=given))
    began = time.process_time()
    finished = list(run_batch(trials, policy, slots=slots, estimator=given))
    used = 1e3 * (time.process_time() - began)
    decisions = sum(trial.decisions for trial in finished)
    return {"trial_ms": used / len(finished), "decision_ms": used / decisions, "decisions": decisions / len(finished)}


def asked_by(policy: Policy, trial: Start, config: TrialConfig) -> Any:
    """What the policy asks at the beginning of a trial: the shipped estimator, or nothing."""
    if policy is not Policy.POTLP:
        return None
    here = Domain.of_world(trial.world, config.camera)
    shipped = rules.estimator_of(policy, trial.world.propositions, here, None)
    resolution = float(trial.world.resolution)
    return rules.first_estimator(policy, shipped, trial.world.shape, resolution, config.panoramas, None)


def table_of(found: dict[str, Any]) -> str:
    """Markdown: the phases of a policy, and its whole trials."""
    lines = ["| policy | phase | ms a decision | share | Mflop | MB |", "|---|---|---|---|---|---|"]
    for policy, result in found.items():
        whole = sum(row["ms"] for row in result["phases"] if not row["part_of"])
        # Of another estimator whole trials alone were run.
        for row in result["phases"]:
            name = f"{row['phase']} (of {row['part_of']})" if row["part_of"] else row["phase"]
            counts = f"{row['operations'] / 1e6:.2f} | {row['bytes'] / 1e6:.2f}"
            lines.append(f"| {policy} | {name} | {row['ms']:.3f} | {row['ms'] / whole:.0%} | {counts} |")
        if result["phases"]:
            lines.append(f"| {policy} | all phases | {whole:.3f} | | | |")
        trials = result["trials"]
        lines.append(f"| {policy} | in a batch | {trials['decision_ms']:.3f} | | | |")
        lines.append(f"| {policy} | a trial of {trials['decisions']:.1f} decisions | {trials['trial_ms']:.1f} | | | |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=2)
    parser.add_argument("--policies", nargs="+", type=Policy, default=list(Policy))
    parser.add_argument("--estimators", nargs="+", default=[], help="that PO-TLP asks in further trials")
    parser.add_argument("--seconds", type=float, default=2.0, help="processor time for each phase")
    parser.add_argument("--slots", type=int, default=SLOTS)
    parser.add_argument("--out", type=Path, help="JSON file")
    arguments = parser.parse_args()
    enable_compilation_cache()
    trials = starts(arguments.worlds)
    found = {}
    for policy in arguments.policies:
        config = rules.config_of(policy, config_in(trials[0].world, None))
        setup, asked = Setup(policy=policy, config=config), asked_by(policy, trials[0], config)
        phases = measure(setup, asked, trials, arguments.seconds)
        found[policy.value] = {"phases": phases, "trials": whole_trials(trials, policy, arguments.slots)}
        print(table_of({policy.value: found[policy.value]}), flush=True)
    for name in arguments.estimators:
        asking = f"{Policy.POTLP.value}, {name}"
        found[asking] = {"phases": [], "trials": whole_trials(trials, Policy.POTLP, arguments.slots, name)}
        print(table_of({asking: found[asking]}), flush=True)
    if arguments.out is not None:
        made_by = provenance() | {"device": str(jax.devices()[0])}
        result = {"provenance": made_by, "environment": ENVIRONMENT, "first_world": FIRST_WORLD}
        arguments.out.write_text(json.dumps(result | {"policies": found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
