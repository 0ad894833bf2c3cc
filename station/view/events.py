"""What happened in a run besides its curves: saturation, sticking, late and lost samples, status bits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from station.runs.run import Run

STUCK_SECONDS = 0.05
"""An encoder that stands still for so long under a driven motor is said to stick."""


@dataclass(frozen=True)
class Event:
    """Row where it begins, a Rerun log level, and a sentence."""

    row: int
    level: str
    text: str


def find_events(run: Run, limit: float, status_names: Mapping[int, str] | None = None) -> list[Event]:
    """Events of a run in order.  ``limit``: counts; ``status_names``: names of the status bits worth a line."""
    rate = run.sample_rate
    events = [Event(first, "WARN", f"command at its limit of {limit:g} counts for {(last - first) / rate * 1e3:.0f} ms")
              for first, last in _stretches(np.abs(run.command) >= limit)]
    still = np.concatenate([[False], np.diff(run.encoder) == 0]) & (np.abs(run.command) >= 1.0)
    events += [Event(first, "INFO", f"arm stands still for {(last - first) / rate * 1e3:.0f} ms, "
                                    f"command up to {np.abs(run.command[first:last]).max():.0f} counts")
               for first, last in _stretches(still) if last - first >= STUCK_SECONDS * rate]
    firmware = run.metadata.firmware
    waits = isinstance(firmware, dict) and firmware.get("virtual_time")     # a device in lockstep, where none is late
    if run.slack is not None and not waits:
        events += [Event(int(row), "WARN", f"answered {-1e3 * run.slack[row]:.1f} ms late")
                   for row in np.flatnonzero(np.nan_to_num(run.slack, nan=1.0) < 0.0)]
    events += [Event(first, "WARN", _lost(last - first)) for first, last in _stretches(~run.logged)]
    if run.n is not None:
        lost = np.diff(run.n) - 1
        events += [Event(int(row) + 1, "WARN", _lost(int(lost[row])))
                   for row in np.flatnonzero(lost > 0)]
    for bit, name in (status_names or {}).items():
        if run.status is not None:
            set_ = (np.asarray(run.status).astype(np.int64) & bit) != 0
            events += [Event(first, "WARN", f"device says: {name}") for first, _ in _stretches(set_)]
    return sorted(events, key=lambda e: e.row)


def _lost(count: int) -> str:
    return f"{count} sample{'s' if count > 1 else ''} lost"


def _stretches(mask: np.ndarray) -> Iterator[tuple[int, int]]:
    """First row and row after the last of each stretch of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    for first, last in edges.reshape(-1, 2):
        yield int(first), int(last)
