"""What one test, or several repeats of it, come to: the figures of a plan's table, from the runs alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from station.runs.run import Run
from station.runs.step_response import overshoot, rise_time, settling_time

FINAL_SECONDS = 0.1
"""The final error is the mean over so long, at the end of a run."""
ROUNDING = 1e-5
"""Relative error of a number in a file of six digits."""


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


def quality(run: Run, limit: float) -> Quality:
    """The figures of a run under a command limit (counts)."""
    whole = limit > 1.0 and np.array_equal(run.command, np.round(run.command))
    largest = float(np.floor(limit)) if whole else limit
    saturated = float(np.mean(np.abs(run.command) >= largest * (1.0 - ROUNDING)))
    if run.open_loop:
        return Quality(None, None, None, None, saturated)
    last = max(round(FINAL_SECONDS * run.sample_rate), 1)
    final = float(np.mean(run.reference[-last:] - run.encoder[-last:]))
    judged = run.reference, run.encoder
    return Quality(overshoot(*judged), rise_time(*judged, run.t), settling_time(*judged, run.t), final, saturated)


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
        sigma = float(np.std(np.subtract(there, there[0]), ddof=1)) if len(there) > 1 else None    # of equal ones: 0
        return cls(float(np.mean(there)), sigma, len(there))


def between_repeats(columns: Sequence[np.ndarray]) -> float:
    """Root mean square over the rows (n) of the standard deviation between m >= 2 repeats' readings (n each)."""
    return math.sqrt(float(np.mean(np.var(np.stack(columns), axis=0, ddof=1))))


def repeatability(runs: Sequence[Run], channel: str = "encoder") -> float | None:
    """``between_repeats`` of one test's runs, counts.

    The encoder is taken from where each run began.  None for fewer than two runs, runs of unequal length, or without
    the channel.
    """
    columns = [run.columns().get(channel) for run in runs]
    if len(columns) < 2 or any(column is None or len(column) != len(columns[0]) for column in columns):
        return None
    return between_repeats([column - column[0] if channel == "encoder" else column for column in columns])
