"""``potlp export``: the planner as programs of plain arrays."""

import json as json_format
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from potlp_jax.cli.group import Command, command_app
from potlp_jax.cli.options import Formula, Json, Propositions, Simulations
from potlp_jax.cli.output import FAILED, console, fail, make_folder, print_json, progress_bar

# What `jax.export` lowers for; an unknown name would fail deep within it.
KNOWN_PLATFORMS = ("cpu", "cuda", "rocm", "tpu")

app = command_app()


@app.command(
    "export",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp export "!fire U exit" --out planner[/cyan] - the search, for distances of your own

[cyan]potlp export "F a & F b" --height 64 --width 64 --subgoals 8 --batch any --out planner[/cyan]

[dim]planner/manifest.json names every input and output; docs/planner.md shows how to call the programs.[/dim]
""",
)
def export_task(
    formula: Formula,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the programs and manifest.json.")],
    propositions: Propositions = None,
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
    from potlp_jax.cli.inputs import read_names, setting_changes, trial_config
    from potlp_jax.export import MANIFEST, ExportConfig, export_planner
    from potlp_jax.task.reading import read_task

    # A map has both sides or none: with one the other would have to be guessed.
    if (height is None) != (width is None):
        fail("--height and --width go together: the whole decision needs both, the search alone neither")
    config = ExportConfig(
        grid=None if height is None or width is None else (height, width),
        subgoals=subgoals,
        decision=trial_config(setting_changes(simulations=simulations)).decision,
        batch=_read_batch(batch),
        platforms=_read_platforms(platforms),
    )
    task = read_task(formula, read_names(propositions))
    folder = make_folder(out)
    with progress_bar() as progress:
        progress.add_task("lowering the planner", total=None)
        # Serialising needs flatbuffers, which only the extra brings; the message names it.
        try:
            files = export_planner(task, folder, config)
        except ModuleNotFoundError as error:
            fail(str(error), FAILED)
    # Shown from the file rather than from memory: it is what callers of the programs read.
    manifest = json_format.loads((folder / MANIFEST).read_text("utf-8"))
    if json:
        print_json({"files": [str(file) for file in files], "manifest": manifest})
        return
    _print(files, manifest)


def _read_batch(text: str | None) -> int | str | None:
    from potlp_jax.export import ANY_BATCH

    # None leaves the batch axis away altogether, which is not the same as a batch of one.
    if text is None or text == ANY_BATCH:
        return text
    if not text.isdecimal() or int(text) < 1:
        fail(f"--batch {text!r}: give a number of problems, or {ANY_BATCH}")
    return int(text)


def _read_platforms(text: str) -> tuple[str, ...]:
    platforms = tuple(name.strip() for name in text.split(",") if name.strip())
    # `jax.export` lowers for a platform without having one: a GPU's program can be made on any machine.
    for name in platforms:
        if name not in KNOWN_PLATFORMS:
            fail(f"unknown platform {name!r}; choose from: {', '.join(KNOWN_PLATFORMS)}")
    return platforms or fail(f"--platforms is empty; choose from: {', '.join(KNOWN_PLATFORMS)}")


def _print(files: list[Path], manifest: dict[str, Any]) -> None:
    out = console()
    for name, program in manifest["functions"].items():
        out.print(f"{name}: {program['meaning']}", style="bold")
        table = Table(box=SIMPLE_HEAD)
        for column in ("", "name", "shape", "type"):
            table.add_column(column)
        for direction, values in (("in", program["inputs"]), ("out", program["outputs"])):
            for value in values:
                table.add_row(direction, value["name"], " × ".join(map(str, value["shape"])) or "-", value["dtype"])
        out.print(table)
    for file in files:
        out.print(f"wrote {file}")
