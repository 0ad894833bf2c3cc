"""The CSV form of a run: ``# key = json`` lines, a line of column names, rows of numbers."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np

from station.errors import WorkError
from station.runs.columns import own_names
from station.runs.files import new_file
from station.runs.foreign import run_from
from station.runs.run import Run, RunMetadata, parse_json
from station.runs.table import read_table

_ENTRY = re.compile(r"\s*([A-Za-z_][A-Za-z0-9_.-]*)\s*=\s*(.+)\Z", re.DOTALL)


def read_csv(path: str | os.PathLike[str]) -> Run:
    """Read the CSV form; WorkError, one line naming file and line or column, where it is not that."""
    path = Path(path)
    table = read_table(path, ",", names_in_header=False)
    entries: dict[str, object] = {}
    for number, line in table.comments:
        match = _ENTRY.match(line)
        if not match:
            raise WorkError(f"{path}: line {number}: a header line reads '# key = JSON', not {line.strip()[:40]!r}; "
                            'keep a remark as # remark = "…", or take the line out')
        key, text = match.groups()
        if key in entries:
            raise WorkError(f"{path}: line {number}: the key {key} stands twice")
        entries[key] = parse_json(f"{path}: line {number}: {key}", text)
    metadata = RunMetadata.from_entries(str(path), entries)
    names = own_names(table.names)
    repeated = next((name for name in names if names.count(name) > 1), None)
    if repeated is not None:
        raise WorkError(f"{path}: the column {repeated[:40]!r} stands twice")
    columns = dict(zip(names, table.values.T, strict=True))
    return run_from(str(path), path.stem, columns, metadata, table.first_line)


def write_csv(run: Run, path: str | os.PathLike[str], overwrite: bool = False) -> None:
    """Write the CSV form; numbers are written so that reading gives them back bit by bit."""
    entries = json.loads(run.metadata.to_json())
    columns = run.columns()
    with new_file(path, overwrite) as part, part.open("w", encoding="utf-8", newline="\n") as file:
        for key, value in entries.items():
            if not _ENTRY.match(f"{key} = 0"):
                raise WorkError(f"{path}: the metadata key {key[:40]!r} cannot stand in a CSV header")
            file.write(f"# {key} = {json.dumps(value)}\n")
        file.write(",".join(columns) + "\n")
        for row in zip(*map(_texts, columns.values()), strict=True):
            file.write(",".join(row) + "\n")


def _texts(values: np.ndarray) -> list[str]:
    """The shortest text of each number that reads back as itself; whole numbers without a point."""
    return [repr(value).removesuffix(".0") for value in values.tolist()]
