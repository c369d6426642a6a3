"""Tables of metrics and timings: Arrow schemas and Parquet folders that many processes append to, a file a writer.

Read in one line: `duckdb.sql("select * from 'runs/metrics/*.parquet'")` or `pandas.read_parquet("runs/metrics")`.
A value that doesn't apply or wasn't measured is null.
"""

from __future__ import annotations

import hashlib
import os
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from schemas.documents import checked_name, sync_folder
from schemas.errors import StoreError

#: Entry of a file's metadata that holds the checksum of its rows; files of other programs have none.
SEAL = b"rows_sha256"
#: Files that say more are not read: a few bytes can stand for any number of equal rows.
MAX_ROWS = 10_000_000


def column(name: str, kind: pa.DataType, meaning: str, unit: str = "", required: bool = False) -> pa.Field:
    """A column that says what it means and in which unit."""
    return pa.field(name, kind, nullable=not required, metadata={"meaning": meaning, "unit": unit})


_WHAT = (
    column("scene_id", pa.string(), "scene", required=True),
    column("dataset", pa.string(), "data set the scene belongs to"),
    column("run", pa.string(), "run of the scene: a split and a method"),
    column("method", pa.string(), "zipnerf, cat3d, or the name of an ablation"),
    column("split", pa.string(), "captured views trained on: 1, 3, 6, 9, all, or the name of a split file"),
    column("seed", pa.int64(), "seed of the run"),
    column("key", pa.string(), "content key of the stage that made the row", required=True),
    column("code_version", pa.string(), "version of the code that made the row"),
)


def metrics_schema(columns: Sequence[pa.Field]) -> pa.Schema:
    """The table of metrics, a row for one rendered view under one protocol, with the columns of these metrics (see
    `column`)."""
    return pa.schema(
        [
            *_WHAT,
            column("protocol", pa.string(), "how the metrics are computed: google, regnerf, …", required=True),
            column("view", pa.int32(), "index of the captured view", required=True),
            column("view_name", pa.string(), "source name of the view"),
            column("width", pa.int32(), "width of the compared images", "px", required=True),
            column("height", pa.int32(), "height of the compared images", "px", required=True),
            *columns,
            column("masked", pa.bool_(), "whether a mask was applied"),
        ],
        metadata={"format": "cat3d-metrics", "schema_version": "2", "row": "one rendered view under one protocol"},
    )


TIMINGS = pa.schema(
    [
        *_WHAT,
        column("stage", pa.string(), "stage of the pipeline", required=True),
        column("started_at", pa.timestamp("us", "UTC"), "start", "s", required=True),
        column("seconds", pa.float64(), "wall time of the execution", "s", required=True),
        column("skipped", pa.bool_(), "the stage was complete already and did nothing"),
        column("views", pa.int64(), "views read or made", "1"),
        column("rays", pa.int64(), "rays cast", "1"),
        column("evaluations", pa.int64(), "evaluations of the network or field", "1"),
        column("steps", pa.int64(), "optimisation or sampler steps", "1"),
        column("bytes_written", pa.int64(), "bytes written to the store", "B"),
        column("peak_memory_bytes", pa.int64(), "largest resident or device memory", "B"),
        column("workers", pa.int32(), "processes that shared the work", "1"),
        column("device", pa.string(), "cpu, or the name of the accelerator"),
        column("host", pa.string(), "name of the machine"),
    ],
    metadata={"format": "cat3d-timings", "schema_version": "1", "row": "one execution of one stage"},
)


def append_rows(folder: str | Path, schema: pa.Schema, rows: Sequence[Mapping[str, Any]], name: str) -> Path:
    """Write rows as `folder/name.parquet`, whole or not at all; returns the file.

    The same name replaces the earlier file, so that a stage that runs again doesn't count twice: make the name of
    what the rows describe. Raises StoreError for a column the schema doesn't have, a missing required value or a
    wrong type.
    """
    folder = Path(folder)
    path = folder / f"{checked_name(name)}.parquet"
    for i, row in enumerate(rows):
        unknown = sorted(set(row) - set(schema.names))
        if unknown:
            raise StoreError(f"Row {i} for {path} has the columns {unknown}, which the schema doesn't know.")
        missing = [f.name for f in schema if not f.nullable and row.get(f.name) is None]
        if missing:
            raise StoreError(f"Row {i} for {path} has no value for {missing}, which every row needs.")
    try:
        table = pa.Table.from_pylist([dict(row) for row in rows], schema=schema)
    except (pa.ArrowInvalid, pa.ArrowTypeError) as error:
        raise StoreError(f"The rows for {path} don't fit the schema: {error}.") from error
    table = table.replace_schema_metadata({**(schema.metadata or {}), SEAL: _digest(table)})
    folder.mkdir(parents=True, exist_ok=True)
    temporary = folder / f".{path.name}.{uuid.uuid4().hex}.partial"  # readers pass over names that start with a dot
    try:
        with temporary.open("wb") as file:
            pq.write_table(table, file, compression="zstd", write_page_checksum=True)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise StoreError(f"Writing {path} failed: {error.strerror or error}.") from error
    finally:
        temporary.unlink(missing_ok=True)
    sync_folder(folder)
    return path


def read_rows(folder: str | Path, schema: pa.Schema | None = None) -> pa.Table:
    """All rows of a folder, in the order of the files' names. Columns a file lacks are null, types are widened.

    With `schema`, an empty or missing folder gives an empty table of it. Raises StoreError naming a damaged file.
    """
    folder = Path(folder)
    tables = [_read_file(path) for path in sorted(folder.glob("[!._]*.parquet"))]
    if not tables:
        if schema is None:
            raise StoreError(f"{folder} holds no tables.")
        return schema.empty_table()
    try:
        return pa.concat_tables(tables, promote_options="permissive")
    except pa.ArrowException as error:
        raise StoreError(f"The tables in {folder} don't go together: {error}.") from error


def _read_file(path: Path) -> pa.Table:
    try:
        file = pq.ParquetFile(path, page_checksum_verification=True)
        if file.metadata.num_rows > MAX_ROWS:
            raise pa.ArrowInvalid(f"it says that it has {file.metadata.num_rows} rows, and none of ours has {MAX_ROWS}")
        table = file.read()
        metadata = dict(table.schema.metadata or {})
        sealed = metadata.pop(SEAL, None)
        if sealed is not None and sealed != _digest(table):
            raise pa.ArrowInvalid("its rows don't match their checksum")
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        raise StoreError(f"{path} is damaged: {error}. Remove it and evaluate again.") from error
    return table.replace_schema_metadata(metadata)


def _digest(table: pa.Table) -> bytes:
    """Checksum of names and values: Parquet's own are of the pages, not of the footer that says what they mean."""
    return hashlib.sha256(repr(table.to_pydict()).encode()).hexdigest().encode()
