"""Results of a sweep in one SQLite file: one row a trial, written whole or not at all, shared by several processes.

Work is handed out as claims. A claim belongs to a process. It is void once that process is gone or, of another host,
once it is ``LEASE`` seconds old. So what a killed process had begun is begun again by another, and two processes on one
store do not run the same trial. If two should run the same trial nevertheless, the first row stays.
"""

import contextlib
import dataclasses
import itertools
import json
import os
import socket
import sqlite3
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from potlp_jax.codec import differences, json_copy
from potlp_jax.errors import StoreError

# Counts up whenever the tables change; a store of another format is refused, not converted.
FORMAT = "potlp-sweep-3"

# Ten minutes: trials take seconds, so that only a worker that is gone holds a claim so long.
LEASE: float = 600.0
"""Seconds after which a claim of another host is void."""

PATIENCE: float = 60.0
"""Seconds to wait for another process that is writing."""


POSSIBLE: str = "possible"
"""What stands for the policy where the work is to find out whether the task is possible in a world."""


@dataclasses.dataclass(frozen=True, order=True)
class Item:
    """One trial of a sweep; ``task`` is a formula, ``world`` the number of a world of the sweep's split."""

    environment: str
    task: str
    policy: str
    world: int


@dataclasses.dataclass(frozen=True)
class Row:
    """The result of one trial. Costs are in units of the resolution; ``seconds`` is the wall time it took.

    ``key`` holds the words of the trial's key; ``path`` holds the cells that were entered (``rows.read_path``).
    ``world_digest`` tells in which world that was (``world.grid.world_digest``), whatever its number means later.
    """

    item: Item
    outcome: str
    cost: float
    budget: float
    steps: int
    decisions: int
    fallbacks: int
    status: int
    key: tuple[int, int]
    path: str
    configuration: str
    versions: Mapping[str, str]
    commit: str
    seconds: float
    world_digest: str


_SCHEMA = """
CREATE TABLE facts (name TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE worlds (
    environment TEXT NOT NULL, task TEXT NOT NULL, world INTEGER NOT NULL, possible INTEGER NOT NULL,
    PRIMARY KEY (environment, task, world)
) WITHOUT ROWID;
CREATE TABLE trials (
    environment TEXT NOT NULL, task TEXT NOT NULL, policy TEXT NOT NULL, world INTEGER NOT NULL,
    outcome TEXT NOT NULL, cost REAL NOT NULL, budget REAL NOT NULL, steps INTEGER NOT NULL,
    decisions INTEGER NOT NULL, fallbacks INTEGER NOT NULL, status INTEGER NOT NULL, key TEXT NOT NULL,
    path TEXT NOT NULL, configuration TEXT NOT NULL, versions TEXT NOT NULL, "commit" TEXT NOT NULL,
    seconds REAL NOT NULL, world_digest TEXT NOT NULL,
    PRIMARY KEY (environment, task, policy, world)
) WITHOUT ROWID;
CREATE TABLE claims (
    environment TEXT NOT NULL, task TEXT NOT NULL, policy TEXT NOT NULL, world INTEGER NOT NULL,
    host TEXT NOT NULL, process INTEGER NOT NULL, started REAL NOT NULL, claimed REAL NOT NULL,
    PRIMARY KEY (environment, task, policy, world)
) WITHOUT ROWID;
"""


# All four, so that SQLite looks the row up by the primary key instead of reading the table.
_THE_ITEM = "environment = ? AND task = ? AND policy = ? AND world = ?"
"""Condition on the primary key of a trial or a claim."""


