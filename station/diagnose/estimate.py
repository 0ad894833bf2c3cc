"""Fitting one hypothesis: Levenberg-Marquardt with priors, per-run nuisances eliminated, evidence by Laplace.

With residuals e, Jacobian J and nuisance columns N of one run (prior precision P), eliminating the nuisances gives
the run's normal matrix A = J'J - J'N (N'N + P)^-1 N'J and gradient g = J'e - J'N (N'N + P)^-1 N'e.  Runs add.

While a model does not reach the noise, chi^2/n is taken as the noise's scale (never below 1): priors keep their say
against a misfit that is not noise, and far from the optimum steps stay where the linearisation holds.

The derivatives by the constants may be handed over from a neighbouring hypothesis; they are then corrected after each
step by what the step did (Broyden 1965) and computed afresh only where that does not lead on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.diagnose.problem import Layout, Problem

STEP = 2e-3
"""Finite-difference step in whitened or logarithmic coordinates."""
HUGE = 1e30
LONGEST = 2.0
"""Longest step in any coordinate, prior sigmas or logarithm."""


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

    @property
    def chi2(self) -> float:
        """Of the data, over all runs, nuisances' priors included."""
        return float(self.costs.sum() + self.penalty.sum())

    @property
    def logs(self) -> np.ndarray:
        """Logarithms of constants over their nominal values."""
        return self.layout.root @ self.x[: len(self.layout.paths)]

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
    return np.array([(0.35 * problem.rig.angle_per_count) ** -2, 0.5**-2])[: problem.channels]


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


