"""``potlp audit``: trials judged against worlds that are made anew."""

import itertools
import logging
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from potlp_jax.cli.group import Command, command_app
from potlp_jax.cli.options import Json
from potlp_jax.cli.output import FAILED, console, fail, print_json, progress_bar

if TYPE_CHECKING:
    from potlp_jax.task.task import Task

logger = logging.getLogger(__name__)

# One cause, such as another world, makes the same problem in all trials of a sweep.
_SHOWN = 10

app = command_app()


@app.command(
    "audit",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp audit out/validation[/cyan] - every trial of a sweep

[cyan]potlp audit out/fire[/cyan] - the trial that `potlp run --out out/fire` wrote

[dim]Ends with exit code 1 if anything is wrong.[/dim]
""",
)
def audit(
    path: Annotated[Path, typer.Argument(help="Folder of a sweep or of a trial, or a trial's record.", metavar="PATH")],
    json: Json = False,
) -> None:
    """Check trials against their worlds, made anew: start, moves, cost, outcome, and violations of the task."""
    from potlp_jax.sweep.runner import RESULTS

    count, found = _sweep(path) if (path / RESULTS).is_file() else _trial(path)
    violations = sum(problem.startswith("violates") for _, problem in found)
    if json:
        problems = [{"trial": trial, "problem": problem} for trial, problem in found]
        print_json({"trials": count, "violations": violations, "problems": problems})
    else:
        for line in _lines(found):
            console().print(line, markup=False)
        console().print(f"{count} trials, {len(found)} problems, {violations} violations of the task", markup=False)
    if found:
        raise typer.Exit(FAILED)


def _lines(found: list[tuple[str, str]]) -> Iterator[str]:
    """A line a problem; of those that many trials share a few, and how many more there are."""
    trials = defaultdict(list)
    for trial, problem in found:
        trials[problem].append(trial)
    for problem, of in trials.items():
        yield from (f"{trial}: {problem}" for trial in of[:_SHOWN])
        if len(of) > _SHOWN:
            yield f"{len(of) - _SHOWN} more trials (--json names them): {problem}"


def _sweep(folder: Path) -> tuple[int, list[tuple[str, str]]]:
    """How many trials a sweep has, and what is wrong with which."""
    from potlp_jax.cli.inputs import open_store
    from potlp_jax.sweep.audit import audit_items, audit_rows
    from potlp_jax.sweep.specification import specification_from_store

    with open_store(folder) as store:
        specification, rows = specification_from_store(store.specification()), store.rows()

    def judged() -> Iterator[tuple[str, str]]:
        judgements = audit_rows(rows, specification.split, specification.seed, automata=dict(specification.automata))
        for row, problem in itertools.chain(audit_items(rows, specification), judgements):
            item = row.item
            yield f"{item.environment}, {item.task}, {item.policy}, world {item.world}", problem

    with progress_bar() as progress:
        progress.add_task(f"judging {len(rows)} trials", total=None)
        return len(rows), list(judged())


def _trial(path: Path) -> tuple[int, list[tuple[str, str]]]:
    """One, and what is wrong with it."""
    from potlp_jax.cli.inputs import record_file
    from potlp_jax.environments.registry import make
    from potlp_jax.environments.splits import Split
    from potlp_jax.trials.record import LOG_PREFIX, ROBOT_PREFIX, load_trial
    from potlp_jax.verify.audit import formula_of, problems_of, task_of_record

    file = record_file(path)
    trial = load_trial(file)
    if trial.environment.startswith(LOG_PREFIX):
        fail(f"{file}: the trial is the replay of a robot's log: nobody but the log knows the world")
    if trial.environment.startswith(ROBOT_PREFIX):
        fail(f"{file}: a robot drove the trial: nobody but the robot knows the world")
    # As `potlp run` and `run` write it; the name of an environment may have slashes of its own.
    environment, _, split = trial.environment.rpartition("/")
    if not environment or split not in list(Split) or trial.world_number is None:
        fail(f"{file}: does not say from which environment, split and number its world is: {trial.environment!r}")
    generator = make(environment)
    task = task_of_record(trial, generator.propositions)
    if formula_of(task) is None:
        _tell_of_automaton(str(file), trial.task_text, task)
    problems = problems_of(trial, task, generator.world(trial.world_number, Split(split)))
    return 1, [(str(file), problem) for problem in problems]


def _tell_of_automaton(file: str, text: str, task: "Task") -> None:
    """Warn where the automaton of a record decides although its name looks like, or is, a formula."""
    from potlp_jax.errors import SpotMissingError, TaskError
    from potlp_jax.task.task import Task
    from potlp_jax.verify.audit import NOT_READ, has_table_of
    from potlp_jax.verify.semantics import can_be_judged

    its_own = True
    if not can_be_judged(text, task.propositions):
        try:
            its_own = not has_table_of(Task.from_formula(text, task.propositions), task)
        except SpotMissingError:
            logger.warning(
                f"{file}: the task is called {text!r}, which cannot be read here without Spot: the trial is judged by "
                "the automaton of its record"
            )
            return
        except TaskError:
            # A mere name of an automaton is no formula to Spot, either.
            return
    if its_own:
        logger.warning(
            f"{file}: the task is called {text!r}, and its automaton is not that of this formula: the trial is "
            "judged by the automaton"
        )
    else:
        logger.warning(f"{file}: task {text!r}: {NOT_READ}")
