"""Runs a sweep: this process plans units and writes results, an engine does the units (``potlp_jax.engine``).

Nobody else writes to the store. A unit that was begun and not finished, because a worker, a scheduler or this process
has ended, is begun again: units are pure, and give the same rows wherever they run.
"""

import dataclasses
import itertools
import logging
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from potlp_jax import plugins
from potlp_jax.engine.engine import Broken, Engine
from potlp_jax.engine.opening import open_engine
from potlp_jax.engine.writer import only_writer
from potlp_jax.environments.splits import MAX_INDEX
from potlp_jax.errors import StoreError, SweepError, WorldError
from potlp_jax.learning.estimator import identity_of, named_estimator
from potlp_jax.planning.policies import named_policy
from potlp_jax.sweep.ending import KEPT, ending_when_asked
from potlp_jax.sweep.specification import Cell, Specification
from potlp_jax.sweep.store import POSSIBLE, Item, Row, Store, has_tables
from potlp_jax.sweep.work import Examined, Unit, Work, do
from potlp_jax.trials.record import Trial
from potlp_jax.world.renderer import renderer_of

logger = logging.getLogger(__name__)

RESULTS: str = "results.sqlite"
"""Name of the store in a sweep's folder."""

IMPOSSIBLE_IN_A_ROW: int = 100
"""Worlds after which a task is taken to be impossible in all of them."""

BLOCK: int = 8
"""Worlds of a unit, at most: as many as a batch has slots."""

# With fewer the last units would keep some workers busy while the others have nothing left.
_UNITS_A_WORKER = 4


@dataclasses.dataclass(frozen=True)
class Progress:
    """Where a sweep stands: trials done, of all; how many work on it."""

    done: int
    total: int
    workers: int = 1


