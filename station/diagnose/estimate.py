"""Fitting one hypothesis: Levenberg-Marquardt with priors, per-run nuisances eliminated, evidence by Laplace.

With residuals e, Jacobian J and nuisance columns N of one run (prior precision P), eliminating the nuisances gives
the run's normal matrix A = J'J - J'N (N'N + P)^-1 N'J and gradient g = J'e - J'N (N'N + P)^-1 N'e.  Runs add.

While a model does not reach the noise, chi^2/n is taken as the noise's scale (never below 1): priors keep their say
against a misfit that is not noise, and far from the optimum steps stay where the linearisation holds.

Derivatives by the constants may be handed over from a neighbouring hypothesis.  After each step they are corrected by
what the step did (Broyden 1965), and computed afresh only where that does not lead on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from station.diagnose.problem import Layout, Problem

LOST = (ArithmeticError, np.linalg.LinAlgError)
"""What a fit raises that went where nothing simulates."""
STEP = 2e-3
"""Finite-difference step in whitened or logarithmic coordinates."""
HUGE = 1e30
LONGEST = 2.0
"""Longest step in any coordinate, prior sigmas or logarithm."""
PLACE_STEP = 0.02
"""Finite-difference step of the motor's place in a gap (artanh of its share)."""
OFFSET_STEP = 0.1
"""Finite-difference step of the accelerometer's offset, counts."""
NUISANCES = (0.35, 0.5)
"""Prior sigmas of a run's starting angle and accelerometer offset, counts."""
POOR = 0.5
"""Share of the predicted gain below which derivatives are computed afresh."""
DAMPING, LEAST_DAMPING = 1.0, 0.01
"""Of steps, near the end in units of the prior's information, so that it holds back only what the data hardly see."""
FAR_OFF = 1e-3
"""The same before, in units of the information itself (Marquardt 1963)."""
REACHED = 1.5
"""Variance of what is left, over the noise's, below which a rig without causes is fitted to the end."""
CORRECTIONS, CORRECTED, STIFF = 3, 2, 100.0
"""Steps back to a valley's floor, the first steps that are corrected so (shorter ones stay on the floor by themselves),
and the information (1/prior sigma^2) below which a correction leaves a direction alone."""
FAR = 100.0
"""A step that multiplies chi^2 by more is not worth correcting."""
SETTLED = 0.3
"""Squared distance, posterior sigmas, over which derivatives are taken to stay."""


@dataclass(eq=False)
class Fit:
    """A fitted hypothesis."""

    layout: Layout
    x: np.ndarray
    start: np.ndarray
    offset: np.ndarray
    objective: float
    """Minus twice the log posterior, the noise's scale profiled out."""
    costs: np.ndarray
    """(runs, channels) sums of squared scaled residuals."""
    penalty: np.ndarray
    """(runs) what the nuisances' priors add."""
    normal: np.ndarray
    """(runs, p, p), nuisances eliminated."""
    gradient: np.ndarray
    """(runs, p)."""
    residuals: list[np.ndarray]
    """Per run (channels, n), scaled."""
    outputs: list[np.ndarray]
    """Per run (channels, n), scaled."""
    jacobian: list[np.ndarray]
    """Per run (p + nuisances, channels n)."""
    scale: list[np.ndarray]
    """Per run (channels, n), what residuals, outputs and derivatives are scaled with."""
    stuck: bool = False
    """Whether ``jacobian`` leads no further."""
    ended: bool = False
    """Whether that holds of derivatives computed at this very place, over the widths that the data leave open."""

    @property
    def chi2(self) -> float:
        """Of the data, over all runs, nuisances' priors included."""
        return float(self.costs.sum() + self.penalty.sum())

    @property
    def logs(self) -> np.ndarray:
        """Logarithms of constants over their nominal values."""
        return self.layout.root @ self.x[: len(self.layout.paths)]

    @property
    def strain(self) -> float:
        """What the distances of the constants from nominal cost, squared sigmas."""
        n = len(self.layout.paths)
        return float(self.layout.prior_precision[:n] @ (self.x - self.layout.prior_mean)[:n] ** 2)

    def jacobian_at(self, scale: list[np.ndarray]) -> list[np.ndarray]:
        """The derivatives under other scales."""
        return [j * (new / np.where(old > 0.0, old, 1.0)).ravel()
                for j, new, old in zip(self.jacobian, scale, self.scale, strict=True)]

    def precision(self, temperature: float = 1.0) -> np.ndarray:
        """Posterior precision (p, p)."""
        return self.normal.sum(axis=0) / temperature + np.diag(self.layout.prior_precision)

    def covariance(self, temperature: float = 1.0) -> np.ndarray:
        """Posterior covariance (p, p)."""
        return np.linalg.pinv(self.precision(temperature), hermitian=True)

    def log_evidence(self, temperature: float = 1.0) -> float:
        """Laplace's approximation of log p(data | hypothesis), up to a constant of the data."""
        prior = self.layout.prior_precision
        delta = self.x - self.layout.prior_mean
        _, logdet = np.linalg.slogdet(self.precision(temperature))
        return float(-0.5 * self.chi2 / temperature - 0.5 * np.sum(prior * delta**2)
                     + 0.5 * np.sum(np.log(prior)) - 0.5 * logdet)


