"""Runs a sweep: workers, one pinned to each core, take trials from the store until none remains.

Each worker reads the store, claims a few trials at a time and runs them as one batch (``trials.batch``), in which a
trial that has ended makes room for the next. A row is written as soon as its trial has ended. A worker needs nothing
but the store, so workers may be killed, started again, or belong to several commands on one store.
"""

import contextlib
import dataclasses
import itertools
import logging
import multiprocessing
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import NoReturn

import jax

from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import MAX_INDEX, world_key
from potlp_jax.errors import PotlpError, SweepError, WorldError
from potlp_jax.files import one_line
from potlp_jax.learning.domain import Domain
from potlp_jax.learning.estimator import TrainedEstimator, identity_of, named_estimator
from potlp_jax.planning.estimates import Estimator
from potlp_jax.planning.policies import Policy, named_policy
from potlp_jax.sweep.rows import trial_row
from potlp_jax.sweep.specification import Cell, Specification
from potlp_jax.sweep.store import POSSIBLE, Item, Row, Store
from potlp_jax.task.task import Task, TaskArrays, TaskSizes
from potlp_jax.trials.batch import Finished, Start, run_batch
from potlp_jax.trials.loop import run_trial, versions
from potlp_jax.trials.record import Outcome, Trial
from potlp_jax.trials.rules import estimator_of, trial_key
from potlp_jax.world.grid import World

logger = logging.getLogger(__name__)

RESULTS: str = "results.sqlite"
"""Name of the store in a sweep's folder."""

IMPOSSIBLE_IN_A_ROW: int = 100
"""Worlds after which a task is taken to be impossible in all of them."""

# A worker that holds more would starve the others at the end of a portion; fewer would leave slots of its batch empty.
BLOCK: int = 8
"""Trials, or worlds to examine, that a worker claims at once."""

# Compiled programs differ by policy: a small portion would switch between them often, a large one would let the pairs
# of the first worlds wait.
PORTION: int = 32
"""Worlds of each task that all policies visit before the next ones."""

MOST_DEATHS: int = 5
"""Workers that are killed in a row, without a trial finished between, after which the sweep ends."""

KEPT: str = "what is finished is kept: the same command goes on"
"""What messages say about rows."""

# With the reading of the store and the end of the process that is less than two seconds.
_GRACE: float = 1.0
"""Seconds between asking a process to end and ending it."""

# Short beside a trial, long beside a reading.
WAIT: float = 0.3
"""Seconds between readings of the store while there is nothing to claim."""


@dataclasses.dataclass(frozen=True)
class Progress:
    """Where a sweep stands: trials done, of all."""

    done: int
    total: int


