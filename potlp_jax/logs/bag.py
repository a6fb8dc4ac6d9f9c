"""Messages of a bag in whatever format, also of one that is damaged.

The library ``rosbags`` reads whole bags. Recordings that were killed, copies that were cut short and blocks that were
damaged are scanned record by record instead: what can be read is kept, and what is lost is counted where the file still
says how much there was.

References:
    ROS wiki, "Bags/Format/2.0"; mcap.dev, "MCAP Format Specification"; sqlite.org, "Database File Format".
"""

import contextlib
import re
import sqlite3
import struct
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from io import BufferedReader, BytesIO
from pathlib import Path

from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag1.reader import Header, RecordType, decompressors, read_bytes, read_uint32
from rosbags.rosbag2 import Reader as Rosbag2Reader
from rosbags.rosbag2.storage_mcap import decompress, read_exact, read_string
from rosbags.typesys.msg import normalize_msgtype

from potlp_jax.errors import LogError
from potlp_jax.files import one_line, read_yaml, reading, require_file

FORMATS = {".bag": "ROS 1 bag", ".db3": "ROS 2 bag (sqlite3)", ".mcap": "MCAP"}
"""Formats by the ending of their files."""

# First and last bytes of an MCAP file.
_MCAP_MAGIC = b"\x89MCAP0\r\n"
_LATEST = 2**63 - 1
"""Nanoseconds since 1970, in the year 2262, up to which times are held."""

_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 0x03, 0x04, 0x05, 0x06
"""Records of an MCAP file that lead to messages."""


@dataclass(frozen=True)
class RawMessage:
    """A message as it was recorded: ``time`` in nanoseconds, when it was received; ``type`` such as
    ``nav_msgs/msg/OccupancyGrid``; ``data`` serialised as its version of ROS does."""

    topic: str
    type: str
    time: int
    data: bytes


@dataclass(frozen=True)
class Bag:
    """A bag that was looked through once.

    Attributes:
        path: file or folder.
        format: in words.
        is_ros1: how messages are serialised.
        topics: name and type of each topic.
        times: when the messages of each topic were received, in nanoseconds, as they stand in the file.
        problems: what is damaged and lost, in words.
        damaged: whether messages are scanned for.
    """

    path: Path
    format: str
    is_ros1: bool
    topics: dict[str, str]
    times: dict[str, list[int]]
    problems: tuple[str, ...]
    damaged: bool

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """Messages of some topics, by time in a whole bag, as they stand in the file in a damaged one."""
        # The library sorts by time; a scan gives what it finds where it finds it.
        source = _until_damage(_scan if self.damaged else _read, self.path)
        return (message for message in source if isinstance(message, RawMessage) and message.topic in topics)


def open_bag(path: Path) -> Bag:
    """Look through a bag.

    Raises:
        LogError: it is missing, of another format, or nothing in it can be read.
    """
    files = _files(path)
    for file in files:
        # Of any size: bags are read message by message.
        require_file(file, LogError)
    ending = files[0].suffix
    damaged, problems = False, []
    # The whole bag is read once in any case, to know its topics and times: damage shows on the way.
    topics, times, error = _count(_read, path)
    # The file says how much there was; the reading says how much there is.
    expected, found = _expected_count(path), sum(map(len, times.values()))
    if error is None and expected not in (None, found):
        # Readers pass over messages of topics that are gone.
        problems.append(f"{found} messages could be read, where by its own count there are {expected}")
    if error is not None:
        damaged = True
        topics, times, scan_error = _count(_scan, path)
        found = sum(map(len, times.values()))
        # The scan often fails for the same reason as the library: said once.
        why = "; ".join(dict.fromkeys(filter(None, (error, scan_error))))
        problems.append(f"damaged or cut short ({why}): {found} messages could be read, {_lost(found, expected)}")
    if not any(times.values()):
        why = f" ({problems[0]})" if problems else ""
        raise LogError(f"{one_line(path)}: holds no message{why}; record it again")
    # A folder is a ROS 2 bag whatever its storage; a lone .mcap file may come from anywhere.
    is_folder = path.is_dir() or len(files) > 1
    name = f"ROS 2 bag ({'MCAP' if ending == '.mcap' else 'sqlite3'})" if is_folder else FORMATS[ending]
    return Bag(path, name, ending == ".bag", topics, times, tuple(problems), damaged)


def _lost(found: int, expected: int | None) -> str:
    if expected is None:
        return "how many are lost is not known, for what counts them is gone"
    return f"{max(expected - found, 0)} of {expected} are lost"


