"""``potlp run``: one trial, its record, picture and animation."""

import contextlib
import logging
from typing import TYPE_CHECKING

import typer

from potlp_jax.cli.group import Command, command_app
from potlp_jax.cli.options import (
    Animation,
    CameraName,
    Environment,
    EstimatorName,
    Json,
    PolicyName,
    SearchName,
    Simulations,
    SplitName,
    TaskName,
    TrialFolder,
    WorldNumber,
)
from potlp_jax.cli.output import FAILED, make_folder, print_json, progress_bar

if TYPE_CHECKING:
    from potlp_jax.environments.base import Generator
    from potlp_jax.environments.splits import Split
    from potlp_jax.task.task import Task
    from potlp_jax.trials.config import TrialConfig

logger = logging.getLogger(__name__)

WORLDS_TRIED: int = 20
"""Worlds in which to look for one where the task is possible, after one where it is not."""

app = command_app()


@app.command(
    "run",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp run toy --task 1[/cyan]

[cyan]potlp run firefighting --task 3 --world 7 --out out/fire[/cyan]

[cyan]potlp run firefighting --task "!fire U exit" --policy baseline --json[/cyan]

[dim]Ends with exit code 1 if the task was not satisfied.[/dim]
""",
)
def run_one(
    environment: Environment,
    task: TaskName = "1",
    policy: PolicyName = None,
    world: WorldNumber = 0,
    split: SplitName = None,
    out: TrialFolder = None,
    animation: Animation = True,
    simulations: Simulations = None,
    search: SearchName = None,
    estimator: EstimatorName = None,
    camera: CameraName = None,
    json: Json = False,
) -> None:
    """Run one trial: one world, one task, one policy."""
    from potlp_jax.cli.doubts import of_worlds, warn_of_doubts
    from potlp_jax.cli.inputs import (
        default_policy_with_note,
        make_world,
        read_estimator,
        read_split,
        setting_changes,
        trial_config,
    )
    from potlp_jax.cli.trial_files import print_trial, require_folder, write_trial
    from potlp_jax.environments.registry import make
    from potlp_jax.planning.policies import named_policy
    from potlp_jax.trials.loop import run_trial
    from potlp_jax.trials.record import Outcome
    from potlp_jax.trials.rules import trial_key

    require_folder(out, animation)
    generator = make(environment)
    chosen_split = read_split(split, generator)
    named = None if policy is None else named_policy(policy)
    trained = read_estimator(estimator)
    asked = generator.task(task)
    made = make_world(generator, chosen_split, world)
    warn_of_doubts(asked, of_worlds(f"world {world} of {generator.name}/{chosen_split}", [made]))
    config = trial_config(setting_changes(simulations=simulations, search=search, camera=camera), generator)
    chosen_policy = default_policy_with_note(made, config, trained) if named is None else named
    folder = None if out is None else make_folder(out)
    with progress_bar() as progress:
        # How many decisions a trial takes is not known before it ends.
        progress.add_task("running the trial (the first decision compiles the planner)", total=None)
        trial = run_trial(
            made,
            asked,
            chosen_policy,
            trial_key(world),
            config,
            environment=f"{environment}/{chosen_split}",
            world_number=world,
            estimator=trained,
        )
    files = [] if folder is None else write_trial(trial, folder, animation)
    if json:
        print_json({**trial.summary(), "files": [str(file) for file in files]})
    else:
        print_trial(trial, files)
    # After the result, because finding out may take a while: each world that is tried is made first.
    if trial.outcome is Outcome.INFEASIBLE:
        logger.warning(_why_infeasible(generator, chosen_split, asked, config, world=world))
    if trial.outcome is not Outcome.SATISFIED:
        raise typer.Exit(FAILED)


def _why_infeasible(generator: "Generator", split: "Split", task: "Task", config: "TrialConfig", *, world: int) -> str:
    """Whether the world or the policy is at fault, and another world to try."""
    from potlp_jax.cli.inputs import make_world
    from potlp_jax.environments.splits import MAX_INDEX
    from potlp_jax.errors import WorldError
    from potlp_jax.planning.policies import Policy
    from potlp_jax.sweep.work import was_possible
    from potlp_jax.trials.loop import run_trial
    from potlp_jax.trials.rules import trial_key

    def is_possible(number: int) -> bool:
        # The planner that knows the map from the start finds every path there is.
        made = make_world(generator, split, number)
        return was_possible(run_trial(made, task, Policy.KNOWN_MAP, trial_key(number), config))

    # A task without a way back, such as one that forbids what was entered, can be lost by a decision.
    if is_possible(world):
        return (
            "with the whole map the task is possible in this world: the policy knew no move, or went where the task "
            "cannot be satisfied"
        )
    # As many as tell a task that is impossible everywhere from a few unlucky worlds.
    tried = 0
    for number in range(world + 1, min(world + WORLDS_TRIED, MAX_INDEX) + 1):
        # A family of one's own may have no such world; the trial that was asked for has its result.
        with contextlib.suppress(WorldError):
            if is_possible(number):
                return f"with the whole map it is impossible too: try --world {number}"
            tried += 1
    also = f", as in the {tried} worlds that follow" if tried else ""
    return f"with the whole map it is impossible too{also}: check the task"