class Store:
    """The store in a file, which is made where there is none. One object per process and thread."""

    def __init__(self, file: Path) -> None:
        self.file = file
        try:
            # Without an isolation level the module begins no transactions of its own.
            self._connection = sqlite3.connect(file, timeout=PATIENCE, isolation_level=None)
            # A write-ahead log lets others read while one writes; FULL syncs at every commit, so that a row that was
            # written is there after a power failure too.
            self._connection.execute("PRAGMA journal_mode=WAL")
            self._connection.execute("PRAGMA synchronous=FULL")
            # Two processes that open a new file at once must not both make its tables.
            with self._transaction():
                self._prepare()
        except sqlite3.DatabaseError as error:
            raise StoreError(f"{file}: not a store of results ({error}); choose another folder") from error

    def _prepare(self) -> None:
        tables = {name for (name,) in self._connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not tables:
            for statement in _SCHEMA.split(";\n"):
                self._connection.execute(statement)
            self._connection.execute("INSERT INTO facts VALUES ('format', ?)", (FORMAT,))
        found = (
            dict(self._connection.execute("SELECT name, value FROM facts")) if not tables or "facts" in tables else {}
        )
        if found.get("format") != FORMAT:
            raise StoreError(
                f"{self.file}: its format is {found.get('format')!r}, this version reads {FORMAT!r}; "
                "choose another folder"
            )

    def close(self) -> None:
        """Let go of the file."""
        self._connection.close()

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        """All or nothing; other processes wait."""
        # IMMEDIATE takes the lock for writing at once: a transaction that read first and wrote later could be refused.
        self._connection.execute("BEGIN IMMEDIATE")
        try:
            yield
        # An interrupt too must not leave half a transaction.
        except BaseException:
            self._connection.execute("ROLLBACK")
            raise
        self._connection.execute("COMMIT")

    def agree(self, facts: Mapping[str, Any]) -> None:
        """Write down what the sweep is, or compare with what is written. More worlds than written make it longer.

        Raises:
            StoreError: the store was begun with something else; the message names the entries.
        """
        with self._transaction():
            written = self.facts()
            for name, value in facts.items():
                given = json_copy(value)
                if name not in written or _is_longer(given, written[name]):
                    self._connection.execute(
                        "INSERT OR REPLACE INTO facts VALUES (?, ?)", (name, json.dumps(given, sort_keys=True))
                    )
                elif given != written[name]:
                    raise StoreError(
                        f"{self.file}: was begun with another {name}: {', '.join(differences(written[name], given))}. "
                        "Give the sweep a folder of its own, or the specification that this one was begun with"
                    )

    def facts(self) -> dict[str, Any]:
        """What ``agree`` wrote."""
        rows = self._connection.execute("SELECT name, value FROM facts WHERE name <> 'format'").fetchall()
        return {name: json.loads(value) for name, value in rows}

    def set_possible(self, environment: str, task: str, possible: Mapping[int, bool]) -> None:
        """Write down in which worlds a task is possible, and give up the claims on finding out.

        Args:
            environment: of the cell.
            task: of the cell.
            possible: by the number of the world.
        """
        with self._transaction():
            # Two processes find the same, so that the first answer may stay.
            for world, is_possible in possible.items():
                self._connection.execute(
                    "INSERT OR IGNORE INTO worlds VALUES (?, ?, ?, ?)", (environment, task, world, int(is_possible))
                )
                self._give_up(Item(environment, task, POSSIBLE, world))

    def possible(self, environment: str, task: str) -> dict[int, bool]:
        """In which worlds a task is possible, of those that were looked at, by number."""
        rows = self._connection.execute(
            "SELECT world, possible FROM worlds WHERE environment = ? AND task = ? ORDER BY world", (environment, task)
        )
        return {world: bool(possible) for world, possible in rows}

    def claim(self, items: Sequence[Item], count: int) -> list[Item]:
        """Up to ``count`` of the items, in their order, that have no row and that no living process has claimed."""
        with self._transaction():
            # Lazily, up to as many as are wanted: each question reads the store, which may hold 10,000s of rows.
            free = list(itertools.islice(filter(self._is_free, items), count))
            now = time.time()
            self._connection.executemany(
                "INSERT OR REPLACE INTO claims VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
                [(*_key(item), socket.gethostname(), os.getpid(), process_start(os.getpid()), now) for item in free],
            )
        return free

    def finish(self, rows: Iterable[Row]) -> None:
        """Write rows and give up their claims, all or nothing. A row that is there stays."""
        with self._transaction():
            # Columns are in the order of the fields of `Row`, after those of `Item`.
            for row in rows:
                values = {field.name: getattr(row, field.name) for field in dataclasses.fields(row)}
                del values["item"]
                values |= {"key": json.dumps(row.key), "versions": json.dumps(dict(row.versions), sort_keys=True)}
                marks = ", ".join("?" * (4 + len(values)))
                self._connection.execute(
                    f"INSERT OR IGNORE INTO trials VALUES ({marks})", (*_key(row.item), *values.values())
                )
                self._give_up(row.item)

    def rows(self, environment: str | None = None, task: str | None = None) -> list[Row]:
        """Finished trials of an environment and task (None: of all), ordered by environment, task, policy, world."""
        # "commit" is a word of SQL, so that names of columns are quoted.
        names = ", ".join(f'"{field.name}"' for field in dataclasses.fields(Row) if field.name != "item")
        found = self._connection.execute(
            f"SELECT environment, task, policy, world, {names} FROM trials "
            "WHERE environment = coalesce(?, environment) AND task = coalesce(?, task) "
            "ORDER BY environment, task, policy, world",
            (environment, task),
        )
        return [_row(entry) for entry in found]

    def _give_up(self, item: Item) -> None:
        self._connection.execute(f"DELETE FROM claims WHERE {_THE_ITEM}", _key(item))

    def count(self) -> int:
        """Finished trials."""
        return self._connection.execute("SELECT count(*) FROM trials").fetchone()[0]

    def _is_free(self, item: Item) -> bool:
        """Whether the item is neither finished nor claimed: looked up by itself, however large the store has grown."""
        if item.policy == POSSIBLE:
            finished = "SELECT 1 FROM worlds WHERE environment = ? AND task = ? AND world = ?"
            values = (item.environment, item.task, item.world)
        else:
            finished = f"SELECT 1 FROM trials WHERE {_THE_ITEM}"
            values = _key(item)
        if self._connection.execute(finished, values).fetchone():
            return False
        claim = f"SELECT host, process, started, claimed FROM claims WHERE {_THE_ITEM}"
        owner = self._connection.execute(claim, _key(item)).fetchone()
        return owner is None or not _alive(*owner)


def _key(item: Item) -> tuple[str, str, str, int]:
    return item.environment, item.task, item.policy, item.world


def _row(entry: tuple[Any, ...]) -> Row:
    names = [field.name for field in dataclasses.fields(Row) if field.name != "item"]
    values = dict(zip(names, entry[4:], strict=True))
    values |= {"key": tuple(json.loads(values["key"])), "versions": json.loads(values["versions"])}
    return Row(item=Item(*entry[:4]), **values)


def _alive(host: str, process: int, started: float, claimed: float) -> bool:
    """Whether the owner of a claim still works on it."""
    # Processes of another host cannot be seen, so that only the age of their claims counts.
    if host == socket.gethostname():
        return process_start(process) == started
    return time.time() - claimed < LEASE


def process_start(process: int) -> float | None:
    """When a process of this host was started, in the system's own units; None where there is none.

    The system uses the number of a process again after a while, but not with the same start. Where the system does not
    report starts, 0 stands for any.
    """
    if not Path("/proc/self/stat").exists():
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            return None
        except PermissionError:
            return 0.0
        return 0.0
    try:
        stat = Path(f"/proc/{process}/stat").read_text()
    except FileNotFoundError:
        return None
    # Fields of /proc/PID/stat: number, name in brackets (which may hold anything), state, and as the 22nd the start.
    state, *fields = stat.rpartition(")")[2].split()
    return None if state == "Z" else float(fields[18])


def _is_longer(given: Any, written: Any) -> bool:
    """Whether a specification differs from the one that is written by more worlds alone."""
    if not (isinstance(given, Mapping) and isinstance(written, Mapping) and "worlds" in given):
        return False
    # More worlds only append: worlds are taken in increasing order, so that the rows that are there stay right.
    return {**written, "worlds": given["worlds"]} == given and given["worlds"] > written["worlds"]