def _files(path: Path) -> list[Path]:
    """The storage files of a bag, in order."""
    with reading(path, LogError, "a log"):
        if not path.exists():
            raise LogError(f"{one_line(path)}: there is no such file or folder")
    if not path.is_dir():
        if path.suffix not in FORMATS:
            raise LogError(f"{path}: {path.suffix or 'no ending'} is no format of logs; known are {', '.join(FORMATS)}")
        return [path]
    files = [file for ending in (".db3", ".mcap") for file in sorted(path.glob(f"*{ending}"), key=_numbered)]
    if not files:
        raise LogError(f"{path}: is no ROS 2 bag, for there is no .db3 or .mcap file in it")
    if len({file.suffix for file in files}) > 1:
        raise LogError(f"{path}: holds .db3 and .mcap files; give one of them")
    return files


def _numbered(file: Path) -> list[str | int]:
    """Sorts the files of a recording that was split by their numbers: 10 comes after 2."""
    # Texts and numbers take turns, so that like is compared with like.
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", file.name)]


def _count(
    source: Callable[[Path], Iterator[RawMessage]], path: Path
) -> tuple[dict[str, str], dict[str, list[int]], str | None]:
    """Types and times by topic, and what stopped the reading."""
    topics: dict[str, str] = {}
    times: dict[str, list[int]] = {}
    for message in _until_damage(source, path):
        if isinstance(message, str):
            return topics, times, message
        topics.setdefault(message.topic, message.type)
        times.setdefault(message.topic, []).append(message.time)
    return topics, times, None


def _until_damage(source: Callable[[Path], Iterator[RawMessage]], path: Path) -> Iterator[RawMessage | str]:
    """Messages until the reading fails, then why. Every pass over a bag goes through here: what one finds, all do."""
    try:
        for message in source(path):
            # Stored values have any type and size in a damaged database, and times are kept in 64 bits with a sign.
            if not (isinstance(message.topic, str) and isinstance(message.type, str)):
                raise ValueError("a topic without name or type")
            if not (isinstance(message.time, int) and 0 <= message.time <= _LATEST):
                raise ValueError(f"a message of {message.topic} has an impossible time")
            yield message
    except LogError:
        raise
    # Parsers of damaged files fail in as many ways as files can be damaged.
    except Exception as error:
        yield "a size beyond the memory" if isinstance(error, MemoryError) else one_line(error).rstrip(".")


def _read(path: Path) -> Iterator[RawMessage]:
    """All messages of a whole bag, by time."""
    # ROS 1 has a file format of its own; both kinds of ROS 2 storage share a reader.
    with Rosbag1Reader(path) if path.suffix == ".bag" else Rosbag2Reader(path) as reader:
        for connection, time, data in reader.messages():
            yield RawMessage(connection.topic, connection.msgtype, time, bytes(data))


def _expected_count(path: Path) -> int | None:
    """Messages that a damaged bag had, by its own word."""
    with contextlib.suppress(LogError), reading(path, LogError, "the folder of a bag"):
        metadata = read_yaml(path / "metadata.yaml", LogError)
        return int(metadata["rosbag2_bagfile_information"]["message_count"])
    # The index may be whole while the messages are not; else whatever is wrong with it leaves no number.
    with (
        contextlib.suppress(Exception),
        Rosbag1Reader(path) if path.suffix == ".bag" else Rosbag2Reader(path) as reader,
    ):
        return reader.message_count
    return None


def _scan(path: Path) -> Iterator[RawMessage]:
    """Messages that can be found in a damaged bag."""
    scanners = {".bag": _scan_rosbag1, ".mcap": _scan_mcap, ".db3": _scan_sqlite}
    for file in _files(path):
        yield from scanners[file.suffix](file)


def _scan_rosbag1(file: Path) -> Iterator[RawMessage]:
    connections: dict[int, tuple[str, str]] = {}
    with file.open("rb") as stream:
        if stream.readline() != b"#ROSBAG V2.0\n":
            raise LogError(f"{file}: is no ROS 1 bag of version 2.0")
        # Messages stand in chunks. Records outside of them are indices, which a killed recording does not have.
        for header, data in _rosbag1_records(stream):
            if header.get_uint8("op") != RecordType.CHUNK:
                continue
            # A block that is damaged is lost, but those after it are not.
            with contextlib.suppress(Exception):
                content = decompressors[header.get_string("compression")](data)
                yield from _messages_of_chunk(content, connections)


def _messages_of_chunk(content: bytes, connections: dict[int, tuple[str, str]]) -> Iterator[RawMessage]:
    for header, data in _rosbag1_records(BytesIO(content)):
        kind, number = header.get_uint8("op"), header.get_uint32("conn")
        if kind == RecordType.CONNECTION:
            # A connection's data is itself a header, without its length in front.
            fields = Header.read(BytesIO(struct.pack("<L", len(data)) + data))
            connections[number] = header.get_string("topic"), normalize_msgtype(fields.get_string("type"))
        elif kind == RecordType.MSGDATA and number in connections:
            topic, message_type = connections[number]
            yield RawMessage(topic, message_type, header.get_time("time"), data)


