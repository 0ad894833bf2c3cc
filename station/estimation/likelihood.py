"""What prediction errors are worth: a likelihood that knows that models are imperfect.

Errors come in blocks: a run r, a channel and a horizon.  With S the sum of a block's squared errors in units of the
sensor's noise, weighed by the independent errors in each sample, n their number, N <= n the number of independent
errors that the block really holds and p the mean square of what the channel shows in that run, in the same units,

    S/n ~ v_r g_r,   v_r = 1 + lambda p_r,   1/g_r ~ chi^2(nu)/nu,
    -2 ln L = sum over blocks of (N + nu) ln(1 + N (S/n)/(nu v_r)) + N ln v_r - 2 ln c(N, nu):

noise, and what the model misses, which is in proportion to what a run shows, the same share lambda of it in all runs
but for a factor g_r.  Errors of unknown size follow Student's t (Gelman et al., Bayesian Data Analysis, 3rd ed. 2013,
sections 3.2 and 17.2); c is its normalisation.  lambda and nu are those of every horizon and channel, most likely of all
runs together (empirical Bayes, section 5.4).  Where a model reaches the noise lambda is 0 and nu infinite, and this is
the likelihood of output errors; one run that a model happens to meet does not outweigh what the others say of it.

N follows from the errors' own autocorrelation r: a mean square of n correlated errors is as uncertain as one of
n / sum r^2 independent ones (Bayley and Hammersley, J. R. Stat. Soc. Suppl. 8, 1946).  What is missed is of one kind in
all runs, too: with kappa the sum of its r^2 beyond lag 0, and white noise beside it,

    n/N_r = 1 + kappa (1 - 1/v_r)^2,   kappa from all runs.

It is a composite likelihood, whose parts share data; its curvature H and the scatter J of its slope over stretches of
time say by how much it counts too much, and it is divided by the temperature

    T = max(1, tr(A^-1 J)/tr(A^-1 H)),   A = H/T + prior's precision

(Varin, Reid and Firth, Statistica Sinica 21, 2011, section 2; Miller and Dunson, J. Am. Stat. Assoc. 114, 2019).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import signal, special

from station.estimation.dataset import Dataset

FREEDOMS = np.array([2.0, 8.0, 32.0, np.inf])
"""Degrees of freedom nu that are tried: from runs that have nothing in common to errors in strict proportion."""
SHARES = np.concatenate([[-80.0], np.linspace(math.log(1e-10), math.log(1e4), 65)])
"""Logarithms of lambda from which the most likely one is sought; the first is none."""
STEPS = 5
"""Newton steps to it."""
NUISANCES = (0.35, 0.5)
"""Prior sigmas of a run's starting angle and accelerometer offset, counts: rounding's, and drift between tests."""
LEAST_DIFFERENCE = 1e-6
"""Share of the command, and counts, by which runs differ where they do not."""
ROUNDS = 3
"""In which sizes and numbers of independent errors settle."""
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


@dataclass(frozen=True, eq=False)
class Sizes:
    """What the errors of b blocks are expected to be."""

    share: np.ndarray
    """(b) lambda."""
    freedom: np.ndarray
    """(b) nu."""
    power: np.ndarray
    """(runs, b) p."""

    @property
    def expected(self) -> np.ndarray:
        """(runs, b) v."""
        return 1.0 + self.share * self.power


def _terms(ratio: np.ndarray, independent: np.ndarray, expected: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """-2 ln L of blocks from S/n, N, v and nu, all of one shape; 0 for errors of the noise's size, N = n."""
    with np.errstate(invalid="ignore"):
        student = ((independent + freedom) * np.log1p(independent * ratio / (freedom * expected))
                   - 2.0 * _normalisation(independent, freedom))
    return np.where(np.isinf(freedom), independent * ratio / expected, student) + independent * np.log(expected)