class Sweep:
    """A specification with its store: what is to be done, and what is there."""

    def __init__(self, specification: Specification, folder: Path, read_only: bool = False) -> None:
        self.specification = specification
        self.work = Work(specification)
        self._done = 0
        # Before the store: of a specification that cannot be run none is begun.
        facts = {"specification": specification.to_dict(), "estimator": self._estimator_identity()}
        if sources := self._sources():
            facts["source"] = sources
        self.store = Store(folder / RESULTS, read_only)
        (self.store.compare if read_only else self.store.agree)(facts)

    @property
    def total(self) -> int:
        """Trials in all."""
        return len(self.specification.cells) * len(self.specification.policies) * self.specification.worlds

    def finished(self) -> bool:
        """Whether as many trials as the specification asks for have rows, or were given up."""
        # There are more once another command has made the sweep longer.
        return self.store.count() + len(self.store.broken()) >= self.total

    def trial(self, item: Item) -> Trial:
        """The whole record of a trial, made again."""
        return self.work.trial(item)

    def run(self, engine: Engine, report: Callable[[Progress], None]) -> None:
        """Do what is missing.

        Raises:
            WorldError: a task is impossible in too many worlds in a row.
            StoreError: worlds are not those of the rows that are there.
        """
        self._require_same_worlds()
        self._done = self.store.count()
        report(self._progress(engine))
        while units := self._worlds_to_examine():
            self._do(engine, units, report)
        self._do(engine, self._missing_trials(engine.workers), report)

    def require_same_world(self, row: Row) -> None:
        """Raises StoreError where a row's world is made otherwise today: a file or a generator has changed."""
        if not self.work.is_of(row):
            raise StoreError(
                f"{self.store.file}: {row.item.environment}: world {row.item.world} is not that of the rows that are "
                "there: its file, or what makes it, has changed; begin in another folder"
            )

    def _require_same_worlds(self) -> None:
        # The first and the last stand for all: to make every world again would take too long.
        for environment in dict.fromkeys(cell.environment for cell in self.specification.cells):
            for row in self.store.outer_rows(environment):
                self.require_same_world(row)

    def _progress(self, engine: Engine) -> Progress:
        # Not counted anew: a large store would be read for every row.
        return Progress(self._done, self.total, engine.workers)

    def _do(self, engine: Engine, units: Iterable[Unit], report: Callable[[Progress], None]) -> None:
        """Do units and write their results. One that is given up is done again item by item, to find out which."""
        given_up: list[Unit] = []
        for unit, found in engine.run(do, self.work, units):
            if isinstance(found, Broken):
                self._give_up(unit, found, given_up)
            else:
                self._write(found)
            report(self._progress(engine))
        if given_up:
            self._do(engine, [piece for unit in given_up for piece in unit.pieces()], report)

    def _give_up(self, unit: Unit, found: Broken, given_up: list[Unit]) -> None:
        item = unit.items[0]
        if len(unit.items) > 1:
            given_up.append(unit)
        elif item.policy == POSSIBLE:
            # Without it nobody knows which worlds the sweep has.
            raise SweepError(f"{item.environment}, world {item.world}: cannot be examined: {found.error}; {KEPT}")
        else:
            logger.warning(f"{item.environment}, {item.policy} in world {item.world}: given up: {found.error}")
            self.store.set_broken(item, found.error)

    def _write(self, found: Iterable[Row | Examined]) -> None:
        rows = [result for result in found if isinstance(result, Row)]
        self.store.finish(rows)
        self._done += len(rows)
        for row in rows:
            logger.debug("world %d, %s: %s at cost %.1f", row.item.world, row.item.policy, row.outcome, row.cost)
        for result in found:
            if isinstance(result, Examined):
                item = result.item
                self.store.set_possible(item.environment, item.task, {item.world: result.possible})

    def _worlds_to_examine(self) -> list[Unit]:
        """The next worlds of each cell of which it is not known whether the task is possible; none: all is known."""
        units = []
        for cell in self.specification.cells:
            known = self.store.possible(cell.environment, cell.task)
            found = len(self._worlds(known))
            if found < self.specification.worlds:
                unknown = self._unknown_worlds(cell, known, found)
                units += [Unit(tuple(block)) for block in _blocks(unknown, BLOCK)]
        return units

    def _unknown_worlds(self, cell: Cell, known: dict[int, bool], found: int) -> list[Item]:
        """The next worlds to examine: as many as are missing."""
        missing = self.specification.worlds - found
        last = max(known, default=self.specification.first_world - 1)
        tail = [known.get(world, True) for world in range(last - IMPOSSIBLE_IN_A_ROW + 1, last + 1)]
        if not any(tail):
            raise WorldError(
                f"{cell.environment}: the task {cell.task!r} is impossible in {IMPOSSIBLE_IN_A_ROW} worlds in a row, "
                f"up to number {last}; check it"
            )
        if last == MAX_INDEX:
            raise WorldError(
                f"{cell.environment}: the task {cell.task!r} is possible in {found} worlds from number "
                f"{self.specification.first_world} on, and world {last} is the last: begin earlier, or ask for fewer"
            )
        # No more at once than would show that the task is impossible everywhere.
        end = min(last + missing, last + IMPOSSIBLE_IN_A_ROW, MAX_INDEX)
        after = range(self.specification.first_world, end + 1)
        return [Item(cell.environment, cell.task, POSSIBLE, world) for world in after if world not in known]

    def _worlds(self, known: dict[int, bool]) -> list[int]:
        """The first worlds in which the task is possible, as far as that is known without a gap."""
        found: list[int] = []
        # At the first gap the list ends: a world in it, once known, would come before those that follow.
        for world in range(self.specification.first_world, MAX_INDEX + 1):
            if world not in known or len(found) == self.specification.worlds:
                break
            if known[world]:
                found.append(world)
        return found

    def _missing_trials(self, workers: int) -> Iterator[Unit]:
        """All policies in the first worlds, then in the next ones: the pairs of the first worlds are complete early."""
        done = self.store.items() | self.store.broken().keys()
        worlds = {
            cell: self._worlds(self.store.possible(cell.environment, cell.task)) for cell in self.specification.cells
        }
        environments = dict.fromkeys(cell.environment for cell in self.specification.cells)
        size = self._worlds_a_unit(len(environments), workers)
        for first in range(0, self.specification.worlds, size):
            for environment, policy in itertools.product(environments, self.specification.policies):
                items = [
                    Item(environment, cell.task, policy, world)
                    for cell in self.specification.cells
                    if cell.environment == environment
                    for world in worlds[cell][first : first + size]
                ]
                if missing := tuple(item for item in items if item not in done):
                    yield Unit(missing)

    def _worlds_a_unit(self, environments: int, workers: int) -> int:
        specification = self.specification
        units = environments * len(specification.policies) * specification.worlds
        return max(1, min(BLOCK, units // (_UNITS_A_WORKER * max(workers, 1))))

    def _sources(self) -> dict[str, str]:
        """Digests of the files of what others wrote, by name: trials before and after a change are not of one sweep."""
        specification = self.specification
        names = dict.fromkeys(cell.environment for cell in specification.cells)
        found: dict[str, Any] = {name: self.work.generator(name) for name in names}
        found |= {name: named_policy(name) for name in specification.policies}
        if specification.estimator is not None and plugins.is_known(specification.estimator, plugins.ESTIMATORS):
            found[specification.estimator] = named_estimator(specification.estimator)
        found[specification.config.camera.renderer] = renderer_of(specification.config.camera)
        own = {name: thing for name, thing in found.items() if not plugins.is_ours(thing)}
        digests = {name: plugins.source_digest(thing) for name, thing in own.items()}
        return {name: digest for name, digest in digests.items() if digest is not None}

    def _estimator_identity(self) -> str | None:
        """Of all that policies ask, so that a store never mixes two. Raises EstimatorError where there is none."""
        environments = sorted({cell.environment for cell in self.specification.cells})
        asked = [self.work.asked(*pair) for pair in itertools.product(environments, self.specification.policies)]
        return ", ".join(dict.fromkeys(identity_of(estimator) for estimator in asked if estimator is not None)) or None


def _blocks(items: list[Item], size: int) -> Iterator[list[Item]]:
    for first in range(0, len(items), size):
        yield items[first : first + size]


def run_sweep(
    specification: Specification,
    folder: Path,
    processes: int | None = 1,
    report: Callable[[Progress], None] = lambda progress: None,
    cluster: str | None = None,
    begun: Callable[[Engine], None] = lambda engine: None,
    retry_broken: bool = False,
    kept: bool = True,
) -> None:
    """Run what is missing of a sweep; returns when every trial has a row, or was given up.

    Args:
        specification: what to run.
        folder: of the store; the same folder again continues.
        processes, cluster: where the work is done (``engine.opening.open_engine``).
        report: is called now and then with the progress.
        begun: is called once with the engine, if there is anything to do.
        retry_broken: begin again the trials that were given up.
        kept: whether the folder stays where the process is asked to end; the message tells then that the sweep can go
            on.

    Raises:
        StoreError: the folder holds another sweep, cannot be written, or another command works on it; of a sweep that
            is finished nothing is written.
        EngineError, SweepError: nobody is left who could do the work; what is finished is kept.
        SystemExit: the process was asked to end (SIGTERM). Its workers do within two seconds, and so does the process
            where the caller lets ``sweep.ending.end_process_soon`` see to it, as ``potlp`` does; otherwise Dask may
            hold the end of the interpreter up.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if _is_finished(specification, folder, retry_broken):
        return
    with ending_when_asked(kept), only_writer(folder, StoreError):
        sweep = Sweep(specification, folder)
        try:
            with open_engine(processes, cluster) as engine:
                # Not before somebody is there to try them.
                if retry_broken:
                    sweep.store.forget_broken()
                begun(engine)
                sweep.run(engine, report)
        finally:
            sweep.store.close()


def _is_finished(specification: Specification, folder: Path, retry_broken: bool) -> bool:
    """Whether nothing is left to do: asked without writing, for the folder may be on a full or locked disk."""
    if not has_tables(folder / RESULTS):
        return False
    sweep = Sweep(specification, folder, read_only=True)
    try:
        return sweep.finished() and not (retry_broken and sweep.store.broken())
    finally:
        sweep.store.close()
