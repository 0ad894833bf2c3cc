"""How exactly a run's channels can be read: noise from rests, or about a smooth motion, never from a fit's residual."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import gammaln

from station.runs.run import Run

QUANTISATION = 1.0 / 12.0
"""Variance of rounding to whole counts, counts^2."""
ACCEL_DEFAULT = 1.0
"""Standard deviation of an accelerometer's noise, steps of its readings, where no run shows it at rest."""

SMOOTH = 5.0
"""Samples within which what a model misses stays alike: an encoder that crosses a count in fewer reads it between the
counts, for its rounding error runs through all its values meanwhile; of a longer stay as many errors are independent.
"""
ASKED = 0.01
"""Share of a run's largest command that asks nothing yet: that of a loop that holds what rests, toggling by a count."""
UNROUNDED = 0.3
"""Noise of a sensor, steps of its readings, from which on rounding errors are independent from sample to sample
(Widrow): of less a rest shows what hangs on where between two counts it is, in the middle of one nothing."""
LEAST = 10
"""Fewest rows at rest that tell what a sensor scatters by."""
FREEDOMS = np.array([2.0, 8.0, 32.0, 1e9])
"""Degrees of freedom that are tried of what mean squares scatter about: from runs that have nothing in common to runs
that are alike."""
VARIES = 5.41
"""2 ln of the likelihood ratio from which on something is said to differ from run to run: one in a hundred where it
does not (half of chi squared with one degree of freedom; Self and Liang, J. Am. Stat. Assoc. 82, 1987)."""
RESTS = 100
"""Most rows at rest that say where a run begins."""
ORDER = 8
"""Of the differences in which nothing of a motion is left that is smooth over as many rows."""
BLOCK = 50
"""Rows whose differences are taken together."""


def rounding_shares(reading: np.ndarray) -> np.ndarray:
    """Independent rounding errors per sample (n) of a sensor's readings (n), counts; 1 while it moves fast.

    As long as it stands at one count the rounding error runs through its values once at most: of all these samples no
    more than SMOOTH are independent, and they count alike, for where it leaves a count the error is half of one.
    Before a log's first change and after its last it rests, and the error with it: one each.  Readings that toggle
    between two counts, for the angle stands where one becomes the other, do not move: what counts is what is left
    beyond a play of one count (Visintin, Differential Models of Hysteresis, 1994, chapter III).
    """
    stay = np.cumsum(np.diff(_beyond_play(reading), prepend=np.nan) != 0.0) - 1
    independent = np.full(stay[-1] + 1, SMOOTH)
    independent[[0, -1]] = 1.0
    return np.minimum(independent / np.bincount(stay), 1.0)[stay]


def _beyond_play(reading: np.ndarray) -> np.ndarray:
    """(n) where a part is that readings (n), counts, push to and fro by play of half a count on either side."""
    low, high = (reading - 0.5).tolist(), (reading + 0.5).tolist()
    place, places = float(reading[0]), []
    for least, most in zip(low, high, strict=True):
        place = min(max(place, least), most)
        places.append(place)
    return np.array(places)


def rest_rows(run: Run) -> int:
    """Number of first rows in which nothing has been asked of the rig and nothing has moved."""
    asked = np.abs(run.command - run.command[0])
    moved = np.flatnonzero((run.reference != run.reference[0]) | (np.abs(run.encoder - run.encoder[0]) > 1.0)
                           | (asked > ASKED * asked.max()))
    return int(moved[0]) if moved.size else len(run.t)


def rest_start(run: Run) -> slice:
    """The first rows, at most RESTS, whose mean says where a run at rest begins; at least one."""
    return slice(max(min(rest_rows(run), RESTS), 1))


class Noise(NamedTuple):
    """Of encoder and accelerometer."""

    sigmas: tuple[float, float]
    """Standard deviations before rounding, counts."""
    freedoms: tuple[float, float]
    """Degrees of freedom of their estimates, at least 1."""


def noise_of(runs: list[Run]) -> Noise:
    """What sensors' readings scatter by, pooled over the runs' rests, rows that were logged alone.

    The encoder's is its ``scatter`` where that is larger: rows that were logged a little late or early show in motion
    alone.  Without any rest the accelerometer's is a default.  Rounding's own variance q^2/12, which a reading that
    moves at all holds, is taken off.
    """
    step = accel_step(runs)
    (encoder, encoder_rows), (accel, accel_rows) = (rests.sum(axis=1).tolist() for rests in _rests(runs))
    angle, freedoms = max((encoder / max(encoder_rows, 1.0), encoder_rows), scatter(runs))
    acceleration = accel / accel_rows if accel_rows else (ACCEL_DEFAULT**2 + QUANTISATION) * step**2
    angle = math.sqrt(max(angle - QUANTISATION, 0.0))
    acceleration = math.sqrt(max(acceleration - QUANTISATION * step**2, 0.0))
    return Noise((angle, acceleration), (max(freedoms, 1.0), max(accel_rows, 1.0)))


