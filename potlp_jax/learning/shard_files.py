"""One Parquet file of a shard: written whole or not at all, and read a piece at a time with every check."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from potlp_jax.errors import DatasetError
from potlp_jax.files import reading, require_file, whole_file
from potlp_jax.learning.dataset_metadata import DatasetMetadata

_METADATA_KEY = b"potlp"

# Rows of a file, and bytes, that are read at once.
_ROWS = 64
_BUFFER = 1 << 20

_REMEDY = "delete all files of the shard and collect or convert it again"


def write_table(path: Path, columns: Mapping[str, Any], schema: pa.Schema, metadata: DatasetMetadata) -> None:
    """Write a file, all of it or none (``files.whole_file``).

    Args:
        path: the file.
        columns: by the schema's names.
        schema: of the columns.
        metadata: what the file says of its dataset.
    """
    table = pa.Table.from_pydict(dict(columns), schema.with_metadata({_METADATA_KEY: metadata.to_json().encode()}))
    with whole_file(path) as file:
        # With checksums of the pages, so that a flipped bit is found when they are read.
        pq.write_table(table, file, compression="zstd", write_page_checksum=True)


def metadata_of(path: Path) -> DatasetMetadata:
    """What a file says of its dataset. Raises DatasetError where it cannot be read or has none."""
    text = (_schema_of(path).metadata or {}).get(_METADATA_KEY)
    if text is None:
        raise DatasetError(f"{path} has no metadata of a dataset in its schema (key '{_METADATA_KEY.decode()}')")
    try:
        return DatasetMetadata.from_json(text.decode("utf-8", "replace"))
    except DatasetError as error:
        raise DatasetError(f"{path}: {error}") from error


def checked_rows(path: Path, schema: pa.Schema, columns: Sequence[str]) -> Iterator[pa.RecordBatch]:
    """The rows of a file, some at a time, each checked.

    Args:
        path: the file.
        schema: columns that it must have; it may have others.
        columns: names of those that are read.

    Returns:
        Batches of at least one row.

    Raises:
        DatasetError: the file cannot be read, is damaged, or has other columns or missing values.
    """
    found = _schema_of(path)
    wrong = [field.name for field in schema if field.name not in found.names or found.field(field.name) != field]
    # More columns than the schema's are no harm: data from elsewhere may keep what they need.
    if wrong:
        raise broken_shard(path, f"has other columns than the schema: {', '.join(wrong)}")
    # Through a buffer, and not a file's column as a whole: a shard may be larger than memory.
    options: dict[str, Any] = {"buffer_size": _BUFFER, "pre_buffer": False, "page_checksum_verification": True}
    with _reading(path), pq.ParquetFile(path, **options) as file:
        for rows in file.iter_batches(_ROWS, columns=list(columns), use_threads=False):
            # Offsets that point beyond their values would be followed later.
            rows.validate(full=True)
            # In lists as well: an array of numbers has no place for them.
            if any(
                column.null_count or (pa.types.is_list(column.type) and column.flatten().null_count)
                for column in rows.columns
            ):
                raise broken_shard(path, "has missing values")
            if len(rows):
                yield rows


def read_table(path: Path, schema: pa.Schema) -> pa.Table:
    """All rows of a file, checked as ``checked_rows`` does."""
    return pa.Table.from_batches(checked_rows(path, schema, schema.names), schema)


def broken_shard(path: Path, why: str) -> DatasetError:
    """The error about a file that is damaged or does not fit the others of its shard; it says what to do."""
    return DatasetError(f"{path} {why}: {_REMEDY}")


def _schema_of(path: Path) -> pa.Schema:
    if not path.exists():
        raise broken_shard(path, "is missing")
    require_file(path, DatasetError)
    with _reading(path):
        return pq.read_schema(path)


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    """As ``files.reading``, with what to do about a shard that is damaged."""
    try:
        with reading(path, DatasetError, "a shard of a dataset"):
            yield
    except DatasetError as error:
        # What was found in it says so already.
        if str(error).endswith(_REMEDY):
            raise
        raise DatasetError(f"{error}: {_REMEDY}") from error
