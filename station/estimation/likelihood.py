"""What prediction errors are worth: a likelihood that knows that models are imperfect.

Errors come in blocks: a run, a channel and a horizon.  With S the sum of a block's squared errors in units of the
sensor's noise, weighed by the independent errors in each sample, n their number and N <= n the number of independent
errors that the block really holds,

    -2 ln L = sum over blocks of N rho(S/n),   rho(s) = s for s <= 1,  1 + ln s beyond:

the noise's likelihood where a model reaches the noise, and beyond it that of errors whose size is unknown (profiled
out; Ljung 1999, section 7.4).  N follows from the errors' own autocorrelation r: a mean square of n correlated errors
is as uncertain as one of n / sum r^2 independent ones (Bayley and Hammersley, J. R. Stat. Soc. Suppl. 8, 1946).

What a model misses is of one kind in all runs: in proportion to what a run shows, and of one colour.  So a run that a
model happens to meet, with as many parameters as it has slow swings, holds no more independent errors than the others
say.  With p the mean square of what a channel shows in run r, in units of the noise, S/n is taken to scatter about

    v_r = 1 + lambda p_r:   S/(n v_r) ~ F(N, nu),   n/N_r >= 1 + kappa (1 - 1/v_r)^2,

noise beside errors of which r^2 sums to kappa beyond lag 0; lambda and nu are most likely of all runs together
(empirical Bayes: Gelman et al., Bayesian Data Analysis, 3rd ed. 2013, sections 5.4 and 17.2), kappa is the runs'
median: of a mean the longest run would be the most.  Where a model reaches the noise lambda is 0, N = n, and this is
the likelihood of output errors.

It is a composite likelihood, whose parts share data.  Curvature H_b and scatter J_b of its slope over stretches of time
say by how much one kind of block (a channel and a horizon) counts too much,

    T_b = max(1, tr(A^-1 J_b)/tr(A^-1 H_b)),   A = H/T + prior's precision,

by which its N are divided; those of all kinds together say by how much these count the same twice, T (Varin, Reid and
Firth, Statistica Sinica 21, 2011, section 2; Miller and Dunson, J. Am. Stat. Assoc. 114, 2019).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from station.estimation.dataset import Dataset
from station.estimation.noise import FREEDOMS, surprise
from station.estimation.record import PUSHED
from station.rig import Rig

SHARES = np.concatenate([[-80.0], np.linspace(math.log(1e-10), math.log(1e4), 65)])
"""Logarithms of lambda from which the most likely one is sought; the first is none."""
STEPS = 5
"""Newton steps to it."""
NEAR = 0.25
"""Longest of these: half of what lies between two of the starts."""
NUISANCES = (0.35, 0.5)
"""Prior sigmas of a run's starting angle and accelerometer offset, counts: rounding's, and drift since it was read."""
LEAST = 1e-6, 5e-9
"""By which runs differ where they do not: a share of the command, and of the amplifier's limit."""
LARGEST = 0.3, PUSHED
"""Most by which runs differ: a share of the command (what the voltage of a supply that nothing regulates, a battery or
a wall adapter, may differ by from one day to another), and of the amplifier's limit (an offset of its input)."""
ROUNDS = 3
"""In which sizes and numbers of independent errors settle."""
TAPER = 0.1
"""Share of a series that fades in and out before its spectrum is taken."""
TEMPERATURES = 4
"""Rounds in which a temperature and the precision that it enters settle."""


@dataclass(frozen=True, eq=False)
class Weighing:
    """What the blocks count for: the same for all hypotheses that are compared."""

    independent: np.ndarray
    """(runs, b) N, divided by the temperature of its kind of block."""
    temperature: float
    differ: tuple[float, float] = (0.0, 0.0)
    """Standard deviations, from run to run, of what the motor does more than the rig says: a share of the command, and
    a constant (counts of command)."""
    may: tuple[bool, bool] = (True, True)
    """Whether runs may differ in either; in what they may not, they are held alike."""


def rho(ratio: np.ndarray) -> np.ndarray:
    """The cost of a mean square in units of the noise's."""
    return np.minimum(ratio, 1.0) + np.log(np.maximum(ratio, 1.0))


def cost(squares: np.ndarray, counts: np.ndarray, independent: np.ndarray) -> float:
    """-2 ln L of blocks; infinite where a model has run away."""
    if not np.all(np.isfinite(squares)):
        return np.inf
    return float(np.sum(independent * rho(squares / counts)))


def block_weights(squares: np.ndarray, counts: np.ndarray, independent: np.ndarray) -> np.ndarray:
    """What a squared error of a block adds to its cost, N/max(S, n)."""
    return independent / np.maximum(squares, counts)