def fit(problem: Problem, layout: Layout, x: np.ndarray, start: np.ndarray | None = None,
        offset: np.ndarray | None = None, *, iterations: int = 25, tolerance: float = 0.1,
        weights: np.ndarray | None = None, jacobian: list[np.ndarray] | None = None, parallel: bool = True,
        exact_end: bool = True) -> Fit:
    """Minimise chi^2 plus priors from ``x``; ``tolerance`` is the fall of the objective that ends it.

    ``weights`` (runs) of 0 leave a run out of the fit; its nuisances follow all the same.  ``jacobian`` (per run
    (p + nuisances, channels n)) starts the quick way; ``exact_end`` computes the derivatives afresh at its end.
    """
    start = problem.start.copy() if start is None else start.copy()
    offset = problem.offset.copy() if offset is None else offset.copy()
    weights = np.ones(len(problem.runs)) if weights is None else weights
    scaled = [m * s for m, s in zip(problem.measured, problem.scale, strict=True)]
    nuisance_prior, prior = nuisance_priors(problem), layout.prior_precision
    samples, count, constants = float(weights @ problem.samples), layout.size, len(layout.paths)
    run_map = problem.pool.map if parallel else map

    def look(x: np.ndarray, start: np.ndarray, offset: np.ndarray):
        outputs = problem.outputs(layout, x, start, offset)
        residuals = [m - y for m, y in zip(scaled, outputs, strict=True)]
        with np.errstate(over="ignore", invalid="ignore"):
            costs = np.array([np.sum(e * e, axis=1) for e in residuals])
        away = np.stack([start - problem.start, offset - problem.offset])[: problem.channels]
        penalty = nuisance_prior @ away**2
        data = float(weights @ (costs.sum(axis=1) + penalty))
        if not data < HUGE:
            return np.inf, np.inf, outputs, residuals, costs, penalty
        total = data if data <= samples else samples * (1.0 + np.log(data / samples))
        return total + float(prior @ (x - layout.prior_mean) ** 2), data, outputs, residuals, costs, penalty

    def columns(which: list[int], x: np.ndarray, start: np.ndarray, offset: np.ndarray, outputs: list[np.ndarray]):
        """Derivatives by parameters ``which`` (count: starting angle, count + 1: offset), per run stacked."""
        def moved(k: int):
            if k < count:
                other = x.copy()
                other[k] += STEP
                return problem.outputs(layout, other, start, offset), STEP
            if k == count:
                step = 0.5 * problem.rig.angle_per_count
                return problem.outputs(layout, x, start + step, offset), step
            return problem.outputs(layout, x, start, offset + 0.1), 0.1
        found = list(run_map(moved, which))
        return [np.stack([(y[r] - outputs[r]).ravel() / step for y, step in found]) for r in range(len(outputs))]

    def along(spread: np.ndarray, x: np.ndarray, start: np.ndarray, offset: np.ndarray, outputs: list[np.ndarray]):
        """Derivatives from steps along the columns of ``spread`` (p, p), the posterior's own axes and widths.

        Sticking makes outputs kinked; a difference over the width that the data leave open is the one that counts.
        """
        def moved(k: int):
            if k < count:
                return problem.outputs(layout, x + spread[:, k], start, offset)
            if k == count:
                return problem.outputs(layout, x, start + angle, offset)
            return problem.outputs(layout, x, start, offset + 0.1)
        angle = 0.5 * problem.rig.angle_per_count
        found = list(run_map(moved, everything))
        jac = []
        for r in range(len(outputs)):
            changes = np.stack([(y[r] - outputs[r]).ravel() for y in found])
            changes[:count] = np.linalg.solve(spread.T, changes[:count])
            changes[count:] /= np.array([angle, 0.1])[: problem.channels, None]
            jac.append(changes)
        return jac

    def axes() -> np.ndarray:
        values, vectors = np.linalg.eigh(np.tensordot(weights, normal, 1) / max(data / samples, 1.0) + np.diag(prior))
        spread = vectors / np.sqrt(np.maximum(values, 1e-12))
        return spread * np.minimum(1.0, 0.5 / np.maximum(np.max(np.abs(spread), axis=0), 1e-300))

    everything, effects = list(range(count + problem.channels)), list(range(constants, count))
    objective, data, outputs, residuals, costs, penalty = look(x, start, offset)
    if objective == np.inf:
        raise ArithmeticError("the fit's start does not simulate")
    fresh = jacobian is None
    jac = columns(everything, x, start, offset, outputs) if fresh else [j.copy() for j in jacobian]
    damping, renewed = 1e-3, fresh
    done = False
    for iteration in range(iterations + 1):
        if not fresh and effects:
            for j, new in zip(jac, columns(effects, x, start, offset, outputs), strict=True):
                j[constants:count] = new
        normal, gradient, back = eliminate(problem, start, offset, residuals, jac, count)
        if done or iteration == iterations:
            break
        scale = max(data / samples, 1.0)
        matrix = np.tensordot(weights, normal, 1) / scale + np.diag(prior)
        force = weights @ gradient / scale - prior * (x - layout.prior_mean)
        better = False
        for _ in range(5):
            step = np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), force)
            if not np.all(np.isfinite(step)):
                damping *= 10.0
                continue
            step *= min(1.0, LONGEST / max(np.max(np.abs(step)), 1e-300))
            nuisance = np.array([b[0] - b[1] @ step for b in back])
            new_start = problem.near_reading(start + nuisance[:, 0])
            nuisance[:, 0] = new_start - start
            new_offset = offset + nuisance[:, 1] if problem.has_accel else offset
            trial = look(x + step, new_start, new_offset)
            if trial[0] < objective:
                better = True
                break
            damping *= 10.0
        if better:
            gain = objective - trial[0]
            move = [np.concatenate([step, nuisance[r]]) for r in range(len(outputs))]
            old, x, start, offset = outputs, x + step, new_start, new_offset
            objective, data, outputs, residuals, costs, penalty = trial
            damping = max(damping / 10.0, 1e-9)
            if not renewed:
                for r, j in enumerate(jac):
                    weight = move[r].copy()
                    weight[count:] *= nuisance_prior**0.5
                    norm = float(weight @ weight)
                    if norm > 1e-12:
                        missing = (outputs[r] - old[r]).ravel() - move[r] @ j
                        j += np.outer(weight / norm * np.where(np.arange(j.shape[0]) < count, 1.0,
                                                               np.r_[np.ones(count), nuisance_prior**0.5]), missing)
        stuck = not better or gain < tolerance
        if renewed:
            if stuck and (not better or gain < tolerance):
                done = True
            if better and not done or exact_end and better:
                jac = along(axes(), x, start, offset, outputs)
            if done and not better:
                break
        elif stuck:
            if not exact_end:
                done = True
                if not better:
                    break
            else:
                jac, renewed, fresh, damping = along(axes(), x, start, offset, outputs), True, True, 1e-3
    return Fit(layout, x, start, offset, objective, costs, penalty, normal, gradient, residuals, outputs, jac)
