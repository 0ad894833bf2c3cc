"""What prediction errors are worth: a likelihood that knows that models are imperfect.

Errors come in blocks: a run, a channel and a horizon.  With S the sum of a block's squared errors in units of the
sensor's noise, weighed by the independent errors in each sample, n their number and N <= n the number of independent
errors that the block really holds,

    -2 ln L = sum over blocks of N rho(S/n),   rho(s) = s for s <= 1,  1 + ln s beyond:

the noise's likelihood where a model reaches the noise, and beyond it that of errors whose size is unknown (profiled
out; Ljung 1999, section 7.4).  N follows from the errors' own autocorrelation r: a mean square of n correlated errors
is as uncertain as one of n / sum r^2 independent ones (Bayley and Hammersley, J. R. Stat. Soc. Suppl. 8, 1946).  Where
a model reaches the noise they are white, N = n, and this is the likelihood of output errors.  It is a composite
likelihood, whose parts share data; its curvature H and the scatter J of its slope over stretches of time say by how
much it counts too much, and it is divided by the temperature

    T = max(1, tr(A^-1 J)/tr(A^-1 H)),   A = H/T + prior's precision

(Varin, Reid and Firth, Statistica Sinica 21, 2011, section 2; Miller and Dunson, J. Am. Stat. Assoc. 114, 2019).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal

from station.estimation.dataset import Dataset

BANDS = 12.0
"""Half-width over which spectra are smoothed where independent errors are counted, over the cube root of n."""
NUISANCES = (0.35, 0.5)
"""Prior sigmas of a run's starting angle and accelerometer offset, counts: rounding's, and drift between tests."""
LEAST_DIFFERENCE = 1e-6
"""Share of the command, and counts, by which runs differ where they do not."""
TEMPERATURES = 4
"""Rounds in which a temperature and the precision that it enters settle."""


@dataclass(frozen=True, eq=False)
class Weighing:
    """What the blocks count for: the same for all hypotheses that are compared."""

    independent: np.ndarray
    """(runs, b) N."""
    temperature: float
    differ: tuple[float, float] = (0.0, 0.0)
    """Standard deviations, from run to run, of what the motor does more than the rig says: a share of the command, and
    a constant (counts of command)."""


def rho(ratio: np.ndarray) -> np.ndarray:
    """The cost of a mean square in units of the noise's."""
    return np.where(ratio <= 1.0, ratio, 1.0 + np.log(np.maximum(ratio, 1.0)))


def cost(squares: np.ndarray, counts: np.ndarray, independent: np.ndarray) -> float:
    """-2 ln L of blocks; infinite where a model has run away."""
    if not np.all(np.isfinite(squares)):
        return np.inf
    return float(np.sum(independent * rho(squares / counts)))


def independent_errors(errors: np.ndarray, counts: float) -> float:
    """Number of independent errors in a series (n) of which ``counts`` would be independent if it were white.

    n / sum r^2 = (sum P)^2 / (n sum P^2) n over the smoothed periodogram P (Parseval).
    """
    power = np.abs(np.fft.rfft(errors * signal.windows.tukey(len(errors), 0.1))) ** 2
    half = max(int(len(power) / max(BANDS * len(power) ** (1.0 / 3.0), 1.0)), 2)
    width = 2 * half + 1
    if power.sum() <= 0.0 or len(power) <= width:
        return counts
    smooth = np.convolve(np.pad(power, half, mode="reflect"), np.full(width, 1.0 / width), mode="valid")
    white = float(smooth.sum() ** 2 / (len(smooth) * np.sum(smooth**2)))
    # Of white noise the smoothed periodogram scatters by 1/width still: undo that, and never claim more than there are.
    return counts * min(1.0 / max(1.0 / white - 1.0 / width, 1.0), 1.0)


def blocks_independent(counts: np.ndarray, residuals: list[np.ndarray]) -> np.ndarray:
    """(runs, b) N of every block, from n (runs, b) and scaled errors (b, n) of every run."""
    found = np.array([[independent_errors(row, counts[r, b]) for b, row in enumerate(e)]
                      for r, e in enumerate(residuals)])
    return np.minimum(np.maximum(found, 1.0), counts)


def temperature(curvature: np.ndarray, scatter: np.ndarray, prior: np.ndarray) -> float:
    """T from H and J (p, p), both of the likelihood without a temperature, and the prior's precision (p)."""
    found = 1.0
    for _ in range(TEMPERATURES):
        inverse = np.linalg.inv(curvature / found + np.diag(prior))
        found = max(float(np.trace(inverse @ scatter) / max(np.trace(inverse @ curvature), 1e-300)), 1.0)
    return found


def nuisance_precision(data: Dataset, differ: tuple[float, float]) -> np.ndarray:
    """(c) prior precisions of what each run has of its own (``Dataset.own``, its free columns)."""
    angle, offset = NUISANCES
    return np.append(np.array([angle * data.rig.angle_per_count, offset]) ** -2.0, differ_precision(differ))[data.free]


def differ_precision(differ: tuple[float, float]) -> np.ndarray:
    """(2) prior precisions of what the motor does more in a run, a share and a constant."""
    return np.maximum(differ, LEAST_DIFFERENCE) ** -2.0
