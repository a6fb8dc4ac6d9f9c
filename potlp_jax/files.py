"""Files that are read: every reader of the library begins here, so that a bad file ends in one clear line, and soon.

A reader asks for the contents (`read_bytes`, `read_text`, `read_json`, `read_yaml`, `read_npz`, and `images` for
pixels), or, where another library opens the file itself, for `require_file`; and it parses within `reading`. Both raise
the reader's own kind of `PotlpError`. What they see to:

- only regular files are opened: a FIFO would wait for ever, and /dev/zero has no end;
- sizes are checked before anything is read, unpacked or decoded, against limits that the message names;
- whatever a parser raises on damaged input, an error of recursion or memory included, becomes one line.

One writer is here, too (`whole_file`, `write_whole`): what takes long to make again is never left half written.
"""

import contextlib
import io
import json
import os
import re
import shutil
import stat
import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
import yaml

from potlp_jax.errors import PotlpError

MIB = 1 << 20

MOST_TEXT: int = 4 * MIB
"""Bytes of a text that people or small programs write: automata, plans, manifests."""

MOST_YAML: int = MIB // 2
"""Bytes of a YAML file. Parsing takes seconds per megabyte; 400 rooms with 20 corners each are 120 kB."""

MOST_RECORD: int = 256 * MIB
"""Bytes of a JSON file that the library wrote: a trial of 1,000 decisions has some 10 MiB."""

MOST_ARRAYS: int = 1024 * MIB
"""Bytes that the arrays of an .npz file may have when they are unpacked."""

DEEPEST: int = 50
"""Levels of YAML within each other; what is nested deeper is damage, and would exhaust the stack of the parser."""

MOST_VALUES: int = 200_000
"""Values of a YAML file with its aliases written out: ten lines of aliases of aliases can stand for billions."""

TEMPORARY: str = ".tmp"
"""How the names of files end that were not written to their end."""

# No setting has a longer name, and messages quote names whole.
_LONGEST_NAME = 100
_LONGEST_INTEGER = 63
# Bytes, of the 255 that names of files may have.
_LONGEST_BEGINNING = 200
_LONGEST_REASON = 200
"""Characters of another library's message that are passed on."""

_LIBYAML = yaml.__with_libyaml__

_SafeLoader: Any = yaml.CSafeLoader if _LIBYAML else yaml.SafeLoader