class Sweep:
    """A specification with its store: what is to be done, and how one piece of it is."""

    def __init__(self, specification: Specification, folder: Path, read_only: bool = False) -> None:
        self.specification = specification
        self.store = Store(folder / RESULTS, read_only)
        # Every policy visits the worlds of a block, and making one may take a second. The caches are the sweep's own: a
        # family that is defined anew under the same name, as in a notebook, is not mistaken for the old one.
        self._generator = lru_cache(maxsize=None)(make)
        self._world = lru_cache(maxsize=4 * BLOCK)(self._make_world)
        facts = {"specification": specification.to_dict(), "estimator": self._estimator_identity()}
        (self.store.compare if read_only else self.store.agree)(facts)

    @property
    def total(self) -> int:
        """Trials in all."""
        return len(self.specification.cells) * len(self.specification.policies) * self.specification.worlds

    def finished(self) -> bool:
        """Whether as many trials have rows as the specification asks for."""
        # There are more once another process has made the sweep longer.
        return self.store.count() >= self.total

    def step(self) -> bool:
        """Do work of one kind as long as there is some; returns whether there was any that no other process works on.

        Raises:
            WorldError: a task is impossible in too many worlds in a row.
        """
        # Worlds first: which trials there are depends on them.
        return self._examine_worlds() or self._run_trials()

    def _examine_worlds(self) -> bool:
        """Find out in which of the next worlds a task is possible."""
        for cell in self.specification.cells:
            known = self.store.possible(cell.environment, cell.task)
            found = len(self._worlds(known))
            if found < self.specification.worlds:
                claimed = self.store.claim(self._unknown_worlds(cell, known, found), BLOCK)
                if claimed:
                    possible = self.possible(claimed)
                    self.store.set_possible(cell.environment, cell.task, possible)
                    logger.debug("%s, %s: possible in worlds %s", cell.environment, cell.task, _true_of(possible))
                    return True
        return False

    def _run_trials(self) -> bool:
        """Run the missing trials of one policy in a portion of the worlds; each is written as soon as it has ended.

        All policies visit a portion before the next one: the pairs of the first worlds are complete early, and the
        rate so far tells the time remaining.
        """
        environments = dict.fromkeys(cell.environment for cell in self.specification.cells)
        for first in range(0, self.specification.worlds, PORTION):
            for environment, policy in itertools.product(environments, self.specification.policies):
                any_ran = False
                # The claims are an iterator, so that a batch claims more only when it has room.
                for row in self.rows(self._claimed(environment, policy, first), environment, policy):
                    self.store.finish([row])
                    logger.debug("world %d, %s: %s at cost %.1f", row.item.world, policy, row.outcome, row.cost)
                    any_ran = True
                if any_ran:
                    return True
        return False

    def _claimed(self, environment: str, policy: str, first: int) -> Iterator[Item]:
        """Trials that are missing in the portion from the ``first`` world on, claimed a few at a time."""
        for cell in self.specification.cells:
            if cell.environment != environment:
                continue
            worlds = self._worlds(self.store.possible(environment, cell.task))[first : first + PORTION]
            missing = [Item(environment, cell.task, policy, world) for world in worlds]
            while missing and (block := self.store.claim(missing, BLOCK)):
                yield from block
                # What stands before the block is finished, or others work on it: not asked about again.
                missing = missing[missing.index(block[-1]) + 1 :]

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

    def _unknown_worlds(self, cell: Cell, known: dict[int, bool], found: int) -> list[Item]:
        """The next worlds to examine: as many as are missing."""
        missing = self.specification.worlds - found
        last = max(known, default=self.specification.first_world - 1)
        # Unknown worlds count as possible: what another worker still examines is no reason to give up.
        tail = [known.get(world, True) for world in range(last - IMPOSSIBLE_IN_A_ROW + 1, last + 1)]
        if not any(tail):
            raise WorldError(
                f"{cell.environment}: the task {cell.task!r} is impossible in {IMPOSSIBLE_IN_A_ROW} worlds in a row, "
                f"up to number {last}; check it"
            )
        after = range(self.specification.first_world, min(last + missing, MAX_INDEX) + 1)
        return [Item(cell.environment, cell.task, POSSIBLE, world) for world in after if world not in known]

    def possible(self, items: Sequence[Item]) -> dict[int, bool]:
        """In which worlds, by number, the planner that knows the map succeeds; the items are of one task."""
        trials = self._trials(items, items[0].environment, Policy.KNOWN_MAP)
        return {item.world: trial.outcome is Outcome.SATISFIED for item, trial in trials}

    def rows(self, items: Iterable[Item], environment: str, policy: str) -> Iterator[Row]:
        """The rows of trials of one environment and policy, as they end."""
        config = self.specification.config_of(policy)
        asked = self.asked(environment, policy)
        for item, trial in self._trials(items, environment, policy):
            world = self._world(environment, item.world)
            # Made again, or from the cache: a batch returns arrays of its own and not the world.
            yield trial_row(item, trial, world, self._key(item.world), config, versions(asked))

    def _trials(self, items: Iterable[Item], environment: str, policy: str) -> Iterator[tuple[Item, Finished]]:
        def start(item: Item) -> Start:
            world = self._world(environment, item.world)
            return Start(world, self._tasks[environment, item.task][1], self._key(item.world), name=item)

        asked = self.asked(environment, policy)
        for trial in run_batch(map(start, items), policy, self.specification.config_of(policy), estimator=asked):
            # A batch hands back the name that `start` gave, whatever it is.
            assert isinstance(trial.name, Item)
            yield trial.name, trial

    def trial(self, item: Item) -> Trial:
        """The whole record of a trial, run or made again."""
        task, arrays = self._tasks[item.environment, item.task]
        return run_trial(
            self._world(item.environment, item.world),
            task,
            item.policy,
            self._key(item.world),
            self.specification.config_of(item.policy),
            environment=f"{item.environment}/{self.specification.split.value}",
            world_number=item.world,
            arrays=arrays,
            estimator=self.asked(item.environment, item.policy),
        )

    def _make_world(self, environment: str, number: int) -> World:
        generator = self._generator(environment)
        return generator.generate(world_key(self.specification.split, number, generator.name))

    def _key(self, world: int) -> jax.Array:
        """Of all trials in a world: it makes no world, and folded by name it serves planning and sensing."""
        return trial_key(world, self.specification.seed)

    @cached_property
    def _tasks(self) -> dict[tuple[str, str], tuple[Task, TaskArrays]]:
        """Tasks by environment and formula, padded per environment to one size: one compilation serves all."""
        tasks = {
            (cell.environment, cell.task): self._generator(cell.environment).task(cell.task)
            for cell in self.specification.cells
        }
        # Sizes differ by environment at most: maps have other shapes there, so that programs differ anyway.
        sizes: dict[str, TaskSizes] = {}
        for (environment, _), task in tasks.items():
            sizes[environment] = sizes.get(environment, task.sizes).union(task.sizes)
        return {key: (task, task.padded(sizes[key[0]])) for key, task in tasks.items()}

    @cached_property
    def _estimator(self) -> TrainedEstimator | Estimator | None:
        name = self.specification.estimator
        return None if name is None else named_estimator(name)

    def asked(self, environment: str, policy: str) -> TrainedEstimator | Estimator | None:
        """What a policy asks in the worlds of an environment; None where it asks nothing."""
        # Worlds of a family are alike in what decides whether an estimator serves them: the first stands for all.
        world = self._world(environment, self.specification.first_world)
        here = Domain.of_world(world, self.specification.config.camera)
        return estimator_of(named_policy(policy), world.propositions, here, self._estimator)

    def _estimator_identity(self) -> str | None:
        """Of all that policies ask, so that a store never mixes two. Raises EstimatorError where there is none."""
        environments = sorted({cell.environment for cell in self.specification.cells})
        asked = [self.asked(*pair) for pair in itertools.product(environments, self.specification.policies)]
        return ", ".join(dict.fromkeys(identity_of(estimator) for estimator in asked if estimator is not None)) or None


