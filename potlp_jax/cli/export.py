"""``potlp export``: the planner as programs of plain arrays."""

import json as json_format
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from potlp_jax.cli.inputs import read_task, trial_config
from potlp_jax.cli.output import FAILED, console, fail, output_folder, print_json, progress_bar
from potlp_jax.export import ANY_BATCH, MANIFEST, ExportConfig, export_planner

KNOWN_PLATFORMS = ("cpu", "cuda", "rocm", "tpu")


def export_task(
    formula: str,
    propositions: str | None,
    height: int | None,
    width: int | None,
    subgoals: int,
    simulations: int | None,
    batch: str | None,
    platforms: str,
    out: Path,
    json: bool,
) -> None:
    """Export the planner for one task and say what was written."""
    names = None if propositions is None else [name.strip() for name in propositions.split(",") if name.strip()]
    if (height is None) != (width is None):
        fail("--height and --width go together: the whole decision needs both, the search alone neither")
    config = ExportConfig(
        grid=None if height is None or width is None else (height, width),
        subgoals=subgoals,
        decision=trial_config(simulations).decision,
        batch=_read_batch(batch),
        platforms=_read_platforms(platforms),
    )
    task = read_task(formula, names)
    folder = output_folder(out)
    assert folder is not None
    with progress_bar() as progress:
        progress.add_task("lowering the planner", total=None)
        try:
            files = export_planner(task, folder, config)
        except ModuleNotFoundError as error:
            fail(str(error), FAILED)
    manifest = json_format.loads((folder / MANIFEST).read_text("utf-8"))
    if json:
        print_json({"files": [str(file) for file in files], "manifest": manifest})
        return
    _print(files, manifest)


def _read_batch(text: str | None) -> int | str | None:
    if text is None or text == ANY_BATCH:
        return text
    if not text.isdigit() or int(text) < 1:
        fail(f"--batch {text!r}: give a number of problems, or {ANY_BATCH}")
    return int(text)


def _read_platforms(text: str) -> tuple[str, ...]:
    platforms = tuple(name.strip() for name in text.split(",") if name.strip())
    for name in platforms:
        if name not in KNOWN_PLATFORMS:
            fail(f"unknown platform {name!r}; choose from: {', '.join(KNOWN_PLATFORMS)}")
    return platforms or fail(f"--platforms is empty; choose from: {', '.join(KNOWN_PLATFORMS)}")


def _print(files: list[Path], manifest: dict[str, Any]) -> None:
    out = console()
    for name, program in manifest["functions"].items():
        out.print(f"{name}: {program['meaning']}", markup=False, style="bold")
        table = Table(box=SIMPLE_HEAD)
        for column in ("", "name", "shape", "type"):
            table.add_column(column)
        for direction, values in (("in", program["inputs"]), ("out", program["outputs"])):
            for value in values:
                table.add_row(direction, value["name"], " × ".join(map(str, value["shape"])) or "-", value["dtype"])
        out.print(table)
    for file in files:
        out.print(f"wrote {file}", markup=False)
