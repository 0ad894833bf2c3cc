"""Where the loop's rows go.  ``station.runs.McapLogWriter`` is one; it writes behind a queue of its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from station.runs.columns import LOG_COLUMNS
from station.runs.run import Run, RunMetadata


class LogSink(Protocol):
    """Takes rows in the order of ``LOG_COLUMNS``; ``append`` must return at once, and raise when rows are lost."""

    def append(self, row: Sequence[float]) -> None:
        """Take one row."""

    def update(self, metadata: RunMetadata) -> None:
        """Replace the metadata, before ``close``."""

    def close(self) -> None:
        """Finish."""


class MemorySink:
    """Keeps the rows; ``run`` makes a Run of them."""

    def __init__(self, metadata: RunMetadata) -> None:
        self.metadata = metadata
        self.rows: list[Sequence[float]] = []
        self.closed = False
        self.append = self.rows.append

    def update(self, metadata: RunMetadata) -> None:
        """Replace the metadata."""
        self.metadata = metadata

    def close(self) -> None:
        """Nothing is left to write."""
        self.closed = True

    def run(self, name: str) -> Run:
        """The rows as a run; WorkError where there are fewer than two."""
        columns = np.array(self.rows, dtype=float).reshape(len(self.rows), len(LOG_COLUMNS))
        return Run.from_columns(name, name, dict(zip(LOG_COLUMNS, columns.T, strict=True)), self.metadata)
