"""The native form of a run: one MCAP file of protobuf messages, appended as the run goes.

The file is a header, a metadata record, then small chunks, each on its way to the disk within 25 ms; the first chunk
holds both message descriptions and the metadata once more.  It can be read to its last whole record whatever happens to
the rest (``mcap_read.py``).
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import monotonic
from types import TracebackType

import numpy as np
from mcap.writer import LIBRARY_IDENTIFIER

from station.errors import WorkError
from station.runs.blueprint import blueprint_path, write_blueprint
from station.runs.columns import LOG_COLUMNS, name_fault
from station.runs.files import check_output, new_file, reason
from station.runs.mcap_chunks import ChunkWriter, RowLayout, Stream
from station.runs.notes import set_notes_aside
from station.runs.run import Run, RunMetadata
from station.runs.schema import (
    METADATA,
    METADATA_RECORD,
    SAMPLE,
    message_class,
    metadata_schema,
    sample_fields,
    sample_schema,
)

FLUSH_SECONDS = 0.025
"""Half of the 50 ms that a killed host may lose: a busy machine wakes the thread late."""
DUE_SECONDS = 0.02
"""From then on the next row wakes the thread: a row comes when its sample has been answered, and until the next sample
the thread has the interpreter to itself.  Where it wakes by itself it may hold up an answer."""
SYNC_SECONDS = 1.0
CAPACITY = 65536
_NEVER = float("inf")
BLOCK_ROWS = 4096
"""Most rows of one chunk."""


class _Encoder:
    """Rows and metadata into MCAP records on a stream."""

    def __init__(self, stream: Stream, metadata: RunMetadata, columns: Sequence[str]) -> None:
        self.columns = tuple(columns)
        self.rows = 0
        self._now = 0
        self._metadata = message_class(METADATA, metadata_schema())
        self._writer = ChunkWriter(stream, f"station {LIBRARY_IDENTIFIER}")
        self._record(metadata)
        self._sample_channel = self._writer.register("/sample", SAMPLE, sample_schema(self.columns))
        self._metadata_channel = self._writer.register("/metadata", METADATA, metadata_schema())
        self._layout = RowLayout(self._sample_channel, sample_fields(self.columns))
        self._message(metadata)

    def _record(self, metadata: RunMetadata) -> None:
        self._writer.add_metadata(METADATA_RECORD, {"json": metadata.to_json()})

    def _message(self, metadata: RunMetadata) -> None:
        data = self._metadata(json=metadata.to_json()).SerializeToString()
        self._writer.message(self._metadata_channel, data, self._now)

    def block(self, columns: Mapping[str, np.ndarray]) -> None:
        """One chunk of rows."""
        times = np.maximum(np.rint(columns["t"] * 1e9), 0.0).astype(np.int64)
        records = self._layout.lay(columns, times, self.rows)
        self._writer.chunk(self._sample_channel, records.tobytes(), times,
                           records.itemsize * np.arange(len(times), dtype=np.int64))
        self.rows += len(times)
        self._now = int(times[-1])

    def rows_of(self, rows: Sequence[Sequence[float]]) -> None:
        """One chunk of rows in the order of ``columns``; ValueError where one has another length."""
        values = np.array(rows, dtype=np.float64)
        if values.ndim != 2 or values.shape[1] != len(self.columns):
            raise ValueError(f"a row of {len(self.columns)} values is wanted")
        self.block(dict(zip(self.columns, values.T, strict=True)))

    def finish(self, changed: RunMetadata | None) -> None:
        if changed is not None:
            self._message(changed)
            self._record(changed)
        self._writer.finish()


class _Pieces:
    """A file that grows by whole pieces: what was written since the last ``commit`` is in the file, or not at all.

    On a full disk, the file is cut back to the last whole piece.
    """

    def __init__(self, path: Path, mode: str) -> None:
        self._file = path.open(mode, buffering=0)
        self._piece = bytearray()
        self._whole = 0

    def write(self, data: bytes) -> int:
        """Take bytes of the piece."""
        self._piece += data
        return len(data)

    def flush(self) -> None:
        """Bytes wait for ``commit``."""

    def tell(self) -> int:
        """Bytes taken so far."""
        return self._whole + len(self._piece)

    def commit(self) -> None:
        """Write the piece; OSError where it is not wholly in the file, which then ends before it."""
        piece = memoryview(self._piece)
        try:
            written = 0
            while written < len(piece):
                written += self._file.write(piece[written:]) or 0
        except OSError:
            with contextlib.suppress(OSError):
                self._file.truncate(self._whole)
            raise
        self._whole += len(piece)
        piece.release()
        self._piece = bytearray()

    def sync(self) -> None:
        """Have the system put it on the disk."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()


