"""Results of a sweep in one SQLite file: one row a trial, written whole or not at all.

One process writes; others may read meanwhile. A trial that is run twice, as after a worker was lost, must give the same
row: the first one stays, and another one is refused.

Everything carries a checksum, so that what a disk or a program has changed is not taken for a result.
Whatever SQLite raises becomes one ``StoreError`` that says what to do.
"""

import contextlib
import dataclasses
import errno
import hashlib
import json
import shutil
import sqlite3
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from potlp_jax.codec import differences, json_copy
from potlp_jax.errors import StoreError
from potlp_jax.files import one_line, short

# Counts up whenever the tables change; a store of another format is refused, not converted.
FORMAT = "potlp-sweep-5"

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
CREATE TABLE facts (name TEXT PRIMARY KEY, value TEXT NOT NULL, checksum TEXT NOT NULL);
CREATE TABLE worlds (
    environment TEXT NOT NULL, task TEXT NOT NULL, world INTEGER NOT NULL, possible INTEGER NOT NULL,
    checksum TEXT NOT NULL, PRIMARY KEY (environment, task, world)
) WITHOUT ROWID;
CREATE TABLE trials (
    environment TEXT NOT NULL, task TEXT NOT NULL, policy TEXT NOT NULL, world INTEGER NOT NULL,
    outcome TEXT NOT NULL, cost REAL NOT NULL, budget REAL NOT NULL, steps INTEGER NOT NULL,
    decisions INTEGER NOT NULL, fallbacks INTEGER NOT NULL, status INTEGER NOT NULL, key TEXT NOT NULL,
    path TEXT NOT NULL, configuration TEXT NOT NULL, versions TEXT NOT NULL, "commit" TEXT NOT NULL,
    seconds REAL NOT NULL, world_digest TEXT NOT NULL, checksum TEXT NOT NULL,
    PRIMARY KEY (environment, task, policy, world)
) WITHOUT ROWID;
CREATE TABLE broken (
    environment TEXT NOT NULL, task TEXT NOT NULL, policy TEXT NOT NULL, world INTEGER NOT NULL,
    error TEXT NOT NULL, checksum TEXT NOT NULL, PRIMARY KEY (environment, task, policy, world)
) WITHOUT ROWID;
"""


# "commit" is a word of SQL, so that names of columns are quoted.
_COLUMNS = ", ".join(
    ["environment", "task", "policy", "world"]
    + [f'"{field.name}"' for field in dataclasses.fields(Row) if field.name != "item"]
)
"""Of a trial, in the order of the fields of ``Item`` and ``Row``."""

# All four, so that SQLite looks the row up by the primary key instead of reading the table.
_THE_ITEM = "environment = ? AND task = ? AND policy = ? AND world = ?"
"""Condition on the primary key of a trial."""


_PUT_BACK = {
    "specification": "the specification that this one was begun with",
    "estimator": "the estimator that this one was begun with",
    "source": "the files that define these, as they were",
}
"""By the fact that differs, what a store is gone on with."""


class Store:
    """The store in a file. One object per process and thread.

    Args:
        file: is made where there is none.
        read_only: reads a store that is there, also from a medium that cannot be written, or that is full.

    Raises:
        StoreError: the file is no store of this format, is damaged, or cannot be opened; or there is none to read.
    """

    def __init__(self, file: Path, read_only: bool = False) -> None:
        self.file = file
        if read_only:
            self._connection = self._open_to_read()
        else:
            with self._reporting():
                # Without an isolation level the module begins no transactions of its own.
                self._connection = sqlite3.connect(file, timeout=PATIENCE, isolation_level=None)
            # A write-ahead log lets others read while one writes; FULL syncs at every commit, so that a row that was
            # written is there after a power failure too.
            self._execute("PRAGMA journal_mode=WAL")
            self._execute("PRAGMA synchronous=FULL")
            # Two processes that open a new file at once must not both make its tables.
            with self._transaction():
                self._make_tables()
        self._check_format()

    def _open_to_read(self) -> sqlite3.Connection:
        if not self.file.exists():
            raise StoreError(f"{self.file}: there is no such file; name the folder of a sweep that was begun")
        log = self.file.with_name(f"{self.file.name}-wal")
        try:
            return self._connect_to_read(self.file, "mode=ro")
        except StoreError:
            # SQLite wants to make files beside it, to share it with others, and cannot. Nobody else can, either.
            if not _has_content(log):
                return self._connect_to_read(self.file, "mode=ro&immutable=1")
        # The log is of a process that was killed. It cannot be worked in where it lies, so a copy is.
        with self._reporting(), tempfile.TemporaryDirectory() as folder:
            for path in (self.file, log):
                shutil.copyfile(path, Path(folder) / path.name)
            with contextlib.closing(self._connect_to_read(Path(folder) / self.file.name, "mode=rw")) as copy:
                memory = sqlite3.connect(":memory:", isolation_level=None)
                copy.backup(memory)
            return memory

    def _connect_to_read(self, file: Path, how: str) -> sqlite3.Connection:
        with self._reporting():
            connection = sqlite3.connect(
                f"{file.resolve().as_uri()}?{how}", uri=True, timeout=PATIENCE, isolation_level=None
            )
            # Connecting reads nothing.
            connection.execute("SELECT count(*) FROM sqlite_master").fetchall()
            return connection

    @contextlib.contextmanager
    def _reporting(self) -> Iterator[None]:
        """Turn whatever SQLite and the system raise into one error with what to do."""
        try:
            yield
        # A text of the schema itself may be damaged: what it should say is then no text.
        except (sqlite3.Error, OSError, OverflowError, MemoryError, UnicodeDecodeError) as error:
            raise StoreError(f"{self.file}: {_explained(error)}") from error

    def _execute(self, statement: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """Run one statement; the rows that it gives, all read."""
        with self._reporting():
            return self._connection.execute(statement, values).fetchall()

    def _make_tables(self) -> None:
        if not self._execute("SELECT 1 FROM sqlite_master WHERE type = 'table'"):
            for statement in _SCHEMA.split(";\n"):
                self._execute(statement)
            self._execute("INSERT INTO facts VALUES ('format', ?, '')", (FORMAT,))

    def _check_format(self) -> None:
        # Checksums tell of rows that were changed; of rows that went with a damaged page SQLite's own check tells.
        problems = [text for (text,) in self._execute("PRAGMA quick_check") if text != "ok"]
        if problems:
            raise StoreError(f"{self.file}: {_DAMAGED.format(one_line(problems[0]))}")
        if not self._execute("SELECT 1 FROM sqlite_master LIMIT 1"):
            raise StoreError(f"{self.file}: {_NOTHING_YET}")
        if not self._execute("SELECT 1 FROM sqlite_master WHERE name = 'facts'"):
            raise StoreError(f"{self.file}: not a store of results; choose another folder")
        found = [value for (value,) in self._execute("SELECT value FROM facts WHERE name = 'format'")]
        if found != [FORMAT]:
            raise StoreError(
                f"{self.file}: its format is {', '.join(map(short, found)) or 'unknown'}, this version reads "
                f"{FORMAT!r}; choose another folder"
            )

    def close(self) -> None:
        """Let go of the file."""
        self._connection.close()

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        """All or nothing; other processes wait."""
        # IMMEDIATE takes the lock for writing at once: a transaction that read first and wrote later could be refused.
        self._execute("BEGIN IMMEDIATE")
        try:
            yield
            self._execute("COMMIT")
        # An interrupt too must not leave half a transaction.
        except BaseException:
            # After some errors, as of a full disk, SQLite has ended the transaction itself; and an error of going back
            # must not hide the first one. What is not committed is gone with the connection in any case.
            with contextlib.suppress(sqlite3.Error):
                self._connection.rollback()
            raise

    def agree(self, facts: Mapping[str, Any]) -> None:
        """Write down what the sweep is, or compare with what is written. More worlds than written make it longer.

        Raises:
            StoreError: the store was begun with something else; the message names the entries.
        """
        with self._transaction():
            for name, value in self._to_write(facts).items():
                text = json.dumps(value, sort_keys=True)
                self._execute("INSERT OR REPLACE INTO facts VALUES (?, ?, ?)", (name, text, _checksum(name, text)))

    def compare(self, facts: Mapping[str, Any]) -> None:
        """Raises StoreError as ``agree`` does, and writes nothing."""
        self._to_write(facts)

    def _to_write(self, facts: Mapping[str, Any]) -> dict[str, Any]:
        """Those facts that are not written yet, or of which more worlds are asked for."""
        written, missing = self.facts(), {}
        for name, value in facts.items():
            given = json_copy(value)
            if name not in written or _is_longer(given, written[name]):
                missing[name] = given
            elif given != written[name]:
                raise StoreError(
                    f"{self.file}: was begun with another {name}: {', '.join(differences(written[name], given))}. "
                    f"Give the sweep a folder of its own, or put back {_PUT_BACK.get(name, name)}"
                )
        return missing

    def facts(self) -> dict[str, Any]:
        """What ``agree`` wrote."""
        rows = self._execute("SELECT name, value, checksum FROM facts WHERE name <> 'format'")
        for name, value, checksum in rows:
            self._check(checksum, f"the fact {name!r}", name, value)
        return {name: json.loads(value) for name, value, _ in rows}

    def specification(self) -> dict[str, Any]:
        """What the sweep is, as ``Specification.to_dict`` wrote it. Raises StoreError where nothing is written yet."""
        try:
            return self.facts()["specification"]
        except KeyError:
            raise StoreError(f"{self.file}: {_NOTHING_YET}") from None

    def _check(self, checksum: Any, what: str, *values: Any) -> None:
        """Raises StoreError where values are not those that were written."""
        if checksum != _checksum(*values):
            raise StoreError(
                f"{self.file}: {one_line(what)} is damaged: its checksum is not that of its values; put back a copy of "
                "the file, or begin the sweep again in another folder"
            )

    def set_possible(self, environment: str, task: str, possible: Mapping[int, bool]) -> None:
        """Write down in which worlds a task is possible.

        Args:
            environment: of the cell.
            task: of the cell.
            possible: by the number of the world.
        """
        with self._transaction():
            # What is there is the same: it was found twice.
            for world, is_possible in possible.items():
                values = (environment, task, world, int(is_possible))
                self._execute("INSERT OR IGNORE INTO worlds VALUES (?, ?, ?, ?, ?)", (*values, _checksum(*values)))

    def possible(self, environment: str, task: str) -> dict[int, bool]:
        """In which worlds a task is possible, of those that were looked at, by number."""
        rows = self._execute(
            "SELECT world, possible, checksum FROM worlds WHERE environment = ? AND task = ? ORDER BY world",
            (environment, task),
        )
        for world, possible, checksum in rows:
            self._check(checksum, f"what is known of world {world}", environment, task, world, possible)
        return {world: bool(possible) for world, possible, _ in rows}

    def finish(self, rows: Iterable[Row]) -> None:
        """Write rows, all or nothing. Raises StoreError where a trial has a row already that says something else."""
        with self._transaction():
            # Columns are in the order of the fields of `Row`, after those of `Item`.
            for row in rows:
                values = [*_key(row.item), *_values(row)]
                marks = ", ".join("?" * (len(values) + 1))
                self._execute(f"INSERT OR IGNORE INTO trials VALUES ({marks})", (*values, _checksum(*values)))
                if self._execute("SELECT changes()") == [(0,)]:
                    self._require_same(row)

    def _require_same(self, row: Row) -> None:
        """Raises StoreError where a trial was run twice with different results."""
        (there,) = self._checked_rows(f"WHERE {_THE_ITEM}", _key(row.item))
        # As SQLite gives it back, numbers of the same kind.
        one, other = (_result(found) for found in (there, _row((*_key(row.item), *_values(row)))))
        if one != other:
            names = ", ".join(differences(one, other))
            raise StoreError(
                f"{self.file}: {row.item.policy} in world {row.item.world} was run twice with different results "
                f"({names}): its workers have other versions, or other processors"
            )

    def set_broken(self, item: Item, error: str) -> None:
        """Write down that a trial was given up, and why."""
        values = (*_key(item), error)
        with self._transaction():
            self._execute("INSERT OR REPLACE INTO broken VALUES (?, ?, ?, ?, ?, ?)", (*values, _checksum(*values)))

    def forget_broken(self) -> None:
        """Begin again what was given up."""
        with self._transaction():
            self._execute("DELETE FROM broken")

    def broken(self) -> dict[Item, str]:
        """The trials that were given up, each with its error."""
        rows = self._execute("SELECT environment, task, policy, world, error, checksum FROM broken")
        for *values, checksum in rows:
            self._check(checksum, f"what is known of {values[2]} in world {values[3]}", *values)
        return {Item(*values[:4]): error for *values, error, _ in rows}

    def items(self) -> set[Item]:
        """The trials that have rows."""
        return {Item(*values) for values in self._execute("SELECT environment, task, policy, world FROM trials")}

    def rows(self, environment: str | None = None, task: str | None = None) -> list[Row]:
        """Finished trials of an environment and task (None: of all), ordered by environment, task, policy, world."""
        return self._checked_rows(
            "WHERE environment = coalesce(?, environment) AND task = coalesce(?, task) "
            "ORDER BY environment, task, policy, world",
            (environment, task),
        )

    def outer_rows(self, environment: str) -> list[Row]:
        """A row of the first and a row of the last world that have any."""
        return [
            row
            for order in ("ASC", "DESC")
            for row in self._checked_rows(f"WHERE environment = ? ORDER BY world {order} LIMIT 1", (environment,))
        ]

    def _checked_rows(self, which: str, values: Sequence[Any]) -> list[Row]:
        """Rows of trials, each compared with its checksum: the one way in which they are read.

        Args:
            which: the rest of the query, after the table's name.
            values: of its question marks.

        Raises:
            StoreError: a row is not what was written.
        """
        found = self._execute(f"SELECT {_COLUMNS}, checksum FROM trials {which}", values)
        for *stored, checksum in found:
            _, _, policy, world, *_ = stored
            self._check(checksum, f"the row of {policy} in world {world}", *stored)
        return [_row(entry[:-1]) for entry in found]

    def count(self) -> int:
        """Finished trials."""
        return sum(self.counts().values())

    def counts(self) -> dict[str, int]:
        """Finished trials by policy; none of a policy that has none."""
        return dict(self._execute("SELECT policy, count(*) FROM trials GROUP BY policy"))


def _key(item: Item) -> tuple[str, str, str, int]:
    # Names of policies may be members of an enumeration, which are written otherwise than the texts that they equal.
    return str(item.environment), str(item.task), str(item.policy), int(item.world)


def _values(row: Row) -> list[Any]:
    """The columns of a row after those of its item, in the order of the fields."""
    # As SQLite gives them back: a column of real numbers makes 9.0 of 9, and numpy's numbers are Python's.
    values = {
        field.name: field.type(getattr(row, field.name)) if field.type in (int, float, str) else None
        for field in dataclasses.fields(row)
        if field.name != "item"
    }
    values |= {"key": json.dumps(row.key), "versions": json.dumps(dict(row.versions), sort_keys=True)}
    return list(values.values())


def _checksum(*values: Any) -> str:
    """Sixteen hexadecimal digits of what is stored: one flipped bit gives others."""
    # `repr` tells 1 from 1.0 and keeps every bit of a float, as SQLite does.
    return hashlib.sha256(repr(values).encode("utf-8", "surrogatepass")).hexdigest()[:16]


def has_tables(file: Path) -> bool:
    """Whether anything was ever written to a store: a full disk, or a kill, may leave a file without content."""
    if not file.is_file():
        return False
    try:
        with contextlib.closing(sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro", uri=True)) as connection:
            return bool(connection.execute("SELECT 1 FROM sqlite_master LIMIT 1").fetchall())
    # What is wrong is said where it is opened.
    except (sqlite3.Error, UnicodeDecodeError):
        return True


def _has_content(file: Path) -> bool:
    try:
        return file.stat().st_size > 0
    except OSError:
        return False


_NOTHING_YET = "was begun, and holds nothing yet: give the sweep's command again"
_DAMAGED = "is damaged, or not a store of results ({}): put back a copy of it, or choose another folder"


def _explained(error: Exception) -> str:
    """What went wrong and what to do, of an error of SQLite or the system."""
    text = str(error)
    why = f"({one_line(error)})"
    if "full" in text or getattr(error, "errno", None) == errno.ENOSPC:
        return f"the disk is full {why}: make room and give the same command again; finished trials are kept"
    if "readonly" in text or getattr(error, "errno", None) == errno.EROFS:
        return f"cannot be written {why}: copy the folder to where it can; `potlp sweep show` reads it here too"
    if "locked" in text or "busy" in text:
        return f"another process has been writing for more than {PATIENCE:g} s {why}: wait for it, or end it"
    if (isinstance(error, sqlite3.OperationalError | OSError) and "I/O" in text) or "unable to open" in text:
        return f"cannot be read or written {why}: look after the disk, its room and the rights to the folder"
    return _DAMAGED.format(one_line(error))


def _row(entry: tuple[Any, ...]) -> Row:
    names = [field.name for field in dataclasses.fields(Row) if field.name != "item"]
    values = dict(zip(names, entry[4:], strict=True))
    values |= {"key": tuple(json.loads(values["key"])), "versions": json.loads(values["versions"])}
    return Row(item=Item(*entry[:4]), **values)


def _result(row: Row) -> dict[str, Any]:
    """What must be the same however often a trial is run."""
    return {name: value for name, value in json_copy(dataclasses.asdict(row)).items() if name != "seconds"}


def _is_longer(given: Any, written: Any) -> bool:
    """Whether a specification differs from the one that is written by more worlds alone."""
    if not (isinstance(given, Mapping) and isinstance(written, Mapping) and "worlds" in given):
        return False
    # More worlds only append: worlds are taken in increasing order, so that the rows that are there stay right.
    return {**written, "worlds": given["worlds"]} == given and given["worlds"] > written["worlds"]