def nuisance_priors(problem: Problem) -> np.ndarray:
    """Prior precisions of a run's starting angle (rad) and accelerometer offset (counts)."""
    angle, offset = NUISANCES
    return np.array([(angle * problem.rig.angle_per_count) ** -2, offset**-2])[: problem.channels]


def eliminate(problem: Problem, fit_start: np.ndarray, fit_offset: np.ndarray, residuals: list[np.ndarray],
              jacobian: list[np.ndarray], count: int) -> tuple[np.ndarray, np.ndarray, list[tuple]]:
    """Normal matrices and gradients per run without the nuisances, and what gives the nuisances back."""
    prior = nuisance_priors(problem)
    normal, gradient, back = [], [], []
    for r, e in enumerate(residuals):
        params, nuisances = jacobian[r][:count], jacobian[r][count:]
        away = np.array([fit_start[r] - problem.start[r], fit_offset[r] - problem.offset[r]])[: problem.channels]
        inner = nuisances @ nuisances.T + np.diag(prior)
        cross = nuisances @ params.T
        solved = np.linalg.solve(inner, np.column_stack([cross, nuisances @ e.ravel() - prior * away]))
        normal.append(params @ params.T - cross.T @ solved[:, :-1])
        gradient.append(params @ e.ravel() - cross.T @ solved[:, -1])
        back.append((solved[:, -1], solved[:, :-1]))
    return np.array(normal), np.array(gradient), back


@dataclass(eq=False)
class _Point:
    """One place that has been simulated."""

    x: np.ndarray
    start: np.ndarray
    offset: np.ndarray
    outputs: list[np.ndarray]
    residuals: list[np.ndarray]
    costs: np.ndarray
    penalty: np.ndarray
    data: float
    """chi^2 with the nuisances' priors, weighted by run."""
    objective: float