def _rosbag1_records(stream: BufferedReader | BytesIO) -> Iterator[tuple[Header, bytes]]:
    """Records until the stream ends or makes no sense; of a chunk that is cut short what there is."""
    while True:
        try:
            header = Header.read(stream)
            size = read_uint32(stream)
            position = stream.tell()
        # Never raises: what was found so far is worth more than what is wrong with the rest.
        # The end, or nothing that can be made sense of.
        except Exception:
            return
        try:
            yield header, read_bytes(stream, size)
        except Exception:
            # A chunk that is cut short is handed on as far as it goes: it may hold whole messages.
            stream.seek(position)
            if header.get("op") == bytes([RecordType.CHUNK]):
                yield header, stream.read()
            return


def _scan_mcap(file: Path) -> Iterator[RawMessage]:
    with file.open("rb") as stream:
        if stream.read(len(_MCAP_MAGIC)) != _MCAP_MAGIC:
            raise LogError(f"{file}: is no MCAP file")
        yield from _messages_of_mcap(stream, {}, {})


def _messages_of_mcap(
    stream: BufferedReader | BytesIO, schemas: dict[int, str], channels: dict[int, tuple[str, str]]
) -> Iterator[RawMessage]:
    # Schemas and channels come before the messages that need them, within chunks too: both are carried along.
    for kind, record in _mcap_records(stream):
        content = BytesIO(record)
        if kind == _SCHEMA:
            (number,) = struct.unpack("<H", read_exact(content, 2))
            schemas[number] = read_string(content)
        elif kind == _CHANNEL:
            number, schema = struct.unpack("<HH", read_exact(content, 4))
            channels[number] = read_string(content), schemas.get(schema, "")
        elif kind == _MESSAGE:
            number, _, time, _ = struct.unpack("<HIQQ", read_exact(content, 22))
            if number in channels:
                yield RawMessage(*channels[number], time, content.read())
        elif kind == _CHUNK:
            # A block that is damaged is lost, but those after it are not.
            with contextlib.suppress(Exception):
                yield from _messages_of_mcap(BytesIO(_chunk_of_mcap(content)), schemas, channels)


def _chunk_of_mcap(content: BytesIO) -> bytes:
    """The records of a chunk; of one that is cut short and not compressed, what there is."""
    _, _, size, crc = struct.unpack("<QQQI", read_exact(content, 28))
    compression = read_string(content)
    (stored,) = struct.unpack("<Q", read_exact(content, 8))
    # Compressed data that is cut short cannot be unpacked, uncompressed data can be used as far as it goes.
    data = content.read(stored)
    return data if len(data) < stored and not compression else decompress(data, compression, size, crc)


def _mcap_records(stream: BufferedReader | BytesIO) -> Iterator[tuple[int, bytes]]:
    """Kind and content of the records until the stream ends; of a chunk that is cut short what there is."""
    while True:
        # One byte of kind, eight of length.
        head = stream.read(9)
        if len(head) < 9:
            return
        kind, size = struct.unpack("<BQ", head)
        record = stream.read(size)
        if len(record) == size or kind == _CHUNK:
            yield kind, record
        if len(record) < size:
            return


def _scan_sqlite(file: Path) -> Iterator[RawMessage]:
    """Rows in the order of their ids: up to a damaged page, then those behind the last damaged one."""
    # As a URI, in which a question mark or a percent sign of the name must be escaped.
    connection = sqlite3.connect(f"{file.absolute().as_uri()}?immutable=1", uri=True)
    with contextlib.closing(connection):
        # Without it a file that is shorter than its header says is refused altogether.
        connection.execute("PRAGMA writable_schema = ON")
        topics = {
            number: (name, kind) for number, name, kind in connection.execute("SELECT id, name, type FROM topics")
        }
        rows = "SELECT id, topic_id, timestamp, data FROM messages NOT INDEXED"
        # Rowids grow with time, and reading by id needs no index, which may be what is damaged.
        last = -1
        with contextlib.suppress(sqlite3.DatabaseError):
            for number, topic, time, data in connection.execute(f"{rows} ORDER BY id"):
                last = number
                yield RawMessage(*topics[topic], time, data)
            return
        # A walk forward would end at the damaged page again, so that each row behind it is found by its id.
        for number in _ids_behind(connection, last):
            # Data may go on in other pages, of which one may be damaged too: that row alone is lost.
            with contextlib.suppress(sqlite3.DatabaseError):
                for _, topic, time, data in connection.execute(f"{rows} WHERE id = ?", (number,)):
                    yield RawMessage(*topics[topic], time, data)


def _ids_behind(connection: sqlite3.Connection, last: int) -> list[int]:
    """Ids of the messages after one, in order, as far as they can be found from the end of the table."""
    ids: list[int] = []
    # Ids alone: messages in the order of the walk would be in reverse, and time with them.
    with contextlib.suppress(sqlite3.DatabaseError):
        for (number,) in connection.execute(
            "SELECT id FROM messages NOT INDEXED WHERE id > ? ORDER BY id DESC", (last,)
        ):
            ids.append(number)
    return ids[::-1]
