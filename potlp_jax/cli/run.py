"""``potlp run``: one trial, its record, picture and animation."""

from pathlib import Path

import typer

from potlp_jax.cli.inputs import (
    default_policy,
    make_world,
    read_environment_task,
    read_policy,
    read_split,
    read_trained_estimator,
    trial_config,
)
from potlp_jax.cli.output import FAILED, console, output_folder, print_json, progress_bar
from potlp_jax.environments.registry import make
from potlp_jax.trials.loop import run_trial, trial_key
from potlp_jax.trials.record import Outcome, Trial
from potlp_jax.types import Status
from potlp_jax.view.animation import save_animation
from potlp_jax.view.maps import draw_trial
from potlp_jax.view.style import save_figure

RECORD = "trial.json"


def run_one(
    environment: str,
    task_name: str,
    policy_name: str | None,
    seed: int,
    split_name: str | None,
    out: Path | None,
    animation: bool,
    simulations: int | None,
    estimator: Path | None,
    json: bool,
) -> None:
    """Run a trial and leave with exit code 1 if it did not end satisfied."""
    generator = make(environment)
    split = read_split(split_name, generator)
    policy = default_policy(generator) if policy_name is None else read_policy(policy_name)
    trained = read_trained_estimator(estimator)
    task = read_environment_task(generator, task_name)
    world = make_world(generator, split, seed)
    folder = output_folder(out)
    with progress_bar() as progress:
        progress.add_task("running the trial (the first decision compiles the planner)", total=None)
        trial = run_trial(
            world,
            task,
            policy,
            trial_key(seed),
            trial_config(simulations, generator),
            environment=f"{environment}/{split}",
            seed=seed,
            estimator=trained,
        )
    files = [] if folder is None else _write(trial, folder, animation)
    if json:
        print_json({**trial.summary(), "files": [str(file) for file in files]})
    else:
        _print(trial, files)
    if trial.outcome is not Outcome.SATISFIED:
        raise typer.Exit(FAILED)


def _write(trial: Trial, folder: Path, animation: bool) -> list[Path]:
    files = [folder / RECORD, folder / "trial.png"]
    trial.save(files[0])
    save_figure(draw_trial(trial), files[1])
    if animation:
        files.append(folder / "trial.gif")
        with progress_bar() as progress:
            bar = progress.add_task("drawing the animation")
            save_animation(
                trial, files[2], progress=lambda done, total: progress.update(bar, completed=done, total=total)
            )
    return files


def _print(trial: Trial, files: list[Path]) -> None:
    out = console()
    colour = "green" if trial.outcome is Outcome.SATISFIED else "red"
    out.print(f"[bold {colour}]{trial.outcome.value}[/]  cost {trial.cost:.2f}")
    summary = trial.summary()
    for name in ("task", "environment", "seed", "policy", "steps", "decisions", "fallbacks"):
        out.print(f"{name:12} {summary[name]}", markup=False)
    if trial.status:
        flags = [str(flag.name).lower().replace("_", " ") for flag in Status(trial.status)]
        out.print(f"{'status':12} {', '.join(flags)}", markup=False)
    for file in files:
        out.print(f"wrote {file}", markup=False)
    if files:
        out.print(f"next: potlp explain {files[0].parent}:0", markup=False, style="dim")
    else:
        out.print("add --out FOLDER for the record, a picture and an animation", markup=False, style="dim")
