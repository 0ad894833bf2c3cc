"""How exactly a run's channels can be read: noise from stretches at rest, never from a fit's residual."""

from __future__ import annotations

import numpy as np

from station.runs.run import Run

QUANTISATION = 1.0 / 12.0
"""Variance of rounding to whole counts, counts^2."""
ACCEL_DEFAULT = 1.0
"""Standard deviation of an accelerometer's noise, counts, where no run shows it at rest."""

SMOOTH = 5.0
"""Samples within which what a model misses stays alike: an encoder that crosses a count in fewer reads it between the
counts, for its rounding error runs through all its values meanwhile."""
RESTING = 0.004
"""Share of a sample while nothing crosses a count: one or two independent errors per rest."""
RESTS = 100
"""Most rows at rest that say where a run begins."""
SPAN = 10
"""Rows either side over which the encoder's speed is taken."""


def rounding_shares(encoder: np.ndarray) -> np.ndarray:
    """Independent rounding errors per sample (n) of an encoder's readings (n), counts; 1 while it moves.

    While nothing moves the rounding error stands still, too, so that many samples say no more than one.
    """
    padded = np.pad(encoder, SPAN, mode="edge")
    speed = np.abs(padded[2 * SPAN:] - padded[: -2 * SPAN]) / (2 * SPAN)
    return np.clip(SMOOTH * speed, RESTING, 1.0)


def rest_rows(run: Run) -> int:
    """Number of first rows in which nothing has been asked of the rig and nothing has moved."""
    moved = np.flatnonzero((run.reference != run.reference[0]) | (np.abs(run.encoder - run.encoder[0]) > 1.0)
                           | (np.abs(run.command - run.command[0]) > 1.0))
    return int(moved[0]) if moved.size else len(run.t)


def rest_start(run: Run) -> slice:
    """The first rows, at most RESTS, whose mean says where a run at rest begins; at least one."""
    return slice(max(min(rest_rows(run), RESTS), 1))


def noise_sigmas(runs: list[Run]) -> tuple[float, float, int]:
    """Standard deviations before rounding (encoder, accelerometer), counts, and the rows that they rest on.

    Pooled over the runs' rests, rows that were logged alone; without any, the accelerometer's is a default and the rows
    are 1.

    The variance at rest holds rounding's own q^2/12 where the reading moves at all; that part is taken off.
    """
    sums = {"encoder": 0.0, "accel": 0.0}
    freedom = {"encoder": 0, "accel": 0}
    for run in runs:
        resting = np.flatnonzero(run.logged[: rest_rows(run)])
        if resting.size < 10:
            continue
        for channel in sums:
            values = getattr(run, channel)
            if values is not None:
                part = values[resting] - np.mean(values[resting])
                sums[channel] += float(part @ part)
                freedom[channel] += resting.size - 1
    encoder = sums["encoder"] / freedom["encoder"] if freedom["encoder"] else 0.0
    if freedom["accel"]:
        accel = sums["accel"] / freedom["accel"]
    else:
        accel = ACCEL_DEFAULT**2 + QUANTISATION
    rows = max(freedom["accel"] or freedom["encoder"], 1)
    return float(np.sqrt(max(encoder - QUANTISATION, 0.0))), float(np.sqrt(max(accel - QUANTISATION, 0.0))), rows


def correlation_time(values: np.ndarray, longest: int = 50) -> float:
    """Integrated autocorrelation time, samples, at least 1."""
    centred = values - values.mean()
    power = float(centred @ centred)
    if power <= 0.0:
        return 1.0
    total = 1.0
    for lag in range(1, min(longest, len(values) - 1)):
        rho = float(centred[lag:] @ centred[:-lag]) / power
        if rho <= 0.0:
            break
        total += 2.0 * rho
    return total