class _Loader(_SafeLoader):
    """The safe values of PyYAML, and numbers as YAML 1.2 and everybody write them: ``1e-3`` is one, too."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
)


def one_line(value: object, longest: int = _LONGEST_REASON) -> str:
    """A text or an error for a message: on one line, printable, and not longer than ``longest`` characters."""
    text = " ".join(str(value).split()) or type(value).__name__
    text = text if len(text) <= longest else f"{text[: longest - 3]}..."
    # Bytes of a damaged file may be escape sequences, which a terminal would obey.
    return "".join(char if char.isprintable() else char.encode("unicode_escape").decode() for char in text)


def short(value: object, longest: int = 80) -> str:
    """A value as Python writes it, cut where it is long."""
    # A file may hold a list of a million entries, and `repr` of a structure that holds itself or is deep fails.
    with contextlib.suppress(RecursionError, ValueError):
        return one_line(repr(value), longest)
    return f"a {type(value).__name__}"


@contextlib.contextmanager
def reading(path: Path | str, error: type[PotlpError], what: str) -> Iterator[None]:
    """Turn whatever reading a file raises into one error that names the file.

    Parsers of damaged files fail in as many ways as files can be damaged, so all exceptions count here; hence only
    parsing belongs within, not work with what was read.

    Args:
        path: the file, for the message.
        error: what is raised.
        what: that the file should have been, with its article: ``"a trial record"``.

    Raises:
        PotlpError: of the kind ``error``; errors of that family that the block raises itself pass through.
    """
    try:
        yield
    except PotlpError:
        raise
    except Exception as cause:
        # Libraries raise OSError for damage, too; that of the system alone has a text for its number.
        if isinstance(cause, OSError) and cause.strerror:
            why = f"cannot be read ({cause.strerror})"
        elif isinstance(cause, RecursionError):
            why = f"is not {what}: it is nested too deeply"
        elif isinstance(cause, MemoryError):
            why = f"is not {what}, or is damaged: it asks for more memory than there is"
        else:
            why = f"is not {what}, or is damaged ({one_line(cause)})"
        raise error.of_file(path, why) from cause


def require_file(path: Path | str, error: type[PotlpError], most: int | None = None) -> Path:
    """Check that a path is a regular file of at most so many bytes.

    Args:
        path: of the file.
        error: what is raised.
        most: bytes; None: any number, for formats that are read piece by piece.

    Returns:
        The path.

    Raises:
        PotlpError: of the kind ``error``: it is missing, something else than a file, or too large.
    """
    path = Path(path)
    try:
        found = path.stat()
    # A null byte in a name is a ValueError, a name of 5,000 characters an OSError.
    except (OSError, ValueError) as cause:
        why = cause.strerror if isinstance(cause, OSError) else one_line(cause)
        # The same command means another file from another folder.
        if isinstance(cause, FileNotFoundError) and not path.is_absolute():
            why = f"{why}, seen from {one_line(Path.cwd())}"
        raise error.of_file(one_line(path), f"cannot be read ({why})") from cause
    if not stat.S_ISREG(found.st_mode):
        kind = "a folder" if stat.S_ISDIR(found.st_mode) else "a device or pipe"
        raise error.of_file(path, f"is {kind}; give a file")
    if most is not None and found.st_size > most:
        raise error.of_file(path, f"has {found.st_size:,} bytes; at most {most:,} are read")
    return path


def read_bytes(path: Path | str, error: type[PotlpError], most: int) -> bytes:
    """The contents of a file.

    Args:
        path: of the file.
        error: what is raised.
        most: bytes that it may have.

    Returns:
        All its bytes.

    Raises:
        PotlpError: of the kind ``error``: it cannot be read, or is too large.
    """
    with reading(path, error, "a file"), require_file(path, error, most).open("rb") as stream:
        # Files of /proc say that they have no bytes, and others grow while they are read.
        contents = stream.read(most + 1)
    if len(contents) > most:
        raise error.of_file(path, f"has more than {most:,} bytes, which is all that is read")
    return contents


def read_text(path: Path | str, error: type[PotlpError], most: int = MOST_TEXT) -> str:
    """The contents of a text file in UTF-8; see `read_bytes`."""
    contents = read_bytes(path, error, most)
    try:
        return contents.decode("utf-8")
    except UnicodeDecodeError as cause:
        raise error.of_file(path, f"is no text in UTF-8 (byte {cause.start})") from cause


def read_json(path: Path | str, error: type[PotlpError], what: str, most: int = MOST_RECORD) -> Any:
    """The value in a JSON file; see `read_bytes` and `reading`."""
    contents = read_bytes(path, error, most)
    with reading(path, error, what):
        return json.loads(contents)


def read_yaml(path: Path | str, error: type[PotlpError], loader: type[Any] | None = None) -> Any:
    """The value in a YAML file.

    Args:
        path: of the file.
        error: what is raised.
        loader: makes values of the text; None: those of ``yaml.safe_load``, where 1e-3 is a number.

    Returns:
        The value.

    Raises:
        PotlpError: of the kind ``error``: it cannot be read, is no YAML, or is too large or too deep.
    """
    text = read_text(path, error, MOST_YAML)
    with reading(path, error, "YAML"):
        try:
            return parse_yaml(text, loader)
        # PyYAML's own words say where; the others (of dates, or of numbers with 5,000 digits) do not.
        except yaml.YAMLError as cause:
            why = one_line(cause, 400).replace('in "<unicode string>", line', "at line")
            raise error.of_file(path, f"is not valid YAML: {why}") from cause


def read_xml(path: Path | str, error: type[PotlpError]) -> ElementTree.Element:
    """The root element of an XML file, read without entities of its own; see `read_bytes` and `reading`."""
    contents = read_bytes(path, error, MOST_TEXT)
    # A few lines of entities within entities can stand for gigabytes, and none of the formats has any.
    # Without zeros, so that it is found in 16 and 32 bits a letter, too.
    if b"<!ENTITY" in contents.replace(b"\0", b""):
        raise error.of_file(path, "declares entities, which are not read")
    with reading(path, error, "valid XML"):
        return ElementTree.fromstring(contents)


def parse_yaml(text: str, loader: type[Any] | None = None) -> Any:
    """The value of a YAML text. Raises YAMLError, or whatever a value that is out of range makes its type raise."""
    _check_events(text)
    reader = (loader or _Loader)(text)
    try:
        node = reader.get_single_node()
        _check_keys(node)
        return None if node is None else reader.construct_document(node)
    finally:
        reader.dispose()


def _check_keys(root: yaml.Node | None) -> None:
    """Refuse a key that is given twice: PyYAML keeps the last of them, and says nothing."""
    waiting, seen = [root], set()
    while waiting:
        node = waiting.pop()
        # An alias is the node itself, once more.
        if not isinstance(node, yaml.CollectionNode) or id(node) in seen:
            continue
        seen.add(id(node))
        if isinstance(node, yaml.MappingNode):
            keys: set[tuple[str, str]] = set()
            for key, value in node.value:
                if isinstance(key, yaml.ScalarNode):
                    if (key.tag, key.value) in keys:
                        line = key.start_mark.line + 1
                        raise yaml.YAMLError(f"key {short(key.value)} is given twice, line {line}")
                    keys.add((key.tag, key.value))
                waiting += [key, value]
        else:
            waiting += node.value


def _check_events(text: str) -> None:
    """Refuse nesting and aliases that would take the stack or the memory. Events come one by one and take neither."""
    sizes: dict[str, int] = {}
    # Of every collection that is open: its anchor, and its values so far.
    open_collections: list[tuple[str | None, int]] = [(None, 0)]
    for event in yaml.parse(text, Loader=yaml.CLoader if _LIBYAML else yaml.Loader):
        added, anchor = 0, getattr(event, "anchor", None)
        if isinstance(event, yaml.CollectionStartEvent):
            open_collections.append((anchor, 0))
            if len(open_collections) > DEEPEST:
                raise yaml.YAMLError(f"more than {DEEPEST} levels within each other, line {event.start_mark.line + 1}")
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, inside = open_collections.pop()
            added = inside + 1
        elif isinstance(event, yaml.AliasEvent):
            # An alias within its own anchor has no size yet: a structure that holds itself has no end.
            if anchor not in sizes:
                raise yaml.YAMLError(f"alias {short(anchor)} stands for nothing, line {event.start_mark.line + 1}")
            added, anchor = sizes[anchor], None
        elif isinstance(event, yaml.ScalarEvent):
            added = 1
        if anchor is not None and added:
            sizes[anchor] = added
        outer, count = open_collections[-1]
        open_collections[-1] = outer, count + added
        if count + added > MOST_VALUES:
            raise yaml.YAMLError(f"more than {MOST_VALUES:,} values, aliases written out")


def read_npz(path: Path | str, error: type[PotlpError], what: str, most: int = MOST_ARRAYS) -> dict[str, np.ndarray]:
    """The arrays of an ``.npz`` file.

    Args:
        path: of the file.
        error: what is raised.
        what: the file should have been, with its article.
        most: bytes that its arrays may have when they are unpacked.

    Returns:
        The arrays by name. The checksums of the zip have been compared: a flipped bit does not go unnoticed.

    Raises:
        PotlpError: of the kind ``error``: it cannot be read, is something else, damaged, or too large.
    """
    require_file(path, error, most)
    with reading(path, error, what), zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        # By the directory of the zip, before anything is unpacked: no member yields more than it says there.
        size = sum(member.file_size for member in members)
        if size > most:
            raise error.of_file(path, f"would unpack to {size:,} bytes; at most {most:,} are read")
        return {member.filename.removesuffix(".npy"): _array(archive.read(member)) for member in members}


def _array(contents: bytes) -> np.ndarray:
    """The array of an ``.npy`` file; its header is compared with its size before memory is taken."""
    stream = io.BytesIO(contents)
    version = np.lib.format.read_magic(stream)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = header(stream)
    if dtype.hasobject:
        raise ValueError("it holds Python objects")
    # In Python's integers, which do not overflow: a shape of (2**40, 2**40) is damage, not zero bytes.
    count = 1
    for size in shape:
        count *= size
    found = len(contents) - stream.tell()
    if count * dtype.itemsize != found:
        raise ValueError(f"an array of shape {shape} and type {dtype} does not have {found} bytes")
    array = np.frombuffer(contents, dtype, count, stream.tell())
    return array.reshape(shape, order="F" if fortran else "C")


def write_whole(path: Path, text: str) -> None:
    """Write a text in UTF-8 under a temporary name in the same folder, and rename it: a reader finds all of it or none.

    Args:
        path: of the file; what is there already is replaced at the end, or stays as it is.
        text: what it is to hold.

    Raises:
        OSError: it cannot be written.
    """
    with whole_file(path) as file:
        file.write(text.encode())


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[IO[bytes]]:
    """A file to be written under a temporary name in the same folder, and renamed where the block ends well.

    A process that is killed leaves what it had written: a file whose name ends with its number and ``.tmp``.

    Args:
        path: of the file; what is there already is replaced at the end, and lends its permissions, or stays as it is.

    Yields:
        What is written to.

    Raises:
        OSError: it cannot be written.
    """
    # A pipe or /dev/stdout is written to: a rename would put a file in its place.
    if path.exists() and not path.is_file():
        with path.open("wb") as file:
            yield file
        return
    # A link stays one.
    path = path.resolve()
    # With the process's number: two that write the same file do not write into one. Of a name that is nearly as long as
    # may be, the beginning.
    beginning = path.name.encode()[:_LONGEST_BEGINNING].decode(errors="ignore")
    temporary = path.with_name(f"{beginning}.{os.getpid()}{TEMPORARY}")
    try:
        with temporary.open("wb") as file:
            yield file
            file.flush()
            # Before the rename: otherwise a power cut could leave the name without the contents.
            os.fsync(file.fileno())
        if path.exists():
            # Those with whom a file is shared may write to it as before.
            shutil.copymode(path, temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def require_mapping(path: Path | str, value: Any, error: type[PotlpError], what: str) -> dict[str, Any]:
    """Check that the value of a file is entries by name, at every depth, as JSON could hold them.

    Args:
        path: the file, for the message.
        value: what was read from it; no deeper than `DEEPEST` levels.
        error: what is raised.
        what: that the file should have been, with its article.

    Returns:
        The value.

    Raises:
        PotlpError: of the kind ``error``: it is something else, or holds names that are no texts (YAML reads ``on`` and
            ``1`` as others), or whole numbers beyond 64 bits.
    """
    if not isinstance(value, dict):
        raise error.of_file(path, f"is not {what}: give a mapping of names to values, found {short(value)}")
    wrong = next(_not_json(value), None)
    if wrong is not None:
        raise error.of_file(path, f"is not {what}: {wrong}")
    return value


def _not_json(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        yield from (f"name {short(name)} is no text: put it in quotes" for name in value if not isinstance(name, str))
        yield from (f"name {short(name)} is too long" for name in value if len(str(name)) > _LONGEST_NAME)
        yield from (wrong for entry in value.values() for wrong in _not_json(entry))
    elif isinstance(value, list):
        yield from (wrong for entry in value for wrong in _not_json(entry))
    # Beyond 64 bits no setting has a meaning, and beyond 4,300 digits Python itself refuses to write a number.
    elif isinstance(value, int) and value.bit_length() > _LONGEST_INTEGER:
        yield "a whole number is beyond 64 bits"
