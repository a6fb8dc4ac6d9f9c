"""``potlp report``: a sweep as one page."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from potlp_jax.cli.group import Command, command_app
from potlp_jax.cli.options import SweepFolder
from potlp_jax.cli.output import console, fail, progress_bar

if TYPE_CHECKING:
    from potlp_jax.sweep.results import Pair
    from potlp_jax.sweep.runner import Sweep
    from potlp_jax.sweep.store import Row
    from potlp_jax.view.report_page import Shown

PAGE: str = "report.html"

app = command_app()


@app.command(
    "report",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp report out/validation[/cyan] - writes out/validation/report.html

[cyan]potlp report out/validation --replays 0 --out table.html[/cyan] - tables and plots alone, a small file
""",
)
def write_report(
    folder: SweepFolder,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Page to write; default: report.html in DIR.")] = None,
    replays: Annotated[
        int, typer.Option(min=0, help="Worst and as many best trials of each task to replay; about 1 MB each.")
    ] = 2,
) -> None:
    """Write a sweep as one page: tables, plots, and the worst and best trials as replays."""
    from potlp_jax.cli.inputs import open_store
    from potlp_jax.sweep.results import pair_rows, remarks_on_given_up, subject_of
    from potlp_jax.sweep.runner import Sweep
    from potlp_jax.sweep.specification import specification_from_store
    from potlp_jax.view.report_page import Cell, report_page

    with open_store(folder) as store:
        specification, facts, given_up = store.specification(), store.facts(), remarks_on_given_up(store.broken())
    # A browser goes by the ending of a file's name.
    page = out or folder / PAGE
    if page.suffix != ".html":
        fail(f"--out {page}: give a name that ends in .html")
    # Trials are run again before it is written.
    if not page.parent.is_dir():
        fail(f"--out {page}: there is no folder {page.parent}")
    # The sweep of the store itself, whatever the file that began it says by now.
    sweep = Sweep(specification_from_store(specification), folder, read_only=True)
    policies = list(sweep.specification.policies)
    cells: list[Cell] = []
    rows: list[Row] = []
    with progress_bar() as progress:
        bar = progress.add_task("running trials again", total=None)
        for cell in sweep.specification.cells:
            found = sweep.store.rows(cell.environment, cell.task)
            rows += found
            pairs = pair_rows(found, policies)
            shown = []
            for reason, row, baseline in _notable(pairs, subject_of(policies), replays):
                # A replay needs the beliefs of every step, which rows do not keep.
                progress.update(bar, description=f"running world {row.item.world} again")
                shown.append(_shown(sweep, reason, row, baseline))
            cells.append(Cell(cell.environment, cell.task, pairs, shown))
    page.write_text(report_page(page_title(folder), _facts(facts, rows, given_up), policies, cells), "utf-8")
    console().print(f"wrote {page}")


def page_title(folder: Path) -> str:
    """Named after the folder; one that calls itself a sweep is not called so twice."""
    # Resolved, for "." has no name.
    name = folder.resolve().name
    return name[:1].upper() + name[1:] if "sweep" in name.lower() else f"Sweep {name}"


def _notable(pairs: "Sequence[Pair]", policy: str, count: int) -> "Iterator[tuple[str, Row, Row]]":
    """The worlds that cost the policy most, and saved it most, against the baseline; with the baseline's row.

    As figures do, they leave unreliable trials out, and charge unsatisfied ones their budget.
    """
    from potlp_jax.sweep.results import charged_cost, reliable_pairs
    from potlp_jax.sweep.statistics import BASELINE, KNOWN_MAP

    # The two that savings are measured between have none of their own to be notable for.
    if policy in (BASELINE, KNOWN_MAP):
        return
    ordered = sorted(
        reliable_pairs(pairs),
        key=lambda pair: charged_cost(pair[policy]) - charged_cost(pair[BASELINE]),
        reverse=True,
    )
    for place, pair in enumerate(ordered[:count]):
        yield f"worst {place + 1}", pair[policy], pair[BASELINE]
    # Of few worlds none is shown both as one of the worst and as one of the best.
    for place, pair in enumerate(reversed(ordered[max(count, len(ordered) - count) :])):
        yield f"best {place + 1}", pair[policy], pair[BASELINE]


def _shown(sweep: "Sweep", reason: str, row: "Row", baseline: "Row") -> "Shown":
    from potlp_jax.trials.replay import views_of
    from potlp_jax.view.replay_page import replay_data
    from potlp_jax.view.report_page import Shown

    # Costs beside the replay of another building would be believed.
    sweep.require_same_world(row)
    trial = sweep.trial(row.item)
    return Shown(
        reason=reason,
        policy=row.item.policy,
        world=row.item.world,
        cost=row.cost,
        outcome=row.outcome,
        baseline=baseline.cost,
        data=replay_data(trial, views_of(trial, sweep.work.asked(row.item.environment, row.item.policy))),
    )


def _facts(facts: dict[str, Any], rows: "Sequence[Row]", given_up: Sequence[str]) -> list[tuple[str, str]]:
    """What was run, and with what; where rows differ, all that there is."""

    # A store that several versions have written names them all: figures are then not of one.
    def all_of(values: Sequence[str]) -> str:
        return "; ".join(sorted({value for value in values if value})) or "-"

    from potlp_jax.sweep.specification import own_settings

    specification = facts["specification"]
    versions = [", ".join(f"{name} {number}" for name, number in sorted(row.versions.items())) for row in rows]
    return [
        (
            "worlds",
            f"{specification['worlds']} of the {specification['split']} split per task, from number "
            f"{specification['first_world']}",
        ),
        ("policies", ", ".join(specification["policies"])),
        ("trials", f"{len(rows)}, {sum(row.seconds for row in rows) / 3600:.2f} hours, added up"),
        *(("trial", line) for line in given_up),
        ("estimator", facts["estimator"] or "-"),
        ("settings", all_of([row.configuration for row in rows])),
        *((f"settings of {policy}", told) for policy, told in own_settings(specification).items()),
        ("seed", str(specification["seed"])),
        ("versions", all_of(versions)),
        ("commit", all_of([row.commit for row in rows])),
    ]