def _free(old: Path) -> Path:
    """Where a log that is to be replaced may wait; WorkError where one waits that never was."""
    if old.exists():
        raise WorkError(f"{old}: an older log; the test that was to replace it was cut off before its first row; "
                        "rename or remove it first")
    return old


class McapLogWriter:
    """Write a run as it goes, off the sample path.

    ``append`` puts a row on a bounded queue and returns; a thread writes the rows every 25 ms and syncs the file once
    a second.  No row is ever dropped: where the queue is full, the disk does not keep up, and ``append`` raises
    WorkError, which ends the test; what waits is still written at ``close``.  A run in virtual time, whose device
    waits for the host, waits for the disk instead (``waits`` counts how often).  When the disk fails, the next
    ``append`` or ``close`` raises WorkError; what was written stays readable, and ``rows_written`` says how many rows
    that are.  A log without any row is removed at ``close``.  Where it is to replace another (``overwrite``), that one
    waits beside it, as ``.old``, until there are rows; without any it is put back.

    ``columns`` names the values of a row; the default is LOG_COLUMNS (n, t, reference, command, encoder, accel,
    device_time, host_time, status, command_sent, latency, slack).  n and status are integers; command_sent,
    latency and slack may be NaN.  ``metadata`` may be replaced until ``close`` (``update``).
    """

    def __init__(self, path: str | os.PathLike[str], metadata: RunMetadata, *,
                 columns: Sequence[str] = LOG_COLUMNS, capacity: int = CAPACITY, overwrite: bool = False,
                 blueprint: bool = True) -> None:
        self.path = check_output(path, overwrite)
        fault = name_fault(columns)
        if fault:
            raise WorkError(f"{self.path}: {fault}")
        self.waits = 0
        self.rows_written = 0
        self._may_wait = metadata.entries().get("clock", "virtual") == "virtual"
        self._capacity, self._blueprint, self._overwrite = capacity, blueprint, overwrite
        self._queue: deque[Sequence[float]] = deque()
        self._columns = tuple(columns)
        self._changed: RunMetadata | None = None
        self._failure: Exception | None = None
        self._taken = 0  # rows that have left the queue
        self._due = 0.0  # when the next row is to wake the thread
        self._closing = False
        self._wake, self._drained = threading.Event(), threading.Event()
        self._old: Path | None = None
        try:
            if overwrite and self.path.exists():
                self._old = self.path.replace(_free(self.path.with_name(f"{self.path.name}.old")))
            self._file = _Pieces(self.path, "xb")
        except OSError as error:
            self._put_back()
            raise WorkError(f"{self.path}: cannot be written ({reason(error)})") from None
        try:
            self._encoder = _Encoder(self._file, metadata, self._columns)
            self._file.commit()
            self._file.sync()
        except BaseException as error:  # Ctrl-C, too
            self._file.close()
            self._remove()
            if isinstance(error, OSError):
                raise WorkError(f"{self.path}: cannot be written ({reason(error)})") from None
            raise
        self._thread = threading.Thread(target=self._work, name="station-log", daemon=True)
        self._thread.start()

    def _remove(self) -> None:
        """Take a log without rows away again."""
        self.path.unlink(missing_ok=True)
        self._put_back()

    def _put_back(self) -> None:
        if self._old is not None:
            self._old.replace(self.path)

    def _replace_old(self) -> None:
        """The log has rows: the one that it replaces goes, and what had been noted on that one."""
        old, self._old = self._old, None
        if old is not None:
            with contextlib.suppress(OSError):
                old.unlink()
            set_notes_aside(self.path)

    def append(self, row: Sequence[float]) -> None:
        """Take one row (a tuple in the order of ``columns``)."""
        if self._closing:
            raise WorkError(f"{self.path}: the log is closed")
        self._queue.append(row)
        if monotonic() >= self._due:
            self._due = _NEVER
            self._wake.set()
        if len(self._queue) >= self._capacity:
            self._full()
        if self._failure is not None:
            raise self._failed()

    def _full(self) -> None:
        if not self._may_wait:
            raise WorkError(f"{self.path}: the disk does not keep up, {len(self._queue)} rows wait for it; "
                            "log to a faster one")
        self.waits += 1
        while len(self._queue) >= self._capacity and self._failure is None:
            self._drained.clear()
            self._wake.set()
            self._drained.wait(0.01)

    def update(self, metadata: RunMetadata) -> None:
        """Replace the metadata; written at ``close``."""
        self._changed = metadata

    def _failed(self) -> WorkError:
        lost = self._taken + len(self._queue) - self.rows_written
        return WorkError(f"{self.path}: the log cannot be written ({reason(self._failure)}); "
                         f"{self.rows_written} rows are in the file, {lost} are lost")

    def _work(self) -> None:
        try:
            synced = monotonic()
            while True:
                closing = self._closing
                self._wake.wait(0.0 if closing else FLUSH_SECONDS)
                self._wake.clear()
                self._due = monotonic() + DUE_SECONDS
                self._drain()
                if closing:
                    return
                if monotonic() - synced >= SYNC_SECONDS:
                    self._file.sync()
                    synced = monotonic()
        except Exception as error:  # whatever it was, the thread that appends must hear of it
            self._failure = error
            self._drained.set()

    def _drain(self) -> None:
        queue = self._queue
        waiting = len(queue)
        while waiting:
            rows = [queue.popleft() for _ in range(min(waiting, BLOCK_ROWS))]
            waiting -= len(rows)
            self._taken += len(rows)
            self._encoder.rows_of(rows)
            self._file.commit()
            self.rows_written += len(rows)
            self._drained.set()
            self._replace_old()

    def close(self, metadata: RunMetadata | None = None) -> None:
        """Write what is left, the closing records and the blueprint; ``metadata`` replaces the first one."""
        if self._closing:
            return
        if metadata is not None:
            self.update(metadata)
        self._closing = True
        self._wake.set()
        self._thread.join()
        try:
            if self._failure is None:
                self._encoder.finish(self._changed)
                self._file.commit()
                self._file.sync()
        except OSError as error:
            self._failure = error
        finally:
            try:
                self._file.close()
            except OSError as error:
                self._failure = self._failure or error
        if not self.rows_written:
            self._remove()
        if self._failure is not None:
            raise self._failed()
        if self.rows_written and self._blueprint:
            _draw(self.path, self._columns, self._overwrite)

    def __enter__(self) -> McapLogWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        try:
            self.close()
        except WorkError:
            if error is None:
                raise


def write_mcap(run: Run, path: str | os.PathLike[str], overwrite: bool = False, blueprint: bool = True) -> None:
    """Write a whole run in the native form, and its blueprint beside it."""
    path = Path(path)
    columns = run.columns()
    with new_file(path, overwrite) as part, part.open("wb") as file:
        encoder = _Encoder(file, run.metadata, tuple(columns))
        for start in range(0, len(run), BLOCK_ROWS):
            encoder.block({name: values[start:start + BLOCK_ROWS] for name, values in columns.items()})
        encoder.finish(None)
    if blueprint:
        _draw(path, tuple(columns), overwrite)


def _draw(log: Path, columns: Sequence[str], overwrite: bool) -> None:
    """Write a log's blueprint beside it.  A file of that name that is there already stays, unless ``overwrite``."""
    path = blueprint_path(log)
    if path.exists() and not overwrite:
        return
    try:
        write_blueprint(path, columns)
    except WorkError as error:
        raise WorkError(f"{error}; the log {log} is whole without it") from None
