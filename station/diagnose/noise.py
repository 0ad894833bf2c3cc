"""How exactly a run's channels can be read: noise from stretches at rest, never from a fit's residual."""

from __future__ import annotations

import numpy as np

from station.runs.run import Run

QUANTISATION = 1.0 / 12.0
"""Variance of rounding to whole counts, counts^2."""
ACCEL_DEFAULT = 1.0
"""Standard deviation of an accelerometer's noise, counts, where no run shows it at rest."""


def rest_rows(run: Run) -> int:
    """Number of first rows in which nothing has been asked of the rig and nothing has moved."""
    moved = np.flatnonzero((run.reference != run.reference[0]) | (np.abs(run.encoder - run.encoder[0]) > 1.0)
                           | (np.abs(run.command - run.command[0]) > 1.0))
    return int(moved[0]) if moved.size else len(run.t)


def noise_sigmas(runs: list[Run]) -> tuple[float, float, int]:
    """Standard deviations before rounding (encoder, accelerometer), counts, and the rows that they rest on.

    Pooled over the runs' rests; without any, the accelerometer's is a default and the rows are 1.

    The variance at rest holds rounding's own q^2/12 where the reading moves at all; that part is taken off.
    """
    sums = {"encoder": 0.0, "accel": 0.0}
    freedom = {"encoder": 0, "accel": 0}
    for run in runs:
        rows = rest_rows(run)
        if rows < 10:
            continue
        for channel in sums:
            values = getattr(run, channel)
            if values is not None:
                part = values[:rows] - np.mean(values[:rows])
                sums[channel] += float(part @ part)
                freedom[channel] += rows - 1
    encoder = sums["encoder"] / freedom["encoder"] if freedom["encoder"] else 0.0
    if freedom["accel"]:
        accel = sums["accel"] / freedom["accel"]
    else:
        accel = ACCEL_DEFAULT**2 + QUANTISATION
    rows = max(freedom["accel"] or freedom["encoder"], 1)
    return float(np.sqrt(max(encoder - QUANTISATION, 0.0))), float(np.sqrt(max(accel - QUANTISATION, 0.0))), rows
