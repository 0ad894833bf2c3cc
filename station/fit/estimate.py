"""The fit itself: least squares within the stated uncertainty, from several starts."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy.optimize

from station.errors import UsageError
from station.fit.judge import judge
from station.fit.problem import Problem
from station.fit.result import FitResult
from station.rig import Rig
from station.runs.run import Run

BOUND = 4.0
"""Constants stay within so many stated standard deviations."""
ANGLE, OFFSET = 3.0, 50.0
"""Bounds of a run's starting angle and accelerometer offset about their first readings, counts."""
ROUNDS, STEPS, LAST = 10, 6, 40
"""Rounds of a descent, evaluations of the derivatives in each, and in the last one."""
SAME = 0.02
"""Two descents ended in one minimum where their mean squares differ by less than this share."""
HELD = ("beam.mass_per_length", "motor.inertia")
"""Held by default: the first of these that the rig has."""


def fit(rig: Rig, runs: Sequence[Run], hold: Sequence[str] | None = None, *, domain: str = "time", starts: int = 3,
        bound: float = BOUND, seed: int = 0, progress: Callable[[str, float], None] | None = None) -> FitResult:
    """Fit the rig's constants to runs.

    ``hold``: constants that stay as they are (default: beam.mass_per_length, without a beam motor.inertia), because
    one common factor is invisible; those of no uncertainty stay too.  ``domain``: "time" compares simulations with
    the runs, "frequency" their measured responses with the model's, "both" does both.  ``starts``: the nominal rig,
    then draws from its stated uncertainty, within ``bound`` deviations of which the constants stay.  What the data
    do not say about a constant, the rig file's own uncertainty says.  UsageError names a constant or domain that is
    not there.  ``progress(what, share)`` is called after each start.
    """
    constants = rig.constants()
    held = tuple(hold) if hold is not None else tuple([path for path in HELD if path in constants][:1])
    for path in held:
        if path not in constants:
            raise UsageError(f"hold {path}: this rig has {', '.join(constants)}")
    if domain not in ("time", "frequency", "both"):
        raise UsageError(f"domain {domain!r} is none of time, frequency, both")
    if not runs:
        raise UsageError("a fit wants at least one run")
    for run in runs:
        if abs(run.sample_rate / rig.sample_rate - 1.0) > 1e-3:
            raise UsageError(f"{run.name}: sampled at {run.sample_rate:g} Hz, the rig at {rig.sample_rate:g} Hz")
    stated = rig.log_covariance(list(constants)).diagonal()
    paths = [path for path, variance in zip(constants, stated, strict=True) if path not in held and variance > 0.0]
    if not paths:
        raise UsageError(f"{rig.name}: every constant is held or exact")
    problem = Problem(rig, runs, paths, domain)
    try:
        return _search(problem, held, starts, bound, seed, progress)
    finally:
        problem.close()


def _search(problem: Problem, held: tuple[str, ...], starts: int, bound: float, seed: int,
            progress: Callable[[str, float], None] | None) -> FitResult:
    middle, count = problem.start(), len(problem.paths)
    reach = np.concatenate([np.full(count, bound), np.tile([ANGLE, OFFSET], (problem.size - count) // 2)])
    rng, ends = np.random.default_rng(seed), []
    for k in range(max(starts, 1)):
        x = middle.copy()
        if k:
            x[:count] = np.clip(rng.standard_normal(count), -0.9 * bound, 0.9 * bound)
        ends.append(descend(problem, x, middle - reach, middle + reach))
        if progress is not None:
            progress(f"start {k + 1} of {max(starts, 1)}: mean squared residual {ends[-1][1]:.4g}",
                     (k + 1) / max(starts, 1))
    best = min(ends, key=lambda end: end[1])
    agreeing = sum(mean <= best[1] * (1.0 + SAME) for _, mean in ends)
    nominal = float(np.mean(problem.residuals(middle) ** 2))
    return judge(problem, best[0], held, bound, nominal, len(ends), agreeing)


def descend(problem: Problem, x: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
    """From ``x`` to a minimum: the point, and the mean squared residual there.

    Far from the minimum the residuals are no noise.  Measured by the noise they would drown the stated uncertainty
    and drive the constants along whatever the first derivatives say.  So each round takes the last residuals' own
    size as noise, never less than the real one (1), until that settles.
    """
    count, last = len(problem.paths), np.inf
    prior = np.concatenate([np.ones(count), np.zeros(x.size - count)])
    for _ in range(ROUNDS):
        here = problem.residuals(x)
        mean = float(np.mean(here**2))
        settled = mean > 0.9 * last
        scale, last = max(np.sqrt(mean), 1.0), mean
        memory = {x.tobytes(): here}

        def residuals(y: np.ndarray, scale: float = scale, memory: dict[bytes, np.ndarray] = memory) -> np.ndarray:
            found = problem.residuals(y)
            memory.clear()
            memory[y.tobytes()] = found
            return np.concatenate([found / scale, prior * y])

        def jacobian(y: np.ndarray, scale: float = scale, memory: dict[bytes, np.ndarray] = memory,
                     exact: bool = settled) -> np.ndarray:
            base = None if exact else memory.get(y.tobytes())
            return np.vstack([problem.jacobian(y, base) / scale, np.diag(prior)])

        x = scipy.optimize.least_squares(residuals, x, jac=jacobian, bounds=(low, high), ftol=1.0 / problem.samples,
                                         xtol=1e-6, max_nfev=LAST if settled else STEPS).x
        if settled:
            break
    return x, float(np.mean(problem.residuals(x) ** 2))
