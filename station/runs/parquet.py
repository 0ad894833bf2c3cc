"""Runs as Parquet: one column each, the metadata as JSON in the schema."""

from __future__ import annotations

import os
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from station.errors import WorkError
from station.runs.columns import MAX_ROWS, name_fault, own_names
from station.runs.files import check_input, new_file
from station.runs.foreign import BEFOREHAND, run_from
from station.runs.run import Run, RunMetadata

KEY = b"station"


def read_parquet(path: str | os.PathLike[str]) -> Run:
    """Read a run; WorkError, one line naming file and column, where the file is not one."""
    path = check_input(path)
    try:
        with pq.ParquetFile(path, arrow_extensions_enabled=False) as file:
            if file.metadata.num_rows > MAX_ROWS:
                raise WorkError(f"{path}: {file.metadata.num_rows} rows, at most {MAX_ROWS}")
            schema = file.schema_arrow
            names = own_names(schema.names)
            fault = name_fault(names, BEFOREHAND)
            if fault:
                raise WorkError(f"{path}: {fault}")
            for field in schema:
                if not (pa.types.is_floating(field.type) or pa.types.is_integer(field.type)):
                    raise WorkError(f"{path}: column {field.name}: {field.type} where numbers are wanted")
            metadata = (schema.metadata or {}).get(KEY, b"{}")
            table = file.read()
    except (pa.ArrowException, OSError, ValueError) as error:  # the last one: names that are not UTF-8
        raise WorkError(f"{path}: not a readable Parquet file ({str(error).splitlines()[0][:120]})") from None
    for name, column in zip(table.column_names, table.columns, strict=True):
        if column.null_count:
            raise WorkError(f"{path}: column {name}: {column.null_count} values are missing")
    columns = {name: column.to_numpy() for name, column in zip(names, table.columns, strict=True)}
    label = str(path)
    return run_from(label, path.stem, columns, RunMetadata.from_json(label, metadata.decode("utf-8", "replace")))


def write_parquet(run: Run, path: str | os.PathLike[str], overwrite: bool = False) -> None:
    """Write a run; numbers are kept bit by bit."""
    table = pa.table(run.columns()).replace_schema_metadata({KEY: run.metadata.to_json().encode()})
    with new_file(Path(path), overwrite) as part:
        pq.write_table(table, part, compression="zstd")