def _true_of(possible: Mapping[int, bool]) -> list[int]:
    return [world for world, is_possible in possible.items() if is_possible]


def run_sweep(
    specification: Specification,
    folder: Path,
    processes: int,
    report: Callable[[Progress], None] = lambda progress: None,
) -> None:
    """Run what is missing of a sweep; returns when every trial has a row.

    Args:
        specification: what to run.
        folder: of the store; the same folder again continues.
        processes: workers, each pinned to a core; 1 works in this process, on all of its cores.
        report: is called now and then with the progress.

    Raises:
        StoreError: the folder holds another sweep, or cannot be written; of a sweep that is finished nothing is.
        SweepError: workers could not be started, or ended with an error; what is finished is kept.
        SystemExit: the process was asked to end (SIGTERM); it and its workers do within two seconds.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if _is_finished(specification, folder):
        return
    with ending_when_asked():
        sweep = Sweep(specification, folder)
        try:
            if processes == 1:
                _work_here(sweep, report)
            else:
                _Workers(sweep, folder, processes).run(report)
        finally:
            sweep.store.close()


def _is_finished(specification: Specification, folder: Path) -> bool:
    """Whether every trial has a row already: asked without writing, for the folder may be on a full or locked disk."""
    if not (folder / RESULTS).is_file():
        return False
    sweep = Sweep(specification, folder, read_only=True)
    try:
        return sweep.finished()
    finally:
        sweep.store.close()


@contextlib.contextmanager
def ending_when_asked() -> Iterator[None]:
    """End the block by SIGTERM as by an error, so that it can tidy up, and the process soon, whatever it does.

    Python runs a handler between its own steps alone, and compiling a program may be one step of a minute. So a thread
    ends the process if the handler has not done so in time: nothing is lost, as rows are written as they end.
    """
    # Elsewhere than in the main thread no handler can be set, and whoever runs it has an own way to end it.
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    ended = threading.Event()
    thread = threading.Thread(target=_end_late, args=(reader, ended), daemon=True)
    before_fd, before = signal.set_wakeup_fd(writer.fileno()), signal.signal(signal.SIGTERM, _end)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        signal.set_wakeup_fd(before_fd)
        signal.signal(signal.SIGTERM, before)
        writer.close()
        thread.join()
        reader.close()


def _end(number: int, frame: object) -> NoReturn:
    logger.warning(f"ended by {signal.Signals(number).name}; {KEPT}")
    # What a shell reports of a process that a signal has ended.
    raise SystemExit(128 + number)


def _end_late(reader: socket.socket, ended: threading.Event) -> None:
    """Wait for SIGTERM, and end the process if nothing else has a while after it. Ends when the other side closes."""
    while signals := reader.recv(1):
        if signals[0] == signal.SIGTERM and not ended.wait(_GRACE):
            os._exit(128 + signal.SIGTERM)


def _work_here(sweep: Sweep, report: Callable[[Progress], None]) -> None:
    while not sweep.finished():
        if not sweep.step():
            time.sleep(WAIT)
        report(Progress(sweep.store.count(), sweep.total))


class _Workers:
    """Processes that work on one sweep. Another takes the place of one that dies."""

    def __init__(self, sweep: Sweep, folder: Path, processes: int) -> None:
        self._sweep, self._folder = sweep, folder
        # Spawned, not forked: a fork of a process in which jax has started its threads may hang.
        self._context = multiprocessing.get_context("spawn")
        cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [None]
        self._cores = [cores[number % len(cores)] for number in range(processes)]
        self._running: dict[int, tuple[BaseProcess, Connection]] = {}
        # Deaths since the last row that was written, and how many rows there were.
        self._deaths, self._rows = 0, sweep.store.count()

    def run(self, report: Callable[[Progress], None]) -> None:
        """Work until nothing remains, and end all processes, however this one comes to its end."""
        try:
            for place in range(len(self._cores)):
                self._start(place)
            while self._running:
                done = self._sweep.store.count()
                report(Progress(done, self._sweep.total))
                if done > self._rows:
                    self._deaths, self._rows = 0, done
                for place in [place for place, (process, _) in self._running.items() if not process.is_alive()]:
                    self._look_after(place)
                time.sleep(WAIT)
        finally:
            self._end_all()
        report(Progress(self._sweep.total, self._sweep.total))

    def _start(self, place: int) -> None:
        """Begin the worker of a place. Raises SweepError where none can be begun."""
        ours, theirs = self._context.Pipe(duplex=False)
        arguments = (self._sweep.specification, self._folder, self._cores[place], theirs)
        process = self._context.Process(target=_work, args=arguments, daemon=True)
        try:
            process.start()
        # Too many processes, or too little memory. The others do the work.
        except OSError as error:
            if not self._running:
                raise SweepError(f"no worker could be started ({error}): give fewer --processes; {KEPT}") from error
            logger.warning(
                f"a worker could not be started ({error}); the sweep goes on with the other {len(self._running)}"
            )
        else:
            self._running[place] = process, ours
        finally:
            theirs.close()

    def _look_after(self, place: int) -> None:
        """Replace a worker that was killed; raise what one has reported. One that has found nothing to do is done."""
        process, connection = self._running.pop(place)
        code, told = process.exitcode, _last_word(connection)
        if code == 0:
            return
        # One worker's error is the others' error soon: their trials are of the same sweep.
        if told is not None:
            raise SweepError(f"a worker of the sweep ended with an error: {told}; {KEPT}")
        self._deaths += 1
        how = f"was killed by {_signal_name(-code)}" if code is not None and code < 0 else f"ended with code {code}"
        if self._deaths >= MOST_DEATHS:
            raise SweepError(
                f"a worker of the sweep {how}, and so did {MOST_DEATHS - 1} before it with no trial finished; if "
                f"there is too little memory, give fewer --processes; {KEPT}"
            )
        logger.warning(f"a worker of the sweep {how}; another takes its place, and its trials begin again")
        self._start(place)

    def _end_all(self) -> None:
        # Also after an interrupt: claims of a process that is gone are void, so that nothing has to be given back.
        for process, _ in self._running.values():
            process.terminate()
        until = time.monotonic() + _GRACE
        for process, connection in self._running.values():
            process.join(max(0.0, until - time.monotonic()))
            process.kill()
            process.join()
            connection.close()


def _last_word(connection: Connection) -> str | None:
    """The error that a worker has reported; None where it could not."""
    try:
        with connection:
            return connection.recv() if connection.poll() else None
    except (EOFError, OSError):
        return None


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _work(specification: Specification, folder: Path, core: int | None, errors: Connection) -> None:
    """A worker: works until nothing remains, or the process that started it is gone."""
    # An interrupt from the terminal reaches all processes; the one that started this one ends it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if core is not None:
        # Before XLA starts, which then uses one thread.
        os.sched_setaffinity(0, {core})
    from potlp_jax.cache import enable_compilation_cache

    enable_compilation_cache()
    try:
        sweep = Sweep(specification, folder)
        while not sweep.finished():
            if not sweep.step():
                time.sleep(WAIT)
    except PotlpError as error:
        errors.send(str(error))
        raise SystemExit(1) from error
    # A fault of the program: its traceback is printed here, where it happened.
    except Exception as error:
        errors.send(f"{type(error).__name__}: {one_line(error)} (its traceback is above)")
        raise


def _end_with_parent() -> None:
    """End this process when the one that started it has ended, killed or not: in a trial as between trials."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
