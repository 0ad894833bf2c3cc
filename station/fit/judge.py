"""What the data say about each constant at the fitted point, and what they leave open."""

from __future__ import annotations

import numpy as np

from station.diagnose.equivalences import powers
from station.fit.problem import Problem
from station.fit.result import FitResult, FittedConstant, FlatDirection

LAGS = 150
"""Samples over which residuals are taken to remember each other."""
DRAWS = 40
"""Simulations of what rounding does to the fit."""
FLAT = 0.5
"""A direction is flat where the data leave more than this share of its stated variance."""
UNKNOWN = 0.5
"""A constant of which the data take away less than this share of the variance is warned about."""
SEEN = 0.05
"""A direction is invisible where the data take away less than this share of its variance."""


def judge(problem: Problem, x: np.ndarray, held: tuple[str, ...], bound: float, nominal: float, starts: int,
          agreeing: int) -> FitResult:
    """Intervals, correlations, flat directions and warnings at the fitted point."""
    count, paths = len(problem.paths), problem.paths
    residuals = problem.residuals(x)
    chi2 = float(np.mean(residuals**2))
    posterior = covariance(problem, x, residuals, problem.jacobian(x))
    logs = problem.root @ posterior @ problem.root.T
    deviation = np.sqrt(np.diag(logs))
    stated = np.sqrt(np.sum(problem.root**2, axis=1))
    fitted = problem.rig_at(x)
    values, nominals = fitted.constants(), problem.rig.constants()
    bounded = np.abs(x[:count]) > 0.999 * bound
    constants = []
    for k, path in enumerate(paths):
        low, high = sorted(values[path] * np.exp(1.96 * deviation[k] * np.array([-1.0, 1.0])))
        constants.append(FittedConstant(path, nominals[path], values[path], float(low), float(high),
                                        float(np.clip(1.0 - (deviation[k] / stated[k]) ** 2, 0.0, 1.0))))
    warnings = []
    if not set(held) & set(common_factor([*paths, *held])):
        warnings.append("one common factor of " + ", ".join(common_factor(paths))
                        + " is invisible to command, encoder and accelerometer; hold one of them")
    loose = [c.path for c in constants if c.determined < UNKNOWN]
    if loose:
        warnings.append(f"the data do not determine {', '.join(loose)}; what is said of them is mostly the rig "
                        "file's own uncertainty")
    if bounded.any():
        warnings.append(f"at the bound of {bound:g} stated deviations: "
                        + ", ".join(path for path, at in zip(paths, bounded, strict=True) if at))
    if chi2 > 2.0:
        warnings.append(f"what is left is {np.sqrt(chi2):.3g} times the noise: these constants alone do not explain "
                        "the runs")
    if agreeing < starts:
        warnings.append(f"{starts - agreeing} of {starts} starts ended in another minimum")
    return FitResult(fitted, tuple(constants), held, logs / np.outer(deviation, deviation),
                     tuple(flat_directions(problem, posterior)), tuple(warnings), chi2, nominal, starts, agreeing)


def covariance(problem: Problem, x: np.ndarray, residuals: np.ndarray,
               jacobian: np.ndarray) -> np.ndarray:
    """Posterior covariance of the constants (in stated deviations), for residuals that remember their past.

    H^-1 (S + R + prior) H^-1 with H = J'J/s^2 + prior.  S is the long-run variance of the scores J_i e_i (Newey and
    West, Econometrica 55, 1987), R that of what rounding does, simulated: a reading at rest is rounded alike for
    hundreds of rows, and in a closed loop the compensator answers each rounding.  Intervals that took the residuals
    as white would be too narrow.  No direction is left wider than the rig file states it.
    """
    scale = max(float(np.mean(residuals**2)), 1.0)
    prior = np.diag((np.arange(problem.size) < len(problem.paths)).astype(float))
    scores, blocks = jacobian * residuals[:, None] / scale, problem.blocks
    white = slice(blocks[-1].stop if blocks else 0, None)
    longrun = scores[white].T @ scores[white]
    for block in blocks:
        part = scores[block]
        longrun = longrun + part.T @ part
        lags = min(LAGS, len(part) // 4)
        for lag in range(1, lags + 1):
            shared = part[lag:].T @ part[:-lag]
            longrun += (1.0 - lag / (lags + 1.0)) * (shared + shared.T)
    rng = np.random.default_rng(0)
    for _ in range(DRAWS):
        score = jacobian.T @ problem.rounding(x, rng) / scale
        longrun += np.outer(score, score) / DRAWS
    inverse = np.linalg.pinv(jacobian.T @ jacobian / scale + prior, hermitian=True)
    count = len(problem.paths)
    values, vectors = np.linalg.eigh((inverse @ (longrun + prior) @ inverse)[:count, :count])
    return vectors * np.minimum(values, 1.0) @ vectors.T


def common_factor(paths: list[str]) -> dict[str, float]:
    """Powers of the factor that no reading shows: torques, inertias, dampings and stiffnesses scaled together."""
    return {path: power for path, power in zip(paths, powers(paths, 0), strict=True) if power}


def length_scale(paths: list[str]) -> dict[str, float]:
    """Powers of a factor on the beam's length that no reading shows; see ``diagnose.equivalences`` for both."""
    return {path: power for path, power in zip(paths, powers(paths, 1), strict=True) if power}


def invisible(paths: list[str], constants: list[str]) -> list[np.ndarray]:
    """Logarithmic directions over ``paths`` that no data of this rig can show, all others of its constants held."""
    factors = [common_factor(constants)]
    if "beam.length" in constants:
        factors.append(length_scale(constants))
    basis = np.array([[factor.get(path, 0.0) for path in constants] for factor in factors])
    fixed = [k for k, path in enumerate(constants) if path not in paths]
    _, sizes, right = np.linalg.svd(basis[:, fixed].T, full_matrices=True)
    null = right[int(np.sum(sizes > 1e-9)):]
    free = [constants.index(path) for path in paths]
    return [mix @ basis[:, free] for mix in null]


def flat_directions(problem: Problem, posterior: np.ndarray) -> list[FlatDirection]:
    """Directions that the data leave open, first those that no data could close.

    ``posterior`` (n, n) in coordinates in which the stated uncertainty is the unit matrix.
    """
    found, basis = [], np.zeros((0, len(problem.paths)))
    for logs in invisible(problem.paths, list(problem.rig.constants())):
        unit = np.linalg.solve(problem.root, logs)
        unit /= np.linalg.norm(unit)
        if unit @ posterior @ unit > 1.0 - SEEN:
            found.append(_direction(problem, unit, True, float(unit @ posterior @ unit)))
            basis = np.vstack([basis, unit])
    away = np.eye(len(problem.paths)) - np.linalg.pinv(basis) @ basis
    values, vectors = np.linalg.eigh(away @ posterior @ away)
    for value, vector in sorted(zip(values, vectors.T, strict=True), key=lambda pair: -pair[0]):
        if value > FLAT:
            found.append(_direction(problem, vector, False, float(value)))
    return found


def _direction(problem: Problem, unit: np.ndarray, always: bool, variance: float) -> FlatDirection:
    logs = problem.root @ unit
    top = int(np.argmax(np.abs(logs)))
    powers = {problem.paths[k]: float(logs[k] / logs[top]) for k in np.argsort(-np.abs(logs), kind="stable")
              if abs(logs[k]) > 0.1 * abs(logs[top])}
    return FlatDirection(powers, always, float(np.clip(1.0 - variance, 0.0, 1.0)))
