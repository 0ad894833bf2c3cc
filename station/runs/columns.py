"""The columns of a run, defined once: every file form and every check derives from this table."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from station.errors import printable

MAX_ROWS = 10_000_000
MAX_EXTRA_COLUMNS = 64
SHOWN = 120
"""Letters of the column names found that a message shows."""


@dataclass(frozen=True)
class Column:
    """One column: unit, meaning, whether it holds integers, must be there, may hold NaN."""

    name: str
    unit: str
    meaning: str
    integer: bool = False
    required: bool = False
    gaps: bool = False


SENSORS: Final = ("encoder", "accel")
COLUMNS = (
    Column("t", "s", "index / sample_rate", required=True),
    Column("reference", "counts", "what the arm is asked to do", required=True),
    Column("command", "counts", "drive in force from this tick on", required=True),
    Column("encoder", "counts", "base angle", required=True),
    Column("accel", "counts", "tip acceleration"),
    Column("n", "", "the device's tick index", integer=True),
    Column("device_time", "s", "device ticks over nominal rate"),
    Column("host_time", "s", "host's monotonic clock on receipt"),
    Column("status", "bits", "status bits of the protocol", integer=True),
    Column("command_sent", "counts", "the host's answer to this sample", gaps=True),
    Column("latency", "s", "receipt to command sent", gaps=True),
    Column("slack", "s", "what was left of the period", gaps=True),
)
BY_NAME = {column.name: column for column in COLUMNS}
REQUIRED = tuple(column.name for column in COLUMNS if column.required)
OFF_TICK = 0.02
"""Share of a period by which a time may be off its tick."""
# The order of a row in the live log and the field numbers 1, 2, ... of its message: never reordered.
LOG_COLUMNS = ("n", "t", "reference", "command", "encoder", "accel", "device_time", "host_time", "status",
               "command_sent", "latency", "slack")

_EXTRA_NAME = re.compile(r"[a-z][a-z0-9_]{0,30}\Z")


def own_names(names: Iterable[str]) -> list[str]:
    """A file's column names, those of a run as they stand here: in any case, with blanks around, they are meant."""
    return [known if (known := name.strip().lower()) in BY_NAME else name for name in names]


def name_fault(names: Iterable[str], required: Iterable[str] = REQUIRED) -> str | None:
    """Say what is wrong with a file's column names, or None."""
    names = list(names)
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        return f"column {repeated[0]!r} stands twice"
    missing = [name for name in required if name not in names]
    if missing:
        return _missing(missing[0], names)
    extra = [name for name in names if name not in BY_NAME]
    if len(extra) > MAX_EXTRA_COLUMNS:
        return f"{len(extra)} columns beyond those of a run, at most {MAX_EXTRA_COLUMNS}"
    for name in extra:
        if not _EXTRA_NAME.match(name) or name == "metadata":
            return (f"column name {name[:40]!r}: a-z, 0-9 and _ alone, at most 31 letters, beginning with a-z; rename "
                    "it or leave it out")
    return None


def _missing(name: str, names: list[str]) -> str:
    found = printable(", ".join(names))
    found = found if len(found) <= SHOWN else found[:SHOWN] + " ..."
    said = (f"column {name} is missing; wanted are {', '.join(REQUIRED)}, found are {found}; a CSV's header line reads "
            f"{','.join(REQUIRED)}")
    if name != "reference":
        return said
    return (f'{said}; where no loop was closed, the metadata controller = {{"kind": "open"}} (of a CSV the line # '
            'controller = {"kind": "open"}) make the command the reference; where one was closed and nobody '
            'knows it, a reference of zeros will do')


def place(row: int, first_line: int | None = None) -> str:
    """Where a row is, for people: rows count from 0 as ticks do, the lines of a file of text from 1."""
    return f"row {row}" if first_line is None else f"line {first_line + row}"


def as_columns(columns: Mapping[str, object], first_line: int | None = None,
               ) -> tuple[dict[str, np.ndarray], str | None]:
    """Columns as float64 arrays (integer columns: int64); the second value says what is wrong, or None.

    ``first_line``: that of row 0, where the columns come from lines of text.
    """
    arrays, fault = as_arrays(columns, first_line)
    return arrays, fault or time_fault(arrays["t"], arrays.get("n"), first_line)


def as_arrays(columns: Mapping[str, object], first_line: int | None = None,
              ) -> tuple[dict[str, np.ndarray], str | None]:
    """The same, but that the times are not looked at."""
    fault = name_fault(columns)
    if fault:
        return {}, fault
    arrays: dict[str, np.ndarray] = {}
    for name, values in columns.items():
        try:
            array = np.asarray(values)
            if np.iscomplexobj(array):
                return {}, f"column {name}: complex numbers where real ones are wanted; save real({name}) in its place"
            if BY_NAME.get(name, COLUMNS[0]).integer and array.dtype.kind in "iu":
                array = array.astype(np.int64)
            else:
                array = array.astype(np.float64)
        except (TypeError, ValueError, OverflowError):
            return {}, f"column {name}: not numbers"
        if array.ndim != 1:
            return {}, f"column {name}: one dimension is wanted, not {array.ndim}"
        arrays[name] = array
    rows = len(arrays["t"])
    if not 2 <= rows <= MAX_ROWS:
        return {}, f"{rows} rows; a run has 2 to {MAX_ROWS}"
    for name, array in arrays.items():
        if len(array) != rows:
            return {}, f"column {name} has {len(array)} rows, t has {rows}"
        column = BY_NAME.get(name)
        bad = np.isinf(array) if column is not None and column.gaps else ~np.isfinite(array)
        if bad.any():
            row = int(np.argmax(bad))
            return {}, (f"column {name}, {place(row, first_line)}: {array[row]} where a finite number is wanted; leave "
                        "out the row or write a number there")
        if column is not None and column.integer and array.dtype.kind == "f":
            bad = (array != np.floor(array)) | (np.abs(array) > 2.0**53)
            if bad.any():
                row = int(np.argmax(bad))
                return {}, f"column {name}, {place(row, first_line)}: {array[row]} where a whole number is wanted"
            arrays[name] = array.astype(np.int64)
    return arrays, None


def time_fault(t: np.ndarray, n: np.ndarray | None, first_line: int | None = None) -> str | None:
    """Say where t is not index / sample_rate, or None.  The index is n where there is one: ticks may be lost."""
    index = np.arange(len(t)) if n is None else n
    steps = np.diff(index)
    if np.any(steps <= 0):
        return f"column n, {place(int(np.argmax(steps <= 0)) + 1, first_line)}: the index does not rise"
    index = index - index[0]
    period = (t[-1] - t[0]) / index[-1]
    if period <= 0.0:
        return "column t: time does not rise"
    if np.any(np.abs(t - t[0] - index * period) > OFF_TICK * period):
        pace = np.diff(t) / steps
        row = int(np.argmax(np.abs(pace - np.median(pace)))) + 1
        found = f"irregular time ({t[row]:.9g} s after {t[row - 1]:.9g} s, {np.median(pace):.6g} s is usual)"
        remedy = ("add a column n with each row's tick, or resample the log" if n is None else
                  "write t as n / sample_rate, or resample the log")
        return f"column t, {place(row, first_line)}: {found}; t must be index / sample_rate: {remedy}"
    return None