def _rests(runs: list[Run]) -> np.ndarray:
    """(2, 2, runs) of encoder and accelerometer the sum of squares about the mean in each run's rest, of rows that were
    logged, and its degrees of freedom; 0 and 0 of a rest of fewer than LEAST."""
    found = np.zeros((2, 2, len(runs)))
    for r, run in enumerate(runs):
        rest = np.flatnonzero(run.logged[: rest_rows(run)])
        for c, reading in enumerate((run.encoder, run.accel)):
            if reading is not None and rest.size >= LEAST:
                found[c, :, r] = rest.size * np.var(reading[rest]), rest.size - 1
    return found


def run_by_run(runs: list[Run]) -> tuple[np.ndarray, np.ndarray]:
    """(runs) variance of the accelerometer's readings in each run, over that of all runs together, and its degrees of
    freedom, at least 1: motor and amplifier disturb it in each by what they do there.

    Each rest's mean square s of d degrees of freedom is taken to scatter about v, s/v ~ F(d, nu), with v and nu most
    likely of all runs together; a run's own variance is (nu v + d s)/(nu + d) (empirical Bayes: Smyth, Stat. Appl.
    Genet. Mol. Biol. 3, 2004).  Where that is not VARIES likelier than one variance for all, it is one.
    """
    sums, freedoms = _rests(runs)[1]
    sums = np.maximum(sums, QUANTISATION * accel_step(runs) ** 2 * freedoms)
    alike = sums.sum() / max(freedoms.sum(), 1.0)
    seen, same = freedoms > 0.0, (np.ones(len(runs)), np.full(len(runs), max(freedoms.sum(), 1.0)))
    if not seen.sum() > 1:
        return same
    d, square = freedoms[seen], sums[seen] / freedoms[seen] / alike

    def about(nu: float) -> tuple[float, float, float]:
        found = minimize_scalar(lambda log: float(surprise(square, d, np.exp(log), nu).sum()), method="bounded",
                                bounds=(math.log(square.min()) - 1.0, math.log(square.max()) + 1.0))
        return float(found.fun), nu, math.exp(found.x)
    (least, nu, v), (one, *_) = min(map(about, FREEDOMS[:-1].tolist())), about(float(FREEDOMS[-1]))
    if one - least < VARIES:
        return same
    return (nu * v + sums / alike) / (nu + freedoms), nu + freedoms


def surprise(square: np.ndarray, independent: np.ndarray, scale: np.ndarray | float, nu: float) -> np.ndarray:
    """-2 ln of the density of so many ``independent`` errors of such a mean ``square`` about ``scale``, their own size
    drawn with nu degrees of freedom."""
    return ((independent + nu) * np.log1p(independent * square / (nu * scale)) + independent * np.log(scale)
            - 2.0 * (gammaln(0.5 * (independent + nu)) - gammaln(0.5 * nu) - 0.5 * independent * np.log(0.5 * nu)))


def accel_step(runs: Iterable[Run]) -> float:
    """The finest step of the accelerometer's readings in these runs, counts."""
    return min(run.step("accel") for run in runs)


def scatter(runs: list[Run]) -> tuple[float, float]:
    """Variance of encoders' readings about a smooth motion, counts^2, and its degrees of freedom; 0 and 0 where
    rounding could make it, and of few rows.

    Mean square of their m-th differences over that of white noise of variance one, C(2m, m), in the median of all
    blocks: blows are no noise (Hall, Kay and Titterington, Biometrika 77, 1990).  Rounding errors of half a count make
    differences of 2^m / 2 at most.  Of n differences the mean square is as uncertain as of n C(2m, m)^2 / C(4m, 2m)
    independent ones, a median as a mean of 2/pi of them.
    """
    whole = math.comb(2 * ORDER, ORDER)
    found, rows = [], 0
    for run in (run for run in runs if len(run) > ORDER):
        known = np.convolve(run.logged, np.ones(ORDER + 1), "valid") > ORDER
        squares = np.diff(run.encoder, ORDER)[known] ** 2 / whole
        found += [float(np.mean(block)) for block in np.split(squares, range(BLOCK, squares.size, BLOCK)) if block.size]
        rows += squares.size
    variance = float(np.median(found)) if found else 0.0
    if variance <= 4.0 ** (ORDER - 1) / whole:
        return 0.0, 0.0
    return variance, rows * whole**2 / math.comb(4 * ORDER, 2 * ORDER) * 2.0 / math.pi


def correlation_time(values: np.ndarray) -> float:
    """Integrated autocorrelation time over at most 50 lags, samples, at least 1."""
    centred = values - values.mean()
    power = float(centred @ centred)
    if power <= 0.0:
        return 1.0
    total = 1.0
    for lag in range(1, min(50, len(values) - 1)):
        rho = float(centred[lag:] @ centred[:-lag]) / power
        if rho <= 0.0:
            break
        total += 2.0 * rho
    return total