def _normalisation(independent: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    nu = np.where(np.isinf(freedom), 1.0, freedom)
    return (special.gammaln(0.5 * (independent + nu)) - special.gammaln(0.5 * nu) - 0.5 * independent * np.log(0.5 * nu))


def _slopes(ratio: np.ndarray, independent: np.ndarray, expected: np.ndarray, freedom: np.ndarray,
            ) -> tuple[np.ndarray, np.ndarray]:
    """First and second derivatives of the terms by v."""
    size = ratio / expected
    with np.errstate(invalid="ignore"):
        weight = np.where(np.isinf(freedom), 1.0, (independent + freedom) / (freedom + independent * size))
        further = np.where(np.isinf(freedom), 0.0, weight * independent * size / (freedom + independent * size))
    first = independent * (1.0 - weight * size) / expected
    return first, independent * (2.0 * weight * size - further * size - 1.0) / expected**2


def sizes(squares: np.ndarray, counts: np.ndarray, independent: np.ndarray, power: np.ndarray) -> Sizes:
    """The most likely lambda and nu of every block, from S, n, N and p (runs, b)."""
    ratio = squares / counts
    freedom = FREEDOMS[:, None, None, None]
    found = _terms(ratio, independent, 1.0 + np.exp(SHARES)[:, None, None] * power, freedom).sum(axis=2)
    at = np.argmin(found.reshape(-1, found.shape[2]), axis=0)
    nu, log_share = FREEDOMS[at // SHARES.size], SHARES[at % SHARES.size]
    for _ in range(STEPS):
        excess = np.exp(log_share) * power
        first, second = _slopes(ratio, independent, 1.0 + excess, nu)
        slope, curvature = (first * excess).sum(axis=0), (second * excess**2 + first * excess).sum(axis=0)
        step = np.where(curvature > 0.0, -slope / np.where(curvature > 0.0, curvature, 1.0), 0.0)
        log_share = np.where(log_share == SHARES[0], log_share, log_share + np.clip(step, -0.25, 0.25))
    return Sizes(np.exp(log_share), nu, power)


def costs(squares: np.ndarray, counts: np.ndarray, independent: np.ndarray, power: np.ndarray) -> np.ndarray:
    """(runs, b) -2 ln L of blocks; infinite where a model has run away."""
    if not np.all(np.isfinite(squares)):
        return np.full(squares.shape, np.inf)
    found = sizes(squares, counts, independent, power)
    return _terms(squares / counts, independent, found.expected, found.freedom)


def weights(squares: np.ndarray, counts: np.ndarray, independent: np.ndarray, power: np.ndarray) -> np.ndarray:
    """(runs, b) derivatives of the cost by the squares, lambda and nu at their most likely (envelope theorem)."""
    found = sizes(squares, counts, independent, power)
    expected, ratio = found.expected, squares / counts
    with np.errstate(invalid="ignore"):
        own = np.where(np.isinf(found.freedom), 1.0 / expected,
                       (independent + found.freedom) / (found.freedom * expected + independent * ratio))
    return independent / counts * own


def correlation(errors: np.ndarray) -> float:
    """sum r^2 over all lags of a series (n), 1 of white noise.

    n sum S^2/(sum S)^2 over the spectrum S (Parseval).  Ordinates P of the periodogram scatter about S as exponentials
    do, E P^2 = 2 S^2, so sum S^2 is taken to be sum P^2/2: not smoothed, for the errors of a whole run often hold no
    more than a few swings, which a smoothing width would spread.
    """
    power = np.abs(np.fft.rfft(errors * signal.windows.tukey(len(errors), 0.1))) ** 2
    total = float(power.sum())
    return max(0.5 * len(power) * float(np.sum((power / total) ** 2)), 1.0) if total > 0.0 else 1.0


def blocks_independent(squares: np.ndarray, counts: np.ndarray, power: np.ndarray, residuals: list[np.ndarray],
                       ) -> np.ndarray:
    """(runs, b) N of every block, from S, n and p (runs, b) and scaled errors (b, n) of every run."""
    each = np.array([[correlation(row) for row in e] for e in residuals])
    independent = counts / each
    for _ in range(ROUNDS):
        missed = (1.0 - 1.0 / sizes(squares, counts, independent, power).expected) ** 2
        kappa = np.sum(counts * missed * (each - 1.0), axis=0) / np.maximum(np.sum(counts * missed**2, axis=0), 1e-300)
        independent = np.maximum(counts / (1.0 + kappa * missed), np.minimum(counts, 1.0))
    return independent


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
