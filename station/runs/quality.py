"""What one test, or several repeats of it, come to: the figures of a plan's table, from the runs alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from station.runs.run import Run

FINAL_SECONDS = 0.1
"""The final error is the mean over so long, at the end of a run."""
SETTLED = 0.02
"""Of the step: inside it for good, a step has settled."""


@dataclass(frozen=True)
class Quality:
    """Figures of one run; None where the test has no such figure.

    overshoot: percent of the step; rise: s from 10 % to 90 % of the step; settling: s from the step until it stays
    within 2 % of it, None where it never does; final_error: counts, reference less encoder; saturated: share of the
    rows whose command is at the limit.
    """

    overshoot: float | None
    rise: float | None
    settling: float | None
    final_error: float | None
    saturated: float

    def as_dict(self) -> dict[str, float | None]:
        """For JSON."""
        return asdict(self)


def _step_row(reference: np.ndarray) -> int | None:
    rows = np.flatnonzero(np.diff(reference))
    return int(rows[0]) + 1 if rows.size == 1 else None


def quality(run: Run, limit: float) -> Quality:
    """The figures of a run under a command limit (counts)."""
    saturated = float(np.mean(np.abs(run.command) >= limit - 0.5))
    if run.metadata.controller.get("kind") == "open":
        return Quality(None, None, None, None, saturated)
    last = max(round(FINAL_SECONDS * run.sample_rate), 1)
    final = float(np.mean(run.reference[-last:] - run.encoder[-last:]))
    row = _step_row(run.reference)
    if row is None:
        return Quality(None, None, None, final, saturated)
    before, after = float(run.reference[row - 1]), float(run.reference[row])
    way = (run.encoder - before) / (after - before)  # 0 before the step, 1 where it is to end
    t = run.t - run.t[row]
    outside = np.flatnonzero(np.abs(way[row:] - 1.0) > SETTLED)
    settled = 0.0 if not outside.size else None if outside[-1] == len(way) - row - 1 else float(t[row + outside[-1]])
    return Quality(float(100.0 * (np.max(way) - 1.0)) + 0.0, _rise(way[row:], t[row:]), settled, final, saturated)


def _rise(way: np.ndarray, t: np.ndarray) -> float | None:
    """Seconds from 10 % to 90 %, between rows on straight lines; None where 90 % is not reached."""
    times = []
    for share in (0.1, 0.9):
        above = np.flatnonzero(way >= share)
        if not above.size:
            return None
        row = int(above[0])
        if row == 0:
            times.append(float(t[0]))
            continue
        low, high = float(way[row - 1]), float(way[row])
        times.append(float(t[row - 1] + (share - low) / (high - low) * (t[row] - t[row - 1])))
    return times[1] - times[0]


@dataclass(frozen=True)
class Scatter:
    """Mean and standard deviation (n - 1) of one figure over repeats; ``sigma`` is None for fewer than two."""

    mean: float | None
    sigma: float | None
    repeats: int

    @classmethod
    def of(cls, values: Sequence[float | None]) -> Scatter:
        """Of the values that there are."""
        there = [value for value in values if value is not None]
        if not there:
            return cls(None, None, 0)
        sigma = float(np.std(there, ddof=1)) if len(there) > 1 else None
        return cls(float(np.mean(there)), sigma, len(there))


def repeatability(runs: Sequence[Run], channel: str = "encoder") -> float | None:
    """Root mean square over the rows of the standard deviation between repeats of one test, counts.

    The encoder is taken from where each run began.  None for fewer than two runs, runs of unequal length, or without
    the channel.
    """
    columns = [run.columns().get(channel) for run in runs]
    if len(columns) < 2 or any(column is None or len(column) != len(columns[0]) for column in columns):
        return None
    stacked = np.stack([column - column[0] if channel == "encoder" else column for column in columns])
    return math.sqrt(float(np.mean(np.var(stacked, axis=0, ddof=1))))