class _Descent:
    """What a fit needs of a problem, a layout and the weights of the runs."""

    def __init__(self, problem: Problem, layout: Layout, weights: np.ndarray, parallel: bool) -> None:
        self.problem, self.layout, self.weights, self.parallel = problem, layout, weights, parallel
        self.scaled = [m * s for m, s in zip(problem.measured, problem.scale, strict=True)]
        self.nuisance_prior, self.prior = nuisance_priors(problem), layout.prior_precision
        self.samples = float(weights @ problem.samples)
        self.count, self.shared = layout.size, layout.size - layout.gap_places
        self.angle = 0.5 * problem.rig.angle_per_count
        places = [-1] if layout.gap_places else []
        self.everything = [*range(self.shared), *places, *range(self.count, self.count + problem.channels)]
        self.effects = [*range(len(layout.paths), self.shared), *places]

    def at(self, x: np.ndarray, start: np.ndarray, offset: np.ndarray) -> _Point:
        """Simulate, and judge."""
        problem = self.problem
        outputs = problem.outputs(self.layout, x, start, offset, parallel=self.parallel)
        residuals = [m - y for m, y in zip(self.scaled, outputs, strict=True)]
        with np.errstate(over="ignore", invalid="ignore"):
            costs = np.array([np.sum(e * e, axis=1) for e in residuals])
        away = np.stack([start - problem.start, offset - problem.offset])[: problem.channels]
        penalty = self.nuisance_prior @ away**2
        data = float(self.weights @ (costs.sum(axis=1) + penalty))
        if not data < HUGE:
            data = total = np.inf
        else:
            total = data if data <= self.samples else self.samples * (1.0 + np.log(data / self.samples))
            total += float(self.prior @ (x - self.layout.prior_mean) ** 2)
        return _Point(x, start, offset, outputs, residuals, costs, penalty, data, total)

    def eliminated(self, here: _Point, jac: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, list[tuple]]:
        """Normal matrices and gradients at a point; see ``eliminate``."""
        return eliminate(self.problem, here.start, here.offset, here.residuals, jac, self.count)

    def columns(self, here: _Point, which: list[int], spread: np.ndarray) -> list[np.ndarray]:
        """Changes of the outputs by steps along columns ``which`` of ``spread``, per run stacked.

        count: the starting angle; count + 1: the offset; -1: the motor's places in the gaps, one row per run.
        Sticking makes outputs kinked; a difference over the width that the data leave open is the one that counts.
        """
        def moved(k: int, way: float = 1.0) -> list[np.ndarray]:
            x, start, offset = here.x.copy(), here.start, here.offset
            if k < 0:
                x[self.shared:] += way * PLACE_STEP
            elif k < self.count:
                x += way * spread[:, k]
            elif k == self.count:
                start = start + way * self.angle
            else:
                offset = offset + way * OFFSET_STEP
            return self.problem.outputs(self.layout, x, start, offset)

        def change_by(k: int) -> list[np.ndarray]:
            """Per run; a step to where nothing simulates is taken back the other way, and where that fails is 0."""
            for way in (1.0, -1.0):
                changes = [way * (y - before) for y, before in zip(moved(k, way), here.outputs, strict=True)]
                if all(np.all(np.isfinite(change)) for change in changes):
                    return changes
            return [np.zeros_like(before) for before in here.outputs]

        found = list((self.problem.pool.map if self.parallel else map)(change_by, which))
        rows: list[np.ndarray] = []
        for r in range(len(here.outputs)):
            changes = []
            for k, by_run in zip(which, found, strict=True):
                change = by_run[r].ravel()
                changes += [change] if k >= 0 else [change * (place == r) for place in range(self.layout.gap_places)]
            rows.append(np.stack(changes))
        return rows

    def afresh(self, here: _Point, spread: np.ndarray) -> list[np.ndarray]:
        """The whole Jacobian, from steps along the columns of ``spread``."""
        found = self.columns(here, self.everything, spread)
        shared, count = self.shared, self.count
        for changes in found:
            changes[:shared] = np.linalg.solve(spread[:shared, :shared].T, changes[:shared])
            changes[shared:count] /= PLACE_STEP
            changes[count:] /= np.array([self.angle, OFFSET_STEP])[: self.problem.channels, None]
        return found

    def renew_effects(self, here: _Point, jac: list[np.ndarray]) -> None:
        """The effects' own columns of the Jacobian, in place."""
        constants, shared, count = len(self.layout.paths), self.shared, self.count
        for j, new in zip(jac, self.columns(here, self.effects, STEP * np.eye(count)), strict=True):
            j[constants:shared] = new[: shared - constants] / STEP
            j[shared:count] = new[shared - constants:] / PLACE_STEP

    def axes(self, normal: np.ndarray, scale: float) -> np.ndarray:
        """The posterior's own axes and widths."""
        matrix = np.tensordot(self.weights, normal, 1) / scale + np.diag(self.prior)
        values, vectors = np.linalg.eigh(matrix[: self.shared, : self.shared])
        found = vectors / np.sqrt(np.maximum(values, 1e-12))
        spread = np.zeros((self.count, self.count))
        spread[: self.shared, : self.shared] = found * np.minimum(
            1.0, 0.5 / np.maximum(np.max(np.abs(found), axis=0), 1e-300))
        return spread

    def step(self, here: _Point, damped: np.ndarray, force: np.ndarray, back: list[tuple]) -> _Point | None:
        """The point one damped Gauss-Newton step away."""
        step = np.linalg.solve(damped, force)
        if not np.all(np.isfinite(step)):
            return None
        step *= min(1.0, LONGEST / max(np.max(np.abs(step)), 1e-300))
        nuisance = np.array([b[0] - b[1] @ step for b in back])
        start = self.problem.near_reading(here.start + nuisance[:, 0])
        offset = here.offset + nuisance[:, 1] if self.problem.has_accel else here.offset
        return self.at(here.x + step, start, offset)

    def lower(self, here: _Point, jac: list[np.ndarray], matrix: np.ndarray, force: np.ndarray, back: list[tuple],
              scale: float, damping: float, metric: np.ndarray, tries: int) -> tuple[_Point | None, float]:
        """A point with a lower objective, if one is found, and the damping that led there.

        A step along a narrow bent valley ends on its side.  Up to CORRECTIONS further steps with the same derivatives,
        across the valley alone (STIFF holds what the data hardly see), bring it back to the floor before it is judged.
        """
        stiff = matrix + STIFF * np.eye(self.count)
        for attempt in range(tries):
            trial = self.step(here, matrix + damping * metric, force, back)
            for _ in range(CORRECTIONS if attempt < CORRECTED else 0):
                if trial is None or trial.objective < here.objective or trial.data > FAR * here.data:
                    break
                _, gradient, ahead = self.eliminated(trial, jac)
                pull = self.weights @ gradient / scale - self.prior * (trial.x - self.layout.prior_mean)
                trial = self.step(trial, stiff, pull, ahead)
            if trial is not None and trial.objective < here.objective:
                return trial, damping
            damping *= 10.0
        return None, damping


