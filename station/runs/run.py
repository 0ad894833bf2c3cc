"""A run: one test on a device, logged; its columns and what is known about it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from station import markup
from station.errors import WorkError
from station.runs.columns import COLUMNS, as_columns

MAX_METADATA_BYTES = 1 << 20
LOST = "lost"
"""Extra column of a filled run: 1 where the log has no such row."""
READ_AS = "read_as"
"""Key of the metadata: what reading made of a log that does not quite have the form of a run, for people."""
BETWEEN = frozenset({"t", "encoder", "accel", "device_time", "host_time"})
"""Columns of which a lost row lies between its neighbours; the others keep what was logged last."""
SENT = frozenset({"command", "reference"})
"""Columns that went on between the rows of a log of every other tick."""
HELD = 5
"""Ticks for which a device holds a command at most (the protocol's ``hold_ticks_max``)."""
RATES = 0.01
"""Largest share by which a run's sample rate may differ from the rig's."""


class RunMetadata(BaseModel):
    """What is known about a run; unknown keys are kept as they are.

    A log that names no ``controller`` has an unknown one: its commands are known, not what worked them out.
    ``rounding`` is False where the logged command was not rounded; ``accel_zero`` (counts) is the
    accelerometer's mean at rest that the compensator took off; ``command_limit`` (counts) is what cut the commands,
    where the log says it: the rig's, or less.
    """

    model_config = ConfigDict(extra="allow")

    rig: str | dict[str, Any] = ""
    controller: dict[str, Any] = Field(default_factory=lambda: {"kind": "unknown"})
    test: dict[str, Any] = Field(default_factory=dict)
    firmware: dict[str, Any] | str | None = None
    versions: dict[str, str] | None = None
    session: int | None = None
    zero_id: str | None = None
    start: Literal["released", "equilibrium"] = "released"
    command_row: int = Field(default=0, ge=-8, le=0)
    rounding: bool = True
    accel_zero: float = Field(default=0.0, allow_inf_nan=False)
    command_limit: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)

    def entries(self) -> dict[str, Any]:
        """The keys that say something: those declared and not None, then the unknown ones kept."""
        return {key: value for key, value in self if value is not None or key not in type(self).model_fields}

    def to_json(self) -> str:
        """One line of JSON; WorkError when it is too large or holds what JSON cannot."""
        try:
            text = json.dumps(self.entries(), allow_nan=False, default=_plain)
        except (TypeError, ValueError, RecursionError) as error:
            raise WorkError(f"metadata: {error}") from None
        if len(text) > MAX_METADATA_BYTES:
            raise WorkError(f"metadata: {len(text)} bytes, at most {MAX_METADATA_BYTES}")
        return text

    @classmethod
    def from_entries(cls, label: str, entries: Mapping[str, Any]) -> RunMetadata:
        """Build from a file's keys; ``label`` names the file in the one line of a WorkError."""
        try:
            return cls(**entries)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            key = ".".join(str(part) for part in first["loc"])
            raise WorkError(f"{label}: metadata {key}: {first['msg']}") from None

    @classmethod
    def from_json(cls, label: str, text: str) -> RunMetadata:
        """Parse what to_json wrote; WorkError with one line otherwise."""
        entries = parse_json(f"{label}: metadata", text)
        if not isinstance(entries, dict):
            raise WorkError(f"{label}: metadata: an object is wanted")
        return cls.from_entries(label, entries)


def _whole(values: np.ndarray) -> bool:
    """Whether all are whole numbers, but for what arithmetic makes of their last digits."""
    return bool(np.allclose(values, np.rint(values), rtol=0.0, atol=1e-6))


