"""Logs of other programs: what they call their columns, what they leave out, how they tell time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from station.errors import WorkError
from station.runs.columns import REQUIRED, as_arrays
from station.runs.run import READ_AS, Run, RunMetadata
from station.runs.ticks import on_ticks

BEFOREHAND = tuple(name for name in REQUIRED if name != "reference")
"""Columns that must be there whatever the metadata say."""


def run_from(label: str, name: str, columns: Mapping[str, Any], metadata: RunMetadata,
             first_line: int | None = None) -> Run:
    """Build a run as ``Run.from_columns`` does, where the columns' names are those of a run.

    An open loop's reference is its command, and may be left out.  Times about a grid are put on it, and the metadata's
    ``read_as`` says so.
    """
    if "reference" not in columns and "command" in columns and metadata.controller.get("kind") == "open":
        columns = {**columns, "reference": columns["command"]}
    arrays, fault = as_arrays(columns, first_line)
    if fault:
        raise WorkError(f"{label}: {fault}")
    arrays, said = on_ticks(arrays, first_line)
    if said:
        metadata = metadata.model_copy(update={READ_AS: said})
    return Run.from_columns(label, name, arrays, metadata, first_line)