def fit(problem: Problem, layout: Layout, x: np.ndarray, start: np.ndarray | None = None,
        offset: np.ndarray | None = None, *, iterations: int = 25, tolerance: float = 0.1,
        weights: np.ndarray | None = None, jacobian: list[np.ndarray] | None = None, parallel: bool = True,
        renewals: int = 100, renew: bool = False) -> Fit:
    """Minimise chi^2 plus priors from ``x``; ``tolerance`` is the fall of the objective that ends it.

    ``weights`` (runs) of 0 leave a run out of the fit; its nuisances follow all the same.  ``jacobian`` (per run
    (p + nuisances, channels n)) starts the quick way; where it leads no further the derivatives are computed afresh, at
    most ``renewals`` times, and at once where ``renew`` says that it leads nowhere.
    ``parallel`` spreads the work over the problem's threads; not from one of them.
    """
    descent = _Descent(problem, layout, np.ones(len(problem.runs)) if weights is None else weights, parallel)
    here = descent.at(x, problem.start.copy() if start is None else start,
                      problem.offset.copy() if offset is None else offset)
    if here.objective == np.inf:
        raise ArithmeticError("the fit's start does not simulate")
    jac = descent.afresh(here, STEP * np.eye(layout.size)) if jacobian is None else [j.copy() for j in jacobian]
    drift = 0.0 if jacobian is None else np.inf
    along_axes, stuck, damping = False, False, DAMPING
    normal, gradient, back = descent.eliminated(here, jac)
    for _ in range(iterations):
        if renew:
            jac = descent.afresh(here, descent.axes(normal, max(here.data / descent.samples, 1.0)))
            along_axes, drift, damping, renew = True, 0.0, min(damping, DAMPING), False
            renewals -= 1
            normal, gradient, back = descent.eliminated(here, jac)
        elif drift > 0.0 and descent.effects:
            descent.renew_effects(here, jac)
            normal, gradient, back = descent.eliminated(here, jac)
        scale = max(here.data / descent.samples, 1.0)
        matrix = np.tensordot(descent.weights, normal, 1) / scale + np.diag(descent.prior)
        force = descent.weights @ gradient / scale - descent.prior * (here.x - layout.prior_mean)
        metric = np.eye(layout.size) if along_axes else FAR_OFF * np.diag(np.diag(matrix))
        found, damping = descent.lower(here, jac, matrix, force, back, scale, damping, metric,
                                       5 if drift == 0.0 else 3)
        stuck, gain, ratio = found is None, 0.0, 0.0
        if found is not None:
            step = found.x - here.x
            gain = here.objective - found.objective
            ratio = gain / max(float(2.0 * force @ step - step @ matrix @ step), 1e-300)
            drift += float(step @ matrix @ step)
            damping = max(damping / 10.0, LEAST_DAMPING)
            _broyden(jac, here, found, layout.size, descent.nuisance_prior)
            here = found
            normal, gradient, back = descent.eliminated(here, jac)
        if gain >= tolerance and (ratio > POOR or not renewals):
            continue
        if not renewals or (gain < tolerance and drift < SETTLED and along_axes):
            break
        renew = True
    return Fit(layout, here.x, here.start, here.offset, here.objective, here.costs, here.penalty, normal, gradient,
               here.residuals, here.outputs, jac, [s.copy() for s in problem.scale], stuck,
               stuck and along_axes and drift == 0.0)


def go_on(problem: Problem, found: Fit, **how: Any) -> Fit:
    """Take a fit further, ``how`` as in ``fit``, from what its derivatives are known to be worth; not over threads."""
    if found.ended:
        return found
    return fit(problem, found.layout, found.x, found.start, found.offset, jacobian=found.jacobian,
               renew=found.stuck, parallel=False, **how)


def _broyden(jac: list[np.ndarray], old: _Point, new: _Point, count: int, nuisance_prior: np.ndarray) -> None:
    """Correct Jacobians (per run) so that they give what a step did; nuisances in units of their priors."""
    units = np.concatenate([np.ones(count), np.sqrt(nuisance_prior)])
    for r, j in enumerate(jac):
        nuisances = [new.start[r] - old.start[r], new.offset[r] - old.offset[r]][: len(nuisance_prior)]
        step = np.concatenate([new.x - old.x, nuisances])
        norm = float(np.sum((step * units) ** 2))
        if norm > 1e-12:
            j += np.outer(step * units**2 / norm, (new.outputs[r] - old.outputs[r]).ravel() - step @ j)