def _plain(value: Any) -> Any:
    """numpy's numbers and arrays as JSON's."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")


def _not_a_number(text: str) -> Any:
    raise ValueError(f"{text} is not JSON")


def _finite(text: str) -> float:
    value = float(text)
    if not np.isfinite(value):
        raise ValueError(f"{text[:20]} is too large")
    return value


def parse_json(label: str, text: str) -> Any:
    """JSON without NaN and infinity and of bounded size; WorkError in one line otherwise."""
    if len(text) > MAX_METADATA_BYTES:
        raise WorkError(f"{label}: {len(text)} bytes, at most {MAX_METADATA_BYTES}")
    try:
        return json.loads(text, parse_constant=_not_a_number, parse_float=_finite)
    except (ValueError, RecursionError) as error:
        raise WorkError(f"{label}: not JSON ({error})") from None


@dataclass(frozen=True, eq=False)
class Run:
    """Columns are one-dimensional arrays of equal length, floats (n and status: integers); units in ``columns.py``.

    ``extra`` holds a log's columns beyond those of every run, by name.  Raises WorkError, one line that names
    run, column and row (from 0), where lengths differ, a number is not finite or time is irregular.
    """

    name: str
    t: np.ndarray
    reference: np.ndarray
    command: np.ndarray
    encoder: np.ndarray
    accel: np.ndarray | None = None
    metadata: RunMetadata = field(default_factory=RunMetadata)
    n: np.ndarray | None = None
    device_time: np.ndarray | None = None
    host_time: np.ndarray | None = None
    status: np.ndarray | None = None
    command_sent: np.ndarray | None = None
    latency: np.ndarray | None = None
    slack: np.ndarray | None = None
    extra: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        arrays, fault = as_columns(self.columns())
        if fault:
            raise WorkError(f"{self.name}: {fault}")
        for column in COLUMNS:
            object.__setattr__(self, column.name, arrays.pop(column.name, None))
        object.__setattr__(self, "extra", arrays)

    @classmethod
    def from_columns(cls, label: str, name: str, columns: Mapping[str, Any], metadata: RunMetadata,
                     first_line: int | None = None) -> Run:
        """Build from a file's columns; ``label`` (the path) stands before what a WorkError says.

        ``first_line``: the line of row 0, of a file of text, in which people look for lines.
        """
        arrays, fault = as_columns(columns, first_line)
        if fault:
            raise WorkError(f"{label}: {fault}")
        known = {column.name: arrays.pop(column.name) for column in COLUMNS if column.name in arrays}
        return cls(name=name, metadata=metadata, extra=arrays, **known)

    def columns(self) -> dict[str, np.ndarray]:
        """The columns that this run has, in the order of ``COLUMNS``, then the extra ones."""
        known = {column.name: getattr(self, column.name) for column in COLUMNS}
        return {name: values for name, values in known.items() if values is not None} | dict(self.extra)

    def __len__(self) -> int:
        return len(self.t)

    @property
    def sample_rate(self) -> float:
        """Nominal rate, Hz, from the time column; nine digits, so that 1/0.002 is 500."""
        rows = len(self.t) - 1 if self.n is None else int(self.n[-1] - self.n[0])
        return float(f"{rows / (self.t[-1] - self.t[0]):.9g}")

    def rate_fault(self, rate: float) -> str | None:
        """Say where the log has neither a row for each tick of a rig's ``rate`` (Hz) nor for every other one, or None.

        What to do is in it; times a thousand or a million times too long are in other units.
        """
        if min(abs(rows * self.sample_rate / rate - 1.0) for rows in (1.0, 2.0)) <= RATES:
            return None
        remedy = (f"a log wants a row for each tick of the loop, or for every other one ({rate:.6g} or "
                  f"{0.5 * rate:.6g} Hz); log so, or give the rig file the sample_rate at which the loop ran")
        for unit, factor in (("ms", 1e3), ("us", 1e6)):
            if any(abs(rows * factor * self.sample_rate / rate - 1.0) <= RATES for rows in (1.0, 2.0)):
                remedy = f"t looks like {unit} and must be in s; divide it by {factor:.0f}"
        return f"sampled at {self.sample_rate:.6g} Hz, the rig at {rate:.6g} Hz: {remedy}"

    @property
    def command_row(self) -> int:
        """0, or -k where row i's command was computed from the encoder and accelerometer of row i - k."""
        return self.metadata.command_row

    @property
    def start(self) -> str:
        """How the run begins: ``released`` or ``equilibrium``."""
        return self.metadata.start

    @property
    def read_as(self) -> str:
        """What reading made of the log, for people; empty where it was taken as it stands."""
        return str(self.metadata.entries().get(READ_AS) or "")

    @property
    def open_loop(self) -> bool:
        """Whether no loop was closed: the log says so, or names no controller and its commands are its reference."""
        kind = self.metadata.controller.get("kind")
        return kind == "open" or (kind == "unknown" and np.array_equal(self.command, self.reference))

    @property
    def loop_unknown(self) -> bool:
        """Whether a loop was closed, and nothing says by what."""
        return self.metadata.controller.get("kind") == "unknown" and not self.open_loop

    @property
    def lost_samples(self) -> int:
        """Ticks between first and last row that the log does not have."""
        return 0 if self.n is None else int(self.n[-1] - self.n[0]) + 1 - len(self)

    def require_unbroken(self) -> None:
        """Raise WorkError where a tick is missing: row i must be tick i for what follows."""
        if self.lost_samples:
            row = int(np.argmax(np.diff(self.n) > 1)) + 1
            raise WorkError(f"{self.name}: {self.lost_samples} samples lost, the first before row {row}; "
                            f"use the rows before it (station trim --to {self.t[row - 1]:g}; Run.slice(0, {row}))")

    def _repr_html_(self) -> str:
        known = self.metadata
        head = markup.table(("run", "test", "controller", "rows", "Hz", "lost"), [
            (self.name, known.test.get("kind", "-"), known.controller.get("kind", "-"), len(self),
             f"{self.sample_rate:g}", self.lost_samples)], self.read_as)
        angle = {"encoder": self.encoder} if self.open_loop else {"reference": self.reference, "encoder": self.encoder}
        plots = [markup.legend(angle), markup.plot(self.t, angle, f"{self.name}, counts")]
        if self.accel is not None:
            plots += [markup.legend(["accelerometer"]),
                      markup.plot(self.t, {"accelerometer": self.accel}, f"{self.name}, counts")]
        return head + "".join(f"<div>{part}</div>" for part in plots)

    @property
    def logged(self) -> np.ndarray:
        """(n) whether each row was logged; False where ``filled`` put it in."""
        lost = self.extra.get(LOST)
        return np.ones(len(self), dtype=bool) if lost is None else lost == 0.0

    @property
    def rounded(self) -> bool:
        """Whether the commands were rounded to whole counts: the log says so, and they are."""
        said = self.metadata.controller.get("rounding", self.metadata.rounding)
        return bool(said) and _whole(self.command[self.logged])

    def step(self, channel: str) -> float:
        """Step of a sensor's readings, counts: the encoder's is 1, and so is the accelerometer's where they are a
        converter's, whole but for an offset taken off; of a log in other units the least by which two differ, at least
        a millionth of their range."""
        read = self.accel[self.logged] if channel == "accel" and self.accel is not None else np.zeros(1)
        if _whole(read - read[:1]):
            return 1.0
        return min(max(float(np.diff(np.unique(read)).min()), 1e-6 * float(np.ptp(read))), 1.0)

    @property
    def blank(self) -> np.ndarray:
        """(n) rows of gaps that ``filled`` put in and that are longer than a device holds a command: what acted there
        nobody knows."""
        edges = np.flatnonzero(np.diff(np.concatenate([[True], self.logged, [True]]).astype(int)))
        blank = np.zeros(len(self), dtype=bool)
        for first, end in edges.reshape(-1, 2).tolist():
            blank[first:end] = end - first > HELD
        return blank

    def filled(self, rate: float | None = None) -> Run:
        """The run with a row for every tick: lost ones have the command and reference last logged, readings and
        times on a straight line between their neighbours, and a 1 in the extra column ``lost``.

        ``rate``: of the rig's ticks, Hz.  A log of every other one is spread over them; the commands between its rows
        were sent, and are worked out (``half_rate``).  A run without gaps is itself.  WorkError where more
        ticks are lost than logged.
        """
        if rate is not None and abs(2.0 * self.sample_rate / rate - 1.0) <= RATES:
            from station.runs.half_rate import spread  # works commands out again, which needs runs

            return spread(self)
        if not self.lost_samples:
            return self
        if self.lost_samples > len(self):
            raise WorkError(f"{self.name}: {self.lost_samples} samples lost and {len(self)} logged; too little is left")
        ticks = np.arange(int(self.n[0]), int(self.n[-1]) + 1)
        last = np.searchsorted(self.n, ticks, side="right") - 1
        found = {name: np.interp(ticks, self.n, values) if name in BETWEEN else values[last]
                 for name, values in self.columns().items()}
        lost = self.n[last] != ticks
        for column in COLUMNS:
            if column.gaps and column.name in found:
                found[column.name] = np.where(lost, np.nan, found[column.name])
        return Run.from_columns(self.name, self.name, found | {"n": ticks, LOST: lost.astype(float)}, self.metadata)

    def slice(self, start: int, stop: int | None = None) -> Run:
        """The rows from start up to stop, time kept as it was; the metadata stays."""
        rows = slice(start, stop)
        known = {column.name: getattr(self, column.name) for column in COLUMNS}
        cut = {name: values[rows] for name, values in known.items() if values is not None}
        return replace(self, **cut, extra={name: values[rows] for name, values in self.extra.items()})