def expected(ratio: np.ndarray, independent: np.ndarray, power: np.ndarray) -> np.ndarray:
    """(runs, b) v, the mean square that a block is expected to have, from S/n, N and p (runs, b)."""
    shares = 1.0 + np.exp(SHARES)[:, None, None] * power
    found = np.stack([surprise(ratio, independent, shares, nu).sum(axis=1) for nu in FREEDOMS])
    at = np.argmin(found.reshape(FREEDOMS.size * SHARES.size, -1), axis=0)
    nu, log_share = FREEDOMS[at // SHARES.size], SHARES[at % SHARES.size]
    for _ in range(STEPS):
        excess = np.exp(log_share) * power
        first, second = _slopes(ratio, independent, 1.0 + excess, nu)
        slope, curvature = (first * excess).sum(axis=0), (second * excess**2 + first * excess).sum(axis=0)
        step = np.where(curvature > 0.0, -slope / np.where(curvature > 0.0, curvature, 1.0), 0.0)
        log_share = np.where(log_share == SHARES[0], log_share, log_share + np.clip(step, -NEAR, NEAR))
    return 1.0 + np.exp(log_share) * power


def _slopes(ratio: np.ndarray, independent: np.ndarray, scale: np.ndarray, nu: np.ndarray,
            ) -> tuple[np.ndarray, np.ndarray]:
    """First and second derivatives of that by v."""
    size = ratio / scale
    weight = (independent + nu) / (nu + independent * size) * size
    further = weight * independent * size / (nu + independent * size)
    return independent * (1.0 - weight) / scale, independent * (2.0 * weight - further - 1.0) / scale**2


def correlation(errors: np.ndarray) -> float:
    """sum r^2 over all lags of a series (n), 1 of white noise.

    n sum S^2/(sum S)^2 over the spectrum S (Parseval).  Ordinates P of the periodogram scatter about S as exponentials
    do, E P^2 = 2 S^2, so sum S^2 is taken to be sum P^2/2: not smoothed, for the errors of a whole run often hold no
    more than a few swings, which a smoothing width would spread.
    """
    power = np.abs(np.fft.rfft(errors * tapered(len(errors)))) ** 2
    total = float(power.sum())
    return max(0.5 * len(power) * float(np.sum((power / total) ** 2)), 1.0) if total > 0.0 else 1.0


@functools.lru_cache(maxsize=64)
def tapered(size: int) -> np.ndarray:
    """(n) Tukey's window, a cosine over a tenth of it (Bloomfield, Fourier Analysis of Time Series, 2nd ed. 2000,
    section 6.2); SciPy's, without the second that scipy.signal takes to import."""
    place = np.minimum(np.arange(size), np.arange(size)[::-1]) / (0.5 * TAPER * max(size - 1, 1))
    return 0.5 - 0.5 * np.cos(np.pi * np.minimum(place, 1.0))


def blocks_independent(squares: np.ndarray, counts: np.ndarray, power: np.ndarray, residuals: list[np.ndarray],
                       ) -> np.ndarray:
    """(runs, b) N of every block, from S, n and p (runs, b) and scaled errors (b, n) of every run."""
    each = np.array([[correlation(row) for row in e] for e in residuals])
    independent = counts / each
    for _ in range(ROUNDS):
        missed = (1.0 - 1.0 / expected(squares / counts, independent, power)) ** 2
        kappas = (each - 1.0) / np.maximum(missed, 1e-9)
        kappa = np.array([_median(*block) for block in zip(kappas.T, missed.T, strict=True)], dtype=float)
        independent = np.maximum(counts / np.maximum(1.0 + kappa * missed, each), np.minimum(counts, 1.0))
    return independent


def _median(values: np.ndarray, weights: np.ndarray) -> float:
    """Of weighed values; 0 where nothing weighs."""
    order = np.argsort(values)
    reached = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(reached, 0.5 * reached[-1])]) if reached[-1] > 0.0 else 0.0


def temperatures(curvatures: np.ndarray, slopes: np.ndarray, prior: np.ndarray) -> tuple[np.ndarray, float]:
    """(b) T of every kind of block, and T of all, from H of every kind (b, p, p), its slopes in every stretch (s, b, p)
    and the prior's precision (p)."""
    kinds, whole = np.ones(len(curvatures)), 1.0
    for _ in range(TEMPERATURES):
        curvature = np.tensordot(1.0 / kinds, curvatures, 1)
        spread = np.linalg.inv(curvature / whole + np.diag(prior))
        kinds = np.maximum(np.einsum("ij,sbi,sbj->b", spread, slopes, slopes)
                           / np.maximum(np.einsum("ij,bij->b", spread, curvatures), 1e-300), 1.0)
        total = np.tensordot(slopes, 1.0 / kinds, (1, 0))
        curvature = np.tensordot(1.0 / kinds, curvatures, 1)
        spread = np.linalg.inv(curvature / whole + np.diag(prior))
        whole = max(float(np.einsum("ij,si,sj->", spread, total, total)
                          / np.maximum(np.sum(spread * curvature), 1e-300)), 1.0)
    return kinds, whole


def nuisance_precision(data: Dataset, differ: tuple[float, float]) -> np.ndarray:
    """(runs, c) prior precisions of what each run has of its own (``Dataset.own``, its free columns)."""
    angle, drift = NUISANCES
    start = np.hypot(angle, data.start_error) * data.rig.angle_per_count
    offset = np.hypot(drift, data.offset_error)
    more = np.tile(differ_precision(data.rig, differ), (len(start), 1))
    return np.column_stack([start**-2.0, offset**-2.0, more])[:, data.free]


def differ_ends(rig: Rig) -> np.ndarray:
    """(2, 2) by how much runs differ that do not, and the most by which they do: a share of the command, and a constant
    (counts of command)."""
    return np.array([LEAST, LARGEST]) * np.array([1.0, rig.amplifier.limit])


def differ_precision(rig: Rig, differ: tuple[float, float] | np.ndarray) -> np.ndarray:
    """(..., 2) prior precisions of what the motor does more in a run, a share and a constant."""
    return np.maximum(differ, differ_ends(rig)[0]) ** -2.0
