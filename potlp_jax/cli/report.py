"""``potlp report``: a sweep as one page."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from potlp_jax.cli.output import console, fail, progress_bar
from potlp_jax.cli.sweep import open_store
from potlp_jax.cli.view import panoramas_of
from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.results import Pair, pair_rows
from potlp_jax.sweep.runner import Sweep
from potlp_jax.sweep.specification import specification_from_store
from potlp_jax.sweep.statistics import BASELINE, KNOWN_MAP
from potlp_jax.sweep.store import Row
from potlp_jax.view.replay_page import replay_data
from potlp_jax.view.report_page import Cell, Shown, report_page

PAGE: str = "report.html"


def write_report(folder: Path, out: Path | None, replays: int) -> None:
    """Write the page of a sweep; its worst and best trials are made again for it."""
    store = open_store(folder)
    facts = store.facts()
    store.close()
    page = out or folder / PAGE
    if page.suffix != ".html":
        fail(f"--out {page}: give a name that ends in .html")
    sweep = Sweep(specification_from_store(facts["specification"]), folder)
    policies = [policy.value for policy in sweep.specification.policies]
    cells: list[Cell] = []
    rows: list[Row] = []
    with progress_bar() as progress:
        bar = progress.add_task("running trials again", total=None)
        for cell in sweep.specification.cells:
            found = sweep.store.rows(cell.environment, cell.task)
            rows += found
            pairs = pair_rows(found, policies)
            chosen = _notable(pairs, _subject(policies), replays)
            shown = []
            for reason, row, baseline in chosen:
                progress.update(bar, description=f"running world {row.item.world} again")
                shown.append(_shown(sweep, reason, row, baseline))
            cells.append(Cell(cell.environment, cell.task, pairs, shown))
    page.write_text(report_page(f"Sweep {folder.name}", _facts(facts, rows), policies, cells), "utf-8")
    console().print(f"wrote {page}", markup=False)


def _subject(policies: Sequence[str]) -> str:
    """The policy whose trials are looked at: PO-TLP where it took part, else the last."""
    return Policy.POTLP.value if Policy.POTLP.value in policies else policies[-1]


def _notable(pairs: Sequence[Pair], policy: str, count: int) -> Iterator[tuple[str, Row, Row]]:
    """The worlds that cost the policy most, and saved it most, against the baseline; with the baseline's row."""
    if policy in (BASELINE, KNOWN_MAP):
        return
    ordered = sorted(pairs, key=lambda pair: pair[policy].cost - pair[BASELINE].cost, reverse=True)
    for place, pair in enumerate(ordered[:count]):
        yield f"worst {place + 1}", pair[policy], pair[BASELINE]
    for place, pair in enumerate(reversed(ordered[max(count, len(ordered) - count) :])):
        yield f"best {place + 1}", pair[policy], pair[BASELINE]


def _shown(sweep: Sweep, reason: str, row: Row, baseline: Row) -> Shown:
    trial = sweep.trial(row.item)
    return Shown(
        reason=reason,
        policy=row.item.policy,
        world=row.item.world,
        cost=row.cost,
        baseline=baseline.cost,
        data=replay_data(trial, panoramas_of(trial)),
    )


def _facts(facts: dict[str, Any], rows: Sequence[Row]) -> list[tuple[str, str]]:
    """What was run, and with what; where rows differ, all that there is."""

    def all_of(values: Sequence[str]) -> str:
        return "; ".join(sorted({value for value in values if value})) or "-"

    specification = facts["specification"]
    versions = [", ".join(f"{name} {number}" for name, number in sorted(row.versions.items())) for row in rows]
    return [
        (
            "worlds",
            f"{specification['worlds']} of the {specification['split']} split per task, from number "
            f"{specification['first_world']}",
        ),
        ("policies", ", ".join(specification["policies"])),
        ("trials", f"{len(rows)}, {sum(row.seconds for row in rows) / 3600:.2f} hours of one core"),
        ("estimator", facts["estimator"] or "-"),
        ("settings", all_of([row.configuration for row in rows])),
        ("seed", str(specification["seed"])),
        ("versions", all_of(versions)),
        ("commit", all_of([row.commit for row in rows])),
    ]
