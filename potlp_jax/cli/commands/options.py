"""Options and arguments that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

Json = Annotated[bool, typer.Option("--json", help="Write JSON, and nothing else, to stdout.")]
Environment = Annotated[
    str,
    typer.Argument(
        metavar="ENV",
        help="[cyan]toy[/cyan], [cyan]firefighting[/cyan], [cyan]delivery[/cyan], [cyan]rooms[/cyan], "
        "[cyan]map:FILE.yaml[/cyan] (ROS map) or [cyan]floorplan:FILE.xml[/cyan] (real floor plan, or a folder).",
    ),
]
TaskName = Annotated[
    str, typer.Option("--task", "-t", help="Number of one of the environment's tasks, a formula, or a .hoa file.")
]
SplitName = Annotated[
    str | None,
    typer.Option(
        "--split",
        help="Which worlds to draw from: calibration, training, validation (the default) or test (all that floor plans "
        "are for).",
        show_default=False,
    ),
]
Simulations = Annotated[
    int | None, typer.Option("--simulations", min=1, help="Simulations per decision of policies that search.")
]
EstimatorFile = Annotated[
    Path | None, typer.Option("--estimator", help="Trained estimator for the policy potlp; default: the shipped one.")
]
