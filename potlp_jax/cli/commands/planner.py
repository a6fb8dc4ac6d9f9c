"""Options and help of the commands about the planner itself: export, bench."""

from pathlib import Path
from typing import Annotated

import typer

from potlp_jax.cli.commands.options import Json, Simulations, TaskName
from potlp_jax.cli.output import clear_errors

app = typer.Typer()


@app.command(
    "export",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp export "!fire U exit" --out planner[/cyan] - the search, for distances of your own

[cyan]potlp export "F a & F b" --height 64 --width 64 --subgoals 8 --batch any --out planner[/cyan]

[dim]planner/manifest.json names every input and output; docs/planner.md shows how to call the programs.[/dim]
""",
)
@clear_errors
def export_command(
    formula: Annotated[
        str,
        typer.Argument(
            metavar="FORMULA", help="A co-safe formula in Spot's syntax, the name of a shipped task, or a .hoa file."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the programs and manifest.json.")],
    propositions: Annotated[
        str | None, typer.Option("--propositions", "-p", help="All propositions, in the order of a letter's bits: a,b.")
    ] = None,
    height: Annotated[int | None, typer.Option(min=1, help="Rows of the map, for the whole decision.")] = None,
    width: Annotated[int | None, typer.Option(min=1, help="Columns of the map, for the whole decision.")] = None,
    subgoals: Annotated[int, typer.Option(min=1, help="Length of the array of subgoals.")] = 12,
    simulations: Simulations = None,
    batch: Annotated[
        str | None, typer.Option(help="Problems per call: a number, or 'any'. Default: one, without a batch axis.")
    ] = None,
    platforms: Annotated[str, typer.Option(help="cpu, cuda, rocm, tpu; joined by commas.")] = "cpu,cuda",
    json: Json = False,
) -> None:
    """Export the planner as programs of plain arrays that run with jax alone."""
    from potlp_jax.cli.export import export_task

    export_task(formula, propositions, height, width, subgoals, simulations, batch, platforms, out, json)


@app.command(
    "bench",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp bench[/cyan] - search, distances and the whole decision

[cyan]potlp bench --parts search --family firefighting --batches 1,64,256 --core 0[/cyan]

[cyan]potlp bench --parts decision --environment firefighting --json[/cyan]

[cyan]potlp bench --parts perception --environment firefighting --world 1[/cyan] - what the camera and the network add

[dim]Compiled anew for every measurement: the cache of compiled programs is left out.[/dim]
""",
)
@clear_errors
def bench_command(
    parts: Annotated[
        str, typer.Option("--parts", help="search, distances, decision, perception; joined by commas.")
    ] = "search,distances,decision",
    family: Annotated[str, typer.Option(help="Family of benchmark problems for the search.")] = "three-single",
    subgoals: Annotated[int, typer.Option(min=1, help="Subgoals of the problems for the search.")] = 8,
    batches: Annotated[str, typer.Option(help="Problems searched at once; joined by commas.")] = "1,16,64",
    simulations: Simulations = None,
    environment: Annotated[
        str, typer.Option("--environment", "-e", help="Where distances and decisions are made.")
    ] = "rooms",
    task: TaskName = "1",
    size: Annotated[int, typer.Option(min=21, help="Cells a side of a floor of rooms.")] = 64,
    world: Annotated[int, typer.Option(min=0, help="Number of the world, of those for validation.")] = 0,
    sources: Annotated[int, typer.Option(min=1, help="Places from which to measure distances.")] = 16,
    repeats: Annotated[int, typer.Option(min=1, help="Timed runs, of which the median is shown.")] = 5,
    core: Annotated[int | None, typer.Option(min=0, help="Stay on this core, with one thread.")] = None,
    json: Json = False,
) -> None:
    """Measure the planner on this machine: times of compiling and running, throughput, memory."""
    from potlp_jax.cli.bench import run_bench

    run_bench(
        parts, family, subgoals, batches, simulations, environment, task, size, world, sources, repeats, core, json
    )
