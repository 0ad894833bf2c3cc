"""How much a parameter differs from run to run, where a fit has given all runs one value.

Every run r has its own value theta + a_r, a_r ~ N(0, tau^2), all other parameters shared (Gelman et al., Bayesian Data
Analysis, 3rd ed. 2013, section 5.4).  With the normal matrices N_r and gradients g_r of a fit that stands at its
optimum, u the parameter's direction, B = sum N_r + P with P the prior's precision, c_r = N_r u,

    M = diag(u' N_r u) - C' B^-1 C,   v_r = u' g_r - c_r' B^-1 b,   b = sum g_r - P (x - mean)
    2 ln L(tau)/L(0) = sum_k w_k^2 tau^2/(1 + lambda_k tau^2) - ln(1 + lambda_k tau^2)

lambda and Q M's eigenvalues and vectors, w = Q' v: the shared parameters integrated out (restricted likelihood,
Harville, J. Am. Stat. Assoc. 72, 1977).  What the shared value is known by is then (B - C (D + I/tau^2)^-1 C')^-1,
D = diag(u' N_r u): runs that differ say less of it than their rows (DerSimonian and Laird, Controlled Clinical Trials
7, 1986).  One linear step from the shared fit: sizes that enter by their logarithm give the spread as a share of the
value.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from station.estimation.fitted import Fit
from station.estimation.likelihood import Weighing

WIDEST = 10.0
"""Largest spread that is tried, in units of the parameter: ten times the value, or ten usual sizes."""
TINIEST = 1e-4
"""Smallest, in the same units."""


@dataclass(frozen=True)
class Spread:
    """How runs differ along a direction of x."""

    size: float
    """Standard deviation between runs, in the direction's units."""
    gained: float
    """2 ln L gained by it over one common value."""
    covariance: np.ndarray
    """(p, p) of the shared parameters, runs taken for draws of what the rig may be."""


def between_runs(found: Fit, direction: np.ndarray, drawn: np.ndarray | None = None) -> Spread:
    """The spread of a parameter along a direction (p) of x that the runs are most likely with; ``drawn`` (s): how often
    each stretch counts, by default once."""
    normals, gradients = found.run_normals(found.weighing, drawn)
    prior = found.space.precision
    common = normals.sum(axis=0) + np.diag(prior)
    force = gradients.sum(axis=0) - prior * (found.x - found.space.mean)
    coupled = normals @ direction
    solved = np.linalg.solve(common, np.column_stack([coupled.T, force]))
    own = coupled @ direction
    matrix = np.diag(own) - coupled @ solved[:, :-1]
    slope = gradients @ direction - coupled @ solved[:, -1]
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    values, along = np.maximum(values, 0.0), vectors.T @ slope

    def gained(log_size: float) -> float:
        variance = np.exp(2.0 * log_size)
        grown = 1.0 + values * variance
        return float(np.sum(along**2 * variance / grown - np.log(grown)))

    best = minimize_scalar(lambda s: -gained(s), bounds=(np.log(TINIEST), np.log(WIDEST)), method="bounded",
                           options={"xatol": 1e-4})
    if best.fun >= 0.0:
        return Spread(0.0, 0.0, np.linalg.inv(common))
    size = float(np.exp(best.x))
    loosened = common - coupled.T @ (coupled / (own + size**-2)[:, None])
    return Spread(size, -float(best.fun), np.linalg.inv(loosened))


def shared(of: np.ndarray) -> float:
    """2 ln of the likelihood ratio by which values of R runs (R) have a mean of their own instead of 0.

    Normal about either, by the most likely spread: R ln(sum a^2/sum (a - m)^2).
    """
    spread = float(np.var(of))
    return len(of) * math.log1p(float(np.mean(of)) ** 2 / spread) if spread > 0.0 else math.inf


@dataclass(frozen=True)
class Difference:
    """By how much runs differ in something that the motor does more than the rig says."""

    size: float
    """Standard deviation from run to run."""
    gained: float
    """2 ln L gained by it over runs that are alike."""
    log_odds: np.ndarray
    """(k) ln of the evidence for it, in every resample."""


def differences(found: Fit, weighing: Weighing, drawn: np.ndarray) -> tuple[Difference, Difference]:
    """In the share of the command and in the constant that ``Weighing.differ`` has, each judged beside the other;
    ``drawn`` (k, s): how often each stretch counts in every resample."""
    share, constant = found.most_likely_differ(weighing)
    sizes = np.array([[share, constant], [0.0, constant], [share, 0.0]])
    whole, resampled = found.log_evidences(weighing, sizes), found.log_evidences(weighing, sizes, drawn[:, None])
    first, second = (Difference(size, float(2.0 * (whole[0] - whole[k])), resampled[:, 0] - resampled[:, k])
                     for k, size in ((1, share), (2, constant)))
    return first, second
